"""System identification: numbers of a vehicle from logs of its flights.

Two steps. A regression of measured accelerations gives start values. Then the error of open-loop
predictions over short windows (`prediction`) is minimised, of position, attitude, velocity and body
rates together, each divided by its own spread, with a robust loss.

Intervals are those of a sandwich estimator whose clusters are segments of the flights: the errors
within one may depend on each other in any way. A number that the data do not tell keeps the value
of the vehicle's file, and the result says why: its interval is wider than half of it, or it cannot
be told apart from another one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ..models.errors import expect
from ..models.vehicle import Vehicle
from .flight_logs import Log, with_lag
from .prediction import (
    ENTRIES,
    Airframe,
    Flight,
    Floats,
    Windows,
    conjugate,
    cross,
    differences,
    from_rotation_vector,
    predict,
    product,
    rotated,
)

LAG: Final = "rotors.time_constant"
NAMES: Final = (*ENTRIES, LAG)
"""Numbers that can be identified."""
DEFAULT: Final = (
    "rotors.thrust_coefficient", LAG, "body.inertia.x", "body.inertia.y", "body.inertia.z",
    "drag.linear.x", "drag.linear.y", "drag.linear.z", "rotors.reaction",
)  # fmt: skip
"""What is identified unless told otherwise. Of two that cannot be told apart the later is kept."""
WIDEST: Final = 0.5
"""A number is not excited if its 95 % interval reaches further than this share, either way."""
ALIKE: Final = 0.98
"""Two numbers cannot be told apart if their estimates correlate more than this."""
SEGMENT: Final = 2.0
"""Length of a cluster, s: four of the default windows."""
_LEAST_SEGMENTS: Final = 5
_ROUNDS: Final = 2  # of estimating the spreads anew
_STIFF: Final = 1e5  # an inertia past the triangle inequality by 1 % costs as a thousand spreads

Group = tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One number of the result."""

    name: str
    value: float
    low: float
    """End of the 95 % interval; that of the number that the data told, if it was kept."""
    high: float
    kept: str = ""
    """Why the vehicle's own value was kept; empty: the value is identified."""


@dataclass(frozen=True, kw_only=True)
class Identified:
    """What the logs tell of a vehicle."""

    airframe: Airframe
    time_constant: float | None
    estimates: tuple[Estimate, ...]
    before: tuple[float, float, float, float]
    """Mean errors over a window with the vehicle's numbers: position, m, attitude, rad, velocity,
    m/s, and body rates, rad/s."""
    after: tuple[float, float, float, float]
    """The same with those identified."""
    windows: int
    segments: int
    logs: tuple[str, ...]


def identify(
    vehicle: Vehicle,
    logs: Sequence[Log],
    *,
    window: float = 0.5,
    names: Sequence[str] = DEFAULT,
) -> Identified:
    """Identify numbers of a vehicle from logs with the same period; `window` in s.

    The time constant of the rotors takes part if the logs have commands. Raises `InputError` for
    an unknown name, or logs that are too short.
    """
    for name in names:
        expect(name in NAMES, "fit", f"some of {', '.join(NAMES)}", repr(name))
    period = logs[0].flight.period
    steps = round(window / period)
    right = 4 <= steps <= 1000 and abs(steps * period - window) < 1e-9
    expect(right, "window", f"a multiple of {period:g} s, 4 to 1000 of them", f"{window:g} s")
    own = Airframe.of(vehicle)
    told = any(log.commands is not None for log in logs)
    alike = all((log.commands is not None) == told for log in logs)
    expect(alike, "logs", "commands in all of them or in none")
    problem = _Problem(logs, steps)
    count = len(np.unique(problem.cluster))
    expected = f"at least {_LEAST_SEGMENTS} segments of {SEGMENT:g} s in the logs"
    expect(count >= _LEAST_SEGMENTS, "logs", expected, str(count))
    lag = vehicle.coefficients.rotors.time_constant or 0.05
    free = [name for name in names if name != LAG or told]
    base = _Point(own, lag if told else None)
    start = _Point(regressed(own, problem.flights(base.lag), free), base.lag)
    kept: dict[str, Estimate] = {}
    while True:
        point, estimates = problem.solve(start, free)
        untold = _untold(estimates, problem.correlation, free)
        if not untold:
            break
        own_values = {name: base.value(name) for name in untold}
        for name, reason in untold.items():
            kept[name] = replace(estimates[name], value=own_values[name], kept=reason)
            free.remove(name)
        start = point.with_values(own_values)
    done = estimates | kept
    order = [name for name in names if name in done]
    return Identified(
        airframe=point.airframe,
        time_constant=point.lag,
        estimates=tuple(done[name] for name in order),
        before=problem.mean_errors(base),
        after=problem.mean_errors(point),
        windows=len(problem.cluster),
        segments=count,
        logs=tuple(log.flight.name for log in logs),
    )


