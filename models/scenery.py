"""Scenery from a seed: a warehouse, a forest, a track of gates, of primitives that touch nothing.

World frame: z up, m. All numbers of a scenery are drawn from one generator, in one order.
"""

import math
from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np

from .errors import expect

ROOM: Final = 8.0
"""Half the width of the room about the z axis that no geom but a gate enters, m."""
ROOM_HEIGHT: Final = 20.0
"""Height of that room, m."""

_HIDDEN_GROUP: Final = 3  # viewers and renderers draw groups 0 to 2 unless told otherwise
_GROUP: Final = 2
_SKY: Final = mujoco.mjtTexture.mjTEXTURE_SKYBOX
_PLANE: Final = mujoco.mjtGeom.mjGEOM_PLANE
_BOX: Final = mujoco.mjtGeom.mjGEOM_BOX
_CYLINDER: Final = mujoco.mjtGeom.mjGEOM_CYLINDER
_ELLIPSOID: Final = mujoco.mjtGeom.mjGEOM_ELLIPSOID
_NEAR, _FAR = 0.25, 400.0  # m: where drawing begins and ends

_ROUNDNESS: Final = 20  # slices of a cylinder
_FOREST: Final = 60.0  # m: half the width of the wood
_LENGTH, _WIDTH, _HEIGHT = 30.0, 20.0, 24.0  # m: half length, half width and height of the hall
_GATES: Final = 8
_OPENING: Final = 5.0  # m: the paper's craft is 2.8 m wide with its rotors
_FLIP: Final = math.pi

_Colour = tuple[float, float, float]


class _Set:
    """The names, the generator and the parts of one scenery."""

    def __init__(self, spec: mujoco.MjSpec, name: str, seed: int) -> None:
        whole = isinstance(seed, int) and not isinstance(seed, bool) and seed >= 0
        expect(whole, "seed", "an integer of at least 0", f"{seed!r}")
        there = any(geom.name.startswith(f"{name}/") for geom in spec.geoms)
        expect(not there, "spec", f"a scene without a {name}", "one that has it")
        self.spec, self.name = spec, name
        self.rng = np.random.Generator(np.random.PCG64(seed))
        _clear(spec)

    def colour(self, *base: float, by: float = 0.06) -> _Colour:
        """A colour near `base`."""
        red, green, blue = np.clip(np.array(base) + self.rng.uniform(-by, by, 3), 0.02, 1.0)
        return float(red), float(green), float(blue)

    def material(
        self, name: str, colour: _Colour, pattern: str = "", repeat: float = 0.5, gloss: float = 0.0
    ) -> str:
        """A material of one colour, or with a texture `checker`, `edge` or `random` of it."""
        full = f"{self.name}/{name}"
        material = self.spec.add_material(name=full, specular=gloss)
        if not pattern:
            material.rgba = (*colour, 1.0)
            return full
        other = np.array(colour) * self.rng.uniform(0.82, 0.94)
        flat, checker = mujoco.mjtBuiltin.mjBUILTIN_FLAT, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
        marks = {"edge": mujoco.mjtMark.mjMARK_EDGE, "random": mujoco.mjtMark.mjMARK_RANDOM}
        self.spec.add_texture(
            name=full, type=mujoco.mjtTexture.mjTEXTURE_2D, width=128, height=128,
            builtin=flat if pattern in marks else checker, rgb1=colour, rgb2=other,
            mark=marks.get(pattern, mujoco.mjtMark.mjMARK_NONE), markrgb=other, random=0.2,
        )  # fmt: skip
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = full
        material.texuniform, material.texrepeat = True, (repeat, repeat)
        return full

    def add(
        self, name: str, shape: Any, size: Any, pos: Any, material: str, turn: Any = (0, 0, 0)
    ) -> None:
        """A geom that neither touches nor weighs; `turn`: rad about x, y and z, one after other."""
        quat = np.empty(4)
        mujoco.mju_euler2Quat(quat, np.array(turn, dtype=float), "XYZ")
        self.spec.worldbody.add_geom(
            name=f"{self.name}/{name}", type=shape, size=size, pos=pos, quat=quat,
            material=material, contype=0, conaffinity=0, group=_GROUP, mass=0.0, density=0.0,
        )  # fmt: skip

    def sun(self) -> None:
        """Sky and a sun from a side of its own, in place of those of the scene."""
        azimuth, down = self.rng.uniform(0.0, 2 * math.pi), self.rng.uniform(1.0, 2.5)
        bright = self.rng.uniform(0.6, 0.8)
        self.spec.worldbody.add_light(
            name=f"{self.name}/sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            castshadow=False,  # the shadow map of a slanted sun speckles the ground
            pos=(0, 0, 60), dir=(math.cos(azimuth), math.sin(azimuth), -down),
            diffuse=(bright, bright, 0.95 * bright), ambient=(0.2, 0.2, 0.2), specular=(0, 0, 0),
        )  # fmt: skip
        self.sky(self.colour(0.40, 0.60, 0.86), (0.93, 0.95, 0.97))

    def sky(self, top: _Colour, bottom: _Colour) -> None:
        """A sky from `top` to `bottom`."""
        gradient = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
        self.spec.add_texture(
            name=f"{self.name}/sky", type=_SKY, builtin=gradient,
            rgb1=top, rgb2=bottom, width=128, height=768,
        )  # fmt: skip

    def around(self, reach: float, far: float) -> tuple[float, float]:
        """A place from which `reach` does not lead into the flying room."""
        while True:
            x, y = (float(value) for value in self.rng.uniform(-far, far, 2))
            if max(abs(x), abs(y)) > ROOM + reach:
                return x, y


