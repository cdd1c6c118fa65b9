"""Sticks of a remote control from a goal: the loops of the level `position`, down to the attitude.

`geometric` asks for an offset and a heading; the loops turn them into a collective thrust, roll,
pitch and a yaw rate, which a flight controller takes as sticks.
"""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..agents.geometric import Geometric
from ..agents.policies import Observation
from ..envs.config import EnvConfig
from ..envs.registry import env_spec
from ..models import Vehicle
from ..sim.control.cascade import Position
from ..sim.control.gains import Gains
from ..sim.effects import NO_EFFECTS
from ..sim.rotations import Parts, Rows
from ..sim.state import Array
from .reading import Floats, Reading

PERIOD = 0.01
"""Time between two positions of the sticks, s."""
LAG = 0.02
"""With which a flight controller is taken to follow them, s."""


class Demands(Position):
    """The level `position` that ends at the attitude: N, rad, rad, rad/s."""

    def point(
        self, collective: Array, axis: Parts, yaw_rate: Array, axes: Rows, state: Any
    ) -> Array:
        """Collective thrust, roll, pitch, yaw rate; as of the level `attitude`."""
        x, y, z = axis
        nose_x, nose_y, _ = axes[0]
        length = math.hypot(nose_x, nose_y)
        ahead = (nose_x * x + nose_y * y) / length
        left = (nose_x * y - nose_y * x) / length
        roll = -math.asin(max(-1.0, min(left, 1.0)))
        return np.array((collective, roll, math.atan2(ahead, z), yaw_rate))


class StickPilot:
    """Flies to the goal of a task by what sticks ask for."""

    def __init__(self, config: EnvConfig, vehicle: Vehicle) -> None:
        position = config.changed(action="position", control_period=PERIOD)
        self._pilot = Geometric(env_spec(position))
        lag = vehicle.coefficients["rotors.time_constant"] or 0.0
        self._demands = Demands(vehicle, Gains.of(vehicle, PERIOD, max(lag, LAG)), NO_EFFECTS)

    def demands(self, reading: Reading, observation: Observation) -> Floats:
        """Collective thrust, N, roll and pitch, rad, and yaw rate, rad/s, shape (4,)."""
        action = self._pilot.act(observation).astype(np.float64)
        state: Any = SimpleNamespace(quaternion=reading.quaternion, velocity=reading.velocity)
        demands: Floats = self._demands.thrust(action, state)
        return demands
