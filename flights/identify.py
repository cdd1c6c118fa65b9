"""System identification: numbers of a vehicle from logs of its flights.

The error of open-loop predictions over short windows (`prediction`) is minimised, of position,
attitude, velocity and body rates together, each divided by its own spread, with a robust loss.

Intervals are those of a sandwich estimator whose clusters are segments of the flights: the errors
within a segment may depend on each other in any way. A number that the data do not determine keeps
the value of the vehicle's file, and the result says why: its interval is wider than half of it, or
it cannot be distinguished from another number.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..models import InputError
from ..models.fields import check_names, immutable
from ..models.vehicle import Vehicle
from ..models.vehicle_file import read_vehicle_file
from ..sim.rotations import advanced
from .flight_logs import FlightLog, Floats, Ints, with_lag
from .prediction import (
    NAMES,
    Numbers,
    Windows,
    differences,
    entry_of,
    inertia_of,
    numbers_of,
    predict,
)

LAG = "rotors.time_constant"
KNOWN = (*NAMES, LAG)
"""Numbers that can be identified."""
DEFAULT = (
    "rotors.thrust_coefficient", LAG, "body.inertia.x", "body.inertia.y", "body.inertia.z",
    "drag.linear.x", "drag.linear.y", "drag.linear.z", "rotors.reaction",
)  # fmt: skip
"""Identified by default. Of two that cannot be distinguished the later keeps its value."""
WIDEST = 0.5
"""A number is not excited if its 95 % interval reaches further than this share, either way."""
ALIKE = 0.98
"""Two numbers cannot be distinguished if their estimates correlate more than this."""
WINDOW = 0.5
"""Length of a prediction, s."""
SEGMENT = 2.0
"""Length of a cluster, s: four windows."""
_LEAST_SEGMENTS = 5
_ROUNDS = 2  # of estimating the spreads anew


class Estimate(NamedTuple):
    """One number of the result."""

    name: str
    value: float
    low: float
    """End of the 95 % interval; that of the number from the data, if the vehicle's was kept."""
    high: float
    kept: str = ""
    """Why the vehicle's own value was kept; empty: the value is identified."""


@immutable
class Identified:
    """The vehicle's numbers that the logs determine."""

    numbers: Numbers
    """All numbers that move the vehicle; with the time constant, if it could be identified."""
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
    names: Sequence[str] = DEFAULT,
) -> Identified:
    """Identify numbers of a vehicle from logs with the same period.

    The time constant of the rotors takes part if the logs have commands alone. Raises `InputError`
    for an unknown name, or logs that are too short.
    """
    check_names(names, KNOWN, "fit")
    if len({log.measured for log in logs}) > 1:
        raise InputError("logs: expected measured speeds in all of them or in none")
    base = numbers_of(vehicle)
    if not logs[0].measured:
        base[LAG] = vehicle.coefficients["rotors.time_constant"] or 0.05
    free = [name for name in names if name in base]
    windows = _cut(logs, base, round(WINDOW / logs[0].period))
    segment = (windows.index * windows.period / SEGMENT).astype(int)
    pairs = np.stack((windows.flight, segment))
    # The number of the segment of each window.
    clusters = np.unique(pairs, axis=1, return_inverse=True)[1].ravel()
    segments = int(clusters.max()) + 1
    if segments < _LEAST_SEGMENTS:
        raise InputError(
            f"logs: expected at least {_LEAST_SEGMENTS} segments of {SEGMENT:g} s in the logs, "
            f"got {segments}"
        )
    point = dict(base)
    kept: dict[str, Estimate] = {}
    while True:
        fit = Fit(vehicle, windows, point, free, logs=logs)
        point = fit.solve()
        half, correlation = fit.half_widths(clusters)
        estimates = {}
        for name, width in zip(free, half.tolist(), strict=True):
            value = point[name]
            estimates[name] = Estimate(name, value, value - width, value + width)
        undetermined = _undetermined(list(estimates.values()), correlation)
        if not undetermined:
            break
        for name, reason in undetermined.items():
            kept[name] = estimates[name]._replace(value=base[name], kept=reason)
            free.remove(name)
            point[name] = base[name]
    found = estimates | kept
    return Identified(
        numbers=point,
        estimates=tuple(found[name] for name in names if name in found),
        before=fit.mean_errors(base),
        after=fit.mean_errors(point),
        windows=len(windows.start),
        segments=segments,
        logs=tuple(log.name for log in logs),
    )


