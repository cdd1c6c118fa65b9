"""The table of a study: one line for each row, measures over its seeds, in Markdown.

The terminal and the report's page show the same text.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from math import floor, isnan, log10, nan

from pandas import DataFrame

from ..flights.palette import agent_label
from .metrics import MEANS, Headline, Measures
from .results import Results
from .settings import Row, short_name
from .statistics import bootstrap_interval, iqm, share_interval

Line = Mapping[str, float]
NOTHING = "–"
"""Shown where there is no value."""
_COUNTS = ("episodes", "settled", "crashed")


# ---- numbers


def results_table(results: Results) -> DataFrame:
    """Measures over seeds of each row of which a run is done, indexed by `row`.

    For each of steady, settling_time (s), overshoot and return: the interquartile mean over seeds,
    and `_low` and `_high` of its 95 % interval. `held`: seeds that hold the goal; `worst`: the
    worst seed's steady state; `most_crashed`: crashes of the seed that crashed most. Counts: seeds,
    episodes, settled, crashed; `crash_rate` of a flight, and `_low` and `_high` of Wilson's
    interval.
    `env_steps_to_hold` and `seconds_to_hold`: interquartile means over the `reached` seeds.
    `env_steps` of a training and `steps_per_second`; missing for controllers.

    The rows of a sweep are ranked: whole rows first, then by the crashes of the worst seed, then by
    its steady state. Other rows keep their order.
    """
    lines = {}
    for row in results.study.rows:
        own = results.runs[results.runs["row"] == row.name]
        if len(own):
            lines[row.name] = _measures(own, results.headline(row))
    table = DataFrame.from_dict(lines, orient="index").rename_axis("row")
    if results.study.kind != "sweep" or table.empty:
        return table
    high = results.headline(results.study.rows[0]).high
    order = {"seeds": False, "most_crashed": True, "worst": not high}
    return table.sort_values(list(order), ascending=list(order.values()), kind="stable")


def _measures(own: DataFrame, headline: Headline) -> Measures:
    trained = own["env_steps"].max() > 0
    line: Measures = {"seeds": len(own), **own[list(_COUNTS)].sum()}
    for name in MEANS:
        values = own[name].to_numpy(float)
        line[name] = iqm(values)
        line[f"{name}_low"], line[f"{name}_high"] = bootstrap_interval(values)
    line |= _share_interval(line, headline)
    line["held"] = nan if headline.held is None else int(own["held"].sum())
    line["worst"] = own["steady"].agg("min" if headline.high else "max")
    line["most_crashed"] = int(own["crashed"].max())
    line["crash_rate"] = line["crashed"] / line["episodes"]
    interval = share_interval(int(line["crashed"]), int(line["episodes"]))
    line["crash_rate_low"], line["crash_rate_high"] = interval
    reached = own["env_steps_to_hold"].notna().sum() if trained else nan
    line["reached"] = nan if headline.held is None else reached
    for name in ("env_steps_to_hold", "seconds_to_hold", "steps_per_second"):
        line[name] = iqm(own[name].to_numpy(float))
    line["env_steps"] = own["env_steps"].max() if trained else nan
    return line


def _share_interval(line: Line, headline: Headline) -> Measures:
    """Wilson's interval for a steady state that is a share of all flights, or is 0 or 1 in all
    seeds: resampling shows no spread there.
    """
    total = int(line["episodes"])
    degenerate = line["steady_low"] == line["steady_high"] and line["steady_low"] in (0.0, 1.0)
    if headline.counts_crashes:
        low, high = share_interval(total - int(line["crashed"]), total)
    elif headline.high and not headline.unit and degenerate:
        low, high = share_interval(round(line["steady"] * total), total)
    else:
        return {}
    return {"steady_low": low, "steady_high": high}


# ---- cells


def markdown(results: Results, table: DataFrame) -> str:
    """The table of each task, of `results_table`, in Markdown, with a note."""
    rows = {row.name: row for row in results.study.rows}
    ordered = [rows[str(name)] for name in table.index]
    tasks = by_task(results, ordered)
    parts = []
    for task, own in tasks:
        if len(tasks) > 1:
            parts.append(f"## {task}")
        headline = results.headline(own[0])
        names = headings(headline)
        lines = [names, ["---"] + ["---:"] * (len(names) - 1)]
        lines += [_line(row, table.loc[row.name].to_dict(), headline) for row in own]
        parts.append("\n".join(map(_markdown_line, lines)))
    return "\n\n".join([*parts, NOTE]) + "\n"


def _markdown_line(cells: Sequence[str]) -> str:
    # What Markdown reads as markup, and a link's "](".
    escaped = [re.sub(r"[|*`\\]|\](?=\()", r"\\\g<0>", cell) for cell in cells]
    return f"| {' | '.join(escaped)} |"


def by_task(results: Results, rows: Iterable[Row]) -> list[tuple[str, list[Row]]]:
    """Rows by their task; those of a sweep are kept together, whatever options it sweeps."""
    is_sweep = results.study.kind == "sweep"
    found: dict[str, list[Row]] = {}
    for row in rows:
        task = row.env.env_id.rpartition("/")[2] if is_sweep else row.task
        found.setdefault(task, []).append(row)
    return sorted(found.items())


def headings(headline: Headline) -> list[str]:
    """Headings of the columns."""
    settled = headline.settled
    band = "" if settled is None else f" to {headline.amount(f'{settled:.2g}')}"
    return [
        "Agent",
        headline.labelled(f"Steady {headline.size_symbol}"),
        f"Seeds that hold {headline.held_text}".rstrip(),
        "Crashes per flight",
        f"Settling{band} (s)",
        headline.labelled("Overshoot"),
        "Return",
        "Env steps to hold",
        "Env steps per s",
    ]


def _line(row: Row, line: Line, headline: Headline) -> list[str]:
    seeds = int(line["seeds"])
    names = [seeds_text(seeds)]
    if not row.controller:
        names.append(f"{count_text(line['env_steps'])} env steps")
    settling = NOTHING
    if headline.settles:
        settled = f"{int(line['settled'])} of {int(line['episodes'])}"
        settling = _measured(line, "settling_time", settled)
    rate = number_text(100 * line["crash_rate"])
    low = 100 * line["crash_rate_low"]
    high = 100 * line["crash_rate_high"]
    crashed = f"{int(line['crashed'])} of {int(line['episodes'])}"
    reached = []
    if not isnan(line["reached"]):
        reached.append(f"{int(line['reached'])} of {seeds}")
    if line["reached"] > 0:
        reached.append(f"{number_text(line['seconds_to_hold'])} s")
    return [
        _cell(row_label(row), *names),
        _measured(line, "steady", f"worst {number_text(line['worst'])}"),
        _held(line, seeds),
        _cell(f"{rate} %", f"{number_text(low)} to {number_text(high)} %", crashed),
        settling,
        _measured(line, "overshoot"),
        _measured(line, "return"),
        _cell(count_text(line["env_steps_to_hold"]), *reached),
        count_text(line["steps_per_second"]),
    ]


def _cell(value: str, *details: str) -> str:
    return f"{value} ({'; '.join(details)})" if details else value


def seeds_text(count: int) -> str:
    """1 seed, 2 seeds."""
    return f"{count} seed{'s' * (count != 1)}"


def row_label(row: Row) -> str:
    """Name of a row in tables and figures."""
    first, *others = row.name.removesuffix(f" {row.task}").split()  # its table names the task
    if first == short_name(row.agent):
        first = agent_label(row.agent)
    return " ".join([first, *others])


def _held(line: Line, seeds: int) -> str:
    if isnan(line["held"]):
        return NOTHING
    held = int(line["held"])
    low, high = share_interval(held, seeds)
    return _cell(f"{held} of {seeds}", f"{low:.0%} to {high:.0%}".replace("%", " %"))


def _measured(line: Line, name: str, *details: str) -> str:
    low = line[f"{name}_low"]
    high = line[f"{name}_high"]
    interval = () if isnan(low) else (f"{number_text(low)} to {number_text(high)}",)
    return _cell(number_text(line[name]), *interval, *details)


def number_text(value: float) -> str:
    """Write a number with about three digits, and fewer below 1."""
    if isnan(value):
        return NOTHING
    size = abs(value)
    if size == 0.0:
        return "0"
    if size < 1e-4:
        return f"{value:.0e}"
    if size < 1.0:
        return f"{value:.{1 - floor(log10(size))}f}"
    return f"{value:,.{max(0, 2 - floor(log10(size)))}f}"


def count_text(value: float) -> str:
    """Write a number without decimals."""
    return NOTHING if isnan(value) else f"{value:,.0f}"


NOTE = (
    "Interquartile means over seeds with 95 % bootstrap intervals, from the deterministic "
    "evaluation after training; each seed flies episodes of its own. Shares have Wilson's 95 % "
    "interval. Steady: mean size of the metric in the last quarter of an episode, or at its end if "
    "only the end counts. A seed holds if its mean steady state is on the right side of the bound "
    "in every snapshot's flights without a crash; env steps to hold: to the first snapshot from "
    "which on all hold. A crashed episode counts with what was flown of it and has not settled."
)
