"""Networks in NumPy: a sequence of layers with gradients by hand, and the kinds of networks.

Small networks are faster here than in torch, and torch is not imported.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError
from .config import Config

Floats = NDArray[np.float32]
ByName = dict[str, np.ndarray]
Shapes = Mapping[str, tuple[int, ...]]
Item = TypeVar("Item")


def named(prefix: str, items: Mapping[str, Item]) -> dict[str, Item]:
    """The same with a prefix to every name."""
    return {prefix + name: item for name, item in items.items()}


def part_of(items: Mapping[str, Item], prefix: str) -> dict[str, Item]:
    """The items with names that begin so, without this prefix."""
    return {k.removeprefix(prefix): item for k, item in items.items() if k.startswith(prefix)}


@dataclass(frozen=True)
class Weights:
    """Arrays by name and their gradients, all of them views of two flat arrays.

    So Adam, the norm of a gradient and a copy are one call for all networks of an agent.
    """

    shapes: Shapes
    """Of every array, in the order of the flat array."""
    values: Floats
    """Shape (P,)."""
    slopes: Floats
    """Derivatives of the loss by `values`, shape (P,)."""

    @classmethod
    def zeros(cls, shapes: Shapes) -> "Weights":
        """Arrays of these shapes."""
        size = sum(map(math.prod, shapes.values()))
        return cls(shapes, np.zeros(size, np.float32), np.zeros(size, np.float32))

    @property
    def arrays(self) -> dict[str, Floats]:
        """The weights by name: views."""
        return self._views(self.values)

    @property
    def gradients(self) -> dict[str, Floats]:
        """Their gradients by name: views."""
        return self._views(self.slopes)

    def part(self, prefix: str) -> "Weights":
        """The arrays with names that begin so, which are neighbours, without this prefix."""
        spans = list(part_of(self._spans(), prefix).values())
        some = slice(spans[0].start, spans[-1].stop)
        return Weights(part_of(self.shapes, prefix), self.values[some], self.slopes[some])

    def _spans(self) -> dict[str, slice]:
        spans = {}
        first = 0
        for name, shape in self.shapes.items():
            last = first + math.prod(shape)
            spans[name] = slice(first, last)
            first = last
        return spans

    def _views(self, flat: Floats) -> dict[str, Floats]:
        return {name: flat[span].reshape(self.shapes[name]) for name, span in self._spans().items()}


class Module:
    """What computes with weights.

    Attributes:
        shapes: Of its weights, by name.
    """

    shapes: Shapes = MappingProxyType({})

    def bind(self, weights: Weights) -> None:
        """Compute with these arrays from now on; they have the shapes of `shapes`."""


class Layer(Module):
    """A step of a network, from inputs (B, n) to outputs (B, k)."""

    def initialise(self, rng: np.random.Generator, gain: float) -> None:
        """Draw the weights."""

    @abstractmethod
    def forward(self, inputs: Floats) -> Floats:
        """The outputs. Keeps what the derivatives need."""

    def learn(self, slope: Floats) -> None:
        """Set the gradients of a loss, from its derivatives by the last outputs."""

    @abstractmethod
    def back(self, slope: Floats) -> Floats:
        """Derivatives by the last inputs, from those by the outputs, which it may overwrite.

        It is called after `learn`, which may not.
        """


class Affine(Layer):
    """Sums of the inputs by weights, and a bias. The weights are orthogonal at the beginning."""

    def __init__(self, inputs: int, outputs: int) -> None:
        self.shapes = {"weight": (outputs, inputs), "bias": (outputs,)}

    def bind(self, weights: Weights) -> None:
        arrays = weights.arrays
        slopes = weights.gradients
        self.weight = arrays["weight"]
        self.bias = arrays["bias"][np.newaxis]
        self._by_weight = slopes["weight"]
        self._by_bias = slopes["bias"]

    def initialise(self, rng: np.random.Generator, gain: float) -> None:
        self.weight[...] = orthogonal(rng, self.weight.shape, gain)
        self.bias[...] = 0.0

    def forward(self, inputs: Floats) -> Floats:
        self._inputs = inputs
        outputs: Floats = inputs.dot(self.weight.T)
        outputs += self.bias
        return outputs

    def learn(self, slope: Floats) -> None:
        ones = np.ones(len(slope), np.float32)
        np.dot(slope.T, self._inputs, out=self._by_weight)
        np.dot(ones, slope, out=self._by_bias)

    def back(self, slope: Floats) -> Floats:
        by_inputs: Floats = slope.dot(self.weight)
        return by_inputs


class Relu(Layer):
    """max(x, 0)."""

    def forward(self, inputs: Floats) -> Floats:
        self._outputs = np.maximum(inputs, np.float32(0.0))
        return self._outputs

    def back(self, slope: Floats) -> Floats:
        slope *= self._outputs > 0
        return slope


class Tanh(Layer):
    """The hyperbolic tangent."""

    def forward(self, inputs: Floats) -> Floats:
        self._outputs: Floats = np.tanh(inputs)
        return self._outputs

    def back(self, slope: Floats) -> Floats:
        slope *= 1 - self._outputs * self._outputs
        return slope


def shapes_of(modules: Mapping[str, Module]) -> Shapes:
    """Shapes of the weights of modules, each with a prefix to its names."""
    shapes: dict[str, tuple[int, ...]] = {}
    for prefix, module in modules.items():
        shapes |= named(prefix, module.shapes)
    return shapes


def bind_parts(modules: Mapping[str, Module], weights: Weights) -> None:
    """Let each module compute with the weights of its prefix."""
    for prefix, module in modules.items():
        module.bind(weights.part(prefix))


class Network(Module):
    """Layers in a row, from inputs (B, n) to outputs (B, k). Subclasses build them.

    Attributes:
        layers: In the order of evaluation.
        shapes: Of all weights: `layers.0.weight` and so on, counted by layers that have weights.
    """

    def __init__(self, inputs: int, outputs: int, config: Config) -> None:
        self.layers = list(self.build(inputs, outputs, config))
        with_weights = [layer for layer in self.layers if layer.shapes]
        self._named = {f"layers.{i}.": layer for i, layer in enumerate(with_weights)}
        self.shapes = shapes_of(self._named)

    @abstractmethod
    def build(self, inputs: int, outputs: int, config: Config) -> Sequence[Layer]:
        """The layers, which allocate nothing yet."""

    def bind(self, weights: Weights) -> None:
        bind_parts(self._named, weights)

    def initialise(self, rng: np.random.Generator, gain: float) -> None:
        """Draw the weights, with the gain sqrt(2) but for the last layer that has weights."""
        *others, last = self._named.values()
        for layer in others:
            layer.initialise(rng, math.sqrt(2))
        last.initialise(rng, gain)

    def forward(self, inputs: Floats) -> Floats:
        """The outputs; the inputs stay as they are."""
        for layer in self.layers:
            inputs = layer.forward(inputs)
        return inputs

    def backward(self, slope: np.ndarray) -> None:
        """Set the gradients of a loss, from its derivatives by the last outputs, shape (B, k)."""
        first = self.layers[0]
        for layer in reversed(self.layers):
            layer.learn(slope)
            if layer is not first:
                slope = layer.back(slope)


_ACTIVATIONS: Final = {"relu": Relu, "tanh": Tanh}


class MLP(Network):
    """Layers of `relu` or `tanh` units (paper, section 2.3: one of 16) and a linear one."""

    def build(self, inputs: int, outputs: int, config: Config) -> Sequence[Layer]:
        layers: list[Layer] = []
        activation = _ACTIVATIONS[config.activation]
        for units in config.hidden:
            layers += [Affine(inputs, units), activation()]
            inputs = units
        return [*layers, Affine(inputs, outputs)]


NETWORKS: Final[dict[str, type[Network]]] = {"mlp": MLP}
"""Kinds of networks by the name in a config. A kind of your own is a new entry."""


def make_network(inputs: int, outputs: int, config: Config) -> Network:
    """A network of the kind that a config names. Raises `InputError` for an unknown one."""
    if config.network not in NETWORKS:
        raise InputError(
            f"network: expected one of {', '.join(NETWORKS)}, got {config.network!r}; import the "
            "module that registers it first"
        )
    return NETWORKS[config.network](inputs, outputs, config)


def orthogonal(
    rng: np.random.Generator, shape: tuple[int, ...], gain: float
) -> NDArray[np.float64]:
    """Rows, or columns if they are fewer, that are orthogonal and of the length `gain`."""
    rows, columns = shape
    q, r = np.linalg.qr(rng.standard_normal((max(shape), min(shape))))
    q *= np.where(np.diag(r) < 0, -1.0, 1.0)  # else the draw would not be uniform
    return gain * (q if rows >= columns else q.T)
