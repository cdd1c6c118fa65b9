"""Commands of many runs: flags of their workers, progress, how to resume, reports."""

import logging
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from tyro.conf import arg

from ..flights.folders import FolderBusy
from ..training.settings import RunsConfig
from ._flags import BackendFlags, Command, folder_to_write, go_on_with

if TYPE_CHECKING:
    from ..flights.executors import OnProgress

RESUMED: Final = ("jobs", "runner", "address", "resume", "env")
"""Flags that a resumed command may be given: they change no number. `--env` imports the module of a
task."""


@dataclass(frozen=True, kw_only=True)
class FolderFlags(Command):
    """A command of many runs, on the cores of this machine or on many machines: where to write."""

    out: Path | None = None
    """Folder to write; it must not exist. Default: runs/COMMAND-TIME."""
    resume: Path | None = None
    """Folder of an interrupted command to go on with; it keeps its settings."""
    address: Annotated[str | None, arg(metavar="ray://HOST:PORT")] = None
    """The Ray cluster. Default: the one that this machine is part of."""


@dataclass(frozen=True, kw_only=True)
class RunsFlags(FolderFlags, RunsConfig, BackendFlags):
    """Such a command that flies one task."""

    def settings(self, kind: type[Any]) -> dict[str, Any]:
        """As of `Command`; of drones that are not told, those of one world."""
        told = super().settings(kind)
        if "num_envs" in told and "num_envs" not in self.given:
            told["num_envs"] = max(self.drones, 1)
        return told


def command_line() -> str:
    """The command as the user typed it."""
    return shlex.join(["rotorgram", *sys.argv[1:]])


@contextmanager
def runs_folder(name: str, command: FolderFlags) -> "Iterator[tuple[Path, OnProgress]]":
    """The folder to write to, and what shows progress; says how to resume if the runs fail."""
    from ._progress import bars

    new = folder_to_write(command.out, name.replace(" ", "-"))
    with nullcontext(command.resume) if command.resume else new as folder:
        try:
            with bars() as progress:
                yield folder, progress
        except BaseException as error:
            if any(folder.iterdir()) and not isinstance(error, FolderBusy):
                print(go_on_with(command, name, folder, "env", "runner", "address"))
            raise


def report_comparison(folder: Path, *, film: bool = True) -> None:
    """Write figures, film and report from the folder's files, and print the table."""
    from rich.console import Console

    from ..models.errors import InputError
    from ..training.report import VIDEO_FILE, table_of, terminal_table, write_report
    from ..training.results import read_results
    from ._progress import frame_bar

    results = read_results(folder)
    page = write_report(folder, results)
    Console(width=100).print(terminal_table(table_of(results), results.headline))
    # Only now: if the film fails, there is a report.
    if film and not (folder / VIDEO_FILE).exists():
        try:
            from ..training.films import film_comparison

            with frame_bar(VIDEO_FILE) as on_frame:
                if film_comparison(folder, folder / VIDEO_FILE, on_frame):
                    write_report(folder, results)
        except (OSError, InputError, ImportError) as error:
            logging.getLogger(__name__).info("no film of the agents: %s", error)
    print(f"report: {page}")


def report_sweep(folder: Path) -> None:
    """Write `sweep.csv` from the folder's files, and print it."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from ..training.metrics import Headline
    from ..training.results import read_spec
    from ..training.sweep import SWEEP_FILE, read_sweep_config, write_sweep_table

    config = read_sweep_config(folder)
    headline = Headline.of(read_spec(folder))
    results = write_sweep_table(config, folder)
    steady = headline.labelled(f"Steady {headline.size_symbol},\nworst")
    table = Table(box=box.SIMPLE_HEAD)
    for name in config.grid:
        table.add_column(name.replace("_", "\n"), overflow="fold")
    for heading in (
        steady, "median", "Return,\nmedian", "Settled", "Crashed", "Seeds", "Training\n(s)",
        "Env\nsteps/s",
    ):  # fmt: skip
        table.add_column(heading, justify="right")
    cells = ("{worst:.3g}", "{median:.3g}", "{return:.0f}", "{settled} of {episodes}", "{crashed}",
             "{seeds}", "{seconds:.1f}", "{steps_per_second:,.0f}")  # fmt: skip
    for row in results.to_dict("records"):
        own = (str(row[name]) for name in config.grid)
        table.add_row(*own, *(cell.format(**row) for cell in cells))
    Console(width=100).print(table)
    print(f"{results['seeds'].sum()} of {len(config.runs())} runs done")
    print(f"table: {folder / SWEEP_FILE}")


def report_board(folder: Path, page: Path | None = None) -> None:
    """Write the page of a board from the folder's files."""
    from ..training.board import write_page

    page = page or folder / "baselines.md"
    write_page(folder, page)
    print(f"page: {page}")
