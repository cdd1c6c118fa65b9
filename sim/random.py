"""Random numbers as functions of (seed, use, episode, step): Philox 4x32-10 in array code.

J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3",
SC 2011. The key is the 64-bit seed of a world. The counter has a block, the step, the episode and
the number of a use, which is made of its name: a use that is switched on later does not move the
numbers of another. A batch of W worlds has the numbers of W single ones.
"""

from collections.abc import Mapping, Sequence
from math import prod
from secrets import randbits
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from . import elementary
from .compile import once
from .snapshots import Kept
from .state import Array, is_traced

Words = NDArray[np.uint32]
Numbers = NDArray[np.float64]
Mask = Array
"""Of drones, bool, shape (W, A), the same for those of a world. None: all."""

# Numbers of uses, and the name of the noise of gusts.
START = crc32(b"start")
"""The draws with which a task begins episodes."""
RANDOMIZATION = crc32(b"randomization")
CRAFT = crc32(b"craft")
RADIO = crc32(b"radio")
SCENES = crc32(b"scenes")
GUSTS = "gusts"

_MULTIPLIERS = np.array((0xD2511F53, 0xCD9E8D57), np.uint64)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_ROUNDS = 10
_UNIT = 2.0**-32
_TURN = 6.283185307179586


@once(vectors=1)
def philox(counter: Words, key: Words) -> Words:
    """Four random words of a counter, shape (..., 4), and a key, shape (..., 2)."""
    even = counter[..., 0::2].astype(np.uint64)
    odd = counter[..., 1::2]
    for number in range(_ROUNDS):
        weyl = np.array([number * step % 2**32 for step in _WEYL], np.uint32)
        product = even * _MULTIPLIERS
        high = (product >> np.uint64(32)).astype(np.uint32)
        mixed = high[..., ::-1] ^ odd ^ (key + weyl)
        odd = product.astype(np.uint32)[..., ::-1]
        even = mixed.astype(np.uint64)
    shape = np.broadcast_shapes(counter.shape[:-1], key.shape[:-1])
    words = np.empty_like(key, np.uint32, shape=(*shape, 4))
    words[..., 0::2] = even
    words[..., 1::2] = odd
    return words


