"""The figures of a comparison, drawn from its files: the paper's 6 to 8 and a learning curve.

Lines are interquartile means over seeds; bands are the quartiles over seeds (from four seeds on) or
the range from the lowest to the highest seed. Curves of one agent's seeds end where the shortest of
them ends. Drawn with matplotlib's object interface, so that no display or global state is involved.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter

from .metrics import (
    HOLD_THRESHOLD,
    Curve,
    Spread,
    average_return,
    episode_ends,
    iqm,
    spread_over_seeds,
    training_runs,
)
from .records import (
    Records,
    read_records,
    read_steps,
    sort_agents,
)

__all__ = ["FIGURE_FILES", "agent_color", "agent_label", "draw_figures"]

FIGURE_FILES: Final = (
    "fig6_reward.png",
    "fig7_cumulative_reward.png",
    "fig8_elevation_error.png",
    "learning_curve.png",
)

AVERAGING_SHARE: Final = 0.05
"""Share of training over which the average reward is a running mean."""

_LABELS: Final = {"vpg": "VPG", "a2c": "A2C", "sb3-a2c": "SB3 A2C", "pid": "PID"}
# Okabe and Ito's palette: told apart by readers with colour-blindness.
_COLORS: Final = {"vpg": "#D55E00", "a2c": "#0072B2", "sb3-a2c": "#009E73", "pid": "#555555"}
_SPARE_COLORS: Final = ("#CC79A7", "#E69F00", "#56B4E9", "#8C564B")
_MAX_POINTS: Final = 2000
_MAX_STEP_ROWS: Final = 400_000
_OUTER: Final = 0.18  # opacity of the 5–95 % band
_INNER: Final = 0.38  # and of the 25–75 % band
_STYLE: Final[dict[Any, Any]] = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.7,
    "axes.edgecolor": "#777777",
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "legend.frameon": False,
    "lines.linewidth": 1.7,
    "figure.constrained_layout.use": True,
}

_TIGHT: Final[dict[str, Any]] = {
    "borderaxespad": 0.0,
    "columnspacing": 1.0,
    "handlelength": 1.2,
    "handletextpad": 0.5,
    "fontsize": 8.5,
}


def agent_label(agent: str) -> str:
    """Give the name under which an agent is shown."""
    return _LABELS.get(agent, agent)


def agent_color(agent: str) -> str:
    """Give an agent's colour, the same in every figure and every report."""
    spare = _SPARE_COLORS[sum(agent.encode()) % len(_SPARE_COLORS)]
    return _COLORS.get(agent, spare)


def draw_figures(folder: Path | str, records: Records | None = None) -> list[Path]:
    """Draw all figures of a comparison into `figures/` inside its folder.

    Agents or runs that are missing are left out of the figures; a panel with nothing in it says so.

    Args:
        folder: Where `rotorgram compare` wrote its records.
        records: What `read_records(folder)` gave, where it is at hand.

    Returns:
        The PNG files, in the order of `FIGURE_FILES`.
    """
    records = records or read_records(folder)
    target = Path(folder) / "figures"
    target.mkdir(exist_ok=True)
    # Bound to the folder here, so that the step rows are in memory only while they are drawn.
    draw: tuple[Callable[[], Figure], ...] = (
        lambda: _draw_reward(records.episodes),
        lambda: _draw_cumulative(records.episodes),
        lambda: _draw_error(Path(folder), records),
        lambda: _draw_learning_curve(records.evaluations),
    )
    paths = []
    with rc_context(_STYLE):
        for name, make in zip(FIGURE_FILES, draw, strict=True):
            make().savefig(target / name, format="png")
            paths.append(target / name)
    return paths


