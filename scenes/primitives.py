"""A scene as data: primitives with their materials, lights and a sky; and how MuJoCo gets it.

World frame: z up, m, rad.
"""

from dataclasses import dataclass
from typing import Final, Literal

import mujoco
import numpy as np

Colour = tuple[float, float, float]
Point = tuple[float, float, float]
Kind = Literal["plane", "box", "cylinder", "ellipsoid"]
Pattern = Literal["", "checker", "edge", "random"]

GROUP: Final = 2
"""Group of the geoms of a scene."""
HIDDEN_GROUP: Final = 3  # viewers and renderers draw groups 0 to 2 unless the user asks for others
SKY: Final = mujoco.mjtTexture.mjTEXTURE_SKYBOX
_NEAR, _FAR = 0.25, 400.0  # m: nearest and furthest distance that is drawn
_SLICES: Final = 20  # of a cylinder

_KINDS: Final = {
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
}
_MARKS: Final = {"edge": mujoco.mjtMark.mjMARK_EDGE, "random": mujoco.mjtMark.mjMARK_RANDOM}


@dataclass(frozen=True, kw_only=True)
class Material:
    """Colour and texture of primitives."""

    name: str
    colour: Colour
    pattern: Pattern = ""
    second_colour: Colour = (0.0, 0.0, 0.0)
    """Of the pattern."""
    repeat: float = 0.5
    """Repetitions of the pattern per metre."""
    gloss: float = 0.0
    emission: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Primitive:
    """A body of a scene."""

    name: str
    kind: Kind
    size: Point
    """Half lengths of a box, an ellipsoid and a plane; radius and half length of a cylinder."""
    position: Point
    turn: Point = (0.0, 0.0, 0.0)
    """Rotations about x, y and z, one after the other."""
    material: str


@dataclass(frozen=True, kw_only=True)
class Light:
    """A light from one direction. It casts no shadow: that of a slanted sun speckles the ground."""

    name: str
    position: Point
    direction: Point
    diffuse: Colour
    ambient: float


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything around the drones."""

    name: str
    materials: tuple[Material, ...]
    primitives: tuple[Primitive, ...]
    lights: tuple[Light, ...]
    sky: tuple[Colour, Colour]
    """Colours above and at the horizon."""


def attach(spec: mujoco.MjSpec, scene: Scene) -> None:
    """Add a scene to a spec, in place of its sky, its lights and the look of its level ground.

    Nothing that is added touches or weighs anything. Planes of the world body at z = 0 still carry
    what stands on them, but only geom group 3 draws them.
    """
    clear(spec, _NEAR, _FAR, _SLICES)
    for light in spec.worldbody.lights:
        light.active = False
    name = scene.name
    for material in scene.materials:
        _add_material(spec, name, material)
    for one in scene.primitives:
        quaternion = np.empty(4)
        mujoco.mju_euler2Quat(quaternion, np.array(one.turn), "XYZ")
        spec.worldbody.add_geom(
            name=f"{name}/{one.name}", type=_KINDS[one.kind], size=one.size, pos=one.position,
            quat=quaternion, material=f"{name}/{one.material}", contype=0, conaffinity=0,
            group=GROUP, mass=0.0, density=0.0,
        )  # fmt: skip
    for light in scene.lights:
        spec.worldbody.add_light(
            name=f"{name}/{light.name}", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            castshadow=False, pos=light.position, dir=light.direction, diffuse=light.diffuse,
            ambient=(light.ambient,) * 3, specular=(0, 0, 0),
        )  # fmt: skip
    top, horizon = scene.sky
    spec.add_texture(
        name=f"{name}/sky", type=SKY, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=top, rgb2=horizon, width=128, height=768,
    )  # fmt: skip


def _add_material(spec: mujoco.MjSpec, scene: str, material: Material) -> None:
    name = f"{scene}/{material.name}"
    added = spec.add_material(name=name, specular=material.gloss, emission=material.emission)
    if not material.pattern:
        added.rgba = (*material.colour, 1.0)
        return
    builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    if material.pattern == "checker":
        builtin = mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    second = material.second_colour
    spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=128, height=128, builtin=builtin,
        rgb1=material.colour, rgb2=second, markrgb=second, random=0.2,
        mark=_MARKS.get(material.pattern, mujoco.mjtMark.mjMARK_NONE),
    )  # fmt: skip
    added.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    added.texuniform = True
    added.texrepeat = (material.repeat, material.repeat)


def clear(spec: mujoco.MjSpec, near: float, far: float, slices: int) -> None:
    """Hide level ground, delete the sky, set the distances that are drawn, m, and roundness.

    The scale of the spec stays as it is without more: MuJoCo measures distances, shadows and the
    free camera's first distance in extents of the model.
    """
    scene = spec.copy()
    scene.compiler.discardvisual = False
    model = scene.compile()
    for geom, compiled in zip(spec.geoms, scene.geoms, strict=True):
        if _is_ground(model, compiled.id):
            geom.group = HIDDEN_GROUP
    for texture in list(spec.textures):
        if texture.type == SKY:
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
