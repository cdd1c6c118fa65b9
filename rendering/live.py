"""Live views: the latest moment in a window, and the speed of what is shown.

A slow machine draws fewer pictures; the simulation goes on, slowed only by the processor that both
share.
"""

import time
from contextlib import AbstractContextManager
from queue import SimpleQueue
from threading import Event, Thread
from typing import Literal, Protocol

import mujoco
import numpy as np

from ..models.errors import InputError
from ..models.fields import Limits, check
from .gl import Lines
from .stage import Moment, Stage

MAX_SHOWN = 16
"""Most craft side by side; of more, the first ones are shown."""
_PICTURES = 30.0  # a second, at most
_NAP = 0.02  # s, at most, before keys are looked at again

Press = Literal["pause", "step", "slower", "faster"]
"""Effect of a key."""
SPEEDS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)
"""Steps of `slower` and `faster`; 1 is real time."""
_CATCH_UP = 0.1  # Longest delay that later steps make up for, s


class Pace:
    """When the next control step is due, in seconds of any clock: the time is passed in.

    Args:
        period: Time between two steps, s; 0 for as fast as possible.
        speed: 2 is twice as fast as real time. A speed beyond `SPEEDS` raises `InputError`.
    """

    def __init__(self, period: float, speed: float = 1.0) -> None:
        self.period = period
        self.speed: float = check("speed", Limits(SPEEDS[0], SPEEDS[-1]), speed)
        self.paused = False
        self._presses: SimpleQueue[Press] = SimpleQueue()
        self._asked = 0  # steps that a pause lets pass
        self._since: float | None = None  # when the last step was due

    @property
    def words(self) -> str:
        """Speed and pause, for an overlay."""
        speed = f"1/{1 / self.speed:g} x" if self.speed < 1 else f"{self.speed:g} x"
        if not self.period:
            return "paused" if self.paused else "as fast as it flies"
        return f"{speed}, paused" if self.paused else speed

    def press(self, press: Press) -> None:
        """Queue a press for the next `wait`; from any thread."""
        self._presses.put(press)

    def wait(self, now: float) -> float | None:
        """Seconds until the next step is due, 0 if it is; None while paused."""
        while not self._presses.empty():
            self._obey(self._presses.get())
        if self.paused:
            return 0.0 if self._asked else None
        if self._since is None:
            return 0.0
        return max(0.0, self._since + self.period / self.speed - now)

    def stepped(self, now: float) -> None:
        """A step was taken now."""
        if self.paused:
            self._asked = max(0, self._asked - 1)
            self._since = now
            return
        due = now if self._since is None else self._since + self.period / self.speed
        self._since = min(max(due, now - _CATCH_UP), now)

    def _obey(self, press: Press) -> None:
        if press == "pause":
            self.paused = not self.paused
            self._asked = 0
            self._since = None
        elif press == "step":
            self._asked = self._asked + 1 if self.paused else 1
            self.paused = True
        elif press == "slower":
            self.speed = max((s for s in SPEEDS if s < self.speed), default=self.speed)
        else:
            self.speed = min((s for s in SPEEDS if s > self.speed), default=self.speed)


class Aim:
    """Turns a viewer's camera towards the goal, or the craft; afterwards moves it with that."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._focus: np.ndarray | None = None

    def apply(self, camera: mujoco.MjvCamera) -> None:
        """Turn or move a free camera."""
        focus = self._stage.focus
        if self._focus is None:
            view = self._stage.camera("free")
            for name in ("azimuth", "elevation", "distance", "lookat"):
                setattr(camera, name, getattr(view, name))
        else:  # keep what the mouse has changed
            camera.lookat[:] += focus - self._focus
        self._focus = focus


class Surface(Protocol):
    """Where a stage is drawn, as `Window`."""

    def show(self, lines: Lines) -> None:
        """Draw the stage as it is now, with these lines over it."""

    def is_running(self) -> bool:
        """Whether it is open."""

    def close(self) -> None:
        """Close it."""


class LiveView(AbstractContextManager["LiveView"]):
    """Draws the latest moments in a thread of its own; `of` drones, if more than are shown."""

    def __init__(self, stage: Stage, surface: Surface, pace: Pace, of: int | None = None) -> None:
        self.stage = stage
        self.surface = surface
        self.pace = pace
        self._of = of or stage.drones
        self._said = ""
        self._latest: tuple[Moment, ...] = ()
        self._fresh = Event()
        self._closing = Event()
        self._error: Exception | None = None
        self._thread = Thread(target=self._paint, name="live view", daemon=True)
        self._thread.start()

    @property
    def is_running(self) -> bool:
        """Whether the surface is open. Raises the error with which drawing ended."""
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
        drones = self.stage.drones
        if len(moments) != drones:
            raise InputError(f"moments: expected {drones}, got {len(moments)}")
        self._latest = moments
        self._fresh.set()

    def draw_in_time(self, *moments: Moment) -> bool:
        """Wait until the pace has them due, and `draw`; False if the surface is closed before."""
        while (left := self.pace.wait(time.monotonic())) != 0.0:
            if not self.is_running:
                return False
            time.sleep(_NAP if left is None else min(left, _NAP))
        self.draw(*moments)
        self.pace.stepped(time.monotonic())
        return self.is_running

    def close(self) -> None:
        """Stop drawing and close the surface. A second call does nothing."""
        if not self._closing.is_set():
            self._closing.set()
            try:
                self._thread.join()
            finally:  # Ctrl-C twice too
                self.surface.close()

    def __exit__(self, *_: object) -> None:
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
                # Moments that come meanwhile wait, so that `wants` limits their number.
                self._closing.wait(max(0.0, 1 / _PICTURES - (time.monotonic() - began)))
        except Exception as error:
            self._error = error

    def _paint_one(self) -> None:
        fresh = self._fresh.is_set()
        if fresh:
            self._fresh.clear()  # before the moments are read: what comes meanwhile is drawn next
        moments = self._latest
        if not moments or not (fresh or self.pace.words != self._said):
            return
        self._said = self.pace.words
        if fresh:
            self.stage.show(*moments)
        high = float(self.stage.vehicle.thrust_high.max())
        lines = lines_over(moments, high, self._said, self._of, self.stage.least_distance)
        self.surface.show(lines)


def lines_over(
    moments: tuple[Moment, ...],
    thrust_high: float,
    pace: str,
    drones: int,
    least_distance: float | None = None,
) -> Lines:
    """The lines of an overlay of so many drones: those of the first; its `thrust_high` is in N.

    Drones of one world have a least distance of two of them, m.
    """
    lines = [*moments[0].lines(thrust_high), ("speed", pace)]
    if least_distance is not None:
        lines.insert(0, ("least distance", f"{least_distance:.2f} m"))
    if drones > 1:
        shown = f"{len(moments)} of {drones}" if drones > len(moments) else str(drones)
        lines.insert(0, ("drones", f"{shown} shown, numbers of the first"))
    return lines
