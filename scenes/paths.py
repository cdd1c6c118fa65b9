"""A way through a scene, by A* (Hart, Nilsson and Raphael 1968) on a grid."""

import heapq
import math
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.errors import InputError, shortened
from .solids import Solids, numbers

Array = NDArray[np.float64]
_Cell = tuple[int, ...]
_STEPS = [(step, math.hypot(*step)) for step in product((-1, 0, 1), repeat=3) if any(step)]


def find_path(
    solids: Solids,
    ends: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
    *,
    radius: float,
    cell: float = 0.5,
) -> Array:
    """Points of a shortest way of a craft from a start to a goal, `ends`, (2, 3), m.

    The points, (n, 3), are centers of cells of a grid, as of `Solids.field`, each at least `radius`
    from all solids. The next of each is one of the 26 cells around it. Without a way there are
    none. Raises `InputError`.
    """
    room = solids.field(low, high, cell) - radius
    corner = numbers("low", low)
    places = (numbers("ends", ends) - corner) / cell
    if places.shape != (2, 3) or not ((places >= 0) & (places < room.shape)).all():
        got = shortened(ends)
        raise InputError(
            f"ends: expected two places within the grid from {shortened(low)}, got {got}"
        )
    first, last = map(tuple, places.astype(int).tolist())
    free = set(map(tuple, np.argwhere(room >= 0).tolist()))
    found = _search(free, first, last) if {first, last} <= free else []
    return corner + cell * (np.array(found).reshape(-1, 3) + 0.5)


def _search(free: set[_Cell], first: _Cell, last: _Cell) -> list[_Cell]:
    """Free cells from the first to the last; none if there is no way."""
    before: dict[_Cell, _Cell] = {}
    way = {first: 0.0}
    waiting = [(math.dist(first, last), first)]
    while waiting:
        _, here = heapq.heappop(waiting)
        if here == last:
            path = [here]
            while path[-1] != first:
                path.append(before[path[-1]])
            return path[::-1]
        x, y, z = here
        for (dx, dy, dz), length in _STEPS:
            there = (x + dx, y + dy, z + dz)
            total = way[here] + length
            if there in free and total < way.get(there, math.inf):
                way[there] = total
                before[there] = here
                heapq.heappush(waiting, (total + math.dist(there, last), there))
    return []
