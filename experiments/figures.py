"""The figures of a comparison, drawn from its files: the paper's 6 to 8 and a learning curve.

What the lines and bands are is told where they are made, in `curves`. Drawn with matplotlib's
object interface, so that no display or global state is involved.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import pandas as pd
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter

from .curves import Curves, Fan, Flown
from .metrics import Headline, Spread, episode_ends, training_runs
from .palette import agent_color, agent_label, sort_agents
from .results import Results

FIGURE_FILES: Final = ("fig6_reward.png", "fig7_cumulative_reward.png", "fig8_error.png",
                       "learning_curve.png")  # fmt: skip

_MAX_POINTS: Final = 2000
_OUTER: Final = 0.18  # opacity of the 5–95 % band
_INNER: Final = 0.38  # and of the 25–75 % band
_STYLE: Final = Path(__file__).parent / "assets" / "figures.mplstyle"
_TIGHT: Final[dict[str, Any]] = {
    "borderaxespad": 0.0, "columnspacing": 1.0, "handlelength": 1.2, "handletextpad": 0.5,
    "fontsize": 8.5,
}  # fmt: skip


def draw_figures(folder: Path, results: Results, curves: Curves) -> None:
    """Draw all figures of a comparison, `FIGURE_FILES`, into `figures/` inside its folder.

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


def _draw_reward(episodes: pd.DataFrame, curves: Curves) -> Figure:
    """Draw figure 6: a panel per agent (episodes and average), and all averages in one panel."""
    agents = sort_agents(episodes["agent"])
    figure, axes = _panels(max(1, len(agents) + (len(agents) > 1)))
    for axis, agent in zip(axes, agents, strict=False):
        runs = training_runs(episodes, agent)
        _scatter_episodes(axis, pd.concat(runs), agent)
        _plot(axis, curves.average_return[agent], agent, label="average reward")
        axis.set_title(f"{agent_label(agent)} ({len(runs)} seed{'s' * (len(runs) != 1)})")
        _legend_above(axis)
    if len(agents) > 1:
        for agent in agents:
            _plot(axes[-1], curves.average_return[agent], agent)
        axes[-1].set_title("Average reward")
        _legend_above(axes[-1])
    for axis in axes:
        _env_steps_axis(axis)
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


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    """Make a figure with some panels, at most three side by side."""
    columns = count if count <= 3 else 2
    rows = -(-count // columns)
    width = {1: 7.2, 2: 4.6, 3: 3.7}[columns] * columns
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
    axis.plot(
        episode_ends(shown), shown["return"].to_numpy(), "o", markersize=3.0 if few else 2.0,
        color=agent_color(agent), alpha=0.4 if few else 0.2, markeredgewidth=0,
        label="total reward",
    )  # fmt: skip


def _env_steps_axis(axis: Axes) -> None:
    axis.set_xlabel("env steps")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))


def _share_y(axes: Sequence[Axes]) -> None:
    limits = [axis.get_ylim() for axis in axes]
    for axis in axes:
        axis.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))


def _legend_above(axis: Axes) -> None:
    """Put the legend beside the title, where no curve can be."""
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4, markerscale=2, **_TIGHT)


def _say(axis: Axes, words: str) -> None:
    # Its own ticks only: the axis may share its scale with others.
    axis.tick_params(left=False, bottom=False, labelleft=False, labelbottom=False)
    axis.grid(False)
    axis.text(0.5, 0.5, words, transform=axis.transAxes, ha="center", color="#777777")
