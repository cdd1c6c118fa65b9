"""Numbers of a flight over time, z up and in SI units, and their table as CSV."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..envs.spec import ArraySpec, Discrete, component_names, component_units
from ..models.files import write_whole
from .trajectories import Trajectory

QUATERNION = ("qw", "qx", "qy", "qz")


class Column(NamedTuple):
    """One number of flights over time."""

    name: str
    unit: str
    values: np.ndarray
    """Shape (T + 1,)."""


def columns_of_array(array: ArraySpec, values: np.ndarray) -> list[Column]:
    """The numbers of an array, each by itself; `values` have shape (T + 1, *shape)."""
    numbers = values.reshape(len(values), -1).T
    return list(map(Column, component_names(array), component_units(array), numbers))


def columns_of(flight: Trajectory) -> list[Column]:
    """The time, the numbers of episode and drone, the telemetry, the action and the reward.

    An action stands in the row from which it is flown, a reward in the row to which it leads; nan
    where a row has none.
    """
    spec = flight.spec
    rows = len(flight) + 1
    columns = [
        Column("time", "s", flight.times),
        Column("episode", "", np.full(rows, flight.episode)),
        Column("drone", "", np.full(rows, flight.drone)),
    ]
    for array in spec.telemetry:
        columns += columns_of_array(array, flight.telemetry[array.name])
    action = spec.action
    if isinstance(action, Discrete):
        action = ArraySpec(name="choice", shape=(1,))
    actions = np.full((rows, action.size), np.nan)
    actions[:-1] = flight.actions.reshape(len(flight), -1)
    for name, unit, values in columns_of_array(action, actions):
        columns.append(Column(f"action_{name}", unit, values))
    columns.append(Column("reward", "", np.concatenate(([np.nan], flight.rewards))))
    return columns


def write_csv(flights: Sequence[Trajectory], out: Path) -> int:
    """Write flights of one spec below each other; the number of rows.

    The head has names and units, as `x [m]`. Numbers have all their digits; a missing one is empty.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    count = 0
    for flight in flights:
        columns = columns_of(flight)
        if not count:
            writer.writerow([f"{c.name} [{c.unit}]" if c.unit else c.name for c in columns])
        for row in zip(*(column.values.tolist() for column in columns), strict=True):
            writer.writerow(["" if math.isnan(value) else value for value in row])
        count += len(flight) + 1
    write_whole(out, text.getvalue())
    return count
