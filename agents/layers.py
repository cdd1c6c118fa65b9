"""Layers of networks in NumPy, with gradients by hand.

Small networks are faster here than in torch, and torch is not imported. Arrays are feature-major:
shape (..., n, B) for a batch of B. A leading axis counts networks of the same layers that compute
together, as an actor and its critic. Between layers a row of ones comes first, so that the first
column of the weights is the bias. Layers keep their arrays from batch to batch: what they return
holds until their next call.
"""

import math
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Parts = dict[str, Floats]
ByName = dict[str, np.ndarray]
Shapes = Mapping[str, tuple[int, ...]]
Item = TypeVar("Item")
BRIGHTEST = 255.0  # of a byte of a picture


def named(prefix: str, items: Mapping[str, Item]) -> dict[str, Item]:
    """The same with a prefix to every name."""
    return {prefix + name: item for name, item in items.items()}


def part_of(items: Mapping[str, Item], prefix: str) -> dict[str, Item]:
    """The items with names that begin so, without this prefix."""
    return {k.removeprefix(prefix): item for k, item in items.items() if k.startswith(prefix)}


def views(flat: Floats, shapes: Shapes) -> Parts:
    """Arrays by name, one after the other, in a flat array."""
    ends = np.cumsum([math.prod(shape) for shape in shapes.values()])[:-1]
    parts = np.split(flat, ends)
    named_parts = zip(shapes.items(), parts, strict=True)
    return {name: part.reshape(shape) for (name, shape), part in named_parts}


@dataclass(frozen=True)
class Weights:
    """Arrays by name and their gradients, all of them views of two flat arrays.

    So Adam, the norm of a gradient and a copy are one call for all networks of an agent.
    """

    values: Floats
    """Shape (P,)."""
    slopes: Floats
    """Derivatives of the loss by `values`, shape (P,)."""
    arrays: Parts
    gradients: Parts

    @classmethod
    def zeros(cls, shapes: Shapes) -> "Weights":
        """Arrays of these shapes."""
        size = sum(map(math.prod, shapes.values()))
        values, slopes = np.zeros((2, size), np.float32)
        return cls(values, slopes, views(values, shapes), views(slopes, shapes))

    def part(self, prefix: str) -> "Weights":
        """The arrays with names that begin so, without this prefix."""
        arrays = part_of(self.arrays, prefix)
        return replace(self, arrays=arrays, gradients=part_of(self.gradients, prefix))

    def of_one(self, number: int, shapes: Shapes) -> "Weights":
        """The arrays of one of the networks that compute together; it may be smaller."""

        def own(arrays: Parts) -> Parts:
            return {k: arrays[k][number][tuple(map(slice, shape))] for k, shape in shapes.items()}

        return replace(self, arrays=own(self.arrays), gradients=own(self.gradients))


def sized(array: Floats, *shape: int) -> Floats:
    """The array if it has this shape, or new ones."""
    return array if array.shape == shape else np.ones(shape, np.float32)


class Module:
    """What computes with weights.

    Attributes:
        shapes: Of its weights, by name.
    """

    shapes: Shapes = MappingProxyType({})

    def bind(self, weights: Weights) -> None:
        """Compute with these arrays from now on; they have the shapes of `shapes`."""


class Layer(Module):
    """A step of a network, from inputs (..., 1 + n, B) to outputs (..., 1 + k, B)."""

    def initialise(self, rng: Generator, gain: float) -> None:
        """Draw the weights."""

    @abstractmethod
    def forward(self, inputs: Floats) -> Floats:
        """The outputs. Keeps what the derivatives need."""

    def learn(self, slope: Floats) -> None:
        """Set the gradients of a loss, from its derivatives by the last outputs, (..., k, B)."""

    @abstractmethod
    def back(self, slope: Floats) -> Floats:
        """Derivatives by the last inputs, (..., n, B), from those by the outputs.

        It is called once, after `learn`, and may overwrite the slope and the outputs.
        """


