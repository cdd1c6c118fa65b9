"""Logs of real flights: CSV, Parquet and ULog files on a uniform grid of times."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError, require
from ..models.vehicle import Vehicle

Floats = NDArray[np.float64]
Columns = Mapping[str, NDArray[Any]]
"""Columns of a file by name, each of shape (N,)."""

MOTION: Final = ("t", *"xyz", *(f"q{a}" for a in "wxyz"), *(f"v{a}" for a in "xyz"),
                 *(f"w{a}" for a in "xyz"))  # fmt: skip
"""Columns that a log must have: time, s; position, m, and velocity, m/s, world frame with z up;
quaternion from body to world; body rates, rad/s, in a body frame x forward, y left, z up."""
SPEED = "m{}_rads"
SPEED_COMMAND = "m{}_command_rads"
THROTTLE = "m{}_throttle"
"""Columns of rotor 1, 2...: measured speed and commanded speed, rad/s, and throttle, 0 to 1, which
is the share of the largest thrust. A log has measured speeds, or one of the commands, or both."""
_KINDS: Final = (SPEED, SPEED_COMMAND, THROTTLE)
_LONGEST_GAP: Final = 0.1  # s: longer gaps are not interpolated
_POSITION_ERROR: Final = 0.5  # m: between two samples, besides the distance by the velocity
_ATTITUDE_ERROR: Final = 0.5  # rad: the same for the attitude
_MAX_LEFT_OUT: Final = 0.01  # share of the samples
_FASTEST: Final = 5.0  # rotor speed, as a multiple of that at the largest thrust


@dataclass(frozen=True, kw_only=True)
class FlightLog:
    """A recorded flight on a uniform grid of N times. Arrays have the time as their first axis."""

    name: str
    period: float
    """Time between two samples, s."""
    position: Floats
    """Of the body's origin, world frame, m, shape (N, 3)."""
    quaternion: Floats
    """From body to world, scalar first, shape (N, 4)."""
    velocity: Floats
    """Of the body's origin, world frame, m/s, shape (N, 3)."""
    body_rates: Floats
    """Body frame, rad/s, shape (N, 3)."""
    speeds: Floats
    """Of the rotors in the vehicle's order, rad/s, shape (N, R): measured, or else commanded."""
    measured: bool = True
    """Whether the speeds were measured."""
    commands: Floats | None = None
    """Commanded speeds, rad/s, shape (N, R); None: the log has none."""
    left_out: int = 0
    """Samples that contradicted their neighbours and were left out."""


def read_log(
    path: Path | str,
    vehicle: Vehicle,
    columns: Mapping[str, str] | None = None,
    period: float = 0.01,
) -> FlightLog:
    """A log of a vehicle, resampled to `period`, s, by linear interpolation.

    `columns` has the file's name for a column of ours: "pos_x", or with a factor "rpm1*0.10472".
    Single samples whose position or attitude contradicts the velocity or the rates are left out.

    Raises `InputError` for a file that lacks a column, has gaps, jumps or numbers that are not
    finite.
    """
    path = Path(path)
    raw = _Raw.read(path, vehicle, columns or {})
    raw.check_speeds(vehicle)
    row = raw.consistent_rows()
    grid = raw.grid(row, period)
    quaternion = raw.resampled(raw.quaternions.T, row, grid)
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    if not (length > 0.5).all():
        _refuse(path, "quaternions of length 1", f"{length.min():.3g}")
    commands = None
    if raw.commands is not None:
        commands = raw.resampled(raw.commands, row, grid)
    elif raw.throttle is not None:
        throttle = raw.resampled(raw.throttle, row, grid)
        commands = _commanded_speeds(throttle, vehicle, path)
    speeds = commands if raw.speeds is None else raw.resampled(raw.speeds, row, grid)
    assert speeds is not None  # `_Raw.read` refuses a log without any
    return FlightLog(
        name=path.stem,
        period=period,
        position=raw.resampled(raw.motion("xyz"), row, grid),
        quaternion=quaternion / length,
        velocity=raw.resampled(raw.motion(["vx", "vy", "vz"]), row, grid),
        body_rates=raw.resampled(raw.motion(["wx", "wy", "wz"]), row, grid),
        speeds=speeds,
        measured=raw.speeds is not None,
        commands=commands,
        left_out=raw.left_out,
    )


