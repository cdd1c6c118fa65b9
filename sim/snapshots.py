"""State as named arrays, so that it can be copied, put back, and stored."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

Snapshot = dict[str, np.ndarray]
Arrays = Mapping[str, np.ndarray]


class Kept:
    """Base of what keeps a state between steps.

    Class attributes:
        arrays: Names of attributes that are arrays.
    """

    arrays: ClassVar[tuple[str, ...]] = ()

    def parts(self) -> "Mapping[str, Kept | None]":
        """Parts that keep a state of their own, by name; None: there is none."""
        return {}

    def snapshot(self) -> Snapshot:
        """Copies by name; attributes without a value yet are left out."""
        own = {}
        for name in self.arrays:
            value = getattr(self, name)
            if value is not None:
                own[name] = np.copy(value)
        parts = {name: part.snapshot() for name, part in self.parts().items() if part}
        return own | joined(parts)

    def restore(self, arrays: Arrays) -> None:
        """Put a snapshot back."""
        for name in self.arrays:
            array = arrays.get(name)
            setattr(self, name, None if array is None else array.copy())
        for name, part in self.parts().items():
            if part:
                part.restore(part_of(arrays, name))


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
