"""Position and velocity by satellites."""

import numpy as np

from ..state import Array
from .base import FURTHEST, MAX_SPEED, Sensor


class Gps(Sensor):
    """Position and velocity of the body's origin; white noise."""

    name = "gps"
    prefix = "gps_"
    columns = 6
    needs = ("noise", "vertical_noise", "velocity_noise")
    frame = "world"
    components = ("x", "y", "z", "vx", "vy", "vz")
    units = ("m",) * 3 + ("m/s",) * 3
    top = (FURTHEST,) * 3 + (MAX_SPEED,) * 3

    def measure(self, normal: Array) -> Array:
        level, vertical, speed = (self.values[name] for name in self.needs)
        sigma = np.array((level, level, vertical, speed, speed, speed))
        state = self.world.state
        exact = np.concat((state.position, state.velocity), axis=-1)
        return exact + sigma * normal
