"""Height fields: ground of heights over a grid, from its corner with the least x and y on.

Frame: x along the columns, y along the rows, z up, m.
"""

import math
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError
from ..models.fields import Limits, immutable
from .options import CLEARANCE, SceneOptions, Size

if TYPE_CHECKING:
    from .generators import Draft

Array = NDArray[np.float64]

MAX_POINTS = 1 << 16
"""Most heights of a field."""
CELL = 1.6  # m: the largest scene has no more than so many heights
_AREA = 250.0  # m² for each hill
_RADII = (6.0, 16.0)  # m
_BOULDERS = 120
_SUNK = 1.0  # m: how deep what is level lies below the ground, where nothing touches it
_DEPTH = 2.0  # m: how deep the field is
_SLOPE = 8.0  # m: over which hills rise from the clear space, and sink to the border


@immutable
class HillsOptions(SceneOptions):
    """Options of the scene `hills`."""

    size: Size = (90.0, 90.0)
    height: Annotated[float, Limits(0.5, 20.0, "m")] = 8.0
    """Of the highest hill."""

    def check(self) -> None:
        """As `SceneOptions.check`."""
        if min(self.size) < 4 * CLEARANCE:
            expected = f"sides of at least {4 * CLEARANCE:g} m"
            raise InputError(f"scene: expected {expected}, got {min(self.size):g} m")


def hills(land: "Draft") -> None:
    """Round hills about a level middle, in one height field, and boulders on them."""
    options: HillsOptions = land.options
    land.add_ground("grass")
    half = np.array(options.size) / 2
    columns, rows = np.ceil(2 * half / CELL).astype(int) + 1
    x = np.linspace(-half[0], half[0], columns)
    y = np.linspace(-half[1], half[1], rows)[:, None]
    heights = np.zeros((rows, columns))
    for _ in range(round(4 * half.prod() / _AREA)):
        place = land.rng.uniform(-half, half)
        radius = land.uniform(*_RADII)
        tall = land.uniform(0.3, 1.0)
        square = ((x - place[0]) ** 2 + (y - place[1]) ** 2) / (radius * radius)
        heights = np.maximum(heights, tall * np.maximum(1 - square, 0.0) ** 2)
    middle = np.sqrt(x * x + y * y) - math.sqrt(2) * CLEARANCE
    border = np.minimum(half[0] - abs(x), half[1] - abs(y))
    heights *= np.clip(np.minimum(middle, border) / _SLOPE, 0.0, 1.0)
    highest = max(float(heights.max()), 1e-6)  # all may lie in the middle
    heights = heights * ((options.height + _SUNK) / highest) - _SUNK
    land.add_heights("hills_0/ground", half, heights, _DEPTH, "slope")
    far = float(half.min())
    for i in range(_BOULDERS):
        radius = land.uniform(0.4, 1.2)
        place = np.array(land.around(radius, far))
        column, row = ((place + half) / (2 * half) * (columns - 1, rows - 1)).astype(int)
        center = (*place, max(0.0, heights[row, column]) + 0.2 * radius)
        land.add(f"boulder_{i}/stone", "sphere", (radius, 0, 0), center, "stone")


def centered(heights: Array, depth: float) -> tuple[float, Array]:
    """Middle between the deepest point of a field, which is `depth` below 0, and the highest; and
    heights above it.
    """
    middle = (float(heights.max()) - depth) / 2
    return middle, heights - middle


Table = tuple[tuple[float, ...], ...]


class Rows:
    """Rule of rows of numbers, m: heights of a field, vertices of a hull."""

    expected = f"2 or more rows of as many numbers from -1000 to 1000 m, {MAX_POINTS} at most"

    def read(self, value: object) -> Table:
        """As `fields.Rule`."""
        if isinstance(value, tuple) and not value:
            return ()
        rows = np.array(value)
        if rows.dtype.kind not in "if" or rows.ndim != 2 or not (abs(rows) <= 1e3).all():
            raise ValueError
        if min(rows.shape) < 2 or rows.size > MAX_POINTS:
            raise ValueError
        return tuple(map(tuple, rows.astype(float).tolist()))


def check_points(rows: int, columns: int, where: str) -> None:
    """Refuse a field of a wrong size. Raises `InputError`."""
    if min(rows, columns) < 2 or rows * columns > MAX_POINTS:
        expected = f"2 or more rows and columns, and at most {MAX_POINTS} heights"
        raise InputError(f"{where}: expected {expected}, got {rows} x {columns}")
