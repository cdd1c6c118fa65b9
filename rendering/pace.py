"""The speed at which a flight is shown. Reads no clock: the time is passed in."""

from queue import SimpleQueue
from typing import Final, Literal

from ..models.errors import expect

__all__ = ["FASTEST", "SLOWEST", "SPEEDS", "Pace", "Press"]

Press = Literal["pause", "step", "slower", "faster"]
"""Effect of a key or a button."""

SPEEDS: Final = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)
"""Steps of `slower` and `faster`; 1 is real time."""
SLOWEST, FASTEST = SPEEDS[0], SPEEDS[-1]
_CATCH_UP: Final = 0.1  # Longest delay that later steps make up for, s


class Pace:
    """When the next control step is due, in seconds of any clock.

    Args:
        period: Time between two steps, s; 0 for as fast as possible.
        speed: 2 is twice as fast as real time. One beyond `SPEEDS` raises `InputError`.
    """

    def __init__(self, period: float, speed: float = 1.0) -> None:
        right = SLOWEST <= speed <= FASTEST
        expect(right, "speed", f"{SLOWEST:g} to {FASTEST:g}", f"{speed:g}")
        self.period, self.speed, self.paused = period, speed, False
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
        """Tell of a press, which `wait` then obeys; from any thread."""
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
            self.paused, self._asked, self._since = not self.paused, 0, None
        elif press == "step":
            self._asked = self._asked + 1 if self.paused else 1
            self.paused = True
        elif press == "slower":
            self.speed = max((s for s in SPEEDS if s < self.speed), default=SLOWEST)
        else:
            self.speed = min((s for s in SPEEDS if s > self.speed), default=FASTEST)
