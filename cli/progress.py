"""Progress of runs: a bar each on a terminal, a line now and then elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from ..experiments.progress import OnProgress

__all__ = ["bars"]

_LINE_EVERY: Final = 10.0  # s


@contextmanager
def bars() -> Iterator[OnProgress]:
    """A function that shows how far the named run is: (name, done, total, words)."""
    if not sys.stdout.isatty():
        yield _Lines()
        return
    columns = (
        TextColumn("{task.description:14}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[words]}"),
    )
    with Progress(*columns) as progress:
        tasks = {}

        def show(name: str, done: int, total: int, words: str) -> None:
            if name not in tasks:
                tasks[name] = progress.add_task(name, total=total, words=words)
            progress.update(tasks[name], completed=done, total=total, words=words)
            if words == "done":  # more runs than lines: what is done makes room
                progress.update(tasks[name], visible=False)
                progress.print(f"{name:14} done")

        yield show


class _Lines:
    """Prints a run at most every ten seconds, and when it is done."""

    def __init__(self) -> None:
        self._last: dict[str, float] = {}

    def __call__(self, name: str, done: int, total: int, words: str) -> None:
        now = time.monotonic()
        if words == "done" or now - self._last.get(name, now - _LINE_EVERY) >= _LINE_EVERY:
            self._last[name] = now
            print(f"{name:14} {done:>9,} / {total:,}  {words}", flush=True)
