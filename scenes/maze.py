"""A maze of walls, from a seed: every place in it can be reached from every other.

World frame: z up, m.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..models.fields import immutable
from .kernels import BOX
from .options import Clear, Size

if TYPE_CHECKING:
    from .generators import Draft

Array = NDArray[np.float64]

CELL = 3.0
"""Width of a corridor with one of its walls, m."""
_HALF_HEIGHT = 2.0  # m, of a wall
_HALF_THICKNESS = 0.1  # m
_LOOPS = 0.1  # share of the walls that is left out, so that ways lead round in circles
_MIDDLE = 11.4  # m: radius of the clear space about the z axis, a square of 16 m
_ENDS = 2.0  # m: radius of the clear spaces at the ends


@immutable
class MazeOptions(Clear):
    """Options of the scene `maze`."""

    size: Size = (48.0, 48.0)
    least = 30.0

    @property
    def cells(self) -> tuple[int, int]:
        """Cells along x and y."""
        wide, deep = self.size
        return int(wide / CELL), int(deep / CELL)

    @property
    def most(self) -> int:
        """As `SceneOptions.most`."""
        columns, rows = self.cells
        return columns * rows + 5


def maze(draft: "Draft") -> None:
    """Walls along the sides of square cells, and around all of them."""
    options: MazeOptions = draft.options
    columns, rows = options.cells
    half = CELL / 2 * np.array([columns, rows])
    wide, deep = half.tolist()
    edge = 2 * max(wide, deep)
    draft.add_ground("floor", edge)
    for name, x, y in (
        ("east", wide, 0),
        ("north", 0, deep),
        ("west", -wide, 0),
        ("south", 0, -deep),
    ):
        size = (_HALF_THICKNESS, deep) if x else (wide + _HALF_THICKNESS, _HALF_THICKNESS)
        draft.add(f"side_{name}/block", "box", (*size, _HALF_HEIGHT), (x, y, _HALF_HEIGHT), "wall")
    middles, along_x, cells = _sides(columns, rows)
    is_open = _opened(draft.rng, cells) | (draft.rng.random(len(middles)) < _LOOPS)
    centers = CELL * middles - half
    long = CELL / 2 + _HALF_THICKNESS
    reach = np.where(along_x, (long, _HALF_THICKNESS), (_HALF_THICKNESS, long))
    place, room = ((wide - _ENDS, 0.0), _ENDS) if options.clear == "ends" else ((0, 0), _MIDDLE)
    gap = np.maximum(abs(abs(centers) - place) - reach, 0.0)
    kept = ~is_open & (np.hypot(*gap.T) >= room)
    count = int(kept.sum())
    draft.add_all(
        lambda: [f"wall_{i}/block" for i in range(count)],
        BOX,
        (*reach[kept].T, _HALF_HEIGHT),
        (*centers[kept].T, _HALF_HEIGHT),
        lambda: ["wall"] * count,
    )


def _sides(columns: int, rows: int) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    """Sides between two cells: their middles, in cells from a corner, (n, 2), which lie along x,
    (n, 1), and the numbers of both cells, (n, 2).
    """
    number = np.arange(columns * rows)
    place = np.column_stack(np.divmod(number, rows))
    right = number[place[:, 0] < columns - 1]
    above = number[place[:, 1] < rows - 1]
    first = np.concatenate((right, above))
    second = np.concatenate((right + rows, above + 1))
    middles = (place[first] + place[second] + 1) / 2
    return middles, (second == first + 1)[:, None], np.column_stack((first, second))


def _opened(rng: np.random.Generator, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which sides are open in a random tree of all cells, by Kruskal's algorithm."""
    is_open = np.zeros(len(cells), bool)
    part = np.arange(cells.max() + 1)
    for side in rng.permutation(len(cells)).tolist():
        one, other = part[cells[side]]
        if one != other:
            part[part == other] = one
            is_open[side] = True
    return is_open