def with_lag(log: FlightLog, time_constant: float) -> FlightLog:
    """The flight with speeds that follow the commands with a first-order lag, s.

    They begin at the first command; a command holds until the next sample.
    """
    assert log.commands is not None
    from scipy.signal import lfilter

    decay = float(np.exp(-log.period / time_constant))
    first = log.commands[:1]
    held = np.concatenate((first, log.commands[:-1]))
    speeds, _ = lfilter([1 - decay], [1, -decay], held, axis=0, zi=decay * first)
    return replace(log, speeds=speeds)


def _refuse(path: Path, expected: str, got: str) -> NoReturn:
    raise InputError(f"{path.name}: expected {expected}, got {got}")


class _Raw:
    """The columns of a log at its own times.

    Attributes:
        speeds, commands, throttle: One array for each rotor, or None where the log lacks them.
        quaternions: Without changes of sign, shape (N, 4).
        left_out: Samples that `consistent_rows` has left out.
    """

    def __init__(self, path: Path, columns: Mapping[str, Floats | None], rotors: int) -> None:
        self.path = path
        self.left_out = 0
        self._columns = columns
        self.speeds, self.commands, self.throttle = (
            self._of_rotors(kind, rotors) for kind in _KINDS
        )
        quaternions = np.stack(self.motion(["qw", "qx", "qy", "qz"]), axis=1)
        self.quaternions = _without_flips(quaternions)

    @classmethod
    def read(cls, path: Path, vehicle: Vehicle, given: Mapping[str, str]) -> "_Raw":
        """Read a file. Raises `InputError`."""
        rotors = vehicle.num_rotors
        known = list(MOTION)
        for kind in _KINDS:
            known += [kind.format(number) for number in range(1, rotors + 1)]
        for name in given:
            if name not in known:
                raise InputError(f"columns: expected some of {', '.join(known)}, got {name!r}")
        table = _table(path)
        columns = {name: _column(table, given.get(name, name), path) for name in known}
        for name in MOTION:
            if columns[name] is None:
                _refuse(path, f"a column {given.get(name, name)}", ", ".join(map(str, table)))
        raw = cls(path, columns, rotors)
        if raw.speeds is None and raw.commands is None and raw.throttle is None:
            names = " or ".join(kind.format(f"1...{rotors}") for kind in _KINDS)
            _refuse(path, f"columns {names}", "none")
        return raw

    def motion(self, names: Sequence[str]) -> list[Floats]:
        """Columns of the motion."""
        columns = [self._columns[name] for name in names]
        return [column for column in columns if column is not None]

    def _of_rotors(self, kind: str, rotors: int) -> list[Floats] | None:
        columns = self.motion([kind.format(number) for number in range(1, rotors + 1)])
        return columns if len(columns) == rotors else None

    def check_speeds(self, vehicle: Vehicle) -> None:
        """Refuse speeds that no such rotor reaches."""
        coefficient = vehicle.coefficients.rotors.thrust_coefficient
        if coefficient is None:
            return
        most = _FASTEST * float(np.sqrt(vehicle.thrust_high.max() / coefficient))
        for columns in (self.speeds, self.commands):
            if columns is None:
                continue
            fastest = float(np.abs(columns).max(initial=0.0))
            if fastest > most:
                _refuse(self.path, f"rotor speeds of at most {most:.4g} rad/s", f"{fastest:.4g}")

    def consistent_rows(self) -> NDArray[np.int_]:
        """Samples with a later time than those before, without single impossible ones."""
        (times,) = self.motion("t")
        if len(times) < 2:
            _refuse(self.path, "two or more samples", str(len(times)))
        if not np.isfinite(times).all():
            _refuse(self.path, "finite times", "others")
        later = times[1:] > np.maximum.accumulate(times)[:-1]
        rows = np.flatnonzero(np.concatenate(([True], later)))
        for name in MOTION:
            if not np.isfinite(self.motion([name])[0][rows]).all():
                _refuse(self.path, f"finite numbers in {name}", "others")
        most = max(1, int(_MAX_LEFT_OUT * len(rows)))
        while len(bad := np.flatnonzero(~self._agree(rows[:-1], rows[1:]))):
            rows = self._without_one(rows, int(bad[0]))
            self.left_out += 1
            if self.left_out > most:
                _refuse(
                    self.path,
                    "positions and attitudes that agree with velocities and rates",
                    f"more than {most} samples that do not",
                )
        return rows

    def _without_one(self, rows: NDArray[np.int_], step: int) -> NDArray[np.int_]:
        """Without the one of two samples that do not agree which also contradicts the others."""
        for place in (step + 1, step):
            rest = np.delete(rows, place)
            around = rest[max(place - 1, 0) : place + 1]
            if len(around) < 2 or self._agree(around[:1], around[1:])[0]:
                return rest
        seconds = self.motion("t")[0][rows[step + 1]]
        _refuse(
            self.path,
            "positions and attitudes that agree with velocities and rates",
            f"a jump at {seconds:.6g} s",
        )

    def _agree(self, first: NDArray[np.int_], second: NDArray[np.int_]) -> NDArray[np.bool_]:
        """Whether the second of two samples follows from the first by the mean rates of both."""
        (times,) = self.motion("t")
        seconds = times[second] - times[first]
        with np.errstate(all="ignore"):
            squares = np.zeros(len(seconds))
            for axis in "xyz":
                place, speed = self.motion([axis, f"v{axis}"])
                moved = 0.5 * (speed[first] + speed[second]) * seconds
                squares += (place[second] - place[first] - moved) ** 2
            rates = np.stack(self.motion(["wx", "wy", "wz"]), axis=1)
            turned = 0.5 * np.linalg.norm(rates[first] + rates[second], axis=1) * seconds
            cosine = np.abs((self.quaternions[first] * self.quaternions[second]).sum(axis=1))
            angle = 2 * np.arccos(np.clip(cosine, 0.0, 1.0))
            near = np.sqrt(squares) <= _POSITION_ERROR
            level = np.abs(angle - turned) <= _ATTITUDE_ERROR
        agree: NDArray[np.bool_] = near & level
        return agree

    def grid(self, rows: NDArray[np.int_], period: float) -> Floats:
        """Uniform times from the first sample on. Raises `InputError` for a gap."""
        times = self.motion("t")[0][rows]
        if len(times) < 2:
            _refuse(self.path, "two or more samples", str(len(times)))
        gap = float(np.diff(times).max())
        if gap > _LONGEST_GAP:
            _refuse(self.path, f"no gap of more than {_LONGEST_GAP:g} s", f"{gap:.3g} s")
        steps = int(np.floor((times[-1] - times[0]) / period + 1e-6))
        uniform: Floats = times[0] + period * np.arange(steps + 1)
        return uniform

    def resampled(
        self, columns: Sequence[Floats] | Floats, rows: NDArray[np.int_], grid: Floats
    ) -> Floats:
        """Columns at other times, shape (N, k)."""
        times = self.motion("t")[0][rows]
        chosen = [column[rows] for column in columns]
        if not all(np.isfinite(column).all() for column in chosen):
            _refuse(self.path, "finite numbers", "others")
        return np.stack([np.interp(grid, times, column) for column in chosen], axis=1)