def regressed(own: Airframe, flights: Sequence[Flight], names: Sequence[str]) -> Airframe:
    """Start values by linear regression of accelerations; a number it does not tell stays.

    Thrust and drag from the measured acceleration in body axes, inertia from that of the rates.
    """
    force, axial, speed, torque, turning = (
        np.concatenate(parts) for parts in zip(*(_accelerations(own, f) for f in flights),
                                               strict=True)
    )  # fmt: skip
    values: dict[str, float] = {}
    scale = float((axial * force).sum() / (axial * axial).sum()) * own.mass
    if "rotors.thrust_coefficient" in names and scale > 0:
        values["rotors.thrust_coefficient"] = scale
    coefficient = values.get("rotors.thrust_coefficient", own.thrust_coefficient)
    rest = own.mass * force - coefficient * axial
    for i, axis in enumerate("xyz"):
        name = f"drag.linear.{axis}"
        if name in names and speed[:, i].std() > 0:
            slope = -float((speed[:, i] * rest[:, i]).sum() / (speed[:, i] ** 2).sum())
            values[name] = max(slope, 0.0)
        name, x, y = f"body.inertia.{axis}", coefficient * torque[:, i], turning[:, i]
        inverse = float((x * y).sum() / max((x * x).sum(), 1e-300))
        old = own.value(name)
        if name in names and inverse > 0 and 0.1 < 1 / (inverse * old) < 10:
            values[name] = 1 / inverse
    return own.with_values(values)


def fit(airframe: Airframe, windows: Windows, groups: Sequence[Group]) -> Airframe:
    """The numbers of least prediction error; those of a group stay equal.

    Differences are weighed as in `identify`, but the starts are taken as they were measured: where
    start and input are noisy, this gives the numbers that predict best, and not the true ones.
    """
    scales = np.array([_scale(airframe, group[0]) for group in groups])
    low = np.array([_lowest(group[0]) for group in groups])

    def made(x: Floats) -> Airframe:
        pairs = zip(groups, (x * scales).tolist(), strict=True)
        return airframe.with_values({name: v for group, v in pairs for name in group})

    x = np.array([airframe.value(group[0]) for group in groups]) / scales
    x = np.maximum(x, low + 1e-6)
    for _ in range(_ROUNDS):
        spreads = _spreads(made(x), windows)

        def rows(several: Sequence[Floats], spreads: Any = spreads) -> Floats:
            airframes = [made(one) for one in several]
            weighed = _weighed(airframes, windows, spreads).reshape(len(several), -1)
            return np.column_stack((weighed, [_flatness(one) for one in airframes]))

        x = _minimum(rows, x, low)
    return _flattened(made(x))


@dataclass(frozen=True)
class _Point:
    """An airframe and the time constant of its rotors, None where speeds were measured alone."""

    airframe: Airframe
    lag: float | None

    def value(self, name: str) -> float:
        if name == LAG:
            assert self.lag is not None
            return self.lag
        return self.airframe.value(name)

    def with_values(self, values: Mapping[str, float]) -> "_Point":
        rest = {name: value for name, value in values.items() if name != LAG}
        return _Point(self.airframe.with_values(rest), values.get(LAG, self.lag))


