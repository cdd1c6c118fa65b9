"""Policies as they fly: plain NumPy, because 16 units need no tensor library."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

__all__ = ["NetworkPolicy", "Policy"]


class Policy(Protocol):
    """Whatever flies a drone: called once for each control step."""

    def reset(self) -> None:
        """Forget the last episode."""

    def act(self, observation: np.ndarray) -> Any:
        """The action for an observation, shape (n,), as the env takes it."""


class NetworkPolicy:
    """The actor of `networks.Actor`, from its weights.

    Args:
        weights: `hidden.weight` (h, n), `hidden.bias` (h,), `output.weight` (k, h),
            `output.bias` (k,), all float32, and for continuous actions `log_std` (k,).

    Raises:
        ValueError: A weight is missing, or has another shape.
    """

    def __init__(self, weights: Mapping[str, np.ndarray]) -> None:
        _check_shapes(weights)
        self._w1, self._b1 = weights["hidden.weight"], weights["hidden.bias"]
        self._w2, self._b2 = weights["output.weight"], weights["output.bias"]
        log_std = weights.get("log_std")
        self._std = None if log_std is None else np.exp(log_std)
        self._hidden = np.empty_like(self._b1)
        self.observation_size = self._w1.shape[1]
        self.action_size = 1 if self._std is None else len(self._b2)

    def reset(self) -> None:
        """Nothing to forget."""

    def output(self, observation: np.ndarray) -> np.ndarray:
        """Means, or logits, shape (k,)."""
        hidden = self._hidden
        np.dot(self._w1, observation, out=hidden)
        np.add(hidden, self._b1, out=hidden)
        np.maximum(hidden, 0.0, out=hidden)
        mean: np.ndarray = self._w2.dot(hidden)
        mean += self._b2
        return mean

    def act(self, observation: np.ndarray) -> Any:
        """The most likely action, clipped to [-1, 1] if continuous."""
        output = self.output(observation)
        return int(output.argmax()) if self._std is None else clip(output)

    def draw_noise(self, rng: np.random.Generator, steps: int) -> np.ndarray:
        """Randomness for so many calls of `sample`, drawn at once: shape (steps, k)."""
        if self._std is None:
            # The Gumbel trick: the largest of logits plus Gumbel noise is a categorical draw.
            return rng.gumbel(size=(steps, len(self._b2))).astype(np.float32)
        noise = rng.standard_normal((steps, self.action_size), dtype=np.float32)
        noise *= self._std
        return noise

    def sample(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """An action drawn from the policy with one row of `draw_noise`, float32, not clipped.

        Shape (k,); (1,) holding a whole number if actions are discrete.
        """
        output = self.output(observation)
        output += noise
        if self._std is None:
            return np.array((output.argmax(),), np.float32)
        return output

    def samples(self, observations: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """`sample` for N observations, shape (N, n), and N rows of noise: float32, shape (N, k)."""
        hidden: np.ndarray = observations @ self._w1.T
        hidden += self._b1
        np.maximum(hidden, 0.0, out=hidden)
        output: np.ndarray = hidden @ self._w2.T
        output += self._b2
        output += noise
        if self._std is None:
            output = output.argmax(axis=1)[:, np.newaxis].astype(np.float32)
        return output

    def to_envs(self, actions: np.ndarray) -> np.ndarray:
        """What a vector env gets for drawn actions, shape (N, k)."""
        return actions if self._std is None else clip(actions)

    def to_env(self, action: np.ndarray) -> Any:
        """What the env gets for a drawn action."""
        return int(action[0]) if self._std is None else clip(action)


def _check_shapes(weights: Mapping[str, np.ndarray]) -> None:
    got = {name: array.shape for name, array in weights.items()}
    units, inputs = (*got.get("hidden.weight", ()), 0, 0)[:2]
    outputs = (*got.get("output.bias", ()), 0)[0]
    expected = {
        "hidden.weight": (units, inputs),
        "hidden.bias": (units,),
        "output.weight": (outputs, units),
        "output.bias": (outputs,),
    }
    if "log_std" in got:
        expected["log_std"] = (outputs,)
    if got != expected or not units * inputs * outputs:
        raise ValueError(f"policy: expected weights of shapes {expected}, got {got}")


def clip(action: np.ndarray) -> np.ndarray:
    """The nearest action inside [-1, 1]."""
    clipped: np.ndarray = np.minimum(np.maximum(action, np.float32(-1.0)), np.float32(1.0))
    return clipped
