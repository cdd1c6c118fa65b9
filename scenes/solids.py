"""What is solid of a scene: primitives as arrays, for rays, planners and physics alike.

World frame: z up, m.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Self

import mujoco
import numpy as np
from mujoco import MjData, MjModel, MjSpec, mjtGeom
from numpy.typing import ArrayLike, NDArray

from ..models.errors import InputError, shortened
from ..models.fields import Limits, check
from . import kernels
from .build import HIDDEN_GROUP, add_scene, is_ground

Array = NDArray[np.float64]

MAX_SOLIDS = 10_000
"""Most primitives of a scene."""
MAX_CELLS = 1 << 26
"""Most cells of a grid, which takes 0.5 GB then."""
_SIZE = Limits(1e-4, 1e4, "m")
_ENDLESS = 1e6  # m: half the width of a plane
_SHEET = 5e-4  # m: half the thickness of a plane of a size, which lies below its face
_MARK = 10.0  # m: half the width of level ground; what is smaller is a mark on it
_CHUNK = 1 << 22  # numbers that a step of `distance` has at once


@dataclass(frozen=True, eq=False)
class Solids:
    """N primitives that stand still.

    `Solids.of_scene("forest:3").distance(points)` is how much room there is at some points.
    """

    names: tuple[str, ...]
    """Of the geoms."""
    kinds: NDArray[np.int8]
    """Places in `kernels.KINDS`, shape (N,)."""
    centers: Array
    """m, shape (N, 3)."""
    axes: Array
    """As columns, shape (N, 3, 3)."""
    halves: Array
    """Half the sides of the box about each, along its axes, m, shape (N, 3)."""

    @classmethod
    def of_scene(cls, scene: str) -> Self:
        """All that pictures show of a scene, NAME or NAME:SEED. Raises `InputError`."""
        spec = MjSpec()
        add_scene(spec, scene)
        model = spec.compile()
        return cls.of_model(model, model.geom_group != HIDDEN_GROUP)

    @classmethod
    def of_model(cls, model: MjModel, which: ArrayLike | None = None) -> Self:
        """Geoms of a model that stand still: those of `which`, bool, or those that can touch.

        An ellipsoid is the capsule about it, or the box about a flat one. Level ground, and a plane
        without a size, have no end; another plane is a sheet. Raises `InputError` for meshes and
        height fields.
        """
        if which is None:
            which = (model.geom_contype | model.geom_conaffinity) != 0
        stands = model.body_weldid[model.geom_bodyid] == 0
        chosen = np.flatnonzero(stands & which).tolist()
        if len(chosen) > MAX_SOLIDS:
            raise InputError(f"scene: expected at most {MAX_SOLIDS} solids, got {len(chosen)}")
        found = [_primitive(model, geom) for geom in chosen]
        kinds, halves, orders = zip(*found, strict=True) if found else ((), (), ())
        half = np.array(halves, float).reshape(-1, 3)
        data = MjData(model)
        mujoco.mj_kinematics(model, data)
        for geom in chosen:
            if not abs(data.geom_xpos[geom]).max() <= _SIZE.high:
                raise InputError(
                    f"scene: expected solids within {_SIZE.high:g} m of the origin, "
                    f"got {_name(model, geom)}"
                )
        axes = data.geom_xmat[chosen].reshape(-1, 3, 3)
        axes = np.take_along_axis(axes, np.array(orders, int).reshape(-1, 1, 3), axis=2)
        is_plane = model.geom_type[chosen] == mjtGeom.mjGEOM_PLANE
        is_sheet = (is_plane & (half[:, 2] == _SHEET))[:, None]
        return cls(
            names=tuple(_name(model, geom) for geom in chosen),
            kinds=np.array([kernels.KINDS.index(kind) for kind in kinds], np.int8),
            centers=data.geom_xpos[chosen] - np.where(is_sheet, _SHEET * axes[:, :, 2], 0.0),
            axes=axes,
            halves=half,
        )

    def __len__(self) -> int:
        return len(self.kinds)

    @cached_property
    def table(self) -> Array:
        """As `kernels` has it, shape (16, N)."""
        is_round = self.kinds < kernels.KINDS.index("cylinder")
        rounding = np.where(is_round, self.halves[:, 0], 0.0)
        columns = self.axes.transpose(0, 2, 1).reshape(-1, 9)
        return np.column_stack((self.centers, columns, self.halves, rounding)).T.copy()

    def distance(self, points: ArrayLike) -> Array:
        """From points, (..., 3), m, to the nearest solid, m, (...); below 0 within one.

        Infinite in an empty scene. Where solids overlap, the way out of them may be longer.
        """
        given = numbers("points", points)
        if given.shape[-1:] != (3,):
            raise InputError(f"points: expected shape (..., 3), got {given.shape}")
        rows = given.reshape(-1, 3)
        count = max(1, _CHUNK // max(1, len(self)))
        parts = [
            kernels.distances(self.kinds, self.table, rows[first : first + count])
            for first in range(0, len(rows), count)
        ]
        return np.concatenate([np.empty(0), *parts]).reshape(given.shape[:-1])

    def field(self, low: ArrayLike, high: ArrayLike, cell: float) -> Array:
        """`distance` at the centers of the cells of a grid (an ESDF), shape (X, Y, Z).

        From the corner `low` on, and at least to `high`, m, with cells of a width, m. Where it is
        less than the radius of a craft, the craft has no room: an occupancy grid. Raises
        `InputError`.
        """
        check("cell", Limits(1e-3, 1e3, "m"), cell)
        start, end = numbers("low", low), numbers("high", high)
        if not (start.shape == end.shape == (3,) and (start < end).all()):
            got = f"{shortened(low)} and {shortened(high)}"
            raise InputError(f"low, high: expected two corners, each below the other, got {got}")
        counts = np.maximum(1, np.ceil((end - start) / cell - 1e-9))
        if not counts.prod() <= MAX_CELLS:
            raise InputError(f"cell: expected at most {MAX_CELLS} cells, got {counts.prod():.0f}")
        ticks = [low + cell * (np.arange(n) + 0.5) for low, n in zip(start, counts, strict=True)]
        found = np.empty(counts.astype(int))
        for row, x in zip(found, ticks[0], strict=True):  # a slab at a time
            row[:] = self.distance(np.stack(np.meshgrid(x, *ticks[1:], indexing="ij"), axis=-1)[0])
        return found


def numbers(name: str, given: ArrayLike) -> Array:
    """An array of finite numbers. Raises `InputError`."""
    try:
        array = np.asarray(given, float)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite numbers, got {shortened(given)}")
    return array


class Layouts(NamedTuple):
    """Solids of S scenes, as `kernels` has them; P is the most that one has."""

    kinds: NDArray[np.int8]
    """Shape (S, P)."""
    tables: NDArray[np.float32]
    """Shape (S, 16, P)."""

    @classmethod
    def of(cls, *scenes: Solids) -> Self:
        """Of scenes in their order."""
        most = max(map(len, scenes), default=0)
        kinds = np.zeros((len(scenes), most), np.int8)
        tables = np.zeros((len(scenes), kernels.ROWS, most), np.float32)
        tables[:, 0] = _ENDLESS  # what is left over is out of reach:
        tables[:, 3] = 1.0  # its center is far along its first axis
        for scene, kind, table in zip(scenes, kinds, tables, strict=True):
            kind[: len(scene)] = scene.kinds
            table[:, : len(scene)] = scene.table
        return cls(kinds, tables)


def _name(model: MjModel, geom: int) -> str:
    return model.geom(geom).name or f"geom {geom}"


def _primitive(model: MjModel, geom: int) -> tuple[str, Sequence[float], Sequence[int]]:
    """Kind of a geom, half the sides of the box about it, and which axis each of them is along."""
    a, b, c = model.geom_size[geom].tolist()
    kind = mjtGeom(model.geom_type[geom])
    name = _name(model, geom)
    if kind == mjtGeom.mjGEOM_PLANE and (
        not a * b or (is_ground(model, geom) and min(a, b) > _MARK)
    ):
        return "plane", (_ENDLESS, _ENDLESS, 0.0), (0, 1, 2)
    order = [0, 1, 2]
    shapes: dict[mjtGeom, tuple[str, Sequence[float]]] = {
        mjtGeom.mjGEOM_SPHERE: ("sphere", (a, a, a)),
        mjtGeom.mjGEOM_CAPSULE: ("capsule", (a, a, a + b)),
        mjtGeom.mjGEOM_CYLINDER: ("cylinder", (a, a, b)),
        mjtGeom.mjGEOM_BOX: ("box", (a, b, c)),
        mjtGeom.mjGEOM_PLANE: ("box", (a, b, _SHEET)),
    }
    if kind == mjtGeom.mjGEOM_ELLIPSOID:
        order = np.argsort((a, b, c)).tolist()
        thin, wide, long = sorted((a, b, c))
        is_flat = thin < wide / 2
        shapes[kind] = ("box", (thin, wide, long)) if is_flat else ("capsule", (wide, wide, long))
    if kind not in shapes:
        expected = ", ".join(kernels.KINDS)
        got = kind.name.removeprefix("mjGEOM_").lower()
        raise InputError(f"scene: expected {expected} or ellipsoid, got {name}, a {got}")
    shape, half = shapes[kind]
    for one in half:
        check(f"scene: half a side of {name}", _SIZE, one)
    return shape, half, order
