"""The table of results: in words, for the terminal and as Markdown."""

import math
import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import pandas as pd
from rich import box
from rich.table import Table
from rich.text import Text

from .metrics import Headline
from .palette import agent_label

NOTHING: Final = "–"
"""Shown where there is no value."""


def headings(headline: Headline) -> tuple[str, ...]:
    """Headings of the columns."""
    size, goal, settled = headline.size_symbol, headline.held_text, headline.settled
    band = f" to {headline.amount(f'{settled:.2g}')}" if settled is not None else ""
    return (
        "Agent",
        headline.labelled(f"Steady {size}"),
        f"Seeds that hold {goal}".rstrip(),
        f"Settling{band} (s)",
        headline.labelled("Overshoot"),
        "Return",
        f"Env steps to {goal or 'hold'}",
        "Env steps per s",
    )


def table_note(headline: Headline) -> str:
    """Explanation of the columns."""
    size, goal, settled = headline.size_symbol, headline.held_text, headline.settled
    parts = [
        "Interquartile means over seeds with 95 % bootstrap intervals, from the deterministic "
        "evaluation after training, on episodes of its own. "
        f"Steady {size}: mean {size} in the last quarter of an episode."
    ]
    if goal:
        parts.append(
            f"Seeds that hold: those with a mean steady state of {goal} and without a crash in "
            "that evaluation; below it the worst seed's steady state. Env steps and training "
            f"time: up to the first snapshot from which on all hold {goal}, over the seeds that "
            "get there."
        )
    if headline.settles:
        band = headline.amount(f"{settled:.2g}")
        parts.append(f"Settling: until {size} stays below {band}, over the episodes that settle.")
    parts.append(
        "A crashed episode counts with what was flown of it and has not settled. Bounds: the "
        "time-optimal flight of the same episodes, and thrust that stays at hover."
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
    for heading in (
        headline.labelled(f"Steady\n{headline.size_symbol}"),
        "Hold\nit",
        "Settling\n(s)",
        f"Overshoot\n({headline.unit})" if headline.unit else "Overshoot",
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
        _measured(row, "overshoot"),
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
    titles = headings(headline)
    lines = [titles, ("---", *["---:"] * (len(titles) - 1))]
    lines += [tuple(map(_markdown_cell, row)) for row in result_rows(table)]
    # |E| in a cell would end the cell.
    text = ["".join(f"| {cell.replace('|', chr(92) + '|')} " for cell in line) for line in lines]
    return "".join(f"{line}|\n" for line in text) + f"\n{table_note(headline)}\n"


def _markdown_cell(cell: Cell) -> str:
    return f"{cell.value} ({'; '.join(cell.details)})" if cell.details else cell.value
