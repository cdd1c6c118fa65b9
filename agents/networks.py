"""Networks in NumPy, with gradients by hand: the paper's, section 2.3, of any depth; and Adam.

A minibatch of a net of 16 units takes a fifth of its time in torch, and nothing is imported.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

__all__ = ["MLP", "Actor", "Adam", "Weights", "clip_norm", "mlp_shapes", "orthogonal"]

_ZERO: Final = np.zeros(1, np.float32)
_LOG_STD: Final = np.array([-4.0, 1.0], np.float32)
"""Least and greatest logarithm of a standard deviation."""


@dataclass(frozen=True)
class Weights:
    """Arrays by name and their gradients, all of them views of two flat arrays.

    So Adam, the norm of a gradient and a copy are one call for all networks of an agent.
    """

    shapes: Mapping[str, tuple[int, ...]]
    """Of every array, in the order of the flat array."""
    values: np.ndarray
    """float32, shape (P,)."""
    slopes: np.ndarray
    """Derivatives of the loss by `values`: float32, shape (P,)."""

    @classmethod
    def zeros(cls, shapes: Mapping[str, tuple[int, ...]]) -> "Weights":
        """Arrays of these shapes."""
        size = sum(map(math.prod, shapes.values()))
        return cls(shapes, np.zeros(size, np.float32), np.zeros(size, np.float32))

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The weights by name: views."""
        return self._views(self.values)

    @property
    def gradients(self) -> dict[str, np.ndarray]:
        """Their gradients by name: views."""
        return self._views(self.slopes)

    def part(self, prefix: str) -> "Weights":
        """Those whose names begin so, which are neighbours, without that prefix."""
        names = [name for name in self.shapes if name.startswith(prefix)]
        sizes = [math.prod(shape) for shape in self.shapes.values()]
        first = sum(sizes[: list(self.shapes).index(names[0])])
        shapes = {name.removeprefix(prefix): self.shapes[name] for name in names}
        some = slice(first, first + sum(map(math.prod, shapes.values())))
        return Weights(shapes, self.values[some], self.slopes[some])

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over arrays by name. Raises `ValueError` unless they are all, in their shapes."""
        got = {name: array.shape for name, array in arrays.items()}
        if got != self.shapes:
            raise ValueError(f"expected arrays of shapes {dict(self.shapes)}, got {got}")
        for name, array in self.arrays.items():
            array[...] = arrays[name]

    def _views(self, flat: np.ndarray) -> dict[str, np.ndarray]:
        views, first = {}, 0
        for name, shape in self.shapes.items():
            last = first + math.prod(shape)
            views[name], first = flat[first:last].reshape(shape), last
        return views


def mlp_shapes(sizes: Sequence[int]) -> dict[str, tuple[int, ...]]:
    """Of the arrays of an MLP, from the numbers of inputs, of units of each layer, of outputs."""
    return {
        name: shape
        for i, (inputs, outputs) in enumerate(pairwise(sizes))
        for name, shape in (
            (f"layers.{i}.weight", (outputs, inputs)),
            (f"layers.{i}.bias", (outputs,)),
        )
    }


def orthogonal(rng: np.random.Generator, shape: tuple[int, ...], gain: float) -> np.ndarray:
    """Rows, or columns if they are fewer, that are orthogonal and of the length `gain`."""
    rows, columns = shape
    q, r = np.linalg.qr(rng.standard_normal((max(shape), min(shape))))
    q *= np.where(np.diag(r) < 0, -1.0, 1.0)  # else the draw would not be uniform
    return gain * (q if rows >= columns else q.T)


class MLP:
    """Layers of `relu` or `tanh` units and one of plain sums, from the arrays of `mlp_shapes`."""

    def __init__(self, weights: Weights, activation: str = "relu") -> None:
        self.weights = weights
        arrays, slopes = list(weights.arrays.values()), list(weights.gradients.values())
        self._layers = [
            (weight, bias[np.newaxis], by_weight, by_bias)
            for weight, bias, by_weight, by_bias in zip(
                arrays[::2], arrays[1::2], slopes[::2], slopes[1::2], strict=True
            )
        ]
        self._relu = activation == "relu"
        self._seen: list[np.ndarray] = []
        self._ones = np.ones(0, np.float32)

    def initialise(self, rng: np.random.Generator, gain: float) -> None:
        """Orthogonal weights, of the gain sqrt(2) but for the last layer; biases of 0."""
        for layer in self._layers:
            last = gain if layer is self._layers[-1] else math.sqrt(2)
            layer[0][...], layer[1][...] = orthogonal(rng, layer[0].shape, last), 0.0

    def forward(self, inputs: np.ndarray) -> np.ndarray:
        """Outputs, shape (B, k), of inputs (B, n): float32."""
        self._seen = [inputs]
        for weight, bias, *_ in self._layers:
            inputs = inputs.dot(weight.T)
            inputs += bias
            if len(self._seen) < len(self._layers):
                np.maximum(inputs, _ZERO, out=inputs) if self._relu else np.tanh(inputs, out=inputs)
                self._seen.append(inputs)
        return inputs

    def backward(self, slope: np.ndarray, *, by_inputs: bool = False) -> np.ndarray:
        """Set the gradients of a loss, from its derivatives by the last outputs, shape (B, k).

        With `by_inputs` it leaves them, and returns the derivatives by the inputs, shape (B, n).
        """
        if len(self._ones) != len(slope):
            self._ones = np.ones(len(slope), np.float32)
        for i in range(len(self._layers) - 1, -1, -1):
            (weight, _, by_weight, by_bias), seen = self._layers[i], self._seen[i]
            if not by_inputs:
                np.dot(slope.T, seen, out=by_weight)
                np.dot(self._ones, slope, out=by_bias)
            if i or by_inputs:
                slope = slope.dot(weight)
            if i:
                slope *= seen > 0 if self._relu else 1 - seen * seen
        return slope


class Actor:
    """Policy: Gaussian for continuous actions, categorical for discrete ones.

    The Gaussian's standard deviation does not depend on the state. The arrays are those of an MLP
    and, of a Gaussian, `log_std`, the logarithm of that deviation, shape (k,).
    """

    def __init__(self, weights: Weights, activation: str = "relu") -> None:
        self.weights = weights
        self.net = MLP(weights.part("layers."), activation)
        self.log_std = weights.arrays.get("log_std")
        self._by_log_std: Any = weights.gradients.get("log_std")
        self._kept: Any = None  # of `score`, for `backward`

    def initialise(self, rng: np.random.Generator, log_std: float) -> None:
        """Last layer near zero: the first policy gives the middle of the action space."""
        self.net.initialise(rng, 0.01)
        if self.log_std is not None:
            self.log_std[...] = log_std

    def score(self, observations: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, float]:
        """Log-probabilities, shape (B,), and mean entropy of actions (B, k), or (B, 1) if discrete.

        Observations have the shape (B, n).
        """
        output = self.net.forward(observations)
        if self.log_std is None:
            output -= output.max(axis=1, keepdims=True)
            shares = np.exp(output)
            total = shares.sum(axis=1, keepdims=True)
            output -= np.log(total)
            shares /= total
            entropy = -(shares * output).sum(axis=1, keepdims=True)
            chosen = np.arange(len(output)), actions[:, 0].astype(int)
            self._kept = output, shares, entropy, chosen
            return output[chosen], float(entropy.mean())
        inverse = np.exp(-self.log_std)
        noise = (actions - output) * inverse
        squares = noise * noise
        self._kept = inverse, noise, squares
        deviation, size = float(self.log_std.sum()), self.log_std.size
        constant = 0.5 * size * math.log(2 * math.pi) + deviation
        halves = np.full(size, -0.5, np.float32)
        return squares.dot(halves) - constant, constant + 0.5 * size

    def backward(self, by_log_probability: np.ndarray, by_entropy: float = 0.0) -> None:
        """Set the gradients of a loss, from its derivatives by what `score` gave last."""
        column = by_log_probability[:, np.newaxis]
        if self.log_std is None:
            logs, shares, entropy, chosen = self._kept
            slope = -column * shares
            slope[chosen] += by_log_probability
            slope -= by_entropy / len(slope) * shares * (logs + entropy)
        else:
            inverse, noise, squares = self._kept
            slope = column * (noise * inverse)
            self._by_log_std[...] = by_log_probability.dot(squares - 1) + by_entropy
        self.net.backward(slope)

    def clamp(self) -> None:
        """Keep the standard deviation between e^-4 and e."""
        if self.log_std is not None:
            np.clip(self.log_std, *_LOG_STD, out=self.log_std)


class Adam:
    """Kingma and Ba 2015, Algorithm 1, with their constants and torch's order of operations."""

    def __init__(self, weights: Weights) -> None:
        self._weights = weights
        self.first, self.second = np.zeros_like(weights.values), np.zeros_like(weights.values)
        self.steps = 0

    def step(self, rate: float | np.ndarray) -> None:
        """Move the weights against their gradients; rates may differ, float32, shape (P,)."""
        self.steps += 1
        slopes = self._weights.slopes
        self.first += 0.1 * (slopes - self.first)
        self.second *= 0.999
        self.second += (0.001 * slopes) * slopes
        scale = np.sqrt(self.second)
        scale /= math.sqrt(1 - 0.999**self.steps)
        scale += 1e-8
        np.divide(self.first, scale, out=scale)
        scale *= rate / (1 - 0.9**self.steps)
        self._weights.values[...] -= scale

    def arrays(self) -> dict[str, np.ndarray]:
        """Its state."""
        return {"first": self.first.copy(), "second": self.second.copy(),
                "steps": np.array(self.steps)}  # fmt: skip

    def load(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` unless it is whole."""
        got = {name: array.shape for name, array in arrays.items()}
        expected = {"first": self.first.shape, "second": self.second.shape, "steps": ()}
        if got != expected:
            raise ValueError(f"optimizer: expected arrays of shapes {expected}, got {got}")
        steps = int(arrays["steps"])
        if steps < 0 or arrays["second"].min(initial=0.0) < 0:
            raise ValueError(f"optimizer: expected no negative steps or squares, got {steps} steps")
        self.first[...], self.second[...], self.steps = arrays["first"], arrays["second"], steps


def clip_norm(slopes: np.ndarray, most: float) -> float:
    """Scale a gradient down to a norm of at most so much; the norm that it had."""
    norm = math.sqrt(float(slopes.dot(slopes)))
    if norm > most:
        slopes *= most / norm
    return norm
