"""Signals of a flight over time, z up and in SI units, and their table as CSV or Parquet."""

import csv
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..envs.spec import ArraySpec, Discrete, component_names
from ..models.errors import require
from ..models.files import write_new
from .trajectories import Trajectory

Floats = NDArray[np.float64]

QUATERNION: Final = ("qw", "qx", "qy", "qz")


class Signal(NamedTuple):
    """An array of a flight's telemetry, its actions or its rewards."""

    name: str
    components: tuple[str, ...]
    """A name for each number."""
    units: tuple[str, ...]
    """A unit for each number; empty for pure numbers."""
    values: Floats
    """Shape (T + 1, n); nan where a row has none."""


class Column(NamedTuple):
    """One number of a flight over time."""

    name: str
    unit: str
    values: Floats | NDArray[np.int_]
    """Shape (T + 1,)."""


def signals_of(flight: Trajectory) -> list[Signal]:
    """All telemetry, then the actions and the rewards.

    An action stands in the row from which it is flown, a reward in the row to which it leads.
    """
    signals = [_telemetry(flight, array) for array in flight.spec.telemetry]
    action = flight.spec.action
    actions = np.asarray(flight.actions, np.float64).reshape(len(flight), -1)
    missing = np.full((1, actions.shape[1]), np.nan)
    names = ("choice",) if isinstance(action, Discrete) else component_names(action)
    units = ("",) if isinstance(action, Discrete) else _units(action)
    components = tuple(f"action_{name}" for name in names)
    signals.append(Signal("action", components, units, np.concatenate((actions, missing))))
    rewards = np.concatenate(([np.nan], flight.rewards))
    signals.append(Signal("reward", ("reward",), ("",), rewards[:, None]))
    return signals


def _telemetry(flight: Trajectory, array: ArraySpec) -> Signal:
    values = flight.telemetry[array.name].reshape(len(flight) + 1, -1)
    return Signal(array.name, component_names(array), _units(array), values)


def _units(array: ArraySpec) -> tuple[str, ...]:
    units = array.unit if isinstance(array.unit, tuple) else (array.unit,) * array.size
    return tuple("" if unit == "1" else unit for unit in units)


def columns_of(flight: Trajectory) -> Iterator[Column]:
    """The time, the numbers of episode and drone, and every number of the signals."""
    rows = len(flight) + 1
    yield Column("time", "s", flight.times)
    yield Column("episode", "", np.full(rows, flight.episode))
    yield Column("drone", "", np.full(rows, flight.drone))
    for signal in signals_of(flight):
        columns = zip(signal.components, signal.units, signal.values.T, strict=True)
        for name, unit, values in columns:
            yield Column(name, unit, values)


def write_csv(flights: Sequence[Trajectory], out: Path) -> int:
    """Write flights of one spec below each other; the number of rows.

    The head has names and units, as `x [m]`. Numbers have all their digits; a missing one is empty.
    """
    rows = 0
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for flight in flights:
        columns = list(columns_of(flight))
        if not rows:
            writer.writerow([f"{c.name} [{c.unit}]" if c.unit else c.name for c in columns])
        numbers = (column.values.tolist() for column in columns)
        for row in zip(*numbers, strict=True):
            writer.writerow(["" if math.isnan(value) else value for value in row])
            rows += 1
    write_new(out, text.getvalue())
    return rows


def write_parquet_log(flights: Sequence[Trajectory], out: Path) -> int:
    """Write flights of one spec below each other; the number of rows.

    A column's metadata has its `unit`.
    """
    require("pyarrow", "dataset", "a log as Parquet")
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables = []
    for flight in flights:
        columns = list(columns_of(flight))
        arrays = [pa.array(column.values, from_pandas=True) for column in columns]
        schema = pa.schema(
            pa.field(column.name, array.type, metadata={"unit": column.unit})
            for column, array in zip(columns, arrays, strict=True)
        )
        tables.append(pa.Table.from_arrays(arrays, schema=schema))
    table = pa.concat_tables(tables)
    file = pa.BufferOutputStream()
    pq.write_table(table, file)
    write_new(out, file.getvalue().to_pybytes())
    return int(table.num_rows)
