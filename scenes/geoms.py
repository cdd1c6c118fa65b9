"""What stands in a scene as geoms of MuJoCo, with which a craft collides."""

import mujoco
import numpy as np
from mujoco import MjModel, MjSpec, mjtGeom
from numpy.typing import NDArray

from ..models.mjcf import add_ground
from . import kernels
from .fields import least_of
from .looks import GEOM_TYPES, add_hulls, shape_of
from .solids import Solids

NAME = "rotorgram/solid"
"""Of a geom, before its number."""
HFIELD = kernels.KINDS.index("hfield")
# MuJoCo's compiler notes which geoms have the axes of their body, and turns these no more.
_TURNED = (0.8, 0.0, 0.0, 0.6)
_AWAY = (0.0, 0.0, -1e4)  # m: where geoms lie that stand for nothing


def add_solids(spec: MjSpec, solids: Solids, count: int, content: str) -> None:
    """Add solids to a spec as so many geoms, the hulls of the content of a scene's file, and level
    ground unless it has ground.
    """
    add_ground(spec)
    own = MjSpec()  # its defaults are not the spec's
    fields = geoms_of(solids, count)
    grids = [*solids.grids, *[None] * (count - len(solids))]
    for number, grid in enumerate(grids):
        shape = shape_of(own, f"{number}", fields["geom_size"][number], grid)
        own.worldbody.add_geom(
            name=f"{number}", type=fields["geom_type"][number], pos=fields["geom_pos"][number],
            quat=fields["geom_quat"][number], **shape,
        )  # fmt: skip
    add_hulls(own, content)
    own.visual, own.stat = spec.visual, spec.stat  # MuJoCo warns if they differ
    spec.attach(own, prefix=NAME, frame=spec.worldbody.add_frame())


def add_fields(spec: MjSpec, number: int, solids: Solids) -> None:
    """Add the height fields of a layout to a spec."""
    for row in np.flatnonzero(solids.kinds == HFIELD).tolist():
        shape_of(spec, f"{NAME}{number}_{row}", solids.halves[row], solids.grids[row])


def fields_of(model: MjModel, number: int, solids: Solids) -> NDArray[np.int64]:
    """Which field of a model with `add_fields` each solid of a layout is, or -1, (n,)."""
    which = np.full(len(solids), -1)
    for row in np.flatnonzero(solids.kinds == HFIELD).tolist():
        which[row] = model.hfield(f"{NAME}{number}_{row}").id
    return which


def geoms_of(solids: Solids, count: int) -> dict[str, np.ndarray]:
    """Fields of so many geoms of a model by name, the first of which are these solids."""
    given = len(solids)
    kinds = solids.kinds
    a, b, c = solids.halves.T
    lows = np.array([least_of(grid) for grid in solids.grids])
    type_ = np.full(count, mjtGeom.mjGEOM_SPHERE.value)
    type_[:given] = np.array([one.value for one in GEOM_TYPES])[kinds]
    position = np.full((count, 3), _AWAY)
    position[:given] = solids.centers + lows[:, None] * solids.axes[:, :, 2]
    quaternion = np.tile(_TURNED, (count, 1))
    for row, axes in zip(quaternion, solids.axes, strict=False):
        mujoco.mju_mat2Quat(row, axes.ravel())
    # What is chosen by kind is in the order of `kernels.KINDS`.
    size = np.tile((0.1, 0.0, 0.0), (count, 1))
    size[:given, 0] = np.choose(kinds, (a, a, a, a, 0.0, a))
    size[:given, 1] = np.choose(kinds, (0.0, c - a, c, b, 0.0, b))
    size[:given, 2] = np.choose(kinds, (0.0, 0.0, 0.0, c, 1.0, c))
    deep = c + abs(lows)
    furthest = np.sqrt(a * a + b * b + deep * deep)
    reach = np.full(count, 0.1)
    reach[:given] = np.choose(kinds, (c, c, np.sqrt(a * a + c * c), furthest, 0.0, furthest))
    box = np.tile((0.0, 0.0, 0.0, 0.1, 0.1, 0.1), (count, 1))
    box[:given, 2] = -lows
    box[:given, 3:] = solids.halves
    return {
        "geom_type": type_, "geom_pos": position, "geom_quat": quaternion, "geom_size": size,
        "geom_rbound": reach, "geom_aabb": box,
    }  # fmt: skip
