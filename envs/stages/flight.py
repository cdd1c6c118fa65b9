"""Control, effects and physics: the stage that runs in substeps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...sim import Controller, World
from ...sim.world import Call
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

    def __post_init__(self) -> None:
        if self.world.is_apart and self.held < self.substeps:
            self.arrays = ("received",)  # a later control of the step needs it

    def begin(self, record: Record) -> None:
        """The task has set the start."""
        self.world.begin(record.begun, record.start)

    def place(self, record: Record) -> None:
        """The physics takes the start."""
        self.world.place(record.begun)

    def step(self, record: Record) -> None:
        """One control step."""
        for call in self.calls():
            if call.commands:
                self.control(record)
            elif call.pushes:
                self.push(record)
            self.world.fly(call, record.flown)

    # ---- the same in parts: all but the physics is array code

    def control(self, record: Record) -> None:
        """What the physics flies under from now on."""
        for part in self.parts:
            part.step(record)
        self.world.command(record.thrust, record.flown)
        self.push(record)

    def push(self, record: Record) -> None:
        """The same for a later physics step of the same thrust."""
        self.world.push(record.flown)

    def take(self, record: Record) -> None:
        """What the physics has done."""
        self.world.take()

    def calls(self) -> list[Call]:
        """Calls of the physics in a step."""
        return self.world.calls(self.substeps, self.held)


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
    """Rotors of drones whose own episode has ended stand still, while the others fly on, and so do
    those that are stopped.
    """

    world: World
    """Its parameter `link_off`, where there is one."""
    rest: np.ndarray
    """Thrust of a rotor that stands still, N, (R,)."""

    def step(self, record: Record) -> None:
        """The thrust next to 0."""
        still = record.out | (self.world.parameters.get("link_off", 0.0) > 0)
        record.thrust = np.where(still[..., None], self.rest, record.thrust)
