"""Control, effects and physics: the stage that runs in substeps."""

from collections.abc import Sequence

import numpy as np

from ...sim import Controller, World
from ...sim.snapshots import Arrays
from ...sim.state import some
from .record import Look, Record, Stage


class Flight(Stage):
    """Runs its parts for each control of a step, then the physics. Parts are stages too.

    Parts compute the thrust of each rotor, `record.thrust`, N, (W, A, R). The world computes
    effects once per physics step.

    Args:
        world: What flies.
        parts: In their order.
        substeps: Physics steps of a control step.
        held: Physics steps for which a thrust is held.
    """

    def __init__(self, world: World, parts: Sequence[Stage], substeps: int, held: int) -> None:
        self.parts = list(parts)
        self._world = world
        self._starts = range(0, substeps, held)
        self._held = held

    def begin(self, record: Record) -> None:
        """The task has set the start."""
        self._world.reset(record.begun, record.start)

    def step(self, record: Record) -> None:
        """One control step."""
        for first in self._starts:
            for part in self.parts:
                part.step(record)
            self._world.step(record.thrust, self._held, record.flown, again=first > 0)

    def snapshot(self, record: Record) -> Arrays:
        """State of the world."""
        return self._world.snapshot()

    def restore(self, record: Record, arrays: Arrays) -> None:
        """Put the world back."""
        self._world.restore(arrays)

    def close(self) -> None:
        """Close the world."""
        self._world.close()


class Control(Stage):
    """The controller turns actions into thrusts."""

    def __init__(self, controller: Controller, look: Look) -> None:
        self._controller = controller
        self._look = look

    def step(self, record: Record) -> None:
        """Thrusts until the next call."""
        record.thrust = self._controller.thrust(record.received, self._look())


class StandStill(Stage):
    """Rotors of drones whose own episode has ended stand still, while the others fly on."""

    def __init__(self, world: World) -> None:
        vehicle = world.vehicle
        self._rest = np.clip(0.0, vehicle.thrust_low, vehicle.thrust_high)

    def step(self, record: Record) -> None:
        """The thrust next to 0."""
        if some(record.out):
            record.thrust = np.where(record.out[..., None], self._rest, record.thrust)