def _cut(logs: Sequence[FlightLog], numbers: Numbers, steps: int) -> Windows:
    """Windows side by side, with measured speeds, or speeds that follow the commands."""
    shares = (0.2, 0.4, 0.6, 0.8, 1.0)
    horizons = sorted({1, *(max(1, round(steps * share)) for share in shares)})
    flights = list(logs)
    if not logs[0].measured:
        flights = [with_lag(log, numbers[LAG]) for log in logs]
    return Windows.cut(flights, steps, steps, horizons)


def _undetermined(estimates: Sequence[Estimate], correlation: Floats) -> dict[str, str]:
    """The names that the data determine least, and why; empty: they determine all.

    One at a time, since without it the others may be determined; hopeless ones at once.
    """
    pairs = np.triu(np.abs(correlation), 1)
    if pairs.max(initial=0.0) > ALIKE:
        i, j = divmod(int(pairs.argmax()), len(pairs))
        reason = f"not told apart from {estimates[i].name} (correlation {pairs[i, j]:.3f})"
        return {estimates[j].name: reason}
    ratios = {}
    for one in estimates:
        ratios[one.name] = (one.high - one.value) / abs(one.value) if one.value else np.inf
    worst = min(max(ratios.values(), default=0.0), 4 * WIDEST)
    reasons = {}
    for name, ratio in ratios.items():
        if ratio > WIDEST and ratio >= worst:
            interval = "any number" if ratio > 10 else f"± {ratio:.0%}"
            reasons[name] = f"not excited: 95 % interval {interval}"
    return reasons


