"""The report of a comparison: one HTML page, the table as CSV and Markdown, the verdicts as JSON.

All of it is written from the comparison's files, into the comparison's folder; the page refers to
nothing outside itself.
"""

import base64
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from itertools import chain, compress
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

import jinja2
import numpy as np
import pandas as pd
from markupsafe import Markup

from ..envs.spec import canonical_id
from ..models.errors import MissingPackage
from ..rendering.film import poster
from . import tables
from .claims import MIN_SEEDS, OURS, Outcome, Verdict, judge_claims, judge_no_worse
from .figures import AVERAGING_SHARE, Curves, draw_figures, make_curves
from .metrics import Headline, Spread, results_table
from .palette import agent_color, agent_label, sort_agents
from .results import Results, read_results

VIDEO_FILE: Final = "video.mp4"
"""The agents side by side; the page has it in itself where it lies in the folder."""

MAX_POINTS: Final = 500
"""Points of a series above which it is thinned."""

_X_DIGITS: Final = 7
_Y_DIGITS: Final = 4

_ASSETS: Final = {
    "style": "report.css",
    "script": "report.js",
    "uplot_style": "uplot/uPlot.min.css",
    "uplot_script": "uplot/uPlot.iife.min.js",
    "uplot_licence": "uplot/LICENSE",
}


def table_of(results: Results) -> pd.DataFrame:
    """The table of results, with the bounds of the task behind the agents."""
    bounds = results.config.get("bounds")
    return results_table(results.evaluations, results.runs, results.headline, bounds)


def _verdicts(results: Results) -> list[Verdict]:
    """The paper's claims, for the paper's task; and whether our A2C is no worse than SB3's."""
    preset, headline = results.config["preset"], results.headline
    verdicts = []
    if canonical_id(results.spec.env_id) == "rotorgram/Elevation-v0":  # of which the paper is
        verdicts = judge_claims(results.episodes, results.evaluations, preset, headline)
    if headline.held is not None:
        trained = set(results.runs["agent"])
        verdicts.append(judge_no_worse(results.evaluations, trained, preset, headline))
    return verdicts


def write_report(folder: Path | str, results: Results | None = None) -> Path:
    """Draw the figures and write the page, the table and the verdicts into the folder; the path of
    the page. Raises `ResultsError` if a file or a column is missing.
    """
    folder = Path(folder)
    results = results or read_results(folder)
    table, verdicts = table_of(results), _verdicts(results)
    curves = make_curves(folder, results)
    draw_figures(folder, results, curves)
    table.to_csv(folder / "results.csv")
    markdown = tables.markdown_table(table, results.headline)
    (folder / "results.md").write_text(markdown, encoding="utf-8")
    claims = json.dumps([asdict(verdict) for verdict in verdicts], indent=2, ensure_ascii=False)
    (folder / "claims.json").write_text(claims + "\n", encoding="utf-8")
    video, report = folder / VIDEO_FILE, folder / "report.html"
    film = picture = b""
    if video.is_file():
        film = video.read_bytes()
        with suppress(MissingPackage, OSError):  # where FFmpeg is missing, the film has no poster
            picture = poster(video)
    page = _page(
        results, table, verdicts, curves,
        video=base64.b64encode(film).decode("ascii"),
        poster=base64.b64encode(picture).decode("ascii"),
        files={path.relative_to(folder).as_posix() for path in folder.rglob("*")},
    )  # fmt: skip
    report.write_text(page, encoding="utf-8")
    return report


# ---- the page: one HTML file, without other files or a network


