"""Statistics over seeds: interquartile means and intervals.

The definitions are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the
Statistical Precipice" (NeurIPS 2021, arXiv 2108.13264), computed by SciPy. A bootstrap resamples
the runs of an agent, always in the same way. Missing values (nan) are left out.

SciPy is imported where it computes: workers, which fly and do not compare, start without it.
"""

from collections.abc import Callable, Sequence
from math import nan

import numpy as np
from numpy.typing import NDArray

_RESAMPLES = 2000

Floats = NDArray[np.float64]
Values = Sequence[float] | NDArray[np.floating]
Interval = tuple[float, float]


def finite(values: Values) -> Floats:
    """The values that are not missing, in their order."""
    array = np.asarray(values, float)
    return np.asarray(array[np.isfinite(array)])


def trimmed_mean(values: Values, axis: int = -1) -> Floats:
    """Mean along an axis without the lowest and the highest quarter; below four nothing is cut."""
    from scipy import stats

    return np.asarray(stats.trim_mean(values, 0.25, axis=axis))


def iqm(values: Values) -> float:
    """Interquartile mean: `trimmed_mean`; nan if there is no value."""
    known = finite(values)
    return float(trimmed_mean(known)) if known.size else nan


def bootstrap_interval(values: Values) -> Interval:
    """Percentile-bootstrap interval of `iqm`, at a level of 95 %.

    Fewer than two values give (nan, nan): one seed shows no spread. With few seeds the
    interval is narrower than it should be: it has the true value in 86 to 93 %
    of the cases with five runs, and in 91 % or more from ten on (400 simulated cases of a normal, a
    lognormal and a two-humped distribution each).
    """
    return _bootstrap([values], trimmed_mean, 0.95)


def bootstrap_difference(
    first: Values, second: Values, level: float = 0.95
) -> tuple[float, float, float]:
    """iqm(first) - iqm(second) over seeds, and the ends of its percentile-bootstrap interval.

    The runs of the two agents are resampled independently. Runs of one seed share their starting
    states; as far as this makes them alike, the interval is wider than it need be.
    """
    low, high = _bootstrap([first, second], _difference, level)
    return iqm(first) - iqm(second), low, high


def share_interval(count: int, total: int, level: float = 0.95) -> Interval:
    """Wilson's interval of a share, of `count` cases out of `total`; (nan, nan) of none."""
    if total == 0:
        return nan, nan
    from scipy import stats

    interval = stats.binomtest(count, total).proportion_ci(level, method="wilson")
    return float(interval.low), float(interval.high)


# ---- parts


def _bootstrap(
    samples: Sequence[Values], statistic: Callable[..., Floats], level: float
) -> Interval:
    """Ends of the interval; nan if a sample has fewer than two values."""
    known = [finite(values) for values in samples]
    if min(values.size for values in known) < 2:
        return nan, nan
    from scipy import stats

    found = stats.bootstrap(
        known,
        statistic,
        n_resamples=_RESAMPLES,
        confidence_level=level,
        method="percentile",
        vectorized=True,
        random_state=np.random.default_rng(0),
    )
    interval = found.confidence_interval
    return float(interval.low), float(interval.high)


def _difference(first: Floats, second: Floats, axis: int) -> Floats:
    return trimmed_mean(first, axis) - trimmed_mean(second, axis)
