"""What stands in a scene as geoms of MuJoCo, for contact and for pictures."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from mujoco import MjsGeom, MjSpec, mjtGeom
from numpy.typing import ArrayLike

from ..models.mjcf import add_ground, attach
from . import kernels
from .obstacles import hulls_of
from .solids import Array, Solids

NAME = "rotorgram/solid"
"""Of a geom, before its number."""
GEOM_TYPES = [getattr(mjtGeom, f"mjGEOM_{kind.upper()}").value for kind in kernels.KINDS]
"""MuJoCo's, by `kernels.KINDS`."""
# MuJoCo's compiler notes which geoms have the axes of their body, and turns these no more.
_TURNED = (0.8, 0.0, 0.0, 0.6)
_LEAST = 1e-6  # m: height and depth of a field, which MuJoCo wants above 0
_AWAY = (0.0, 0.0, -1e4)  # m: where geoms lie that stand for nothing


def add_solids(spec: MjSpec, solids: Solids, count: int, content: str) -> None:
    """Add solids to a spec as so many geoms, the hulls of the content of a scene's file, and level
    ground unless it has ground.
    """
    add_ground(spec)
    own = MjSpec()  # its defaults are not the spec's
    add_geoms(own, solids, [f"{number}" for number in range(count)], {})
    add_hulls(own, content, {})
    attach(spec, own, NAME)


def add_geoms(
    spec: MjSpec, solids: Solids, names: Sequence[str], settings: Mapping[str, float]
) -> list[MjsGeom]:
    """Add solids to a spec as geoms with names and settings. Where there are more names, their
    geoms stand for nothing.
    """
    fields = geoms_of(solids, len(names))
    geoms = [
        spec.worldbody.add_geom(
            name=name, type=fields["geom_type"][number], pos=fields["geom_pos"][number],
            quat=fields["geom_quat"][number], size=fields["geom_size"][number], **settings,
        )
        for number, name in enumerate(names)
    ]  # fmt: skip
    for row, name in _add_fields(spec, solids).items():
        geoms[row].hfieldname = name
    return geoms


def add_hulls(spec: MjSpec, content: str, settings: Mapping[str, float]) -> None:
    """Add the hulls of the content of a scene's file to a spec, as geoms with settings."""
    for name, one in hulls_of(content).items():
        spec.add_mesh(name=name, uservert=np.ravel(one.vertices))
        spec.worldbody.add_geom(
            name=name, type=mjtGeom.mjGEOM_MESH, meshname=name, pos=one.position,
            quat=one.attitude, rgba=(*one.color, 1.0), **settings,
        )  # fmt: skip


def _add_fields(spec: MjSpec, solids: Solids) -> dict[int, str]:
    """Add the height fields of solids to a spec. Gives their names by the numbers of solids."""
    names = {}
    for row in np.flatnonzero(solids.kinds == kernels.HFIELD).tolist():
        names[row] = f"{NAME}_{row}"
        grid = solids.grids[row]
        a, b, depth = solids.halves[row].tolist()
        low = grid.min()
        tall = max(grid.max() - low, _LEAST)
        rows, columns = grid.shape
        spec.add_hfield(
            name=names[row], size=(a, b, tall, max(depth + low, _LEAST)), nrow=rows, ncol=columns,
            userdata=((grid - low) / tall).ravel(),
        )  # fmt: skip
    return names


def geoms_of(solids: Solids, count: int) -> dict[str, np.ndarray]:
    """Fields of so many geoms of a model by name, the first of which are these solids. Reach and
    box are not those of height fields, which MuJoCo's compiler finds.
    """
    kinds = solids.kinds
    axes = solids.axes
    a, b, c = solids.halves.T
    lows = np.array([0.0 if grid is None else grid.min() for grid in solids.grids])
    quaternions = np.empty((len(solids), 4))
    for quaternion, turned in zip(quaternions, axes, strict=True):
        mujoco.mju_mat2Quat(quaternion, turned.ravel())
    # What is chosen by kind is in the order of `kernels.KINDS`.
    first = np.choose(kinds, (a, a, a, a, 0.0, a))
    second = np.choose(kinds, (0.0, c - a, c, b, 0.0, b))
    third = np.choose(kinds, (0.0, 0.0, 0.0, c, 1.0, c))
    furthest = np.sqrt(a * a + b * b + c * c)
    reach = np.choose(kinds, (c, c, np.sqrt(a * a + c * c), furthest, 0.0, furthest))

    def filled(given: Array, other: ArrayLike) -> np.ndarray:
        """Numbers of the solids, and others of geoms that stand for nothing."""
        rows = np.full((count, *np.shape(other)), other)
        rows[: len(given)] = given
        return rows

    return {
        "geom_type": filled(np.array(GEOM_TYPES)[kinds], GEOM_TYPES[0]),
        "geom_pos": filled(solids.centers + lows[:, None] * axes[:, :, 2], _AWAY),
        "geom_quat": filled(quaternions, _TURNED),
        "geom_size": filled(np.column_stack((first, second, third)), (0.1, 0.0, 0.0)),
        "geom_rbound": filled(reach, 0.1),
        "geom_aabb": filled(
            np.pad(solids.halves, ((0, 0), (3, 0))), (0.0, 0.0, 0.0, 0.1, 0.1, 0.1)
        ),
    }
