"""Measures of a trajectory and of a set of runs: pure functions of arrays and frames.

Over an episode: `steady_state`, `settling_time`, `overshoot` of the headline metric. Over seeds:
the interquartile mean with its interval (`statistics`), the share of seeds that hold their goal,
and the worst seed. `results_table` puts them together.

How episodes that end early (a crash) enter: the steady state, the overshoot and the return are
those of the flown part; the settling time is missing, and the table says how many episodes
settled and how many crashed; a run with a crash in its evaluation does not hold its goal, unless
the mean of its metric counts crashes already, as the share of landings does.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from ..envs.spec import EnvSpec, Metric
from ..flights.palette import agent_label, sort_agents
from ..models.errors import InputError
from .statistics import Floats, Values, bootstrap_interval, iqm, trimmed_mean

_MEASURES: Final = ("steady", "settling_time", "overshoot", "return")
_COUNTS: Final = ("seeds", "episodes", "settled", "crashed")


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


@dataclass(frozen=True, kw_only=True)
class Headline(Metric):
    """The metric that decides, and how its numbers are read. The *size* of an error (goal `zero`)
    is its magnitude; of a metric that is to be high, its value.
    """

    @classmethod
    def of(cls, spec: EnvSpec) -> "Headline":
        """The headline metric of an env. Raises `InputError` where the env names none."""
        if (metric := spec.headline) is None:
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
        return f"{number} {self.unit}" if self.unit else number

    @property
    def held_text(self) -> str:
        """The condition of a held goal: "|E| < 0.1 m"; empty if undefined."""
        if self.held is None:
            return ""
        sign = "≥" if self.high else "<"
        return f"{self.size_symbol} {sign} {self.amount(f'{self.held:g}')}"

    def size(self, values: Values) -> Floats:
        """Sizes of some values; same shape, float64."""
        return np.asarray(values, float) if self.high else np.abs(np.asarray(values, float))

    def holds(self, sizes: Values) -> npt.NDArray[np.bool_]:
        """Whether each mean size counts as holding the goal; false for nan, or without a bound."""
        array = np.asarray(sizes, float)
        bound = np.nan if self.held is None else self.held  # no number is above or below nan
        return np.asarray(array >= bound if self.high else array < bound)

    @property
    def counts_crashes(self) -> bool:
        """Whether the mean over the episodes says how many crashed, as the share of landings."""
        return self.final and self.high

    def crashed(self, evaluations: pd.DataFrame) -> "pd.Series[bool]":
        """Which episodes terminated; of a `final` metric those that did not hold its goal."""
        ended = evaluations["terminated"].astype(bool)
        return ended & ~self.holds(evaluations["steady"]) if self.final else ended


def steady_state(sizes: Values, *, final: bool = False) -> float:
    """Mean of the last quarter of an episode's sizes, (T,), at least of the last; nan if T = 0.

    Of a `final` metric only the last counts.
    """
    last = np.asarray(sizes, float)[-1 if final else -max(1, len(sizes) // 4) :]
    return float(last.mean()) if last.size else math.nan


def settling_time(errors: Values, control_period: float, tolerance: float) -> float:
    """Time from which the error stays inside the tolerance until the episode ends, s; nan if never.

    The metric is given at every control step, shape (T,), the first at time 0; the tolerance is the
    half width of the band around zero, in the metric's unit, and the control period in s.
    """
    outside = ~(np.abs(np.asarray(errors, float)) < tolerance)
    if outside.size == 0 or outside[-1]:
        return math.nan
    return float(outside.nonzero()[0][-1] + 1) * control_period if outside.any() else 0.0


def overshoot(errors: Values) -> float:
    """How far the craft passed its target: the largest -sign(E_0)·E of shape (T,), at least 0.

    An episode that begins on its target has the largest |E|; one without steps has nan.
    """
    values = np.asarray(errors, float)
    if not values.size:
        return math.nan
    passed = -np.sign(values[0]) * values if values[0] else np.abs(values)
    return max(0.0, float(passed.max()))


def training_runs(episodes: pd.DataFrame, agent: str) -> list[pd.DataFrame]:
    """Split an agent's training episodes into one frame per seed, in the order of their ends."""
    own = episodes[episodes["agent"] == agent].sort_values(["seed", "last_step"], kind="stable")
    return [run for _, run in own.groupby("seed")]


