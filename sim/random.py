"""Random numbers: one stream for each world, so that a batch of N equals N single worlds.

A world's seed gives a `SeedSequence`. Every use has a child of it under a fixed number, so that a
use that is switched on later does not move the numbers of another.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from .state import Array

START: Final = 0
"""Child of a world's seed that draws how its episodes begin."""


class Draw:
    """Draws numbers for the worlds that begin an episode; for the others it gives zeros.

    `chosen` has by name what a reset's options give in place of draws, shape (W, A, *size).
    """

    def __init__(self, chosen: Mapping[str, Any] | None) -> None:
        self._chosen = chosen or {}

    def uniform(
        self, low: float, high: float, size: tuple[int, ...] = (), *, name: str = ""
    ) -> Array:
        """Uniform numbers, float64, shape (W, A, *size), with `size` that of one drone.

        Equal ends give that number, and a number is drawn all the same. Under `name` a reset's
        options may give values in place of the draw.
        """
        return self._chosen.get(name, self._draw("uniform", (low, high), size))

    def normal(self, scale: float, size: tuple[int, ...] = (), *, name: str = "") -> Array:
        """Normal numbers with mean 0 and that standard deviation, shape (W, A, *size)."""
        return self._chosen.get(name, self._draw("normal", (0.0, scale), size))

    def chosen(self, name: str) -> Array | None:
        """Values that a reset's options give under that name, shape (W, A); None if none."""
        return self._chosen.get(name)

    def _draw(self, kind: str, parameters: tuple[float, float], size: tuple[int, ...]) -> Array:
        raise NotImplementedError


class Streams:
    """A generator for each of W worlds, seeded by `seed`; unpredictable until it is.

    `use` is the number of the child of a world's seed.
    """

    def __init__(self, num_worlds: int, use: int = START) -> None:
        self._use = use
        self._generators: list[np.random.Generator | None] = [None] * num_worlds

    def seed(self, ids: Sequence[int], seeds: Sequence[int | None]) -> None:
        """Seed the worlds `ids`; where the seed is None the stream goes on."""
        for world, seed in zip(ids, seeds, strict=True):
            if seed is not None:
                sequence = np.random.SeedSequence(int(seed), spawn_key=(self._use,))
                self._generators[world] = np.random.default_rng(sequence)

    def of(self, world: int) -> np.random.Generator:
        """The generator of a world."""
        generator = self._generators[world]
        if generator is None:
            generator = self._generators[world] = np.random.default_rng()
        return generator


class NumpyDraw(Draw):
    """Draws from streams, for the worlds `ids` of (W, A), or of () for a single drone."""

    def __init__(
        self,
        streams: Streams,
        ids: Sequence[int],
        shape: tuple[int, ...],
        chosen: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(chosen)
        self._streams, self._ids, self._shape = streams, ids, shape

    def _draw(self, kind: str, parameters: tuple[float, float], size: tuple[int, ...]) -> Array:
        numbers = np.zeros((*self._shape, *size))
        one_world = (*self._shape[1:], *size)
        for world in self._ids:
            place = world if self._shape else ...
            numbers[place] = getattr(self._streams.of(world), kind)(*parameters, one_world)
        return numbers[()]