class _Problem:
    """Windows of logs, what they cost at a point, and the point of least cost.

    The measured state at which a window starts has errors too. What any such error would change in
    the differences, to first order, is projected out of them, in each window.
    """

    def __init__(self, logs: Sequence[Log], steps: int) -> None:
        self._logs, self._steps = logs, steps
        self._measured = logs[0].measured
        horizons = sorted({1, *(max(1, round(steps * share)) for share in (0.2, 0.4, 0.6, 0.8, 1))})
        flights = self.flights(0.05)
        self._windows = windows = Windows.cut(flights, steps, steps, horizons)
        segment = (windows.index * windows.period / SEGMENT).astype(int)
        pairs = np.stack((windows.flight, segment))
        self.cluster = np.unique(pairs, axis=1, return_inverse=True)[1].ravel()
        self._spreads: dict[int, list[float]] = {}
        self._basis: Floats | None = None
        self._speed_spread = 1.0
        self.correlation: Floats = np.zeros((0, 0))

    def flights(self, lag: float | None) -> list[Flight]:
        """The flights with measured speeds, or those that follow the commands with this lag."""
        if self._measured or lag is None:
            return [log.flight for log in self._logs]
        return [with_lag(log, lag) for log in self._logs]

    def solve(self, start: _Point, free: Sequence[str]) -> tuple[_Point, dict[str, Estimate]]:
        """The point of least cost from a start, and what it tells of the free numbers."""
        scales = np.array([start.value(n) if n == LAG else _scale(start.airframe, n) for n in free])
        low = np.array([_lowest(name) for name in free])
        x = np.array([start.value(name) for name in free]) / np.maximum(scales, 1e-300)
        x = np.maximum(x, low + 1e-6)

        def at(x: Floats) -> _Point:
            return start.with_values(dict(zip(free, (x * scales).tolist(), strict=True)))

        def rows(several: Sequence[Floats]) -> Floats:
            points = [at(one) for one in several]
            weighed = self.rows(points).reshape(len(several), -1)
            return np.column_stack((weighed, [_flatness(one.airframe) for one in points]))

        for _ in range(_ROUNDS if free else 0):
            self._prepare(at(x))
            x = _minimum(rows, x, low)
        point = _Point(_flattened(at(x).airframe), at(x).lag)
        self._prepare(point)
        half = self._half_widths(at, x) * scales
        estimates = {
            name: Estimate(name=name, value=float(v), low=float(v - h), high=float(v + h))
            for name, v, h in zip(free, x * scales, half, strict=True)
        }
        return point, estimates

    def rows(self, points: Sequence[_Point]) -> Floats:
        """Weighed differences at points, shape (P, M, K)."""
        speeds = None
        if not self._measured:
            speeds = np.concatenate([self._speeds(one.lag) for one in points], axis=-1)
        airframes = [one.airframe for one in points]
        rows = _weighed(airframes, self._windows, self._spreads, speeds)
        if self._basis is not None:
            # The start itself, where the difference is 0, is a measurement as well.
            rows = np.concatenate((rows, np.zeros((*rows.shape[:2], 12))), axis=-1)
            inside = np.einsum("mki,pmk->pmi", self._basis, rows)
            rows = rows - np.einsum("mki,pmi->pmk", self._basis, inside)
        if self._measured and points[0].lag is not None:
            extra = [self._speed_differences(one.lag) / self._speed_spread for one in points]
            rows = np.concatenate((rows, np.stack(extra)), axis=-1)
        return rows

    def mean_errors(self, point: _Point) -> tuple[float, float, float, float]:
        """Mean sizes of the differences at the end of a window."""
        speeds = None if self._measured else self._speeds(point.lag)
        for horizon, predicted in predict(point.airframe, self._windows, speeds):
            if horizon == self._steps:
                errors = differences(predicted, self._windows.truth[horizon])
                p, r, v, w = (float(np.linalg.norm(e, axis=0).mean()) for e in errors)
        return p, r, v, w

    def _speeds(self, lag: float | None) -> Floats:
        """In the windows, (H, R, M)."""
        return Windows.cut(self.flights(lag), self._steps, self._steps).speeds

    def _prepare(self, point: _Point) -> None:
        """Spreads and basis for a point: robust, and of what errors of the starts change."""
        self._basis = None
        speeds = None if self._measured else self._speeds(point.lag)
        windows = self._windows
        self._spreads = _spreads(point.airframe, windows, speeds)
        if point.lag is not None and self._measured:
            self._speed_spread = _robust(self._speed_differences(point.lag))
        # At the first horizon differences have the noise of two measurements, at the start of one.
        noise = np.repeat(self._spreads[1], 3) / np.sqrt(2)
        base = _weighed([point.airframe], windows, self._spreads, speeds)[0]
        columns = []
        for i, size in enumerate(noise):
            near = replace(windows, start=_shifted(windows.start, i, size))
            moved = _weighed([point.airframe], near, self._spreads, speeds)[0] - base
            unit = np.zeros((len(moved), 12))
            unit[:, i] = 1.0
            columns.append(np.concatenate((moved, unit), axis=-1))
        self._basis, _ = np.linalg.qr(np.stack(columns, axis=-1))

    def _speed_differences(self, lag: float | None) -> Floats:
        """Speeds that follow the commands less those measured, in each window, (M, H R)."""
        assert lag is not None
        flights = [
            replace(one.flight, speeds=with_lag(one, lag).speeds - one.flight.speeds)
            for one in self._logs
        ]
        cut = Windows.cut(flights, self._steps, self._steps)
        begun = cut.index > 0  # in the first window they come from where the command was
        return (cut.speeds * begun).reshape(-1, cut.speeds.shape[-1]).T

    def _half_widths(self, at: Any, x: Floats) -> Floats:
        """Of the 95 % intervals of x; infinite where nothing depends on it."""
        from scipy.stats import t

        if not len(x):
            return np.zeros(0)
        steps = 1e-4 * np.maximum(np.abs(x), 1e-2)
        near = [x, *(x + step * unit for step, unit in zip(steps, np.eye(len(x)), strict=True))]
        rows = self.rows([at(one) for one in near])
        base = rows[0]
        jacobian = (rows[1:] - base) / steps[:, None, None]  # (p, M, K)
        weight = 1 / np.sqrt(1 + base * base)  # of the loss soft_l1
        bread = np.einsum("imk,jmk,mk->ij", jacobian, jacobian, weight)
        scores = np.einsum("imk,mk->mi", jacobian, weight * base)
        count = int(self.cluster.max()) + 1
        sums = np.zeros((count, len(x)))
        np.add.at(sums, self.cluster, scores)
        size = np.sqrt(np.diag(bread))
        felt = size > 1e-9 * max(float(size.max()), 1e-300)
        half, self.correlation = np.full(len(x), np.inf), np.eye(len(x))
        chosen = np.ix_(felt, felt)
        scaled = bread[chosen] / np.outer(size[felt], size[felt])
        inverse = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True)
        meat = sums[:, felt].T @ sums[:, felt] / np.outer(size[felt], size[felt])
        spread = inverse @ meat @ inverse * (count / (count - 1))
        deviation = np.sqrt(np.maximum(np.diag(spread), 0)) / size[felt]
        half[felt] = deviation * t.ppf(0.975, count - 1)
        root = np.sqrt(np.diag(inverse))
        self.correlation[chosen] = inverse / np.outer(root, root)
        return half