@dataclass(eq=False)
class Fit:
    """Least squares of the errors of predictions, over numbers of a vehicle.

    Errors are divided by their spread, of each kind at each horizon. With logs the starts count as
    measured with errors: in a window they give the errors the covariance I + J Jᵀ, with J the
    effect of one spread of each. Without, the fit gives the numbers that predict best from such
    starts, and not the true ones.
    """

    vehicle: Vehicle
    windows: Windows
    numbers: Numbers
    """To begin with."""
    names: Sequence[str]
    """Those that are fitted."""
    logs: Sequence[FlightLog] = ()

    def __post_init__(self) -> None:
        names = self.names
        self._scales = np.array([_scale(self.vehicle, self.numbers, name) for name in names])
        self._lowest = np.array([_lowest(name) for name in names])
        values = np.array([self.numbers[name] for name in names])
        self._x = np.maximum(values / self._scales, self._lowest + 1e-6)
        self._is_drag = np.array([name.startswith("drag.linear") for name in names], bool)
        self._spreads: Floats = np.ones((len(self.windows.horizons), 4, 1))
        self._whitener: Floats | None = None

    def solve(self) -> dict[str, float]:
        """The numbers of least robust sum of squares."""
        from scipy.optimize import least_squares

        for _ in range(_ROUNDS if len(self._x) else 0):
            self._weigh()
            solution = least_squares(
                lambda x: self._rows(x[None]).ravel(),
                self._x,
                lambda x: self._jacobian(x, 1e-6)[1].reshape(len(x), -1).T,
                bounds=(self._lowest, np.inf),
                x_scale="jac",
                loss="soft_l1",
                ftol=1e-6,
                xtol=1e-6,
                gtol=1e-10,
                max_nfev=40,
            )
            self._x = solution.x
        self._weigh()
        return _flattened(self.vehicle, self.numbers_at(self._x))

    def mean_errors(self, numbers: Numbers) -> tuple[float, ...]:
        """Mean sizes of the four errors at the end of a window."""
        errors = self._errors([numbers])[0, :, -1]
        return tuple(np.linalg.norm(errors, axis=-1).mean(axis=0).tolist())

    def half_widths(self, clusters: Ints) -> tuple[Floats, Floats]:
        """Of the 95 % intervals, infinite where nothing depends on a number; correlations."""
        from scipy.stats import t

        base, jacobian = self._jacobian(self._x, 1e-4)
        weight = 1 / np.sqrt(1 + base * base)  # of the loss soft_l1
        bread = np.einsum("imk,jmk,mk->ij", jacobian, jacobian, weight)
        scores = np.einsum("imk,mk->mi", jacobian, weight * base)
        count = int(clusters.max()) + 1
        sums = np.zeros((count, len(bread)))
        np.add.at(sums, clusters, scores)
        size = np.sqrt(np.diag(bread))
        felt = size > 1e-9 * size.max(initial=1e-300)
        size = np.where(felt, size, 1.0)
        scale = np.outer(size, size)
        inverse = np.linalg.pinv(bread / scale, rcond=1e-13, hermitian=True)
        spread = inverse @ (sums.T @ sums / scale) @ inverse * (count / (count - 1))
        deviation = np.sqrt(np.maximum(np.diag(spread), 0)) / size
        half = np.where(felt, deviation * t.ppf(0.975, count - 1), np.inf) * self._scales
        root = np.where(felt, np.sqrt(np.diag(inverse)), 1.0)
        # More drag than a physics step can follow is no estimate.
        stiffest = 0.5 * self.vehicle.mass / self.windows.period
        half[self._is_drag & (self._x * self._scales > stiffest)] = np.inf
        return half, inverse / np.outer(root, root)

    def _jacobian(self, x: Floats, step: float) -> tuple[Floats, Floats]:
        """Residuals (M, K), and their slopes (n, M, K): all are one stacked prediction."""
        steps = step * np.maximum(np.abs(x), 1e-2)
        rows = self._rows(np.concatenate((x[None], x + np.diag(steps))))
        return rows[0], (rows[1:] - rows[0]) / steps[:, None, None]

    def numbers_at(self, x: Floats) -> dict[str, float]:
        """All numbers at a point; a derived class may tie others to those that are fitted."""
        fitted = zip(self.names, (x * self._scales).tolist(), strict=True)
        return {**self.numbers, **dict(fitted)}

    def _errors(self, candidates: Sequence[Numbers], start: Floats | None = None) -> Floats:
        """Differences, (P, M, H, 4, 3), of P candidates; of those with starts (P, M, 13) too."""
        windows = self.windows
        if start is not None:
            windows = replace(windows, start=start)
        if self.logs and not self.logs[0].measured:
            steps = windows.speeds.shape[1]
            speeds = np.stack([_cut(self.logs, one, steps).speeds for one in candidates])
            windows = replace(windows, speeds=speeds)
        with np.errstate(all="ignore"):
            errors = differences(predict(self.vehicle, candidates, windows), windows.truth)
        return np.clip(np.nan_to_num(errors, nan=1e6), -1e6, 1e6)

    def _weighed(self, candidates: Sequence[Numbers], start: Floats | None = None) -> Floats:
        """Errors in spreads, (P, M, 12 H)."""
        errors = self._errors(candidates, start) / self._spreads
        return errors.reshape(*errors.shape[:2], -1)

    def _weigh(self) -> None:
        """Set the spreads, and the effects of errors of the starts, as they are now."""
        numbers = self.numbers_at(self._x)
        errors = np.abs(self._errors([numbers])[0])
        # Of normal numbers with this median size; never 0.
        median = np.median(errors, axis=(0, 3))[..., None]
        self._spreads = median / 0.6745 + 1e-12
        if not self.logs:
            return
        # At the first horizon differences have the noise of two measurements, at the start of one.
        noise = np.repeat(self._spreads[0], 3) / np.sqrt(2)
        start = _shifted(self.windows.start, noise)
        rows = self._weighed([numbers] * len(start), start)
        effects = np.moveaxis(rows[1:] - rows[0], 0, -1)
        covariance = np.eye(rows.shape[-1]) + effects @ np.swapaxes(effects, 1, 2)
        self._whitener = np.linalg.inv(np.linalg.cholesky(covariance))

    def _rows(self, points: Floats) -> Floats:
        """Residuals at points (P, n): shape (P, M, K)."""
        candidates = [self.numbers_at(x) for x in points]
        rows = self._weighed(candidates)
        if self._whitener is not None:
            rows = np.einsum("mij,pmj->pmi", self._whitener, rows)
        return rows


