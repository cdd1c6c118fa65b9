"""Rays of a sensor, which look for the first solid.

Frame of a sensor: x forward, y left, z up.
"""

from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.errors import InputError, shortened
from ..models.fields import Limits, check
from ..models.matrices import rotation, settled
from . import kernels
from .kernels import LANES
from .solids import Layouts, numbers

Array = NDArray[np.float32]

MAX_RAYS = 1 << 20
MAX_REACH = 1e4  # m
REACH = 20.0  # m: of rays, unless they say another one
MAX_PLACE = 2e4  # m: further away, numbers of float32 are too coarse
_COUNT = Limits(1, 4096, whole=True)
_DEGREES = "degrees"


class Rays:
    """Rays from one point, of R rows and C columns.

    Attributes:
        directions: Unit vectors, shape (R, C, 3).
        reach: How far they go, m, shape (R, C).
    """

    def __init__(self, directions: ArrayLike, reach: ArrayLike = REACH) -> None:
        """`reach`: of all rays, or of each."""
        given = numbers("directions", directions)
        if given.ndim != 3 or given.shape[2] != 3 or not 0 < given.size <= 3 * MAX_RAYS:
            raise InputError(f"directions: expected shape (rows, columns, 3), got {given.shape}")
        sizes = np.sqrt((given * given).sum(axis=-1, keepdims=True))
        if not (np.isfinite(sizes) & (sizes > 0)).all():
            raise InputError("directions: expected vectors that are not 0, got one")
        self.directions = settled(given / sizes)
        self.directions.flags.writeable = False  # packets are made of them once
        ends = numbers("reach", reach)
        if ends.shape not in ((), given.shape[:2]):
            expected = f"one number or shape {given.shape[:2]}"
            raise InputError(f"reach: expected {expected}, got {ends.shape}")
        for end in (ends.min(), ends.max()):
            check("reach", Limits(1e-3, MAX_REACH, "m"), float(end))
        self.reach = np.broadcast_to(ends, given.shape[:2])

    @classmethod
    def pinhole(cls, rows: int, columns: int, fov: float, reach: float = REACH) -> Self:
        """Through the centers of pixels: top row first, from left to right.

        `fov` is the angle between the outer edges of the first and the last column, degrees.
        """
        _check_counts(rows, columns)
        check("fov", Limits(0.1, 179.0, _DEGREES), fov)
        width = 2 * np.tan(np.radians(fov) / 2) / columns
        left = (columns / 2 - (np.arange(columns) + 0.5)) * width
        up = (rows / 2 - (np.arange(rows) + 0.5)) * width
        return cls(np.stack(np.broadcast_arrays(1.0, left, up[:, None]), axis=-1), reach)

    @classmethod
    def rings(cls, rows: int, columns: int, low: float, high: float, reach: float = REACH) -> Self:
        """Rings of a lidar, at elevations from `high` to `low`, degrees, the highest first; a
        single one lies in the middle.

        Each begins ahead and turns to the left.
        """
        _check_counts(rows, columns)
        for name, value in (("low", low), ("high", high)):
            check(name, Limits(-90.0, 90.0, _DEGREES), value)
        ends = (high, low) if rows > 1 else ((high + low) / 2,) * 2
        elevation = np.radians(np.linspace(*ends, rows))[:, None]
        azimuth = 2 * np.pi * np.arange(columns) / columns
        ahead = np.cos(elevation) * np.cos(azimuth)
        left = np.cos(elevation) * np.sin(azimuth)
        return cls(np.stack(np.broadcast_arrays(ahead, left, np.sin(elevation)), axis=-1), reach)

    def cast(
        self,
        layouts: Layouts,
        position: ArrayLike,
        attitude: ArrayLike,
        *,
        which: ArrayLike = 0,
    ) -> Array:
        """Distances to the first solid, m, float32, shape (W, R, C); `reach` if it is further.

        The same bits alone and among others, with Numba and without.

        Args:
            layouts: Of which each sensor is in one, `Layouts.of(scene, …)`.
            position: Of each sensor, world frame, m, shape (W, 3).
            attitude: Quaternions from its frame to the world's, scalar first, shape (W, 4).
            which: Number of its layout, shape (W,).
        """
        place = np.atleast_2d(numbers("position", position))
        turn = np.atleast_2d(numbers("attitude", attitude))
        if place.shape[1:] != (3,) or turn.shape != (len(place), 4):
            expected = "positions (W, 3) and quaternions (W, 4)"
            raise InputError(f"rays: expected {expected}, got {place.shape} and {turn.shape}")
        if not (abs(place).max(initial=0.0) <= MAX_PLACE and (abs(turn).max(axis=1) > 1e-6).all()):
            expected = f"positions within {MAX_PLACE:g} m, and quaternions that are not 0"
            raise InputError(f"rays: expected {expected}, got others")
        kinds, tables = layouts
        chosen = numbers("which", which)
        scenes = chosen.astype(np.int64)
        is_right = (scenes == chosen) & (scenes >= 0) & (scenes < len(kinds))
        if chosen.shape not in ((), (len(place),)) or not is_right.all():
            expected = f"whole numbers from 0 to {len(kinds) - 1}, one or {len(place)} of them"
            raise InputError(f"which: expected {expected}, got {shortened(which)}")
        scenes = np.full(len(place), scenes)
        out = np.empty((len(place), *self.reach.shape), np.float32)
        near = np.array(place, np.float32, order="C")
        code = kernels.compiled()
        run = code.packets if code else kernels.by_numpy
        run(
            kinds, tables, scenes, near, _matrices(turn), *self._packets,
            out.reshape(len(place), self.reach.size),
        )  # fmt: skip
        return out

    @cached_property
    def _packets(self) -> tuple[Array, Array, Array, NDArray[np.uint64], Array]:
        """Directions, planes about packets, planes about all rays, where each ray is, and how far
        they go, as `kernels` has them.
        """
        rays = self.directions.reshape(-1, 3)
        reach = self.reach.ravel()
        numbers = _tiles(*self.reach.shape)
        slots = np.empty(len(rays), np.uint64)  # unsigned: none is from the end
        slots[numbers.ravel()] = np.arange(numbers.size)
        tiles = rays[numbers]
        lanes = tiles.transpose(0, 2, 1).reshape(-1, 3 * LANES)
        planes = np.array([_around(tile) for tile in tiles])  # (K, 5, 3)
        planes = np.pad(planes, ((0, -len(planes) % LANES), (0, 0), (0, 0)))
        blocks = planes.reshape(-1, LANES, 15).transpose(0, 2, 1).reshape(-1, 15 * LANES)
        around = _around(rays)
        whole = np.zeros((6, 4))
        whole[:5, :3] = around
        whole[5] = (*-around[-1], (rays @ around[-1] * reach).max())
        if not around.any():
            whole = whole[:0]
        single = np.float32
        ends = reach[numbers].astype(single)
        return lanes.astype(single), blocks.astype(single), whole.astype(single), slots, ends


