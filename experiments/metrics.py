"""What is measured of a flight and of a set of runs: pure functions of arrays and frames.

Over an episode: `steady_state_error`, `settling_time`, `overshoot`. Over seeds: the interquartile
mean (`iqm`) with a percentile-bootstrap interval, as Agarwal et al. ("Deep Reinforcement Learning
at the Edge of the Statistical Precipice", 2021) recommend for few runs. `results_table` puts them
together.

How episodes that end early (a crash) enter: the steady-state error, the overshoot and the return
are those of what was flown; the settling time is missing, and the table says how many episodes
settled and how many crashed; a snapshot with a crash in it does not count as holding the target.
"""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from .records import sort_agents

__all__ = [
    "HOLD_THRESHOLD",
    "SETTLING_TOLERANCE",
    "Curve",
    "Spread",
    "average_return",
    "bootstrap_difference",
    "bootstrap_interval",
    "env_steps_to_reach",
    "episode_ends",
    "final_evaluations",
    "final_per_run",
    "iqm",
    "overshoot",
    "results_table",
    "seconds_to_reach",
    "settling_time",
    "spread_over_seeds",
    "steady_state_error",
    "training_runs",
]

SETTLING_TOLERANCE: Final = 0.05
"""|E| below which an episode counts as settled, m. Ours: the paper gives none."""

HOLD_THRESHOLD: Final = 0.1
"""Steady-state |E| below which an agent counts as holding its target, m. Ours."""

_RESAMPLES: Final = 2000

FloatArray = npt.NDArray[np.floating[Any]]
Values = Sequence[float] | npt.NDArray[np.floating[Any]]


class Curve(NamedTuple):
    """One seed's curve: x ascending, both of shape (n,)."""

    x: npt.NDArray[np.float64]
    y: npt.NDArray[np.float64]


class Spread(NamedTuple):
    """Several seeds' curves on one grid, each of shape (m,)."""

    x: npt.NDArray[np.float64]
    middle: npt.NDArray[np.float64]
    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]


