"""Least squares of the errors of predictions, over numbers of a vehicle.

The error of open-loop predictions over short windows (`prediction`) is minimised, of position,
attitude, velocity and body rates together, each divided by its own spread, with a robust loss.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from flight_logs import FlightLog, Floats, Ints, with_lag
from prediction import Numbers, Windows, differences, entry_of, inertia_of, predict
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim.rotations import advanced
from scipy.optimize import least_squares
from scipy.stats import t

LAG = "rotors.time_constant"
_ROUNDS = 2  # of estimating the spreads anew


def cut_logs(logs: Sequence[FlightLog], numbers: Numbers, steps: int) -> Windows:
    """Windows side by side, with measured speeds, or speeds that follow the commands."""
    shares = (0.2, 0.4, 0.6, 0.8, 1.0)
    horizons = sorted({1, *(max(1, round(steps * share)) for share in shares)})
    flights = list(logs)
    if not logs[0].measured:
        flights = [with_lag(log, numbers[LAG]) for log in logs]
    return Windows.cut(flights, steps, steps, horizons)


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
            speeds = np.stack([cut_logs(self.logs, one, steps).speeds for one in candidates])
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
