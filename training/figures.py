"""Curves and figures of a comparison, from its files: the paper's figures 6 to 8, and learning.

Lines are interquartile means over seeds; bands are the quartiles over seeds (from four seeds on) or
the range from the lowest to the highest seed. Curves of one agent's seeds end where the shortest of
them ends. An agent without any data for a curve is not in that curve's dictionary.

Drawn with matplotlib's object interface, so that no display or global state is involved.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import EngFormatter

from ..flights.distances import nearest
from ..flights.palette import agent_color, agent_label, sort_agents
from ..rendering.stage import DRONE_COLORS, MOST_NAMES
from . import metrics
from .metrics import Curve, Headline, Spread
from .results import Results, read_steps
from .statistics import Floats, iqm
from .swarms import World, distance_curves, worlds

AVERAGING_SHARE: Final = 0.05
"""Share of training over which the average reward is a running mean."""

_MAX_STEP_ROWS: Final = 400_000
_MAX_TRAJECTORIES: Final = 40
_MAX_MOMENTS: Final = 500


class Fan(NamedTuple):
    """Quantiles of the metric over windows of training: 5, 25, 50, 75 and 95 %, each of shape
    (windows,); x in env steps."""

    x: Floats
    low: Floats
    lower: Floats
    middle: Floats
    upper: Floats
    high: Floats


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
    distances: dict[str, Spread]  # least distance between two drones over time (s), if any


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
        distances={} if results.positions is None else distance_curves(results.positions, period),
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
    # Each begins where the step does not grow: an episode may have several drones.
    flights = (steps["step"].diff() <= 0).cumsum().rename("flight")
    found = [one for _, one in steps.groupby(["seed", "episode", flights], sort=True)]
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
    return Spread(x, np.array([iqm(values) for values in groups]), *ends.T)


def learning_curves(evaluations: pd.DataFrame) -> tuple[dict[str, Spread], dict[str, float]]:
    """Steady-state size of the snapshots of each agent over env steps; interquartile means over
    seeds of the agents that were not trained, all of whose evaluations are at 0 env steps.
    """
    curves: dict[str, Spread] = {}
    levels: dict[str, float] = {}
    for agent, own in _by_agent(evaluations.dropna(subset="steady")):
        means = own.groupby(["seed", "env_steps"])["steady"].mean().reset_index()
        if means["env_steps"].max() == 0:
            levels[agent] = iqm(means["steady"].to_numpy())
            continue
        columns = ["env_steps", "steady"]
        runs = [Curve(*run[columns].to_numpy(float).T) for _, run in means.groupby("seed")]
        curves[agent] = metrics.spread_over_seeds(runs, np.unique(means["env_steps"]))
    return curves, levels


# ---- the figures


FIGURE_FILES: Final = ("fig6_reward.png", "fig7_cumulative_reward.png", "fig8_error.png",
                       "learning_curve.png")  # fmt: skip
SWARM_FIGURE: Final = "swarm.png"
"""Drawn too where a world has several drones."""

_MAX_POINTS: Final = 2000
_OUTER: Final = 0.18  # opacity of the 5–95 % band
_INNER: Final = 0.38  # and of the 25–75 % band
_STYLE: Final = Path(__file__).parent / "assets" / "figures.mplstyle"
_TIGHT: Final[dict[str, Any]] = {
    "borderaxespad": 0.0, "columnspacing": 1.0, "handlelength": 1.2, "handletextpad": 0.5,
    "fontsize": 8.5,
}  # fmt: skip


def draw_figures(folder: Path, results: Results, curves: Curves) -> None:
    """Draw all figures of a comparison, `FIGURE_FILES` and `SWARM_FIGURE`, into `figures/`.

    Agents or runs that are missing are left out of the figures; a panel with nothing in it says so.
    """
    headline = results.headline
    target = folder / "figures"
    target.mkdir(exist_ok=True)
    with style.context(_STYLE):
        figures = (
            _draw_reward(results.episodes, curves),
            _draw_cumulative(curves),
            _draw_error(sort_agents(results.evaluations["agent"]), curves, headline),
            _draw_learning_curve(results.evaluations, curves, headline),
        )
        for name, figure in zip(FIGURE_FILES, figures, strict=True):
            figure.savefig(target / name)
        if results.positions is not None:
            _draw_swarm(results, results.positions).savefig(target / SWARM_FIGURE)


def _draw_reward(episodes: pd.DataFrame, curves: Curves) -> Figure:
    """Draw figure 6: a panel per agent (episodes and average), and all averages in one panel."""
    agents = list(curves.average_return)
    figure, axes = _panels(max(1, len(agents) + (len(agents) > 1)))
    for axis, agent in zip(axes, agents, strict=False):
        runs = metrics.training_runs(episodes, agent)
        _scatter_episodes(axis, pd.concat(runs), agent)
        _plot(axis, curves.average_return[agent], agent, label="average reward")
        axis.set_title(f"{agent_label(agent)} ({len(runs)} seed{'s' * (len(runs) != 1)})")
    if len(agents) > 1:
        for agent in agents:
            _plot(axes[-1], curves.average_return[agent], agent)
        axes[-1].set_title("Average reward")
    for axis in axes:
        _env_steps_axis(axis)
        if agents:  # beside the title, where no curve can be
            axis.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=4, markerscale=2, **_TIGHT)
    for axis in axes[:: 2 if len(axes) > 3 else 3]:  # the first of each row
        axis.set_ylabel("reward per episode")
    _share_y(axes[: len(agents)])  # the averages keep a scale of their own
    if not agents:
        _say(axes[0], "no training")
    return figure


def _draw_cumulative(curves: Curves) -> Figure:
    """Draw figure 7: the cumulative reward over env steps and over episodes."""
    figure, axes = _panels(2)
    for axis, spreads in zip(axes, (curves.return_by_step, curves.return_by_episode), strict=True):
        for agent, spread in spreads.items():
            _plot(axis, spread, agent)
    _env_steps_axis(axes[0])
    axes[1].set_xlabel("training episodes")
    axes[0].set_ylabel("cumulative reward")
    for axis in axes:
        axis.yaxis.set_major_formatter(EngFormatter(sep=""))
        if axis.get_legend_handles_labels()[0]:
            axis.legend(loc="upper left")
        else:
            _say(axis, "no training")
    _share_y(axes)
    return figure


def _draw_error(agents: Sequence[str], curves: Curves, headline: Headline) -> Figure:
    """Draw figure 8: the metric in training (above) and in the final evaluation, per agent."""
    figure = Figure(figsize=(max(5.0, 3.1 * len(agents)), 5.6), dpi=110)
    axes = figure.subplots(2, max(1, len(agents)), squeeze=False, sharey="row")
    for (above, below), agent in zip(axes.T, agents, strict=False):
        if agent in curves.training_values:
            _training_values(above, curves.training_values[agent], agent_color(agent))
        else:
            _say(above, "no training")
        if agent in curves.flown:
            _flown_values(below, curves.flown[agent], agent_color(agent), headline)
        else:
            _say(below, "not evaluated")
        above.set_title(agent_label(agent))
        below.set_xlabel("time in the episode (s)")
    handles = [  # in grey, once for all agents' colours
        Patch(color="#444444", alpha=_OUTER, lw=0, label="5–95 %"),
        Patch(color="#444444", alpha=_INNER, lw=0, label="25–75 %"),
        Line2D([], [], color="#444444", lw=1.2, label=f"median of {headline.symbol} in training"),
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=3, fontsize=8.5)
    axes[0, 0].set_ylabel(f"training: {headline.labelled(headline.symbol)}")
    axes[1, 0].set_ylabel(f"final evaluation: {headline.labelled(headline.symbol)}")
    return figure


def _training_values(axis: Axes, fan: Fan, color: str) -> None:
    """Draw quantiles of the metric over windows of env steps, pooled over the agent's seeds."""
    _env_steps_axis(axis)
    axis.fill_between(fan.x, fan.low, fan.high, color=color, alpha=_OUTER, lw=0)
    axis.fill_between(fan.x, fan.lower, fan.upper, color=color, alpha=_INNER, lw=0)
    axis.plot(fan.x, fan.middle, color=color, lw=1.2)
    axis.axhline(0.0, color="#333333", lw=0.7, ls=":")


