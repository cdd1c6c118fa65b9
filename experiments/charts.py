"""The curves of a comparison as the interactive charts of the report's page."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from .curves import AVERAGING_SHARE, Curves, Fan
from .metrics import HOLD_THRESHOLD, Spread
from .records import sort_agents

__all__ = ["MAX_POINTS", "Chart", "chart_data", "make_charts"]

MAX_POINTS: Final = 500
"""Points of a series above which it is thinned."""

_X_DIGITS: Final = 7
_Y_DIGITS: Final = 4

_SEEDS: Final = (
    "Lines: interquartile mean over seeds. Bands: quartiles over seeds, or the whole range below "
    "four seeds."
)


@dataclass(frozen=True, kw_only=True)
class Chart:
    """One chart: what it shows, in words, and its series."""

    key: str
    """Names it in the page."""
    title: str
    caption: str
    x_label: str
    y_label: str
    spreads: Mapping[str, Spread]
    """By agent; never without a point."""
    levels: Mapping[str, float] = field(default_factory=dict)
    """By agent; drawn as a dashed line."""
    log: bool = False
    """Whether y is drawn on a logarithmic scale."""
    mark: float | None = None
    """Where a dotted line is drawn across, in y."""


def make_charts(curves: Curves) -> list[Chart]:
    """Make the charts in the order in which the page shows them; those without data too."""
    return [
        Chart(
            key="learning",
            title="Distance from the target over training",
            caption="Steady-state |E| of deterministic evaluations of snapshots taken during "
            "training. Dashed: agents that are not trained. Dotted: "
            f"{HOLD_THRESHOLD} m. {_SEEDS}",
            x_label="env steps",
            y_label="steady-state |E| (m)",
            spreads=curves.learning,
            levels=curves.levels,
            log=True,
            mark=HOLD_THRESHOLD,
        ),
        Chart(
            key="flown",
            title="Distance from the target in flight",
            caption="|E| over the time in an episode of the final evaluation. Lines: interquartile "
            "mean over the flights of all seeds. Bands: their quartiles. A flight that crashed "
            "counts as long as it lasted.",
            x_label="time (s)",
            y_label="|E| (m)",
            spreads=curves.flown_error,
            log=True,
            mark=HOLD_THRESHOLD,
        ),
        Chart(
            key="reward",
            title="Reward per episode (the paper's Figure 6)",
            caption="Average reward with exploration: a running mean over "
            f"{AVERAGING_SHARE * 100:g} % of training. {_SEEDS}",
            x_label="env steps",
            y_label="reward per episode",
            spreads=curves.average_return,
        ),
        Chart(
            key="training-error",
            title="Elevation error in training (the paper's Figure 8)",
            caption="E with exploration, in windows of training, all seeds together. Lines: "
            "median. Bands: 25 to 75 % of the steps. Dotted: the target.",
            x_label="env steps",
            y_label="E (m)",
            spreads={name: _of_fan(fan) for name, fan in curves.training_error.items()},
            mark=0.0,
        ),
        Chart(
            key="total-by-step",
            title="Cumulative reward (the paper's Figure 7)",
            caption=f"The sum of all rewards since training began, over env steps. {_SEEDS}",
            x_label="env steps",
            y_label="cumulative reward",
            spreads=curves.return_by_step,
        ),
        Chart(
            key="total-by-episode",
            title="Cumulative reward over episodes",
            caption="The same over episodes, as in the paper: whoever crashes often has more "
            "episodes in as many env steps.",
            x_label="episodes",
            y_label="cumulative reward",
            spreads=curves.return_by_episode,
        ),
    ]


def _of_fan(fan: Fan) -> Spread:
    return Spread(fan.x, fan.middle, fan.lower, fan.upper)


def chart_data(charts: Sequence[Chart], agents: Sequence[str]) -> list[dict[str, Any]]:
    """Give the charts as what JSON can hold: rounded, thinned, missing values as None.

    Args:
        charts: What `make_charts` gave.
        agents: Every agent that may be in them; a series names its agent by the place in here.
    """
    return [
        {
            "key": chart.key,
            "x": chart.x_label,
            "y": chart.y_label,
            "log": chart.log,
            "mark": chart.mark,
            "series": _all_series(chart, agents),
        }
        for chart in charts
    ]


def _all_series(chart: Chart, agents: Sequence[str]) -> list[dict[str, Any]]:
    series: list[dict[str, Any]] = []
    for agent in sort_agents((*chart.spreads, *chart.levels)):
        place = {"agent": agents.index(agent)}
        if agent in chart.levels:
            series.append(place | {"level": _rounded(chart.levels[agent], _Y_DIGITS)})
        else:
            series.append(place | _series(chart.spreads[agent], chart.log))
    return series


def _series(spread: Spread, log: bool) -> dict[str, list[float | None]]:
    count = len(spread.x)
    kept = np.unique(np.linspace(0, count - 1, min(count, MAX_POINTS)).round().astype(np.int64))
    names = {"y": spread.middle, "low": spread.low, "high": spread.high}
    columns = {name: [_rounded(y, _Y_DIGITS, log) for y in ys[kept]] for name, ys in names.items()}
    return {"x": [_rounded(x, _X_DIGITS) for x in spread.x[kept]], **columns}


def _rounded(value: float, digits: int, log: bool = False) -> float | None:
    """Round to significant digits; None where there is no value, or none on a logarithmic scale."""
    if not math.isfinite(value) or (log and value <= 0.0):
        return None
    rounded = float(f"{value:.{digits}g}")
    return int(rounded) if rounded.is_integer() else rounded
