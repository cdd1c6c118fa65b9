"""The table of results: in words, for the terminal and as Markdown."""

import math
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import pandas as pd
from rich import box
from rich.table import Table
from rich.text import Text

from .figures import agent_label
from .metrics import HOLD_THRESHOLD, SETTLING_TOLERANCE

__all__ = [
    "HEADINGS",
    "NOTHING",
    "TABLE_NOTE",
    "Cell",
    "count_text",
    "markdown_table",
    "number_text",
    "result_rows",
    "terminal_table",
]

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


class Cell(NamedTuple):
    """A cell of the table: its value, and what stands in small print below it."""

    value: str
    details: tuple[str, ...] = ()


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
        Cell(count_text(row["env_steps_to_reach"]), reached),
        Cell(number_text(row["seconds_to_reach"])),
        Cell(count_text(row["steps_per_second"])),
    )


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


def markdown_table(results: pd.DataFrame) -> str:
    """Make a Markdown table from `metrics.results_table`, with its note below."""
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
