"""Events in flight: when they happen, and what they change meanwhile."""

from collections.abc import Callable

import numpy as np

from ...models.fields import check_names
from ...sim import Array, World, stack
from ...sim.snapshots import Arrays
from ...sim.state import total
from ..events import ASKED, changes_of, steps_of
from ..spec import Values
from ..tasks.task import Task
from ..telemetry import quantities_of
from .record import Record, Stage


class Events(Stage):
    """Notes after a step which of E events happen, and changes the parameters of later steps.

    Attributes:
        task, world, record: The telemetry is read from them.
    """

    arrays = ("fired",)
    record: Record

    def __init__(self, task: Task, world: World) -> None:
        self.task = task
        self.world = world
        events = task.config.events
        period = task.control_period
        drones = np.arange(world.shape[1])
        whose = [drones == event.get("drone", drones) for event in events]
        self._whose = np.stack(whose, axis=-1)
        self._steps = np.array([steps_of(event, period) for event in events])
        self._changes = changes_of(events, period)
        self._quantities = {
            name: (quantity, index)
            for quantity in quantities_of(task)
            for index, name in enumerate(quantity.components)
        }
        self._conditions = [self._condition(event) for event in events]

    def begin(self, record: Record) -> None:
        """Nothing has happened."""
        record.fired = np.full((*record.shape, len(self._steps)), np.inf)

    def act(self, record: Record) -> None:
        """Change what the step that begins is flown with. What is asked for happens at once."""
        if record.asked is not None:
            steps = record.steps[..., None]
            record.fired = np.where(record.asked & self._whose, steps, record.fired)
        self._change(record, record.steps)

    def restore(self, record: Record, arrays: Arrays) -> None:
        """Change what the last step was flown with."""
        if record.has_begun:
            self._change(record, record.steps - 1)

    def step(self, record: Record) -> None:
        """Note what happens now."""
        self.record = record
        steps = record.steps[..., None]
        excess = stack([excess() for excess in self._conditions])
        happens = (excess > 0) & self._whose
        record.fired = np.where(happens & (record.fired == np.inf), steps, record.fired)

    def _change(self, record: Record, steps: Array) -> None:
        age = steps[..., None] - record.fired
        lasts = (age >= 0) & (age < self._steps)
        changes = self._changes.items()
        self.world.change({name: total(np.where(lasts, x, 0.0)) for name, x in changes})

    def _condition(self, event: Values) -> Callable[[], Array]:
        """Gives by how much an event is due, (W, A), above 0. Raises `InputError` for an unknown
        name.
        """
        if "at" in event:
            before = np.ceil(event["at"] / self.task.control_period - 1e-6) - 1.0
            return lambda: self.record.steps - before
        if event["when"] == ASKED:
            return lambda: 0.0
        name, sign, number = event["when"].split()
        check_names([name], self._quantities, "events: when")
        quantity, index = self._quantities[name]
        scale = 1.0 if sign == ">" else -1.0
        # A quantity reads no more of a loop than this has.
        return lambda: scale * (quantity.read(self)[..., index] - float(number))  # type: ignore[arg-type]