def episode_ends(episodes: pd.DataFrame) -> Floats:
    """Env step of the run at which each training episode ended, shape (episodes,)."""
    return np.asarray(episodes["last_step"], float)


def average_return(run: pd.DataFrame, share: float) -> Curve:
    """Running mean of one run's return, over the episodes that ended in the last `share` of it: a
    point at the end of every episode, which is always in its mean.
    """
    ends = episode_ends(run)
    total = np.concatenate([[0.0], np.cumsum(run["return"].to_numpy())])
    last = np.arange(1, len(ends) + 1)
    first = np.minimum(np.searchsorted(ends, ends - share * ends[-1], side="right"), last - 1)
    return Curve(ends, (total[last] - total[first]) / (last - first))


def spread_over_seeds(curves: Sequence[Curve], grid: Floats | None = None) -> Spread:
    """Put several seeds' curves, at least one, on one grid: interquartile mean and `extent`.

    Of a grid, ascending, shape (m,), the points are kept that all curves reach; without one there
    are 300 even points.
    """
    start = max(curve.x[0] for curve in curves)
    end = min(curve.x[-1] for curve in curves)
    if grid is None:
        grid = np.linspace(start, max(start, end), 300)
    x = np.asarray(grid[(grid >= start) & (grid <= end)], float)
    values = np.stack([np.interp(x, curve.x, curve.y) for curve in curves])
    low, high = np.quantile(values, extent(len(curves)), axis=0)
    return Spread(x, trimmed_mean(values, axis=0), low, high)


def extent(count: int) -> tuple[float, float]:
    """Quantiles of a band over so many values: the quartiles, or the extremes below four."""
    return (0.25, 0.75) if count >= 4 else (0.0, 1.0)


def first_lasting_snapshot(evaluations: pd.DataFrame, headline: Headline) -> tuple[float, float]:
    """Env steps and seconds of training after which one run holds its goal for good; nan if never.

    They are those of the first snapshot from which on every snapshot holds its goal. Few
    episodes judge a snapshot, and even an untrained network can pass them by luck.
    """
    # A crash, or a value that is missing, must not vanish in a mean that skips it.
    never = -np.inf if headline.high else np.inf
    crashed = headline.crashed(evaluations) & (not headline.counts_crashes)
    steady = evaluations["steady"].fillna(never).mask(crashed, never)
    snapshots = evaluations.assign(steady=steady).groupby("env_steps")
    misses = ~headline.holds(snapshots["steady"].mean().to_numpy())
    lasting = snapshots["seconds"].max()[~np.logical_or.accumulate(misses[::-1])[::-1]]
    return next(((float(s), float(t)) for s, t in lasting.items()), (math.nan, math.nan))


def final_evaluations(evaluations: pd.DataFrame) -> pd.DataFrame:
    """The evaluation episodes of each run's last snapshot (the largest `env_steps`)."""
    last = evaluations.groupby(["agent", "seed"])["env_steps"].transform("max")
    return evaluations[evaluations["env_steps"] == last]


def final_per_run(evaluations: pd.DataFrame, headline: Headline) -> pd.DataFrame:
    """One row per run (agent, seed): the means over the episodes of its final evaluation.

    `settling_time` is the mean over the episodes that settled (nan if none did); `episodes`,
    `settled` and `crashed` count them. `held`: whether its mean steady state holds the goal, with
    a value in every episode and without a crash that this does not count.
    """
    final = final_evaluations(evaluations)
    # Files leave a crash's settling time empty; a value there would be a mistake.
    crashed = headline.crashed(final)
    settling_time = final["settling_time"].mask(crashed)
    missing = final["steady"].isna()
    final = final.assign(settling_time=settling_time, missing=missing, crashed=crashed)
    rows = final.groupby(["agent", "seed"], sort=True).agg(
        **{name: (name, "mean") for name in _MEASURES},
        episodes=("episode", "size"),
        settled=("settling_time", "count"),
        crashed=("crashed", "sum"),
        missing=("missing", "sum"),
    ).reset_index()  # fmt: skip
    whole = ((rows["crashed"] == 0) | headline.counts_crashes) & (rows.pop("missing") == 0)
    return rows.assign(held=headline.holds(rows["steady"].to_numpy()) & whole)


