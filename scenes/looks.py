"""How scenes from a seed look: their parts as geoms, materials, lights and skies."""

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from mujoco import MjSpec, mjtGeom
from numpy.typing import ArrayLike as Vector

from ..models.mjcf import attach
from . import HALL_XML
from .config import SceneConfig
from .generators import drafted
from .geoms import add_geoms
from .solids import Solids

PICTURED: Mapping[str, float] = {
    "contype": 0, "conaffinity": 0, "group": 2, "mass": 0.0, "density": 0.0,
}  # fmt: skip
"""Settings of geoms of a scene that touch and weigh nothing."""
SKY = mujoco.mjtTexture.mjTEXTURE_SKYBOX
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
        attach(spec, MjSpec.from_file(str(HALL_XML)), "warehouse/")
    draft = drafted(scene, scene.seed)
    solids = Solids.drawn([draft])
    geoms = iter(add_geoms(spec, solids, solids.names, PICTURED))
    for block in draft.blocks:
        for material, size in zip(block.materials(), block.numbers[1:4].T, strict=True):
            geom = next(geoms)
            geom.material = f"{scene.name}/{material}"
            if geom.type == mjtGeom.mjGEOM_PLANE:  # it has no end but in pictures
                geom.size = size


class Painter:
    """Adds materials and lights to a spec, and draws their numbers."""

    def __init__(self, spec: MjSpec, scene: SceneConfig) -> None:
        self.spec = spec
        self.scene = scene.name
        self.materials = scene.type.materials
        self.rng = np.random.Generator(np.random.PCG64((scene.seed, 1)))  # none of its parts
        self.uniform = self.rng.uniform

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
