"""Sensors with white noise alone: magnetometer, rangefinder, GPS, motion capture, battery."""

import numpy as np

from ..rotations import advanced, to_body
from ..state import Array, clip, stack
from .base import ABOUT, Bounds, Sensor, Values


class Magnetometer(Sensor):
    """Earth's field in the body frame; white noise. Setting: the field in the world frame."""

    about = ABOUT["magnetometer"]

    def measure(self, normal: Array) -> Array:
        field = np.array(self.values["field"]) + 0.0 * normal
        return to_body(self.world.state.quaternion, field) + self.values["noise"] * normal


class Rangefinder(Sensor):
    """Distance from the body's origin along its -z axis, by a ray; white noise.

    It reads its limit where there is nothing.
    """

    about = ABOUT["rangefinder"]

    @classmethod
    def bounds(cls, values: Values) -> Bounds:
        return (0.0,), (values["limit"],)

    def measure(self, normal: Array) -> Array:
        distance = clip(self.world.below(), 0.0, self.values["limit"])
        return stack((distance,)) + self.values["noise"] * normal


class Gps(Sensor):
    """Position and velocity of the body's origin; white noise."""

    about = ABOUT["gps"]

    def measure(self, normal: Array) -> Array:
        names = ("noise", "vertical_noise", "velocity_noise")
        level, vertical, speed = (self.values[name] for name in names)
        sigma = np.array((level, level, vertical, speed, speed, speed))
        state = self.world.state
        exact = np.concat((state.position, state.velocity), axis=-1)
        return exact + sigma * normal


class MotionCapture(Sensor):
    """Position and attitude; white noise, of the attitude about the body's axes."""

    about = ABOUT["motion_capture"]

    def measure(self, normal: Array) -> Array:
        state = self.world.state
        position = state.position + self.values["noise"] * normal[..., :3]
        turned = advanced(state.quaternion, self.values["angle_noise"] * normal[..., 3:])
        return np.concat((position, turned), axis=-1)


class Battery(Sensor):
    """Voltage at the terminals of the battery, which the effect `battery` brings; white noise."""

    about = ABOUT["battery"]

    def measure(self, normal: Array) -> Array:
        return stack((self.world.effects.rotors.voltage,)) + self.values["noise"] * normal
