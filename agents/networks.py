"""Kinds of networks: what they are built of, from the arrays that they see.

Plain arrays enter as they are. A network with a memory carries a state from row to row.
"""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ..envs.spec import ArraySpec, component_units
from ..models.errors import InputError
from .config import Config
from .convolutions import Encoder, is_grid, slices
from .layers import BRIGHTEST, Affine, Chain, Floats, Layer, Relu, Scaling, Tanh, sized
from .memory import GRU, Sequences

_ACTIVATIONS: dict[str, type[Layer]] = {"relu": Relu, "tanh": Tanh}


class Network(Chain):
    """Layers in a row, from inputs (..., n, B) to outputs (..., k, B): an MLP (paper, section 2.3).

    Distances and pictures are scaled; then come the encoder and the memory, if it has them.
    `learn` may be called once after a `forward`: it overwrites the slope and what that returned.
    Another kind overrides `build`.

    Attributes:
        inputs: Numbers that it sees, n.
        memory: The layer that remembers, if there is one.
    """

    convolves: ClassVar[bool] = False
    """Whether images and rings go through convolutions."""

    def __init__(self, arrays: Sequence[ArraySpec], outputs: int, config: Config) -> None:
        """The inputs are these arrays, one after the other."""
        self.inputs = inputs = sum(array.size for array in arrays)
        layers: list[Layer] = []
        scaled = scaled_in(arrays)
        lengths = lengths_in(arrays) if config.reach else []
        if any(scaled) or lengths:
            layers.append(Scaling(*scaled, lengths, config.reach))
        if self.convolves:
            if not any(map(is_grid, arrays)):
                names = ", ".join(array.name for array in arrays)
                raise InputError(
                    f"network: expected rays in rows or rings, or pictures, for cnn, got {names}"
                )
            encoder = Encoder(arrays, config.filters, _ACTIVATIONS[config.activation])
            inputs = encoder.outputs
            layers.append(encoder)
        self.memory = GRU(inputs, config.memory) if config.memory else None
        if self.memory:
            inputs = config.memory
            layers.append(self.memory)
        super().__init__([*layers, *self.build(inputs, outputs, config)])
        self._inputs = np.ones(0, np.float32)

    def build(self, inputs: int, outputs: int, config: Config) -> Sequence[Layer]:
        """The last layers, which allocate nothing yet: `relu` or `tanh` units (paper: one layer of
        16 `relu`), and linear outputs.
        """
        layers: list[Layer] = []
        activation = _ACTIVATIONS[config.activation]
        for units in config.hidden:
            layers += [Affine(inputs, units), activation()]
            inputs = units
        return [*layers, Affine(inputs, outputs)]

    def forward(self, inputs: Floats, sequences: Sequences | None = None) -> Floats:
        """The outputs; the inputs stay as they are. Of more than n, it sees the first.

        With a memory the B rows are those of `sequences`, one time after the other. Without these
        they are the next rows of B sequences that the memory itself follows.
        """
        *lead, _, count = inputs.shape
        self._inputs = sized(self._inputs, *lead, 1 + self.inputs, count)
        self._inputs[..., 1:, :] = inputs[..., : self.inputs, :]
        if self.memory:
            self.memory.sequences = sequences
        return super().forward(self._inputs)[..., 1:, :]


class CNN(Network):
    """An MLP behind convolutions over images and rings."""

    convolves = True


NETWORKS: dict[str, type[Network]] = {"mlp": Network, "cnn": CNN}
"""Kinds of networks by the name in a config. A kind of your own is a new entry."""


def make_network(arrays: Sequence[ArraySpec], outputs: int, config: Config) -> Network:
    """A network of the kind that a config names. Raises `InputError` for an unknown one."""
    if config.network not in NETWORKS:
        raise InputError(
            f"network: expected one of {', '.join(NETWORKS)}, got {config.network!r}; import the "
            "module that registers it first"
        )
    return NETWORKS[config.network](arrays, outputs, config)


def scaled_in(arrays: Sequence[ArraySpec]) -> tuple[list[slice], list[slice]]:
    """Where arrays, one after the other, have what networks see scaled: distances along rays (two
    axes or more, m, from 0 on), and bytes of pictures.
    """
    distances = []
    pictures = []
    for array, place in zip(arrays, slices([array.size for array in arrays]), strict=True):
        if array.unit == "m" and len(array.shape) > 1 and array.low == 0.0:
            distances.append(place)
        elif array.dtype == "uint8" and array.high == BRIGHTEST:
            pictures.append(place)
    return distances, pictures


def lengths_in(arrays: Sequence[ArraySpec]) -> list[slice]:
    """Where arrays, one after the other, have numbers in m that may be below 0."""
    units: list[bool] = []
    for array in arrays:
        low = np.broadcast_to(array.bounds()[0], array.shape).ravel()
        own = zip(component_units(array), low, strict=True)
        units += [unit == "m" and least < 0 for unit, least in own]
    ends = np.flatnonzero(np.diff([False, *units, False])).tolist()
    return [slice(*pair) for pair in zip(ends[::2], ends[1::2], strict=True)]
