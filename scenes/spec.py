"""What scenes do to the spec to which they are added."""

import mujoco
import numpy as np

Colour = tuple[float, float, float]

HIDDEN_GROUP = 3  # viewers and renderers draw groups 0 to 2 unless the user asks for others


def clear(spec: mujoco.MjSpec, near: float, far: float, slices: int) -> None:
    """Hide level ground, delete the sky, set the distances that are drawn, m, and roundness.

    The ground still carries what stands on it, but only geom group 3 draws it. The scale of the
    spec stays as it is without more: MuJoCo measures distances, shadows and the free camera's first
    distance in extents of the model.
    """
    scene = spec.copy()
    scene.compiler.discardvisual = False
    model = scene.compile()
    for geom, compiled in zip(spec.geoms, scene.geoms, strict=True):
        if _is_ground(model, compiled.id):
            geom.group = HIDDEN_GROUP
    for texture in list(spec.textures):
        if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            spec.delete(texture)
    stat = spec.stat
    visual = spec.visual
    stat.extent = model.stat.extent
    stat.center = model.stat.center
    stat.meansize = model.stat.meansize
    visual.map.znear = near / model.stat.extent
    visual.map.zfar = far / model.stat.extent
    visual.quality.numslices = max(visual.quality.numslices, slices)


def _is_ground(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is a plane of the world body at z = 0 that faces up."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE or model.geom_bodyid[geom] != 0:
        return False
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    return bool(np.isclose(rotation[8], 1.0) and model.geom_pos[geom, 2] == 0.0)
