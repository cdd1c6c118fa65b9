"""System identification: numbers of a vehicle from logs of its flights.

Two steps. A regression of measured accelerations gives start values. Then the error of open-loop
predictions over short windows (`prediction`) is minimised, of position, attitude, velocity and body
rates together, each divided by its own spread, with a robust loss.

Intervals are those of a sandwich estimator whose clusters are segments of the flights: the errors
within a segment may depend on each other in any way. A number that the data do not determine keeps
the value of the vehicle's file, and the result says why: its interval is wider than half of it, or
it cannot be distinguished from another number.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from ..models.errors import InputError
from ..models.vehicle import Vehicle
from ..sim.rotations import cross, multiplied, to_body
from .flight_logs import FlightLog, with_lag
from .prediction import (
    NAMES,
    Floats,
    Numbers,
    States,
    Windows,
    differences,
    inertia_of,
    numbers_of,
    predict,
)

LAG: Final = "rotors.time_constant"
KNOWN: Final = (*NAMES, LAG)
"""Numbers that can be identified."""
DEFAULT: Final = (
    "rotors.thrust_coefficient", LAG, "body.inertia.x", "body.inertia.y", "body.inertia.z",
    "drag.linear.x", "drag.linear.y", "drag.linear.z", "rotors.reaction",
)  # fmt: skip
"""Identified by default. Of two that cannot be distinguished the later keeps its value."""
WIDEST: Final = 0.5
"""A number is not excited if its 95 % interval reaches further than this share, either way."""
ALIKE: Final = 0.98
"""Two numbers cannot be distinguished if their estimates correlate more than this."""
SEGMENT: Final = 2.0
"""Length of a cluster, s: four of the default windows."""
_LEAST_SEGMENTS: Final = 5
_ROUNDS: Final = 2  # of estimating the spreads anew
_STIFF: Final = 1e5  # an inertia past the triangle inequality by 1 % costs as a thousand spreads
_ERRORS: Final = 12  # numbers of a start that are measured with errors

Group = tuple[str, ...]
Spreads = Mapping[int, Sequence[float]]
"""Standard deviations of the four differences at each horizon."""


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One number of the result."""

    name: str
    value: float
    low: float
    """End of the 95 % interval; that of the number from the data, if the vehicle's was kept."""
    high: float
    kept: str = ""
    """Why the vehicle's own value was kept; empty: the value is identified."""


@dataclass(frozen=True, kw_only=True)
class Identified:
    """The vehicle's numbers that the logs determine."""

    numbers: Numbers
    """All numbers that move the vehicle; the time constant among them if the logs have commands."""
    estimates: tuple[Estimate, ...]
    before: tuple[float, ...]
    """Mean errors over a window with the vehicle's numbers: position, m, attitude, rad, velocity,
    m/s, and body rates, rad/s."""
    after: tuple[float, ...]
    """The same with the identified numbers."""
    windows: int
    segments: int
    logs: tuple[str, ...]


def identify(
    vehicle: Vehicle,
    logs: Sequence[FlightLog],
    *,
    window: float = 0.5,
    names: Sequence[str] = DEFAULT,
) -> Identified:
    """Identify numbers of a vehicle from logs with the same period; `window` in s.

    The time constant of the rotors takes part if the logs have commands. Raises `InputError` for
    an unknown name, or logs that are too short.
    """
    for name in names:
        if name not in KNOWN:
            raise InputError(f"fit: expected some of {', '.join(KNOWN)}, got {name!r}")
    has_commands = _have_commands(logs)
    problem = _Problem(vehicle, logs, _steps(window, logs[0].period))
    if problem.segments < _LEAST_SEGMENTS:
        raise InputError(
            f"logs: expected at least {_LEAST_SEGMENTS} segments of {SEGMENT:g} s in the logs, "
            f"got {problem.segments}"
        )
    base = numbers_of(vehicle)
    free = [name for name in names if name != LAG or has_commands]
    if has_commands:
        base[LAG] = vehicle.coefficients.rotors.time_constant or 0.05
    start: Numbers = base | regressed(vehicle, problem.flights(base), free)
    kept: dict[str, Estimate] = {}
    while True:
        point, estimates = problem.solve(start, free)
        undetermined = _undetermined(estimates, problem.correlation, free)
        if not undetermined:
            break
        for name, reason in undetermined.items():
            kept[name] = replace(estimates[name], value=base[name], kept=reason)
            free.remove(name)
        start = {**point, **{name: base[name] for name in undetermined}}
    found = estimates | kept
    return Identified(
        numbers=point,
        estimates=tuple(found[name] for name in names if name in found),
        before=problem.mean_errors(base),
        after=problem.mean_errors(point),
        windows=len(problem.cluster),
        segments=problem.segments,
        logs=tuple(log.name for log in logs),
    )


