"""What is solid of a scene: primitives as arrays, for rays, planners and physics alike.

World frame: z up, m.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, Self

import mujoco
import numpy as np
from mujoco import MjData, MjModel, MjSpec, mjtGeom
from numpy.typing import ArrayLike, NDArray

from ..models.errors import InputError, shortened
from ..models.fields import Limits, check
from ..models.matrices import settled
from . import HALL_XML, kernels
from .config import SceneConfig, parse_scene, refuse_hidden
from .fields import Table, centered, check_points
from .generators import Draft, drafted
from .motion import REST, offsets
from .obstacles import HULL, OWN, SIZES, Obstacle, hulls_of, obstacles_of

Array = NDArray[np.float64]

MAX_CELLS = 1 << 26
"""Most cells of a grid, which takes 0.5 GB then."""
_ENDLESS = 1e6  # m: half the width of a plane
_SHEET = 5e-4  # m: half the thickness of a plane of a size, which lies below its face
_MARK = 10.0  # m: half the width of level ground; what is smaller is a mark on it
# An unused column of a table is out of reach: its center is far along its first axis.
_NOTHING = np.zeros((kernels.WAYS.stop, 1))
_NOTHING[0] = _ENDLESS
_NOTHING[3] = 1.0
_MARCHES = 60  # steps along a way, each up to the next solid
_TOUCH = 1e-3  # m: a solid that is so near is touched
_CHUNK = 1 << 22  # numbers that a step of `distance` has at once


@dataclass(frozen=True, eq=False)
class Solids:
    """N primitives where they are drawn, from which some move in the course of an episode.

    `Solids.of_scene("forest:3").distance(points)` is how much room there is at some points.
    """

    label: Callable[[], tuple[str, ...]]
    """Gives the names."""
    kinds: NDArray[np.int8]
    """Places in `kernels.KINDS`, shape (N,)."""
    centers: Array
    """m, shape (N, 3)."""
    axes: Array
    """As columns, shape (N, 3, 3)."""
    halves: Array
    """Half the sides of the box about each, along its axes, m, shape (N, 3)."""
    motions: Array
    """As of `motion`, shape (N, 11)."""
    grids: NDArray[np.object_]
    """Of a height field its heights above its center, m, shape (rows, columns), the first row at
    the least y and the first column at the least x; None of another solid. Shape (N,)."""

    @classmethod
    def of_scene(cls, scene: str | SceneConfig) -> "Solids":
        """All that pictures show of a single scene. Raises `InputError`, for meshes too."""
        whole = parse_scene(scene).embedded()
        refuse_hidden(hulls_of(whole.content), "distances")
        return _of_scene(whole)

    @classmethod
    def of_layout(cls, scene: SceneConfig, seed: int) -> "Solids":
        """What stands in one layout of a scene, without level ground at z = 0 and meshes."""
        return _made(scene, seed).standing()

    @classmethod
    def of_drafts(cls, drafts: Sequence[Draft]) -> "list[Solids]":
        """The same of several layouts of a scene, quicker than one by one."""
        scene = drafts[0].scene
        if not scene.is_seeded:
            return [_of_scene(scene).standing()] * len(drafts)
        whole = cls.drawn(drafts)
        owner = np.repeat(np.arange(len(drafts)), [draft.count for draft in drafts])
        ends = np.bincount(owner[whole.stands], minlength=len(drafts)).cumsum().tolist()
        kept = whole.standing()
        layouts = [kept[first:end] for first, end in zip([0, *ends], ends, strict=False)]
        if scene.name == "warehouse":
            return [_hall().standing() + layout for layout in layouts]
        return layouts

    @classmethod
    def drawn(cls, drafts: Sequence[Draft]) -> Self:
        """All parts of drafts of a scene, of one after the other. Raises `InputError`."""
        scene = drafts[0].scene.name
        blocks = [block for draft in drafts for block in draft.blocks]
        rows = np.concatenate((np.empty((8, 0)), *[one.numbers for one in blocks]), axis=1)
        count = rows.shape[1]
        motions = np.zeros((count, len(REST)))
        grids = np.full(count, None)
        first = 0
        for one in blocks:
            if one.motion is not REST:
                motions[first] = one.motion
            if one.grid is not None:
                grids[first] = one.grid
            first += one.numbers.shape[1]
        kinds = rows[0].astype(np.int8)
        half = _halves(kinds, rows[1:4].T)
        furthest = np.maximum(abs(rows[4:]).max(initial=0.0), abs(motions).max(initial=0.0))
        least, largest = half.min(initial=0.0), half.max(initial=0.0)
        if not (furthest <= _ENDLESS and least >= 0.0 and largest <= _ENDLESS):
            raise InputError(
                f"scene: expected sizes, places, turns, motions within 1e6, got others in {scene}"
            )
        return cls(
            label=lambda: tuple(f"{scene}/{name}" for one in blocks for name in one.names()),
            kinds=kinds,
            centers=rows[4:7].T,
            axes=_about_z(rows[7]),
            halves=half,
            motions=motions,
            grids=grids,
        )

    @classmethod
    def of_obstacles(cls, obstacles: Sequence[Obstacle], names: Sequence[str] = ()) -> Self:
        """All but hulls. Without names they have object and part, as those of our scenes."""
        obstacles = [one for one in obstacles if one.kind != HULL]
        count = len(obstacles)
        names = names or [
            f"{OWN}/{one.label or one.kind}_{i}/{one.kind}" for i, one in enumerate(obstacles)
        ]
        kinds = np.array([kernels.KINDS.index(one.kind) for one in obstacles], np.int8)
        places = np.array([one.position for one in obstacles]).reshape(-1, 3)
        axes = np.zeros((count, 3, 3))
        sizes = np.zeros((count, 3))
        middles = np.zeros(count)
        grids = np.full(count, None)
        for i, one in enumerate(obstacles):
            mujoco.mju_quat2Mat(axes[i].reshape(9), np.array(one.attitude))
            sizes[i, : len(one.size)] = one.size
            if one.heights:
                middles[i], grids[i] = centered(np.array(one.heights), sizes[i, 2])
        axes = settled(axes)
        sizes[:, 2] += middles
        return cls(
            label=lambda: tuple(names),
            kinds=kinds,
            centers=places + middles[:, None] * axes[:, :, 2],
            axes=axes,
            halves=_halves(kinds, sizes),
            motions=np.zeros((count, len(REST))),
            grids=grids,
        )

    @classmethod
    def of_model(cls, model: MjModel, which: ArrayLike | None = None) -> Self:
        """Geoms of a model that stand still: those of `which`, bool, or those that can touch.

        Level ground, a plane that can touch, and one without a size have no end; another is a
        sheet. Raises `InputError` for meshes and ellipsoids.
        """
        if which is None:
            which = (model.geom_contype | model.geom_conaffinity) != 0
        stands = model.body_weldid[model.geom_bodyid] == 0
        chosen = np.flatnonzero(stands & which).tolist()
        data = MjData(model)
        mujoco.mj_kinematics(model, data)
        obstacles = [obstacle_of(model, data, geom) for geom in chosen]
        return cls.of_obstacles(obstacles, [_name(model, geom) for geom in chosen])

    @classmethod
    def none(cls) -> "Solids":
        """Nothing."""
        return Solids.of_obstacles(())

    @classmethod
    def ground(cls) -> "Solids":
        """Level ground at z = 0."""
        return Solids.of_obstacles([Obstacle(kind="plane", label="ground")])

    def __len__(self) -> int:
        return len(self.kinds)

    def __add__(self, other: "Solids") -> "Solids":
        """These and others."""
        pairs = [(getattr(self, name), getattr(other, name)) for name in _ARRAYS]
        return Solids(lambda: self.names + other.names, *map(np.concatenate, pairs))

    @property
    def moves(self) -> NDArray[np.bool_]:
        """Which of them move, (N,)."""
        return np.asarray(self.motions.any(axis=1))

    def at(self, time: float) -> "Solids":
        """Where they are at a time of an episode, s."""
        away = offsets(self.motions, np.array([time]))
        return replace(self, centers=self.centers + away)

    @property
    def stands(self) -> NDArray[np.bool_]:
        """Which of them reach above level ground at z = 0, (N,)."""
        reach = (abs(self.axes[:, 2]) * self.halves).sum(axis=1)
        return np.asarray(self.centers[:, 2] + reach > 1e-6)

    def standing(self) -> "Solids":
        """What stands."""
        return self[self.stands]

    def __getitem__(self, which: slice | NDArray[np.bool_]) -> "Solids":
        """Some of them."""
        arrays = [getattr(self, name)[which] for name in _ARRAYS]
        return Solids(lambda: tuple(np.array(self.names, object)[which]), *arrays)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the geoms."""
        return self.label()

    @cached_property
    def table(self) -> Array:
        """As `kernels` has it, shape (16, N)."""
        table = np.empty((kernels.ROWS, len(self)))
        table[:3] = self.centers.T
        table[3:12] = self.axes.transpose(2, 1, 0).reshape(9, -1)
        table[12:15] = self.halves.T
        table[15] = np.where(self.kinds < kernels.CYLINDER, table[12], 0.0)
        tables = [table]
        grids = np.flatnonzero(self.kinds == kernels.HFIELD).tolist()
        for number in grids:
            table[-1, number] = sum(one.shape[1] for one in tables) - number
            tables.append(_columns_of(self.grids[number], self.halves[number]))
        return np.concatenate(tables, axis=1) if grids else table  # no copy: quicker

    @cached_property
    def columns(self) -> NDArray[np.int8]:
        """Kinds of the columns of `table`."""
        kinds = np.full(self.table.shape[1], kernels.REST, np.int8)
        kinds[: len(self)] = self.kinds
        return kinds

    def distance(self, points: ArrayLike) -> Array:
        """From points, (..., 3), m, to the nearest solid, m, (...); below 0 within one.

        Infinite in an empty scene. Where solids overlap, the way out of them may be longer.
        """
        given = numbers("points", points)
        if given.shape[-1:] != (3,):
            raise InputError(f"points: expected shape (..., 3), got {given.shape}")
        rows = given.reshape(-1, 3)
        count = max(1, _CHUNK // max(1, len(self)))
        parts = [
            kernels.distances(self.columns, self.table, rows[first : first + count])
            for first in range(0, len(rows), count)
        ]
        return np.concatenate([np.empty(0), *parts]).reshape(given.shape[:-1])

    def traversability(
        self, radius: float, low: ArrayLike, high: ArrayLike, count: int = 500
    ) -> float:
        """How far a sphere flies straight before it touches a solid, in its radii: the mean.

        It starts where it has room, at `count` random places between the corners `low` and `high`,
        m, in random level directions; a way ends at the border at the latest. A measure of
        difficulty in the way of AvoidBench (H. Yu, G. de Croon and C. De Wagter, 2023); the
        definition is ours. The lower, the harder; 0 where there is no room. The same solids have
        the same number.
        """
        check("radius", Limits(1e-3, 1e3, "m"), radius)
        first, last = numbers("low", low), numbers("high", high)
        rng = np.random.Generator(np.random.PCG64(0))
        places = rng.uniform(first, last, (count, 3))
        turns = rng.uniform(0.0, 2 * np.pi, count)
        has_room = self.distance(places) > radius
        place, turn = places[has_room], turns[has_room]
        if not len(place):
            return 0.0
        ahead = np.stack((np.cos(turn), np.sin(turn), 0.0 * turn), axis=-1)
        border = np.where(ahead > 0.0, last, first)[:, :2] - place[:, :2]
        furthest = (border / ahead[:, :2]).min(axis=1)
        way = np.zeros(len(place))
        for _ in range(_MARCHES):  # no solid is nearer than the distance
            gap = self.distance(place + way[:, None] * ahead) - radius
            way = np.minimum(way + np.where(gap > _TOUCH, gap, 0.0), furthest)
        return float(way.mean() / radius)

    def field(self, low: ArrayLike, high: ArrayLike, cell: float) -> Array:
        """`distance` at the centers of the cells of a grid (an ESDF), shape (X, Y, Z).

        From the corner `low` on, and at least to `high`, m, with cells of a width, m. Where it is
        less than the radius of a craft, the craft has no room: an occupancy grid. Raises
        `InputError`.
        """
        check("cell", Limits(1e-3, 1e3, "m"), cell)
        start, end = numbers("low", low), numbers("high", high)
        if not (start.shape == end.shape == (3,) and (start < end).all()):
            got = f"{shortened(low)} and {shortened(high)}"
            raise InputError(f"low, high: expected two corners, each below the other, got {got}")
        counts = np.maximum(1, np.ceil((end - start) / cell - 1e-9))
        if not counts.prod() <= MAX_CELLS:
            raise InputError(f"cell: expected at most {MAX_CELLS} cells, got {counts.prod():.0f}")
        ticks = [low + cell * (np.arange(n) + 0.5) for low, n in zip(start, counts, strict=True)]
        found = np.empty(counts.astype(int))
        for row, x in zip(found, ticks[0], strict=True):  # a slab at a time
            row[:] = self.distance(np.stack(np.meshgrid(x, *ticks[1:], indexing="ij"), axis=-1)[0])
        return found


def numbers(name: str, given: ArrayLike) -> Array:
    """An array of finite numbers. Raises `InputError`."""
    try:
        array = np.asarray(given, float)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if not np.isfinite(array).all():
        raise InputError(f"{name}: expected finite numbers, got {shortened(given)}")
    return array


_ARRAYS = [one.name for one in fields(Solids)[1:]]


class Layouts(NamedTuple):
    """Solids of S scenes, as `kernels` has them; P is the most that one has."""

    kinds: NDArray[np.int8]
    """Shape (S, P)."""
    tables: NDArray[np.float32]
    """Shape (S, 19, P)."""

    @classmethod
    def of(cls, *scenes: Solids) -> Self:
        """Of scenes in their order."""
        most = max((len(scene.columns) for scene in scenes), default=0)
        layouts = cls.empty(len(scenes), most)
        for number, scene in enumerate(scenes):
            layouts.put(number, scene)
        return layouts

    @classmethod
    def of_balls(cls, centers: Array, radius: float) -> Self:
        """S scenes of balls about centers, m, (..., P, 3)."""
        places = centers.reshape(-1, *centers.shape[-2:])
        layouts = cls.empty(*places.shape[:2])
        unturned = np.ravel(np.eye(3))
        layouts.tables[:, :3] = places.transpose(0, 2, 1)
        layouts.tables[:, 3:12] = unturned[:, None]
        layouts.tables[:, 12 : kernels.ROWS] = radius
        return layouts

    @classmethod
    def empty(cls, count: int, most: int) -> Self:
        """Layouts without solids, each with places for `most` of them."""
        kinds = np.zeros((count, most), np.int8)
        return cls(kinds, np.tile(_NOTHING.astype(np.float32), (count, 1, most)))

    def enlarged(self, count: int, most: int) -> Self:
        """The same with room for more of both."""
        larger = self.empty(count, most)
        scenes, solids = self.kinds.shape
        larger.kinds[:scenes, :solids] = self.kinds
        larger.tables[:scenes, :, :solids] = self.tables
        return larger

    def put(self, number: int, *scenes: Solids) -> None:
        """Set a scene, of all that stands in some, for which there is room."""
        first = 0
        for one in scenes:
            last = first + len(one.columns)
            self.kinds[number, first:last] = one.columns
            self.tables[number, : kernels.ROWS, first:last] = one.table
            first = last
        self.kinds[number, first:] = 0
        self.tables[number, :, first:] = _NOTHING


def _columns_of(grid: Array, half: Array) -> Array:
    """Columns of a table with the numbers of a height field, (16, n)."""
    rows, columns = grid.shape
    along = np.diff(grid, axis=1) * (columns - 1) / (2 * half[0])
    across = np.diff(grid, axis=0) * (rows - 1) / (2 * half[1])
    steep = (along * along).max() + (across * across).max()  # at most, of a triangle
    numbers = np.concatenate(((columns, rows, 1 / np.sqrt(1 + steep)), grid.ravel()))
    whole = np.pad(numbers, (0, -len(numbers) % kernels.ROWS))
    return whole.reshape(-1, kernels.ROWS).T


def _about_z(headings: Array) -> Array:
    """Axes that are turned, (n, 3, 3)."""
    axes = np.zeros((len(headings), 3, 3))
    axes[:, 0, 0] = axes[:, 1, 1] = settled(np.cos(headings))
    axes[:, 1, 0] = settled(np.sin(headings))
    axes[:, 0, 1] = -axes[:, 1, 0]
    axes[:, 2, 2] = 1.0
    return axes


def is_ground(model: MjModel, geom: int) -> bool:
    """Whether a geom is a plane of the world body at z = 0 that faces up."""
    if model.geom_type[geom] != mjtGeom.mjGEOM_PLANE or model.geom_bodyid[geom] != 0:
        return False
    is_level = np.abs(model.geom_quat[geom, 1:3]).max() < 1e-3
    return bool(is_level and model.geom_pos[geom, 2] == 0.0)


def _name(model: MjModel, geom: int) -> str:
    return model.geom(geom).name or f"geom {geom}"


def obstacle_of(model: MjModel, data: MjData, geom: int) -> Obstacle:
    """A geom that is no mesh, where it is; as of `Solids.of_model`. Raises `InputError`."""
    name = _name(model, geom)
    type_ = mjtGeom(model.geom_type[geom])
    kind = type_.name.removeprefix("mjGEOM_").lower()
    size = model.geom_size[geom]
    place = data.geom_xpos[geom]
    axes = data.geom_xmat[geom].reshape(3, 3)
    heights: Table = ()
    if type_ == mjtGeom.mjGEOM_PLANE:
        touches = model.geom_contype[geom] or model.geom_conaffinity[geom]
        is_level = is_ground(model, geom) and size[:2].min() > _MARK
        if not (touches or is_level) and size[0] * size[1]:
            kind = "box"
            size = (*size[:2], _SHEET)
            place = place - _SHEET * axes[:, 2]
    elif type_ == mjtGeom.mjGEOM_HFIELD:
        number = model.geom_dataid[geom]
        size = model.hfield_size[number, [0, 1, 3]]
        heights = _heights(model, number, name)
    elif kind not in kernels.KINDS:
        expected = ", ".join(kernels.KINDS)
        raise InputError(f"scene: expected {expected}, got the {kind} {name}")
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    try:
        return Obstacle(
            kind=kind,
            size=tuple(map(float, size[: SIZES[kind]])),
            heights=heights,
            position=tuple(place.tolist()),
            quaternion=tuple(quaternion.tolist()),
        )
    except InputError as error:
        raise InputError(f"scene: {name}: {error}") from None


def _heights(model: MjModel, number: int, name: str) -> Table:
    """Of a height field, m, to the hundredth of a millimetre."""
    rows, columns = model.hfield_nrow[number], model.hfield_ncol[number]
    check_points(rows, columns, f"scene: {name}")
    first = model.hfield_adr[number]
    data = model.hfield_data[first : first + rows * columns].astype(float)
    heights = (model.hfield_size[number, 2] * data).round(5)
    return tuple(map(tuple, heights.reshape(rows, columns).tolist()))


def _halves(kinds: NDArray[np.int8], sizes: Array) -> Array:
    """Half the sides of boxes about primitives of sizes as MuJoCo has them, m, (n, 3)."""
    a, b, c = sizes.T
    is_round = kinds <= kernels.CYLINDER
    length = np.where(kinds == kernels.SPHERE, 0.0, b) + np.where(kinds == kernels.CYLINDER, 0.0, a)
    half = np.empty((len(kinds), 3))
    half[:, 0] = a
    half[:, 1] = np.where(is_round, a, b)
    half[:, 2] = np.where(is_round, length, c)
    half[kinds == kernels.PLANE] = (_ENDLESS, _ENDLESS, 0.0)
    return half


@lru_cache(maxsize=256)
def _of_scene(scene: SceneConfig) -> Solids:
    return _made(scene, scene.seed)


def _made(scene: SceneConfig, seed: int) -> Solids:
    if scene.is_file:
        obstacles = obstacles_of(scene.embedded().content)
        return Solids.ground() + Solids.of_obstacles(obstacles)
    if scene.is_seeded:
        parts = Solids.drawn([drafted(scene, seed)])
        return _hall() + parts if scene.name == "warehouse" else parts
    from .build import HIDDEN_GROUP, add_scene  # it draws solids

    spec = MjSpec()
    add_scene(spec, scene)
    model = spec.compile()
    return Solids.of_model(model, model.geom_group != HIDDEN_GROUP)


@lru_cache
def _hall() -> Solids:
    spec = MjSpec.from_file(str(HALL_XML))
    for geom in spec.geoms:
        geom.material = ""
    model = spec.compile()
    return Solids.of_model(model, np.ones(model.ngeom, bool))
