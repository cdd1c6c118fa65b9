"""`rotorgram compare` and `rotorgram report`."""

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ..experiments.compare import PARTS, CompareConfig, read_compare_config
from ..experiments.compare import compare as run_comparison
from ..experiments.errors import RunsFailed
from ..experiments.metrics import results_table
from ..experiments.records import read_records
from ..experiments.report import terminal_table, write_report
from .inputs import new_folder, refuse_settings
from .progress import bars

if TYPE_CHECKING:
    from .commands import Compare

__all__ = ["compare", "report"]


def compare(command: "Compare") -> int:
    """Train, evaluate and report."""
    workers: dict[str, Any] = {n: getattr(command, n) for n in ("jobs", "backend", "address")}
    if command.resume:
        folder = command.resume
        refuse_settings(command, folder, free=("resume", *workers))
        config = replace(read_compare_config(folder), **workers)
        if not (folder / PARTS).is_dir():
            raise ValueError(
                f"resume: expected an interrupted comparison, {folder} is finished; "
                f"draw its report with: rotorgram report {folder}"
            )
    else:
        config = CompareConfig(
            agents=command.agents,
            seeds=command.seeds,
            env_steps=command.env_steps,
            preset=command.preset,
            env=command.env.checked(),
            snapshots=command.snapshots,
            episodes=command.episodes,
            **workers,
        )
        folder = new_folder(command.out, "compare")
    words = shlex.join(["rotorgram", *sys.argv[1:]])
    try:
        with bars() as progress:
            run_comparison(config, folder, words, progress)
    except (KeyboardInterrupt, RunsFailed):
        where = f" --backend {command.backend}" if command.backend != "loky" else ""
        where += f" --address {command.address}" if command.address else ""
        if folder.exists():
            print(f"go on with: rotorgram compare --resume {folder}{where}")
        raise
    report(folder)
    return 0


def report(folder: Path) -> None:
    """Write figures and report from the folder's files, and print the table."""
    records = read_records(folder)
    results = results_table(records.evaluations, records.runs)
    page = write_report(folder, records, results)
    Console(width=100).print(terminal_table(results))
    print(f"report: {page}")
