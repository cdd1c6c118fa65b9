"""What a range sensor makes of distances: noise, and returns that are missing.

As in `kernels`, a formula is there once: NumPy runs it on arrays, Numba compiles it for numbers.
"""

from collections.abc import Callable
from functools import cache
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from .kernels import Array, Maker, _least, _pick

RANGES = ("depth", "lidar", "tof")
"""Kinds of sensors with rays, and their names among observations."""
LEVELS = 4096
"""How many values a normal number has here: those in the middle of as many equal shares."""
SHARES = 1 << 20
"""How many shares a probability has."""
CALM = 0xFFFFF800
"""A word that loses no return."""
_BITS = np.uint32(12)  # of a word, below those of a share
_LEVEL = np.uint32(LEVELS - 1)
_JUMP = np.float32(0.1)  # of a distance, to the next ray: more is an edge
_WORD = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_FIRST = np.uint64(0xD2511F53)
_SECOND = np.uint64(0xCD9E8D57)
_WEYL = np.uint64(0x9E3779B9)
_OTHER_WEYL = np.uint64(0xBB67AE85)


_SHARES = (np.arange(LEVELS) + 0.5) / LEVELS
QUANTILES = np.array([round(NormalDist().inv_cdf(share), 10) for share in _SHARES], np.float32)


class ErrorModel(NamedTuple):
    """Of a sensor. Its noise at a distance d has the size noise + share d + growth d², m."""

    near: float
    """Nearest distance that returns, m."""
    reach: float
    """Farthest, m; also what is said where nothing returns."""
    noise: float
    """m."""
    share: float
    growth: float
    """1/m."""
    dropout: float
    """Probability that a return is missing."""
    edge_dropout: float
    """A further one where a neighbouring ray is much nearer or farther."""

    @property
    def draws(self) -> bool:
        """Whether random numbers matter."""
        return any(self[2:])

    def numbers(self) -> Array:
        """As code has them, float32; probabilities are numbers of shares."""
        either = 1 - (1 - self.dropout) * (1 - self.edge_dropout)
        chances = [np.ceil(chance * SHARES) for chance in (self.dropout, either)]
        return np.array([*self[:5], *chances], np.float32)


class Reading(NamedTuple):
    """What a sensor with rays reads on one drone, for pictures."""

    name: str
    distances: Array
    """m, (rows, columns); `reach` where nothing returned."""
    reach: float
    """m."""
    origin: Array
    """Of the rays, world frame, m, (3,)."""
    points: Array
    """Where rays ended, world frame, m, (rows, columns, 3); nan where nothing returned."""


# ---- formulas


def _reading(distance: Array, word: Array, level: Array, is_edge: Array, errors: Array) -> Array:
    """What is read of a distance, by a random word and its normal number."""
    sigma = errors[2] + distance * (errors[3] + distance * errors[4])
    value = distance + sigma * level
    chance = _pick(is_edge, errors[6], errors[5])
    missing = (distance >= errors[1]) | (value < errors[0]) | (np.float32(word >> _BITS) < chance)
    return _pick(missing, errors[1], _least(value, errors[1]))


def _jumps(a: Array, b: Array) -> Array:
    return abs(a - b) > _JUMP * _least(a, b)


def _word(block: Array, step: Array, episode: Array, use: Array, low: Array, high: Array) -> Array:
    """Four words of `sim.random.philox`, of uint64."""
    a, b, c, d = block, step, episode, use
    for _ in range(10):
        first = _FIRST * a
        second = _SECOND * c
        a, b = (second >> _HALF) ^ b ^ low, second & _WORD
        c, d = (first >> _HALF) ^ d ^ high, first & _WORD
        low = (low + _WEYL) & _WORD
        high = (high + _OTHER_WEYL) & _WORD
    return a, b, c, d


# ---- all rays of M scans


def by_numpy(
    ranges: Array, scale: Array, columns: int, words: Array, errors: Array, out: Array
) -> None:
    """Set `out`, float32, (M, N), to the readings of scans.

    Args:
        ranges: Along the rays, m, (M, N).
        scale: What a distance is of the way along each ray, (N,).
        columns: Rays of each row. Those beside and below each other are neighbours.
        words: Random, uint32, (M, N).
        errors: `ErrorModel.numbers()`.
    """
    distance = ranges * scale
    grid = distance.reshape(len(distance), -1, columns)
    edges = np.zeros(grid.shape, bool)
    aside = _jumps(grid[:, :, :-1], grid[:, :, 1:])
    edges[:, :, :-1] |= aside
    edges[:, :, 1:] |= aside
    below = _jumps(grid[:, :-1], grid[:, 1:])
    edges[:, :-1] |= below
    edges[:, 1:] |= below
    level = QUANTILES[words & np.uint32(LEVELS - 1)]
    out[:] = _reading(distance, words, level, edges.reshape(distance.shape), errors)


def _readings(
    ranges: Array, scale: Array, columns: int, words: Array, errors: Array, out: Array
) -> None:
    """As `by_numpy`."""
    distance = np.empty(scale.size, np.float32)
    jump = np.empty(scale.size, np.int32)
    edge = np.zeros(scale.size, np.int32)
    ways = 2 if errors[6] > errors[5] else 0  # else edges do not matter
    for m in range(out.shape[0]):
        for i in range(scale.size):
            distance[i] = ranges[m, i] * scale[i]
        edge[:] = 0
        for way in range(ways):
            step = columns if way else 1
            count = scale.size - step
            for i in range(count):
                jump[i] = _jumps(distance[i], distance[i + step])
            if not way:  # none is beside the last ray of a row
                jump[columns - 1 :: columns] = 0
            for i in range(count):
                edge[i] |= jump[i]
            for i in range(count):
                edge[i + step] |= jump[i]
        for i in range(scale.size):
            word = words[m, i]
            level = QUANTILES[word & _LEVEL]
            out[m, i] = _reading(distance[i], word, level, edge[i] != 0, errors)


def _words(keys: Array, use: Array, episode: Array, step: Array, out: Array) -> None:
    """Random words, uint32, (M, N), of keys (M, 2), episodes and steps (M,): `random.words_of`."""
    for m in range(out.shape[0]):
        low, high = np.uint64(keys[m, 0]), np.uint64(keys[m, 1])
        own, now = np.uint64(episode[m]), np.uint64(step[m])
        for block in range(out.shape[1] // 4):
            four = _word(np.uint64(block), now, own, use, low, high)
            for k in range(4):
                out[m, 4 * block + k] = four[k]


class Compiled(NamedTuple):
    """What Numba has compiled."""

    readings: Callable[..., None]
    words: Callable[..., None]


@cache
def compiled() -> Compiled | None:
    """Kernels by Numba, or None where it is not installed."""
    try:
        maker = Maker(globals())
    except ImportError:
        return None
    rows = "f4[:,::1]"
    return Compiled(
        maker.made(f"{rows},f4[::1],i8,u4[:,::1],f4[::1],{rows}", _readings),
        maker.made("u4[:,::1],u8,u4[::1],u4[::1],u4[:,::1]", _words),
    )
