"""The one place where MuJoCo's frame becomes the paper's, and the paper's MuJoCo's.

MuJoCo: x forward, y left, z up, right-handed, quaternions scalar first.
Paper and Unity: X right, Y up, Z forward, left-handed, degrees (paper, section 2.2, figure 4).

The map is S: (x, y, z) -> (X, Y, Z) = (-y, z, x), a reflection. A rotation by angle a about axis n
becomes one by -a about S·n. The angles are named as in the paper's nomenclature: phi about X,
theta about Y, psi about Z. It gives no order: we take Unity's (`Transform.eulerAngles`), so that
R = Ry(theta) · Rx(phi) · Rz(psi). Positive phi is nose down, positive theta is nose right, and
positive psi is right side up.
"""

import math
from collections.abc import Sequence

import numpy as np

__all__ = [
    "attitude_in_paper_frame",
    "attitudes_in_paper_frame",
    "pose_in_mujoco_frame",
    "position_in_paper_frame",
    "positions_in_paper_frame",
]

_POLE = 1 - 1e-12  # sine of phi past which (within 1e-4 degrees) the nose counts as vertical


def position_in_paper_frame(position: Sequence[float]) -> tuple[float, float, float]:
    """(x, y, z) in MuJoCo's world, m -> (X, Y, Z) in the paper's, m."""
    x, y, z = position
    return 0.0 - y, z, x  # 0 - y: no negative zeros


def attitude_in_paper_frame(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """Unit quaternion (w, x, y, z) in MuJoCo's world -> (phi, theta, psi) about X, Y, Z, degrees.

    phi lies in [-90, 90], the others in [-180, 180]. With the nose straight up or down only a sum
    of theta and psi is defined: psi is then 0.
    """
    w, mx, my, mz = quaternion
    x, y, z = my, 0.0 - mz, 0.0 - mx
    sin_phi = 2 * (w * x - y * z)
    if abs(sin_phi) > _POLE:
        phi = math.copysign(90.0, sin_phi)
        theta = 2 * math.degrees(math.atan2(y, w))
        return phi, theta - 360.0 * round(theta / 360.0), 0.0
    theta = math.atan2(2 * (w * y + x * z), 1 - 2 * (x * x + y * y))
    psi = math.atan2(2 * (w * z + x * y), 1 - 2 * (x * x + z * z))
    return math.degrees(math.asin(sin_phi)), math.degrees(theta), math.degrees(psi)


def pose_in_mujoco_frame(position: Sequence[float], attitude: Sequence[float]) -> np.ndarray:
    """The way back, for what is drawn: a free joint's `qpos`, float64, shape (7,).

    Args:
        position: (X, Y, Z), m.
        attitude: (phi, theta, psi), degrees.
    """
    right, up, forward = position
    (a, d), (b, e), (c, f) = (
        (math.cos(half), math.sin(half)) for half in (math.radians(angle) / 2 for angle in attitude)
    )
    # Ry(theta) · Rx(phi) · Rz(psi) as a quaternion about X, Y and Z.
    w, x = b * a * c + e * d * f, b * d * c + e * a * f
    y, z = e * a * c - b * d * f, b * a * f - e * d * c
    return np.array((forward, 0.0 - right, up, w, 0.0 - z, x, 0.0 - y))


def positions_in_paper_frame(positions: np.ndarray, out: np.ndarray) -> None:
    """`position_in_paper_frame` of every row: float64, shapes (N, 3)."""
    np.subtract(0.0, positions[:, 1], out=out[:, 0])
    out[:, 1], out[:, 2] = positions[:, 2], positions[:, 0]


def attitudes_in_paper_frame(quaternions: np.ndarray, out: np.ndarray) -> None:
    """`attitude_in_paper_frame` of every row, bit for bit: float64, shapes (N, 4) and (N, 3).

    NumPy's inverse functions round otherwise than Python's. So a craft that is turned goes through
    those; one that is not, and the elevation task turns none in the air, has zeros.
    """
    out.fill(0.0)
    turned = np.flatnonzero(quaternions[:, 1:].any(axis=1) | np.signbit(quaternions).any(axis=1))
    if turned.size:
        out[turned] = [attitude_in_paper_frame(q) for q in quaternions[turned].tolist()]
