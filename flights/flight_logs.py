"""Logs of flights: CSV, Parquet and ULog files as `Flight`s on a uniform grid of times."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..models.errors import expect, require
from ..models.vehicle import Vehicle
from .prediction import Flight, Floats

MOTION: Final = ("t", *"xyz", *(f"q{a}" for a in "wxyz"), *(f"v{a}" for a in "xyz"),
                 *(f"w{a}" for a in "xyz"))  # fmt: skip
"""Columns that a log must have: time, s; position, m, and velocity, m/s, world frame with z up;
quaternion from body to world; body rates, rad/s, in a body frame x forward, y left, z up."""
SPEED, SPEED_COMMAND, THROTTLE = "m{}_rads", "m{}_command_rads", "m{}_throttle"
"""Columns of rotor 1, 2...: measured speed and commanded speed, rad/s, and throttle, 0 to 1, which
is the share of the largest thrust. A log has the first, or one of the others, or both."""
_LONGEST_GAP: Final = 0.1  # s: over more than that nothing is interpolated


@dataclass(frozen=True, kw_only=True)
class Log:
    """A flight, and what its rotors were told."""

    flight: Flight
    """Its `speeds` are those measured, or else those commanded."""
    measured: bool
    """Whether the speeds were measured."""
    commands: Floats | None
    """Commanded speeds, rad/s, shape (N, R); None: the log has none."""


def read_log(
    path: Path | str,
    vehicle: Vehicle,
    columns: Mapping[str, str] | None = None,
    period: float = 0.01,
) -> Log:
    """A log of a vehicle, resampled to `period`, s, by linear interpolation.

    `columns` has the file's name for a column of ours: "pos_x", or with a factor "rpm1*0.10472".
    Raises `InputError` for a file that lacks a column, has gaps or numbers that are not finite.
    """
    path, given = Path(path), dict(columns or {})
    count = vehicle.num_rotors
    known = [*MOTION, *(k.format(i + 1) for k in (SPEED, SPEED_COMMAND, THROTTLE)
                        for i in range(count))]  # fmt: skip
    for name in given:
        expect(name in known, "columns", f"some of {', '.join(known)}", repr(name))
    table = _table(path)
    wanted = {name: _column(table, given.get(name, name), path) for name in known}
    for name in MOTION:
        got = ", ".join(map(str, table))
        expect(wanted[name] is not None, path.name, f"a column {given.get(name, name)}", got)
    kinds = [
        [wanted[kind.format(i + 1)] for i in range(count)]
        for kind in (SPEED, SPEED_COMMAND, THROTTLE)
    ]
    speeds, commands, throttle = (None if any(c is None for c in kind) else kind for kind in kinds)
    names = " or ".join(kind.format(f"1...{count}") for kind in (SPEED, SPEED_COMMAND, THROTTLE))
    some = speeds is not None or commands is not None or throttle is not None
    expect(some, path.name, f"columns {names}", "none")
    data: Any = {name: wanted[name] for name in MOTION}
    grid, row = _grid(data["t"], period, path)

    def resampled(arrays: Any) -> Floats:
        table = np.stack([array[row] for array in arrays], axis=1)
        expect(np.isfinite(table).all(), path.name, "finite numbers", "others")
        times = data["t"][row]
        return np.stack([np.interp(grid, times, array) for array in table.T], axis=1)

    quaternion = np.stack([data[f"q{a}"] for a in "wxyz"], axis=1)
    signs = np.cumprod(np.where((quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    quaternion[1:] *= signs[:, None]
    quaternion = resampled(quaternion.T)
    size = np.linalg.norm(quaternion, axis=1, keepdims=True)
    expect((size > 0.5).all(), path.name, "quaternions of length 1", f"{size.min():.3g}")
    told = None
    if commands is not None:
        told = resampled(commands)
    elif throttle is not None:
        told = _commanded_speeds(resampled(throttle), vehicle, path)
    flown = told if speeds is None else resampled(speeds)
    assert flown is not None
    flight = Flight(
        name=path.stem,
        period=period,
        position=resampled([data[a] for a in "xyz"]),
        quaternion=quaternion / size,
        velocity=resampled([data[f"v{a}"] for a in "xyz"]),
        body_rates=resampled([data[f"w{a}"] for a in "xyz"]),
        speeds=flown,
    )
    return Log(flight=flight, measured=speeds is not None, commands=told)


def with_lag(log: Log, time_constant: float) -> Flight:
    """The flight with speeds that follow the commands with a first-order lag, s.

    They begin at the first command; a command holds until the next sample.
    """
    assert log.commands is not None
    from scipy.signal import lfilter

    decay = float(np.exp(-log.flight.period / time_constant))
    first = log.commands[:1]
    held = np.concatenate((first, log.commands[:-1]))
    speeds, _ = lfilter([1 - decay], [1, -decay], held, axis=0, zi=decay * first)
    return replace(log.flight, speeds=speeds)


def _table(path: Path) -> Mapping[str, Any]:
    kind = path.suffix.lower()
    expect(kind in (".csv", ".parquet", ".ulg"), "log", "a .csv, .parquet or .ulg file", path.name)
    if kind == ".ulg":
        return _ulog(path)
    pandas = require("pandas", "identify", "reading a log")
    if kind == ".parquet":
        require("pyarrow", "identify", "reading a Parquet file")
    try:
        frame = pandas.read_csv(path) if kind == ".csv" else pandas.read_parquet(path)
    except ValueError as error:  # of pandas and pyarrow
        expect(False, "log", f"a {kind} file", f"{path.name}: {' '.join(str(error).split()):.80}")
    return {str(name): frame[name].to_numpy() for name in frame}


def _column(table: Mapping[str, Any], text: str, path: Path) -> Floats | None:
    """A column, times a factor that may follow its name; None: there is none."""
    name, star, factor = text.rpartition("*") if text not in table else (text, "", "")
    name = name.strip() if star else text
    if name not in table:
        return None
    try:
        return np.array(table[name], float) * (float(factor) if star else 1.0)
    except (TypeError, ValueError):
        expect(False, "columns", f"numbers in {name} of {path.name} and as its factor", repr(text))
        return None


def _grid(times: Floats, period: float, path: Path) -> tuple[Floats, Any]:
    """Uniform times, and the samples of a log to interpolate between: those with a later time."""
    expect(np.isfinite(times).all(), path.name, "finite times", "others")
    later = np.concatenate(([True], times[1:] > np.maximum.accumulate(times)[:-1]))
    kept = times[later]
    expect(len(kept) > 1, path.name, "two or more samples", str(len(kept)))
    gap = float(np.diff(kept).max())
    expect(
        gap <= _LONGEST_GAP, path.name, f"no gap of more than {_LONGEST_GAP:g} s", f"{gap:.3g} s"
    )
    steps = int(np.floor((kept[-1] - kept[0]) / period + 1e-6))
    return kept[0] + period * np.arange(steps + 1), later


def _commanded_speeds(throttle: Floats, vehicle: Vehicle, path: Path) -> Floats:
    """Speeds at which the vehicle as it is gives the commanded share of its largest thrust."""
    inside = bool((throttle > -0.01).all() and (throttle < 1.01).all())
    expect(
        inside, path.name, "throttle from 0 to 1", f"{throttle.min():.3g} to {throttle.max():.3g}"
    )
    (coefficient,) = vehicle.coefficients.need("rotors.thrust_coefficient", "a log of commands")
    thrust = np.clip(throttle, 0.0, 1.0) * vehicle.thrust_high
    speeds: Floats = np.sqrt(thrust / coefficient)
    return speeds


def _ulog(path: Path) -> Mapping[str, Any]:
    """Columns of a PX4 log. Its frames, north east down and forward right down, become ours.

    World axes are then north, west, up. Topics are interpolated at the times of the body rates.
    """
    pyulog = require("pyulog", "identify", "reading a ULog file")
    try:
        log = pyulog.ULog(str(path))
    except (TypeError, ValueError, IndexError, KeyError) as error:
        expect(False, "log", "a ULog file", f"{path.name}: {error}")
    topics = {one.name: one.data for one in reversed(log.data_list)}
    for topic in ("vehicle_local_position", "vehicle_attitude", "vehicle_angular_velocity"):
        expect(topic in topics, path.name, f"the topic {topic}", ", ".join(sorted(topics)))
    place, turn = topics["vehicle_local_position"], topics["vehicle_attitude"]
    rates = topics["vehicle_angular_velocity"]
    base = rates["timestamp"].astype(float)
    others = [place, turn, *(topics[name] for name in ("esc_status", "actuator_motors")
                             if name in topics)]  # fmt: skip
    first = max(float(one["timestamp"][0]) for one in others)
    last = min(float(one["timestamp"][-1]) for one in others)
    base = base[(base >= first) & (base <= last)]

    def at(topic: Any, name: str, sign: float = 1.0) -> Floats:
        times = topic["timestamp"].astype(float)
        return np.asarray(sign * np.interp(base, times, topic[name].astype(float)))

    q = np.stack([turn[f"q[{i}]"].astype(float) for i in range(4)], axis=1)
    signs = np.cumprod(np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    q[1:] *= signs[:, None]
    spun = {"timestamp": turn["timestamp"], **{f"q{i}": q[:, i] for i in range(4)}}
    columns = {"t": (base - base[0]) * 1e-6} if len(base) else {"t": base}
    for axis, sign in zip("xyz", (1.0, -1.0, -1.0), strict=True):
        columns[axis] = at(place, axis, sign)
        columns[f"v{axis}"] = at(place, f"v{axis}", sign)
        columns[f"w{axis}"] = at(rates, f"xyz[{'xyz'.index(axis)}]", sign)
    for i, (axis, sign) in enumerate(zip("wxyz", (1.0, 1.0, -1.0, -1.0), strict=True)):
        columns[f"q{axis}"] = at(spun, f"q{i}", sign)
    for i in range(12):
        name = f"esc[{i}].esc_rpm"
        if name in topics.get("esc_status", {}):
            columns[SPEED.format(i + 1)] = at(topics["esc_status"], name, 2 * np.pi / 60)
        name = f"control[{i}]"
        if name in topics.get("actuator_motors", {}):
            columns[THROTTLE.format(i + 1)] = at(topics["actuator_motors"], name)
    return columns
