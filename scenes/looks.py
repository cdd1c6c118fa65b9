"""How scenes from a seed look: their parts as geoms, materials, lights and skies."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import MjsGeom, MjSpec, mjtGeom
from numpy.typing import ArrayLike as Vector
from numpy.typing import NDArray

from .config import SceneConfig
from .fields import least_of
from .generators import Parts, parts_of
from .kernels import KINDS
from .obstacles import hulls_of

Array = NDArray[np.float64]

GROUP = 2
"""Group of the geoms of a scene."""
_LEAST = 1e-6  # m: height and depth of a field, which MuJoCo wants above 0
SKY = mujoco.mjtTexture.mjTEXTURE_SKYBOX
HALL_XML = Path(__file__).with_name("hall.xml")
"""Walls, windows, roof, lamps and racks of the warehouse."""

GEOM_TYPES = [getattr(mjtGeom, f"mjGEOM_{kind.upper()}") for kind in KINDS]
"""MuJoCo's, by `kernels.KINDS`."""
_FLAT = mujoco.mjtBuiltin.mjBUILTIN_FLAT
_PATTERNS = {
    "checker": (mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mujoco.mjtMark.mjMARK_NONE),
    "edge": (_FLAT, mujoco.mjtMark.mjMARK_EDGE),
    "random": (_FLAT, mujoco.mjtMark.mjMARK_RANDOM),
}


def add_parts(spec: MjSpec, scene: SceneConfig) -> None:
    """Add a scene from a seed to a spec. Nothing of it touches or weighs anything."""
    painter = Painter(spec, scene)
    if scene.name in ("warehouse", "aisles"):
        _lamps(painter)
    else:
        painter.sun()
    painter.paint()
    if scene.name == "warehouse":
        walls = MjSpec.from_file(str(HALL_XML))
        spec.attach(walls, prefix="warehouse/", frame=spec.worldbody.add_frame())
    parts = parts_of(scene, scene.seed)
    geoms = add_geoms(spec, scene.name, parts)
    for geom, material in zip(geoms, parts.materials(), strict=True):
        geom.material = f"{scene.name}/{material}"


def add_geoms(spec: MjSpec, scene: str, parts: Parts) -> list[MjsGeom]:
    """Add parts of a scene to a spec, which touch and weigh nothing."""
    geoms = []
    axes = parts.axes
    for i, own in enumerate(parts.names()):
        name = f"{scene}/{own}"
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, axes[i].ravel())
        shape = shape_of(spec, name, parts.sizes[i], parts.grids[i])
        position = parts.positions[i] + least_of(parts.grids[i]) * axes[i, :, 2]
        geom = spec.worldbody.add_geom(
            name=name, type=GEOM_TYPES[parts.kinds[i]], pos=position, quat=quaternion,
            contype=0, conaffinity=0, group=GROUP, mass=0.0, density=0.0, **shape,
        )  # fmt: skip
        geoms.append(geom)
    return geoms


def add_hulls(spec: MjSpec, content: str, **settings: int) -> None:
    """Add the hulls of the content of a scene's file to a spec, as geoms with further settings."""
    for name, one in hulls_of(content).items():
        spec.add_mesh(name=name, uservert=np.ravel(one.vertices))
        spec.worldbody.add_geom(
            name=name, type=mjtGeom.mjGEOM_MESH, meshname=name, pos=one.position,
            quat=one.attitude, rgba=(*one.color, 1.0), **settings,
        )  # fmt: skip


def shape_of(spec: MjSpec, name: str, size: Vector, grid: Array | None) -> dict[str, object]:
    """Arguments of a geom for its size.

    The heights of a `grid` above a position, m, (rows, columns), are added to the spec: the geom
    lies at the least of them. Its size is half its width along x and y, and its depth below that
    position.
    """
    if grid is None:
        return {"size": size}
    low = grid.min()
    tall = max(grid.max() - low, _LEAST)
    a, b, depth = np.asarray(size).tolist()
    rows, columns = grid.shape
    spec.add_hfield(
        name=name, size=(a, b, tall, max(depth + low, _LEAST)), nrow=rows, ncol=columns,
        userdata=((grid - low) / tall).ravel(),
    )  # fmt: skip
    return {"hfieldname": name}


class Painter:
    """Adds materials and lights to a spec, and draws their numbers."""

    def __init__(self, spec: MjSpec, scene: SceneConfig) -> None:
        self.spec = spec
        self.scene = scene.name
        self.materials = scene.type.materials
        self.rng = np.random.Generator(np.random.PCG64((scene.seed, 1)))  # none of its parts

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def colour(self, base: Vector, by: float = 0.06) -> np.ndarray:
        """A colour near `base`."""
        return np.clip(np.array(base) + self.rng.uniform(-by, by, 3), 0.02, 1.0)

    def paint(self) -> None:
        """Add the materials of the scene, in colours near those of the table."""
        for name, look in self.materials.items():
            colours = look["colours"]
            for number, base in enumerate(colours):
                colour = self.colour(base, look.get("by", 0.06))
                own = f"{self.scene}/{name}"
                if len(colours) > 1:
                    own += f"_{number}"
                material = self.spec.add_material(name=own, specular=look.get("gloss", 0.0))
                if "pattern" in look:
                    self._add_pattern(material, colour, look)
                else:
                    material.rgba = (*colour, 1.0)

    def _add_pattern(
        self, material: mujoco.MjsMaterial, colour: np.ndarray, look: Mapping[str, Any]
    ) -> None:
        second = colour * self.rng.uniform(0.82, 0.94)
        repeat = look.get("repeat", 0.5)
        builtin, mark = _PATTERNS[look["pattern"]]
        self.spec.add_texture(
            name=material.name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=128, height=128,
            builtin=builtin, rgb1=colour, rgb2=second, markrgb=second, random=0.2, mark=mark,
        )  # fmt: skip
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = material.name
        material.texuniform = True
        material.texrepeat = (repeat, repeat)

    def light(
        self, name: str, position: Vector, direction: Vector, diffuse: Vector, ambient: float
    ) -> None:
        """Add a light from one direction. A shadow of a slanted one would speckle the ground."""
        self.spec.worldbody.add_light(
            name=f"{self.scene}/{name}", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            castshadow=False, pos=position, dir=direction, diffuse=diffuse,
            ambient=(ambient,) * 3, specular=(0, 0, 0),
        )  # fmt: skip

    def sky(self, top: Vector, horizon: Vector) -> None:
        """Add a sky of two colours."""
        self.spec.add_texture(
            name=f"{self.scene}/sky", type=SKY, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=top, rgb2=horizon, width=128, height=768,
        )  # fmt: skip

    def sun(self) -> None:
        """Add a sun from a side of its own, and its sky."""
        azimuth = self.uniform(0.0, 2 * math.pi)
        down = self.uniform(1.0, 2.5)
        bright = self.uniform(0.6, 0.8)
        direction = (math.cos(azimuth), math.sin(azimuth), -down)
        self.light("sun", (0.0, 0.0, 60.0), direction, (bright, bright, 0.95 * bright), 0.2)
        self.sky(self.colour((0.40, 0.60, 0.86)), (0.93, 0.95, 0.97))


def _lamps(hall: Painter) -> None:
    hall.sky(hall.colour((0.55, 0.60, 0.66)), hall.colour((0.62, 0.64, 0.66)))
    for i, x in enumerate((-15.0, 15.0)):
        bright = hall.uniform(0.28, 0.42)
        direction = (-x / 30, hall.uniform(-0.4, 0.4), -1.0)
        hall.light(f"light_{i}", (x, 0.0, 22.0), direction, (bright,) * 3, 0.15)
