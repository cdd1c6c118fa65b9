"""Scenes from a seed: a forest, a warehouse, a track of gates.

World frame: z up, m. A generator draws all numbers of a scene from one stream, in one order.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import MjSpec, mjtGeom
from numpy.typing import ArrayLike as Vector

from ..models.files import read_toml

CLEARANCE = 8.0
"""Half the width of the space about the z axis, 20 m high, that nothing but a gate enters, m."""
GROUP = 2
"""Group of the geoms of a scene."""
SKY = mujoco.mjtTexture.mjTEXTURE_SKYBOX

MATERIALS = read_toml(Path(__file__).with_name("materials.toml"), "materials")
_TREES = read_toml(Path(__file__).with_name("trees.toml"), "trees")["kind"]
_FOREST = 60.0  # m: half the width of the wood
_HALL_XML = Path(__file__).with_name("hall.xml")  # its walls, windows, roof, lamps and racks
_GATES = 8
_OPENING = 5.0  # m: the paper's craft is 2.8 m wide with its rotors

_FLAT = mujoco.mjtBuiltin.mjBUILTIN_FLAT
_PATTERNS = {
    "checker": (mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mujoco.mjtMark.mjMARK_NONE),
    "edge": (_FLAT, mujoco.mjtMark.mjMARK_EDGE),
    "random": (_FLAT, mujoco.mjtMark.mjMARK_RANDOM),
}


class Builder:
    """Adds the parts of a scene to a spec, and draws its numbers. Nothing of it touches or weighs
    anything."""

    def __init__(self, spec: MjSpec, scene: str, seed: int) -> None:
        self.spec = spec
        self.scene = scene
        self.rng = np.random.Generator(np.random.PCG64(seed))

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def choose(self, name: str) -> str:
        """One of the materials of several colours."""
        count = len(MATERIALS[self.scene][name]["colours"])
        return f"{name}_{self.rng.integers(count)}"

    def colour(self, base: Vector, by: float = 0.06) -> np.ndarray:
        """A colour near `base`."""
        return np.clip(np.array(base) + self.rng.uniform(-by, by, 3), 0.02, 1.0)

    def around(self, reach: float, far: float) -> tuple[float, float]:
        """A place up to `far` from which `reach` does not lead into the clear space."""
        while True:
            x, y = self.rng.uniform(-far, far, 2).tolist()
            if max(abs(x), abs(y)) > CLEARANCE + reach:
                return x, y

    def paint(self) -> None:
        """Add the materials of the scene, in colours near those of the table."""
        for name, look in MATERIALS[self.scene].items():
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

    def add(
        self,
        name: str,
        kind: str,
        size: Vector,
        position: Vector,
        material: str,
        heading: float = 0.0,
    ) -> None:
        """Add a geom that is turned about z, rad."""
        quaternion = (math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2))
        self.spec.worldbody.add_geom(
            name=f"{self.scene}/{name}", type=getattr(mjtGeom, f"mjGEOM_{kind.upper()}"),
            size=size, pos=position,
            quat=quaternion, material=f"{self.scene}/{material}", contype=0, conaffinity=0,
            group=GROUP, mass=0.0, density=0.0,
        )  # fmt: skip

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


def forest(wood: Builder) -> None:
    """A wood of 120 m by 120 m: trees, shrubs and rocks."""
    wood.sun()
    wood.paint()
    wood.add("ground/floor", "plane", (150, 150, 1), (0, 0, 0), "ground")
    for i in range(110):
        _add_tree(wood, f"tree_{i}")
    for i in range(60):
        wide = wood.uniform(0.4, 1.2)
        x, y = wood.around(wide, _FOREST)
        leaf = wood.choose("leaves")
        wood.add(f"shrub_{i}/crown", "sphere", (wide, 0, 0), (x, y, 0.1 * wide), leaf)
    for i in range(40):
        sides = wood.rng.uniform(0.3, 1.0, 3)
        x, y = wood.around(1.0, _FOREST)
        turn = wood.uniform(0, math.pi)
        wood.add(f"rock_{i}/stone", "box", 0.8 * sides, (x, y, 0.2 * sides[2]), "stone", turn)


def _add_tree(wood: Builder, name: str) -> None:
    x, y = wood.around(3.2, _FOREST)
    tall = wood.uniform(6.0, 15.0)
    wide = wood.uniform(1.4, 3.0)
    kind = int(wood.rng.integers(3))
    leaf = wood.choose("leaves")
    trunk = (0.13 + 0.012 * tall, 0.3 * tall, 0)
    wood.add(f"{name}/trunk", "cylinder", trunk, (x, y, 0.3 * tall), f"bark_{kind % 2}")
    crowns = _TREES[kind]["crowns"]
    shape = _TREES[kind]["shape"]
    aside = np.zeros(2)
    if any(side for _, side, *_ in crowns):
        aside = wood.rng.uniform(-0.3, 0.3, 2) * wide
    for part, side, height, half_width, by_width, by_height in crowns:
        radius = half_width * wide
        half = by_width * wide + by_height * tall
        position = (x + side * aside[0], y + side * aside[1], height * tall)
        if shape == "capsule":
            half = max(1e-3, half - radius)  # of the part between its balls
        wood.add(f"{name}/{part}", shape, (radius, half, 0), position, leaf)


def warehouse(hall: Builder) -> None:
    """A hall of 60 m by 40 m, 24 m high. Racks, pallets and barrels stand along its walls."""
    hall.sky(hall.colour((0.55, 0.60, 0.66)), hall.colour((0.62, 0.64, 0.66)))
    hall.paint()
    walls = MjSpec.from_file(str(_HALL_XML))
    hall.spec.attach(walls, prefix="warehouse/", frame=hall.spec.worldbody.add_frame())
    for i, x in enumerate((-15.0, 15.0)):
        bright = hall.uniform(0.28, 0.42)
        direction = (-x / 30, hall.uniform(-0.4, 0.4), -1.0)
        hall.light(f"light_{i}", (x, 0.0, 22.0), direction, (bright,) * 3, 0.15)
    racks = [(x, y) for y in (-16.5, -11.0, 11.0, 16.5) for x in (-20.0, -7.0, 7.0, 20.0)]
    for i, (x, y) in enumerate(racks):
        _fill_rack(hall, f"rack_{i}", x, y)
    for i in range(20):
        _add_goods(hall, i)


def _fill_rack(hall: Builder, name: str, x: float, y: float) -> None:
    """Boxes on the three shelves of a rack."""
    for level in range(3):
        deck = 0.3 + 2.3 * level
        for slot, dx in enumerate((-3.0, -1.0, 1.0, 3.0)):
            half = hall.rng.uniform((0.5, 0.4, 0.4), (0.9, 0.6, 0.9))
            tint = hall.choose("box")
            if hall.rng.random() < 0.85:  # else the slot is empty
                position = (x + dx, y, deck + 0.06 + half[2])
                hall.add(f"{name}/box_{4 * level + slot}", "box", half, position, tint)


def _add_goods(hall: Builder, number: int) -> None:
    """A barrel, or a box on a pallet; the first six stand in the middle."""
    if number < 6:
        x, y = hall.around(1.0, 13.5)
    else:
        x = hall.uniform(-28, 28)
        y = float(hall.rng.choice((-13.7, 13.7))) + hall.uniform(-0.3, 0.3)
    tint = hall.choose("box")
    if number % 2:
        hall.add(f"barrel_{number}/drum", "cylinder", (0.4, 0.6, 0), (x, y, 0.6), tint)
        return
    half = hall.rng.uniform((0.3, 0.3, 0.2), (0.6, 0.6, 0.6))
    hall.add(f"pallet_{number}/deck", "box", (0.6, 0.6, 0.07), (x, y, 0.08), "pallet")
    hall.add(f"pallet_{number}/box", "box", half, (x, y, 0.16 + half[2]), tint)


def gates(track: Builder) -> None:
    """A ring of 8 gates, 5 m wide inside, with barriers, cones and stands around it."""
    track.sun()
    track.paint()
    track.add("ground/floor", "plane", (150, 150, 1), (0, 0, 0), "grass")
    for i in range(_GATES):
        _add_gate(track, i)
    for i in range(40):
        x, y = track.around(1.5, 40.0)
        tint = track.choose("paint")
        turn = track.uniform(0, math.pi)
        if i % 2:
            track.add(f"barrier_{i}/block", "box", (1.2, 0.25, 0.45), (x, y, 0.45), tint, turn)
        else:
            track.add(f"cone_{i}/body", "capsule", (0.25, 0.5, 0), (x, y, 0.2), tint)
    for i in range(4):
        away = track.uniform(34.0, 44.0)
        angle = math.pi * (i / 2 + 0.25)
        for row in range(4):
            distance = away + 1.5 * row
            height = 0.4 * (row + 1)
            position = (distance * math.cos(angle), distance * math.sin(angle), height)
            size = (0.75, 9.0, height)
            track.add(f"stand_{i}/row_{row}", "box", size, position, "stand", angle)


def _add_gate(track: Builder, number: int) -> None:
    half = _OPENING / 2
    bar = 0.25
    angle = 2 * math.pi * number / _GATES + track.uniform(-0.15, 0.15)
    radius = track.uniform(15.0, 20.0)
    height = track.uniform(5.0, 12.0)
    heading = angle + math.pi / 2 + track.uniform(-0.3, 0.3)  # anticlockwise round the ring
    tint = track.choose("paint")
    x = radius * math.cos(angle)
    y = radius * math.sin(angle)
    foot = (height - half - 2 * bar) / 2
    for part, sign in (("left", 1), ("right", -1)):
        aside = sign * (half + bar)
        side = (x - aside * math.sin(heading), y + aside * math.cos(heading))
        size = (0.15, bar, half + 2 * bar)
        track.add(f"gate_{number}/frame_{part}", "box", size, (*side, height), tint, heading)
        track.add(f"gate_{number}/post_{part}", "cylinder", (0.1, foot, 0), (*side, foot), "steel")
    for part, sign in (("top", 1), ("bottom", -1)):
        position = (x, y, height + sign * (half + bar))
        track.add(f"gate_{number}/frame_{part}", "box", (0.15, half, bar), position, tint, heading)


GENERATORS = {"warehouse": warehouse, "forest": forest, "gates": gates}
"""The function that builds each scene."""