def _shifted(start: Floats, sizes: Floats) -> Floats:
    """Start states (M, 13), and the same with each of 12 errors: shape (13, M, 13)."""
    errors = np.zeros((13, 1, 12))
    errors[1:, 0] = np.diag(sizes)
    position = start[:, :3] + errors[..., :3]
    quaternion = advanced(start[:, 3:7], errors[..., 3:6])
    rest = start[:, 7:] + errors[..., 6:]
    return np.concatenate((position, quaternion, rest), axis=-1)


def _flattened(vehicle: Vehicle, numbers: Numbers) -> dict[str, float]:
    """With the largest moment of inertia at most the sum of the others, as of every body."""
    moments, axes = np.linalg.eigh(inertia_of(vehicle, numbers))
    moments[2] = min(moments[2], (moments[0] + moments[1]) * (1 - 1e-9))
    inertia = (axes * moments) @ axes.T
    names = [f"body.inertia.{axis}" for axis in "xyz"]
    return {**numbers, **dict(zip(names, np.diag(inertia).tolist(), strict=True))}


def _scale(vehicle: Vehicle, numbers: Numbers, name: str) -> float:
    """A typical size of a number: its own, or where that is 0 that of a lively vehicle."""
    inertia = float(np.trace(vehicle.inertia)) / 3
    weight = vehicle.mass * vehicle.gravity
    lift = weight / vehicle.num_rotors
    speed = float(np.sqrt(lift / numbers["rotors.thrust_coefficient"]))
    typical = {
        "rotors.drag": 0.03 * lift / speed,
        "rotors.inflow": 0.03 * lift / speed,
        "rotors.lift": 0.03 * lift,
        "rotors.reaction": 0.01,
        "drag.linear": 0.03 * weight,
        "drag.angular": inertia,
        "drag.moment": 10 * inertia,
    }
    return abs(numbers[name]) or typical[entry_of(name)[0]]


def _lowest(name: str) -> float:
    """The least value of a number in units of its scale."""
    if name.startswith("drag.moment"):
        return -np.inf
    return 0.01 if name.startswith("body.inertia") or name == LAG else 0.0


# ---- the vehicle's file with identified numbers: docs/vehicles.md has the format

_OF_FILE = ("body.size", "body.ground_clearance", "rotors.speed")
"""Entries of a file that the vehicle itself no longer has."""


class Origin(NamedTuple):
    """Where a number of the file comes from."""

    source: str
    """Empty: the source in the vehicle's file."""
    why: str = ""


