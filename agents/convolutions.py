"""Convolutions over images and rings: which array needs them follows from the axes of its spec.

An image has the axes `row` and `column`, and a picture `channel` too; beyond its edges it goes on
as at the edge. A lidar has `ring` and `azimuth`: each ring is a channel, and the azimuths close a
circle.
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..envs.spec import IMAGE, PICTURE, RINGS, ArraySpec
from .layers import Affine, Chain, Floats, Layer, sized

Places = NDArray[np.int64]
Beyond = Literal["edge", "wrap"]
"""How an array goes on beyond its ends."""


class Convolution(Affine):
    """Sums over windows of the inputs. Outputs are filter by filter, each in the order of windows.

    Attributes:
        places: Numbers of the inputs: a row for each weight, that of the bias first, and a column
            for each window.
    """

    def __init__(self, inputs: int, windows: Places, filters: int) -> None:
        """Windows have the numbers of their inputs, counted from 0: a column for each."""
        super().__init__(len(windows), filters)
        self.inputs = inputs
        self.places = np.concatenate((0 * windows[:1], 1 + windows))
        self._patches = np.ones(0, np.float32)

    def forward(self, inputs: Floats) -> Floats:
        *lead, _, count = inputs.shape
        rows, size = self.places.shape
        self._patches = sized(self._patches, *lead, rows, size, count)
        inputs.take(self.places, axis=-2, out=self._patches, mode="clip")
        self._inputs = self._patches.reshape(*lead, rows, -1)
        *lead, filters, _ = self.weight.shape
        self._outputs = sized(self._outputs, *lead, 1 + filters * size, count)
        np.matmul(self.weight, self._inputs, out=self._by_filter(self._outputs[..., 1:, :]))
        return self._outputs

    def learn(self, slope: Floats) -> None:
        super().learn(self._by_filter(slope))

    def back(self, slope: Floats) -> Floats:
        by_patches = self._transposed @ self._by_filter(slope)
        *lead, rows, _ = by_patches.shape
        count = slope.shape[-1]
        parts = by_patches.reshape(*lead, rows, -1, count)
        by_inputs = np.zeros((*lead, self.inputs, count), np.float32)
        for row, places in enumerate(self.places[1:]):
            by_inputs[..., places - 1, :] += parts[..., row, :, :]
        return by_inputs

    def _by_filter(self, outputs: Floats) -> Floats:
        *lead, filters, _ = self.weight.shape
        return outputs.reshape(*lead, filters, -1)


class Encoder(Chain):
    """Convolutions over the images and rings among some arrays; plain arrays pass.

    Attributes:
        chains: Layers of each array; none of a plain one.
        taken: Where each array is among the inputs, without the row of ones.
        given: Where what becomes of it is among the outputs.
        outputs: How many there are.
    """

    def __init__(
        self, arrays: Sequence[ArraySpec], filters: Sequence[int], activation: type[Layer]
    ) -> None:
        sizes = [array.size for array in arrays]
        self.taken = slices(sizes)
        self.inputs = sum(sizes)
        self.chains = []
        for number, array in enumerate(arrays):
            layers: list[Layer] = []
            if is_grid(array):
                first = self.taken[number].start
                found = convolutions(array, first, self.inputs, filters, activation)
                layers, sizes[number] = found
            self.chains.append(Chain(layers))
        super().__init__(self.chains)
        self.given = slices(sizes)
        self.outputs = sum(sizes)
        self._outputs = np.ones(0, np.float32)

    def forward(self, inputs: Floats) -> Floats:
        parts = []
        for chain, taken in zip(self.chains, self.taken, strict=True):
            part = chain.forward(inputs)[..., 1:, :]
            parts.append(part if chain.layers else part[..., taken, :])
        *lead, _, count = max((part.shape for part in parts), key=len)
        self._outputs = sized(self._outputs, *lead, 1 + self.outputs, count)
        for part, given in zip(parts, self.given, strict=True):
            self._outputs[..., 1:, :][..., given, :] = part
        return self._outputs

    def learn(self, slope: Floats) -> None:
        for chain, given in zip(self.chains, self.given, strict=True):
            if chain.layers:
                chain.learn(slope[..., given, :])

    def back(self, slope: Floats) -> Floats:
        *lead, _, count = slope.shape
        by_inputs = np.zeros((*lead, self.inputs, count), np.float32)
        for chain, taken, given in zip(self.chains, self.taken, self.given, strict=True):
            part = slope[..., given, :]
            if chain.layers:
                by_inputs += chain.back(part)
            else:
                by_inputs[..., taken, :] += part
        return by_inputs


def convolutions(
    array: ArraySpec, first: int, inputs: int, filters: Sequence[int], activation: type[Layer]
) -> tuple[list[Layer], int]:
    """Layers for an image or rings, from the number `first` of the inputs on; how many they give.

    Windows have three places along each axis, around every second place.
    """
    numbers = first + np.arange(array.size).reshape(array.shape)
    beyond: Beyond = "wrap"
    if array.axes != RINGS:
        beyond = "edge"
        numbers = np.moveaxis(numbers.reshape(*array.shape[:2], -1), -1, 0)
    layers: list[Layer] = []
    for count in filters:
        layers += [Convolution(inputs, _windows(numbers, beyond), count), activation()]
        sizes = [-(-size // 2) for size in numbers.shape[1:]]
        inputs = count * math.prod(sizes)
        numbers = np.arange(inputs).reshape(count, *sizes)
    return layers, inputs


def _windows(numbers: Places, beyond: Beyond) -> Places:
    """The inputs of each window, shape (3 or 9 times channels, windows); a row has none twice.

    The inputs' numbers have shape (channels, ...), and go on as `beyond` says.
    """
    channels, *sizes = numbers.shape
    padded = np.pad(numbers, [(0, 0), *[(1, 1)] * len(sizes)], beyond)
    axes = tuple(range(1, numbers.ndim))
    neighbours = sliding_window_view(padded, sizes, axes)  # (channels, 3..., sizes)
    every_second = [slice(None)] * numbers.ndim + [slice(None, None, 2)] * len(sizes)
    windows: Places = neighbours[tuple(every_second)]
    return windows.reshape(channels * 3 ** len(sizes), -1)


def slices(sizes: Sequence[int]) -> list[slice]:
    """Parts of such sizes, one after the other."""
    ends = np.cumsum(sizes).tolist()
    return [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]


def is_grid(array: ArraySpec) -> bool:
    """Whether convolutions can read an array."""
    return array.axes in (IMAGE, PICTURE, RINGS)
