"""Logs of real flights: CSV, Parquet and ULog files on a uniform grid of times."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import pandas
from numpy.typing import NDArray
from rotorgram.models import InputError
from rotorgram.models.errors import one_line
from rotorgram.models.fields import immutable
from rotorgram.models.files import read_own_toml
from rotorgram.models.vehicle import Vehicle
from scipy.signal import lfilter

Floats = NDArray[np.float64]
Ints = NDArray[np.int_]
Columns = Mapping[str, NDArray[np.generic]]
"""Columns of a file by name, each of shape (N,)."""

MOTION = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz")
"""Columns that a log must have besides the time t, s: position, m, and velocity, m/s, world frame
with z up; quaternion from body to world; body rates, rad/s, in a body frame x forward, y left,
z up."""
SPEED = "m{}_rads"
SPEED_COMMAND = "m{}_command_rads"
THROTTLE = "m{}_throttle"
"""Columns of rotor 1, 2...: measured speed and commanded speed, rad/s, and throttle, 0 to 1, which
is the share of the largest thrust. A log has at least one of the three; the first of them
counts."""
_KINDS = (SPEED, SPEED_COMMAND, THROTTLE)
_ATTITUDES = slice(4, 8)  # of the columns t and `MOTION`
_LONGEST_GAP = 0.1  # s: longer gaps are not interpolated
_POSITION_ERROR = 0.5  # m: between two samples, besides the distance by the velocity
_ATTITUDE_ERROR = 0.5  # rad: the same for the attitude
_MOST_LEFT_OUT = 0.01  # share of the samples
_FASTEST = 5.0  # rotor speed, as a multiple of that at the largest thrust


@immutable
class FlightLog:
    """A recorded flight on a uniform grid of N times."""

    name: str
    period: float
    """Time between two samples, s."""
    states: Floats
    """The columns of `MOTION`, shape (N, 13)."""
    speeds: Floats
    """Of the rotors in the vehicle's order, rad/s, shape (N, R): measured, or else commanded."""
    measured: bool = True
    """Whether the speeds were measured."""
    left_out: int = 0
    """Samples that contradicted their neighbours and were left out."""


def read_log(path: Path | str, vehicle: Vehicle, period: float = 0.01) -> FlightLog:
    """A log of a vehicle, resampled to `period`, s, by linear interpolation.

    Single samples whose position or attitude contradicts the velocity or the rates are left out.

    Raises `InputError` for a file that lacks a column, has gaps, jumps or numbers that are not
    finite.
    """
    path = Path(path)
    table = _table(path)
    try:
        return _flight(path.stem, table, vehicle, period)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None


def _flight(name: str, table: Columns, vehicle: Vehicle, period: float) -> FlightLog:
    kind, samples = _samples(table, vehicle.num_rotors)
    if not np.isfinite(samples).all():
        _refuse("finite numbers", "others")
    first = 1 + len(MOTION)  # column of the rotors
    samples[:, _ATTITUDES] = _without_flips(samples[:, _ATTITUDES])
    if kind == THROTTLE:
        samples[:, first:] = _commanded_speeds(samples[:, first:], vehicle)
    _check_speeds(vehicle, samples[:, first:])
    latest = np.maximum.accumulate(samples[:, 0])
    samples = samples[np.diff(latest, prepend=-np.inf) > 0]
    consistent = _consistent(samples)
    grid = _grid(consistent[:, 0], period)
    columns = [np.interp(grid, consistent[:, 0], column) for column in consistent.T]
    _, states, speeds = np.split(np.stack(columns, axis=1), (1, first), axis=1)
    length = np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
    if not (length > 0.5).all():
        _refuse("quaternions of length 1", f"{length.min():.3g}")
    states[:, 3:7] /= length
    return FlightLog(
        name=name,
        period=period,
        states=states,
        speeds=speeds,
        measured=kind == SPEED,
        left_out=len(samples) - len(consistent),
    )


