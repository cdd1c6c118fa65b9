"""Flights as they are flown: the latest moment in a window or a browser.

Whoever flies hands over a moment and goes on at once; a thread draws the latest one. So a slow
machine draws fewer pictures, and flies no slower but for the processor that both share.
"""

import time
from threading import Event, Thread
from typing import Final, Literal, Protocol, Self

from .moment import Moment
from .pace import Pace
from .stage import Stage

__all__ = ["MOST_DRONES", "Lines", "LiveView", "Surface", "lines_over", "open_surface"]

MOST_DRONES: Final = 16
"""Craft that are shown side by side; of more, the first ones."""
DEFAULT_PORT: Final = 8080
_PICTURES: Final = 30.0
"""At most so many a second."""
_NAP: Final = 0.02
"""Longest sleep between two looks at the keys, s."""

Lines = list[tuple[str, str]]
"""Names and values."""


class Surface(Protocol):
    """What a stage is drawn on: a window, or a page."""

    where: str
    """Where to look, for a sentence."""

    def show(self, lines: Lines) -> None:
        """Draw the stage as it is now, with these lines over it."""

    def is_running(self) -> bool:
        """Whether it is still open."""

    def is_watched(self) -> bool:
        """Whether somebody has begun to look."""

    def close(self) -> None:
        """Close it."""


class LiveView:
    """Shows what it is given, in a thread of its own.

    Args:
        stage: What is drawn. Nobody else shows anything on it.
        surface: What it is drawn on.
        pace: Told in the overlay.
        of: How many drones there are, if more than are shown.
    """

    def __init__(self, stage: Stage, surface: Surface, pace: Pace, of: int | None = None) -> None:
        self.stage, self.surface, self.pace = stage, surface, pace
        self._of = of or stage.drones
        self._latest: tuple[Moment, ...] = ()
        self._said = ""
        self._fresh, self._closing = Event(), Event()
        self._error: Exception | None = None
        self._thread = Thread(target=self._paint, name="live view", daemon=True)
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """Whether there is still something to look at. Raises what drawing has raised."""
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        return self._thread.is_alive() and not self._closing.is_set()

    @property
    def is_watched(self) -> bool:
        """Whether somebody has begun to look: with a page, whether a browser has come."""
        return self.surface.is_watched()

    @property
    def wants(self) -> bool:
        """Whether the last moments are drawn, so that others would be."""
        return not self._fresh.is_set()

    def draw(self, *moments: Moment) -> None:
        """Have these drawn, one of each craft, and go on. Older ones that wait are dropped."""
        if len(moments) != self.stage.drones:
            raise ValueError(f"moments: expected {self.stage.drones}, got {len(moments)}")
        self._latest = moments
        self._fresh.set()

    def draw_in_time(self, *moments: Moment) -> bool:
        """`draw`, when the pace has them due, paused or slow; False if it is closed before."""
        while (left := self.pace.wait(time.monotonic())) != 0.0:
            if not self.is_running:
                return False
            time.sleep(_NAP if left is None else min(left, _NAP))
        self.draw(*moments)
        self.pace.stepped(time.monotonic())
        return self.is_running

    def close(self) -> None:
        """Stop drawing and close what it was drawn on. A second call does nothing."""
        if not self._closing.is_set():
            self._closing.set()
            try:
                self._thread.join()
            finally:  # Ctrl-C twice too
                self.surface.close()

    def __enter__(self) -> Self:
        """Return the view, to be closed at the end of the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def _paint(self) -> None:
        try:
            while self.surface.is_running() and not self._closing.is_set():
                began = time.monotonic()
                try:
                    self._paint_one()
                except Exception:
                    if self.surface.is_running():  # otherwise it was closed meanwhile
                        raise
                # What is handed over meanwhile waits, so that `wants` bounds the work for it.
                self._closing.wait(max(0.0, 1 / _PICTURES - (time.monotonic() - began)))
        except Exception as error:
            self._error = error

    def _paint_one(self) -> None:
        if fresh := self._fresh.is_set():
            self._fresh.clear()  # before the moments are read: what comes meanwhile is drawn next
        moments = self._latest
        if not moments or not (fresh or self.pace.words != self._said):
            return
        self._said = self.pace.words
        if fresh:
            self.stage.show(*moments)
        self.surface.show(lines_over(moments, self._said, self._of))


def lines_over(moments: tuple[Moment, ...], pace: str, drones: int) -> Lines:
    """What is written over a picture: of the first craft, if there are many."""
    lines = [*moments[0].lines(), ("speed", pace)]
    if drones > 1:
        shown = f"{len(moments)} of {drones}" if drones > len(moments) else str(drones)
        lines.insert(0, ("drones", f"{shown} shown, numbers of the first"))
    return lines


def open_surface(
    kind: Literal["window", "web"], stage: Stage, pace: Pace, port: int = DEFAULT_PORT
) -> Surface:
    """A window on the display, or a page for browsers.

    Raises:
        NoDisplay: There is no display for a window.
        ValueError: The port cannot be had.
    """
    if kind == "window":
        from .passive import Window

        return Window(stage, pace)
    from .web import WebPage

    return WebPage(stage, pace, port)
