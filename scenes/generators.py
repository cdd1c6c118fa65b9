"""Scenes from a seed: a forest, a warehouse, a track of gates, a maze.

World frame: z up, m. A generator draws what stands in a scene from one stream, in one order.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike as Vector
from numpy.typing import NDArray

from ..models.errors import InputError
from ..models.fields import Choice, Limits, check, immutable
from ..models.files import read_own_toml
from .aisles import AislesOptions, aisles
from .config import SceneConfig
from .fields import HillsOptions, centered, hills
from .kernels import BOX, CAPSULE, CYLINDER, HFIELD, KINDS, SPHERE
from .maze import MazeOptions, maze
from .motion import REST
from .options import CLEARANCE, Clear, SceneOptions, Size
from .registry import SceneType, register
from .traffic import TrafficOptions, traffic

Array = NDArray[np.float64]

_MATERIALS = read_own_toml(__file__, "materials")
"""By scene and name."""

_TREES = read_own_toml(__file__, "trees")["kind"]
_COUNTS = np.array([len(tree["crowns"]) for tree in _TREES])  # crowns of each kind of tree
_FIRSTS = np.cumsum(_COUNTS) - _COUNTS
_PARTS = [name for tree in _TREES for name, *_ in tree["crowns"]]
_CROWNS = np.array(
    [[KINDS.index(tree["shape"]), *crown[1:]] for tree in _TREES for crown in tree["crowns"]]
)
"""Kind and numbers of each crown."""
_SHRUB_DENSITY = 1 / 240
_ROCK_DENSITY = 1 / 360
_ROCK_REACH = 1.2  # m
_ENDS = 2.0  # m: radius of the clear spaces at the ends of a forest
_GATES = 8
OPENING = 5.0
"""Width of a gate inside, in a scene of `GATES_SIZE`, m: the paper's craft is 2.8 m wide."""
GATES_SIZE = 50.0  # m
_MOST_PARTS = 1 + int(_COUNTS.max())  # of a tree

Names = Callable[[], Sequence[str]]
Vectors = Array | Sequence[Vector]
"""Three numbers, or arrays of them."""


class Block(NamedTuple):
    """Parts that were added together."""

    names: Names
    numbers: Array
    """Kind, size as MuJoCo has it, m, position, m, and heading, rad, (8, n)."""
    materials: Names
    motion: Sequence[float]
    """Of a single part."""
    grid: Array | None
    """Likewise, as of `Solids`."""


class Draft:
    """Draws the parts of a scene."""

    def __init__(self, scene: SceneConfig, seed: int) -> None:
        self.scene = scene
        self.options = scene.values
        self.openings: list[tuple[float, ...]] = []
        """As the rows of `ways`."""
        self.rng = np.random.Generator(np.random.PCG64(seed))
        self.uniform = self.rng.uniform
        self.blocks: list[Block] = []

    @property
    def count(self) -> int:
        """Parts so far."""
        return sum(block.numbers.shape[1] for block in self.blocks)

    @property
    def ways(self) -> Array:
        """Gates in the order in which they are passed, or ways through rows of racks, shape (K, 6).

        The center, m; x and y of the direction in which it is passed; half the width, m.
        """
        return np.array(self.openings).reshape(-1, 6)

    def choose(self, name: str) -> str:
        """One of the materials of several colours."""
        return self.choices(name, 1)()[0]

    def choices(self, name: str, count: int) -> Names:
        """As many such materials."""
        colours = len(self.scene.type.materials[name]["colours"])
        drawn = self.rng.integers(colours, size=count)
        return lambda: [f"{name}_{one}" for one in drawn.tolist()]

    def around(self, reach: float, far: float) -> tuple[float, float]:
        """A place up to `far`, whose circle of radius `reach` does not touch the clear space."""
        while True:
            x, y = self.rng.uniform(-far, far, 2).tolist()
            if max(abs(x), abs(y)) > CLEARANCE + reach:
                return x, y

    def add(
        self,
        name: str,
        kind: str,
        size: Vectors,
        position: Vectors,
        material: str,
        heading: float = 0.0,
        motion: Sequence[float] = REST,
    ) -> None:
        """Add a part that is turned about z, rad, and moves as of `motion`."""
        number = KINDS.index(check(f"scene: kind of {name}", Choice(KINDS), kind))
        self.add_all(lambda: [name], number, size, position, lambda: [material], heading, motion)

    def add_ground(self, material: str, edge: float = 150.0) -> None:
        """Add level ground, which pictures show up to so far from the origin, m."""
        self.add("ground/floor", "plane", (edge, edge, 1), (0, 0, 0), material)

    def add_all(
        self,
        names: Names,
        kinds: Vector,
        sizes: Vectors,
        positions: Vectors,
        materials: Names,
        headings: Vector = 0.0,
        motion: Sequence[float] = REST,
        grid: Array | None = None,
    ) -> None:
        """Add n parts. Sizes and positions are three numbers or arrays of n; a number is that of
        all parts. A motion or the grid of a height field is that of a single part. Raises
        `InputError` for a motion in a scene that says that nothing moves.
        """
        if motion is not REST and not self.scene.type.moves:
            name = self.scene.name
            raise InputError(f"scene: expected {name} to be registered with moves=True")
        rows = np.empty((8, np.size(positions[0])))
        rows[0] = kinds
        rows[1], rows[2], rows[3] = sizes
        rows[4], rows[5], rows[6] = positions
        rows[7] = headings
        self.blocks.append(Block(names, rows, materials, motion, grid))

    def add_heights(
        self, name: str, half: Array, heights: Array, depth: float, material: str
    ) -> None:
        """Add a height field about the z axis: half its width along x and along y, m; heights above
        z = 0, m, (rows, columns), and how deep it is below it, m.
        """
        center, grid = centered(heights, depth)
        size = (*half, depth + center)
        place = (0, 0, center)
        self.add_all(lambda: [name], HFIELD, size, place, lambda: [material], grid=grid)