def words_of(
    key: Words, use: int, episode: Array, step: Array, count: int, first: int = 0
) -> Words:
    """Random words of a use, shape (..., count), for keys (..., 2), episodes and steps (...).

    They begin at the block `first`, of four words.
    """
    blocks = -(-count // 4)
    counter = np.empty_like(key, np.uint32, shape=(*key.shape[:-1], blocks, 4))
    counter[..., 0] = np.arange(first, first + blocks)
    counter[..., 1] = np.expand_dims(step, -1)
    counter[..., 2] = np.expand_dims(episode, -1)
    counter[..., 3] = use
    words: Words = philox(counter, key[..., None, :])
    return words.reshape(*key.shape[:-1], 4 * blocks)[..., :count]


def uniform(words: Words) -> Numbers:
    """Numbers from 0 up to 1, one of each word."""
    return words.astype(np.float64) * _UNIT


def normal(words: Words) -> Numbers:
    """Standard normal numbers of an even number of words, as many (Box and Muller, 1958)."""
    half = words.shape[-1] // 2
    distance = uniform(words[..., :half])
    angle = _TURN * uniform(words[..., half:])
    radius = np.sqrt(-2.0 * elementary.log(1.0 - distance))
    parts = (radius * elementary.cos(angle), radius * elementary.sin(angle))
    return np.concatenate(parts, axis=-1)


class Random(Kept):
    """The counters of W worlds. Until a world is seeded its seed is unpredictable.

    Attributes:
        shape: (W, A).
        keys: Of each world the low and the high word of its seed, shape (W, 2).
        episode: Number of the world's episode since it was seeded, shape (W,).
    """

    arrays = ("keys", "episode")

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.shape = shape
        worlds, drones = shape
        self.drones = drones
        seeds = np.array([randbits(64) for _ in range(worlds)], np.uint64)
        self.keys = _keys(seeds)
        self.episode = np.zeros(worlds, np.uint32)
        self._noises: dict[str, Noise] = {}

    def seed(self, mask: Mask, seeds: Sequence[int | None] | Array) -> None:
        """Seed the worlds of a mask, seeds (W,); where it is None their numbers go on."""
        given = [world for world in self.ids(mask).tolist() if seeds[world] is not None]
        numbers = [int(seeds[world]) % 2**64 for world in given]
        self.keys[given] = _keys(np.array(numbers, np.uint64))
        self.episode[given] = 0

    def begin(self, mask: Mask) -> None:
        """Begin an episode of the worlds of a mask."""
        begun = self.worlds(mask)
        self.episode = np.where(begun, self.episode + np.uint32(1), self.episode)
        for noise in self._noises.values():
            noise.begin(begun)

    def worlds(self, mask: Mask) -> Array:
        """The worlds of a mask, bool, shape (W,)."""
        return np.ones(len(self.episode), bool) if mask is None else mask[:, 0]

    def ids(self, mask: Mask) -> Array:
        """The numbers of the worlds of a mask; `...` of traced code, which has one world."""
        worlds = self.worlds(mask)
        return ... if is_traced(worlds) else np.flatnonzero(worlds)

    def noise(self, name: str, size: int) -> "Noise":
        """A source of `size` normal numbers for each drone and step."""
        self._noises[name] = noise = Noise(self, crc32(name.encode()), size)
        return noise

    def parts(self) -> Mapping[str, Kept]:
        """The noises."""
        return self._noises


def _keys(seeds: NDArray[np.uint64]) -> Words:
    return seeds.astype("<u8").view("<u4").reshape(-1, 2)


class Draw:
    """Draws numbers for the worlds that begin an episode; for the others it gives zeros.

    `ahead` is 1 for draws before the `Random.begin` of their episode.

    Attributes:
        openings: Of a start, those of the layout of each world, as of `Scenery`, (W, 1, K, 6); None
            where it has none.
        craft: Of a start, the drawn craft of each world, as of `WorldState.craft`; None where the
            vehicle is one for all.
    """

    openings: Array = None
    craft: Array = None

    def __init__(self, random: Random, use: int, mask: Mask, ahead: int = 0) -> None:
        self._random = random
        self._use = use
        self._ids = ids = random.ids(mask)
        self._key = random.keys[ids]
        self._episode = random.episode[ids] + np.uint32(ahead)
        self._first = 0  # block that comes next

    def uniform(self, low: float, high: float, size: tuple[int, ...] = ()) -> Array:
        """Uniform numbers, float64, shape (W, A, *size), with `size` that of one drone.

        Equal ends give that number, and a number is drawn all the same.
        """
        drawn = low + (high - low) * uniform(self._next(size))
        return self._spread(drawn, size)

    def normal(self, scale: float, size: tuple[int, ...] = ()) -> Array:
        """Normal numbers, mean 0, standard deviation `scale`, shape (W, A, *size)."""
        return self._spread(scale * normal(self._next(size)), size)

    def _next(self, size: tuple[int, ...]) -> Words:
        """The next words of each world that begins, from a new block on: an even number."""
        count = self._random.drones * prod(size)
        count += count % 2
        step = 0 * self._episode
        words = words_of(self._key, self._use, self._episode, step, count, self._first)
        self._first += -(-count // 4)
        return words

    def _spread(self, drawn: Numbers, size: tuple[int, ...]) -> Array:
        random = self._random
        numbers = np.zeros_like(drawn, shape=(len(random.keys), random.drones, *size))
        count = random.drones * prod(size)
        numbers[self._ids] = drawn[:, :count].reshape(-1, random.drones, *size)
        return numbers


class Noise(Kept):
    """Standard normal numbers of each drone in every step: `Random.noise` makes it.

    Attributes:
        step: Number of each world's next step in its episode, shape (W,).
    """

    arrays = ("step",)

    def __init__(self, random: Random, use: int, size: int) -> None:
        worlds = len(random.keys)
        self.step = np.zeros(worlds, np.uint32)
        self._random = random
        self._use = use
        self._size = size

    def begin(self, begun: Array) -> None:
        """An episode of some worlds begins, bool, (W,)."""
        self.step = np.where(begun, np.uint32(0), self.step)

    def normal(self, mask: Mask = None) -> Array:
        """The next numbers of the worlds of a mask, bool, shape (W, A), None for all.

        Shape (W, A, size). The other worlds get zeros, and their steps do not advance.
        """
        random = self._random
        worlds = random.worlds(mask)
        count = random.drones * self._size
        words = words_of(random.keys, self._use, random.episode, self.step, count + count % 2)
        drawn = normal(words)[..., :count].reshape(-1, random.drones, self._size)
        self.step = np.where(worlds, self.step + np.uint32(1), self.step)
        return np.where(worlds[:, None, None], drawn, 0.0)