def _steps(window: float, period: float) -> int:
    """Samples of a window. Raises `InputError`."""
    steps = round(window / period)
    if not 4 <= steps <= 1000 or abs(steps * period - window) > 1e-9:
        raise InputError(
            f"window: expected a multiple of {period:g} s, 4 to 1000 of them, got {window:g} s"
        )
    return steps


def _have_commands(logs: Sequence[FlightLog]) -> bool:
    """Whether the logs have commands. Raises `InputError` if some of them have none."""
    having = [log.commands is not None for log in logs]
    if any(having) and not all(having):
        raise InputError("logs: expected commands in all of them or in none")
    return having[0]


def regressed(
    vehicle: Vehicle, flights: Sequence[FlightLog], names: Sequence[str]
) -> dict[str, float]:
    """Start values by linear regression of accelerations, of the numbers that it determines.

    Thrust and drag from the measured acceleration in body axes, inertia from that of the rates.
    """
    own = numbers_of(vehicle)
    parts = [_accelerations(vehicle, own, flight) for flight in flights]
    force, axial, speed, torque, turning = (
        np.concatenate(arrays) for arrays in zip(*parts, strict=True)
    )
    values: dict[str, float] = {}
    scale = float((axial * force).sum() / (axial * axial).sum()) * vehicle.mass
    coefficient = own["rotors.thrust_coefficient"]
    if "rotors.thrust_coefficient" in names and scale > 0:
        values["rotors.thrust_coefficient"] = coefficient = scale
    rest = vehicle.mass * force - coefficient * axial
    for i, axis in enumerate("xyz"):
        name = f"drag.linear.{axis}"
        if name in names and speed[:, i].std() > 0:
            slope = -float((speed[:, i] * rest[:, i]).sum() / (speed[:, i] ** 2).sum())
            values[name] = max(slope, 0.0)
        name = f"body.inertia.{axis}"
        x = coefficient * torque[:, i]
        y = turning[:, i]
        inverse = float((x * y).sum() / max((x * x).sum(), 1e-300))
        if name in names and inverse > 0 and 0.1 < 1 / (inverse * own[name]) < 10:
            values[name] = 1 / inverse
    return values


def _accelerations(vehicle: Vehicle, own: Numbers, flight: FlightLog) -> tuple[Floats, ...]:
    """For each sample but the first and last two, (N - 4, 3) each: acceleration less gravity, body
    axes; thrust per thrust coefficient; velocity, body axes; torque per thrust coefficient; and
    acceleration of the rates plus its gyroscopic part, with the inertia as it is."""
    inner = slice(2, -2)
    quaternion = flight.quaternion[inner]
    rates = flight.body_rates[inner]

    def slope(array: Floats) -> Floats:
        near = array[3:-1] - array[1:-3]
        far = array[4:] - array[:-4]
        slopes: Floats = (8 * near - far) / (12 * flight.period)
        return slopes

    up = np.array([0.0, 0.0, vehicle.gravity])
    force = to_body(quaternion, slope(flight.velocity) + up)
    velocity = to_body(quaternion, flight.velocity[inner])
    squares = flight.speeds[inner] ** 2
    axes = np.array([rotor.axis for rotor in vehicle.rotors])
    arms = np.array([rotor.position for rotor in vehicle.rotors]) - vehicle.center_of_mass
    reactions = np.array([rotor.reaction for rotor in vehicle.rotors])
    levers = np.cross(arms, axes) + reactions
    inertia = inertia_of(vehicle, own)
    gyroscopic = np.linalg.solve(inertia, cross(rates, rates @ inertia).T).T
    turning = slope(flight.body_rates) + gyroscopic
    return force, squares @ axes, velocity, squares @ levers, turning