def attach_forest(spec: mujoco.MjSpec, seed: int = 0) -> None:
    """Put a wood of 120 m around the scene `spec`, in place: trees, shrubs and rocks.

    The scene moves bit for bit as without it: no geom touches or weighs anything, and
    `spec.compiler.discardvisual` drops them all. Planes of the world body at z = 0 still carry
    what stands on them, but only geom group 3 draws them. Sky, sun and the ends of drawing become
    the forest's. Raises `InputError` for a seed below 0, or if the scene has a forest already.
    """
    size: Any
    wood = _Set(spec, "forest", seed)
    rng = wood.rng
    wood.sun()
    ground = wood.material("ground", wood.colour(0.36, 0.42, 0.22), "random", 0.1)
    bark = [wood.material(f"bark_{i}", wood.colour(0.36, 0.26, 0.17), "random") for i in range(2)]
    green = [(0.15, 0.33, 0.16), (0.26, 0.43, 0.15), (0.40, 0.47, 0.16), (0.30, 0.38, 0.20)]
    leaves = [
        wood.material(f"leaves_{i}", wood.colour(*each), "random", 0.7)
        for i, each in enumerate(green)
    ]
    stone = wood.material("stone", wood.colour(0.48, 0.47, 0.45), "random", 0.6)
    wood.add("ground/floor", _PLANE, (150, 150, 1), (0, 0, 0), ground)
    for i in range(110):
        x, y = wood.around(3.2, _FOREST)
        tall, wide = rng.uniform(6.0, 15.0), rng.uniform(1.4, 3.0)
        kind, leaf = int(rng.integers(3)), leaves[int(rng.integers(len(leaves)))]
        trunk = (0.13 + 0.012 * tall, 0.3 * tall, 0)
        wood.add(f"tree_{i}/trunk", _CYLINDER, trunk, (x, y, 0.3 * tall), bark[kind % 2])
        if kind == 0:  # a fir: three storeys, each narrower
            for storey, (height, width) in enumerate(((0.40, 1.0), (0.62, 0.72), (0.84, 0.42))):
                size = (wide * width, wide * width, 0.18 * tall)
                wood.add(f"tree_{i}/crown_{storey}", _ELLIPSOID, size, (x, y, height * tall), leaf)
        elif kind == 1:  # round
            size = (wide, wide, 0.3 * tall)
            wood.add(f"tree_{i}/crown", _ELLIPSOID, size, (x, y, 0.72 * tall), leaf)
        else:  # two balls side by side
            dx, dy = rng.uniform(-0.3, 0.3, 2) * wide
            for part, (side, height) in enumerate(((1, 0.62), (-1, 0.80))):
                pos = (x + side * dx, y + side * dy, height * tall)
                wood.add(f"tree_{i}/crown_{part}", _ELLIPSOID, (0.7 * wide,) * 3, pos, leaf)
    for i in range(60):
        wide = rng.uniform(0.4, 1.2)
        x, y = wood.around(wide, _FOREST)
        leaf = leaves[int(rng.integers(len(leaves)))]
        wood.add(f"shrub_{i}/crown", _ELLIPSOID, (wide, wide, 0.7 * wide), (x, y, 0.4 * wide), leaf)
    for i in range(40):
        size = rng.uniform(0.3, 1.0, 3)
        x, y = wood.around(1.0, _FOREST)
        turn = (0, 0, rng.uniform(0, math.pi))
        wood.add(f"rock_{i}/stone", _ELLIPSOID, size, (x, y, 0.2 * size[2]), stone, turn)