class Affine(Layer):
    """Sums of the inputs by weights, which are orthogonal at the beginning.

    The first input is 1, and its weight the bias.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        self.shapes = {"weight": (outputs, 1 + inputs)}

    def bind(self, weights: Weights) -> None:
        self.weight = weights.arrays["weight"]
        self._by_weight = weights.gradients["weight"]
        self._transposed = self.weight[..., 1:].swapaxes(-1, -2)
        self._outputs = self._by_inputs = self.weight[..., :0]

    def initialise(self, rng: Generator, gain: float) -> None:
        units, inputs = self.weight.shape
        self.weight[:, 0] = 0.0
        self.weight[:, 1:] = orthogonal(rng, (units, inputs - 1), gain)

    def forward(self, inputs: Floats) -> Floats:
        self._inputs = inputs
        *lead, units, _ = self.weight.shape
        self._outputs = sized(self._outputs, *lead, 1 + units, inputs.shape[-1])
        np.matmul(self.weight, inputs, out=self._outputs[..., 1:, :])
        return self._outputs

    def learn(self, slope: Floats) -> None:
        np.matmul(slope, self._inputs.swapaxes(-1, -2), out=self._by_weight)

    def back(self, slope: Floats) -> Floats:
        *shape, _ = self._transposed.shape
        self._by_inputs = sized(self._by_inputs, *shape, slope.shape[-1])
        return np.matmul(self._transposed, slope, out=self._by_inputs)


class Relu(Layer):
    """max(x, 0), in the place of x."""

    def forward(self, inputs: Floats) -> Floats:
        self._outputs = inputs[..., 1:, :]
        np.maximum(self._outputs, 0.0, out=self._outputs)
        return inputs

    def back(self, slope: Floats) -> Floats:
        slope *= self._outputs > 0
        return slope


class Tanh(Layer):
    """The hyperbolic tangent, in the place of x."""

    def forward(self, inputs: Floats) -> Floats:
        self._outputs = inputs[..., 1:, :]
        np.tanh(self._outputs, out=self._outputs)
        return inputs

    def back(self, slope: Floats) -> Floats:
        outputs = self._outputs
        np.square(outputs, out=outputs)
        np.subtract(1.0, outputs, out=outputs)
        slope *= outputs
        return slope


class Chain(Layer):
    """Layers in a row.

    Attributes:
        layers: In the order of evaluation.
        shapes: Of all weights: `layers.0.weight` and so on, counted by layers that have weights.
    """

    def __init__(self, layers: Iterable[Layer]) -> None:
        self.layers = list(layers)
        with_weights = [layer for layer in self.layers if layer.shapes]
        self._named = {f"layers.{i}.": layer for i, layer in enumerate(with_weights)}
        shapes: dict[str, tuple[int, ...]] = {}
        for prefix, layer in self._named.items():
            shapes |= named(prefix, layer.shapes)
        self.shapes = shapes

    def bind(self, weights: Weights) -> None:
        for prefix, layer in self._named.items():
            layer.bind(weights.part(prefix))

    def initialise(self, rng: Generator, gain: float) -> None:
        """Draw the weights, with the gain sqrt(2) but for the last layer that has weights."""
        *others, last = self._named.values()
        for layer in others:
            layer.initialise(rng, math.sqrt(2))
        last.initialise(rng, gain)

    def forward(self, inputs: Floats) -> Floats:
        for layer in self.layers:
            inputs = layer.forward(inputs)
        return inputs

    def learn(self, slope: Floats) -> None:
        first = next(layer for layer in self.layers if layer.shapes)
        for layer in reversed(self.layers):
            layer.learn(slope)
            if layer is first:
                break
            slope = layer.back(slope)

    def back(self, slope: Floats) -> Floats:
        """See `Layer`. It may be called in place of `learn`, but not after it."""
        for layer in reversed(self.layers):
            slope = layer.back(slope)
        return slope


class Scaling(Layer):
    """Distances as nearness, bytes of pictures as 0 to 1, and lengths d as d / (1 + |d| / reach),
    or with a reach below 1 m as d / (reach + |d|), in their place; the others stay.

    A distance d >= 0 m is 2 / (1 + d / 2 m) - 1 / 2: what is near differs most. `distances`,
    `pictures` and `lengths` are slices of the inputs.

    Attributes:
        unit: Slope of a length at 0 is one over this: 1 m, or the reach if that is shorter.
    """

    def __init__(
        self,
        distances: Sequence[slice],
        pictures: Sequence[slice],
        lengths: Sequence[slice],
        reach: float | None,
    ) -> None:
        self.distances = distances
        self.pictures = pictures
        self.lengths = lengths if reach else ()
        self.reach = np.float32(reach or 1.0)
        self.unit = np.minimum(self.reach, np.float32(1.0))

    def forward(self, inputs: Floats) -> Floats:
        self._seen = seen = inputs[..., 1:, :]
        for place in self.distances:
            values = seen[..., place, :]
            np.maximum(values, 0.0, out=values)
            values *= 0.5
            values += 1.0
            np.divide(2.0, values, out=values)
            values -= 0.5
        for place in self.pictures:
            seen[..., place, :] /= BRIGHTEST
        self._factors = []
        for place in self.lengths:
            values = seen[..., place, :]
            factors = 1.0 / (1.0 + np.abs(values) / self.reach)
            values *= factors / self.unit
            self._factors.append(factors)
        return inputs

    def back(self, slope: Floats) -> Floats:
        for place in self.distances:
            values = self._seen[..., place, :] + 0.5
            slope[..., place, :] *= -0.25 * values * values
        for place in self.pictures:
            slope[..., place, :] /= BRIGHTEST
        for place, factors in zip(self.lengths, self._factors, strict=True):
            slope[..., place, :] *= factors * factors / self.unit
        return slope


def orthogonal(rng: Generator, shape: tuple[int, ...], gain: float) -> NDArray[np.float64]:
    """Rows, or columns if they are fewer, that are orthogonal and of the length `gain`."""
    rows, columns = shape
    q, r = np.linalg.qr(rng.standard_normal((max(shape), min(shape))))
    q *= np.where(np.diag(r) < 0, -1.0, 1.0)  # else the draw would not be uniform
    return gain * (q if rows >= columns else q.T)