def identified_toml(vehicle: Vehicle, found: Identified) -> str:
    """The vehicle with the identified numbers, and the 95 % interval of each.

    All else is the vehicle's own, with the sources of its file where that is TOML.
    """
    source = f"identified from {', '.join(found.logs)}"
    origins: dict[str, Origin] = {}
    for estimate in found.estimates:
        entry, axis = entry_of(estimate.name)
        sentence = f"95 % interval {estimate.low:.4g} to {estimate.high:.4g}"
        if estimate.kept:
            sentence = f"the vehicle's own value, {estimate.kept}"
        if axis:
            sentence = f"{axis}: {sentence}"
        before = origins.get(entry, Origin(""))
        why = f"{before.why}; {sentence}" if before.why else sentence
        origins[entry] = Origin(before.source if estimate.kept else source, why)
    return vehicle_toml(vehicle, found.numbers, origins)


def vehicle_toml(vehicle: Vehicle, numbers: Numbers, origins: Mapping[str, Origin]) -> str:
    """A TOML file of a vehicle with other numbers; origins by their dotted names.

    The time constant is the vehicle's own unless it is among the numbers.
    """
    given = {}
    if vehicle.path.suffix.lower() == ".toml":
        given = {number.name: number for number in read_vehicle_file(vehicle.path).numbers}
    own = vehicle.path.parent.name if vehicle.path.stem == "vehicle" else vehicle.path.stem
    values = _values(vehicle, numbers)
    values |= {name: given[name].value for name in _OF_FILE if name in given}
    if "rotors.speed" in values:  # the file has it in place of the thrust
        del values["rotors.thrust"]
    lines = [
        f"name = {_written(vehicle.name)}",
        f"timestep = {vehicle.timestep!r}",
        f"gravity = {vehicle.gravity!r}",
    ]
    tables: dict[str, list[str]] = {}
    for name, value in values.items():
        origin = origins.get(name, Origin(""))
        known = given[name].source if name in given else f"as in {own}"
        text = f"value = {_written(value)}, source = {_written(origin.source or known)}"
        if origin.why:
            text += f", why = {_written(origin.why)}"
        group, _, key = name.partition(".")
        tables.setdefault(group, []).append(f"{key} = {{ {text} }}")
    for group, rows in tables.items():
        lines += ["", f"[{group}]", *rows]
        if group == "rotors":
            lines += _rotors(vehicle)
    return "\n".join([*lines, ""])


def _values(vehicle: Vehicle, numbers: Numbers) -> dict[str, ArrayLike]:
    """Values of the file's entries, but for those that a model lacks."""
    inertia = inertia_of(vehicle, numbers)
    products = [inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    values: dict[str, ArrayLike] = {
        "body.mass": vehicle.mass,
        "body.inertia": [*np.diag(inertia), *(products if np.any(products) else ())],
        "rotors.thrust": [vehicle.thrust_low.min(), vehicle.thrust_high.max()],
    }
    if vehicle.center_of_mass.any():
        values["body.center_of_mass"] = vehicle.center_of_mass
    given = vehicle.coefficients.numbers()
    changed: dict[str, list[float]] = {}
    for name, number in numbers.items():
        changed.setdefault(entry_of(name)[0], []).append(number)
    del changed["body.inertia"]
    for entry, own in {**given, **changed}.items():
        if entry in given or any(own):
            values[entry] = own[0] if len(own) == 1 and entry != "rotors.curve" else own
    if LAG in numbers:
        values.pop("rotors.time_constant_down", None)
    return values


def _rotors(vehicle: Vehicle) -> Iterator[str]:
    for rotor in vehicle.rotors:
        clockwise = np.dot(rotor.reaction, rotor.axis) > 0
        yield from (
            "",
            "[[rotors.list]]",
            f"name = {_written(rotor.name)}",
            f"position = {_written(rotor.position)}",
            f"axis = {_written(rotor.axis)}",
            f'turn = "{"cw" if clockwise else "ccw"}"',
        )


def _written(value: ArrayLike) -> str:
    """A text, a number or a list of numbers in TOML, with all digits."""
    plain = value if isinstance(value, str) else np.asarray(value, np.float64).tolist()
    return json.dumps(plain, ensure_ascii=False)
