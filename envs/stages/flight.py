"""Control, effects and physics: the stage that runs in substeps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...sim import Controller, World
from ...sim.state import some
from .record import Look, Record, Stage


@dataclass
class Flight(Stage):
    """Runs its parts for each control of a step, then the physics. Parts are stages too.

    Parts compute the thrust of each rotor, `record.thrust`, N, (W, A, R). The world computes
    effects once per physics step.
    """

    keeps = "world"

    world: World
    """What flies."""
    parts: Sequence[Stage]
    """In their order."""
    substeps: int
    """Physics steps of a control step."""
    held: int
    """Physics steps for which a thrust is held."""

    def begin(self, record: Record) -> None:
        """The task has set the start."""
        self.world.reset(record.begun, record.start)

    def step(self, record: Record) -> None:
        """One control step."""
        for first in range(0, self.substeps, self.held):
            for part in self.parts:
                part.step(record)
            self.world.step(record.thrust, self.held, record.flown, again=first > 0)

    def close(self) -> None:
        """Close the world."""
        self.world.close()


@dataclass
class Control(Stage):
    """The controller turns actions into thrusts."""

    controller: Controller
    look: Look

    def step(self, record: Record) -> None:
        """Thrusts until the next call."""
        record.thrust = self.controller.thrust(record.received, self.look())


@dataclass
class StandStill(Stage):
    """Rotors of drones whose own episode has ended stand still, while the others fly on."""

    rest: np.ndarray
    """Thrust of a rotor that stands still, N, (R,)."""

    def step(self, record: Record) -> None:
        """The thrust next to 0."""
        if some(record.out):
            record.thrust = np.where(record.out[..., None], self.rest, record.thrust)
