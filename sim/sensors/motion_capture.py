"""Motion capture."""

import numpy as np

from ..rotations import advanced
from ..state import Array
from .base import FURTHEST, UNIT, Sensor


class MotionCapture(Sensor):
    """Position and attitude; white noise, of the attitude about the body's axes."""

    name = "motion_capture"
    prefix = "mocap_"
    columns = 6
    needs = ("noise", "angle_noise")
    frame = "world; quaternion: body to world"
    components = ("x", "y", "z", "qw", "qx", "qy", "qz")
    units = ("m",) * 3 + ("1",) * 4
    top = (FURTHEST,) * 3 + (UNIT,) * 4

    def measure(self, normal: Array) -> Array:
        state = self.world.state
        position = state.position + self.values["noise"] * normal[..., :3]
        turned = advanced(state.quaternion, self.values["angle_noise"] * normal[..., 3:])
        return np.concat((position, turned), axis=-1)