def shown_runs(evaluations: pd.DataFrame, headline: Headline) -> tuple[dict[str, int], int]:
    """What a film and a picture of paths show: a seed of each agent, and an episode.

    Of an agent's seeds the middle one, by the steady state in the final evaluation (of an even
    number the better of the two in the middle); of the episodes of that evaluation the one that
    starts furthest from its goal.
    """
    final = final_per_run(evaluations, headline)
    shown = final_evaluations(evaluations)
    starts = headline.size(shown["start"].to_numpy())
    seeds = {}
    for agent in sort_agents(final["agent"]):
        runs = final[final["agent"] == agent]
        runs = runs.sort_values("steady", ascending=not headline.high, kind="stable")
        seeds[agent] = int(runs["seed"].iloc[(len(runs) - 1) // 2])
    return seeds, int(shown["episode"].iloc[int(np.argmax(starts))])


def run_label(evaluations: pd.DataFrame, agent: str, seed: int) -> str:
    """Name of an agent's run: with its seed where there are others."""
    several = evaluations.loc[evaluations["agent"] == agent, "seed"].nunique() > 1
    return agent_label(agent) + (f", seed {seed}" if several else "")


def results_table(
    evaluations: pd.DataFrame,
    runs: pd.DataFrame,
    headline: Headline,
    bounds: Mapping[str, float] | None = None,
) -> pd.DataFrame:
    """Tabulate the final evaluations and the training of all agents.

    Args:
        evaluations: As of `results.Results`, and so are `runs` and `headline`.
        bounds: Mean returns that no agent reached but physics or idleness gives, by name.

    Returns:
        One row per agent, then one per bound, indexed by `agent`. For each of steady,
        settling_time (s), overshoot and return: the interquartile mean over seeds, and `_low` and
        `_high` of its 95 % interval. `held`: seeds that hold the goal; `worst`: the worst seed's
        steady state. Counts: seeds, episodes, settled, crashed. For agents that were trained:
        env_steps_to_reach and seconds_to_reach (interquartile mean over the `reached` of `seeds`
        seeds that hold the goal for good) and steps_per_second. A bound has a return alone.
    """
    final = final_per_run(evaluations, headline)
    rows: dict[str, dict[str, float]] = {}
    for agent in sort_agents(evaluations["agent"]):
        own = final[final["agent"] == agent]
        row: dict[str, float] = {"seeds": len(own)}
        for name in _MEASURES:
            row[name] = iqm(own[name])
            row[f"{name}_low"], row[f"{name}_high"] = bootstrap_interval(own[name])
        row["held"] = math.nan if headline.held is None else own["held"].sum()
        row["worst"] = own["steady"].agg("min" if headline.high else "max")
        row |= own[["episodes", "settled", "crashed"]].sum().to_dict()
        trained = runs[(runs["agent"] == agent) & (runs["env_steps"] > 0)]
        row["reached"], steps, seconds = math.nan, np.empty(0), np.empty(0)
        if len(trained) and headline.held is not None:
            seeds = evaluations[evaluations["agent"] == agent].groupby("seed")
            steps, seconds = np.array([first_lasting_snapshot(run, headline) for _, run in seeds]).T
            row["reached"] = np.isfinite(steps).sum()
        row |= {"env_steps_to_reach": iqm(steps), "seconds_to_reach": iqm(seconds)}
        row["steps_per_second"] = iqm(trained["steps_per_second"])
        rows[agent] = row
    for name, value in (bounds or {}).items():
        rows[name] = {**dict.fromkeys(_COUNTS, 0), "return": value}
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("agent")
    return table.astype(dict.fromkeys(_COUNTS, "int64"))