def _flown_values(axis: Axes, flown: Flown, color: str, headline: Headline) -> None:
    """Draw the metric over time of some episodes of the agent's final evaluations."""
    shown, total = flown
    for time, value in shown:
        axis.plot(time, value, color=color, lw=0.8, alpha=0.45)
    if (held := headline.held) is not None:
        low = axis.get_ylim()[1] if headline.high else -held if headline.signed else 0.0
        axis.axhspan(low, held, color="#333333", alpha=0.12, lw=0)
    count = f"{len(shown)} of {total}" if len(shown) < total else total
    axis.set_title(f"{count} trajectories", fontsize=8.5, color="#444444")


def _draw_learning_curve(evaluations: pd.DataFrame, curves: Curves, headline: Headline) -> Figure:
    """Draw the steady state of the snapshots over training; agents without any as a line."""
    figure, (axis,) = _panels(1)
    for agent in sort_agents((*curves.learning, *curves.levels)):
        if agent in curves.levels:
            level, label = curves.levels[agent], agent_label(agent)
            axis.axhline(level, color=agent_color(agent), ls="--", label=label)
        else:
            _plot(axis, curves.learning[agent], agent, marker="o")
    if (held := headline.held) is not None:
        label = headline.amount(f"{held:g}")
        axis.axhline(held, color="#333333", lw=0.9, ls=":", label=label)
    if not headline.high:
        axis.set_yscale("log")
    axis.set_ylabel(headline.labelled(f"steady-state {headline.size_symbol} in evaluation"))
    _env_steps_axis(axis)
    if evaluations["env_steps"].max() == 0:
        axis.set_xticks([0])
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _draw_swarm(results: Results, positions: pd.DataFrame) -> Figure:
    """Draw one episode of each agent: paths from above, and each drone's nearest other over time.

    It is the episode of the film: see `metrics.shown_runs`.
    """
    seeds, episode = metrics.shown_runs(results.evaluations, results.headline)
    figure = Figure(figsize=(max(5.0, 4.2 * len(seeds) + 1.2), 7.2), dpi=110)
    axes = figure.subplots(2, len(seeds), squeeze=False)
    shown = dict(worlds(positions[positions["episode"] == episode]))
    diameter = results.config.get("diameter")
    for (above, below), (agent, seed) in zip(axes.T, seeds.items(), strict=True):
        world = shown[agent, seed, episode]
        _paths(above, world, results.spec.agents)
        _distances(below, world, results.spec.control_period, diameter)
        above.set_title(metrics.run_label(results.evaluations, agent, seed))
    axes[0, 0].set_ylabel("Z, forward (m)")
    axes[1, 0].set_ylabel("distance to the nearest other (m)")
    lines, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside right upper", title="o start   × goal")
    return figure