def _page(
    results: Results, table: pd.DataFrame, verdicts: Sequence[Verdict], curves: Curves, **media: Any
) -> str:
    """The page, with names in the template of the film, its poster and the files beside it."""
    config, headline = results.config, results.headline
    agents = sort_agents(table.index[table["seeds"] > 0])
    bounds = [name for name in table.index if name not in agents]
    trained = sort_agents(config["agents"])
    charts = make_charts(curves, headline)
    settings = config["agents"]
    annealed = [name for name in ("vpg", "a2c") if settings.get(name, {}).get("anneal")]
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # NaN has no place in JSON: better an error here than a page without charts.
    environment.filters |= {"written": _written, "label": agent_label}
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.from_string(_read("report.html")).render(
        # Ours or uPlot's, and so not to be escaped.
        **{name: Markup(_read(f"assets/{path}")) for name, path in _ASSETS.items()},
        config=config,
        headline=headline,
        outcome=_outcome(table.loc[agents], verdicts, config["env_steps"], headline),
        colors=[agent_color(agent) for agent in agents],
        dark_colors=[agent_color(agent, dark=True) for agent in agents],
        headings=tables.headings(headline),
        rows=tables.result_rows(table.loc[[*agents, *bounds]]),
        note=tables.table_note(headline),
        verdicts=verdicts,
        annealed=[agent_label(name) for name in annealed],
        charts=charts,
        averaging_share=AVERAGING_SHARE,
        data={"agents": list(map(agent_label, agents)), "charts": chart_data(charts, agents)},
        trained=trained,
        hyperparameters=dict.fromkeys(chain(*(settings[agent] for agent in trained))),
        **media,
    )


def _read(path: str) -> str:
    return (Path(__file__).parent / path).read_text(encoding="utf-8")


def _outcome(
    table: pd.DataFrame, verdicts: Sequence[Verdict], env_steps: int, headline: Headline
) -> str:
    """The result in one sentence."""
    seen = table[table["steady"].notna()]
    ends = seen["steady"].map(tables.number_text).map(headline.amount)
    labels = [f"{amount} ({agent_label(str(name))})" for name, amount in ends.items()]
    learns = seen["steps_per_second"].notna()
    trained, others = (_listed(list(compress(labels, one))) for one in (learns, ~learns))
    parts = []
    if trained:
        parts.append(
            f"After {tables.count_text(env_steps)} env steps of training, episodes end with a mean "
            f"{headline.size_symbol} of {trained}"
        )
    if others:
        parts.append(f"without training, with {others}")
    if paper := [verdict for verdict in verdicts if verdict.source != OURS]:
        counts = Counter(verdict.verdict for verdict in paper)
        found = [f"{counts[name]} {'is' if counts[name] == 1 else 'are'} {name}"
                 for name in get_args(Outcome) if counts[name]]  # fmt: skip
        parts.append(f"of the paper's {len(paper)} claims, {_listed(found)}")
        most = int(table["seeds"].max())
        if most < MIN_SEEDS:
            parts.append(f"{most} seed{'s' * (most != 1)} decide no claim, that takes {MIN_SEEDS}")
    text = "; ".join(parts) + "."
    return text[0].upper() + text[1:]


def _listed(words: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def _written(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


# ---- charts


class Chart(NamedTuple):
    """One chart; the page has its title and caption."""

    key: str
    """Names it in the page."""
    x_label: str
    y_label: str
    spreads: Mapping[str, Spread]
    """By agent; never without a point."""
    levels: Mapping[str, float] = {}
    """By agent; drawn as a dashed line."""
    log: bool = False
    """Whether y is drawn on a logarithmic scale."""
    mark: float | None = None
    """Value of y with a dotted line."""


def make_charts(curves: Curves, headline: Headline) -> list[Chart]:
    """Make the charts in the order in which the page shows them; those without data too."""
    size, held, log = headline.size_symbol, headline.held, not headline.high
    steps, steady = "env steps", headline.labelled(f"steady-state {size}")
    training = {
        agent: Spread(fan.x, fan.middle, fan.lower, fan.upper)
        for agent, fan in curves.training_values.items()
    }
    value, target = headline.labelled(headline.symbol), None if headline.high else 0.0
    total = "cumulative reward"
    return [
        Chart("learning", steps, steady, curves.learning, curves.levels, log=log, mark=held),
        Chart("flown", "time (s)", headline.labelled(size), curves.flown_sizes, log=log, mark=held),
        Chart("reward", steps, "reward per episode", curves.average_return),
        Chart("training-error", steps, value, training, mark=target),
        Chart("total-by-step", steps, total, curves.return_by_step),
        Chart("total-by-episode", "episodes", total, curves.return_by_episode),
    ]


def chart_data(charts: Sequence[Chart], agents: Sequence[str]) -> list[dict[str, Any]]:
    """Charts for JSON: rounded, thinned, without a value None; agents by their place."""
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
