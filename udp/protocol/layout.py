"""Where each array of a State and of a Command lies, known from Hello on.

The tables of State and Command in `docs/protocol.md` say it in words: every array begins at a
multiple of 8 bytes, and the size of a message is exactly where its last array ends.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from ...models.errors import InputError
from ...models.fields import Limits, check

Array = np.ndarray

MAX_DRONES = 1 << 16  # most drones of one simulator
DRONES = Limits(1, MAX_DRONES, whole=True)
MAX_MESSAGE = 1 << 24  # largest message in all its fragments, bytes
STATE_ARRAYS_AT = 40
COMMAND_ARRAYS_AT = 32

_LETTERS = {"float32": "f", "float64": "d"}  # names of `struct`
_SMALL = 256  # up to this many numbers Python's loop is faster than NumPy's calls


class ArrayLayout(NamedTuple):
    """An array of one drone."""

    shape: tuple[int, ...]
    dtype: str = "float32"
    """`float32`, `float64`, `uint8`, `int32` or `int64`."""


class Slot(NamedTuple):
    """An array of all drones, at its place in a message."""

    at: int  # first byte
    end: int  # first byte after it
    shape: tuple[int, ...]  # (N, *shape)
    dtype: np.dtype  # little-endian
    pad: bytes  # the zeros before it

    def view(self, data: bytes) -> Array:
        """The array in a message, not copied, read-only."""
        return np.ndarray(self.shape, self.dtype, data, self.at)

    def zeros(self) -> Array:
        """An array of zeros."""
        return np.zeros(self.shape, self.dtype)


class Record(NamedTuple):
    """The arrays of a State or a Command."""

    slots: tuple[Slot, ...]
    size: int  # bytes of the message
    flags: slice  # bytes that are flags or orders
    legal: bytes  # values of these bytes
    numbers: struct.Struct | None
    """Reads the floats from the first array on, for a quick check; None if NumPy is faster, or
    other numbers are to be checked too."""
    asks: Slot | None = None
    """Requests of a Command that has them."""


@dataclass(kw_only=True, eq=False)
class Layout:
    """Layout of the messages of one simulator.

    Attributes:
        state: Observations, rewards (float64), terminated, truncated (bool), telemetry (float64).
        commands: Actions (N, *shape), or int64 of shape (N,) if discrete; orders (uint8); then, by
            whether it has them, seeds and requests (uint64).

    Raises:
        InputError: The drones are too many, or a message would be larger than `MAX_MESSAGE`.
    """

    drones: int
    """N, of all worlds together."""
    observation: tuple[ArrayLayout, ...]
    """Arrays of one drone."""
    action: ArrayLayout | None
    """None if actions are discrete."""
    choices: int = 0
    """Discrete actions are 0 ... choices - 1; 0 if actions are an array."""
    asked_bits: int = 0
    """Of the events that may be asked for."""
    telemetry: tuple[tuple[tuple[int, ...], str], ...] = ()
    """Shape and frame of each telemetry array of one drone; the text codec converts by them."""

    def __post_init__(self) -> None:
        drones = self.drones
        check("drones", DRONES, drones)

        reward = ArrayLayout((), "float64")
        flag = ArrayLayout((), "bool")
        numbers = [ArrayLayout(shape, "float64") for shape, _ in self.telemetry]
        arrays = [*self.observation, reward, flag, flag, *numbers]
        slots = _slots(STATE_ARRAYS_AT, drones, arrays)
        first = len(self.observation)
        flags = slice(slots[first + 1].at, slots[first + 2].end)
        self.state = Record(slots, slots[-1].end, flags, b"\0\1", _numbers(slots))
        self.observation_slots = slots[:first]
        self.telemetry_slots = slots[first + 3 :]

        actions = self.action or ArrayLayout((), "int64")
        number = ArrayLayout((), "uint64")
        self.commands: dict[tuple[bool, bool], Record] = {}
        for has in product((False, True), (False, True)):
            arrays = [actions, ArrayLayout((), "uint8"), *[number] * sum(has)]
            slots = _slots(COMMAND_ARRAYS_AT, drones, arrays)
            self.actions, orders, *_ = slots
            flags = slice(orders.at, orders.end)
            asks = slots[-1] if has[1] else None
            floats = _numbers(slots[:1]) if self.action and not asks else None
            self.commands[has] = Record(slots, slots[-1].end, flags, b"\0\1\2", floats, asks)
        size = max(self.state.size, self.commands[True, True].size)
        if size > MAX_MESSAGE:
            raise InputError(
                f"expected States and Commands of at most {MAX_MESSAGE} bytes, got {size}"
            )


def _slots(at: int, drones: int, arrays: Sequence[ArrayLayout]) -> tuple[Slot, ...]:
    slots: list[Slot] = []
    for shape, name in arrays:
        begin = at
        if not (name == "bool" and slots[-1].dtype == bool):  # the second flag follows the first
            begin = -(-at // 8) * 8
        dtype = np.dtype("<" + np.dtype(name).str[1:])  # NumPy's own object: quick to compare
        end = begin + drones * math.prod(shape) * dtype.itemsize
        slots.append(Slot(begin, end, (drones, *shape), dtype, bytes(begin - at)))
        at = end
    return tuple(slots)


def _numbers(slots: Sequence[Slot]) -> struct.Struct | None:
    """Reads the floats of all slots from the first byte of the first slot on."""
    form = "<"
    count = 0
    at = slots[0].at
    for slot in slots:
        if slot.dtype.kind == "f":
            size = math.prod(slot.shape)
            form += f"{slot.at - at}x{size}{_LETTERS[slot.dtype.name]}"
            at = slot.end
            count += size
    return struct.Struct(form) if count <= _SMALL else None