def attach_warehouse(spec: mujoco.MjSpec, seed: int = 0) -> None:
    """Put a hall of 60 m by 40 m, 24 m high, around the scene `spec`, in place.

    Its racks with boxes, pallets and barrels stand along the walls. Else as `attach_forest`.
    """
    size: Any
    pos: Any
    turn: Any
    y: float
    hall = _Set(spec, "warehouse", seed)
    rng = hall.rng
    hall.sky(hall.colour(0.55, 0.60, 0.66), hall.colour(0.62, 0.64, 0.66))
    floor = hall.material("floor", hall.colour(0.55, 0.55, 0.53), "checker", 0.25)
    wall = hall.material("wall", hall.colour(0.72, 0.72, 0.70, by=0.03), "edge", 0.3)
    roof = hall.material("roof", hall.colour(0.50, 0.52, 0.55), "edge", 0.2)
    steel = hall.material("steel", hall.colour(0.20, 0.34, 0.62, by=0.15), gloss=0.2)
    pallet = hall.material("pallet", hall.colour(0.62, 0.48, 0.30), "random")
    glass = hall.material("glass", hall.colour(0.70, 0.84, 0.93), "edge", 0.5)
    lamp = hall.material("lamp", (1.0, 0.98, 0.90))
    spec.material(lamp).emission = 0.9
    tints = [(0.72, 0.53, 0.33), (0.62, 0.44, 0.27), (0.25, 0.45, 0.66), (0.72, 0.24, 0.20)]
    boxes = [
        hall.material(f"box_{i}", hall.colour(*each, by=0.1), "edge", 1.0)
        for i, each in enumerate(tints)
    ]
    across, along, middle = _WIDTH, _LENGTH, _HEIGHT / 2
    hall.add("ground/floor", _PLANE, (along, across, 1), (0, 0, 0), floor)
    hall.add("roof/sheet", _PLANE, (along, across, 1), (0, 0, _HEIGHT), roof, (_FLIP, 0, 0))
    for name, sign in (("west", -1), ("east", 1)):
        turn = (0, -sign * math.pi / 2, 0)
        pos = (sign * along, 0, middle)
        hall.add(f"wall_{name}/sheet", _PLANE, (middle, across, 1), pos, wall, turn)
    for name, sign in (("south", -1), ("north", 1)):
        turn = (sign * math.pi / 2, 0, 0)
        pos = (0, sign * across, middle)
        hall.add(f"wall_{name}/sheet", _PLANE, (along, middle, 1), pos, wall, turn)
        for i, x in enumerate(np.linspace(-24.0, 24.0, 7)):
            pos = (x, sign * (across - 0.05), 19.0)
            hall.add(f"wall_{name}/window_{i}", _BOX, (2.5, 0.04, 1.6), pos, glass)
    for i, x in enumerate(np.linspace(-25.0, 25.0, 6)):
        hall.add(f"truss_{i}/beam", _BOX, (0.15, across, 0.3), (x, 0, 23.4), steel)
        for j, y in enumerate((-11.0, 0.0, 11.0)):
            hall.add(f"lamp_{3 * i + j}/tube", _BOX, (0.2, 1.2, 0.08), (x, y, 22.9), lamp)
    for i, x in enumerate((-15.0, 15.0)):
        bright = rng.uniform(0.28, 0.42)
        spec.worldbody.add_light(
            name=f"warehouse/light_{i}", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=(x, 0, 22), dir=(-x / 30, rng.uniform(-0.4, 0.4), -1), diffuse=(bright,) * 3,
            ambient=(0.15,) * 3, specular=(0, 0, 0), castshadow=False,
        )  # fmt: skip
    racks = [(x, y) for y in (-16.5, -11.0, 11.0, 16.5) for x in (-20.0, -7.0, 7.0, 20.0)]
    for i, (x, y) in enumerate(racks):
        for j, (dx, dy) in enumerate(((-4.0, -0.6), (-4.0, 0.6), (4.0, -0.6), (4.0, 0.6))):
            size, pos = (0.07, 0.07, 3.6), (x + dx, y + dy, 3.6)
            hall.add(f"rack_{i}/post_{j}", _BOX, size, pos, steel)
        for level in range(3):
            deck = 0.3 + 2.3 * level
            size, pos = (4.0, 0.7, 0.05), (x, y, deck)
            hall.add(f"rack_{i}/shelf_{level}", _BOX, size, pos, steel)
            for slot, dx in enumerate((-3.0, -1.0, 1.0, 3.0)):
                half = rng.uniform((0.5, 0.4, 0.4), (0.9, 0.6, 0.9))
                tint = boxes[int(rng.integers(len(boxes)))]
                if rng.random() < 0.85:  # else the slot is empty
                    pos = (x + dx, y, deck + 0.06 + half[2])
                    hall.add(f"rack_{i}/box_{4 * level + slot}", _BOX, half, pos, tint)
    for i in range(20):
        x, y = hall.around(1.0, _WIDTH - 6.5) if i < 6 else (rng.uniform(-28, 28), 0.0)
        if i >= 6:
            y = float(rng.choice((-13.7, 13.7)) + rng.uniform(-0.3, 0.3))
        tint = boxes[int(rng.integers(len(boxes)))]
        if i % 2:
            hall.add(f"barrel_{i}/drum", _CYLINDER, (0.4, 0.6, 0), (x, y, 0.6), tint)
        else:
            half = rng.uniform((0.3, 0.3, 0.2), (0.6, 0.6, 0.6))
            hall.add(f"pallet_{i}/deck", _BOX, (0.6, 0.6, 0.07), (x, y, 0.08), pallet)
            hall.add(f"pallet_{i}/box", _BOX, half, (x, y, 0.16 + half[2]), tint)


