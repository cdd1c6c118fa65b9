"""Balls that are thrown at a place, and posts that cross it."""

import math
from typing import TYPE_CHECKING

from .motion import GRAVITY, along_ellipse, thrown
from .options import SceneOptions

if TYPE_CHECKING:
    from .generators import Draft

_POSTS = 4
_BALLS = 8
_FIRST_THROW = 1.0  # s
_THROW_EVERY = 1.0  # s


class TrafficOptions(SceneOptions):
    """Of the scene `traffic`."""

    most = _BALLS + _POSTS + 1  # and the ground
    room = 0.0


def traffic(field: "Draft") -> None:
    """Balls are thrown at the place 2 m above the origin, and posts cross it."""
    field.add_ground("grass")
    for i in range(_POSTS):
        angle = field.uniform(0.0, 2 * math.pi)
        ahead = (math.cos(angle), math.sin(angle))
        aside = field.uniform(-1.0, 1.0)
        way = field.uniform(4.0, 7.0)
        period = field.uniform(10.0, 20.0)
        first = (way * ahead[0], way * ahead[1], 0.0)
        place = (first[0] - aside * ahead[1], first[1] + aside * ahead[0], 2.0)
        motion = along_ellipse(first, (0.0, 0.0, 0.0), period)
        tint = field.choose("paint")
        field.add(f"post_{i}/post", "cylinder", (0.15, 2.0, 0), place, tint, motion=motion)
    for i in range(_BALLS):
        angle = field.uniform(0.0, 2 * math.pi)
        away = field.uniform(7.0, 9.0)
        flight = field.uniform(1.2, 1.6)  # s
        start = _FIRST_THROW + i * _THROW_EVERY + field.uniform(0.0, 0.5 * _THROW_EVERY)
        radius = field.uniform(0.15, 0.3)
        place = (away * math.cos(angle), away * math.sin(angle), radius)
        aim = (field.uniform(-0.4, 0.4), field.uniform(-0.4, 0.4), 2.0)
        forward, aside, up = ((end - begin) / flight for end, begin in zip(aim, place, strict=True))
        motion = thrown((forward, aside, up + GRAVITY / 2 * flight), start)
        field.add(f"ball_{i}/ball", "sphere", (radius, 0, 0), place, "ball", motion=motion)
