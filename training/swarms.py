"""How near the drones of one world come to each other: over time, and at the least.

Distances are between the origins of the craft. A drone counts as long as it flies.
"""

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from ..flights.distances import least
from ..flights.trajectories import Trajectory
from .metrics import Spread
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
        drone, steps = place % len(one.spec.agents), np.arange(len(where))
        label = {"episode": one.episode, "drone": drone, "step": steps}
        columns = zip((*POSITION, *GOAL), np.hstack((where, goal)).T, strict=True)
        parts.append(pd.DataFrame({**label, **dict(columns)}))
    return pd.concat(parts, ignore_index=True)


def worlds(rows: pd.DataFrame) -> Iterator[tuple[tuple[str, int, int], World]]:
    """The episodes in rows of `rows_of` with the columns `agent` and `seed`: agent, seed and number
    of each, and its drones.
    """
    for (agent, seed, episode), own in rows.groupby(["agent", "seed", "episode"], observed=True):
        shape = int(own["step"].max()) + 1, int(own["drone"].max()) + 1, 6
        told = np.full(shape, np.nan)
        told[own["step"], own["drone"]] = own[[*POSITION, *GOAL]]
        yield (str(agent), int(seed), int(episode)), World(told[..., :3], told[..., 3:])


def distance_curves(rows: pd.DataFrame, control_period: float) -> dict[str, Spread]:
    """Least distance between two drones over the time in an episode (s), by agent: interquartile
    mean, lowest and highest of the episodes of all seeds that still have two.
    """
    found: dict[str, list[Floats]] = {}
    for (agent, _, _), world in worlds(rows):
        found.setdefault(agent, []).append(least(world.position))
    curves = {}
    for agent, ones in found.items():
        table = np.full((len(ones), max(map(len, ones))), np.nan)
        for row, one in zip(table, ones, strict=True):
            row[: len(one)] = one
        kept = np.flatnonzero(np.isfinite(table).any(axis=0))
        if len(kept):
            shown, x = table[:, kept], np.asarray(kept * control_period, float)
            middle = np.array([iqm(column) for column in shown.T])
            curves[agent] = Spread(x, middle, np.nanmin(shown, axis=0), np.nanmax(shown, axis=0))
    return curves


def least_distances(rows: pd.DataFrame) -> pd.DataFrame:
    """Of each agent (the index) the least distance of a seed's evaluation, m: `least_distance`, the
    interquartile mean over seeds, and `_low` and `_high` of its 95 % interval.
    """
    found: dict[tuple[str, int], float] = {}
    for (agent, seed, _), world in worlds(rows):
        values = least(world.position)
        lowest = float(np.min(values[np.isfinite(values)], initial=np.inf))
        found[agent, seed] = min(found.get((agent, seed), np.inf), lowest)
    own = pd.Series(found).replace(np.inf, np.nan)
    table = {}
    for agent, seeds in own.groupby(level=0):
        low, high = bootstrap_interval(seeds)
        table[agent] = dict(zip(LEAST, (iqm(seeds), low, high), strict=True))
    return pd.DataFrame.from_dict(table, orient="index")


LEAST: Final = ("least_distance", "least_distance_low", "least_distance_high")
"""Columns of `least_distances`."""
