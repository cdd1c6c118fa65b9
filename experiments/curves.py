"""The curves of a comparison, from its files, for the figures and the report's page.

Lines are interquartile means over seeds; bands are the quartiles over seeds (from four seeds on) or
the range from the lowest to the highest seed. Curves of one agent's seeds end where the shortest of
them ends. An agent without any data for a curve is not in that curve's dictionary.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
import pandas as pd

from . import metrics
from .metrics import Curve, Headline, Spread
from .palette import sort_agents
from .results import Results, read_steps

AVERAGING_SHARE: Final = 0.05
"""Share of training over which the average reward is a running mean."""

_MAX_STEP_ROWS: Final = 400_000
_MAX_TRAJECTORIES: Final = 40
_MAX_MOMENTS: Final = 500

FloatArray = npt.NDArray[np.float64]


class Fan(NamedTuple):
    """Quantiles of the metric over windows of training: 5, 25, 50, 75 and 95 %, each of shape
    (windows,); x in env steps."""

    x: FloatArray
    low: FloatArray
    lower: FloatArray
    middle: FloatArray
    upper: FloatArray
    high: FloatArray


class Flown(NamedTuple):
    """Some trajectories of an agent's final evaluations."""

    shown: list[Curve]  # the metric over the time in the episode (s)
    total: int  # number of all trajectories


@dataclass(frozen=True, kw_only=True)
class Curves:
    """All curves of a comparison, by agent; over env steps where nothing else is said."""

    average_return: dict[str, Spread]  # running mean of the training episodes' return
    return_by_step: dict[str, Spread]  # sum of all rewards since training began
    return_by_episode: dict[str, Spread]  # the same over training episodes
    training_values: dict[str, Fan]  # the metric in training, all seeds together
    flown: dict[str, Flown]  # the metric over time (s) in the final evaluation
    flown_sizes: dict[str, Spread]  # its size there, all trajectories of all seeds together
    learning: dict[str, Spread]  # steady-state size of the snapshots
    levels: dict[str, float]  # steady-state size of the agents that were not trained


def make_curves(folder: Path | str, results: Results) -> Curves:
    """Make all curves of a comparison. Raises `ResultsError` if the step rows are not right."""
    by_step, by_episode = cumulative_returns(results.episodes)
    learning, levels = learning_curves(results.evaluations)
    metric, period = results.headline.name, results.spec.control_period
    columns = ("agent", "step", "value")
    training = read_steps(folder, metric, "train", columns, max_rows=_MAX_STEP_ROWS)
    flown = _by_agent(read_steps(folder, metric, "evaluation"))
    return Curves(
        average_return=return_curves(results.episodes),
        return_by_step=by_step,
        return_by_episode=by_episode,
        training_values={name: value_fan(rows) for name, rows in _by_agent(training)},
        flown={name: pick_trajectories(rows, period) for name, rows in flown},
        flown_sizes={name: flown_sizes(rows, period, results.headline) for name, rows in flown},
        learning=learning,
        levels=levels,
    )


def _by_agent(rows: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    return [(name, rows[rows["agent"] == name]) for name in sort_agents(rows["agent"])]


def return_curves(episodes: pd.DataFrame, share: float = AVERAGING_SHARE) -> dict[str, Spread]:
    """The running mean of the return over the last `share` of training, spread over seeds."""
    return {
        agent: metrics.spread_over_seeds([metrics.average_return(run, share) for run in runs])
        for agent, runs in _runs(episodes)
    }


def cumulative_returns(episodes: pd.DataFrame) -> tuple[dict[str, Spread], dict[str, Spread]]:
    """The sum of all rewards since training began, over env steps and over episodes (from 1)."""
    by_step, by_episode = {}, {}
    for agent, runs in _runs(episodes):
        ends = [Curve(metrics.episode_ends(run), run["return"].cumsum().to_numpy()) for run in runs]
        by_step[agent] = metrics.spread_over_seeds(ends)
        numbers = [Curve(np.arange(1.0, len(curve.x) + 1), curve.y) for curve in ends]
        by_episode[agent] = metrics.spread_over_seeds(numbers)
    return by_step, by_episode


def _runs(episodes: pd.DataFrame) -> Iterator[tuple[str, list[pd.DataFrame]]]:
    return ((name, metrics.training_runs(rows, name)) for name, rows in _by_agent(episodes))


def value_fan(steps: pd.DataFrame) -> Fan:
    """Quantiles of the metric over at most 100 windows of an agent's training steps."""
    step = steps["step"].to_numpy()
    windows = min(100, max(1, len(steps) // 50))
    width = (float(step.max()) + 1) / windows
    window = np.minimum((step / width).astype(np.int64), windows - 1)
    quantiles = steps["value"].groupby(window).quantile([0.05, 0.25, 0.5, 0.75, 0.95]).unstack()
    return Fan((quantiles.index.to_numpy() + 0.5) * width, *quantiles.to_numpy().T)


def pick_trajectories(steps: pd.DataFrame, control_period: float) -> Flown:
    """At most 40 trajectories of an agent's evaluation, at random but always the same ones."""
    found = [one for _, one in steps.groupby(["seed", "episode"], sort=True)]
    # At random: every n-th would be the same few start positions for every seed.
    order = np.random.default_rng(0).permutation(len(found))[:_MAX_TRAJECTORIES]
    curves = [Curve(one["step"].to_numpy() * control_period, one["value"].to_numpy())
              for one in (found[index] for index in order)]  # fmt: skip
    return Flown(curves, len(found))


def flown_sizes(steps: pd.DataFrame, control_period: float, headline: Headline) -> Spread:
    """Interquartile mean and spread of the size over an agent's trajectories of the evaluation, at
    most at 500 moments. One that crashed counts as long as it lasted.
    """
    last = int(steps["step"].max())
    moments = np.unique(np.linspace(0, last, min(last + 1, _MAX_MOMENTS)).round().astype(np.int64))
    shown = steps[steps["step"].isin(moments)]
    groups = [headline.size(rows.to_numpy()) for _, rows in shown.groupby("step")["value"]]
    ends = np.array([np.quantile(values, metrics.extent(len(values))) for values in groups])
    x = np.unique(shown["step"]) * control_period
    return Spread(x, np.array([metrics.iqm(values) for values in groups]), *ends.T)


def learning_curves(evaluations: pd.DataFrame) -> tuple[dict[str, Spread], dict[str, float]]:
    """Steady-state size of the snapshots of each agent over env steps; interquartile means over
    seeds of the agents that were not trained, all of whose evaluations are at 0 env steps.
    """
    curves: dict[str, Spread] = {}
    levels: dict[str, float] = {}
    for agent, own in _by_agent(evaluations.dropna(subset="steady")):
        means = own.groupby(["seed", "env_steps"])["steady"].mean().reset_index()
        if means["env_steps"].max() == 0:
            levels[agent] = metrics.iqm(means["steady"].to_numpy())
            continue
        columns = ["env_steps", "steady"]
        runs = [Curve(*run[columns].to_numpy(float).T) for _, run in means.groupby("seed")]
        curves[agent] = metrics.spread_over_seeds(runs, np.unique(means["env_steps"]))
    return curves, levels
