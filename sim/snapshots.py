"""State as named arrays, so that it can be copied, put back, and stored."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from .state import Array

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
        own = {name: getattr(self, name) for name in self.arrays}
        return joined(own | {name: part.snapshot() for name, part in self.parts().items() if part})

    def restore(self, arrays: Arrays) -> None:
        """Put a snapshot back."""
        for name in self.arrays:
            array = arrays.get(name)
            setattr(self, name, None if array is None else array.copy())
        for name, part in self.parts().items():
            if part:
                part.restore(part_of(arrays, name))


def joined(parts: Mapping[str, Array]) -> Snapshot:
    """Copies of arrays by name; those of a part, a mapping, after its name. None is left out."""
    joint: Snapshot = {}
    for name, part in parts.items():
        if isinstance(part, Mapping):
            joint |= {f"{name}/{own}": array for own, array in joined(part).items()}
        elif part is not None:
            joint[name] = np.copy(part)
    return joint


def part_of(arrays: Arrays, part: str) -> Snapshot:
    """The arrays of one part of `joined`."""
    start = f"{part}/"
    return {
        name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)
    }
