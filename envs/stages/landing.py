"""Drones of a lost agent land by themselves."""

from typing import Any, Final

import numpy as np

from ...sim import EffectOptions, World, make_controller
from .record import Look, Mask, Record, Stage, where

DESCENT: Final = 0.7  # m/s: PX4's default of MPC_LAND_SPEED


class Landing(Stage):
    """A part of the flight that brings the drones of `record.landing` down.

    They hold their place over the ground and sink at 0.7 m/s, as far as the vehicle can, by the
    level `velocity`.

    Args:
        world: What flies.
        look: Gives the state that a controller sees.
        period: Time between two controls, s.
        effects: Lag and thrust curve of the rotors among them.

    Raises:
        InputError: The vehicle cannot be flown at that level.
    """

    def __init__(self, world: World, look: Look, period: float, effects: EffectOptions) -> None:
        self._look = look
        controller: Any = make_controller("velocity", world.vehicle, period, effects)
        self._controller = controller
        fastest, _ = controller.ranges()[2]
        down = (0.0, 0.0, -min(1.0, DESCENT / fastest), 0.0)
        self._action = np.broadcast_to(down, (*world.shape, len(down)))

    def step(self, record: Record) -> None:
        """Replace the thrust of the drones that land."""
        down = self._controller.thrust(self._action, self._look())
        record.thrust = where(record.landing, down, record.thrust)


class Landed(Stage):
    """Drones that land and touch something are out, without a reward and an end."""

    arrays = ("landing",)

    def prepare(self, record: Record, drones: Mask) -> None:
        """These drones land too."""
        landing = vars(record).get("landing", False)
        record.landing = landing | drones

    def begin(self, record: Record) -> None:
        """A drone whose episode begins has an agent again."""
        record.landing = np.zeros(record.shape, bool)[()]

    def step(self, record: Record) -> None:
        """Take them out."""
        record.leaving = record.landing & record.state.touching
