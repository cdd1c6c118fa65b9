"""Actions for a craft that nobody commands: it hovers, lands, or its rotors stop.

They are of the env's own action level, so whatever flies the env flies them.
"""

from collections.abc import Mapping
from typing import Literal

import numpy as np

from ..models.errors import InputError
from ..sim.control import CollectiveThrust, RotorThrust, make_controller
from ..sim.control.cascade import Attitude, Position, Rates, Velocity, tilt_of
from ..sim.control.wrench import Wrench
from ..sim.rotations import axes_of
from ..sim.state import Array, WorldState, clip, parts_of, stack
from .tasks.task import Task

Measure = Literal["hover", "land", "off"]
"""What a craft does: it brakes and stays, it descends, or its rotors give their least thrust."""
DESCENT = 0.5
"""Speed of a landing, m/s: the default of ArduCopter's LAND_SPEED."""


class Failsafe:
    """Actions that hover, land or stop the rotors of a task's drones, from their telemetry.

    Raises `InputError` for a controller of the task's own, for vehicles that differ, and for rotors
    that cannot roll, pitch and yaw; for `off` at another level than `rotors`.
    """

    def __init__(self, task: Task, measure: Measure) -> None:
        self._controller = controller = task.controller
        self._vehicle = vehicle = task.vehicle
        known = isinstance(controller, RotorThrust | CollectiveThrust | Rates | Wrench)
        if not known or hasattr(vehicle, "table"):
            raise InputError(
                "failsafe: expected actions of a level, and drones of one vehicle, "
                f"got {type(controller).__name__} of {vehicle.name}"
            )
        if measure == "off" and not isinstance(controller, RotorThrust):
            raise InputError(f"off: expected actions of the level rotors, got {task.action}")
        self._measure = measure
        effects = task.config.effects
        pilot = make_controller("velocity", vehicle, task.control_period, effects)
        assert isinstance(pilot, Velocity)
        self._pilot: Velocity = pilot

    def actions(self, telemetry: Mapping[str, Array]) -> Array:
        """Actions of N drones, float64, shape (N, k); choices have the shape (N,).

        Telemetry has `attitude`, `velocity`, `body_rates` and `thrust`, (N, ...).
        """
        if self._measure == "off":
            return -np.ones_like(telemetry["thrust"])
        speed = -DESCENT * (self._measure == "land")
        state = state_of(telemetry)
        controller = self._controller
        pilot = self._pilot
        axes = axes_of(state.quaternion)
        collective, axis = pilot.aim((0.0, 0.0, speed), axes, state)
        rates = pilot.rates_to(axis, 0.0, axes)
        if isinstance(controller, RotorThrust):
            return controller.action(pilot.turn(collective, rates, state))
        if isinstance(controller, CollectiveThrust):
            return controller.action(collective, state)
        if isinstance(controller, Wrench):
            share = collective / self._vehicle.mass - self._vehicle.gravity
            loops = zip(pilot.gains.rate, rates, parts_of(state.body_rates), strict=True)
            turns = [gain * (wanted - now) for gain, wanted, now in loops]
            return clip(stack([share, *turns]) / controller.constants["action_scale"], -1.0, 1.0)
        assert isinstance(controller, Rates)
        asked = [controller.collective.share(collective), *rates]
        if isinstance(controller, Velocity):
            gain = controller.gains.position if isinstance(controller, Position) else 1.0
            still = 0.0 * collective
            asked = [still, still, still + speed / gain, still]
        elif isinstance(controller, Attitude):
            asked[1:] = *tilt_of(axis, axes[0]), 0.0
        return clip(stack(asked) / controller.constants["action_scale"], -1.0, 1.0)


def state_of(telemetry: Mapping[str, Array]) -> WorldState:
    """What loops of control look at, from the telemetry, (N, ...)."""
    thrust = telemetry["thrust"]
    return WorldState(
        quaternion=telemetry["attitude"],
        velocity=telemetry["velocity"],
        body_rates=telemetry["body_rates"],
        command=thrust,
        thrust=thrust,
        touching=None,
    )
