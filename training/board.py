"""The page of a baselines board, made of the folder's files alone.

Tables by task; then, where agents share tasks, measures over all of them by the definitions of
`statistics`, of a *score*: with the mean size of the headline metric in the last quarter, and the
bound below (above) which a goal counts as held, bound / (bound + size), or for a metric that is to
be high size / (bound + size). A share that is to be high, without a unit and with a bound below 1,
counts by what it lacks to 1. So 1/2 is the bound itself, and 1 the best. A run with a crash that
the size does not count, or without a value, scores 0.
"""

import os
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd

from ..agents.checkpoints import write_whole
from ..flights.palette import agent_label
from .benchmark import SEEDS_FILE, Board, checkpoint_file, read_board
from .metrics import Headline
from .results import CONFIG_FILE
from .settings import BoardRow
from .statistics import (
    bootstrap_interval,
    finite,
    improvement_interval,
    iqm,
    performance_profile,
    probability_of_improvement,
)

PROFILE: Final = (0.5, 0.8, 0.95)
"""Scores of which the profile is shown: the bound, a quarter and a nineteenth of its size."""
_NOTHING: Final = "–"


def write_page(folder: Path, page: Path) -> None:
    """Write the page of a board's folder. Raises `ResultsError`."""
    write_whole(page, page_of(folder, page.parent).encode())


def page_of(folder: Path, beside: Path) -> str:
    """The page, whose links lead from the folder `beside` to the board's files."""
    board = read_board(folder)
    where = Path(os.path.relpath(folder, beside))
    tasks = [(task, list(rows)) for task, rows in groupby(
        sorted(board.config.rows, key=lambda row: row.task), key=lambda row: row.task
    )]  # fmt: skip
    parts = [_introduction(board, where)]
    parts += [_task(board, folder, where, task, rows) for task, rows in tasks]
    parts += _overall(board, tasks)
    return "\n\n".join(parts) + "\n"


def _introduction(board: Board, where: Path) -> str:
    config, content = board.config, board.content
    seeds = f"{config.first_seed} to {config.first_seed + config.seeds - 1}"
    machine, versions = content["machine"], content["versions"]
    missing = len(config.runs()) - len(board.seeds)
    lines = [
        "# Baselines",
        "",
        "Agents on tasks with vehicles, every row trained on the same seeds, which no tuning used. "
        "Every policy",
        "is evaluated without exploration on the backend `mujoco`.",
        "`rotorgram benchmark` writes this page from its files alone:",
        "",
        "```sh",
        content["command"],
        "```",
        "",
        f"[`{CONFIG_FILE}`]({where / CONFIG_FILE}) has all settings and versions, "
        f"[`{SEEDS_FILE}`]({where / SEEDS_FILE}) a line for each seed.",
        f"Seeds {seeds}; {config.episodes} evaluation episodes each; {content['created'][:10]}, "
        f"{machine['cores']} cores ({machine['processor']}), MuJoCo {versions['mujoco']}.",
        *(["Fewer than five seeds: a short look, which decides nothing."] * (config.seeds < 5)),
        *([f"{missing} of {len(config.runs())} runs are missing."] if missing else []),
        "",
        "* **Steady**: mean size of the task's deciding metric in the last quarter of an episode. "
        "Here and for the return:",
        "  the interquartile mean over seeds, with its 95 % bootstrap interval, by the definitions "
        "of",
        "  [rliable](https://arxiv.org/abs/2108.13264).",
        "* **Hold**: seeds whose steady size is on the good side of the bound, without a crash "
        "(`landed` counts crashes itself).",
        "* **Env steps and training time to hold**: to the first of "
        f"{config.snapshots} snapshots from which on all hold;",
        "  the interquartile mean over the seeds that get there. The time has simulator and wire "
        "in it, and",
        "  other runs on the other cores.",
        "* **Policy**: that of the first seed, which nobody chose: "
        "`rotorgram evaluate FILE` flies it.",
    ]
    return "\n".join(lines)


def _task(board: Board, folder: Path, where: Path, task: str, rows: Sequence[BoardRow]) -> str:
    headline = Headline.of(board.specs[rows[0].name])
    steady = headline.labelled(f"Steady {headline.size_symbol}").replace("|", r"\|")
    held = headline.held_text.replace("|", r"\|")
    headings = ["Agent", steady, f"Hold {held}".rstrip(), "Crashed", "Env steps to hold",
                "Training to hold (s)", "Return", "Env steps", "Policy"]  # fmt: skip
    lines = [
        f"## {task}",
        "",
        _line(headings),
        _line(["---", *["---:"] * (len(headings) - 2), "---"]),
    ]
    for row in rows:
        own = board.seeds[board.seeds["row"] == row.name]
        if len(own):
            lines.append(_line(_cells(row, own, headline, _link(folder, where, row))))
    bounds = board.bounds[rows[0].name]
    for name, value in bounds.items():
        empty = [_NOTHING] * (len(headings) - 4)
        lines.append(_line([f"{name} (bound)", *empty, _figure(value), _NOTHING, _NOTHING]))
    if bounds:
        lines += ["", "Bounds: mean returns over the same episodes; "
                  "[their derivation](results.md#the-returns-bound)."]  # fmt: skip
    return "\n".join(lines)


