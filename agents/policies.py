"""Policies for flying, in plain NumPy: such small nets need no tensor library."""

from collections.abc import Mapping
from typing import Any, Final, Protocol

import numpy as np

from ..envs.spec import ArraySpec, Discrete, EnvSpec
from ..models.errors import expect

_ZERO: Final = np.zeros((1, 1), np.float32)


class Policy(Protocol):
    """Chooses actions: called once for each control step."""

    def reset(self) -> None:
        """Forget the last episode."""

    def act(self, observation: Any) -> Any:
        """The action for an observation, both as the env has them."""


def flat(observations: Any, spec: EnvSpec, *lead: int) -> np.ndarray:
    """Observations as networks take them: float32, shape (*lead, n).

    Given is an array of shape (*lead, ...), or a mapping with one for each array of the spec.
    """
    if not isinstance(observations, Mapping):
        return np.asarray(observations, np.float32).reshape(*lead, -1)
    parts = [observations[array.name] for array in spec.observation]
    return np.concatenate([np.asarray(p, np.float32).reshape(*lead, -1) for p in parts], axis=-1)


def flat_size(spec: EnvSpec) -> int:
    """Length n of a flat observation."""
    return sum(array.size for array in spec.observation)


class ActionMap:
    """Maps outputs of a network to actions of an env.

    Of a continuous action the network's 0 is the middle between the bounds, -1 the lower and 1 the
    upper one; where there is no bound, it is the number itself. Of a discrete action the network
    gives a number for each choice. An array of whole numbers raises `InputError`.

    Attributes:
        outputs: Numbers that the network gives.
        size: Numbers of a drawn action, k: 1 if discrete.
        discrete: Whether an action is a choice.
        middle: Action of an output 0, shape (1, k); the others likewise. None of them if discrete.
        half: What an output 1 adds to it.
        low: Lower bound of the action, float32; -inf where there is none.
        high: Upper bound.
    """

    def __init__(self, action: ArraySpec | Discrete) -> None:
        self.discrete = isinstance(action, Discrete)
        if isinstance(action, Discrete):
            self.outputs, self.size = action.n, 1
            return
        right = action.dtype.startswith("float")
        expect(right, "action", "a choice or numbers of type float", action.dtype)
        self.outputs = self.size = action.size
        # Two axes here and below: NumPy is slow where it has to add one to a batch of one.
        low, high = (bound.reshape(1, -1) for bound in action.bounds())
        bounded = np.isfinite(low) & np.isfinite(high)
        with np.errstate(invalid="ignore"):
            self.middle = np.where(bounded, (low + high) / 2, 0.0).astype(np.float32)
            self.half = np.where(bounded, (high - low) / 2, 1.0).astype(np.float32)
        self.low, self.high = low.astype(np.float32), high.astype(np.float32)
        self._plain = bool((self.middle == 0).all() and (self.half == 1).all())

    def to_envs(self, actions: np.ndarray) -> np.ndarray:
        """Drawn actions (N, k) as the env's: float32, (N, k), inside the bounds; or int64, (N,)."""
        if self.discrete:
            return actions[:, 0].astype(np.int64)
        if not self._plain:
            actions = self.middle + self.half * actions
        clipped: np.ndarray = np.minimum(np.maximum(actions, self.low), self.high)
        return clipped


