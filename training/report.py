"""The report of a comparison: one HTML page, the table as CSV and Markdown, the verdicts as JSON.

All of it is written from the comparison's files, into the comparison's folder; the page refers to
nothing outside itself. The table is for the terminal too.
"""

import base64
import json
import math
import re
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
from rich import box
from rich.table import Table
from rich.text import Text

from ..envs.spec import canonical_id
from ..flights.palette import agent_color, agent_label, sort_agents
from ..models.errors import MissingPackage
from ..rendering.film import poster
from .claims import MIN_SEEDS, OURS, Outcome, Verdict, judge_claims, judge_no_worse
from .figures import AVERAGING_SHARE, SWARM_FIGURE, Curves, draw_figures, make_curves
from .metrics import Headline, Spread, results_table
from .results import Results, read_results
from .swarms import least_distances

VIDEO_FILE: Final = "video.mp4"
"""The agents side by side; the page has it in itself where it lies in the folder."""
MAX_POINTS: Final = 500
"""Points of a series above which it is thinned."""
NOTHING: Final = "–"
"""Shown where there is no value."""
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
    """The table of results, with the bounds of the task behind the agents.

    Where a world has several drones, it has the columns of `swarms.least_distances` too.
    """
    bounds = results.config.get("bounds")
    table = results_table(results.evaluations, results.runs, results.headline, bounds)
    if results.positions is None:
        return table
    return table.join(least_distances(results.positions)).rename_axis("agent")


def _verdicts(results: Results) -> list[Verdict]:
    """The paper's claims, for the paper's task; and whether our A2C is no worse than SB3's. None of
    them is of several drones.
    """
    preset, headline = results.config["preset"], results.headline
    verdicts = []
    if canonical_id(results.spec.env_id) == "rotorgram/Elevation-v0":  # of which the paper is
        verdicts = judge_claims(results.episodes, results.evaluations, preset, headline)
    if headline.held is not None and len(results.spec.agents) == 1:
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
    markdown = markdown_table(table, results.headline)
    (folder / "results.md").write_text(markdown, encoding="utf-8")
    claims = json.dumps([asdict(verdict) for verdict in verdicts], indent=2, ensure_ascii=False)
    (folder / "claims.json").write_text(claims + "\n", encoding="utf-8")
    video, report = folder / VIDEO_FILE, folder / "report.html"
    film = picture = b""
    if video.is_file():
        film = video.read_bytes()
        with suppress(MissingPackage, OSError):  # where FFmpeg is missing, the film has no poster
            picture = poster(video)
    swarm = b""
    if results.positions is not None:
        swarm = (folder / "figures" / SWARM_FIGURE).read_bytes()
    media: dict[str, Any] = {
        "swarm": base64.b64encode(swarm).decode("ascii"),
        "video": base64.b64encode(film).decode("ascii"),
        "poster": base64.b64encode(picture).decode("ascii"),
        "files": {path.relative_to(folder).as_posix() for path in folder.rglob("*")},
    }
    report.write_text(_page(results, table, verdicts, curves, **media), encoding="utf-8")
    return report


# ---- the table, in words


def headings(headline: Headline, swarm: bool = False) -> tuple[str, ...]:
    """Headings of the columns; of a swarm the least distance is in the place of the overshoot."""
    size, goal, settled = headline.size_symbol, headline.held_text, headline.settled
    band = f" to {headline.amount(f'{settled:.2g}')}" if settled is not None else ""
    return (
        "Agent",
        headline.labelled(f"Steady {size}"),
        f"Seeds that hold {goal}".rstrip(),
        f"Settling{band} (s)",
        "Least distance (m)" if swarm else headline.labelled("Overshoot"),
        "Return",
        f"Env steps to {goal or 'hold'}",
        "Env steps per s",
    )


