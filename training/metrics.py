"""Measures of a trajectory and of a run: pure functions of arrays and frames.

Over an episode: `steady_state`, `settling_time`, `overshoot` of the headline metric. Over the
episodes of a run's evaluation: `measure_run`. Over seeds: `tables.results_table`.

How episodes that end early (a crash) enter: the steady state, the overshoot and the return are
those of the flown part; the settling time is missing, and the table says how many episodes settled
and how many crashed; a run with a crash in its evaluation does not hold its goal, unless the mean
of its metric counts crashes already, as the share of landings does.
"""

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pandas import DataFrame, Series

from ..envs.spec import EnvSpec, Metric
from ..flights.trajectories import Trajectory
from ..models.errors import InputError
from ..models.fields import immutable
from .statistics import Floats, trimmed_mean

Places = NDArray[np.int64]
Measures = dict[str, float]
"""Numbers by the names of their columns."""

MEANS = ("steady", "settling_time", "overshoot", "return")


class Curve(NamedTuple):
    """One seed's curve: x ascending, both of shape (n,)."""

    x: Floats
    y: Floats


class Spread(NamedTuple):
    """Several seeds' curves on one grid, each of shape (m,)."""

    x: Floats
    middle: Floats
    low: Floats
    high: Floats


@immutable
class Headline(Metric):
    """The metric that decides, and how its numbers are read. The *size* of an error (goal `zero`)
    is its magnitude; of a metric that is to be high, its value.
    """

    @classmethod
    def of(cls, spec: EnvSpec) -> "Headline":
        """The headline metric of an env. Raises `InputError` where the env names none."""
        metric = spec.headline
        if metric is None:
            raise InputError(f"env: expected one that names a metric, got {spec.env_id}")
        return cls(**(vars(metric) | {"symbol": metric.symbol or metric.name}))

    @property
    def size_symbol(self) -> str:
        """Of the size, as |E|."""
        return f"|{self.symbol}|" if self.signed else self.symbol

    @property
    def high(self) -> bool:
        """Whether more is better."""
        return self.goal == "high"

    @property
    def settles(self) -> bool:
        """Whether a settling time is defined."""
        return self.settled is not None and not self.high

    def labelled(self, text: str) -> str:
        """A heading with the unit: "steady |E| (m)"."""
        return f"{text} ({self.unit})" if self.unit else text

    def amount(self, number: str) -> str:
        """A number with the unit: "0.1 m"."""
        return f"{number} {self.unit}".rstrip()

    @property
    def held_text(self) -> str:
        """The condition of a held goal: "|E| < 0.1 m"; empty if undefined."""
        if self.held is None:
            return ""
        sign = "≥" if self.high else "<"
        return f"{self.size_symbol} {sign} {self.amount(f'{self.held:g}')}"

    def size(self, values: Floats) -> Floats:
        """Sizes of some values, of the same shape."""
        return values if self.high else np.abs(values)

    def holds(self, sizes: ArrayLike) -> NDArray[np.bool_]:
        """Whether each mean size counts as holding the goal; false for nan, or without a bound."""
        array = np.asarray(sizes, float)
        bound = np.nan if self.held is None else self.held  # no number is above or below nan
        return np.asarray(array >= bound if self.high else array < bound)

    @property
    def counts_crashes(self) -> bool:
        """Whether the mean over the episodes says how many crashed, as the share of landings."""
        return self.final and self.high

    def crashed(self, evaluations: DataFrame) -> "Series[bool]":
        """Which episodes terminated; of a `final` metric those that did not hold its goal."""
        ended = evaluations["terminated"].astype(bool)
        return ended & ~self.holds(evaluations["steady"]) if self.final else ended


# ---- over an episode