@immutable
class ForestOptions(Clear):
    """Options of the scene `forest`."""

    density: Annotated[float, Limits(1e-4, 0.5, "1/m²")] = 0.0076
    """Trees per square metre."""
    size: Size = (120.0, 120.0)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Trees, shrubs and rocks."""
        wide, deep = self.size
        densities = (self.density, _SHRUB_DENSITY, _ROCK_DENSITY)
        trees, shrubs, rocks = (round(wide * deep * density) for density in densities)
        return trees, shrubs, rocks

    @property
    def most(self) -> int:
        """As `SceneOptions.most`."""
        trees, shrubs, rocks = self.counts
        return _MOST_PARTS * trees + shrubs + rocks + 1


def forest(wood: Draft) -> None:
    """A wood: trees, shrubs and rocks. Its crowns are over 4 m high."""
    options: ForestOptions = wood.options
    wide, deep = options.size
    area = wide * deep
    trees, shrubs, rocks = options.counts
    green = trees + shrubs
    edge = max(150.0, wide, deep)
    wood.add_ground("ground", edge)
    drawn = wood.rng.random((green + rocks, 6))
    leaves = wood.choices("leaves", green)
    kinds = (drawn[:trees, 3] * len(_TREES)).astype(int)
    room = min(1.0, 0.16 * math.sqrt(area / max(1, trees)))  # crowns of a dense wood are narrow
    tall = 9.5 + 6.5 * drawn[:trees, 0]
    spread = room * (1.4 + 1.6 * drawn[:trees, 1])
    trunk = 0.2 + 0.3 * drawn[:trees, 2]
    aside = (0.6 * drawn[:trees, 4:].T - 0.3) * spread
    radii = 0.4 + 0.8 * drawn[trees:green, 0]
    sides = 0.3 + 0.7 * drawn[green:, :3]
    narrow = trunk if wood.options.clear == "ends" else 1.1 * spread
    reach = np.concatenate((narrow, radii, np.full(rocks, _ROCK_REACH)))
    x, y = _places(wood, reach)
    bark = lambda: [f"bark_{kind % 2}" for kind in kinds.tolist()]  # noqa: E731
    wood.add_all(
        lambda: [f"tree_{i}/trunk" for i in range(trees)],
        CYLINDER, (trunk, 0.3 * tall, trunk), (x[:trees], y[:trees], 0.3 * tall), bark,
    )  # fmt: skip
    _add_crowns(wood, kinds, tall, spread, (x, y), aside, leaves)
    wood.add_all(
        lambda: [f"shrub_{i}/crown" for i in range(shrubs)],
        SPHERE, (radii,) * 3, (x[trees:green], y[trees:green], 0.1 * radii),
        lambda: leaves()[trees:],
    )  # fmt: skip
    wood.add_all(
        lambda: [f"rock_{i}/stone" for i in range(rocks)],
        BOX, 0.8 * sides.T, (x[green:], y[green:], 0.2 * sides[:, 2]),
        lambda: ["stone"] * rocks, math.pi * drawn[green:, 3],
    )  # fmt: skip


def _add_crowns(
    wood: Draft, kinds: Array, tall: Array, spread: Array, places: Sequence[Array], aside: Array,
    leaves: Names,
) -> None:  # fmt: skip
    """Add the crowns of all trees; the kind of a tree says how many it has."""
    counts = _COUNTS[kinds]
    tree = np.repeat(np.arange(len(kinds)), counts)
    first = np.cumsum(counts) - counts
    row = np.arange(len(tree)) + (_FIRSTS[kinds] - first)[tree]
    shape, side, height, half_width, by_width, by_height = _CROWNS.T[:, row]
    wide, high = spread[tree], tall[tree]
    radius = half_width * wide
    half = by_width * wide + by_height * high
    half = np.where(shape == CAPSULE, np.maximum(1e-3, half - radius), half)
    x, y = (place[tree] + side * away[tree] for place, away in zip(places, aside, strict=True))
    wood.add_all(
        lambda: [f"tree_{i}/{_PARTS[k]}" for i, k in zip(tree.tolist(), row.tolist(), strict=True)],
        shape, (radius, half, half), (x, y, height * high),
        lambda: list(map(leaves().__getitem__, tree.tolist())),
    )  # fmt: skip


def _places(wood: Draft, reach: Array) -> Array:
    """Places in the wood, (2, n), whose circles of radius `reach` touch no clear space."""
    wide, deep = wood.options.size
    half = np.array([[wide / 2], [deep / 2]])
    has_ends = wood.options.clear == "ends"
    places = np.empty((2, len(reach)))
    left = np.arange(len(reach))
    while left.size:
        places[:, left] = drawn = half * (2.0 * wood.rng.random((left.size, 2)).T - 1.0)
        x, y = abs(drawn)
        if has_ends:
            x = x - (wide / 2 - _ENDS)
            room = _ENDS - np.sqrt(x * x + y * y)
        else:
            room = CLEARANCE - np.maximum(x, y)
        left = left[room > -reach[left]]
    return places


def warehouse(hall: Draft) -> None:
    """Racks, pallets and barrels along the walls of a hall of 60 m by 40 m, 24 m high."""
    racks = [(x, y) for y in (-16.5, -11.0, 11.0, 16.5) for x in (-20.0, -7.0, 7.0, 20.0)]
    for i, (x, y) in enumerate(racks):
        _fill_rack(hall, f"rack_{i}", x, y)
    for i in range(20):
        _add_goods(hall, i)


def _fill_rack(hall: Draft, name: str, x: float, y: float) -> None:
    """Boxes on the three shelves of a rack."""
    for level in range(3):
        deck = 0.3 + 2.3 * level
        for slot, dx in enumerate((-3.0, -1.0, 1.0, 3.0)):
            half = hall.rng.uniform((0.5, 0.4, 0.4), (0.9, 0.6, 0.9))
            tint = hall.choose("box")
            if hall.rng.random() < 0.85:  # else the slot is empty
                position = (x + dx, y, deck + 0.06 + half[2])
                hall.add(f"{name}/box_{4 * level + slot}", "box", half, position, tint)


def _add_goods(hall: Draft, number: int) -> None:
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


@immutable
class GatesOptions(SceneOptions):
    """Options of the scene `gates`."""

    size: Size = (GATES_SIZE, GATES_SIZE)
    """Of a square of gates, which grow with it: those of 50 m are 5 m wide."""

    def check(self) -> None:
        """As `SceneOptions.check`."""
        if len(set(self.size)) > 1:
            raise InputError(f"scene: expected a square of gates, got {self.size}")

    @property
    def scale(self) -> float:
        """1 of 50 m."""
        return self.size[0] / GATES_SIZE

    @property
    def room(self) -> float:
        """As `SceneOptions.room`."""
        return CLEARANCE * self.scale


def gates(track: Draft) -> None:
    """A ring of 8 gates, 5 m wide inside, with barriers, cones and stands around it.

    All but the ground has the scale of the scene.
    """
    track.add_ground("grass")
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
    for block in track.blocks[1:]:
        block.numbers[1:7] *= track.options.scale


def _add_gate(track: Draft, number: int) -> None:
    half = OPENING / 2
    bar = 0.25
    angle = 2 * math.pi * number / _GATES + track.uniform(-0.15, 0.15)
    radius = track.uniform(15.0, 20.0)
    height = track.uniform(5.0, 12.0)
    heading = angle + math.pi / 2 + track.uniform(-0.3, 0.3)  # anticlockwise round the ring
    tint = track.choose("paint")
    x = radius * math.cos(angle)
    y = radius * math.sin(angle)
    scale = track.options.scale
    center = (scale * x, scale * y, scale * height)
    track.openings.append((*center, math.cos(heading), math.sin(heading), scale * half))
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


@lru_cache(maxsize=4)
def drafted(scene: SceneConfig, seed: int) -> Draft:
    """What is drawn in a scene from a seed. Raises `InputError`."""
    draft = Draft(scene, seed)
    draw = scene.type.draw
    if draw is None:
        return draft
    draw(draft)
    most = scene.values.most
    if draft.count > most:
        got = draft.count
        raise InputError(f"scene: expected at most {most} parts of {scene.name}, got {got}")
    return draft


def _register(name: str, draw: Callable[[Draft], None], **more: Any) -> None:
    register(name, SceneType(draw=draw, materials=_MATERIALS[name], **more))


_register("forest", forest, options=ForestOptions)
_register("warehouse", warehouse)
_register("gates", gates, options=GatesOptions)
_register("aisles", aisles, options=AislesOptions)
_register("maze", maze, options=MazeOptions)
_register("hills", hills, options=HillsOptions)
_register("traffic", traffic, options=TrafficOptions, moves=True)
