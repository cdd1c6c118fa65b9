"""The report of a comparison: one HTML file, the table as CSV and Markdown, the verdicts as JSON.

All of it is written from the comparison's files, into the comparison's folder; the HTML embeds its
figures and refers to nothing outside itself.
"""

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple

import jinja2
import pandas as pd
from rich import box
from rich.table import Table
from rich.text import Text

from .claims import Verdict, judge_claims
from .figures import FIGURE_FILES, agent_color, agent_label, draw_figures
from .metrics import HOLD_THRESHOLD, SETTLING_TOLERANCE, results_table
from .records import Records, read_records, sort_agents

__all__ = [
    "CLAIMS_FILE",
    "REPORT_FILE",
    "RESULTS_CSV",
    "RESULTS_MARKDOWN",
    "result_rows",
    "terminal_table",
    "write_report",
]

REPORT_FILE: Final = "report.html"
RESULTS_CSV: Final = "results.csv"
RESULTS_MARKDOWN: Final = "results.md"
CLAIMS_FILE: Final = "claims.json"

NOTHING: Final = "–"
"""Shown where there is no value."""

_TERMINAL_HEADINGS: Final = (
    "Agent",
    "Steady\n|E| (m)",
    "Settling\n(s)",
    "Overshoot\n(m)",
    "Return",
    f"Env steps to\n|E| < {HOLD_THRESHOLD} m",
    "Time to\nit (s)",
    "Env\nsteps/s",
)

HEADINGS: Final = (
    "Agent",
    "Steady |E| (m)",
    f"Settling to {SETTLING_TOLERANCE:.2g} m (s)",
    "Overshoot (m)",
    "Return",
    f"Env steps to |E| < {HOLD_THRESHOLD} m",
    "Training time to it (s)",
    "Env steps per s",
)

TABLE_NOTE: Final = (
    "Interquartile means over seeds with 95 % bootstrap intervals, from the deterministic "
    "evaluation after training. Steady |E|: mean |E| in the last quarter of an episode. Settling: "
    f"until |E| stays below {SETTLING_TOLERANCE:.2g} m, over the episodes that settle. Env steps "
    f"and training time: up to the first snapshot from which on all hold |E| < {HOLD_THRESHOLD} m, "
    "over the seeds that get there. A crashed episode counts with what was flown of it and has "
    "not settled."
)

_CAPTIONS: Final = (
    (
        "The paper's Figure 6: total reward and average reward",
        "Dots: episodes of all seeds (at most 2,000, picked at random). Lines: running mean over "
        "5 % of training, interquartile mean over seeds. Bands: quartiles over "
        "seeds, or the whole range below four seeds.",
    ),
    (
        "The paper's Figure 7: cumulative reward",
        "The sum of all rewards since training began, over env steps and, as in the paper, over "
        "episodes. Lines and bands as above.",
    ),
    (
        "The paper's Figure 8: elevation error",
        "Above: E in windows of training, all seeds together. Below: E over time in the final "
        f"evaluation, a line per flight; the grey band is ±{HOLD_THRESHOLD} m.",
    ),
    (
        "Learning curve (not in the paper)",
        "Steady-state |E| of deterministic evaluations of snapshots taken during training; agents "
        "that are not trained are a dashed line. Lines and bands as above.",
    ),
)


class Cell(NamedTuple):
    """A cell of the table: its value, and what stands in small print below it."""

    value: str
    details: tuple[str, ...] = ()


def write_report(
    folder: Path | str, records: Records | None = None, results: pd.DataFrame | None = None
) -> Path:
    """Draw the figures and write the report, the table and the verdicts into the folder.

    Args:
        folder: Where `rotorgram compare` wrote its records.
        records: What `records.read_records(folder)` gave, where it is at hand.
        results: What `metrics.results_table` made of them, where it is at hand.

    Returns:
        The path of the HTML report.

    Raises:
        RecordsError: If a file or a column of the records is missing.
    """
    folder = Path(folder)
    records = records or read_records(folder)
    if results is None:
        results = results_table(records.evaluations, records.runs)
    verdicts = judge_claims(records.episodes, records.evaluations, records.config["preset"])
    figures = draw_figures(folder, records)
    results.to_csv(folder / RESULTS_CSV)
    (folder / RESULTS_MARKDOWN).write_text(_markdown(results), encoding="utf-8")
    claims = json.dumps([asdict(verdict) for verdict in verdicts], indent=2, ensure_ascii=False)
    (folder / CLAIMS_FILE).write_text(claims + "\n", encoding="utf-8")
    report = folder / REPORT_FILE
    report.write_text(_html(records, results, verdicts, figures), encoding="utf-8")
    return report


def terminal_table(results: pd.DataFrame) -> Table:
    """Make a table of at most 100 columns for the terminal from `metrics.results_table`."""
    table = Table(
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
        pad_edge=False,
        caption="Below a value: its 95 % interval, and how many flights (or seeds) got there.",
        caption_justify="left",
    )
    for place, heading in enumerate(_TERMINAL_HEADINGS):
        table.add_column(heading, justify="left" if place == 0 else "right", overflow="fold")
    for row in result_rows(results):
        table.add_row(*(_terminal_cell(cell) for cell in row), end_section=True)
    return table


