"""The onboard estimate of position, velocity, attitude and body rates."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ...models.matrices import cross
from ..elementary import atan2, exp, expm1, wrapped
from ..rotations import advanced, between, to_world, world_z
from ..state import Array, WorldState, chosen, clip, parts_of, stack
from .base import ABOUT, Sensor, Source

TIME = 1.0
"""Time constant of all corrections, s."""
_UP = np.array((0.0, 0.0, 1.0))
_PARTS = ("position", "velocity", "quaternion", "body_rates")


class Estimator(Source):
    """Complementary filter: integrates the IMU and corrects by the other sensors.

    Attitude: R. Mahony, T. Hamel, J.-M. Pflimlin, "Nonlinear Complementary Filters on the Special
    Orthogonal Group", IEEE TAC 53(5), 2008, equation 32, without its bias; the accelerometer's
    direction counts in proportion to its size over g, the magnetometer turns about the vertical
    alone. Position and velocity: a g-h filter with two equal poles (E. Brookner, "Tracking and
    Kalman Filtering Made Easy", 1998, section 1.2). The filter begins at the exact state, and
    treats delayed readings as current.

    Args:
        interval: Time of a step, s.
        gravity: m/s².
    """

    about = ABOUT["estimate"]
    arrays = _PARTS

    position: Array = None
    velocity: Array = None
    quaternion: Array = None
    body_rates: Array = None

    def __init__(self, interval: float, gravity: float) -> None:
        self.interval = interval
        self._gravity = gravity

    def begin(self, mask: Array, state: WorldState, imu: Array) -> None:
        """Take over the exact state of the drones of a mask."""
        for name in ("position", "velocity", "quaternion"):
            exact = getattr(state, name).astype(np.float64)  # its own memory
            setattr(self, name, chosen(mask, exact, getattr(self, name)))
        self.body_rates = imu[..., :3]

    def update(self, mask: Array, sensors: Mapping[str, Sensor]) -> None:
        """A control step of the drones of a mask."""
        imu = sensors["imu"].value
        period = self.interval
        rates = imu[..., :3]
        force = imu[..., 3:]
        turned = advanced(self.quaternion, rates * period + self._correction(force, sensors))
        acceleration = to_world(turned, force) - self._gravity * _UP
        position = self.position + period * self.velocity + 0.5 * period * period * acceleration
        velocity = self.velocity + period * acceleration
        position, velocity = self._followed(position, velocity, sensors)
        self.quaternion = chosen(mask, turned, self.quaternion)
        furthest = self.about.top[0]
        fastest = self.about.top[3]
        self.position = chosen(mask, clip(position, -furthest, furthest), self.position)
        self.velocity = chosen(mask, clip(velocity, -fastest, fastest), self.velocity)
        self.body_rates = chosen(mask, rates, self.body_rates)

    def _correction(self, force: Array, sensors: Mapping[str, Sensor]) -> Array:
        """Rotation vector in the body frame that corrects the attitude, rad."""
        up = world_z(self.quaternion)
        share = -expm1(-self.interval / TIME)
        angle = share / self._gravity * stack(cross(parts_of(force), parts_of(up)))
        if sensor := sensors.get("magnetometer"):
            east, north, _ = sensor.values["field"]
            field = to_world(self.quaternion, sensor.value)
            off = atan2(north, east) - atan2(field[..., 1], field[..., 0])
            off = wrapped(off) * self._gain(sensor)
            angle = angle + off[..., None] * up
        if sensor := sensors.get("motion_capture"):
            error = between(self.quaternion, sensor.value[..., 3:])
            sign = np.copysign(2.0 * self._gain(sensor), error[..., 0])
            angle = angle + sign[..., None] * error[..., 1:]
        return angle

    def _followed(
        self, position: Array, velocity: Array, sensors: Mapping[str, Sensor]
    ) -> tuple[Array, Array]:
        """Position and velocity, corrected by fresh readings."""
        if sensor := sensors.get("barometer"):
            off = sensor.value[..., 0] - sensor.values["altitude"] - position[..., 2]
            g, h = self._gains(sensor)
            position = position + (g * off)[..., None] * _UP
            velocity = velocity + (h * off)[..., None] * _UP
        if sensor := sensors.get("motion_capture"):
            g, h = self._gains(sensor)
            off = sensor.value[..., :3] - position
            position = position + g[..., None] * off
            velocity = velocity + h[..., None] * off
        if sensor := sensors.get("gps"):
            gain = self._gain(sensor)[..., None]
            position = position + gain * (sensor.value[..., :3] - position)
            velocity = velocity + gain * (sensor.value[..., 3:] - velocity)
        return position, velocity

    def _gain(self, sensor: Sensor) -> Array:
        """Share of an error that a fresh reading removes; 0 without a fresh reading."""
        return -expm1(-sensor.interval / TIME) * sensor.fresh

    def _gains(self, sensor: Sensor) -> tuple[Array, Array]:
        """g, and h over the interval: 1 - ξ² and (1 - ξ)² for two poles at ξ."""
        pole = exp(-sensor.interval / TIME)
        off = 1 - pole
        return (1 - pole * pole) * sensor.fresh, off * off / sensor.interval * sensor.fresh

    def estimate(self) -> Array:
        """Position, velocity, quaternion and rates, shape (W, A, 13)."""
        return np.concat([getattr(self, name) for name in _PARTS], axis=-1)

    def seen(self, state: WorldState) -> WorldState:
        """The state with estimated position, velocity, quaternion and body rates."""
        return replace(state, **{name: getattr(self, name) for name in _PARTS})
