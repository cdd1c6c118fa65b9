"""The page of a comparison's report: one HTML file, without other files or a network."""

import base64
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, get_args

import numpy as np

from ..models.errors import require
from .claims import MIN_SEEDS, OURS, Outcome, Verdict
from .curves import AVERAGING_SHARE, Curves
from .metrics import Headline, Spread
from .palette import agent_color, agent_label, sort_agents
from .results import Results
from .tables import count_text, headings, number_text, result_rows, table_note

if TYPE_CHECKING:
    import jinja2
    import pandas as pd
    from markupsafe import Markup
else:
    jinja2 = require("jinja2", "report", "writing the report's page")
    from markupsafe import Markup

__all__ = ["MAX_POINTS", "Chart", "chart_data", "make_charts", "render_page"]

PAPER: Final = "https://doi.org/10.3390/drones7040225"

MAX_POINTS: Final = 500
"""Points of a series above which it is thinned."""

_X_DIGITS: Final = 7
_Y_DIGITS: Final = 4

_SEEDS: Final = (
    "Lines: interquartile mean over seeds. Bands: quartiles over seeds, or the whole range below "
    "four seeds."
)


_ASSETS: Final = {
    "style": "report.css",
    "script": "report.js",
    "uplot_style": "uplot/uPlot.min.css",
    "uplot_script": "uplot/uPlot.iife.min.js",
    "uplot_licence": "uplot/LICENSE",
}


def render_page(
    results: Results,
    table: "pd.DataFrame",
    verdicts: Sequence[Verdict],
    curves: Curves,
    video: bytes | None = None,
    files: Sequence[tuple[str, str]] = (),
) -> str:
    """Make the page.

    Args:
        results, table, verdicts, curves: As `report.write_report` makes them.
        video: An MP4 of the agents side by side, shown where there is one.
        files: Names and contents of the files beside the page.
    """
    config, headline = results.config, results.headline
    agents = sort_agents(table.index[table["seeds"] > 0])
    bounds = [name for name in table.index if name not in agents]
    charts = make_charts(curves, headline)
    trained = sort_agents(config["agents"])
    return _template().render(
        **{name: _asset(path) for name, path in _ASSETS.items()},
        paper=PAPER,
        config=config,
        outcome=_outcome(table.loc[agents], verdicts, config["env_steps"], headline),
        extent=_extent(results),
        colors=[agent_color(agent) for agent in agents],
        dark_colors=[agent_color(agent, dark=True) for agent in agents],
        headings=headings(headline),
        rows=result_rows(table.loc[[*agents, *bounds]]),
        note=table_note(headline),
        verdicts=verdicts,
        schedule=_schedule(config["agents"]),
        charts=charts,
        data={
            "agents": [agent_label(agent) for agent in agents],
            "charts": chart_data(charts, agents),
        },
        video=base64.b64encode(video).decode("ascii") if video else None,
        trained=trained,
        hyperparameters=dict.fromkeys(chain(*(config["agents"][agent] for agent in trained))),
        files=files,
    )


def _template() -> "jinja2.Template":
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # NaN has no place in JSON: better an error here than a page without charts.
    environment.filters |= {"written": _written, "label": agent_label}
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.from_string(_read("report.html"))


def _read(path: str) -> str:
    return resources.files(__package__).joinpath(path).read_text(encoding="utf-8")


def _asset(path: str) -> "Markup":
    """Ours or uPlot's, and so not to be escaped."""
    return Markup(_read(f"assets/{path}"))


def _outcome(
    table: "pd.DataFrame", verdicts: Sequence[Verdict], env_steps: int, headline: Headline
) -> str:
    """The result in one sentence."""
    seen = table[table["steady"].notna()]
    trained = _ends(seen[seen["steps_per_second"].notna()], headline)
    others = _ends(seen[seen["steps_per_second"].isna()], headline)
    parts = []
    if trained:
        parts.append(
            f"After {count_text(env_steps)} env steps of training, episodes end with a mean "
            f"{headline.size_symbol} of {trained}"
        )
    if others:
        parts.append(f"without training, with {others}")
    paper = [verdict for verdict in verdicts if verdict.source != OURS]
    counts = Counter(verdict.verdict for verdict in paper)
    found = [f"{counts[name]} {'is' if counts[name] == 1 else 'are'} {name}"
             for name in get_args(Outcome) if counts[name]]  # fmt: skip
    if paper:
        parts.append(f"of the paper's {len(paper)} claims, {_listed(found)}")
    most = int(table["seeds"].max())
    if paper and most < MIN_SEEDS:
        parts.append(f"{most} seed{'s' * (most != 1)} decide no claim, that takes {MIN_SEEDS}")
    text = "; ".join(parts) + "."
    return text[0].upper() + text[1:]


