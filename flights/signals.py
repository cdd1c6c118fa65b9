"""Signals of a flight over time, z up and in SI units, and their table as CSV."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..envs.spec import Discrete, component_names, component_units
from ..models.files import write_whole
from .trajectories import Floats, Trajectory

QUATERNION = ("qw", "qx", "qy", "qz")


class Column(NamedTuple):
    """One number of flights over time."""

    name: str
    unit: str
    values: np.ndarray
    """Shape (T + 1,)."""


class Signal(NamedTuple):
    """An array of a flight's telemetry, its actions or its rewards."""

    name: str
    components: tuple[str, ...]
    """A name for each number."""
    units: tuple[str, ...]
    """A unit for each number; empty for pure numbers."""
    values: Floats
    """Shape (T + 1, n); nan where a row has none."""

    def columns(self) -> list[Column]:
        """Each number by itself."""
        return list(map(Column, self.components, self.units, self.values.T))


def telemetry_of(flight: Trajectory) -> list[Signal]:
    """All telemetry."""
    signals = []
    for array in flight.spec.telemetry:
        values = flight.telemetry[array.name].reshape(len(flight) + 1, -1)
        signals.append(Signal(array.name, component_names(array), component_units(array), values))
    return signals


def signals_of(flight: Trajectory) -> list[Signal]:
    """All telemetry, then the actions and the rewards.

    An action stands in the row from which it is flown, a reward in the row to which it leads.
    """
    action = flight.spec.action
    actions = np.asarray(flight.actions, np.float64).reshape(len(flight), -1)
    missing = np.full((1, actions.shape[1]), np.nan)
    names = ("choice",) if isinstance(action, Discrete) else component_names(action)
    units = ("",) if isinstance(action, Discrete) else component_units(action)
    components = tuple(f"action_{name}" for name in names)
    rewards = np.concatenate(([np.nan], flight.rewards))
    return [
        *telemetry_of(flight),
        Signal("action", components, units, np.concatenate((actions, missing))),
        Signal("reward", ("reward",), ("",), rewards[:, None]),
    ]


def columns_of(flight: Trajectory) -> list[Column]:
    """The time, the numbers of episode and drone, and every number of the signals."""
    rows = len(flight) + 1
    columns = [
        Column("time", "s", flight.times),
        Column("episode", "", np.full(rows, flight.episode)),
        Column("drone", "", np.full(rows, flight.drone)),
    ]
    for signal in signals_of(flight):
        columns += signal.columns()
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