def _cells(row: BoardRow, own: pd.DataFrame, headline: Headline, link: str) -> list[str]:
    reached = finite(own["env_steps_to_hold"].to_numpy())
    seconds = iqm(own["seconds_to_hold"].to_numpy())
    some = f" ({len(reached)} of {len(own)})" if len(reached) < len(own) else ""
    trained = not row.controller
    told = [row.preset] if trained else [f"{name}={value}" for name, value in row.brought.items()]
    agent = ", ".join([agent_label(row.agent), *(f"`{word}`" for word in told)])
    crashed = f"{own['crashed'].sum()} of {own['episodes'].sum()}"
    return [
        agent,
        _estimate(own["steady"]),
        _NOTHING if headline.held is None else f"{own['held'].sum()} of {len(own)}",
        crashed,
        f"{iqm(reached):,.0f}{some}" if reached.size else _NOTHING,
        f"{seconds:.3g}" if reached.size else _NOTHING,
        _estimate(own["return"]),
        f"{row.env_steps:,}" if trained else _NOTHING,
        link,
    ]


def _link(folder: Path, where: Path, row: BoardRow) -> str:
    path = checkpoint_file(folder, row)
    if not path.exists():
        return _NOTHING
    size = f"{path.stat().st_size / 1024:.1f} KiB"
    return f"[{size}]({where / path.relative_to(folder)})"


def scores(own: pd.DataFrame, headline: Headline) -> np.ndarray:
    """Scores from 0 to 1 of the seeds of a row, (n,): see the module. NaN without a bound."""
    size, bound, high = own["steady"].to_numpy(), headline.held, headline.high
    if bound is None:
        return np.full(len(own), np.nan)
    if high and not headline.unit and bound < 1:
        size, bound, high = 1 - size, 1 - bound, False
    size = np.maximum(size, 0.0)
    score = (size if high else bound) / (bound + size)
    crashed = (own["crashed"] > 0) & (not headline.counts_crashes)
    return np.where(crashed | np.isnan(size), 0.0, score)


def _overall(board: Board, tasks: Sequence[tuple[str, list[BoardRow]]]) -> list[str]:
    """Agents over the tasks that all of them fly; each pair over the tasks that it shares."""
    found: dict[str, dict[str, np.ndarray]] = {}
    for task, rows in tasks:
        headline = Headline.of(board.specs[rows[0].name])
        for row in rows:
            own = board.seeds[board.seeds["row"] == row.name]
            if not row.controller and len(own) and headline.held is not None:
                label = f"{agent_label(row.agent)}, `{row.preset}`"
                found.setdefault(label, {})[task] = scores(own, headline)
    if len(found) < 2:
        return []
    return [*_totals(found), _pairs(found)]


def _totals(found: dict[str, dict[str, np.ndarray]]) -> list[str]:
    shared = [
        task for task in next(iter(found.values())) if all(task in own for own in found.values())
    ]
    if len(shared) < 2:
        return []
    headings = ["Agent", "Score", *(f"Runs above {mark:g}" for mark in PROFILE)]
    lines = [
        "## Over all tasks",
        "",
        f"Of the {len(shared)} tasks that all agents fly. Score: b / (b + e) for a steady size e "
        "and the bound b of holding (e / (b + e) of",
        "a metric that is to be high; of a share that is, e and b are what it lacks to 1), 0 with "
        "a crash. Interquartile mean over all runs,",
        "resampled task by task; then the performance profile.",
        "",
        _line(headings),
        _line(["---", *["---:"] * (len(headings) - 1)]),
    ]
    for label, own in found.items():
        strata = [own[task] for task in shared]
        shares = performance_profile(strata, PROFILE)
        low, high = bootstrap_interval(*strata)
        value = f"{iqm(*strata):.3f}{_interval(low, high, '.3f')}"
        lines.append(_line([label, value, *(f"{share:.0%}" for share in shares)]))
    return ["\n".join(lines)]


def _pairs(found: dict[str, dict[str, np.ndarray]]) -> str:
    lines = [
        "## Which is better",
        "",
        "Probability that a run of the agent of the row has a higher score than one of the column, "
        "over the tasks that both fly, and",
        "its 95 % bootstrap interval. An interval that has 50 % in it decides nothing.",
        "",
        _line(["", *found]),
        _line(["---", *["---:"] * len(found)]),
    ]
    for label, own in found.items():
        cells = []
        for other, theirs in found.items():
            tasks = [task for task in own if task in theirs]
            if label == other or not tasks:
                cells.append(_NOTHING)
                continue
            pair = [own[task] for task in tasks], [theirs[task] for task in tasks]
            share = probability_of_improvement(*pair)
            cells.append(f"{share:.0%}{_interval(*improvement_interval(*pair), '.0%')}")
        lines.append(_line([label, *cells]))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _estimate(values: pd.Series) -> str:
    numbers = values.to_numpy()
    low, high = bootstrap_interval(numbers)
    ends = f" [{_figure(low)}, {_figure(high)}]" if np.isfinite(low) else ""
    return f"{_figure(iqm(numbers))}{ends}"


def _interval(low: float, high: float, form: str) -> str:
    return f" [{low:{form}}, {high:{form}}]" if np.isfinite(low) else ""


def _figure(value: float) -> str:
    if not np.isfinite(value):
        return _NOTHING
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