def _tiles(rows: int, columns: int) -> NDArray[np.int64]:
    """Numbers of the rays of each packet, (K, 16): tiles of a grid whose last rows and columns are
    repeated.
    """
    high = 4 if rows > 3 else min(rows, 2)
    wide = LANES // high
    numbers = np.arange(rows * columns).reshape(rows, columns)
    numbers = np.pad(numbers, ((0, -rows % high), (0, -columns % wide)), mode="edge")
    tiles = numbers.reshape(numbers.shape[0] // high, high, -1, wide)
    return tiles.transpose(0, 2, 1, 3).reshape(-1, LANES)


def _around(rays: np.ndarray) -> np.ndarray:
    """Five planes that hold rays, by normals that point inwards; of rays too far apart, zeros."""
    middle = rays.mean(axis=0)
    length = np.sqrt(middle @ middle)
    if length < 0.5 or (rays @ middle).min() < 0.2 * length:
        return np.zeros((5, 3))
    middle /= length
    up = (0.0, 0.0, 1.0) if abs(middle[2]) < 0.9 else (1.0, 0.0, 0.0)
    right = np.cross(up, middle)
    right /= np.sqrt(right @ right)
    above = np.cross(middle, right)
    planes = []
    for side in (right, -right, above, -above):
        angle = np.arctan2(-(rays @ side), rays @ middle).max() + 1e-6
        planes.append(side * np.cos(angle) + middle * np.sin(angle))
    return np.array([*planes, middle])


def _matrices(quaternions: np.ndarray) -> Array:
    """Rows of rotation matrices, (W, 9)."""
    scaled = quaternions / abs(quaternions).max(axis=-1, keepdims=True)
    unit = scaled / np.sqrt((scaled * scaled).sum(axis=-1, keepdims=True))
    first, second, third = rotation(unit.T)
    return np.column_stack((*first, *second, *third)).astype(np.float32)


def _check_counts(rows: int, columns: int) -> None:
    check("rows", _COUNT, rows)
    check("columns", _COUNT, columns)
    check("rays", Limits(1, MAX_RAYS, whole=True), rows * columns)