def _draw_reward(episodes: pd.DataFrame) -> Figure:
    """Draw figure 6: a panel per agent (episodes and average), and all averages in one panel."""
    agents = sort_agents(episodes["agent"])
    panels = max(1, len(agents) + (len(agents) > 1))
    figure, axes = _panels(panels)
    everything = axes[-1] if len(agents) > 1 else None
    for axis, agent in zip(axes, agents, strict=False):
        runs = training_runs(episodes, agent)
        spread = spread_over_seeds([average_return(run, AVERAGING_SHARE) for run in runs])
        _scatter_episodes(axis, pd.concat(runs), agent)
        _plot(axis, spread, agent, label="average reward")
        axis.set_title(f"{agent_label(agent)} ({_seeds(len(runs))})")
        _legend_above(axis)
        if everything is not None:
            _plot(everything, spread, agent)
    if everything is not None:
        everything.set_title("Average reward")
        _legend_above(everything)
    for axis in axes:
        _env_steps_axis(axis)
    for axis in axes[:: _columns(panels)]:
        axis.set_ylabel("reward per episode")
    _share_y(axes[: len(agents)])  # the averages keep a scale of their own
    if not agents:
        _say(axes[0], "no training")
    return figure


def _draw_cumulative(episodes: pd.DataFrame) -> Figure:
    """Draw figure 7: the cumulative reward over env steps and over episodes."""
    figure, axes = _panels(2)
    for agent in sort_agents(episodes["agent"]):
        runs = training_runs(episodes, agent)
        totals = [run["return"].cumsum().to_numpy() for run in runs]
        by_step = [Curve(episode_ends(run), total) for run, total in zip(runs, totals, strict=True)]
        by_episode = [Curve(np.arange(1.0, len(total) + 1), total) for total in totals]
        _plot(axes[0], spread_over_seeds(by_step), agent)
        _plot(axes[1], spread_over_seeds(by_episode), agent)
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


def _draw_error(folder: Path, records: Records) -> Figure:
    """Draw figure 8: E in training (above) and in the final evaluation (below), per agent."""
    training = read_steps(folder, "train", ("agent", "step", "error"), max_rows=_MAX_STEP_ROWS)
    flown = read_steps(folder, "evaluation")
    period = float(records.config["env"]["control_period"])
    agents = sort_agents(records.evaluations["agent"])
    figure = Figure(figsize=(max(5.0, 3.1 * len(agents)), 5.6), dpi=110)
    axes = figure.subplots(2, max(1, len(agents)), squeeze=False, sharey="row")
    for (above, below), agent in zip(axes.T, agents, strict=False):
        _training_error(above, training[training["agent"] == agent], agent)
        _flown_error(below, flown[flown["agent"] == agent], agent, period)
        above.set_title(agent_label(agent))
        below.set_xlabel("time in the episode (s)")
    _explain_quantiles(figure)
    axes[0, 0].set_ylabel("training: E (m)")
    axes[1, 0].set_ylabel("final evaluation: E (m)")
    return figure


