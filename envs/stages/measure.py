"""What is measured of the state: the state itself, or what sensors say of it."""

from ...sim import World
from ...sim.snapshots import Arrays
from ..state import kept_state
from .record import Record, Stage


class Measure(Stage):
    """Sets `record.state`, the exact state, and `record.measured`, which a task observes.

    Args:
        world: What flies.
        period: Time of a control step, s.
    """

    def __init__(self, world: World, period: float) -> None:
        self._world = world
        self._period = period

    def restore(self, record: Record, arrays: Arrays) -> None:
        """Measure the state that was put back."""
        if record.has_begun:
            self.step(record)

    def step(self, record: Record) -> None:
        """Measures without errors; sensors change it."""
        steps = record.steps
        record.state = kept_state(
            self._world.state, action=record.action, steps=steps, time=steps * self._period
        )
        record.measured = record.state