def fit(
    vehicle: Vehicle, numbers: Numbers, windows: Windows, groups: Sequence[Group]
) -> dict[str, float]:
    """The numbers of least prediction error; those of a group stay equal.

    Differences are weighed as in `identify`, but the starts are taken as they were measured: where
    start and input are noisy, this gives the numbers that predict best, and not the true ones.
    """
    scales = np.array([_scale(vehicle, numbers, group[0]) for group in groups])
    low = np.array([_lowest(group[0]) for group in groups])

    def numbers_at(x: Floats) -> dict[str, float]:
        pairs = zip(groups, (x * scales).tolist(), strict=True)
        return {**numbers, **{name: value for group, value in pairs for name in group}}

    x = np.maximum(np.array([numbers[group[0]] for group in groups]) / scales, low + 1e-6)
    for _ in range(_ROUNDS):
        spreads = _spreads(vehicle, numbers_at(x), windows)

        def rows(several: Sequence[Floats], spreads: Spreads = spreads) -> Floats:
            candidates = [numbers_at(one) for one in several]
            weighed = _weighed(vehicle, candidates, windows, spreads)
            costs = [_flatness(vehicle, one) for one in candidates]
            return np.column_stack((weighed.reshape(len(several), -1), costs))

        x = _minimum(rows, x, low)
    return _flattened(vehicle, numbers_at(x))


class _Problem:
    """Windows of logs, their cost at some numbers, and the numbers of least cost.

    The measured state at which a window starts has errors too. The first-order effect of any such
    error is projected out of the differences, in each window.

    Attributes:
        cluster: Number of the segment of each window.
        segments: Number of segments.
        correlation: Of the free numbers in the last `solve`.
    """

    def __init__(self, vehicle: Vehicle, logs: Sequence[FlightLog], steps: int) -> None:
        self._vehicle = vehicle
        self._logs = logs
        self._steps = steps
        self._measured = logs[0].measured
        shares = (0.2, 0.4, 0.6, 0.8, 1.0)
        horizons = sorted({1, *(max(1, round(steps * share)) for share in shares)})
        flights = self.flights({LAG: 0.05})
        self._windows = windows = Windows.cut(flights, steps, steps, horizons)
        segment = (windows.index * windows.period / SEGMENT).astype(int)
        pairs = np.stack((windows.flight, segment))
        self.cluster = np.unique(pairs, axis=1, return_inverse=True)[1].ravel()
        self.segments = len(np.unique(self.cluster))
        self.correlation: Floats = np.zeros((0, 0))
        self._spreads: Spreads = {}
        self._basis: Floats | None = None
        self._speed_spread = 1.0

    def flights(self, numbers: Numbers) -> list[FlightLog]:
        """The flights with measured speeds, or those that follow the commands with the lag."""
        if self._measured or LAG not in numbers:
            return list(self._logs)
        return [log if log.commands is None else with_lag(log, numbers[LAG]) for log in self._logs]

    def solve(
        self, start: Numbers, free: Sequence[str]
    ) -> tuple[dict[str, float], dict[str, Estimate]]:
        """The numbers of least cost from a start, and the estimates of the free ones."""
        vehicle = self._vehicle
        scales = np.array(
            [start[name] if name == LAG else _scale(vehicle, start, name) for name in free]
        )
        low = np.array([_lowest(name) for name in free])
        x = np.array([start[name] for name in free]) / np.maximum(scales, 1e-300)
        x = np.maximum(x, low + 1e-6)

        def at(x: Floats) -> dict[str, float]:
            return {**start, **dict(zip(free, (x * scales).tolist(), strict=True))}

        def rows(several: Sequence[Floats]) -> Floats:
            points = [at(one) for one in several]
            costs = [_flatness(vehicle, one) for one in points]
            return np.column_stack((self._rows(points).reshape(len(several), -1), costs))

        for _ in range(_ROUNDS if free else 0):
            self._prepare(at(x))
            x = _minimum(rows, x, low)
        point = _flattened(vehicle, at(x))
        self._prepare(point)
        half = self._half_widths(lambda several: self._rows([at(one) for one in several]), x)
        # More drag than a physics step can follow is no estimate.
        stiffest = 0.5 * vehicle.mass / self._windows.period
        for i, name in enumerate(free):
            if name.startswith("drag.linear") and x[i] * scales[i] > stiffest:
                half[i] = np.inf
        estimates = {
            name: Estimate(name=name, value=float(v), low=float(v - h), high=float(v + h))
            for name, v, h in zip(free, x * scales, half * scales, strict=True)
        }
        return point, estimates

    def _rows(self, points: Sequence[Numbers]) -> Floats:
        """Weighed differences at points, shape (P, M, K)."""
        speeds = None
        if not self._measured:
            speeds = np.concatenate([self._speeds(one) for one in points], axis=-1)
        rows = _weighed(self._vehicle, points, self._windows, self._spreads, speeds)
        if self._basis is not None:
            # The start itself, where the difference is 0, is a measurement as well.
            starts = np.zeros((*rows.shape[:2], _ERRORS))
            rows = np.concatenate((rows, starts), axis=-1)
            inside = np.einsum("mki,pmk->pmi", self._basis, rows)
            rows = rows - np.einsum("mki,pmi->pmk", self._basis, inside)
        if self._measured and LAG in points[0]:
            extra = [self._speed_differences(one) / self._speed_spread for one in points]
            rows = np.concatenate((rows, np.stack(extra)), axis=-1)
        return rows

    def mean_errors(self, point: Numbers) -> tuple[float, ...]:
        """Mean sizes of the differences at the end of a window."""
        speeds = None if self._measured else self._speeds(point)
        predictions = dict(predict(self._vehicle, point, self._windows, speeds))
        last = self._steps
        errors = differences(predictions[last], self._windows.truth[last])
        return tuple(float(np.linalg.norm(error, axis=0).mean()) for error in errors)

    def _speeds(self, point: Numbers) -> Floats:
        """In the windows, (H, R, M)."""
        return Windows.cut(self.flights(point), self._steps, self._steps).speeds

    def _prepare(self, point: Numbers) -> None:
        """Set the spreads at a point, and the basis: the effects of errors of the starts."""
        self._basis = None
        vehicle = self._vehicle
        windows = self._windows
        speeds = None if self._measured else self._speeds(point)
        self._spreads = _spreads(vehicle, point, windows, speeds)
        if self._measured and LAG in point:
            self._speed_spread = _robust(self._speed_differences(point))
        # At the first horizon differences have the noise of two measurements, at the start of one.
        noise = np.repeat(self._spreads[1], 3) / np.sqrt(2)
        base = _weighed(vehicle, [point], windows, self._spreads, speeds)[0]
        columns = []
        for i, size in enumerate(noise):
            shifted = replace(windows, start=_shifted(windows.start, i, size))
            moved = _weighed(vehicle, [point], shifted, self._spreads, speeds)[0] - base
            unit = np.zeros((len(moved), _ERRORS))
            unit[:, i] = 1.0
            columns.append(np.concatenate((moved, unit), axis=-1))
        self._basis, _ = np.linalg.qr(np.stack(columns, axis=-1))

    def _speed_differences(self, point: Numbers) -> Floats:
        """Speeds that follow the commands less those measured, in each window, (M, H R)."""
        flights = [
            replace(log, speeds=with_lag(log, point[LAG]).speeds - log.speeds) for log in self._logs
        ]
        cut = Windows.cut(flights, self._steps, self._steps)
        begun = cut.index > 0  # in the first window they come from where the command was
        return (cut.speeds * begun).reshape(-1, cut.speeds.shape[-1]).T

    def _half_widths(self, rows_at: Callable[[Sequence[Floats]], Floats], x: Floats) -> Floats:
        """Of the 95 % intervals of x; infinite where nothing depends on it."""
        from scipy.stats import t

        if not len(x):
            return np.zeros(0)
        steps = 1e-4 * np.maximum(np.abs(x), 1e-2)
        rows = rows_at(_neighbours(x, steps))
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
        half = np.full(len(x), np.inf)
        self.correlation = np.eye(len(x))
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