def _untold(
    estimates: Mapping[str, Estimate], correlation: Floats, free: Sequence[str]
) -> dict[str, str]:
    """The free numbers that the data tell least, and why; empty: they tell all.

    One at a time, since without it the others may be told; those without any hope at once.
    """
    pairs = np.argwhere(np.triu(np.abs(correlation) > ALIKE, 1))
    if len(pairs):
        i, j = max(pairs, key=lambda pair: abs(correlation[*pair]))
        share = abs(correlation[i, j])
        return {free[j]: f"not told apart from {free[i]} (correlation {share:.3f})"}
    ratios = {}
    for name in free:
        one = estimates[name]
        ratios[name] = (one.high - one.value) / abs(one.value) if one.value else np.inf
    most = max(ratios.values(), default=0.0)
    if most <= WIDEST:
        return {}
    sizes = {name: ratio for name, ratio in ratios.items() if ratio >= min(most, 4 * WIDEST)}
    return {
        name: "not excited: 95 % interval " + ("any number" if r > 10 else f"± {r:.0%}")
        for name, r in sizes.items()
    }


def _weighed(
    airframes: Sequence[Airframe],
    windows: Windows,
    spreads: Mapping[int, Sequence[float]],
    speeds: Floats | None = None,
) -> Floats:
    """Differences divided by their spreads, (P, M, K)."""
    count = len(airframes)
    rows: list[Floats] = []
    with np.errstate(all="ignore"):
        for horizon, predicted in predict(airframes, windows, speeds):
            truth = [np.tile(array, count) for array in windows.truth[horizon]]
            pairs = zip(differences(predicted, truth), spreads[horizon], strict=True)
            rows += [error / spread for error, spread in pairs]
    # A trial far off may tumble: still a number, and a large one.
    table = np.nan_to_num(np.concatenate(rows), nan=1e6, posinf=1e6, neginf=-1e6)
    return np.ascontiguousarray(table.T).reshape(count, -1, len(table))


def _minimum(rows: Callable[[Sequence[Floats]], Floats], x: Floats, low: Floats) -> Floats:
    """x of least robust sum of squares. All columns of a Jacobian are one stacked prediction."""
    from scipy.optimize import least_squares

    def slopes(x: Floats) -> Floats:
        steps = 1e-6 * np.maximum(np.abs(x), 1e-2)
        near = [x, *(x + step * unit for step, unit in zip(steps, np.eye(len(x)), strict=True))]
        table = rows(near)
        return np.asarray((table[1:] - table[0]).T / steps)

    solution = least_squares(
        lambda x: rows([x])[0], x, slopes, bounds=(low, np.inf), x_scale="jac", loss="soft_l1",
        ftol=1e-6, xtol=1e-6, gtol=1e-10, max_nfev=40,
    )  # fmt: skip
    found: Floats = solution.x
    return found