def _without_flips(quaternions: Floats) -> Floats:
    """The same attitudes, shape (N, 4), each quaternion on the side of the one before."""
    cosine = (quaternions[1:] * quaternions[:-1]).sum(axis=1)
    signs = np.cumprod(np.where(cosine < 0, -1.0, 1.0))
    flipped = quaternions.copy()
    flipped[1:] *= signs[:, None]
    return flipped


def _table(path: Path) -> Columns:
    kind = path.suffix.lower()
    if kind == ".ulg":
        return _ulog(path)
    if kind not in (".csv", ".parquet"):
        raise InputError(f"log: expected a .csv, .parquet or .ulg file, got {path.name}")
    pandas = require("pandas", "identify", "reading a log")
    if kind == ".parquet":
        require("pyarrow", "identify", "reading a Parquet file")
    try:
        frame = pandas.read_csv(path) if kind == ".csv" else pandas.read_parquet(path)
    except ValueError as error:  # of pandas and pyarrow
        reason = " ".join(str(error).split())
        raise InputError(f"log: expected a {kind} file, got {path.name}: {reason:.80}") from None
    return {str(name): frame[name].to_numpy() for name in frame}


def _column(table: Columns, text: str, path: Path) -> Floats | None:
    """A column, times a factor that may follow its name; None: there is none."""
    name = text
    factor = "1"
    if text not in table and "*" in text:
        name, _, factor = text.rpartition("*")
        name = name.strip()
    if name not in table:
        return None
    try:
        return np.array(table[name], np.float64) * float(factor)
    except (TypeError, ValueError):
        raise InputError(
            f"columns: expected numbers in {name} of {path.name} and as its factor, got {text!r}"
        ) from None


