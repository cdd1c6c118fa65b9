"""Progress of runs: a bar each on a terminal, a line now and then elsewhere, the same figures.

A line fits into 80 columns: on narrow terminals the bar gives way, then the figures are cut.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console
from rich.progress import BarColumn, Progress, Task, TextColumn

from ..flights.executors import OnProgress

_LINE_EVERY = 10.0  # s


@contextmanager
def bars() -> Iterator[OnProgress]:
    """A function that shows how far the named run is: (name, done, total, words)."""
    console = Console()
    if not sys.stdout.isatty() or console.is_dumb_terminal:
        yield Lines()
        return
    shown = Bars(console)
    with shown.progress:
        yield shown


@contextmanager
def frame_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A function that shows how many frames of a film are drawn: (done, total)."""
    with bars() as show:

        def show_frame(done: int, total: int) -> None:
            words = "done" if done == total else "frames"
            show(name, done, total, words)

        yield show_frame


class Bars:
    """Shows each run by a bar, with its figures and words. The clock tells seconds."""

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        name = TextColumn("{task.description}", markup=False)
        figures = TextColumn("{task.fields[figures]}", markup=False)
        bar = BarColumn(bar_width=None)
        self.progress = Progress(name, bar, figures, console=console, get_time=clock)
        self._tasks: dict[str, Task] = {}

    def __call__(self, name: str, done: int, total: int, words: str) -> None:
        """Show it."""
        task = self._update(name, done, total, words)
        if words == "done":  # more runs than lines: what is done makes room
            self.progress.update(task.id, visible=False)
            self.progress.print(f"{name:14} done", highlight=False)

    def _update(self, name: str, done: int, total: int, words: str) -> Task:
        """The task of a run, with these amounts."""
        if name not in self._tasks:
            number = self.progress.add_task(name, figures="")
            self._tasks[name] = next(t for t in self.progress.tasks if t.id == number)
        task = self._tasks[name]
        self.progress.update(task.id, completed=done, total=total)
        self.progress.update(task.id, figures=_figures(task, words))
        return task


class Lines(Bars):
    """Prints a run at most every ten seconds, and when it is done. The clock tells seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(Console(), clock)  # its bars are never started: they show nothing
        self._last: dict[str, float] = {}

    def __call__(self, name: str, done: int, total: int, words: str) -> None:
        """Print it, unless that was done a moment ago."""
        task = self._update(name, done, total, words)
        now = self.progress.get_time()
        if words == "done" or now - self._last.get(name, now - _LINE_EVERY) >= _LINE_EVERY:
            self._last[name] = now
            with suppress(OSError):  # no line is worth a run
                print(f"{name:14} {task.fields['figures']}", flush=True)


def _figures(task: Task, words: str) -> str:
    """Amounts, rate, times and words of a run."""
    texts = [f"{_short(task.completed)}/{_short(task.total or 0)}"]
    elapsed = task.finished_time if task.finished else task.elapsed
    times = _duration(elapsed or 0.0)
    if task.speed:
        texts.append(f"{_short(task.speed)}/s")
        if task.remaining:
            times += f", {_duration(math.ceil(task.remaining / task.speed))} left"
    texts += [times, words]
    return " ".join(filter(None, texts))


def _short(number: float) -> str:
    """Four figures and a letter at most beyond 99,999: 12,345 and 200k and 1.25M."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e5, "k")):
        if number >= size:
            scaled = number / (1e3 if letter == "k" else size)
            return f"{scaled:.4g}{letter}"
    return f"{number:,.0f}" if number >= 10 or number == int(number) else f"{number:.2g}"


def _duration(seconds: float) -> str:
    """1:05 is a minute, 1h05m an hour."""
    minutes, second = divmod(int(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}h{minute:02}m" if hours else f"{minute}:{second:02}"