def _terminal_cell(cell: Cell) -> Text:
    # Text, not markup: an agent's name may hold brackets. The last words would cost the width.
    details = (detail.removesuffix(" settled") for detail in cell.details)
    return Text("\n".join((cell.value, *details)))


def result_rows(results: pd.DataFrame) -> list[tuple[Cell, ...]]:
    """Put the results into words: a cell for each of `HEADINGS`, a row per agent."""
    return [_row(str(agent), row) for agent, row in results.iterrows()]


def _row(agent: str, row: Mapping[str, Any]) -> tuple[Cell, ...]:
    seeds, episodes = int(row["seeds"]), int(row["episodes"])
    settled = (f"{int(row['settled'])} of {episodes} settled",)
    crashed = (f"{int(row['crashed'])} of {episodes} crashed",) if row["crashed"] else ()
    if math.isnan(row["reached"]):
        reached: tuple[str, ...] = ()
    else:
        reached = (f"{int(row['reached'])} of {seeds} seed{'s' * (seeds != 1)}",)
    return (
        Cell(agent_label(agent), (f"{seeds} seed{'s' * (seeds != 1)}",)),
        _measured(row, "steady_error", crashed),
        _measured(row, "settling_time", settled),
        _measured(row, "overshoot"),
        _measured(row, "return"),
        Cell(_count(row["env_steps_to_reach"]), reached),
        Cell(_number(row["seconds_to_reach"])),
        Cell(_count(row["steps_per_second"])),
    )


def _measured(row: Mapping[str, Any], name: str, details: tuple[str, ...] = ()) -> Cell:
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    interval = () if math.isnan(low) else (f"{_number(low)} to {_number(high)}",)
    return Cell(_number(row[name]), interval + details)


def _number(value: float) -> str:
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


def _count(value: float) -> str:
    return NOTHING if math.isnan(value) else f"{value:,.0f}"


def _markdown(results: pd.DataFrame) -> str:
    lines = [HEADINGS, ("---", *["---:"] * (len(HEADINGS) - 1))]
    for row in result_rows(results):
        lines.append(tuple(_markdown_cell(cell) for cell in row))
    table = "".join(f"| {' | '.join(cells)} |\n" for cells in _escape_bars(lines))
    return f"{table}\n{TABLE_NOTE}\n"


def _markdown_cell(cell: Cell) -> str:
    return f"{cell.value} ({'; '.join(cell.details)})" if cell.details else cell.value


def _escape_bars(lines: list[tuple[str, ...]]) -> list[list[str]]:
    # |E| in a cell would end the cell.
    return [[cell.replace("|", r"\|") for cell in line] for line in lines]


def _html(
    records: Records, results: pd.DataFrame, verdicts: list[Verdict], figures: list[Path]
) -> str:
    source = resources.files(__package__).joinpath("report.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    config = records.config
    agents = sort_agents(records.evaluations["agent"])
    return environment.from_string(source).render(
        config=config,
        agents=[(agent_label(agent), agent_color(agent)) for agent in agents],
        summary=_summary(config),
        headings=HEADINGS,
        rows=list(zip((agent_color(agent) for agent in agents), result_rows(results), strict=True)),
        note=TABLE_NOTE,
        verdicts=verdicts,
        schedule=_schedule(config["agents"]),
        figures=_embedded(figures),
        sections=_sections(config),
    )


def _summary(config: Mapping[str, Any]) -> str:
    seeds, env = config["seeds"], config["env"]
    text = f"{len(seeds)} seed{'s' * (len(seeds) != 1)}, {_count(config['env_steps'])} env steps"
    if "episode_length" in env and "control_period" in env:
        duration = env["episode_length"] * env["control_period"]
        text += f" per run, episodes of {duration:g} s at {env['control_period']:g} s per step"
    return text


def _schedule(agents: Mapping[str, Mapping[str, Any]]) -> str:
    """What an annealed learning rate means for the claims; "" if the judged agents have none."""
    annealed = [agent_label(name) for name in ("vpg", "a2c") if agents.get(name, {}).get("anneal")]
    if not annealed:
        return ""
    return (
        f"Here the learning rate of {' and '.join(annealed)} falls to 0 over the run, which fixes "
        "roughly when a curve settles and damps its late fluctuation; the paper's rate is constant."
    )


def _embedded(figures: list[Path]) -> list[tuple[str, str, str, str]]:
    """For each figure: its name, its picture as a data URL, its title and its caption."""
    return [
        (
            Path(name).stem,
            "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii"),
            title,
            caption,
        )
        for name, path, (title, caption) in zip(FIGURE_FILES, figures, _CAPTIONS, strict=True)
    ]


def _sections(config: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """The configuration as titled lists of names and values."""
    general = {name: config[name] for name in ("created", "preset", "seeds", "env_steps")}
    sections: list[tuple[str, Mapping[str, Any]]] = [
        ("Comparison", general | {"model_hash": config["model_hash"]}),
        ("Environment", config["env"]),
    ]
    agents = config["agents"]
    sections += [(f"Agent: {agent_label(name)}", agents[name]) for name in sort_agents(agents)]
    sections += [("Versions", config["versions"]), ("Machine", config["machine"])]
    return [
        (title, [(name, _written(value)) for name, value in values.items()])
        for title, values in sections
    ]


def _written(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
