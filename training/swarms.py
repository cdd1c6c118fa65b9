"""How near the drones of one world come to each other: over time, and at the least.

Distances are between the origins of the craft. A drone counts as long as it flies.
"""

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from ..flights.distances import least
from ..flights.trajectories import Trajectory
from .statistics import Floats, bootstrap_interval, iqm

POSITION: Final = ("X", "Y", "Z")
"""Columns of a position in the paper's frame, m."""
GOAL: Final = ("goal_X", "goal_Y", "goal_Z")
"""Columns of the position to reach or hold, the same frame, m; nan where a task has none."""


class World(NamedTuple):
    """An episode of A drones, T control steps; nan after a drone's end."""

    position: Floats
    """Shape (T + 1, A, 3), m."""
    goal: Floats
    """The same."""


def rows_of(flown: Sequence[Trajectory]) -> pd.DataFrame:
    """Positions and goals of trajectories after each control step, and at the start (step 0).

    The trajectories of an episode follow each other in the order of its drones. Columns: `episode`,
    `drone`, `step`, `POSITION`, `GOAL`.
    """
    parts = []
    for place, one in enumerate(flown):
        where = np.asarray(one.telemetry["position"], float)
        goal = np.asarray(one.telemetry.get("goal", np.full(where.shape, np.nan)), float)
        drone = place % len(one.spec.agents)
        steps = np.arange(len(where))
        label = {"episode": one.episode, "drone": drone, "step": steps}
        columns = zip((*POSITION, *GOAL), np.hstack((where, goal)).T, strict=True)
        parts.append(pd.DataFrame({**label, **dict(columns)}))
    return pd.concat(parts, ignore_index=True)


def worlds(rows: pd.DataFrame) -> Iterator[tuple[tuple[str, int, int], World]]:
    """The episodes in rows of `rows_of` with the columns `row` and `seed`: row, seed and number
    of each, and its drones.
    """
    for (row, seed, episode), own in rows.groupby(["row", "seed", "episode"], observed=True):
        shape = int(own["step"].max()) + 1, int(own["drone"].max()) + 1, 6
        told = np.full(shape, np.nan)
        told[own["step"], own["drone"]] = own[[*POSITION, *GOAL]]
        yield (str(row), int(seed), int(episode)), World(told[..., :3], told[..., 3:])


def least_distances(rows: pd.DataFrame) -> pd.DataFrame:
    """Of each row (the index) the least distance of a seed's evaluation, m: `least_distance`, the
    interquartile mean over seeds, and `_low` and `_high` of its 95 % interval.
    """
    found: dict[tuple[str, int], float] = {}
    for (row, seed, _), world in worlds(rows):
        values = least(world.position)
        lowest = float(np.min(values[np.isfinite(values)], initial=np.inf))
        found[row, seed] = min(found.get((row, seed), np.inf), lowest)
    own = pd.Series(found).replace(np.inf, np.nan)
    table = {}
    for row, seeds in own.groupby(level=0):
        low, high = bootstrap_interval(seeds)
        table[row] = dict(zip(LEAST, (iqm(seeds), low, high), strict=True))
    return pd.DataFrame.from_dict(table, orient="index")


LEAST: Final = ("least_distance", "least_distance_low", "least_distance_high")
"""Columns of `least_distances`."""
