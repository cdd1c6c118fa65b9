"""Progress of runs: a bar each on a terminal, a line now and then elsewhere, the same figures.

A line fits into 80 columns: on narrow terminals the bar gives way, then the figures are cut.
"""

import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Final

from rich.console import Console
from rich.progress import BarColumn, Progress, Task, TextColumn
from rich.table import Column
from rich.text import Text

from ..experiments.progress import OnProgress

__all__ = ["Bars", "Lines", "bars"]

_LINE_EVERY: Final = 10.0  # s
_RATE_OVER: Final = 10.0  # s: the rate is that of so long a time up to now


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


class Bars:
    """Shows runs by a bar each, with done and total, rate, elapsed and remaining time, and words.

    Args:
        console: Where.
        clock: Tells seconds.
    """

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self.progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=None),
            _Figures(_count),
            _Figures(_rate),
            _Figures(_times),
            TextColumn("{task.fields[words]}"),
            console=console,
            get_time=clock,
        )
        self._runs = _Runs(self.progress)

    def __call__(self, name: str, done: int, total: int, words: str) -> None:
        """Show it."""
        task = self._runs.update(name, done, total, words)
        if words == "done":  # more runs than lines: what is done makes room
            self.progress.update(task.id, visible=False)
            self.progress.print(f"{name:14} done", highlight=False)


class Lines:
    """Prints a run at most every ten seconds, and when it is done.

    Args:
        clock: Tells seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last: dict[str, float] = {}
        self._runs = _Runs(Progress(get_time=clock))  # never started: it shows nothing

    def __call__(self, name: str, done: int, total: int, words: str) -> None:
        """Print it, unless that was done a moment ago."""
        task, now = self._runs.update(name, done, total, words), self._clock()
        if words == "done" or now - self._last.get(name, now - _LINE_EVERY) >= _LINE_EVERY:
            self._last[name] = now
            figures = (_count(task), _rate(task), _times(task), words)
            with suppress(OSError):  # no line is worth a run
                print(f"{name:14} {'  '.join(filter(None, figures))}", flush=True)


class _Pace:
    """Recent speed of a run: amounts done and their times, over the last seconds.

    There is always a point: a bar may be drawn, by a thread of rich's, at any time.
    """

    def __init__(self, now: float, done: int) -> None:
        self._points = deque([(now, done)])

    def add(self, now: float, done: int) -> None:
        points = self._points
        points.append((now, done))
        while len(points) > 2 and points[1][0] <= now - _RATE_OVER:
            points.popleft()

    @property
    def rate(self) -> float:
        """Per second; 0 where it is not known."""
        (began, before), (now, done) = self._points[0], self._points[-1]
        return max(done - before, 0) / (now - began) if now > began else 0.0


class _Runs:
    """The task of each run, by name."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, Task] = {}

    def update(self, name: str, done: int, total: int, words: str) -> Task:
        now = self._progress.get_time()
        if name not in self._tasks:
            pace = _Pace(now, done)
            number = self._progress.add_task(name, total=total, words=words, pace=pace)
            self._tasks[name] = next(t for t in self._progress.tasks if t.id == number)
        task = self._tasks[name]
        task.fields["pace"].add(now, done)
        self._progress.update(task.id, completed=done, total=total, words=words)
        return task


class _Figures(TextColumn):
    """A column with the text that a function gives for a task."""

    def __init__(self, figures: Callable[[Task], str]) -> None:
        super().__init__("", table_column=Column(no_wrap=True, justify="right"))
        self._figures = figures

    def render(self, task: Task) -> Text:
        return Text(self._figures(task))


def _count(task: Task) -> str:
    return f"{_short(task.completed)}/{_short(task.total or 0)}"


def _rate(task: Task) -> str:
    rate = task.fields["pace"].rate
    return f"{_short(rate)}/s" if rate else ""


def _times(task: Task) -> str:
    elapsed = task.finished_time if task.finished else task.elapsed
    rate, remaining = task.fields["pace"].rate, task.remaining
    left = f", {_duration(math.ceil(remaining / rate))} left" if rate and remaining else ""
    return f"{_duration(elapsed or 0.0)}{left}"


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
