"""Drones of a lost agent land by themselves."""

from functools import cached_property
from typing import Any

import numpy as np

from ...sim import EffectOptions, World, make_controller
from .record import Floats, Look, Mask, Record, Stage, where

DESCENT = 0.7  # m/s: PX4's default of MPC_LAND_SPEED


class Landing(Stage):
    """A part of the flight that brings the drones of `record.landing` down.

    They hold their place over the ground and sink at 0.7 m/s, as far as the vehicle can, by the
    level `velocity`.

    Args:
        world: What flies.
        look: Gives the state that a controller sees.
        period: Time between two controls, s.
        effects: Lag and thrust curve of the rotors among them.
    """

    def __init__(self, world: World, look: Look, period: float, effects: EffectOptions) -> None:
        self._world = world
        self._look = look
        self._period = period
        self._effects = effects

    @cached_property
    def _descent(self) -> tuple[Any, Floats]:
        """The controller and its action, made when the first drone lands."""
        vehicle = self._world.vehicle
        controller: Any = make_controller("velocity", vehicle, self._period, self._effects)
        fastest = controller.constants["action_scale"][2]
        down = (0.0, 0.0, -min(1.0, DESCENT / fastest), 0.0)
        return controller, np.broadcast_to(down, (*self._world.shape, len(down)))

    def prepare(self, record: Record, drones: Mask) -> None:
        """These drones land too. Raises `InputError` if the vehicle has no level `velocity`."""
        assert self._descent
        record.landing = vars(record).get("landing", False) | drones

    def step(self, record: Record) -> None:
        """Replace the thrust of the drones that land."""
        if "landing" not in vars(record):
            return
        controller, action = self._descent
        down = controller.thrust(action, self._look())
        record.thrust = where(record.landing, down, record.thrust)


class Landed(Stage):
    """Drones that land and touch something are out, without a reward and an end."""

    arrays = ("landing",)

    def begin(self, record: Record) -> None:
        """A drone whose episode begins has an agent again."""
        if "landing" in vars(record):
            record.landing = np.zeros(record.shape, bool)[()]

    def step(self, record: Record) -> None:
        """Take them out."""
        if "landing" in vars(record):
            record.leaving = record.landing & record.state.touching
