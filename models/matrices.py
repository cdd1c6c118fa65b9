"""Matrices in a stated order of operations: their bits do not depend on the processor.

Those of NumPy's `@` and `linalg` do, as BLAS and LAPACK have other code for each.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

Array = np.ndarray
Triple = tuple[Array, Array, Array]
_NOTHING = 1e-13  # of a number: what rounding leaves


def settled(values: ArrayLike, size: float = 1.0) -> Array:
    """Rounded to about 1e-12 of a size, with no negative zero.

    The last bits of what MuJoCo's compiler computes differ between processors.
    """
    return np.round(np.asarray(values), 12 - round(math.log10(size))) + 0.0


def dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """Of the components of two vectors, numbers or arrays."""
    total: Array = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return total


def cross(a: Sequence[Array], b: Sequence[Array]) -> Triple:
    """As `dot`."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def times(rows: Sequence[Sequence[Array]], vector: Sequence[Array]) -> Triple:
    """A matrix of three rows, and a vector."""
    return dot(rows[0], vector), dot(rows[1], vector), dot(rows[2], vector)


def rotation(
    quaternion: Sequence[Array], twice: float | Array = 2.0
) -> tuple[Triple, Triple, Triple]:
    """Rotation matrix of a unit quaternion, scalar first, from body to world frame. `twice` is 2
    over the squared length of a quaternion of another length.
    """
    w, x, y, z = quaternion
    return (
        (1.0 - twice * (y * y + z * z), twice * (x * y - w * z), twice * (x * z + w * y)),
        (twice * (x * y + w * z), 1.0 - twice * (x * x + z * z), twice * (y * z - w * x)),
        (twice * (x * z - w * y), twice * (y * z + w * x), 1.0 - twice * (x * x + y * y)),
    )


def product(a: Array, b: Array) -> Array:
    """a @ b of shapes (..., n, k) and (..., k, m), summed from the first product to the last."""
    total = a[..., :, 0, None] * b[..., 0, None, :]
    for k in range(1, a.shape[-1]):
        total = total + a[..., :, k, None] * b[..., k, None, :]
    return np.asarray(total)


def inverse(matrix: Array) -> Array:
    """Inverse of positive definite matrices, shape (..., n, n), by Gauss and Jordan.

    A row that depends on those before it is left out, with its column.
    """
    count = matrix.shape[-1]
    unit = np.broadcast_to(np.eye(count), matrix.shape)
    rows = np.concat((matrix, unit), axis=-1)
    for i in range(count):
        pivot = rows[..., i, i, None]
        is_nothing = pivot <= _NOTHING * matrix[..., i, i, None]
        row = rows[..., i, :] / np.where(is_nothing, np.inf, pivot)
        rows = rows - rows[..., :, i, None] * row[..., None, :]
        rows[..., i, :] = row
    return rows[..., count:]


def right_inverse(matrix: Array) -> Array:
    """Aᵀ (A Aᵀ)⁻¹ of A, shape (n, m): what gives the least x with A x = b."""
    size = np.abs(matrix).max(axis=1, keepdims=True).clip(1e-12)
    rows = matrix / size
    least: Array = product(rows.T, inverse(product(rows, rows.T))) / size.T
    return least
