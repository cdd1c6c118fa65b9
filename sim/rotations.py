"""Vectors turned by unit quaternions, scalar first, for any leading axes."""

import numpy as np

from .state import Array, component, stack


def to_world(quaternion: Array, vector: Array) -> Array:
    """Body vectors, shape (..., 3), in the world frame; quaternions have shape (..., 4)."""
    return _turned(quaternion, vector, 1.0)


def to_body(quaternion: Array, vector: Array) -> Array:
    """World vectors in the body frame; shapes as of `to_world`."""
    return _turned(quaternion, vector, -1.0)


def body_z(quaternion: Array) -> Array:
    """Direction of body z in the world frame, shape (..., 3)."""
    w, x, y, z = (component(quaternion, i) for i in range(4))
    return stack((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)))


def world_z(quaternion: Array) -> Array:
    """Direction of world z in the body frame, shape (..., 3)."""
    w, x, y, z = (component(quaternion, i) for i in range(4))
    return stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)))


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors, shape (..., 3)."""
    (ax, ay, az), (bx, by, bz) = ([component(v, i) for i in range(3)] for v in (a, b))
    return stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def multiplied(a: Array, b: Array) -> Array:
    """Product of quaternions, shape (..., 4): b in the frame that a turns."""
    (aw, ax, ay, az), (bw, bx, by, bz) = ([component(q, i) for i in range(4)] for q in (a, b))
    return stack((
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ))  # fmt: skip


def between(a: Array, b: Array) -> Array:
    """Quaternion that turns a into b, seen from a, shape (..., 4): a's conjugate times b."""
    w, x, y, z = (component(a, i) for i in range(4))
    return multiplied(stack((w, -x, -y, -z)), b)


def advanced(quaternion: Array, angle: Array) -> Array:
    """Attitudes turned by rotation vectors in the body frame, rad, shape (..., 3); normalised."""
    x, y, z = (0.5 * component(angle, i) for i in range(3))
    half = np.sqrt(x * x + y * y + z * z)
    share = np.sin(half) / (half + 1e-30)  # 1 or 0 where nothing turns: x, y, z are 0 then
    turned = multiplied(quaternion, stack((np.cos(half), share * x, share * y, share * z)))
    w, x, y, z = (component(turned, i) for i in range(4))
    return turned / stack((np.sqrt(w * w + x * x + y * y + z * z),))


def _turned(quaternion: Array, vector: Array, sign: float) -> Array:
    # v + w t + u x t with t = 2 u x v, for the axis u; the other way with w's sign changed.
    w, x, y, z = (component(quaternion, i) for i in range(4))
    a, b, c = (component(vector, i) for i in range(3))
    w = w * sign
    p = 2 * (y * c - z * b)
    q = 2 * (z * a - x * c)
    r = 2 * (x * b - y * a)
    return stack((
        a + w * p + y * r - z * q,
        b + w * q + z * p - x * r,
        c + w * r + x * q - y * p,
    ))  # fmt: skip
