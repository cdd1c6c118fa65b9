"""Figures of a study, from its files: rows beside each other, and the paper's figures 6 to 8.

Lines are interquartile means over seeds; bands are the quartiles over seeds (from four seeds on) or
the range from the lowest to the highest seed. Curves of one row's seeds end where the shortest of
them ends. Drawn with matplotlib's object interface, so that no display or global state is involved.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from pandas import DataFrame, concat

from ..flights.palette import agent_color
from .metrics import (
    Curve,
    Spread,
    average_return,
    episode_ends,
    spread_over_seeds,
    training_runs,
)
from .results import Results
from .settings import Row, file_words, short_name
from .tables import by_task, row_label, seeds_text

AVERAGING_SHARE = 0.05
"""Share of training over which the average reward is a running mean."""
PAPER = {
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
FORMATS = ("png", "pdf", "svg")

_MAX_STEP_ROWS = 400_000
_MAX_TRAJECTORIES = 40
_MAX_POINTS = 2000
_BANDS = ((0.05, 0.95, 0.18), (0.25, 0.75, 0.38))  # quantiles, and the band's opacity
_STYLE = Path(__file__).parent / "assets" / "figures.mplstyle"
_GREY = "#333333"


def draw_figures(results: Results, table: DataFrame) -> list[str]:
    """Draw all figures into `figures/`, in all `FORMATS`; their names.

    Args:
        results: Of a study of which a run is done.
        table: Its `tables.results_table`.
    """
    target = results.folder / "figures"
    target.mkdir(exist_ok=True)
    rows = [row for row in results.study.rows if row.name in table.index]
    tasks = by_task(results, rows)
    figures = {}
    with style.context(_STYLE):
        for task, own in tasks:
            name = "comparison" if len(tasks) == 1 else f"comparison_{file_words(task)}"
            figures[name] = draw_comparison(results, table, own)
        if results.study.kind == "paper":
            trained = [row for row in rows if not row.controller]
            figures["fig6_reward"] = draw_reward(results, trained)
            figures["fig7_cumulative_reward"] = draw_cumulative(results, trained)
            if (results.folder / "steps").is_dir():
                figures["fig8_error"] = draw_error(results, rows)
        for name, figure in figures.items():
            for kind in FORMATS:
                figure.savefig(target / f"{name}.{kind}")
    return list(figures)


def row_color(row: Row) -> str:
    """Colour of a row: that of its agent, if the row is named as its agent."""
    return agent_color(row.agent if row.name == short_name(row.agent) else row.name)


# ---- rows beside each other


def draw_comparison(results: Results, table: DataFrame, rows: Sequence[Row]) -> Figure:
    """Rows of one task: the steady state over training, and at its end with 95 % intervals."""
    headline = results.headline(rows[0])
    names = [row.name for row in rows]
    curves = learning_curves(results.evaluations, names)
    figure = Figure(figsize=(10.5, max(3.4, 1.4 + 0.35 * len(rows))), dpi=110)
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    for place, row in enumerate(rows):
        color = row_color(row)
        line = table.loc[row.name]
        ends = [line["steady_low"], line["steady_high"]]
        right.plot(line["steady"], place, "o", color=color)
        right.plot(ends, [place, place], color=color, lw=2.5, alpha=0.6)
        if row.name in curves:
            _plot(left, curves[row.name], color, row_label(row), marker="o")
    _env_steps_axis(left)
    steady = f"steady {headline.size_symbol}"
    left.set_ylabel(headline.labelled(f"{steady} in evaluation"))
    right.set_yticks(range(len(rows)), [row_label(row) for row in rows])
    right.set_ylim(len(rows) - 0.3, -0.7)
    right.set_xlabel(headline.labelled(f"{steady}, 95 % interval"))
    if headline.held is not None:
        left.axhline(headline.held, color=_GREY, lw=0.9, ls=":")
        right.axvline(headline.held, color=_GREY, lw=0.9, ls=":")
    if not headline.high and np.nanmin(table.loc[names, "steady"]) > 0:
        left.set_yscale("log")
        right.set_xscale("log")
    return figure


def learning_curves(evaluations: DataFrame, names: Sequence[str]) -> dict[str, Spread]:
    """Steady state of the snapshots of each row over env steps; rows without training are not
    there.
    """
    curves = {}
    known = evaluations.dropna(subset="steady")
    for name in names:
        own = known[known["row"] == name]
        if own["env_steps"].max() > 0:
            means = own.groupby(["seed", "env_steps"])["steady"].mean()
            runs = [run.droplevel("seed") for _, run in means.groupby("seed")]
            points = [Curve(run.index.to_numpy(float), run.to_numpy(float)) for run in runs]
            curves[name] = spread_over_seeds(points, np.unique(own["env_steps"]))
    return curves


# ---- the paper's figures


def draw_reward(results: Results, rows: Sequence[Row]) -> Figure:
    """Figure 6: a panel per agent (episodes and average), and all averages in one panel."""
    figure, axes = _panels(len(rows) + 1, "fig6_reward")
    together = axes[-1]
    for axis, row in zip(axes, rows, strict=False):
        runs = training_runs(results.episodes, row.name)
        if runs:
            average = spread_over_seeds([average_return(run, AVERAGING_SHARE) for run in runs])
            color = row_color(row)
            dots = concat(runs)
            dots = dots.sample(min(len(dots), _MAX_POINTS), random_state=0)  # few enough to draw
            axis.plot(
                episode_ends(dots), dots["return"].to_numpy(), "o", color=color,
                markersize=2.5, alpha=0.3, markeredgewidth=0, label="total reward", rasterized=True,
            )  # fmt: skip
            _plot(axis, average, color, "average reward")
            _plot(together, average, color, row_label(row))
            axis.set_title(f"{row_label(row)} ({seeds_text(len(runs))})")
            axis.sharey(axes[0])  # the averages keep a scale of their own
    together.set_title("Average reward")
    for axis in axes:
        _env_steps_axis(axis)
        axis.set_ylabel("reward per episode")
    return figure


def draw_cumulative(results: Results, rows: Sequence[Row]) -> Figure:
    """Figure 7: the sum of all rewards since training began, over env steps and over episodes."""
    figure, (left, right) = _panels(2, "fig7_cumulative_reward")
    right.sharey(left)
    for row in rows:
        over_steps = []
        over_episodes = []
        for run in training_runs(results.episodes, row.name):
            total = run["return"].cumsum().to_numpy()
            over_steps.append(Curve(episode_ends(run), total))
            over_episodes.append(Curve(np.arange(1.0, len(total) + 1), total))
        if over_steps:
            for axis, curves in ((left, over_steps), (right, over_episodes)):
                _plot(axis, spread_over_seeds(curves), row_color(row), row_label(row))
    _env_steps_axis(left)
    right.set_xlabel("training episodes")
    left.set_ylabel("cumulative reward")
    left.yaxis.set_major_formatter(EngFormatter(sep=""))
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
        color = row_color(row)
        above.set_title(row_label(row))
        above.axhline(0.0, color=_GREY, lw=0.7, ls=":")
        _env_steps_axis(above)
        own = training[training["row"] == row.name]
        if len(own):
            fan = value_fan(own)
            for low, high, alpha in _BANDS:
                above.fill_between(fan.index, fan[low], fan[high], color=color, alpha=alpha, lw=0)
            above.plot(fan.index, fan[0.5], color=color, lw=1.2)
        else:  # a controller is not trained
            above.xaxis.set_visible(False)
        for time, value in trajectories(flown[flown["row"] == row.name], period):
            below.plot(time, value, color=color, lw=0.8, alpha=0.45)
        if headline.held is not None and not headline.high:
            low = -headline.held if headline.signed else 0.0
            below.axhspan(low, headline.held, color=_GREY, alpha=0.12, lw=0)
        below.set_xlabel("time in the episode (s)")
    axes[0, 0].set_ylabel(f"training: {headline.labelled(headline.symbol)}")
    axes[1, 0].set_ylabel(f"final evaluation: {headline.labelled(headline.symbol)}")
    bands = "Above: median, 25–75 % and 5–95 % of the steps of all seeds."
    figure.supxlabel(f"{bands} {PAPER['fig8_error']}", fontsize=8, wrap=True)
    return figure


def value_fan(steps: DataFrame) -> DataFrame:
    """Quantiles of the metric over at most 100 windows of an agent's training steps.

    The index is the env step in the middle of a window, the columns are 0.05, 0.25, 0.5, 0.75 and
    0.95.
    """
    step = steps["step"].to_numpy()
    windows = min(100, max(1, len(steps) // 50))
    width = (float(step.max()) + 1) / windows
    window = np.minimum((step / width).astype(np.int64), windows - 1)
    quantiles = steps["value"].groupby(window).quantile([0.05, 0.25, 0.5, 0.75, 0.95]).unstack()
    return quantiles.set_index((quantiles.index + 0.5) * width)


def trajectories(steps: DataFrame, control_period: float) -> list[Curve]:
    """At most 40 trajectories of an agent's evaluation, at random but always the same ones: the
    metric over the time in the episode (s).
    """
    # At random: every n-th would be the same few start positions for every seed.
    found = [one for _, one in steps.groupby(["seed", "episode"])]
    order = np.random.default_rng(0).permutation(len(found))[:_MAX_TRAJECTORIES]
    chosen = [found[place] for place in order]
    return [
        Curve(one["step"].to_numpy() * control_period, one["value"].to_numpy()) for one in chosen
    ]


# ---- parts


def _panels(count: int, name: str) -> tuple[Figure, Sequence[Axes]]:
    """A figure with panels side by side, and the paper's words below."""
    figure = Figure(figsize=(4.0 * count, 3.8), dpi=110)
    figure.supxlabel(PAPER[name], fontsize=8, wrap=True)
    return figure, figure.subplots(1, count, squeeze=False)[0]


def _plot(axis: Axes, spread: Spread, color: str, label: str, marker: str | None = None) -> None:
    """Draw a line and its band; a curve of a single point becomes a dot, so that it is seen."""
    if len(spread.x) < 2:
        marker = "o"
    axis.fill_between(spread.x, spread.low, spread.high, color=color, alpha=0.2, lw=0)
    axis.plot(spread.x, spread.middle, color=color, label=label, marker=marker, markersize=3.5)
    axis.legend(fontsize=8.5)


def _env_steps_axis(axis: Axes) -> None:
    axis.set_xlabel("env steps")
    axis.xaxis.set_major_formatter(EngFormatter(sep=""))
