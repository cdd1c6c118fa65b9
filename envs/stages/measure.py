"""What is measured of the state: the state itself, or what sensors and the estimate say of it."""

from dataclasses import dataclass, replace

import numpy as np

from ...models.errors import InputError
from ...sim import Randomization, World
from ...sim.sensors import Sensors
from ...sim.snapshots import Arrays
from ..spec import ArraySpec
from ..state import kept_state, read_only
from .record import Record, Stage

_DRAWN = "drawn"
_ESTIMATED = ("position", "quaternion", "velocity", "body_rates")


@dataclass
class Measure(Stage):
    """Sets `record.state`, the exact state, and `record.measured`, which a task observes."""

    world: World
    """What flies."""
    period: float
    """Time of a control step, s."""

    def restore(self, record: Record, arrays: Arrays) -> None:
        """Measure the state that was put back."""
        if record.has_begun:
            self.step(record)

    def step(self, record: Record) -> None:
        """Measures without errors; sensors change it."""
        steps = record.steps
        record.state = kept_state(
            self.world.state,
            action=record.action,
            steps=steps,
            time=steps * self.period,
            known_clearance=self.world.clearance(),
            distance=self.world.scenery.distance,
            parameters=self.world.parameters,
        )
        record.measured = record.state


@dataclass
class Sensing(Stage):
    """Samples sensors after each control step."""

    keeps = "sensors"

    sensors: Sensors
    """Of the world's drones."""
    replaces: bool
    """Whether task and controller see the estimate in place of the exact state."""

    def begin(self, record: Record) -> None:
        """First readings."""
        self.sensors.begin(record.begun)

    def step(self, record: Record) -> None:
        """Readings of the drones that flew; the others keep theirs."""
        flown = record.flown
        if flown is None:
            flown = np.ones(record.shape, bool)
        self.sensors.sample(flown, record.steps)
        if self.replaces:
            seen = self.sensors.seen()
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


@dataclass
class Drawn(Stage):
    """Adds what is drawn to the observation, as `drawn_array` says."""

    world: World
    """Its parameters."""

    def step(self, record: Record) -> None:
        """What the next step is flown with."""
        drawn = self.world.randomize.shares(self.world.parameters)
        record.observations = {**record.observations, _DRAWN: drawn}


def drawn_array(drawn: Randomization) -> ArraySpec:
    """The spec of what is drawn, each between its ends. Raises `InputError` where nothing is."""
    if not drawn.names:
        raise InputError("observe_drawn: expected something in randomize or events, got nothing")
    return ArraySpec(
        name=_DRAWN,
        shape=(len(drawn.names),),
        low=-1.0,
        high=1.0,
        components=drawn.names,
        privileged=True,
    )
