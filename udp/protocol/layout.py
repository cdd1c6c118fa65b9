"""Where each array of a State and of a Command lies, known from Hello on.

The tables of State and Command in `docs/protocol.md` say it in words: every array begins at a
multiple of 8 bytes, and the size of a message is exactly where its last array ends.
"""

import math
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from ...models.errors import InputError

MAX_DRONES: Final = 1 << 16  # most drones of one simulator
MAX_MESSAGE: Final = 1 << 24  # largest message in all its fragments, bytes
STATE_ARRAYS_AT: Final = 40
COMMAND_ARRAYS_AT: Final = 32

_LETTERS: Final = {"float32": "f", "float64": "d", "uint8": "B", "int32": "i", "int64": "q"}
"""The dtypes that may cross the wire, and how `struct` calls them."""
_SMALL: Final = 256  # up to this many numbers Python's loop is faster than NumPy's calls


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

    def view(self, data: bytes) -> np.ndarray:
        """The array in a message, not copied, read-only."""
        return np.ndarray(self.shape, self.dtype, data, self.at)


class Layout:
    """Layout of the messages of one simulator.

    Args:
        drones: N, of all worlds together.
        observation: Of one drone.
        action: None if actions are discrete.
        choices: Discrete actions are 0 ... choices - 1; 0 if actions are an array.
        telemetry: Shape of each telemetry array of one drone.

    Attributes:
        observation_slots: Of each observation array in a State.
        rewards: float64, shape (N,).
        flags: terminated and truncated, bool, shape (N,).
        telemetry_slots: Of each telemetry array in a State, float64.
        state_slots: Every array of a State in its order: shape, dtype, first byte, and the zeros
            before. Plain tuples, for they are looked at in each message.
        state_floats: Where its numbers lie that have to be finite: of the telemetry all together.
        state_numbers: Reads every float of a State after its header, for a quick look at whether
            all are finite. None where there are so many that NumPy is faster.
        actions: Of the actions in a Command: (N, *shape), or int64 of shape (N,) if discrete.
        orders: uint8, shape (N,).
        seeds: uint64, shape (N,), in a Command that has any; others end before.
        command_numbers: Reads every float of a Command, as `state_numbers`; None too if discrete.
        state_size: Bytes of a State.
        command_size: Bytes of a Command with seeds.

    Raises:
        InputError: The drones are too many, or a message would be larger than `MAX_MESSAGE`.
    """

    def __init__(
        self,
        *,
        drones: int,
        observation: tuple[ArrayLayout, ...],
        action: ArrayLayout | None,
        choices: int = 0,
        telemetry: tuple[tuple[int, ...], ...] = (),
    ) -> None:
        if not 1 <= drones <= MAX_DRONES:
            raise InputError(f"drones: expected 1 to {MAX_DRONES}, got {drones}")
        self.drones = drones
        self.observation = observation
        self.action = action
        self.choices = choices
        self.telemetry = telemetry

        reward = ArrayLayout((), "float64")
        *slots, self.rewards = _slots(STATE_ARRAYS_AT, drones, [*observation, reward])
        at = self.rewards.end
        end = self.rewards.end + drones
        flag = np.dtype(bool)
        self.flags = Slot(at, end, (drones,), flag), Slot(end, end + drones, (drones,), flag)
        told = _slots(end + drones, drones, [ArrayLayout(shape, "float64") for shape in telemetry])
        self.observation_slots = tuple(slots)
        self.telemetry_slots = tuple(told)
        slots += [self.rewards, *self.flags, *told]
        ends = [STATE_ARRAYS_AT, *(slot.end for slot in slots)]
        self.state_slots = tuple(
            (slot.shape, slot.dtype, slot.at, bytes(slot.at - end))
            for slot, end in zip(slots, ends, strict=False)
        )
        self.state_size = ends[-1]
        self.state_floats = [
            slot for slot in slots[: len(observation) + 1] if slot.dtype.kind == "f"
        ]
        if told:  # float64 side by side: one array, for one look at it
            at = told[0].at
            end = told[-1].end
            self.state_floats.append(Slot(at, end, ((end - at) // 8,), told[0].dtype))
        self.state_numbers = _numbers("d8x", STATE_ARRAYS_AT, self.state_floats)

        actions = action or ArrayLayout((), "int64")
        arrays = [actions, ArrayLayout((), "uint8"), ArrayLayout((), "uint64")]
        self.actions, self.orders, self.seeds = _slots(COMMAND_ARRAYS_AT, drones, arrays)
        self.command_size = self.seeds.end
        self.command_numbers = _numbers("", COMMAND_ARRAYS_AT, [self.actions]) if action else None
        if (size := max(self.state_size, self.command_size)) > MAX_MESSAGE:
            most = f"States and Commands of at most {MAX_MESSAGE} bytes"
            raise InputError(f"expected {most}, got {size}")


def _slots(at: int, drones: int, arrays: Sequence[ArrayLayout]) -> list[Slot]:
    slots = []
    for shape, name in arrays:
        at = -(-at // 8) * 8
        dtype = np.dtype("<" + np.dtype(name).str[1:])  # NumPy's own object: quick to compare
        end = at + drones * math.prod(shape) * dtype.itemsize
        slots.append(Slot(at, end, (drones, *shape), dtype))
        at = end
    return slots


def _numbers(fixed: str, at: int, slots: list[Slot]) -> struct.Struct | None:
    """Reads the floats of all slots behind `fixed`, which ends at that byte; None if many."""
    form = "<" + fixed
    count = 0
    for slot in slots:
        if slot.dtype.kind == "f":
            size = math.prod(slot.shape)
            form += f"{slot.at - at}x{size}{_LETTERS[slot.dtype.name]}"
            at = slot.end
            count = count + size
    return struct.Struct(form) if count <= _SMALL else None