def steady_state_error(errors: FloatArray) -> float:
    """Mean |E| in the last quarter of an episode (at least its last step), m.

    Args:
        errors: E at every control step, shape (T,), m.

    Returns:
        nan for an episode without steps.
    """
    values = np.abs(np.asarray(errors, dtype=np.float64))
    if values.size == 0:
        return float("nan")
    return float(values[-max(1, values.size // 4) :].mean())


def settling_time(
    errors: FloatArray, control_period: float, tolerance: float = SETTLING_TOLERANCE
) -> float:
    """Time from which |E| stays below the tolerance until the episode ends, s.

    Args:
        errors: E at every control step, shape (T,), m; `errors[0]` is at time 0.
        control_period: Time between two control steps, s.
        tolerance: Half width of the band around the target, m.

    Returns:
        nan if the last error lies outside the band, or if there is none. An episode that crashes
        has not settled whatever its errors say; the caller knows, this function does not.
    """
    outside = ~(np.abs(np.asarray(errors, dtype=np.float64)) < tolerance)
    if outside.size == 0 or outside[-1]:
        return float("nan")
    return float(outside.nonzero()[0][-1] + 1) * control_period if outside.any() else 0.0


def overshoot(errors: FloatArray) -> float:
    """How far the craft passed its target, m: the largest -sign(E_0)·E, at least 0.

    An episode that begins exactly on its target has no side to pass to: its largest |E| counts.

    Args:
        errors: E at every control step, shape (T,), m.

    Returns:
        nan for an episode without steps.
    """
    values = np.asarray(errors, dtype=np.float64)
    if values.size == 0:
        return float("nan")
    if values[0] == 0.0:
        return float(np.abs(values).max())
    return max(0.0, float((-np.sign(values[0]) * values).max()))


def _finite(values: Values) -> npt.NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    return array[np.isfinite(array)]


def iqm(values: Values) -> float:
    """Interquartile mean: the mean without the lowest and the highest quarter of the values.

    Below four values nothing is cut. Missing values are left out; nan if none is left.
    """
    finite = _finite(values)
    return float(stats.trim_mean(finite, 0.25)) if finite.size else float("nan")


def _resampled_iqms(values: FloatArray, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    samples = rng.choice(values, size=(_RESAMPLES, values.size), replace=True)
    return np.asarray(stats.trim_mean(samples, 0.25, axis=1), dtype=np.float64)


def bootstrap_interval(
    values: Values, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float]:
    """Percentile-bootstrap interval of the interquartile mean over seeds.

    Args:
        values: One value per seed; missing ones are left out.
        confidence: Share of the bootstrap distribution between the two ends.
        seed: Of the resampling, so that a report is the same each time it is written.

    Returns:
        (low, high). (nan, nan) for fewer than two values: one seed shows no spread, which is not
        the same as a spread of zero. With few seeds the interval is narrower than it should be.
    """
    finite = _finite(values)
    if finite.size < 2:
        return float("nan"), float("nan")
    means = _resampled_iqms(finite, np.random.default_rng(seed))
    return _ends(means, confidence)


def bootstrap_difference(
    first: Values, second: Values, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float, float]:
    """Difference between two interquartile means over seeds, with its bootstrap interval.

    The runs of the two agents are resampled independently, although runs of one seed share their
    starting states, and VPG's and A2C's also the actor's first weights and the stream of noise. As
    far as this makes the runs of a seed alike, the interval is wider than it need be.

    Returns:
        (iqm(first) - iqm(second), low, high); the ends are nan where either side has fewer than
        two values.
    """
    one, other = _finite(first), _finite(second)
    difference = iqm(one) - iqm(other)
    if min(one.size, other.size) < 2:
        return difference, float("nan"), float("nan")
    rng = np.random.default_rng(seed)
    return difference, *_ends(_resampled_iqms(one, rng) - _resampled_iqms(other, rng), confidence)


def _ends(means: npt.NDArray[np.float64], confidence: float) -> tuple[float, float]:
    low, high = np.quantile(means, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def training_runs(episodes: pd.DataFrame, agent: str) -> list[pd.DataFrame]:
    """Split an agent's training episodes into one frame per seed, in order."""
    own = episodes[episodes["agent"] == agent].sort_values(["seed", "first_step"], kind="stable")
    return [run for _, run in own.groupby("seed")]


def episode_ends(episodes: pd.DataFrame) -> npt.NDArray[np.float64]:
    """Env step of the run at which each training episode ended, shape (episodes,)."""
    ends = episodes["first_step"].to_numpy() + episodes["length"].to_numpy()
    return np.asarray(ends, dtype=np.float64)


def average_return(run: pd.DataFrame, share: float) -> Curve:
    """Running mean of one run's return, over the episodes that ended in the last `share` of it.

    Args:
        run: The training episodes of one run, in order.
        share: Of the run's env steps, 0 to 1.

    Returns:
        A point at the end of every episode; that episode is always in its mean.
    """
    ends = episode_ends(run)
    total = np.concatenate([[0.0], np.cumsum(run["return"].to_numpy())])
    last = np.arange(1, len(ends) + 1)
    first = np.minimum(np.searchsorted(ends, ends - share * ends[-1], side="right"), last - 1)
    return Curve(ends, (total[last] - total[first]) / (last - first))


def spread_over_seeds(
    curves: Sequence[Curve], grid: npt.NDArray[np.float64] | None = None
) -> Spread:
    """Put several seeds' curves on one grid: interquartile mean and spread.

    Args:
        curves: One per seed, at least one, of at least one point each.
        grid: Ascending, shape (m,); 300 even points if not given.

    Returns:
        The grid's points that all curves reach. `low` and `high` are the quartiles over seeds, or
        the extremes below four seeds, where quartiles would be made up.
    """
    start = max(curve.x[0] for curve in curves)
    end = min(curve.x[-1] for curve in curves)
    if grid is None:
        grid = np.linspace(start, max(start, end), 300)
    x = np.asarray(grid[(grid >= start) & (grid <= end)], dtype=np.float64)
    values = np.stack([np.interp(x, curve.x, curve.y) for curve in curves])
    quartiles = (0.25, 0.75) if len(curves) >= 4 else (0.0, 1.0)
    low, high = np.quantile(values, quartiles, axis=0)
    return Spread(x, np.asarray(stats.trim_mean(values, 0.25, axis=0)), low, high)


def env_steps_to_reach(evaluations: pd.DataFrame, threshold: float = HOLD_THRESHOLD) -> float:
    """Training after which one run holds its target for good, env steps.

    A snapshot is judged by few episodes, in which even an untrained network can pass by luck:
    hence a snapshot counts only if none after it fails.

    Args:
        evaluations: The evaluation episodes of one run (one agent, one seed).
        threshold: Bound on a snapshot's mean steady-state |E|, m.

    Returns:
        `env_steps` of the first snapshot from which on every snapshot stays below the threshold
        without a crash; nan if there is none.
    """
    return _first_lasting_snapshot(evaluations, "env_steps", threshold)


def seconds_to_reach(evaluations: pd.DataFrame, threshold: float = HOLD_THRESHOLD) -> float:
    """As `env_steps_to_reach`, in seconds of training."""
    return _first_lasting_snapshot(evaluations, "seconds", threshold)


def _first_lasting_snapshot(evaluations: pd.DataFrame, column: str, threshold: float) -> float:
    # A crash, or an error that is missing, must not vanish in a mean that skips it.
    held = evaluations["steady_error"].fillna(np.inf).mask(evaluations["terminated"], np.inf)
    snapshots = (
        evaluations.assign(held=held)
        .groupby("env_steps", sort=True)
        .agg(held=("held", "mean"), seconds=("seconds", "max"))
        .reset_index()
    )
    misses = (~(snapshots["held"].to_numpy() < threshold)).nonzero()[0]
    first = int(misses[-1]) + 1 if misses.size else 0
    return float(snapshots[column].iloc[first]) if first < len(snapshots) else float("nan")


def final_evaluations(evaluations: pd.DataFrame) -> pd.DataFrame:
    """The evaluation episodes of each run's last snapshot (the largest `env_steps`)."""
    last = evaluations.groupby(["agent", "seed"])["env_steps"].transform("max")
    return evaluations[evaluations["env_steps"] == last]


def final_per_run(evaluations: pd.DataFrame) -> pd.DataFrame:
    """One row per run (agent, seed): the means over the episodes of its final evaluation.

    `settling_time` is the mean over the episodes that settled (nan if none did); `episodes`,
    `settled` and `crashed` count them.
    """
    final = final_evaluations(evaluations)
    final = final.assign(
        # The records leave a crash's settling time empty; a value there would be a mistake.
        settling_time=final["settling_time"].mask(final["terminated"])
    )
    groups = final.groupby(["agent", "seed"], sort=True)
    return groups.agg(
        **{name: (name, "mean") for name in ("steady_error", "settling_time", "overshoot")},
        **{"return": ("return", "mean")},
        episodes=("episode", "size"),
        settled=("settling_time", "count"),
        crashed=("terminated", "sum"),
    ).reset_index()


def results_table(evaluations: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Tabulate the final evaluations and the training of all agents.

    Args:
        evaluations: As of `records.read_evaluations`.
        runs: As of `records.read_runs`.

    Returns:
        One row per agent, indexed by `agent`. For each of steady_error (m), settling_time (s),
        overshoot (m) and return: the interquartile mean over seeds, and `_low` and `_high` of its
        95 % interval. Counts: seeds, episodes, settled, crashed. For agents that were trained:
        env_steps_to_reach and seconds_to_reach (interquartile mean over the `reached` of `seeds`
        seeds that hold |E| < 0.1 m for good) and steps_per_second; nan for the others.
    """
    final = final_per_run(evaluations)
    rows = {}
    for agent in sort_agents(evaluations["agent"]):
        own = evaluations[evaluations["agent"] == agent]
        trained = runs[(runs["agent"] == agent) & (runs["env_steps"] > 0)]
        rows[agent] = _final_row(final[final["agent"] == agent]) | _training_row(own, trained)
    table = pd.DataFrame.from_dict(rows, orient="index")
    table.index.name = "agent"
    return table


def _final_row(final: pd.DataFrame) -> dict[str, float]:
    row: dict[str, float] = {"seeds": len(final)}
    for name in ("steady_error", "settling_time", "overshoot", "return"):
        values = final[name].to_numpy()
        row[name] = iqm(values)
        row[f"{name}_low"], row[f"{name}_high"] = bootstrap_interval(values)
    return row | {name: int(final[name].sum()) for name in ("episodes", "settled", "crashed")}


def _training_row(evaluations: pd.DataFrame, runs: pd.DataFrame) -> dict[str, float]:
    if runs.empty:
        names = ("reached", "env_steps_to_reach", "seconds_to_reach", "steps_per_second")
        return dict.fromkeys(names, float("nan"))
    own_runs = [run for _, run in evaluations.groupby("seed")]
    steps = [env_steps_to_reach(run) for run in own_runs]
    return {
        "reached": int(np.isfinite(steps).sum()),
        "env_steps_to_reach": iqm(steps),
        "seconds_to_reach": iqm([seconds_to_reach(run) for run in own_runs]),
        "steps_per_second": iqm(runs["steps_per_second"].to_numpy()),
    }
