"""Sensors with white noise alone: magnetometer, rangefinder, GPS, motion capture."""

from typing import ClassVar

import numpy as np

from ...models.fields import Limits
from ..rotations import advanced, to_body
from ..state import Array, clip, stack
from .base import FURTHEST, MAX_SPEED, UNIT, Bounds, Sensor, Setting, Values, coefficients

FIELD = (1.287, 21.532, -43.231)
"""Earth's magnetic field at Zurich (47.377° N, 8.542° E, 408 m) on 2025-01-01: east, north and up,
µT. World Magnetic Model WMM2025, NOAA NCEI and British Geological Survey."""


class Magnetometer(Sensor):
    """Earth's field in the body frame; white noise. Setting: the field in the world frame."""

    name = "magnetometer"
    columns = 3
    settings: ClassVar = {
        **coefficients("magnetometer_", "noise"),
        "field": Setting(FIELD, Limits(-100.0, 100.0, "µT", count=3)),
    }
    frame = "body"
    components = ("field x", "field y", "field z")
    units = ("µT",) * 3
    top = (1e3,) * 3  # far from any reading but for a wrong noise

    def measure(self, normal: Array) -> Array:
        field = np.array(self.values["field"]) + 0.0 * normal
        return to_body(self.world.state.quaternion, field) + self.values["noise"] * normal


class Rangefinder(Sensor):
    """Distance from the body's origin along its -z axis, by a ray; white noise.

    It reads its limit where there is nothing.
    """

    name = "rangefinder"
    columns = 1
    settings = coefficients("range_", "noise", "limit")
    frame = "body, along -z"
    components = ("distance",)
    units = ("m",)

    @classmethod
    def bounds(cls, values: Values) -> Bounds:
        return (0.0,), (values["limit"],)

    def measure(self, normal: Array) -> Array:
        distance = clip(self.world.below(), 0.0, self.values["limit"])
        return stack((distance,)) + self.values["noise"] * normal


class Gps(Sensor):
    """Position and velocity of the body's origin; white noise."""

    name = "gps"
    columns = 6
    settings = coefficients("gps_", "noise", "vertical_noise", "velocity_noise")
    frame = "world"
    components = ("x", "y", "z", "vx", "vy", "vz")
    units = ("m",) * 3 + ("m/s",) * 3
    top = (FURTHEST,) * 3 + (MAX_SPEED,) * 3

    def measure(self, normal: Array) -> Array:
        level, vertical, speed = (self.values[name] for name in self.settings)
        sigma = np.array((level, level, vertical, speed, speed, speed))
        state = self.world.state
        exact = np.concat((state.position, state.velocity), axis=-1)
        return exact + sigma * normal


class MotionCapture(Sensor):
    """Position and attitude; white noise, of the attitude about the body's axes."""

    name = "motion_capture"
    columns = 6
    settings = coefficients("mocap_", "noise", "angle_noise")
    frame = "world; quaternion: body to world"
    components = ("x", "y", "z", "qw", "qx", "qy", "qz")
    units = ("m",) * 3 + ("1",) * 4
    top = (FURTHEST,) * 3 + (UNIT,) * 4

    def measure(self, normal: Array) -> Array:
        state = self.world.state
        position = state.position + self.values["noise"] * normal[..., :3]
        turned = advanced(state.quaternion, self.values["angle_noise"] * normal[..., 3:])
        return np.concat((position, turned), axis=-1)