def with_lag(log: FlightLog, time_constant: float) -> FlightLog:
    """The flight with speeds that follow its own, as commands, with a first-order lag, s.

    They begin at the first command; a command holds until the next sample.
    """
    decay = float(np.exp(-log.period / time_constant))
    first = log.speeds[:1]
    held = np.concatenate((first, log.speeds[:-1]))
    speeds, _ = lfilter([1 - decay], [1, -decay], held, axis=0, zi=decay * first)
    return replace(log, speeds=speeds)


def _refuse(expected: str, got: str) -> NoReturn:
    raise InputError(f"expected {expected}, got {got}")


# ---- columns


def _samples(table: Columns, rotors: int) -> tuple[str, Floats]:
    """The kind of the rotors' columns; t, `MOTION` and these columns, shape (N, 14 + R)."""
    numbers = range(1, rotors + 1)
    given = [kind for kind in _KINDS if table.keys() >= {kind.format(i) for i in numbers}]
    if not given:
        names = " or ".join(kind.format(f"1...{rotors}") for kind in _KINDS)
        _refuse(f"columns {names}", "none")
    columns = []
    for name in ("t", *MOTION, *(given[0].format(i) for i in numbers)):
        if name not in table:
            _refuse(f"a column {name}", ", ".join(table))
        try:
            columns.append(np.array(table[name], np.float64))
        except (TypeError, ValueError):
            _refuse(f"numbers in {name}", "others")
    return given[0], np.stack(columns, axis=1)


def _table(path: Path) -> Columns:
    kind = path.suffix.lower()
    if kind == ".ulg":
        return _ulog(path)
    if kind not in (".csv", ".parquet"):
        raise InputError(f"log: expected a .csv, .parquet or .ulg file, got {path.name}")
    try:
        frame = pandas.read_csv(path) if kind == ".csv" else pandas.read_parquet(path)
    except ValueError as error:  # of pandas and pyarrow
        raise InputError(
            f"log: expected a {kind} file, got {path.name}: {one_line(error):.80}"
        ) from None
    return {str(name): frame[name].to_numpy() for name in frame}


def _commanded_speeds(throttle: Floats, vehicle: Vehicle) -> Floats:
    """Speeds at which the vehicle as it is gives the commanded share of its largest thrust."""
    low = throttle.min(initial=0.0)
    high = throttle.max(initial=0.0)
    if low <= -0.01 or high >= 1.01:
        _refuse("throttle from 0 to 1", f"{low:.3g} to {high:.3g}")
    (coefficient,) = vehicle.coefficients.need("rotors.thrust_coefficient", "a log of commands")
    thrust = np.clip(throttle, 0.0, 1.0) * vehicle.thrust_high
    speeds: Floats = np.sqrt(thrust / coefficient)
    return speeds


def _check_speeds(vehicle: Vehicle, speeds: Floats) -> None:
    """Refuse speeds that no such rotor reaches."""
    coefficient = vehicle.coefficients["rotors.thrust_coefficient"]
    if coefficient is None:
        return
    most = _FASTEST * float(np.sqrt(vehicle.thrust_high.max() / coefficient))
    fastest = float(np.abs(speeds).max(initial=0.0))
    if fastest > most:
        _refuse(f"rotor speeds of at most {most:.4g} rad/s", f"{fastest:.4g}")


def _without_flips(quaternions: Floats) -> Floats:
    """The same attitudes, shape (N, 4), each quaternion on the side of the one before."""
    cosine = (quaternions[1:] * quaternions[:-1]).sum(axis=1)
    signs = np.cumprod(np.where(cosine < 0, -1.0, 1.0))
    return np.concatenate((quaternions[:1], quaternions[1:] * signs[:, None]))


# ---- samples