def table_note(headline: Headline, swarm: bool = False) -> str:
    """Explanation of the columns."""
    size, goal, settled = headline.size_symbol, headline.held_text, headline.settled
    which = f"{size} at the end" if headline.final else f"mean {size} in the last quarter"
    crash = "" if headline.counts_crashes else " and without a crash"
    parts = [
        "Interquartile means over seeds with 95 % bootstrap intervals, from the deterministic "
        "evaluation after training, on episodes of its own. "
        f"Steady {size}: {which} of an episode."
    ]
    if goal:
        parts.append(
            f"Seeds that hold: those with a mean steady state of {goal}{crash} in "
            "that evaluation; below it the worst seed's steady state. Env steps and training "
            f"time: up to the first snapshot from which on all hold {goal}, over the seeds that "
            "get there."
        )
    if headline.settles:
        band = headline.amount(f"{settled:.2g}")
        parts.append(f"Settling: until {size} stays below {band}, over the episodes that settle.")
    parts.append("A crashed episode counts with what was flown of it and has not settled.")
    parts.append(
        "An episode of each drone counts for itself. Least distance: of the centres of two drones "
        "that fly, in all episodes of a seed."
        if swarm
        else "Bounds: the time-optimal flight of the same episodes, and thrust that stays at hover."
    )
    return " ".join(parts)


class Cell(NamedTuple):
    """A cell of the table: its value, and the small print below it."""

    value: str
    details: tuple[str, ...] = ()


def terminal_table(table: pd.DataFrame, headline: Headline) -> Table:
    """Make a table of at most 100 columns for the terminal from `metrics.results_table`."""
    shown = Table(
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
        pad_edge=False,
        caption="Below a value: its 95 % interval, and how many episodes (or seeds) got there.",
        caption_justify="left",
    )
    shown.add_column("Agent", no_wrap=True)
    overshoot = f"Overshoot\n({headline.unit})" if headline.unit else "Overshoot"
    overshoot = "Least dis-\ntance (m)" if _is_swarm(table) else overshoot
    for heading in (
        headline.labelled(f"Steady\n{headline.size_symbol}"),
        "Hold\nit",
        "Settling\n(s)",
        overshoot,
        "Return",
        f"Env steps to\n{headline.held_text}",
        "Env\nsteps/s",
    ):
        shown.add_column(heading, justify="right", overflow="fold")
    for row in result_rows(table):
        shown.add_row(*(_terminal_cell(cell) for cell in row), end_section=True)
    return shown


def _terminal_cell(cell: Cell) -> Text:
    # Text, not markup: an agent's name may hold brackets. The last words would cost the width.
    details = (re.sub(r"( of \d+) (settled|seeds?)$", r"\1", one) for one in cell.details)
    return Text("\n".join((cell.value, *details)))


def result_rows(table: pd.DataFrame) -> list[tuple[Cell, ...]]:
    """Put the results into words: a cell for each of `headings`, a row per agent."""
    return [_row(str(agent), row) for agent, row in table.iterrows()]


def _row(agent: str, row: Mapping[str, Any]) -> tuple[Cell, ...]:
    seeds, episodes = int(row["seeds"]), int(row["episodes"])
    if not seeds:
        nothing = (Cell(NOTHING),)
        value = Cell(number_text(row["return"]))
        return (Cell(agent, ("bound",)), *nothing * 4, value, *nothing * 2)
    crashed = (f"{int(row['crashed'])} of {episodes} crashed",) if row["crashed"] else ()
    settled = (f"{int(row['settled'])} of {episodes} settled",)
    reached: tuple[str, ...] = ()
    if not math.isnan(row["reached"]):
        reached = (_seeds(int(row["reached"]), seeds),)
        if row["reached"]:
            reached += (f"{number_text(row['seconds_to_reach'])} s",)
    return (
        Cell(agent_label(agent), (f"{seeds} seed{'s' * (seeds != 1)}",)),
        _measured(row, "steady", crashed),
        _held(row, seeds),
        _measured(row, "settling_time", settled),
        _measured(row, "least_distance" if "least_distance" in row else "overshoot"),
        _measured(row, "return"),
        Cell(count_text(row["env_steps_to_reach"]), reached),
        Cell(count_text(row["steps_per_second"])),
    )


def _held(row: Mapping[str, Any], seeds: int) -> Cell:
    worst = () if math.isnan(row["worst"]) else (f"worst {number_text(row['worst'])}",)
    if math.isnan(row["held"]):
        return Cell(NOTHING, worst)
    held = int(row["held"])
    return Cell(f"{held / seeds:.0%}".replace("%", " %"), (_seeds(held, seeds), *worst))


