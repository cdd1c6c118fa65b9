"""Live views: the latest moment in a window, and the speed of what is shown.

A slow machine draws fewer pictures; the simulation goes on, slowed only by the processor that both
share.
"""

import time
from threading import Event, Thread

from ..models.fields import Limits, check
from . import window
from .stage import Moment, Stage

_PICTURES = 30.0  # a second, at most
_NAP = 0.02  # s, at most, before keys are looked at again
_SPEEDS = Limits(1 / 16, 8.0)
_CATCH_UP = 0.1  # Longest delay that later steps make up for, s


class Pace:
    """When the next control step is due, in seconds of any clock: the time is passed in.

    Args:
        period: Time between two steps, s; 0 for as fast as possible.
        speed: 2 is twice as fast as real time. A speed out of range raises `InputError`.
    """

    def __init__(self, period: float, speed: float = 1.0) -> None:
        self.period: float = period / check("speed", _SPEEDS, speed)
        self.paused = False
        self._asked = 0  # steps that a pause lets pass
        self._since: float | None = None  # when the last step was due

    def press(self, press: window.Press) -> None:
        """Effect of a key; from any thread."""
        if press == "pause":
            self._asked = 0
            self._since = None
            self.paused = not self.paused
        else:
            self._asked = self._asked + 1 if self.paused else 1
            self.paused = True

    def wait(self, now: float) -> float | None:
        """Seconds until the next step is due, 0 if it is; None while paused."""
        since = self._since
        if self.paused:
            return 0.0 if self._asked else None
        if since is None:
            return 0.0
        return max(0.0, since + self.period - now)

    def stepped(self, now: float) -> None:
        """A step was taken now."""
        since = self._since
        if self.paused:
            self._asked = max(0, self._asked - 1)
            self._since = now
            return
        due = now if since is None else since + self.period
        self._since = min(max(due, now - _CATCH_UP), now)


class LiveView:
    """Draws the latest moments of a stage in a window, in a thread of its own.

    Raises `NoOpenGL`.
    """

    def __init__(self, stage: Stage, pace: Pace) -> None:
        self.stage = stage
        self.pace = pace
        self._window = window.Window(stage, pace.press)
        self._latest: tuple[Moment, ...] = ()
        self._fresh = Event()
        self._closing = Event()
        self._error: Exception | None = None
        self._thread = Thread(target=self._paint, name="live view", daemon=True)
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """Whether the window is open. Raises the error with which drawing ended."""
        if self._error is not None:
            error = self._error
            self._error = None
            raise error
        return self._thread.is_alive() and not self._closing.is_set()

    @property
    def wants(self) -> bool:
        """Whether the latest moments are drawn, so that new ones would be."""
        return not self._fresh.is_set()

    def draw(self, *moments: Moment) -> None:
        """Leave moments to be drawn, one of each craft. Older ones that wait are dropped."""
        self._latest = moments
        self._fresh.set()

    def draw_in_time(self, *moments: Moment) -> bool:
        """Wait until the pace has them due, and `draw`; False if the window is closed before."""
        while (left := self.pace.wait(time.monotonic())) != 0.0:
            if not self.is_running:
                return False
            time.sleep(_NAP if left is None else min(left, _NAP))
        self.draw(*moments)
        self.pace.stepped(time.monotonic())
        return self.is_running

    def close(self) -> None:
        """Stop drawing and close the window. A second call does nothing."""
        if not self._closing.is_set():
            self._closing.set()
            try:
                self._thread.join()
            finally:  # Ctrl-C twice too
                self._window.close()

    def _paint(self) -> None:
        try:
            while self._window.is_running() and not self._closing.is_set():
                began = time.monotonic()
                try:
                    if self._fresh.is_set():
                        # Before the moments are read: what comes meanwhile is drawn next.
                        self._fresh.clear()
                        self.stage.show(*self._latest)
                        self._window.show()
                except Exception:
                    if self._window.is_running():  # otherwise it was closed meanwhile
                        raise
                # Moments that come meanwhile wait, so that `wants` limits their number.
                self._closing.wait(max(0.0, 1 / _PICTURES - (time.monotonic() - began)))
        except Exception as error:
            self._error = error