def _expected_shapes(
    got: Mapping[str, tuple[int, ...]], inputs: int, actions: ActionMap, squash: bool
) -> dict[str, tuple[int, ...]]:
    """Of the weights of a policy with as many units in its layers as those have."""
    expected: dict[str, tuple[int, ...]] = {}
    last = max(sum(name.startswith("layers.") for name in got) // 2 - 1, 0)
    before = inputs
    for i in range(last + 1):
        units = actions.outputs if i == last else (*got.get(f"layers.{i}.bias", ()), 0)[0]
        expected |= {f"layers.{i}.weight": (units, before), f"layers.{i}.bias": (units,)}
        before = units
    if not actions.discrete and ("log_std" in got or not squash):
        expected["log_std"] = (actions.outputs,)
    if any(name.startswith("observation.") for name in got):
        expected |= {"observation.mean": (inputs,), "observation.scale": (inputs,)}
    return expected


class NetworkPolicy:
    """The actor of `networks.Actor`, from its weights, all float32.

    These are `layers.0.weight` (h, n), `layers.0.bias` (h,) and so on to the last layer, which
    gives the mean of the action or the logits of the choices, k numbers; for continuous actions
    `log_std` (k,); and where observations are normalised `observation.mean` (n,) and
    `observation.scale` (n,): the input is (observation - mean) · scale. With `squash` the output is
    tanh of the last layer's, and `log_std` may be left out: then the policy acts, but draws none.
    Raises `InputError` if an array is missing, or the shapes are not those that the env needs.

    Attributes:
        layers: Weight (h, n) and bias (h,) of each layer.
        activation: Of all layers but the last: `relu` or `tanh`.
        squash: Whether the output is bounded by tanh.
        mean: Of the observations: shape (n,), or None.
        scale: Of the observations: shape (n,), or None.
        actions: Map from outputs to actions of the env.
    """

    def __init__(
        self,
        weights: Mapping[str, np.ndarray],
        spec: EnvSpec,
        activation: str = "relu",
        *,
        squash: bool = False,
    ) -> None:
        self.spec, self.actions = spec, ActionMap(spec.action)
        self.activation, self.squash = activation, squash
        self._relu = activation == "relu"
        expect(activation in ("relu", "tanh"), "activation", "relu or tanh", activation)
        got = {name: array.shape for name, array in weights.items()}
        expected = _expected_shapes(got, flat_size(spec), self.actions, squash)
        reason = (
            "it was trained for other observations or actions; give the --vehicle and the --env "
            "options of its training"
        )
        right = got == expected and 0 not in sum(got.values(), ())
        expect(right, "policy", f"weights of shapes {expected}", f"{got}: {reason}")
        count = sum(name.startswith("layers.") for name in weights) // 2
        self.layers = [(weights[f"layers.{i}.weight"], weights[f"layers.{i}.bias"])
                       for i in range(count)]  # fmt: skip
        self.mean, self.scale = weights.get("observation.mean"), weights.get("observation.scale")
        self._sums = [(weight.T, bias[np.newaxis]) for weight, bias in self.layers]
        self._std = np.exp(weights["log_std"]) if "log_std" in weights else None

    def reset(self) -> None:
        """Nothing to forget."""

    def output(self, observations: np.ndarray) -> np.ndarray:
        """Means, or logits, shape (N, k), of flat observations, shape (N, n)."""
        values = observations
        if self.mean is not None:
            values = (values - self.mean) * self.scale
        for i, (weight, bias) in enumerate(self._sums):
            if i and self._relu:
                np.maximum(values, _ZERO, out=values)
            elif i:
                np.tanh(values, out=values)
            values = values.dot(weight)
            values += bias
        if self.squash:
            np.tanh(values, out=values)
        return values

    def act(self, observation: Any) -> Any:
        """The most likely action, inside the bounds of the env."""
        output = self.output(flat(observation, self.spec, 1))
        if isinstance(self.spec.action, Discrete):
            return int(output.argmax())
        return self.actions.to_envs(output).reshape(self.spec.action.shape)

    def draw_noise(self, rng: np.random.Generator, steps: int) -> np.ndarray:
        """Randomness for so many rows of `sample`, drawn at once: shape (steps, k)."""
        shape = steps, self.actions.outputs
        if self._std is None:
            # The Gumbel trick: the largest of logits plus Gumbel noise is a categorical draw.
            return rng.gumbel(size=shape).astype(np.float32)
        noise = rng.standard_normal(shape, dtype=np.float32)
        noise *= self._std
        return noise

    def sample(self, observations: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Actions drawn from the policy, float32, shape (N, k), not clipped.

        Shape (N, 1), holding whole numbers, if they are discrete. Observations are flat, shape
        (N, n); noise is N rows of `draw_noise`.
        """
        output = self.output(observations)
        output += noise
        if self._std is None:
            output = output.argmax(axis=1)[:, np.newaxis].astype(np.float32)
        return output
