"""Convolutions over images and rings: which array needs them follows from the axes of its spec.

An image has the axes `row` and `column`, and a picture `channel` too; beyond its edges it goes on
as at the edge. A lidar has `ring` and `azimuth`: each ring is a channel, and the azimuths close a
circle.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..envs.spec import IMAGE, PICTURE, RINGS, ArraySpec
from .layers import Affine, Chain, Floats, Layer, sized

Places = NDArray[np.int64]


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
    circle = array.axes == RINGS
    channels = array.shape[0] if circle else math.prod(array.shape[2:])
    sizes = array.shape[1:] if circle else array.shape[:2]
    # Steps from channel to channel, and from place to place.
    apart, step = (math.prod(sizes), 1) if circle else (1, channels)
    layers: list[Layer] = []
    for count in filters:
        windows = step * _windows(sizes, circle)
        starts = first + apart * np.arange(channels)
        places = starts[:, None, None] + windows
        layers += [Convolution(inputs, places.reshape(-1, windows.shape[1]), count), activation()]
        sizes = tuple(-(-size // 2) for size in sizes)
        apart, step = math.prod(sizes), 1
        first = 0
        channels = count
        inputs = count * math.prod(sizes)
    return layers, inputs


def _windows(sizes: Sequence[int], circle: bool) -> Places:
    """Places of a channel in each window, shape (3 or 9, windows); a row has none twice."""
    found = np.zeros((1, 1), np.int64)
    for size in sizes:
        places = np.arange(0, size, 2) + np.array([[-1], [0], [1]])
        places = places % size if circle else places.clip(0, size - 1)
        sums = found[:, None, :, None] * size + places[None, :, None, :]
        found = sums.reshape(len(found) * 3, -1)
    return found


def slices(sizes: Sequence[int]) -> list[slice]:
    """Parts of such sizes, one after the other."""
    ends = np.cumsum(sizes).tolist()
    return [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]


def is_grid(array: ArraySpec) -> bool:
    """Whether convolutions can read an array."""
    return array.axes in (IMAGE, PICTURE, RINGS)
