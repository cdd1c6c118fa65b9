"""`rotorgram compare` and `rotorgram report`."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from ..experiments.compare import PARTS, CompareConfig, read_compare_config
from ..experiments.compare import compare as run_comparison
from ..experiments.metrics import results_table
from ..experiments.records import read_records
from ..experiments.report import VIDEO_FILE, terminal_table, write_report
from .inputs import new_folder, refuse_settings
from .progress import bars
from .workers import WORKERS, command_line, showing, workers

if TYPE_CHECKING:
    from .training import Compare

__all__ = ["compare", "report"]


def compare(command: "Compare") -> int:
    """Train, evaluate and report."""
    if command.resume:
        folder = command.resume
        refuse_settings(command, folder, free=("resume", "film", *WORKERS))
        config = replace(read_compare_config(folder), **workers(command))
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
            **workers(command),
        )
        folder = new_folder(command.out, "compare")
    with showing("compare", command, folder) as progress:
        run_comparison(config, folder, command_line(), progress)
    report(folder, film=command.film)
    return 0


def report(folder: Path, *, film: bool = True) -> None:
    """Write figures, film and report from the folder's files, and print the table."""
    records = read_records(folder)
    results = results_table(records.evaluations, records.runs)
    page = write_report(folder, records, results)
    Console(width=100).print(terminal_table(results))
    # Only now: whatever becomes of the film, there is a report.
    if film and not (folder / VIDEO_FILE).exists() and _film(folder):
        write_report(folder, records, results)
    print(f"report: {page}")


def _film(folder: Path) -> bool:
    """Whether there is a film of the agents for the report. A report without one is a report."""
    # OpenGL is loaded when everything is trained, not before.
    from ..experiments.comparison_film import film_comparison

    try:
        with bars() as progress:

            def on_frame(done: int, total: int) -> None:
                progress(VIDEO_FILE, done, total, "done" if done == total else "film of the agents")

            return film_comparison(folder, folder / VIDEO_FILE, on_frame)
    except (OSError, ValueError) as error:
        logging.getLogger(__name__).info("no film of the agents: %s", error)
        return False
