"""A way through a scene, by A* (Hart, Nilsson and Raphael 1968) on a grid.

    python examples/find_path.py maze:3,clear=ends

From x = -22 m to x = 22 m, 2 m above the ground, for a craft with a radius of 0.5 m.
"""

import argparse
import heapq
import math
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rotorgram.models import InputError
from rotorgram.scenes import Solids

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
    corner = np.asarray(low, float)
    places = (np.asarray(ends, float) - corner) / cell
    if places.shape != (2, 3) or not ((places >= 0) & (places < room.shape)).all():
        raise InputError(f"ends: expected two places within the grid from {low}, got {ends}")
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


def main() -> None:
    parser = argparse.ArgumentParser(description="Find a way through a scene.")
    parser.add_argument("scene", nargs="?", default="maze:3,clear=ends")
    solids = Solids.of_scene(parser.parse_args().scene).standing()
    ends = [(-22.0, 0.0, 2.0), (22.0, 0.0, 2.0)]
    way = find_path(solids, ends, (-25, -25, 1.75), (25, 25, 2.25), radius=0.5)
    length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    print(f"{len(way)} points, {length:.1f} m")


if __name__ == "__main__":
    main()
