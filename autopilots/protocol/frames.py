"""Frames of flight stacks: the world is x north, y east, z down; a body x forward, y right, z down.

Ours are x east, y north, z up, and x forward, y left, z up.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ...sim.rotations import axes_of

Floats = NDArray[np.float64]

ORIGIN = (47.377, 8.542, 408.0)
"""Latitude and longitude of the world's origin, °, and its altitude above sea level, m: Zurich, as
of the magnetometer's field."""
_RADIUS = 6_371_000.0  # m: of the sphere that PX4's map projection takes for the earth


def north_east_down(vector: Floats) -> list[float]:
    """A vector of our world, shape (3,)."""
    x, y, z = vector.tolist()
    return [y, x, -z]


def forward_right_down(vector: Floats) -> list[float]:
    """A vector of our body frame, shape (3,)."""
    x, y, z = vector.tolist()
    return [x, -y, -z]


def angles_of(quaternion: Floats) -> list[float]:
    """Roll, pitch and yaw from north, clockwise, rad, of our quaternion, shape (4,)."""
    (front_x, front_y, front_z), (*_, left_z), (*_, up_z) = axes_of(quaternion)
    pitch = math.asin(min(max(front_z, -1.0), 1.0))
    return [math.atan2(left_z, up_z), pitch, math.atan2(front_x, front_y)]


def geodetic(position: Floats, radius: float = _RADIUS) -> list[int]:
    """Latitude and longitude, 1e-7 °, and altitude above sea level, mm, of a position in our
    world, m, shape (3,), on a sphere of a radius, m.
    """
    east, north, up = position.tolist()
    latitude, longitude, altitude = ORIGIN
    parallel = radius * math.cos(math.radians(latitude))
    latitude += math.degrees(north / radius)
    longitude += math.degrees(east / parallel)
    return [round(1e7 * latitude), round(1e7 * longitude), round(1e3 * (altitude + up))]
