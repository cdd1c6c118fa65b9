"""Lenses: where points of the world come to in a picture, also where a lens distorts.

Pixels: row 0 is the top, column 0 the left; the middle of the first pixel is at (0.5, 0.5).
A camera's frame here: x right, y down, z along its axis, as in computer vision.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from .errors import InputError

WIDEST: Final = math.radians(80.0)
"""Largest angle from its axis that a lens with distortion may see, rad."""
_PARTS: Final = 8  # of the way from the axis on which `undistorted` goes outwards
_ROUNDS: Final = 12  # of Newton's method for each, at most
_EXACT: Final = 1e-12  # of the distance from the axis to the picture's edge of a lens of 90°


class Lens(NamedTuple):
    """How points of the world come to pixels: p = K (R x + t), then over its third number.

    A lens that distorts moves that point, over its third number, before K: see `distorted`.
    """

    matrix: np.ndarray
    """K, shape (3, 3), pixels."""
    rotation: np.ndarray
    """R, shape (3, 3), from the world's frame to the camera's."""
    translation: np.ndarray
    """t, shape (3,), m."""
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2, k3; empty: none."""

    def project(self, points: np.ndarray) -> np.ndarray:
        """Columns and rows of points of the world, shape (..., 3), m: shape (..., 2), pixels; nan
        of a point that is not ahead."""
        return self.pixels(points @ self.rotation.T + self.translation)

    def pixels(self, seen: np.ndarray) -> np.ndarray:
        """The same of points of the camera's frame."""
        ahead = np.where(seen[..., 2:] > 0, seen[..., 2:], np.nan)
        flat = distorted(seen[..., :2] / ahead, self.distortion)
        k = self.matrix
        pixels: np.ndarray = flat * np.diagonal(k)[:2] + k[:2, 2]
        return pixels

    def rays(self, height: int, width: int) -> np.ndarray:
        """What the middles of the pixels see one metre ahead, camera's frame, (H, W, 3), m.

        Raises `InputError` where the distortion takes several directions to one pixel.
        """
        rows, columns = np.indices((height, width)) + 0.5
        return self.rays_of(np.stack((columns, rows), axis=-1))

    def rays_of(self, pixels: np.ndarray) -> np.ndarray:
        """The same of columns and rows, shape (..., 2): shape (..., 3)."""
        k = self.matrix
        flat = undistorted((pixels - k[:2, 2]) / np.diagonal(k)[:2], self.distortion)
        return np.concatenate((flat, np.ones_like(flat[..., :1])), axis=-1)

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Points of the world that the pixels of a depth picture (H, W) see, (H, W, 3), m."""
        seen = self.rays(*depth.shape) * depth[..., None]
        points: np.ndarray = (seen - self.translation) @ self.rotation
        return points


def distorted(flat: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Points (x, y) one metre ahead, shape (..., 2), as a lens moves them.

    With r² = x² + y² and s = 1 + k1 r² + k2 r⁴ + k3 r⁶:
    (s x + 2 p1 x y + p2 (r² + 2 x²), s y + p1 (r² + 2 y²) + 2 p2 x y).
    D. C. Brown, Close-range camera calibration, Photogrammetric Engineering 37(8), 1971, in the
    order of OpenCV's coefficients k1, k2, p1, p2, k3; none: the points themselves.
    """
    if not any(coefficients):
        return flat
    k1, k2, p1, p2, k3 = coefficients
    x = flat[..., 0]
    y = flat[..., 1]
    square = x * x + y * y
    scale = 1 + square * (k1 + square * (k2 + square * k3))
    return np.stack(
        (
            scale * x + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            scale * y + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ),
        axis=-1,
    )


def undistorted(flat: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """The reverse of `distorted`, by Newton's method from the axis outwards.

    Raises `InputError` where there is none, or one that is more than `WIDEST` from the axis.
    """
    if not any(coefficients):
        return flat
    found = np.zeros_like(flat)
    wanted = f"a lens that sees each direction up to {math.degrees(WIDEST):.0f}° at one place"
    got = f"{', '.join(f'{one:.4g}' for one in coefficients)}, which folds the picture"
    with np.errstate(all="ignore"):
        for part in range(1, _PARTS + 1):
            for _ in range(_ROUNDS):
                missing = part / _PARTS * flat - distorted(found, coefficients)
                across, both, down = _slope(found, coefficients)
                if np.abs(missing).max() < _EXACT:
                    break
                x = missing[..., 0]
                y = missing[..., 1]
                steps = np.stack((down * x - both * y, across * y - both * x), axis=-1)
                found = found + steps / (across * down - both * both)[..., None]
            right = (across * down > both * both) & (across > 0)
            right &= np.linalg.norm(found, axis=-1) < math.tan(WIDEST)
            right &= np.abs(missing).max(axis=-1) < 1e3 * _EXACT
            if not right.all():
                raise InputError(f"distortion: expected {wanted}, got {got}")
    return found


def _slope(
    flat: np.ndarray, coefficients: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of `distorted`: of x by x, of x by y (which is that of y by x), of y by y."""
    k1, k2, p1, p2, k3 = coefficients
    x = flat[..., 0]
    y = flat[..., 1]
    square = x * x + y * y
    scale = 1 + square * (k1 + square * (k2 + square * k3))
    more = 2 * (k1 + square * (2 * k2 + square * 3 * k3))  # of the scale, over x or y
    return (
        scale + more * x * x + 2 * p1 * y + 6 * p2 * x,
        more * x * y + 2 * p1 * x + 2 * p2 * y,
        scale + more * y * y + 6 * p1 * y + 2 * p2 * x,
    )