def attach_gates(spec: mujoco.MjSpec, seed: int = 0) -> None:
    """Put a ring of 8 gates, 5 m wide inside, around the scene `spec`, in place.

    Barriers, cones and stands lie around it. Else as `attach_forest`.
    """
    size: Any
    pos: Any
    track = _Set(spec, "gates", seed)
    rng = track.rng
    track.sun()
    grass = track.material("grass", track.colour(0.36, 0.50, 0.26), "checker", 0.08)
    steel = track.material("steel", track.colour(0.30, 0.31, 0.33), gloss=0.2)
    stand = track.material("stand", track.colour(0.60, 0.61, 0.63), "edge", 0.5)
    tints = [(0.90, 0.30, 0.10), (0.10, 0.42, 0.80), (0.92, 0.80, 0.12), (0.75, 0.12, 0.45)]
    paint = [
        track.material(f"paint_{i}", track.colour(*each), "checker", 1.0)
        for i, each in enumerate(tints)
    ]
    track.add("ground/floor", _PLANE, (150, 150, 1), (0, 0, 0), grass)
    half, bar = _OPENING / 2, 0.25
    for i in range(_GATES):
        angle = 2 * math.pi * i / _GATES + rng.uniform(-0.15, 0.15)
        radius, height = rng.uniform(15.0, 20.0), rng.uniform(5.0, 12.0)
        heading = angle + math.pi / 2 + rng.uniform(-0.3, 0.3)  # anticlockwise round the ring
        tint = paint[int(rng.integers(len(paint)))]
        x, y = radius * math.cos(angle), radius * math.sin(angle)
        left = np.array([-math.sin(heading), math.cos(heading), 0.0])
        centre, turn = np.array([x, y, height]), (0, 0, heading)
        for part, sign in (("left", 1), ("right", -1)):
            pos = centre + sign * (half + bar) * left
            track.add(f"gate_{i}/frame_{part}", _BOX, (0.15, bar, half + 2 * bar), pos, tint, turn)
            foot = (height - half - 2 * bar) / 2
            pos[2] = foot
            track.add(f"gate_{i}/post_{part}", _CYLINDER, (0.1, foot, 0), pos, steel)
        for part, sign in (("top", 1), ("bottom", -1)):
            pos = centre + np.array([0, 0, sign * (half + bar)])
            track.add(f"gate_{i}/frame_{part}", _BOX, (0.15, half, bar), pos, tint, turn)
    for i in range(40):
        x, y = track.around(1.5, 40.0)
        tint, turn = paint[int(rng.integers(len(paint)))], (0, 0, rng.uniform(0, math.pi))
        if i % 2:
            track.add(f"barrier_{i}/block", _BOX, (1.2, 0.25, 0.45), (x, y, 0.45), tint, turn)
        else:
            track.add(f"cone_{i}/body", _ELLIPSOID, (0.3, 0.3, 0.8), (x, y, 0.1), tint)
    for i in range(4):
        away, angle = rng.uniform(34.0, 44.0), math.pi * (i / 2 + 0.25)
        x, y = away * math.cos(angle), away * math.sin(angle)
        for row in range(4):
            out = 1 + 1.5 * row / away
            size, pos = (0.75, 9.0, 0.4 * (row + 1)), (x * out, y * out, 0.4 * (row + 1))
            track.add(f"stand_{i}/row_{row}", _BOX, size, pos, stand, (0, 0, angle))


SCENERIES: Final[dict[str, Callable[[mujoco.MjSpec, int], None]]] = {
    "warehouse": attach_warehouse, "forest": attach_forest, "gates": attach_gates,
}  # fmt: skip
"""What attaches each world that is drawn from a seed."""


def _clear(spec: mujoco.MjSpec) -> None:
    """Hide level ground, delete the sky, switch the lights of the world off; keep the scale."""
    scene = spec.copy()
    scene.compiler.discardvisual = False
    model = scene.compile()
    for geom in spec.worldbody.geoms:
        if geom.type == _PLANE and geom.pos[2] == 0.0:
            geom.group = _HIDDEN_GROUP
    for texture in list(spec.textures):
        if texture.type == _SKY:
            spec.delete(texture)
    for light in spec.worldbody.lights:
        light.active = False
    stat, visual = model.stat, spec.visual  # MuJoCo measures in extents of the scene
    spec.stat.extent, spec.stat.center, spec.stat.meansize = stat.extent, stat.center, stat.meansize
    visual.map.znear, visual.map.zfar = _NEAR / stat.extent, _FAR / stat.extent
    visual.quality.numslices = max(visual.quality.numslices, _ROUNDNESS)