def _seeds(count: int, total: int) -> str:
    return f"{count} of {total} seed{'s' * (total != 1)}"


def _measured(row: Mapping[str, Any], name: str, details: tuple[str, ...] = ()) -> Cell:
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    interval = () if math.isnan(low) else (f"{number_text(low)} to {number_text(high)}",)
    return Cell(number_text(row[name]), interval + details)


def number_text(value: float) -> str:
    """Write a number with about three digits, and fewer below 1."""
    if math.isnan(value):
        return NOTHING
    size = abs(value)
    if size == 0.0:
        return "0"
    if size < 1e-4:
        return f"{value:.0e}"
    if size < 1.0:
        return f"{value:.{1 - math.floor(math.log10(size))}f}"
    return f"{value:,.{max(0, 2 - math.floor(math.log10(size)))}f}"


def count_text(value: float) -> str:
    """Write a number without decimals."""
    return NOTHING if math.isnan(value) else f"{value:,.0f}"


def markdown_table(table: pd.DataFrame, headline: Headline) -> str:
    """Make a Markdown table from `metrics.results_table`, with its note below."""
    swarm = _is_swarm(table)
    titles = headings(headline, swarm)
    lines = [titles, ("---", *["---:"] * (len(titles) - 1))]
    lines += [tuple(map(_markdown_cell, row)) for row in result_rows(table)]
    # |E| in a cell would end the cell.
    text = ["".join(f"| {cell.replace('|', chr(92) + '|')} " for cell in line) for line in lines]
    return "".join(f"{line}|\n" for line in text) + f"\n{table_note(headline, swarm)}\n"


def _is_swarm(table: pd.DataFrame) -> bool:
    return "least_distance" in table


def _markdown_cell(cell: Cell) -> str:
    return f"{cell.value} ({'; '.join(cell.details)})" if cell.details else cell.value


# ---- the page: one HTML file, without other files or a network


def _page(
    results: Results, table: pd.DataFrame, verdicts: Sequence[Verdict], curves: Curves, **media: Any
) -> str:
    """The page, with names in the template of the film, its poster and the files beside it."""
    config, headline, swarm = results.config, results.headline, _is_swarm(table)
    agents = sort_agents(table.index[table["seeds"] > 0])
    bounds = [name for name in table.index if name not in agents]
    trained = sort_agents(config["agents"])
    charts = make_charts(curves, headline, config.get("diameter"))
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
        headings=headings(headline, swarm),
        rows=result_rows(table.loc[[*agents, *bounds]]),
        note=table_note(headline, swarm),
        verdicts=verdicts,
        of_paper=any(verdict.source != OURS for verdict in verdicts),
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
    ends = seen["steady"].map(number_text).map(headline.amount)
    labels = [f"{amount} ({agent_label(str(name))})" for name, amount in ends.items()]
    learns = seen["steps_per_second"].notna()
    trained, others = (_listed(list(compress(labels, one))) for one in (learns, ~learns))
    parts = []
    if trained:
        parts.append(
            f"After {count_text(env_steps)} env steps of training, episodes end with a mean "
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


def make_charts(curves: Curves, headline: Headline, diameter: float | None = None) -> list[Chart]:
    """Make the charts in the order in which the page shows them; those without data too.

    That of the distances is there where a world has several drones, whose spheres touch at the
    `diameter`, m.
    """
    size, held, log = headline.size_symbol, headline.held, not headline.high
    steps, steady = "env steps", headline.labelled(f"steady-state {size}")
    training = {
        agent: Spread(fan.x, fan.middle, fan.lower, fan.upper)
        for agent, fan in curves.training_values.items()
    }
    value, target = headline.labelled(headline.symbol), None if headline.high else 0.0
    total = "cumulative reward"
    distance = "least distance (m)"
    near = [Chart("distance", "time (s)", distance, curves.distances, mark=diameter)]
    return [
        Chart("learning", steps, steady, curves.learning, curves.levels, log=log, mark=held),
        Chart("flown", "time (s)", headline.labelled(size), curves.flown_sizes, log=log, mark=held),
        *(near if curves.distances else ()),
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
