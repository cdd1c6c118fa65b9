"""Marks of a task, which pictures show and physics does not know: gates, discs, balls.

Imports the standard library and models/fields.py alone.
"""

import math
from typing import Annotated, Literal, NamedTuple

from ..models.fields import Limits, immutable

Point = tuple[float, float, float]

_BAR = 0.025  # radius of a gate's bars, over the gate's width
_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))


@immutable
class Mark:
    """Something of a task that pictures show."""

    shape: Literal["gate", "disc", "ball"]
    """`gate`: an upright square frame; `disc`: level, as a landing pad; `ball`."""
    size: Annotated[float, Limits(0.0, unit="m", above=True)]
    """Width of a gate; radius of a disc or a ball."""
    position: Annotated[Point, Limits(unit="m", count=3)] = (0.0, 0.0, 0.0)
    """Of its centre: x, y, z in MuJoCo's world frame (z up); from the goal where it moves."""
    heading: Annotated[float, Limits(unit="degrees")] = 0.0
    """Direction in which a gate is passed, about z, anticlockwise from x."""
    moves: bool = False
    """Whether it moves along with the goal, which telemetry tells."""

    def parts(self, thickness: float) -> list["MarkPart"]:
        """What is drawn, about the mark's `position`; `thickness` is that of a disc, m."""
        if self.shape == "ball":
            return [MarkPart("sphere", self.size, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))]
        if self.shape == "disc":  # its lower side lies on the ground: both at one height flicker
            return [MarkPart("cylinder", self.size, (0.0, 0.0, 0.0), (0.0, 0.0, thickness))]
        turn = math.radians(self.heading)
        half = self.size / 2
        corners = [
            (-half * y * math.sin(turn), half * y * math.cos(turn), half * z) for y, z in _CORNERS
        ]
        bars = zip(corners, [*corners[1:], corners[0]], strict=True)
        return [MarkPart("capsule", _BAR * self.size, start, end) for start, end in bars]


class MarkPart(NamedTuple):
    """A sphere at `start`, or a cylinder or a capsule from `start` to `end`."""

    kind: Literal["sphere", "cylinder", "capsule"]
    radius: float
    start: Point
    end: Point
