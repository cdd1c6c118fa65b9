"""Where each array of a State and of a Command lies, known from Hello on.

Every array begins at a multiple of 8 bytes, counted from the beginning of the message; the bytes
between two arrays are 0 and are ignored. Numbers are little-endian, in C order, and the drone is
the first axis. With N drones a State is, after its fixed 40 bytes:

    each observation array   its dtype, N x shape
    rewards                  f64 x N
    terminated, truncated    u8 x N each, 0 or 1, without a gap between the two
    each telemetry array     f64, N x shape

and a Command, after its fixed 32 bytes:

    actions                  their dtype, N x shape; a discrete one is an i64
    orders                   u8 x N: 0 fly, 1 reset, 2 stay frozen
    seeds                    u64 x N, or nothing

The size of a message is exactly where its last array ends.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from ...models.errors import InputError

__all__ = ["MAX_DRONES", "MAX_MESSAGE", "ArrayLayout", "Layout", "Slot"]

MAX_DRONES: Final = 1 << 16
"""Most drones of one simulator."""
MAX_MESSAGE: Final = 1 << 24
"""Largest message in all its fragments, bytes."""
STATE_ARRAYS_AT: Final = 40
COMMAND_ARRAYS_AT: Final = 32

_LETTERS: Final = {"float32": "f", "float64": "d", "uint8": "B", "int32": "i", "int64": "q"}
"""The dtypes that may cross the wire, and how `struct` calls them."""
_SMALL: Final = 256
"""Up to this many numbers Python's loop is faster than NumPy's calls."""


@dataclass(frozen=True, kw_only=True)
class ArrayLayout:
    """An array of one drone."""

    shape: tuple[int, ...]
    dtype: str = "float32"
    """`float32`, `float64`, `uint8`, `int32` or `int64`."""

    def __post_init__(self) -> None:
        if self.dtype not in _LETTERS:
            raise InputError(f"dtype: expected one of {', '.join(_LETTERS)}, got {self.dtype!r}")

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)


@dataclass(frozen=True, kw_only=True)
class Slot:
    """An array of all drones, at its place in a message."""

    at: int
    """First byte."""
    end: int
    """First byte after it."""
    shape: tuple[int, ...]
    """(N, *shape)."""
    dtype: np.dtype
    """Little-endian."""

    def view(self, data: bytes) -> np.ndarray:
        """The array in a message, not copied, read-only."""
        return np.ndarray(self.shape, self.dtype, data, self.at)


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Layout of the messages of one simulator.

    Raises:
        InputError: The drones are too many, or a message would be larger than `MAX_MESSAGE`.
    """

    drones: int
    """N, of all worlds together."""
    observation: tuple[ArrayLayout, ...]
    action: ArrayLayout | None
    """None if actions are discrete."""
    choices: int = 0
    """Discrete actions are 0 ... choices - 1; 0 if actions are an array."""
    telemetry: tuple[tuple[int, ...], ...] = ()
    """Shape of each telemetry array."""

    def __post_init__(self) -> None:
        if not 1 <= self.drones <= MAX_DRONES:
            raise InputError(f"drones: expected 1 to {MAX_DRONES}, got {self.drones}")
        if (self.action is None) != (self.choices >= 1):
            raise InputError("action: expected an array or a number of choices, not both")
        size = max(self.state_size, self.command_size)
        if size > MAX_MESSAGE:
            raise InputError(
                f"expected States and Commands of at most {MAX_MESSAGE} bytes, got {size}"
            )

    # ---- State

    @cached_property
    def observation_slots(self) -> tuple[Slot, ...]:
        """Of each observation array in a State."""
        return self._slots(STATE_ARRAYS_AT, [(a.shape, a.dtype) for a in self.observation])

    @cached_property
    def rewards(self) -> Slot:
        """float64, shape (N,)."""
        (slot,) = self._slots(self.observation_slots[-1].end, [((), "float64")])
        return slot

    @cached_property
    def flags(self) -> tuple[Slot, Slot]:
        """terminated and truncated, bool, shape (N,)."""
        at, count = self.rewards.end, self.drones
        flag = np.dtype(bool)
        return (
            Slot(at=at, end=at + count, shape=(count,), dtype=flag),
            Slot(at=at + count, end=at + 2 * count, shape=(count,), dtype=flag),
        )

    @cached_property
    def telemetry_slots(self) -> tuple[Slot, ...]:
        """Of each telemetry array in a State, float64."""
        return self._slots(self.flags[1].end, [(shape, "float64") for shape in self.telemetry])

    @cached_property
    def state_slots(self) -> tuple[tuple[tuple[int, ...], np.dtype, int, bytes], ...]:
        """Of every array of a State in its order: shape, dtype, first byte, and the zeros before.

        Plain tuples, for they are looked at in each message.
        """
        slots = (*self.observation_slots, self.rewards, *self.flags, *self.telemetry_slots)
        ends = (STATE_ARRAYS_AT, *(slot.end for slot in slots))
        return tuple(
            (slot.shape, slot.dtype, slot.at, bytes(slot.at - end))
            for slot, end in zip(slots, ends, strict=False)
        )

    @cached_property
    def state_size(self) -> int:
        """Bytes of a State."""
        return (self.telemetry_slots or self.flags)[-1].end

    @cached_property
    def state_numbers(self) -> struct.Struct | None:
        """Every float of a State after its header, for a quick look at whether all are finite.

        None where there are so many that NumPy is faster.
        """
        slots = [*self.observation_slots, self.rewards, *self.telemetry_slots]
        return _floats(24, "d8x", STATE_ARRAYS_AT, slots)

    # ---- Command

    @cached_property
    def actions(self) -> Slot:
        """Of the actions in a Command: (N, *shape), or int64 of shape (N,) if discrete."""
        array = self.action or ArrayLayout(shape=(), dtype="int64")
        (slot,) = self._slots(COMMAND_ARRAYS_AT, [(array.shape, array.dtype)])
        return slot

    @cached_property
    def orders(self) -> Slot:
        """Of the orders in a Command, uint8, shape (N,)."""
        (slot,) = self._slots(self.actions.end, [((), "uint8")])
        return slot

    @cached_property
    def seeds(self) -> Slot:
        """Of the seeds in a Command that has any, uint64, shape (N,)."""
        at = _aligned(self.orders.end)
        end = at + 8 * self.drones
        return Slot(at=at, end=end, shape=(self.drones,), dtype=np.dtype("<u8"))

    @property
    def command_size(self) -> int:
        """Bytes of a Command with seeds. Without seeds it ends with the orders."""
        return self.seeds.end

    @cached_property
    def command_numbers(self) -> struct.Struct | None:
        """Every float of a Command, as `state_numbers`."""
        return _floats(COMMAND_ARRAYS_AT, "", COMMAND_ARRAYS_AT, [self.actions])

    def _slots(self, at: int, arrays: Sequence[tuple[tuple[int, ...], str]]) -> tuple[Slot, ...]:
        slots = []
        for shape, name in arrays:
            at = _aligned(at)
            dtype = np.dtype("<" + np.dtype(name).str[1:])  # NumPy's own object: quick to compare
            end = at + self.drones * math.prod(shape) * dtype.itemsize
            slots.append(Slot(at=at, end=end, shape=(self.drones, *shape), dtype=dtype))
            at = end
        return tuple(slots)


def _aligned(at: int) -> int:
    return -(-at // 8) * 8


def _floats(start: int, fixed: str, at: int, slots: list[Slot]) -> struct.Struct | None:
    """Reads the floats of all slots, from byte `start` on; None if there are many."""
    form = "<" + fixed
    count = 0
    for slot in slots:
        if slot.dtype.kind == "f":
            size = math.prod(slot.shape)
            form += f"{slot.at - at}x{size}{_LETTERS[slot.dtype.name]}"
            at, count = slot.end, count + size
    return struct.Struct(form) if count <= _SMALL else None