def _shifted(
    start: tuple[Floats, Floats, Floats, Floats], index: int, size: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Start states with one of 12 errors: of position, attitude, velocity and rates."""
    kind, axis = divmod(index, 3)
    arrays = list(start)
    unit = np.zeros((3, 1))
    unit[axis] = size
    turn = from_rotation_vector(unit + 0 * start[0])
    arrays[kind] = product(arrays[1], turn) if kind == 1 else arrays[kind] + unit
    position, quaternion, velocity, rates = arrays
    return position, quaternion, velocity, rates


def _spreads(
    airframe: Airframe, windows: Windows, speeds: Floats | None = None
) -> dict[int, list[float]]:
    """Robust standard deviations of the differences, at each horizon."""
    with np.errstate(all="ignore"):
        return {
            horizon: [_robust(error) for error in differences(predicted, windows.truth[horizon])]
            for horizon, predicted in predict(airframe, windows, speeds)
        }


def _flatness(airframe: Airframe) -> float:
    """A cost for an inertia that no body has: a moment larger than the sum of the others."""
    low, middle, high = np.linalg.eigvalsh(airframe.inertia)
    return _STIFF * max(0.0, float(high / (low + middle)) - 1.0)


def _flattened(airframe: Airframe) -> Airframe:
    """With what a fit left of that made good: the largest moment at most the sum of the others."""
    low, middle, high = np.linalg.eigvalsh(airframe.inertia)
    if high <= low + middle:
        return airframe
    _, axes = np.linalg.eigh(airframe.inertia)
    moments = np.array((low, middle, (low + middle) * (1 - 1e-9)))
    return replace(airframe, inertia=(axes * moments) @ axes.T)


def _accelerations(own: Airframe, flight: Flight) -> tuple[Floats, ...]:
    """For each sample but the first and last two, (N - 4, 3) each: acceleration less gravity, body
    axes; thrust per thrust coefficient; velocity, body axes; torque per thrust coefficient; and
    acceleration of the rates plus its gyroscopic part, with the inertia as it is."""
    h, inner = flight.period, slice(2, -2)
    q, w = flight.quaternion[inner].T, flight.body_rates[inner].T

    def slope(array: Floats) -> Floats:
        return (8 * (array[3:-1] - array[1:-3]) - (array[4:] - array[:-4])).T / (12 * h)

    up = np.array([0.0, 0.0, own.gravity])[:, None]
    force = rotated(conjugate(q), slope(flight.velocity) + up)
    velocity = rotated(conjugate(q), flight.velocity[inner].T)
    squares = flight.speeds[inner].T ** 2
    arm = own.place - own.center[:, None]
    lever = np.cross(arm.T, own.axis.T).T + own.turn * own.reaction * own.axis
    gyro = np.linalg.solve(own.inertia, cross(w, own.inertia @ w))
    turning = slope(flight.body_rates) + gyro
    return force.T, (own.axis @ squares).T, velocity.T, (lever @ squares).T, turning.T


def _scale(airframe: Airframe, name: str) -> float:
    """A typical size of a number: its own, or one that gives a lively vehicle's forces."""
    value = abs(airframe.value(name))
    inertia, weight = float(np.trace(airframe.inertia)) / 3, airframe.mass * airframe.gravity
    speed = np.sqrt(weight / airframe.place.shape[1] / airframe.thrust_coefficient)
    total = speed * airframe.place.shape[1]
    typical = {
        "rotors.drag": 0.03 * weight / total, "rotors.inflow": 0.03 * weight / total,
        "rotors.lift": 0.03 * weight / airframe.place.shape[1],
        "drag.linear": 0.03 * weight, "drag.angular": inertia, "drag.moment": 10 * inertia,
        "rotors.reaction": 0.01,
    }  # fmt: skip
    kind = name if name in typical else name.rpartition(".")[0]
    return typical.get(kind, value) or 1.0


def _lowest(name: str) -> float:
    """The least value of a number in units of its scale."""
    if name.startswith("drag.moment"):
        return -np.inf
    return 0.01 if name.startswith("body.inertia") or name == LAG else 0.0


def _robust(errors: npt.ArrayLike) -> float:
    """Standard deviation of normal numbers with this median size; never 0."""
    sizes = np.nan_to_num(np.abs(errors), nan=1e6, posinf=1e6)
    return float(np.median(sizes) / 0.6745) + 1e-12
