"""Figures of a study, from its files: rows beside each other, and the paper's figures 6 to 8.

Lines are interquartile means over seeds; bands are the quartiles over seeds (from four seeds on) or
the range from the lowest to the highest seed. Curves of one row's seeds end where the shortest of
them ends. Drawn with matplotlib's object interface, so that no display or global state is involved.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import EngFormatter

from ..flights.distances import nearest
from ..flights.palette import agent_color
from ..models.vehicle import Vehicle
from ..rendering.stage import DRONE_COLORS, MAX_NAMES
from . import metrics
from .metrics import Curve, Headline, Spread
from .results import Results
from .settings import Row
from .statistics import Floats
from .swarms import World, worlds
from .tables import by_task, row_label

AVERAGING_SHARE: Final = 0.05
"""Share of training over which the average reward is a running mean."""
PAPER: Final = {
    "fig6_reward": (
        "The paper's Figure 6 says: “A2C converge slower than VPG, with much more stability”; A2C "
        "“can reach to higher average reward with minimum fluctuation”. It gives no numbers."
    ),
    "fig7_cumulative_reward": (
        "The paper's Figure 7 says: “A2C outperform the VPG on the long run”. It gives no numbers."
    ),
    "fig8_error": (
        "The paper's Figure 8 says: “A2C compensate the error with higher stability than VPG, but "
        "after much more time steps”. It gives no numbers."
    ),
}
"""What the paper publishes beside its figures, by the name of ours."""
FORMATS: Final = ("png", "pdf", "svg")

_MAX_STEP_ROWS: Final = 400_000
_MAX_TRAJECTORIES: Final = 40
_MAX_POINTS: Final = 2000
_OUTER: Final = 0.18  # opacity of the 5–95 % band
_INNER: Final = 0.38  # and of the 25–75 % band
_STYLE: Final = Path(__file__).parent / "assets" / "figures.mplstyle"
_GREY: Final = "#333333"


class Fan(NamedTuple):
    """Quantiles of the metric over windows of training: 5, 25, 50, 75 and 95 %, each of shape
    (windows,); x in env steps."""

    x: Floats
    low: Floats
    lower: Floats
    middle: Floats
    upper: Floats
    high: Floats


def draw_figures(results: Results, table: pd.DataFrame) -> list[str]:
    """Draw all figures into `figures/`, in all `FORMATS`; their names.

    Args:
        results: Of a study of which a run is done.
        table: Its `tables.results_table`.
    """
    target = results.folder / "figures"
    target.mkdir(exist_ok=True)
    names = []
    with style.context(_STYLE):
        for name, figure in _figures(results, table):
            names.append(name)
            for kind in FORMATS:
                figure.savefig(target / f"{name}.{kind}")
    return names


def _figures(results: Results, table: pd.DataFrame) -> list[tuple[str, Figure]]:
    rows = [row for row in results.study.rows if row.name in table.index]
    tasks = by_task(rows, together=results.study.kind == "sweep")
    found = []
    for task, own in tasks:
        words = "".join(letter if letter.isalnum() else "-" for letter in task).lower()
        name = "comparison" if len(tasks) == 1 else f"comparison_{words}"
        found.append((name, draw_comparison(results, table, own)))
    if results.study.kind == "paper":
        trained = [row for row in rows if not row.controller]
        found.append(("fig6_reward", draw_reward(results, trained)))
        found.append(("fig7_cumulative_reward", draw_cumulative(results, trained)))
        found.append(("fig8_error", draw_error(results, rows)))
    if len(results.positions):
        found.append(("swarm", draw_swarm(results, rows)))
    return found


def row_color(row: Row) -> str:
    """Colour of a row: that of its agent, if the row is named as its agent."""
    return agent_color(row.agent if row.name == row.agent else row.name)


# ---- rows beside each other


def draw_comparison(results: Results, table: pd.DataFrame, rows: Sequence[Row]) -> Figure:
    """Rows of one task: the steady state over training, and at its end with 95 % intervals."""
    headline = results.headline(rows[0])
    curves = learning_curves(results.evaluations, [row.name for row in rows])
    figure = Figure(figsize=(10.5, max(3.4, 1.4 + 0.35 * len(rows))), dpi=110)
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    for row in rows:
        if row.name in curves:
            _plot(left, curves[row.name], row_color(row), row_label(row), marker="o")
    if not curves:
        _say(left, "no training")
    _env_steps_axis(left)
    left.set_ylabel(headline.labelled(f"steady {headline.size_symbol} in evaluation"))
    for place, row in enumerate(reversed(rows)):
        line = table.loc[row.name]
        right.plot(line["steady"], place, "o", color=row_color(row))
        ends = [line["steady_low"], line["steady_high"]]
        right.plot(ends, [place, place], color=row_color(row), lw=2.5, alpha=0.6)
    right.set_yticks(range(len(rows)), [row_label(row) for row in reversed(rows)])
    right.set_ylim(-0.7, len(rows) - 0.3)
    right.set_xlabel(headline.labelled(f"steady {headline.size_symbol}, 95 % interval"))
    if headline.held is not None:
        left.axhline(headline.held, color=_GREY, lw=0.9, ls=":")
        right.axvline(headline.held, color=_GREY, lw=0.9, ls=":")
    if not headline.high and np.nanmin(table["steady"]) > 0:
        left.set_yscale("log")
        right.set_xscale("log")
    return figure


def learning_curves(evaluations: pd.DataFrame, names: Sequence[str]) -> dict[str, Spread]:
    """Steady state of the snapshots of each row over env steps; rows without training are not
    there.
    """
    curves = {}
    known = evaluations.dropna(subset="steady")
    for name in names:
        own = known[known["row"] == name]
        if own["env_steps"].max() > 0:
            means = own.groupby(["seed", "env_steps"])["steady"].mean().reset_index()
            curves[name] = metrics.spread_over_seeds(
                [
                    Curve(run["env_steps"].to_numpy(float), run["steady"].to_numpy(float))
                    for _, run in means.groupby("seed")
                ],
                np.unique(means["env_steps"]),
            )
    return curves


# ---- the paper's figures


def draw_reward(results: Results, rows: Sequence[Row]) -> Figure:
    """Figure 6: a panel per agent (episodes and average), and all averages in one panel."""
    runs = {row.name: metrics.training_runs(results.episodes, row.name) for row in rows}
    averages = {
        name: metrics.spread_over_seeds([metrics.average_return(r, AVERAGING_SHARE) for r in own])
        for name, own in runs.items()
        if own
    }
    shown = [row for row in rows if row.name in averages]
    figure, axes = _panels(max(1, len(shown) + (len(shown) > 1)), "fig6_reward")
    for axis, row in zip(axes, shown, strict=False):
        own = runs[row.name]
        _scatter_episodes(axis, pd.concat(own), row_color(row))
        _plot(axis, averages[row.name], row_color(row), "average reward")
        axis.set_title(f"{row_label(row)} ({len(own)} seed{'s' * (len(own) != 1)})")
    for row in shown if len(shown) > 1 else ():
        _plot(axes[-1], averages[row.name], row_color(row), row_label(row))
        axes[-1].set_title("Average reward")
    for axis in axes:
        _env_steps_axis(axis)
        axis.set_ylabel("reward per episode")
        _legend(axis)
    _share_y(axes[: len(shown)])  # the averages keep a scale of their own
    if not shown:
        _say(axes[0], "no training")
    return figure


def draw_cumulative(results: Results, rows: Sequence[Row]) -> Figure:
    """Figure 7: the sum of all rewards since training began, over env steps and over episodes."""
    figure, axes = _panels(2, "fig7_cumulative_reward")
    for row in rows:
        runs = metrics.training_runs(results.episodes, row.name)
        if not runs:
            continue
        totals = [run["return"].cumsum().to_numpy() for run in runs]
        ends = [metrics.episode_ends(run) for run in runs]
        numbers = [np.arange(1.0, len(total) + 1) for total in totals]
        for axis, grid in zip(axes, (ends, numbers), strict=True):
            curves = [Curve(x, y) for x, y in zip(grid, totals, strict=True)]
            _plot(axis, metrics.spread_over_seeds(curves), row_color(row), row_label(row))
    _env_steps_axis(axes[0])
    axes[1].set_xlabel("training episodes")
    for axis in axes:
        axis.set_ylabel("cumulative reward")
        axis.yaxis.set_major_formatter(EngFormatter(sep=""))
        _legend(axis)
    _share_y(axes)
    return figure


def draw_error(results: Results, rows: Sequence[Row]) -> Figure:
    """Figure 8: the metric in training (above) and in the final evaluation, per agent."""
    training = results.steps("train", _MAX_STEP_ROWS)
    flown = results.steps("evaluation")
    period = results.specs[rows[0].name].control_period
    headline = results.headline(rows[0])
    figure = Figure(figsize=(max(5.0, 3.1 * len(rows)), 6.0), dpi=110)
    axes = figure.subplots(2, len(rows), squeeze=False, sharey="row")
    for (above, below), row in zip(axes.T, rows, strict=True):
        above.set_title(row_label(row))
        below.set_xlabel("time in the episode (s)")
        own = training[training["row"] == row.name]
        if len(own):
            _draw_fan(above, value_fan(own), row_color(row))
        else:
            _say(above, "no training")
        curves = trajectories(flown[flown["row"] == row.name], period)
        _draw_trajectories(below, curves, row_color(row), headline)
    axes[0, 0].set_ylabel(f"training: {headline.labelled(headline.symbol)}")
    axes[1, 0].set_ylabel(f"final evaluation: {headline.labelled(headline.symbol)}")
    bands = "Above: median, 25–75 % and 5–95 % of the steps of all seeds. "
    figure.supxlabel(f"{bands}{PAPER['fig8_error']}", fontsize=8, wrap=True)
    return figure


def value_fan(steps: pd.DataFrame) -> Fan:
    """Quantiles of the metric over at most 100 windows of an agent's training steps."""
    step = steps["step"].to_numpy()
    windows = min(100, max(1, len(steps) // 50))
    width = (float(step.max()) + 1) / windows
    window = np.minimum((step / width).astype(np.int64), windows - 1)
    quantiles = steps["value"].groupby(window).quantile([0.05, 0.25, 0.5, 0.75, 0.95]).unstack()
    return Fan((quantiles.index.to_numpy() + 0.5) * width, *quantiles.to_numpy().T)


def trajectories(steps: pd.DataFrame, control_period: float) -> list[Curve]:
    """At most 40 trajectories of an agent's evaluation, at random but always the same ones: the
    metric over the time in the episode (s).
    """
    # Each begins where the step does not grow: an episode may have several drones.
    flights = (steps["step"].diff() <= 0).cumsum().rename("flight")
    found = [one for _, one in steps.groupby(["seed", "episode", flights], sort=True)]
    # At random: every n-th would be the same few start positions for every seed.
    order = np.random.default_rng(0).permutation(len(found))[:_MAX_TRAJECTORIES]
    return [
        Curve(one["step"].to_numpy() * control_period, one["value"].to_numpy())
        for one in (found[index] for index in order)
    ]


def _draw_fan(axis: Axes, fan: Fan, color: str) -> None:
    _env_steps_axis(axis)
    axis.fill_between(fan.x, fan.low, fan.high, color=color, alpha=_OUTER, lw=0)
    axis.fill_between(fan.x, fan.lower, fan.upper, color=color, alpha=_INNER, lw=0)
    axis.plot(fan.x, fan.middle, color=color, lw=1.2)
    axis.axhline(0.0, color=_GREY, lw=0.7, ls=":")


def _draw_trajectories(axis: Axes, curves: Sequence[Curve], color: str, headline: Headline) -> None:
    for time, value in curves:
        axis.plot(time, value, color=color, lw=0.8, alpha=0.45)
    if headline.held is not None and not headline.high:
        low = -headline.held if headline.signed else 0.0
        axis.axhspan(low, headline.held, color=_GREY, alpha=0.12, lw=0)
    axis.set_title(f"{len(curves)} trajectories", fontsize=8.5, color="#444444")


# ---- several drones in a world


def draw_swarm(results: Results, rows: Sequence[Row]) -> Figure:
    """One episode of each row: paths from above, and each drone's nearest other over time.

    It is the episode of the film: see `metrics.shown_runs`.
    """
    names = set(results.positions["row"])
    shown = [row for row in rows if row.name in names]
    headline = results.headline(shown[0])
    seeds, episode = metrics.shown_runs(results.runs, results.evaluations, headline)
    figure = Figure(figsize=(max(5.0, 4.2 * len(shown) + 1.2), 7.2), dpi=110)
    axes = figure.subplots(2, len(shown), squeeze=False)
    positions = results.positions[results.positions["episode"] == episode]
    found: Mapping[tuple[str, int, int], World] = dict(worlds(positions))
    for (above, below), row in zip(axes.T, shown, strict=True):
        world = found[row.name, seeds[row.name], episode]
        spec = results.specs[row.name]
        _draw_paths(above, world, spec.agents)
        _draw_distances(below, world, spec.control_period, _touching(row))
        above.set_title(row_label(row))
    axes[0, 0].set_ylabel("Z, forward (m)")
    axes[1, 0].set_ylabel("distance to the nearest other (m)")
    lines, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside right upper", title="o start   × goal")
    return figure


def _touching(row: Row) -> float:
    """Distance at which the spheres of two drones touch, m."""
    from ..models.fleet import load_vehicles

    fleet: Vehicle = load_vehicles(row.env.vehicle, row.env.drones)
    return 2 * fleet.radius


def _drone_style(drone: int) -> dict[str, Any]:
    # Yellow is told from white by its edge.
    edge = withStroke(linewidth=2.2, foreground="#555555")
    return {"color": DRONE_COLORS[drone % len(DRONE_COLORS)], "lw": 1.3, "path_effects": [edge]}


def _draw_paths(axis: Axes, world: World, names: Sequence[str]) -> None:
    for drone, name in enumerate(names):
        x, _, z = world.position[:, drone].T
        style = _drone_style(drone)
        axis.plot(x, z, label=name if drone < MAX_NAMES else None, **style)
        axis.plot(x[:1], z[:1], "o", markersize=5, **style)
        goal = world.goal[np.isfinite(world.position[:, drone, 0]), drone][-1]
        axis.plot(goal[0], goal[2], "x", markersize=6, mew=1.4, **style)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("X, right (m)")


def _draw_distances(axis: Axes, world: World, control_period: float, touching: float) -> None:
    time = np.arange(len(world.position)) * control_period
    for drone, values in enumerate(nearest(world.position).T):
        axis.plot(time, values, **_drone_style(drone))
    axis.axhline(touching, color=_GREY, lw=0.9, ls=":")
    axis.set_ylim(bottom=0.0)
    axis.set_xlabel("time in the episode (s)")


# ---- parts


def _panels(count: int, name: str) -> tuple[Figure, list[Axes]]:
    """A figure with some panels, at most three side by side, and the paper's words below."""
    columns = count if count <= 3 else 2
    rows = -(-count // columns)
    figure = Figure(figsize=(4.5 * max(columns, 2), 3.4 * rows + 0.4), dpi=110)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for unused in axes[count:]:
        unused.remove()
    figure.supxlabel(PAPER[name], fontsize=8, wrap=True)
    return figure, axes[:count]


def _plot(axis: Axes, spread: Spread, color: str, label: str, marker: str | None = None) -> None:
    """Draw a line and its band; a curve of a single point becomes a dot, so that it is seen."""
    if len(spread.x) < 2:
        marker = "o"
    axis.fill_between(spread.x, spread.low, spread.high, color=color, alpha=0.2, lw=0)
    axis.plot(spread.x, spread.middle, color=color, label=label, marker=marker, markersize=3.5)


def _scatter_episodes(axis: Axes, episodes: pd.DataFrame, color: str) -> None:
    """Draw each episode's total reward as a dot, thinned at random where there are very many."""
    shown = episodes.sample(min(len(episodes), _MAX_POINTS), random_state=0)
    axis.plot(
        metrics.episode_ends(shown), shown["return"].to_numpy(), "o", color=color,
        markersize=2.5, alpha=0.3, markeredgewidth=0, label="total reward", rasterized=True,
    )  # fmt: skip


def _legend(axis: Axes) -> None:
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8.5)
    else:
        _say(axis, "no training")


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
