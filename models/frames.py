"""Conversions between MuJoCo's frame and the paper's, for the text codec.

MuJoCo: x forward, y left, z up, right-handed, quaternions scalar first.
Paper and Unity: X right, Y up, Z forward, left-handed, degrees (paper, section 2.2, figure 4).

The map is S: (x, y, z) -> (X, Y, Z) = (-y, z, x), a reflection. A rotation by angle a about axis n
becomes one by -a about S·n. The angles are named as in the paper's nomenclature: phi about X,
theta about Y, psi about Z. It gives no order: we take Unity's (`Transform.eulerAngles`), so that
R = Ry(theta) · Rx(phi) · Rz(psi). Positive phi is nose down, positive theta is nose right, and
positive psi is right side up.

Every function accepts any leading axes, or none.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_POLE = 1 - 1e-12  # sine of phi past which (within 1e-4 degrees) the nose counts as vertical


def positions_in_paper_frame(positions: ArrayLike) -> Array:
    """(x, y, z) in MuJoCo's world -> (X, Y, Z) in the paper's, m; both (..., 3)."""
    positions = np.asarray(positions, np.float64)
    out = np.empty(positions.shape)
    np.subtract(0.0, positions[..., 1], out=out[..., 0])  # no negative zeros
    out[..., 1:] = positions[..., 2::-2]
    return out


def attitudes_in_paper_frame(quaternions: ArrayLike) -> Array:
    """Unit quaternions (w, x, y, z) in MuJoCo's world -> (phi, theta, psi), degrees, (..., 3).

    phi lies in [-90, 90], the others in [-180, 180]. With the nose straight up or down only a sum
    of theta and psi is defined: psi is then 0.
    """
    w, roll, x, yaw = np.moveaxis(np.asarray(quaternions, np.float64), -1, 0)
    y = -yaw
    z = -roll
    sin_phi = np.clip(2 * (w * x - y * z), -1.0, 1.0)
    phi = np.degrees(np.arcsin(sin_phi))
    theta = np.degrees(np.arctan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y)))
    psi = np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (x * x + z * z)))
    turned = 2 * np.degrees(np.arctan2(y, w))
    turned = turned - 360 * np.round(turned / 360)
    vertical = np.abs(sin_phi) > _POLE
    phi = np.where(vertical, np.copysign(90.0, sin_phi), phi)
    theta = np.where(vertical, turned, theta)
    psi = np.where(vertical, 0.0, psi)
    return np.stack((phi, theta, psi), axis=-1) + 0.0  # no negative zeros


def positions_in_world_frame(positions: ArrayLike) -> Array:
    """(X, Y, Z) in the paper's frame -> (x, y, z) in MuJoCo's world, m; both (..., 3)."""
    right, up, forward = np.moveaxis(np.asarray(positions, np.float64), -1, 0)
    return np.stack((forward, -right, up), axis=-1) + 0.0  # no negative zeros


def quaternions_in_world_frame(attitudes: ArrayLike) -> Array:
    """(phi, theta, psi), degrees, (..., 3) -> (w, x, y, z) in MuJoCo's world, (..., 4)."""
    halves = np.radians(np.moveaxis(np.asarray(attitudes, np.float64), -1, 0)) / 2
    a, b, c = np.cos(halves)
    d, e, f = np.sin(halves)
    # Ry(theta) · Rx(phi) · Rz(psi) as a quaternion about X, Y and Z.
    w = b * a * c + e * d * f
    x = b * d * c + e * a * f
    y = e * a * c - b * d * f
    z = b * a * f - e * d * c
    return np.stack((w, -z, x, -y), axis=-1) + 0.0