def _ends(table: "pd.DataFrame", headline: Headline) -> str:
    ends = table["steady"].map(number_text).map(headline.amount).items()
    return _listed([f"{amount} ({agent_label(str(name))})" for name, amount in ends])


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def _extent(results: Results) -> str:
    config, period = results.config, results.spec.control_period
    seeds = config["seeds"]
    text = (
        f"{len(seeds)} seed{'s' * (len(seeds) != 1)}, {count_text(config['env_steps'])} env steps"
    )
    if length := results.spec.options.get("episode_length"):
        text += f" per run, episodes of {length * period:g} s at {period:g} s per step"
    return text


def _schedule(agents: Mapping[str, Mapping[str, Any]]) -> str:
    """Effect of an annealed learning rate on the claims; "" if the judged agents have none."""
    annealed = [agent_label(name) for name in ("vpg", "a2c") if agents.get(name, {}).get("anneal")]
    if not annealed:
        return ""
    return (
        f"Here the learning rate of {' and '.join(annealed)} falls to 0 over the run, which fixes "
        "roughly when a curve settles and damps its late fluctuation; the paper's rate is constant."
    )


def _written(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


# ---- charts


@dataclass(frozen=True, kw_only=True)
class Chart:
    """One chart: its description and its series."""

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
    """Value of y with a dotted line."""


def make_charts(curves: Curves, headline: Headline) -> list[Chart]:
    """Make the charts in the order in which the page shows them; those without data too."""
    size, held, log = headline.size_symbol, headline.held, not headline.high
    fans = curves.training_values.items()
    dotted = "" if held is None else f"Dotted: {headline.amount(f'{held:g}')}. "
    return [
        Chart(
            key="learning",
            title=f"{size} at the end of an episode over training",
            caption=f"Steady-state {size} of deterministic evaluations of snapshots taken during "
            f"training. Dashed: agents that are not trained. {dotted}{_SEEDS}",
            x_label="env steps",
            y_label=headline.labelled(f"steady-state {size}"),
            spreads=curves.learning,
            levels=curves.levels,
            log=log,
            mark=held,
        ),
        Chart(
            key="flown",
            title=f"{size} during an episode",
            caption=f"{size} over the time in an episode of the final evaluation. Lines: "
            "interquartile mean over the episodes of all seeds. Bands: their quartiles. An episode "
            "that crashed counts as long as it lasted.",
            x_label="time (s)",
            y_label=headline.labelled(size),
            spreads=curves.flown_sizes,
            log=log,
            mark=held,
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
            title=f"{headline.symbol} in training (the paper's Figure 8)",
            caption=f"{headline.symbol} with exploration, in windows of training, all seeds "
            "together. Lines: median. Bands: 25 to 75 % of the steps."
            + ("" if headline.high else " Dotted: the target."),
            x_label="env steps",
            y_label=headline.labelled(headline.symbol),
            spreads={a: Spread(fan.x, fan.middle, fan.lower, fan.upper) for a, fan in fans},
            mark=None if headline.high else 0.0,
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
            caption="The same over episodes, as in the paper: an agent that crashes often has more "
            "episodes in as many env steps.",
            x_label="episodes",
            y_label="cumulative reward",
            spreads=curves.return_by_episode,
        ),
    ]


def chart_data(charts: Sequence[Chart], agents: Sequence[str]) -> list[dict[str, Any]]:
    """Give the charts as what JSON can hold: rounded, thinned, missing values as None.

    A series names its agent by the place in `agents`.
    """
    return [
        {
            "key": chart.key,
            "x": chart.x_label,
            "y": chart.y_label,
            "log": chart.log,
            "mark": chart.mark,
            "series": [
                {"agent": agents.index(agent)}
                | (
                    {"level": _rounded(chart.levels[agent], _Y_DIGITS)}
                    if agent in chart.levels
                    else _series(chart.spreads[agent], chart.log)
                )
                for agent in sort_agents((*chart.spreads, *chart.levels))
            ],
        }
        for chart in charts
    ]


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
