"""Random numbers: one stream for each world, so that a batch of N equals N single worlds.

A world's seed gives a `SeedSequence`. Every use has a child of it under a fixed number, so that a
use that is switched on later does not move the numbers of another.
"""

from collections.abc import Iterator, Mapping, Sequence
from math import prod
from typing import Any, Final, Protocol

import numpy as np

from .state import Array

START: Final = 0
"""Child of a world's seed that draws how its episodes begin."""
GUSTS: Final = 1
"""Child that moves the air."""
RANDOMIZATION: Final = 2
"""Child that draws a vehicle's coefficients."""
SENSORS: Final = 3
"""Child of the sensors; each of them has a child of it."""
CAMERAS: Final = 4
"""Child of the noise of pictures."""
SCENES: Final = 5
"""Child that draws what surrounds an episode."""

_ROWS: Final = 256  # Most rows of numbers that a stream gives at once
_NUMBERS: Final = 1 << 23  # Most numbers that all streams of a `Noise` give at once: 64 MiB


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

    `use` is the number of the child of a world's seed, or the path to a child of a child.
    """

    def __init__(self, num_worlds: int, use: int | tuple[int, ...] = START) -> None:
        self._key = use if isinstance(use, tuple) else (use,)
        self._generators: list[np.random.Generator | None] = [None] * num_worlds
        self._seeds: list[int | None] = [None] * num_worlds  # of generators that were not asked yet

    def seed(self, ids: Sequence[int], seeds: Sequence[int | None]) -> None:
        """Seed the worlds `ids`; where the seed is None the stream goes on."""
        for world, seed in zip(ids, seeds, strict=True):
            if seed is not None:
                self._generators[world], self._seeds[world] = None, int(seed)

    def of(self, world: int) -> np.random.Generator:
        """The generator of a world."""
        generator = self._generators[world]
        if generator is None:
            seed = self._seeds[world]
            sequence = None if seed is None else np.random.SeedSequence(seed, spawn_key=self._key)
            generator = self._generators[world] = np.random.default_rng(sequence)
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
        # A generator scales slowly, number by number, and to the same bits as this.
        first, second = parameters
        name, span = (
            ("random", second - first) if kind == "uniform" else ("standard_normal", second)
        )
        one_world = (*self._shape[1:], *size)
        numbers = np.zeros((*self._shape, *size))
        if self._ids:
            drawn = [getattr(self._streams.of(world), name)(one_world) for world in self._ids]
            numbers[self._ids if self._shape else ...] = first + span * np.array(drawn)
        return numbers[()]


class Noise(Protocol):
    """Standard normal numbers in every step, from a use's streams: `World.noise` makes it."""

    def seed(self, ids: Sequence[int], seeds: Sequence[int | None]) -> None:
        """Seed the worlds `ids`; where the seed is None the stream goes on."""

    def normal(self, mask: Array | None = None) -> Array:
        """The next numbers of the worlds of a mask, bool, shape (W, A), None for all.

        Shape (W, A, size). The other worlds get zeros, and their streams stay where they are.
        """


class NumpyNoise:
    """A `Noise` with a stream for each world.

    A call of a generator takes longer than ten numbers, so that each gives many rows at once. How
    many does not change the numbers.
    """

    def __init__(self, shape: tuple[int, ...], size: int, use: int | tuple[int, ...]) -> None:
        self._shape, self._size, (worlds, drones) = shape, size, shape or (1, 1)
        self._streams, self._worlds = Streams(worlds, use), np.arange(worlds)
        row = (drones, size)
        self._count = max(1, min(_ROWS, _NUMBERS // (worlds * prod(row))))
        self._single = self._rows()
        self._block = np.empty((worlds, self._count, *row) if shape else 0)
        self._next = np.full(worlds, self._count)  # of the rows of each world; past the last: none

    def seed(self, ids: Sequence[int], seeds: Sequence[int | None]) -> None:
        """As `Noise.seed`."""
        self._streams.seed(ids, seeds)
        for world, seed in zip(ids, seeds, strict=True):
            if seed is not None:
                self._next[world] = self._count
                self._single = self._rows()

    def normal(self, mask: Array | None = None) -> Array:
        """As `Noise.normal`."""
        if not self._shape:
            return np.zeros(self._size) if mask is not None and not mask else next(self._single)
        ids = self._worlds if mask is None else np.flatnonzero(mask[:, 0])
        for world in ids[self._next[ids] == self._count].tolist():
            self._streams.of(world).standard_normal(out=self._block[world])
            self._next[world] = 0
        rows = self._block[ids, self._next[ids]]
        self._next[ids] += 1
        if mask is None:
            return rows
        numbers = np.zeros((*self._shape, self._size))
        numbers[ids] = rows
        return numbers

    def _rows(self) -> Iterator[np.ndarray]:
        """The rows of a single drone."""
        while True:
            yield from self._streams.of(0).standard_normal((self._count, self._size))
