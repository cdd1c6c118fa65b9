"""Gyroscope and accelerometer."""

import math

import numpy as np
from numpy.typing import NDArray

from ..rotations import to_body
from ..state import Array, chosen
from .base import Bounds, Sensor, Values, coefficients

GYRO_RANGE = math.radians(2000.0)  # rad/s: the largest setting of the BMI088
ACCELEROMETER_RANGE = 24 * 9.80665  # m/s²: the same


class Imu(Sensor):
    """Gyroscope and accelerometer at the body's origin.

    reading = exact + bias + white noise, for each axis. White noise of density N read
    every T has σ = N / √T; the bias walks by K √T between readings. (IEEE Std 952-1997, annex C.)
    The exact specific force is R^T (a - g), with the attitude R and the acceleration a at the end
    of the control step, under the thrusts and the forces of the air of its last physics step.
    """

    name = "imu"
    arrays = (*Sensor.arrays, "_bias")
    settings = coefficients(
        "",
        "gyro_noise",
        "accelerometer_noise",
        gyro_walk=0.0,
        gyro_bias=0.0,
        gyro_range=GYRO_RANGE,
        accelerometer_walk=0.0,
        accelerometer_bias=0.0,
        accelerometer_range=ACCELEROMETER_RANGE,
    )
    columns = 12
    frame = "body"
    components = tuple(f"{what} {axis}" for what in ("gyro", "accelerometer") for axis in "xyz")
    units = ("rad/s",) * 3 + ("m/s²",) * 3

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