def _consistent(samples: Floats) -> Floats:
    """The samples without single ones that contradict the samples before and after."""
    if len(samples) < 2:
        _refuse("two or more samples", str(len(samples)))
    rule = "positions and attitudes that agree with velocities and rates"
    bad = ~_agree(samples)
    alone = np.append(bad, True) & np.insert(bad, 0, True)
    most = max(1, int(_MOST_LEFT_OUT * len(samples)))
    if alone.sum() > most:
        _refuse(rule, f"more than {most} samples that do not")
    consistent = samples[~alone]
    jumps = consistent[1:][~_agree(consistent)]
    if len(jumps):
        _refuse(rule, f"a jump at {jumps[0, 0]:.6g} s")
    return consistent


def _agree(samples: Floats) -> NDArray[np.bool_]:
    """Whether each sample but the first follows from the one before by the mean rates of both."""
    attitudes = samples[:, _ATTITUDES]
    with np.errstate(all="ignore"):
        mean = 0.5 * (samples[1:] + samples[:-1])
        step = np.diff(samples, axis=0)
        distance = np.linalg.norm(step[:, 1:4] - mean[:, 8:11] * step[:, :1], axis=1)
        turned = np.linalg.norm(mean[:, 11:14], axis=1) * step[:, 0]
        cosine = np.abs((attitudes[1:] * attitudes[:-1]).sum(axis=1))
        angle = 2 * np.arccos(np.clip(cosine, 0.0, 1.0))
        is_near = distance <= _POSITION_ERROR
        is_turned = np.abs(angle - turned) <= _ATTITUDE_ERROR
    agree: NDArray[np.bool_] = is_near & is_turned
    return agree


def _grid(times: Floats, period: float) -> Floats:
    """Uniform times from the first sample on. Raises `InputError` for a gap."""
    gap = float(np.diff(times).max())
    if gap > _LONGEST_GAP:
        _refuse(f"no gap of more than {_LONGEST_GAP:g} s", f"{gap:.3g} s")
    steps = int(np.floor((times[-1] - times[0]) / period + 1e-6))
    uniform: Floats = times[0] + period * np.arange(steps + 1)
    return uniform


# ---- PX4

_PX4 = read_own_toml(__file__, "px4")
"""Topic, field and factor of each of our columns, in our frames."""
_ATTITUDE = "vehicle_attitude"
_RATES = "vehicle_angular_velocity"
_TOPICS = ("vehicle_local_position", _ATTITUDE, _RATES)


def _ulog(path: Path) -> Columns:
    """Columns of a PX4 log in our frames: world north, west, up; body forward, left, up."""
    import pyulog  # for these files alone

    try:
        with path.open("rb") as file:
            log = pyulog.ULog(file)
    except (TypeError, ValueError, LookupError, pyulog.exceptions.ULogException) as error:
        raise InputError(f"log: expected a ULog file, got {path.name}: {error}") from None
    topics = {topic.name: topic.data for topic in reversed(log.data_list)}
    for topic in _TOPICS:
        if topic not in topics:
            got = ", ".join(sorted(topics))
            raise InputError(f"{path.name}: expected the topic {topic}, got {got}")
    used = topics.keys() & {topic for topic, _, _ in _PX4.values()}
    times = {topic: topics[topic]["timestamp"].astype(np.float64) for topic in used}
    first = max(own[0] for own in times.values())
    last = min(own[-1] for own in times.values())
    base = times[_RATES]
    base = base[(base >= first) & (base <= last)]
    attitude = topics[_ATTITUDE]
    names = [f"q[{i}]" for i in range(4)]
    smooth = _without_flips(np.stack([attitude[name] for name in names], axis=1))
    attitude |= zip(names, smooth.T, strict=True)
    columns = {"t": (base - base[:1]) * 1e-6}
    for name, (topic, field, factor) in _PX4.items():
        if topic in used and field in topics[topic]:
            values = topics[topic][field].astype(np.float64)
            columns[name] = factor * np.interp(base, times[topic], values)
    return columns
