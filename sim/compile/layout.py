"""Arrays of many worlds in one piece of memory, so that a vector instruction reads neighbours.

Worlds lie in blocks of lanes. A block holds row after row: a component of an array for its lanes.
"""

from collections.abc import Mapping

import numpy as np

from .program import DType

LINE = 64  # bytes of the cache, and of the widest vector of AVX-512

Fields = Mapping[str, tuple[DType, tuple[int, ...]]]
"""Dtype and shape of arrays for one world, by name."""


def fields_of(arrays: Mapping[str, np.ndarray]) -> dict[str, tuple[DType, tuple[int, ...]]]:
    """Those of arrays of one world, shape (1, ...)."""
    return {name: (array.dtype, array.shape[1:]) for name, array in arrays.items()}


class Layout:
    """Where each array lies within a block of so many lanes.

    Attributes:
        offsets: Of each array, in bytes.
        size: Of a block, in bytes.
    """

    def __init__(self, fields: Fields, lanes: int) -> None:
        self.fields = fields
        self.lanes = lanes
        self.offsets: dict[str, int] = {}
        self._strides: dict[str, tuple[int, ...]] = {}  # of lanes and rows
        self.size = 0
        for name, (dtype, shape) in fields.items():
            self.offsets[name] = self.size
            strides: list[int] = []
            step = dtype.itemsize * lanes
            for length in reversed(shape):
                strides.insert(0, step)
                step *= length
            self._strides[name] = (dtype.itemsize, *strides)
            self.size += -(-step // LINE) * LINE

    def place(self, name: str, row: int) -> int:
        """Where a row of an array begins, in bytes."""
        return self.offsets[name] + row * self.lanes * self.fields[name][0].itemsize

    def view(self, name: str, content: np.ndarray, blocks: int) -> np.ndarray:
        """An array within the bytes of some blocks, shape (blocks, lanes, *shape)."""
        dtype, shape = self.fields[name]
        whole = (blocks, self.lanes, *shape)
        steps = (self.size, *self._strides[name])
        return np.ndarray(whole, dtype, content, self.offsets[name], steps)

    def read(self, name: str, content: np.ndarray, worlds: int) -> np.ndarray:
        """A copy of an array within the bytes of the blocks of W worlds, shape (W, *shape)."""
        view = self.view(name, content, -(-worlds // self.lanes))
        return view.copy().reshape(-1, *view.shape[2:])[:worlds]


class Memory:
    """The arrays of a layout for W worlds; the last block is filled up with worlds nobody sees.

    Attributes:
        address: What code gets.
        blocks: How many.
        size: Worlds of all blocks.
    """

    def __init__(self, layout: Layout, worlds: int) -> None:
        """All is 0."""
        self._layout = layout
        self._worlds = worlds
        self.blocks = -(-worlds // layout.lanes)
        self.size = self.blocks * layout.lanes
        raw = np.zeros(self.blocks * layout.size + LINE, np.uint8)
        first = raw.ctypes.data
        start = -first % LINE
        self._content = raw[start:]
        self.address = first + start

    def copy(self) -> "Memory":
        """Another one of the same content."""
        copy = Memory(self._layout, self._worlds)
        size = self.blocks * self._layout.size
        copy._content[:size] = self._content[:size]
        return copy

    def get(self, name: str) -> np.ndarray:
        """A copy of an array, shape (W, *shape)."""
        return self._layout.read(name, self._content, self._worlds)

    def put(self, name: str, values: np.ndarray) -> None:
        """Set an array from one of shape (W, *shape), or of as many numbers."""
        view = self._layout.view(name, self._content, self.blocks)
        values = values.reshape(self._worlds, *view.shape[2:])
        lanes = self._layout.lanes
        whole = self._worlds // lanes
        if whole:
            view[:whole] = values[: whole * lanes].reshape(whole, lanes, *view.shape[2:])
        if whole < self.blocks:
            view[whole, : self._worlds - whole * lanes] = values[whole * lanes :]
