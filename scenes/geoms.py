"""What stands in a scene as geoms of MuJoCo, with which a craft collides."""

import mujoco
import numpy as np
from mujoco import MjSpec, mjtGeom

from ..models.mjcf import add_ground
from . import kernels
from .looks import GEOM_TYPES
from .solids import Solids

NAME = "rotorgram/solid"
"""Of a geom, before its number."""
_SPHERE, _CAPSULE, _CYLINDER, _BOX, _PLANE = range(len(kernels.KINDS))
# MuJoCo's compiler notes which geoms have the axes of their body, and turns these no more.
_TURNED = (0.8, 0.0, 0.0, 0.6)
_AWAY = (0.0, 0.0, -1e4)  # m: where geoms lie that stand for nothing


def add_solids(spec: MjSpec, solids: Solids, count: int) -> None:
    """Add solids to a spec as so many geoms, and level ground unless it has ground."""
    add_ground(spec)
    own = MjSpec()  # its defaults are not the spec's
    fields = geoms_of(solids, count)
    for number in range(count):
        own.worldbody.add_geom(
            name=f"{number}", type=fields["geom_type"][number], pos=fields["geom_pos"][number],
            quat=fields["geom_quat"][number], size=fields["geom_size"][number],
        )  # fmt: skip
    own.visual, own.stat = spec.visual, spec.stat  # MuJoCo warns if they differ
    spec.attach(own, prefix=NAME, frame=spec.worldbody.add_frame())


def geoms_of(solids: Solids, count: int) -> dict[str, np.ndarray]:
    """Fields of so many geoms of a model by name, the first of which are these solids."""
    given = len(solids)
    kinds = solids.kinds
    a, b, c = solids.halves.T
    is_plane = kinds == _PLANE
    is_flat = (kinds == _BOX) | is_plane
    type_ = np.full(count, mjtGeom.mjGEOM_SPHERE.value)
    position = np.full((count, 3), _AWAY)
    quaternion = np.tile(_TURNED, (count, 1))
    size = np.zeros((count, 3))
    size[:, 0] = 0.1
    type_[:given] = np.array([one.value for one in GEOM_TYPES])[kinds]
    position[:given] = solids.centers
    for row, axes in zip(quaternion, solids.axes, strict=False):
        mujoco.mju_mat2Quat(row, axes.ravel())
    second = np.where(kinds == _CAPSULE, c - a, np.where(kinds == _CYLINDER, c, b))
    size[:given, 0] = np.where(is_plane, 0.0, a)
    size[:given, 1] = np.where(is_plane | (kinds == _SPHERE), 0.0, second)
    size[:given, 2] = np.where(is_flat, np.where(is_plane, 1.0, c), 0.0)
    half = np.full((count, 3), 0.1)
    half[:given] = solids.halves
    square = half * half
    reach = np.sqrt(square.sum(axis=1))
    reach[:given] = np.where(kinds == _CYLINDER, np.sqrt(a * a + c * c), reach[:given])
    reach[:given] = np.where(kinds <= _CAPSULE, c, reach[:given])
    reach[:given][is_plane] = 0.0
    box = np.concatenate((np.zeros((count, 3)), half), axis=1)
    return {
        "geom_type": type_, "geom_pos": position, "geom_quat": quaternion, "geom_size": size,
        "geom_rbound": reach, "geom_aabb": box,
    }  # fmt: skip
