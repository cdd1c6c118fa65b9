"""Magnetometer."""

from typing import ClassVar

import numpy as np

from ...models.fields import Limits
from ..rotations import to_body
from ..state import Array
from .base import Sensor, Setting

FIELD = (1.287, 21.532, -43.231)
"""Earth's magnetic field at Zurich (47.377° N, 8.542° E, 408 m) on 2025-01-01: east, north and up,
µT. World Magnetic Model WMM2025, NOAA NCEI and British Geological Survey."""


class Magnetometer(Sensor):
    """Earth's field in the body frame; white noise. Setting: the field in the world frame."""

    name = "magnetometer"
    prefix = "magnetometer_"
    columns = 3
    own: ClassVar = {"field": Setting(FIELD, Limits(-100.0, 100.0, "µT", count=3))}
    frame = "body"
    components = ("field x", "field y", "field z")
    units = ("µT",) * 3
    top = (1e3,) * 3  # far from any reading but for a wrong noise

    def measure(self, normal: Array) -> Array:
        field = np.array(self.values["field"]) + 0.0 * normal
        return to_body(self.world.state.quaternion, field) + self.values["noise"] * normal
