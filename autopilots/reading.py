"""What an autopilot is told: sensor readings, and where to fly, from an env's observation."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..envs.config import EnvConfig
from ..envs.spec import EnvSpec
from ..models import Vehicle
from ..sim.control import throttle_curve
from ..sim.effects import NO_EFFECTS
from ..sim.rotations import axes_of
from ..sim.sensors import SENSOR_TYPES

Floats = NDArray[np.float64]
SENSORS = ("imu", "gps", "motion_capture")
"""What every seat reads."""
_ERRORS = ("noise", "walk", "bias")
_GUIDES = ("goal - position", "nose", "velocity")


class Reading(NamedTuple):
    """Of one drone. World frame: x east, y north, z up; body frame: x forward, y left, z up."""

    time: float
    """Since the program began, s."""
    position: Floats
    """World frame, m, shape (3,)."""
    quaternion: Floats
    """From body to world, scalar first, shape (4,)."""
    velocity: Floats
    """World frame, m/s, shape (3,)."""
    rates: Floats
    """Body frame, rad/s, shape (3,)."""
    specific_force: Floats
    """Acceleration less gravity, body frame, m/s², shape (3,)."""


class Order(NamedTuple):
    """Where to fly."""

    goal: Floats
    """World frame, m, shape (3,)."""
    heading: float
    """Of the nose from x, counterclockwise, rad."""
    stands: bool = False
    """Whether it stands there yet, and is to lift."""


def exact(sensors: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of sensors, with those of `SENSORS` that are missing, without errors."""
    settings: dict[str, Any] = {}
    for name in SENSORS:
        own = SENSOR_TYPES[name].about.settings
        settings[name] = {one: 0.0 for one in own if one.endswith(_ERRORS)}
    return settings | dict(sensors)


class Propellers:
    """Thrust of a vehicle's rotors at a throttle: by its curve, or else the square.

    Where the effect `thrust_curve` is on, a throttle is the command, and the effect has the curve.

    Attributes:
        share: Thrust of a hover over the largest.
        hover: Throttle of a hover.
        slope: Of the thrust over the throttle there, N, shape (R,).
        expo: E of E u² + (1 - E) u, the form of ArduPilot and PX4 that is nearest to the curve.
    """

    def __init__(self, config: EnvConfig, vehicle: Vehicle) -> None:
        own = np.polynomial.Polynomial(throttle_curve(vehicle, NO_EFFECTS))
        self._asked = np.array(throttle_curve(vehicle, config.effects)[::-1])
        self._high = vehicle.thrust_high
        self._throttles = np.linspace(0.0, 1.0, 1025)
        self._shares = own(self._throttles)
        self.share = float(vehicle.hover_thrust.sum() / vehicle.thrust_high.sum())
        self.hover = self.throttle(self.share)
        self.slope: Floats = self._high * own.deriv()(self.hover)
        bend = self._throttles * (self._throttles - 1.0)
        over = self._shares - self._throttles
        self.expo = float(bend @ over / (bend @ bend))

    def commands(self, throttles: Floats) -> Floats:
        """Commands of the rotors, N, at throttles from 0 to 1, shape (R,)."""
        return self._high * np.polyval(self._asked, throttles)

    def lift(self, throttles: Floats) -> float:
        """Sum of the rotors' thrusts at throttles, N."""
        return float(self._high @ np.interp(throttles, self._throttles, self._shares))

    def throttle(self, share: float) -> float:
        """At which a rotor gives a share of its largest thrust."""
        return float(np.interp(share, self._shares, self._throttles))


class Instruments:
    """Reads an env's observation. Raises `InputError` for one that says no goal."""

    def __init__(self, spec: EnvSpec) -> None:
        self._gravity = spec.constant("gravity", "autopilot")
        self._array = spec.observation[0].name
        self._at = np.concatenate([*spec.vectors("autopilot", _GUIDES).values()])

    def reading(self, observation: Mapping[str, Floats], time: float) -> Reading:
        """Of a craft that flies."""
        gps = observation["gps"].astype(np.float64)
        quaternion = observation["motion_capture"][3:].astype(np.float64)
        imu = observation["imu"].astype(np.float64)
        return Reading(time, gps[:3], quaternion, gps[3:], imu[:3], imu[3:])

    def standing(self, observation: Mapping[str, Floats], time: float) -> Reading:
        """Of a craft that is held where it was observed, as it was turned."""
        position, quaternion = self.reading(observation, time)[1:3]
        rest = np.zeros(3)
        up = self._gravity * np.array([axis[2] for axis in axes_of(quaternion)])
        return Reading(time, position, quaternion, rest, rest, up)

    def order(self, observation: Mapping[str, Floats], reading: Reading) -> Order:
        """To the goal of the task, with its heading.

        The goal is where the task has it: motion capture says from where, whatever GPS reads.
        """
        seen = observation[self._array][self._at].astype(np.float64)
        x, y, z, nose_x, nose_y = seen[:5].tolist()
        turn = heading_of(reading.quaternion) - math.atan2(nose_y, nose_x)
        c, s = math.cos(turn), math.sin(turn)
        start = observation["motion_capture"][:3].astype(np.float64)
        goal = start + np.array((c * x - s * y, s * x + c * y, z))
        return Order(goal, math.remainder(turn, math.tau))

    def seen(
        self, observation: Mapping[str, Floats], reading: Reading, order: Order
    ) -> Mapping[str, Floats]:
        """The observation as a pilot outside has it: position and velocity are those of GPS."""
        c, s = math.cos(order.heading), math.sin(order.heading)
        into = np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))
        numbers = observation[self._array].copy()
        numbers[self._at[:3]] = into @ (order.goal - reading.position)
        numbers[self._at[6:]] = into @ reading.velocity
        return {**observation, self._array: numbers}


def heading_of(quaternion: Floats) -> float:
    w, x, y, z = quaternion.tolist()
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))