def _training_error(axis: Axes, steps: pd.DataFrame, agent: str) -> None:
    """Draw quantiles of E over windows of env steps, pooled over the agent's seeds."""
    if steps.empty:
        _say(axis, "no training")
        return
    _env_steps_axis(axis)
    step = steps["step"].to_numpy()
    windows = min(100, max(1, len(steps) // 50))
    width = (float(step.max()) + 1) / windows
    window = np.minimum((step / width).astype(np.int64), windows - 1)
    quantiles = steps["error"].groupby(window).quantile([0.05, 0.25, 0.5, 0.75, 0.95]).unstack()
    x = (quantiles.index.to_numpy() + 0.5) * width
    low, lower, middle, upper, high = quantiles.to_numpy().T
    color = agent_color(agent)
    axis.fill_between(x, low, high, color=color, alpha=_OUTER, lw=0)
    axis.fill_between(x, lower, upper, color=color, alpha=_INNER, lw=0)
    axis.plot(x, middle, color=color, lw=1.2)
    axis.axhline(0.0, color="#333333", lw=0.7, ls=":")


def _flown_error(axis: Axes, steps: pd.DataFrame, agent: str, period: float) -> None:
    """Draw E over time of every episode of the agent's final evaluations, at most 40 of them."""
    if steps.empty:
        _say(axis, "not evaluated")
        return
    flights = [flight for _, flight in steps.groupby(["seed", "episode"], sort=True)]
    # At random: every n-th would be the same few start positions for every seed.
    order = np.random.default_rng(0).permutation(len(flights))[:40]
    chosen = [flights[index] for index in order]
    for flight in chosen:
        time = flight["step"].to_numpy() * period
        axis.plot(time, flight["error"].to_numpy(), color=agent_color(agent), lw=0.8, alpha=0.45)
    axis.axhspan(-HOLD_THRESHOLD, HOLD_THRESHOLD, color="#333333", alpha=0.12, lw=0)
    count = f"{len(chosen)} of {len(flights)}" if len(chosen) < len(flights) else len(flights)
    axis.set_title(f"{count} flights", fontsize=8.5, color="#444444")


def _explain_quantiles(figure: Figure) -> None:
    """Explain the bands in grey, once for all agents' colours."""
    handles = [
        Patch(color="#444444", alpha=_OUTER, lw=0, label="5–95 %"),
        Patch(color="#444444", alpha=_INNER, lw=0, label="25–75 %"),
        Line2D([], [], color="#444444", lw=1.2, label="median of E in training"),
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=3, fontsize=8.5)


def _draw_learning_curve(evaluations: pd.DataFrame) -> Figure:
    """Draw the steady-state |E| of the snapshots over training; agents without any as a line."""
    figure, (axis,) = _panels(1)
    for agent in sort_agents(evaluations["agent"]):
        own = evaluations[evaluations["agent"] == agent].dropna(subset="steady_error")
        means = own.groupby(["seed", "env_steps"])["steady_error"].mean().reset_index()
        curves = [
            Curve(run["env_steps"].to_numpy(float), run["steady_error"].to_numpy(float))
            for _, run in means.groupby("seed")
        ]
        if means.empty:
            continue
        if means["env_steps"].max() == 0:
            value = iqm(means["steady_error"].to_numpy())
            axis.axhline(value, color=agent_color(agent), ls="--", label=agent_label(agent))
        else:
            _plot(axis, spread_over_seeds(curves, np.unique(means["env_steps"])), agent, marker="o")
    axis.axhline(HOLD_THRESHOLD, color="#333333", lw=0.9, ls=":", label=f"{HOLD_THRESHOLD} m")
    axis.set_yscale("log")
    axis.set_ylabel("steady-state |E| in evaluation (m)")
    _env_steps_axis(axis)
    if evaluations["env_steps"].max() == 0:
        axis.set_xticks([0])
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _columns(panels: int) -> int:
    return panels if panels <= 3 else 2


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    """Make a figure with some panels, at most three side by side."""
    columns = _columns(count)
    rows = -(-count // columns)
    width = {1: 7.2, 2: 4.6}.get(columns, 3.7) * columns
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
    axis.plot(
        spread.x,
        spread.middle,
        color=color,
        marker=marker,
        markersize=3.5,
        label=label or agent_label(agent),
    )


def _scatter_episodes(axis: Axes, episodes: pd.DataFrame, agent: str) -> None:
    """Draw each episode's total reward as a dot, thinned at random where there are very many."""
    shown = episodes.sample(min(len(episodes), _MAX_POINTS), random_state=0)
    few = len(shown) < 1000
    axis.plot(
        episode_ends(shown),
        shown["return"].to_numpy(),
        ls="",
        marker="o",
        markersize=3.0 if few else 2.0,
        color=agent_color(agent),
        alpha=0.4 if few else 0.2,
        markeredgewidth=0,
        label="total reward",
    )


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


def _seeds(count: int) -> str:
    return f"{count} seed{'s' * (count != 1)}"
