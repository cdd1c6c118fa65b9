"""System identification: numbers of a vehicle from logs of its flights, with intervals.

Intervals are those of a sandwich estimator whose clusters are segments of the flights: the errors
within a segment may depend on each other in any way. A number that the data do not determine keeps
the value of the vehicle's file, and the result says why: its interval is wider than half of it, or
it cannot be distinguished from another number.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from fit import LAG, Fit, cut_logs
from flight_logs import FlightLog, Floats
from prediction import NAMES, Numbers, numbers_of
from rotorgram.models import InputError
from rotorgram.models.fields import check_names, immutable
from rotorgram.models.vehicle import Vehicle

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
    windows = cut_logs(logs, base, round(WINDOW / logs[0].period))
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
