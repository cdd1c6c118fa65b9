"""The page of a comparison's report: one HTML file, without other files or a network."""

import base64
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

import numpy as np

from ..models.errors import require
from .claims import MIN_SEEDS, OURS, Outcome, Verdict
from .curves import AVERAGING_SHARE, Curves, Fan
from .metrics import Headline, Spread
from .palette import agent_color, agent_label, sort_agents
from .results import Results
from .tables import NOTHING, count_text, headings, number_text, result_rows, table_note

if TYPE_CHECKING:
    import jinja2
    import pandas as pd
    from markupsafe import Markup
else:
    jinja2 = require("jinja2", "report", "writing the report's page")
    from markupsafe import Markup

__all__ = ["MAX_POINTS", "Chart", "FolderFile", "chart_data", "make_charts", "render_page"]

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


class FolderFile(NamedTuple):
    """A file of the comparison's folder: its name and its contents."""

    name: str
    text: str


def render_page(
    results: Results,
    table: "pd.DataFrame",
    verdicts: Sequence[Verdict],
    curves: Curves,
    video: bytes | None = None,
    poster: bytes | None = None,
    files: Sequence[FolderFile] = (),
) -> str:
    """Make the page.

    Args:
        results, table, verdicts, curves: As `report.write_report` makes them.
        video: An MP4 of the agents side by side, shown where there is one.
        poster: A JPEG of it, shown before it is played.
        files: Files beside the page.
    """
    config, headline = results.config, results.headline
    agents = sort_agents(table.index[table["seeds"] > 0])
    bounds = [name for name in table.index if name not in agents]
    charts = make_charts(curves, headline)
    return _template().render(
        **{name: _asset(path) for name, path in _ASSETS.items()},
        paper=PAPER,
        config=config,
        env_id=results.spec.env_id,
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
        poster=base64.b64encode(poster).decode("ascii") if poster else None,
        hyperparameters=_hyperparameters(config["agents"]),
        settings=_settings(config),
        surroundings=_surroundings(config),
        files=files,
    )


def _template() -> "jinja2.Template":
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # NaN has no place in JSON: better an error here than a page without charts.
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
    return _listed(
        [
            f"{headline.amount(number_text(value))} ({agent_label(str(name))})"
            for name, value in table["steady"].items()
        ]
    )


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


def _hyperparameters(
    agents: Mapping[str, Mapping[str, Any]],
) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """The names of the agents, and for each hyperparameter its name and its value per agent."""
    shown = sort_agents(agents)
    names = list(dict.fromkeys(name for agent in shown for name in agents[agent]))
    rows = [
        (name, [_written(agents[agent][name]) if name in agents[agent] else NOTHING
                for agent in shown])
        for name in names
    ]  # fmt: skip
    return [agent_label(agent) for agent in shown], rows


def _settings(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Settings without the hyperparameters: titled lists of names and values."""
    general = {name: config[name] for name in ("preset", "seeds", "env_steps", "num_envs")
               if name in config}  # fmt: skip
    spec = config["spec"]
    task = {"env": spec["env_id"], **spec["options"], "control_period": spec["control_period"]}
    return [
        ("Comparison", _pairs(general | config.get("evaluation", {}))),
        ("Task", _pairs(task)),
    ]


def _surroundings(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Machine and software: titled lists of names and values."""
    spec = config["spec"]
    vehicle = {"name": spec.get("vehicle", ""), "hash": spec.get("vehicle_hash", "")}
    return [
        ("Versions", _pairs(config["versions"])),
        ("Machine", _pairs(config["machine"])),
        ("Vehicle", _pairs({**vehicle, "file": config["vehicle"] or "the paper's"})),
    ]


def _pairs(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(name, _written(value)) for name, value in values.items()]


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
    size, held, log = headline.size_symbol, headline.metric.held, not headline.high
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
            spreads={name: _of_fan(fan) for name, fan in curves.training_values.items()},
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


def _of_fan(fan: Fan) -> Spread:
    return Spread(fan.x, fan.middle, fan.lower, fan.upper)


def chart_data(charts: Sequence[Chart], agents: Sequence[str]) -> list[dict[str, Any]]:
    """Give the charts as what JSON can hold: rounded, thinned, missing values as None.

    Args:
        charts: As of `make_charts`.
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