def _commanded_speeds(throttle: Floats, vehicle: Vehicle, path: Path) -> Floats:
    """Speeds at which the vehicle as it is gives the commanded share of its largest thrust."""
    low = float(throttle.min())
    high = float(throttle.max())
    if low <= -0.01 or high >= 1.01:
        _refuse(path, "throttle from 0 to 1", f"{low:.3g} to {high:.3g}")
    (coefficient,) = vehicle.coefficients.need("rotors.thrust_coefficient", "a log of commands")
    thrust = np.clip(throttle, 0.0, 1.0) * vehicle.thrust_high
    speeds: Floats = np.sqrt(thrust / coefficient)
    return speeds


# ---- PX4

_TOPICS: Final = ("vehicle_local_position", "vehicle_attitude", "vehicle_angular_velocity")
_ROTOR_TOPICS: Final = (
    ("esc_status", "esc[{}].esc_rpm", SPEED, 2 * np.pi / 60),
    ("actuator_motors", "control[{}]", THROTTLE, 1.0),
)
"""Topic, its field of a rotor from 0, our column, and the factor."""
_AXES: Final = (("x", 1.0), ("y", -1.0), ("z", -1.0))
"""Signs of our axes: theirs are north east down and forward right down."""
_MAX_ROTORS: Final = 12


def _ulog(path: Path) -> Columns:
    """Columns of a PX4 log in our frames: world north, west, up; body forward, left, up.

    Topics are interpolated at the times of the body rates.
    """
    pyulog = require("pyulog", "identify", "reading a ULog file")
    try:
        log = pyulog.ULog(str(path))
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise InputError(f"log: expected a ULog file, got {path.name}: {error}") from None
    topics = {one.name: one.data for one in reversed(log.data_list)}
    for topic in _TOPICS:
        if topic not in topics:
            _refuse(path, f"the topic {topic}", ", ".join(sorted(topics)))
    place, turn, rates = (topics[name] for name in _TOPICS)
    rotor_topics = [topics[name] for name, *_ in _ROTOR_TOPICS if name in topics]
    base = _common_times(rates, [place, turn, *rotor_topics])

    def at(topic: Columns, name: str, factor: float = 1.0) -> Floats:
        times = topic["timestamp"].astype(np.float64)
        values = np.interp(base, times, topic[name].astype(np.float64))
        return np.asarray(factor * values)

    columns = {"t": (base - base[:1]) * 1e-6}
    for i, (axis, sign) in enumerate(_AXES):
        columns[axis] = at(place, axis, sign)
        columns[f"v{axis}"] = at(place, f"v{axis}", sign)
        columns[f"w{axis}"] = at(rates, f"xyz[{i}]", sign)
    quaternions = np.stack([turn[f"q[{i}]"].astype(np.float64) for i in range(4)], axis=1)
    smooth = {"timestamp": turn["timestamp"]}
    for axis, values in zip("wxyz", _without_flips(quaternions).T, strict=True):
        smooth[axis] = values
    for axis, sign in (("w", 1.0), *_AXES):
        columns[f"q{axis}"] = at(smooth, axis, sign)
    for topic, field, ours, factor in _ROTOR_TOPICS:
        for i in range(_MAX_ROTORS):
            name = field.format(i)
            if name in topics.get(topic, {}):
                columns[ours.format(i + 1)] = at(topics[topic], name, factor)
    return columns


def _common_times(base: Columns, others: Sequence[Columns]) -> Floats:
    """Times of a topic, µs, at which all others have samples around them."""
    times = base["timestamp"].astype(np.float64)
    first = max(float(topic["timestamp"][0]) for topic in others)
    last = min(float(topic["timestamp"][-1]) for topic in others)
    inside: Floats = times[(times >= first) & (times <= last)]
    return inside