def _undetermined(
    estimates: Mapping[str, Estimate], correlation: Floats, free: Sequence[str]
) -> dict[str, str]:
    """The free numbers that the data determine least, and why; empty: they determine all.

    One at a time, since without it the others may be determined; hopeless ones at once.
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
    reasons = {}
    for name, ratio in ratios.items():
        if ratio >= min(most, 4 * WIDEST):
            interval = "any number" if ratio > 10 else f"± {ratio:.0%}"
            reasons[name] = f"not excited: 95 % interval {interval}"
    return reasons


def _weighed(
    vehicle: Vehicle,
    candidates: Sequence[Numbers],
    windows: Windows,
    spreads: Spreads,
    speeds: Floats | None = None,
) -> Floats:
    """Differences divided by their spreads, (P, M, K)."""
    count = len(candidates)
    rows: list[Floats] = []
    with np.errstate(all="ignore"):
        for horizon, predicted in predict(vehicle, candidates, windows, speeds):
            p, q, v, w = (np.tile(array, count) for array in windows.truth[horizon])
            errors = differences(predicted, (p, q, v, w))
            pairs = zip(errors, spreads[horizon], strict=True)
            rows += [error / spread for error, spread in pairs]
    # A trial far off may tumble: still a number, and a large one.
    table = np.nan_to_num(np.concatenate(rows), nan=1e6, posinf=1e6, neginf=-1e6)
    return np.ascontiguousarray(table.T).reshape(count, -1, len(table))


def _neighbours(x: Floats, steps: Floats) -> list[Floats]:
    """The point, and one with a step along each axis."""
    return [x, *(x + np.diag(steps))]


def _minimum(rows: Callable[[Sequence[Floats]], Floats], x: Floats, low: Floats) -> Floats:
    """x of least robust sum of squares. All columns of a Jacobian are one stacked prediction."""
    from scipy.optimize import least_squares

    def slopes(x: Floats) -> Floats:
        steps = 1e-6 * np.maximum(np.abs(x), 1e-2)
        table = rows(_neighbours(x, steps))
        return np.asarray((table[1:] - table[0]).T / steps)

    solution = least_squares(
        lambda x: rows([x])[0],
        x,
        slopes,
        bounds=(low, np.inf),
        x_scale="jac",
        loss="soft_l1",
        ftol=1e-6,
        xtol=1e-6,
        gtol=1e-10,
        max_nfev=40,
    )
    found: Floats = solution.x
    return found


def _shifted(start: States, index: int, size: float) -> States:
    """Start states with one of 12 errors: of position, attitude, velocity and rates."""
    kind, axis = divmod(index, 3)
    arrays = list(start)
    if kind == 1:
        turn = np.zeros(4)
        turn[0] = np.cos(size / 2)
        turn[1 + axis] = np.sin(size / 2)
        arrays[1] = multiplied(start[1].T, np.broadcast_to(turn, start[1].T.shape)).T
    else:
        arrays[kind] = start[kind].copy()
        arrays[kind][axis] += size
    position, quaternion, velocity, rates = arrays
    return position, quaternion, velocity, rates


def _spreads(
    vehicle: Vehicle, numbers: Numbers, windows: Windows, speeds: Floats | None = None
) -> Spreads:
    """Robust standard deviations of the differences, at each horizon."""
    with np.errstate(all="ignore"):
        return {
            horizon: [_robust(error) for error in differences(predicted, windows.truth[horizon])]
            for horizon, predicted in predict(vehicle, numbers, windows, speeds)
        }


def _flatness(vehicle: Vehicle, numbers: Numbers) -> float:
    """A cost for an inertia that no body has: a moment larger than the sum of the others."""
    low, middle, high = np.linalg.eigvalsh(inertia_of(vehicle, numbers))
    return _STIFF * max(0.0, float(high / (low + middle)) - 1.0)


def _flattened(vehicle: Vehicle, numbers: Numbers) -> dict[str, float]:
    """With the largest moment at most the sum of the others, which the cost keeps but for 1e-5."""
    inertia = inertia_of(vehicle, numbers)
    (low, middle, high), axes = np.linalg.eigh(inertia)
    corrected = dict(numbers)
    if high > low + middle:
        moments = np.array((low, middle, (low + middle) * (1 - 1e-9)))
        inertia = (axes * moments) @ axes.T
        for i, axis in enumerate("xyz"):
            corrected[f"body.inertia.{axis}"] = float(inertia[i, i])
    return corrected


def _scale(vehicle: Vehicle, numbers: Numbers, name: str) -> float:
    """A typical size of a number: its own, or one that gives a lively vehicle's forces."""
    inertia = float(np.trace(vehicle.inertia)) / 3
    weight = vehicle.mass * vehicle.gravity
    lift = weight / vehicle.num_rotors
    speed = np.sqrt(lift / numbers["rotors.thrust_coefficient"])
    typical = {
        "rotors.drag": 0.03 * lift / speed,
        "rotors.inflow": 0.03 * lift / speed,
        "rotors.lift": 0.03 * lift,
        "rotors.reaction": 0.01,
        "drag.linear": 0.03 * weight,
        "drag.angular": inertia,
        "drag.moment": 10 * inertia,
    }
    kind = name if name in typical else name.rpartition(".")[0]
    return float(typical.get(kind, abs(numbers[name]))) or 1.0


def _lowest(name: str) -> float:
    """The least value of a number in units of its scale."""
    if name.startswith("drag.moment"):
        return -np.inf
    return 0.01 if name.startswith("body.inertia") or name == LAG else 0.0


def _robust(errors: npt.ArrayLike) -> float:
    """Standard deviation of normal numbers with this median size; never 0."""
    sizes = np.nan_to_num(np.abs(errors), nan=1e6, posinf=1e6)
    return float(np.median(sizes) / 0.6745) + 1e-12
