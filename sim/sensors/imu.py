"""Gyroscope and accelerometer."""

import math

import numpy as np
from numpy.typing import NDArray

from ..rotations import to_body
from ..state import Array, chosen
from .base import ABOUT, Bounds, Sensor, Values


class Imu(Sensor):
    """Gyroscope and accelerometer at the body's origin.

    reading = exact + bias + white noise, for each axis. White noise of density N read
    every T has σ = N / √T; the bias walks by K √T between readings. (IEEE Std 952-1997, annex C.)
    The exact specific force is R^T (a - g), with the attitude R and the acceleration a at the end
    of the control step, under the thrusts and the forces of the air of its last physics step.
    """

    about = ABOUT["imu"]
    arrays = (*Sensor.arrays, "_bias")

    _bias: Array = None

    def _both(self, what: str) -> NDArray[np.float64]:
        return np.repeat([self.values[f"gyro_{what}"], self.values[f"accelerometer_{what}"]], 3)

    @classmethod
    def bounds(cls, values: Values) -> Bounds:
        high = (values["gyro_range"],) * 3 + (values["accelerometer_range"],) * 3
        return tuple(-bound for bound in high), high

    def draw(self, mask: Array, normal: Array) -> None:
        """The bias, without negative zeros: what adds 0 to them changes them."""
        bias = self._both("bias") * normal[..., :6] + 0.0
        self._bias = chosen(mask, bias, self._bias)

    def measure(self, normal: Array) -> Array:
        state = self.world.state
        gravity = np.array((0.0, 0.0, self.world.vehicle.gravity))
        force = to_body(state.quaternion, self.world.acceleration() + gravity)
        exact = np.concat((state.body_rates, force), axis=-1)
        root = math.sqrt(self.interval)
        reading = exact + self._bias + self._both("noise") / root * normal[..., :6]
        self._bias = self._bias + self._both("walk") * root * normal[..., 6:]
        return reading
