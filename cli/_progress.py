"""Progress of runs: a bar each on a terminal, a line now and then elsewhere.

A line fits into 80 columns: on narrow terminals the bar gives way, then the figures are cut.
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # importing rich takes time, also where no bar is shown
    from rich.console import Console
    from rich.progress import TaskID

    from ..flights.executors import OnProgress

_LINE_EVERY = 10.0  # s


@contextmanager
def bars() -> Iterator["OnProgress"]:
    """A function that shows how far the named run is: (name, done, total, words)."""
    if sys.stdout.isatty():
        from rich.console import Console

        console = Console()
        if not console.is_dumb_terminal:
            shown = Bars(console)
            with shown.progress:
                yield shown
            return
    yield Lines()


class Bars:
    """Shows each run by a bar, with its amounts, times and words. The clock tells seconds."""

    def __init__(self, console: "Console", clock: Callable[[], float] = time.monotonic) -> None:
        from rich.progress import (
            BarColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )
        from rich.table import Column

        self.progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=None),
            TextColumn("{task.completed:,}/{task.total:,}"),
            TimeElapsedColumn(table_column=Column(no_wrap=True)),
            TimeRemainingColumn(table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[words]}", markup=False),
            console=console,
            get_time=clock,
        )
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, name: str, done: int, total: int, words: str) -> None:
        """Show it."""
        if name not in self._tasks:
            self._tasks[name] = self.progress.add_task(name, total=total, words=words)
        task = self._tasks[name]
        self.progress.update(task, completed=done, total=total, words=words)
        if words == "done":  # more runs than lines: what is done makes room
            self.progress.update(task, visible=False)
            self.progress.print(f"{name:14} done", highlight=False)


class Lines:
    """Prints a run at most every ten seconds, and when it is done. The clock tells seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last: dict[str, float] = {}

    def __call__(self, name: str, done: int, total: int, words: str) -> None:
        """Print it, unless that was done a moment ago."""
        now = self._clock()
        if words == "done" or now - self._last.get(name, now - _LINE_EVERY) >= _LINE_EVERY:
            self._last[name] = now
            with suppress(OSError):  # no line is worth a run
                print(f"{name:14} {done:,}/{total:,} {words}".rstrip())
