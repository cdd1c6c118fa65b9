"""Rotations by unit quaternions, scalar first: the one algebra of the project.

Functions of `Parts` take and give the components of vectors: each a number, or an array. The others
take arrays with the components on their last axis, and any leading axes.
"""

from collections.abc import Sequence

from ..models.matrices import cross, rotation
from .elementary import atan2, cos, sin
from .state import Array, parts_of, square_root, stack

Parts = Sequence[Array]
Rows = tuple[Parts, Parts, Parts]

# ---- of components


def add(a: Parts, b: Parts) -> Parts:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def transposed(rows: Rows) -> Rows:
    """The three columns of a matrix."""
    x, y, z = zip(*rows, strict=True)
    return x, y, z


def product(a: Parts, b: Parts) -> Parts:
    """Product of quaternions: b in the frame that a turns."""
    w, x, y, z = a
    d, e, f, g = b
    return (
        w * d - x * e - y * f - z * g,
        x * d + w * e + y * g - z * f,
        y * d + w * f + z * e - x * g,
        z * d + w * g + x * f - y * e,
    )


# ---- of arrays


def to_world(quaternion: Array, vector: Array) -> Array:
    """Body vectors, shape (..., 3), in the world frame; quaternions have shape (..., 4)."""
    return _turned(quaternion, vector, 1.0)


def to_body(quaternion: Array, vector: Array) -> Array:
    """World vectors in the body frame; shapes as of `to_world`."""
    return _turned(quaternion, vector, -1.0)


def _turned(quaternion: Array, vector: Array, sign: float) -> Array:
    # v + w t + u x t with t = 2 u x v, for the axis u; the other way with w's sign changed.
    w, *axis = parts_of(quaternion)
    w = w * sign
    v = parts_of(vector)
    t = [2 * part for part in cross(axis, v)]
    x, y, z = axis
    p, q, r = t
    return stack((
        v[0] + w * p + y * r - z * q,
        v[1] + w * q + z * p - x * r,
        v[2] + w * r + x * q - y * p,
    ))  # fmt: skip


def axes_of(quaternion: Array) -> Rows:
    """The components of body x, y and z in the world frame, shape (...)."""
    return transposed(rotation(parts_of(quaternion)))


def body_x(quaternion: Array) -> Array:
    """Direction of body x in the world frame, shape (..., 3)."""
    return stack(axes_of(quaternion)[0])


def body_z(quaternion: Array) -> Array:
    """Direction of body z in the world frame, shape (..., 3)."""
    return stack(axes_of(quaternion)[2])


def world_z(quaternion: Array) -> Array:
    """Direction of world z in the body frame, shape (..., 3)."""
    return stack(rotation(parts_of(quaternion))[2])


def euler(quaternion: Array) -> tuple[Array, Array, Array]:
    """Angles about x, y and z of R = Rz(yaw) Ry(pitch) Rx(roll), rad, shape (...)."""
    w, x, y, z = parts_of(quaternion)
    roll = atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    sine = 2 * (w * y - x * z)
    pitch = atan2(sine, square_root((1 - sine) * (1 + sine)))
    yaw = atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def between(a: Array, b: Array) -> Array:
    """Quaternion that turns a into b, seen from a, shape (..., 4): a's conjugate times b."""
    w, x, y, z = parts_of(a)
    return stack(product((w, -x, -y, -z), parts_of(b)))


def advanced(quaternion: Array, angle: Array) -> Array:
    """Attitudes turned by rotation vectors in the body frame, rad, shape (..., 3); normalised."""
    x, y, z = (0.5 * part for part in parts_of(angle))
    half = square_root(x * x + y * y + z * z)
    share = sin(half) / (half + 1e-30)  # 1 or 0 where nothing turns: x, y, z are 0 then
    turn = (cos(half), share * x, share * y, share * z)
    w, x, y, z = product(parts_of(quaternion), turn)
    size = square_root(w * w + x * x + y * y + z * z)
    return stack((w / size, x / size, y / size, z / size))
