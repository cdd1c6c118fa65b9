"""What is measured of the state: the state itself, or what sensors and the estimate say of it."""

from dataclasses import replace

import numpy as np

from ...sim import World
from ...sim.sensors import Sensors
from ...sim.snapshots import Arrays
from ...sim.state import some
from ..spec import ArraySpec
from ..state import kept_state, read_only
from .record import Record, Stage

_ESTIMATED = ("position", "quaternion", "velocity", "body_rates")


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


class Sensing(Stage):
    """Samples sensors after each control step.

    Args:
        sensors: Of the world's drones.
        replaces: Whether task and controller see the estimate in place of the exact state.
    """

    def __init__(self, sensors: Sensors, *, replaces: bool) -> None:
        self._sensors = sensors
        self._replaces = replaces

    def begin(self, record: Record) -> None:
        """First readings."""
        self._sensors.begin(record.begun)

    def snapshot(self, record: Record) -> Arrays:
        """State of the sensors."""
        return self._sensors.snapshot()

    def restore(self, record: Record, arrays: Arrays) -> None:
        """Put them back."""
        self._sensors.restore(arrays)

    def step(self, record: Record) -> None:
        """Readings of the drones that flew; the others keep theirs."""
        flown = record.flown
        if flown is None:
            flown = np.ones(record.shape, bool)[()]
        if some(flown):
            self._sensors.sample(flown)
        if self._replaces:
            seen = self._sensors.seen()
            values = {name: read_only(getattr(seen, name)) for name in _ESTIMATED}
            record.measured = replace(record.state, **values)


class Readings(Stage):
    """Adds the readings to the observation; with an estimate, keeps it within its bounds.

    Args:
        sensors: As of `Sensing`.
        observation: Specs of the task's arrays whose bounds an estimate may leave.
    """

    def __init__(self, sensors: Sensors, observation: tuple[ArraySpec, ...]) -> None:
        self._sensors = sensors
        self._bounds = {array.name: array.bounds() for array in observation}

    def step(self, record: Record) -> None:
        """Observations of the task and readings."""
        observations = {**record.observations, **self._sensors.readings}
        for name, (low, high) in self._bounds.items():
            observations[name] = np.clip(observations[name], low, high)
        record.observations = observations