def _drone_style(drone: int) -> dict[str, Any]:
    # Yellow is told from white by its edge.
    edge = withStroke(linewidth=2.2, foreground="#555555")
    return {"color": DRONE_COLORS[drone % len(DRONE_COLORS)], "lw": 1.3, "path_effects": [edge]}


def _paths(axis: Axes, world: World, names: Sequence[str]) -> None:
    """Draw each drone's path from above, with its start and its last goal."""
    for drone, name in enumerate(names):
        x, _, z = world.position[:, drone].T
        style = _drone_style(drone)
        axis.plot(x, z, label=name if drone < MOST_NAMES else None, **style)
        axis.plot(x[:1], z[:1], "o", markersize=5, **style)
        goal = world.goal[np.isfinite(world.position[:, drone, 0]), drone][-1]
        axis.plot(goal[0], goal[2], "x", markersize=6, mew=1.4, **style)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("X, right (m)")


def _distances(axis: Axes, world: World, control_period: float, diameter: float | None) -> None:
    """Draw each drone's distance to the nearest other over time; the spheres touch at a line."""
    time = np.arange(len(world.position)) * control_period
    for drone, values in enumerate(nearest(world.position).T):
        axis.plot(time, values, **_drone_style(drone))
    if diameter is not None:
        axis.axhline(diameter, color="#333333", lw=0.9, ls=":")
    axis.set_ylim(bottom=0.0)
    axis.set_xlabel("time in the episode (s)")


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    """Make a figure with some panels, at most three side by side."""
    columns = count if count <= 3 else 2
    rows = -(-count // columns)
    width = {1: 7.2, 2: 4.6, 3: 4.4}[columns] * columns
    figure = Figure(figsize=(width, (3.6 if columns < 3 else 3.3) * rows), dpi=110)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for unused in axes[count:]:
        unused.remove()
    return figure, axes[:count]


def _plot(
    axis: Axes, spread: Spread, agent: str, label: str | None = None, marker: str | None = None
) -> None:
    """Draw a line and its band; a curve of a single point becomes a dot, so that it is seen."""
    color = agent_color(agent)
    marker = "o" if len(spread.x) < 2 else marker
    axis.fill_between(spread.x, spread.low, spread.high, color=color, alpha=0.2, lw=0)
    words = {"marker": marker, "markersize": 3.5, "label": label or agent_label(agent)}
    axis.plot(spread.x, spread.middle, color=color, **words)  # type: ignore[arg-type]


def _scatter_episodes(axis: Axes, episodes: pd.DataFrame, agent: str) -> None:
    """Draw each episode's total reward as a dot, thinned at random where there are very many."""
    shown = episodes.sample(min(len(episodes), _MAX_POINTS), random_state=0)
    few = len(shown) < 1000
    size, alpha = (3.0, 0.4) if few else (2.0, 0.2)
    axis.plot(
        metrics.episode_ends(shown), shown["return"].to_numpy(), "o", color=agent_color(agent),
        markersize=size, alpha=alpha, markeredgewidth=0, label="total reward",
    )  # fmt: skip


def _env_steps_axis(axis: Axes) -> None:
    axis.set_xlabel("env steps")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))


def _share_y(axes: Sequence[Axes]) -> None:
    limits = [axis.get_ylim() for axis in axes]
    for axis in axes:
        axis.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))


def _say(axis: Axes, words: str) -> None:
    # Its own ticks only: the axis may share its scale with others.
    axis.tick_params(left=False, bottom=False, labelleft=False, labelbottom=False)
    axis.grid(False)
    axis.text(0.5, 0.5, words, transform=axis.transAxes, ha="center", color="#777777")
