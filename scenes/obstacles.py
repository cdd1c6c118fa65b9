"""Obstacles of a scene's file, and their text in TOML, which a config carries."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import fields
from functools import lru_cache
from typing import Annotated

import numpy as np

from ..models.errors import InputError, shortened
from ..models.fields import (
    Choice,
    Direction,
    Limits,
    Text,
    check_fields,
    check_names,
    immutable,
    read_table,
)
from ..models.files import MAX_BYTES, parse_toml
from .fields import Rows, Table
from .kernels import KINDS
from .registry import MAX_SOLIDS

OWN = "own"
"""Before the names of a file's obstacles."""
SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "plane": 0, "hfield": 3}
"""How many numbers the size of each kind has."""
HULL = "hull"
"""Kind of a convex hull, which `mujoco` and pictures know, and no ray and no distance."""
MAX_VERTICES = 2048
"""Most vertices of a hull."""
_FLAT = 1e-4  # m: least deviation of a hull's vertices from a plane, a root of a sum of squares
_WORD = Text(r"([A-Za-z][\w-]{0,31})?", "a word of at most 32 letters, digits, - and _")


@immutable
class Obstacle:
    """A primitive or a convex hull that stands still. World frame: z up."""

    kind: Annotated[str, Choice((*KINDS, HULL))]
    size: Annotated[tuple[float, ...], Limits(1e-4, 1e4, "m", count=0, least=0)] = ()
    """As MuJoCo has them: radius; radius and half the length, without the round ends of a capsule;
    half the sides of a box along x, y and z; those of a height field along x and y, and its depth
    below its position. A plane has no end and no size: its z axis points out of it."""
    heights: Annotated[Table, Rows()] = ()
    """Of a height field above its position, m: rows from the least y on, each from the least x
    on."""
    vertices: Annotated[Table, Rows()] = ()
    """Of a hull: x, y and z of each, from its position, m."""
    position: Annotated[tuple[float, ...], Limits(-1e4, 1e4, "m", count=3)] = (0.0, 0.0, 0.0)
    """Of its center; of a height field of the middle of its ground."""
    quaternion: Annotated[tuple[float, ...], Direction(-1e3, 1e3, count=4)] = (1.0, 0.0, 0.0, 0.0)
    """Attitude, w first: `[cos, 0, 0, sin]` of half the angle turns about z, anticlockwise."""
    color: Annotated[tuple[float, ...], Limits(0.0, 1.0, count=3)] = (0.5, 0.5, 0.5)
    """Red, green and blue."""
    label: Annotated[str, _WORD] = ""
    """Its class, a word as `tree`. None given: its kind."""

    def __post_init__(self) -> None:
        check_fields(self, "obstacle: ")
        count = SIZES.get(self.kind, 0)
        if len(self.size) != count:
            raise InputError(
                f"obstacle: expected a size of {count} numbers for a {self.kind}, "
                f"got {len(self.size)}"
            )
        if bool(self.heights) != (self.kind == "hfield"):
            raise InputError(f"obstacle: expected heights of an hfield alone, got a {self.kind}")
        if (self.vertices or self.kind == HULL) and not self._is_hull():
            got = f"{len(self.vertices)} of a {self.kind}"
            raise InputError(
                f"obstacle: expected 4 to {MAX_VERTICES} vertices of a hull alone, as maxhullvert "
                f"of a mesh gives, with 3 numbers each and not in a plane, got {got}"
            )
        if self.heights and min(map(min, self.heights)) < -self.size[2]:
            raise InputError("obstacle: expected heights above the depth of the field, got others")

    def _is_hull(self) -> bool:
        """Whether it is one that is not flat."""
        points = np.array(self.vertices)
        if self.kind != HULL or points.shape[1:] != (3,) or len(points) > MAX_VERTICES:
            return False
        return bool(np.linalg.matrix_rank(points - points.mean(axis=0), tol=_FLAT) == 3)

    @property
    def attitude(self) -> tuple[float, ...]:
        """Unit quaternion."""
        length = math.hypot(*self.quaternion)
        return tuple(one / length for one in self.quaternion)


def to_content(obstacles: Iterable[Obstacle]) -> str:
    """Obstacles as the text of a TOML file. Raises `InputError` if it would be too long to read."""
    content = ""
    for one in obstacles:
        content += "[[obstacle]]\n"
        for field in fields(one):
            value = getattr(one, field.name)
            if value != field.default:
                content += f"{field.name} = {json.dumps(value)}\n"
        if len(content) > MAX_BYTES:
            raise InputError(f"obstacle: expected text of at most {MAX_BYTES} bytes, got more")
    return content.rstrip() or "obstacle = []"


@lru_cache(maxsize=16)
def obstacles_of(content: str) -> tuple[Obstacle, ...]:
    """Obstacles of the text of a TOML file. Raises `InputError`."""
    return obstacles_in(parse_toml(content, "obstacle"))


def obstacles_in(file: Mapping[str, object]) -> tuple[Obstacle, ...]:
    """Obstacles of the tables of a TOML file, hulls last. Raises `InputError`."""
    check_names(file, ["obstacle"], "obstacle")
    tables = file.get("obstacle", [])
    if not isinstance(tables, list):
        raise InputError(f"obstacle: expected a list of tables, got {shortened(tables)}")
    if len(tables) > MAX_SOLIDS:
        raise InputError(f"obstacle: expected at most {MAX_SOLIDS}, got {len(tables)}")
    obstacles = [read_table(Obstacle, table, "obstacle") for table in tables]
    return tuple(sorted(obstacles, key=lambda one: one.kind == HULL))


def hulls_of(content: str) -> dict[str, Obstacle]:
    """Convex hulls of the text of a TOML file, by names as those of other parts."""
    return {
        f"{OWN}/{one.label or HULL}_{i}/{HULL}": one
        for i, one in enumerate(obstacles_of(content))
        if one.kind == HULL
    }
