"""State as named arrays, so that it can be copied, put back, and stored."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from .compile import TracedArray

Snapshot = dict[str, np.ndarray]
Arrays = Mapping[str, np.ndarray]


class Kept:
    """Base of what keeps a state between steps.

    Class attributes:
        arrays: Names of attributes that are arrays, or a single drone's numbers.
        lists: Names of attributes that are lists of those.
    """

    arrays: ClassVar[tuple[str, ...]] = ()
    lists: ClassVar[tuple[str, ...]] = ()

    def parts(self) -> "dict[str, Kept]":
        """Parts that keep a state of their own, by name."""
        return {}

    def snapshot(self) -> Snapshot:
        """Copies by name; attributes without a value yet are left out."""
        own = {}
        for name in self.arrays:
            value = getattr(self, name)
            if value is not None:
                own[name] = copied(value)
        for name in self.lists:
            values = getattr(self, name)
            if values:
                own[name] = np.stack(values, axis=-1)
        return own | joined({name: part.snapshot() for name, part in self.parts().items()})

    def restore(self, arrays: Arrays) -> None:
        """Put a snapshot back."""
        for name in self.arrays:
            array = arrays.get(name)
            setattr(self, name, None if array is None else array.copy()[()])
        for name in self.lists:
            array = arrays.get(name)
            setattr(self, name, [] if array is None else _listed(array))
        for name, part in self.parts().items():
            part.restore(part_of(arrays, name))


def copied(value: Any) -> Any:
    """A copy of an array, or of a single drone's number as one."""
    return value.copy() if isinstance(value, TracedArray) else np.array(value)


def _listed(array: Any) -> list[Any]:
    """The arrays of a stack of them; of a single drone Python's numbers."""
    if array.ndim == 1:
        numbers: list[float] = array.tolist()
        return numbers
    return [array[..., index].copy() for index in range(array.shape[-1])]


def joined(parts: Mapping[str, Arrays]) -> Snapshot:
    """Arrays of several parts under the name of the part and their own."""
    joint = {}
    for part, arrays in parts.items():
        for name, array in arrays.items():
            joint[f"{part}/{name}"] = array
    return joint


def part_of(arrays: Arrays, part: str) -> Snapshot:
    """The arrays of one part of `joined`."""
    start = f"{part}/"
    return {
        name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)
    }
