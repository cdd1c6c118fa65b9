"""Conversions between MuJoCo's frame and the paper's. No other module converts.

MuJoCo: x forward, y left, z up, right-handed, quaternions scalar first.
Paper and Unity: X right, Y up, Z forward, left-handed, degrees (paper, section 2.2, figure 4).

The map is S: (x, y, z) -> (X, Y, Z) = (-y, z, x), a reflection. A rotation by angle a about axis n
becomes one by -a about S·n. The angles are named as in the paper's nomenclature: phi about X,
theta about Y, psi about Z. It gives no order: we take Unity's (`Transform.eulerAngles`), so that
R = Ry(theta) · Rx(phi) · Rz(psi). Positive phi is nose down, positive theta is nose right, and
positive psi is right side up.

Every function accepts any leading axes, or none. A row gives the same bits alone and in a batch.
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_POLE: Final = 1 - 1e-12  # sine of phi past which (within 1e-4 degrees) the nose counts as vertical


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
    of theta and psi is defined: psi is then 0. Level craft that point forward, as all of the
    elevation task, cost next to nothing.
    """
    quaternions = np.asarray(quaternions, np.float64)
    out = np.zeros((*quaternions.shape[:-1], 3))
    if not np.count_nonzero(quaternions[..., 1:]):
        return out
    # One craft as four floats, many as four contiguous rows: the same bits, and fast for one.
    if quaternions.size == 4:
        w, mx, my, mz = quaternions.reshape(4).tolist()
    else:
        w, mx, my, mz = np.moveaxis(quaternions, -1, 0).copy()
    x, y, z = my, -mz, -mx
    sin_phi = 2 * (w * x - y * z)
    vertical = np.count_nonzero(pole := abs(sin_phi) > _POLE)
    if vertical:
        sin_phi = np.clip(sin_phi, -1.0, 1.0)  # rounding may have taken it past 1
    out[..., 0] = np.arcsin(sin_phi)
    out[..., 1] = np.arctan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y))
    out[..., 2] = np.arctan2(2 * (w * z + x * y), 1 - 2 * (x * x + z * z))
    np.degrees(out, out=out)
    if vertical:
        theta = 2 * np.degrees(np.arctan2(y, w))
        theta -= 360 * np.round(theta / 360)
        there = np.stack([np.copysign(90.0, sin_phi), theta, np.zeros_like(theta)], axis=-1)
        np.copyto(out, there, where=np.expand_dims(pole, -1))
    return np.add(out, 0.0, out=out)  # no negative zeros


def pose_in_mujoco_frame(positions: ArrayLike, attitudes: ArrayLike) -> Array:
    """(X, Y, Z), m, and (phi, theta, psi), degrees, -> `qpos` of a free joint, (..., 7)."""
    right, up, forward = np.moveaxis(np.asarray(positions, np.float64), -1, 0)
    halves = np.radians(np.moveaxis(np.asarray(attitudes, np.float64), -1, 0)) / 2
    (a, b, c) = np.cos(halves)
    (d, e, f) = np.sin(halves)
    # Ry(theta) · Rx(phi) · Rz(psi) as a quaternion about X, Y and Z.
    w = b * a * c + e * d * f
    x = b * d * c + e * a * f
    y = e * a * c - b * d * f
    z = b * a * f - e * d * c
    return np.stack((forward, -right, up, w, -z, x, -y), axis=-1) + 0.0
