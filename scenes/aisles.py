"""Rows of racks across a hall, with aisles through them of which one is open."""

from typing import TYPE_CHECKING

from ..models.fields import immutable
from .options import SceneOptions, Size

if TYPE_CHECKING:
    from .generators import Draft

PASSAGE = 1.4
"""Width of an aisle, m."""
DEPTH = 3.0
"""Of a row of racks, m."""
ROW, AISLE = 5.0, 2.4
"""A row of racks with the way before it takes so many m along x; an aisle with its racks so many
along y."""
_SHELF = 1.25  # m: half the height of racks


@immutable
class AislesOptions(SceneOptions):
    """Options of the scene `aisles`."""

    size: Size = (12.0, 7.2)
    """Of the hall."""
    room = 0.0

    @property
    def counts(self) -> tuple[int, int]:
        """Rows of racks, and aisles in each."""
        wide, deep = self.size
        return int((wide - ROW + DEPTH) / ROW + 1e-6), int(deep / AISLE + 1e-6)

    @property
    def most(self) -> int:
        """As `SceneOptions.most`."""
        rows, count = self.counts
        return 2 * rows * count + rows + 8


def aisles(hall: "Draft") -> None:
    """Rows of racks across a hall. Each row has aisles through it, and goods at the far end of all
    but one of them.
    """
    options: AislesOptions = hall.options
    rows, count = options.counts
    wide, deep = options.size
    hall.add_ground("floor")
    for name, x, y in (("right", 0, -1), ("left", 0, 1), ("back", -1, 0), ("front", 1, 0)):
        half = (wide / 2 * abs(y) + 0.1, deep / 2 * abs(x) + 0.1, _SHELF)
        center = (x * (wide / 2 + 0.1), y * (deep / 2 + 0.1), _SHELF)
        hall.add(f"wall/{name}", "box", half, center, "wall")
    for row in range(rows):
        _add_row(hall, row, count, -wide / 2 + ROW * (row + 1) - DEPTH / 2)


def _add_row(hall: "Draft", row: int, count: int, x: float) -> None:
    """Racks between aisles, goods in them, and the aisle that is left open."""
    _, deep = hall.options.size
    ways = [AISLE * (i - (count - 1) / 2) for i in range(count)]
    borders = [-deep / 2, *[y + side for y in ways for side in (-PASSAGE / 2, PASSAGE / 2)]]
    borders.append(deep / 2)
    racks = zip(borders[::2], borders[1::2], strict=True)
    for i, (right, left) in enumerate(racks):
        half = (left - right) / 2
        tint = hall.choose("rack")
        center = (x, (left + right) / 2, _SHELF)
        hall.add(f"row_{row}/rack_{i}", "box", (DEPTH / 2, half, _SHELF), center, tint)
    way = int(hall.rng.integers(count))
    for i, y in enumerate(ways):
        tint = hall.choose("box")
        if i != way:
            end = (x + DEPTH / 2 - 0.3, y, _SHELF)
            hall.add(f"row_{row}/goods_{i}", "box", (0.3, PASSAGE / 2, _SHELF), end, tint)
    hall.openings.append((x, ways[way], _SHELF, 1.0, 0.0, PASSAGE / 2))