def steady_state(sizes: Floats, *, final: bool = False) -> float:
    """Mean of the last quarter of an episode's sizes, (T,), at least of the last; nan if T = 0.

    Of a `final` metric only the last counts.
    """
    count = 1 if final else max(1, len(sizes) // 4)
    last = sizes[-count:]
    return float(last.mean()) if last.size else nan


def settling_time(errors: Floats, control_period: float, tolerance: float) -> float:
    """Time from which the error stays inside the tolerance until the episode ends, s; nan if never.

    The metric is given at every control step, shape (T,), the first at time 0; the tolerance is the
    half width of the band around zero, in the metric's unit, and the control period in s.
    """
    outside = ~(np.abs(errors) < tolerance)
    if outside.size == 0 or outside[-1]:
        return nan
    last = outside.nonzero()[0].max(initial=-1)
    return float(last + 1) * control_period


def overshoot(errors: Floats) -> float:
    """How far the craft passed its target: the largest -sign(E_0)·E of shape (T,), at least 0.

    An episode that begins on its target has the largest |E|; one without steps has nan.
    """
    if not errors.size:
        return nan
    passed = -np.sign(errors[0]) * errors if errors[0] else np.abs(errors)
    return max(0.0, float(passed.max()))


def measure_episode(trajectory: Trajectory, headline: Headline) -> Measures:
    """A trajectory as a row of the table `evaluations`, but for the columns that name the run.

    What was drawn for the episode follows in columns of its own.
    """
    values = trajectory.headline
    steady = steady_state(headline.size(values[1:]), final=headline.final)
    reached = headline.final and bool(headline.holds(steady))
    settled = nan
    if headline.settles and (reached or not trajectory.terminated):
        settled = settling_time(values, trajectory.spec.control_period, headline.settled or 0.0)
    return {
        "episode": trajectory.episode,
        "length": len(trajectory),
        "return": float(trajectory.rewards.sum()),
        "steady": steady,
        "settling_time": settled,
        "overshoot": overshoot(values) if headline.signed else nan,
        "terminated": trajectory.terminated,
        **trajectory.drawn,
    }


# ---- over the episodes of a run's evaluation


def measure_run(evaluations: DataFrame, headline: Headline) -> Measures:
    """Measures of one run from the evaluations of all its snapshots.

    Returns:
        Means over the episodes of the last snapshot: `steady`, `settling_time` (of those that
        settled; nan if none did), `overshoot`, `return`. Counts: `episodes`, `settled`, `crashed`.
        `held`: 1 if the mean steady state holds the goal, with a value in every episode and without
        a crash that it does not count. `env_steps_to_hold`, `seconds_to_hold`: see
        `first_lasting_snapshot`; nan for an agent that is not trained.
    """
    last = evaluations["env_steps"].max()
    final = evaluations[evaluations["env_steps"] == last]
    crashed = headline.crashed(final)
    final = final.assign(settling_time=final["settling_time"].mask(crashed))
    means = {name: float(final[name].mean()) for name in MEANS}
    safe = headline.counts_crashes or not crashed.any()
    whole = bool(final["steady"].notna().all())
    steps = seconds = nan
    if last > 0:
        steps, seconds = first_lasting_snapshot(evaluations, headline)
    return {
        **means,
        "episodes": len(final),
        "settled": int(final["settling_time"].notna().sum()),
        "crashed": int(crashed.sum()),
        "held": int(safe and whole and bool(headline.holds(means["steady"]))),
        "env_steps_to_hold": steps,
        "seconds_to_hold": seconds,
    }


def first_lasting_snapshot(evaluations: DataFrame, headline: Headline) -> tuple[float, float]:
    """Env steps and seconds of training after which one run holds its goal for good; nan if never.

    They are those of the first snapshot from which on every snapshot holds its goal. Few
    episodes judge a snapshot, and even an untrained network can pass them by luck.
    """
    # A crash, or a value that is missing, must not vanish in a mean that skips it.
    never = -np.inf if headline.high else np.inf
    crashed = headline.crashed(evaluations) & (not headline.counts_crashes)
    steady = evaluations["steady"].fillna(never).mask(crashed, never)
    snapshots = evaluations.assign(steady=steady).groupby("env_steps")
    holds = headline.holds(snapshots["steady"].mean().to_numpy())
    later = np.logical_and.accumulate(holds[::-1])[::-1]
    lasting = snapshots["seconds"].max()[later]
    if lasting.empty:
        return nan, nan
    return float(lasting.index[0]), float(lasting.iloc[0])


# ---- curves


def training_runs(episodes: DataFrame, row: str) -> list[DataFrame]:
    """Training episodes of a row: one frame per seed, in the order of their ends."""
    own = episodes[episodes["row"] == row].sort_values(["seed", "last_step"], kind="stable")
    return [run for _, run in own.groupby("seed")]


def episode_ends(episodes: DataFrame) -> Floats:
    """Env step of the run at which each training episode ended, shape (episodes,)."""
    return np.asarray(episodes["last_step"], float)


def mean_returns(run: DataFrame, first: Places, last: Places) -> Floats:
    """Mean return of one run's episodes from each of the first places to before the last ones."""
    total = np.concatenate([[0.0], np.cumsum(run["return"].to_numpy())])
    return np.asarray((total[last] - total[first]) / (last - first))


def average_return(run: DataFrame, share: float) -> Curve:
    """Running mean of one run's return, over the episodes that ended in the last `share` of it: a
    point at the end of every episode, which is always in its mean.
    """
    ends = episode_ends(run)
    last = np.arange(1, len(ends) + 1)
    first = np.minimum(np.searchsorted(ends, ends - share * ends[-1], side="right"), last - 1)
    return Curve(ends, mean_returns(run, first, last))


def spread_over_seeds(curves: Sequence[Curve], grid: Floats | None = None) -> Spread:
    """Put several seeds' curves, at least one, on one grid: interquartile mean, and the
    quartiles, or below four curves the extremes.

    Of a grid, ascending, shape (m,), the points are kept that all curves reach; without one there
    are 300 even points.
    """
    start = max(curve.x[0] for curve in curves)
    end = min(curve.x[-1] for curve in curves)
    if grid is None:
        grid = np.linspace(start, max(start, end), 300)
    x = np.asarray(grid[(grid >= start) & (grid <= end)], float)
    values = np.stack([np.interp(x, curve.x, curve.y) for curve in curves])
    ends = (0.25, 0.75) if len(curves) >= 4 else (0.0, 1.0)
    low, high = np.quantile(values, ends, axis=0)
    return Spread(x, trimmed_mean(values, axis=0), low, high)
