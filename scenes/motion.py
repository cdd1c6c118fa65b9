"""How solids move: where they are follows from the time since the episode began.

When it begins, all are in their places. A row of motions, (11,), has the velocity of a throw, m/s,
and its start, s; then two vectors of an ellipse, m, and its rate, rad/s: a solid is away from its
place by `(cos(rate * t) - 1) * first + sin(rate * t) * second`.

Physics knows where they are at the ends of control steps of T s, and moves them straight between:
off by at most 9.8 T² / 8 in a fall, by a (rate T)² / 8 on an ellipse with the half axis a, and by
v T / 4 in the step in which a throw with the speed v begins.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ..models.matrices import settled

Array = NDArray[np.float64]

GRAVITY = 9.8
"""Of what is thrown, m/s², as in the paper."""
REST = (0.0,) * 11
"""The row of a solid that stands still."""


def thrown(velocity: tuple[float, float, float], start: float) -> tuple[float, ...]:
    """Rests in its place until `start`, s, and falls freely from then on."""
    return (*velocity, start, *REST[4:])


def along_ellipse(
    first: tuple[float, float, float], second: tuple[float, float, float], period: float
) -> tuple[float, ...]:
    """Goes round in a period, s: on a circle, or to and fro on a line if one vector is 0."""
    return (*REST[:4], *first, *second, 2 * math.pi / period)


def offsets(motions: Array, time: Array) -> Array:
    """From their places to where solids of motions, (..., N, 11), are at a time, s, (..., 1): m,
    (..., N, 3). The bits are the same on every processor.
    """
    velocity, start, first, second, rate = np.split(motions, (3, 4, 7, 10), axis=-1)
    seconds = time[..., None]
    angle = rate * seconds
    moved: Array = (settled(np.cos(angle)) - 1) * first + settled(np.sin(angle)) * second
    since = np.maximum(seconds - start, 0.0)
    is_thrown = velocity.any(axis=-1)
    moved += velocity * since
    moved[..., 2] -= np.where(is_thrown, GRAVITY / 2 * (since * since)[..., 0], 0.0)
    return moved
