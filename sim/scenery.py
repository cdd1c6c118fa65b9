"""What stands around drones: the layout of each world, and distances to its solids."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from mujoco import mjtGeom
from numpy.typing import NDArray

from ..models.errors import InputError
from ..models.vehicle import Vehicle, can_touch, craft_geoms
from ..scenes import SceneConfig, kernels
from ..scenes.config import NEW_SEEDS, refuse_hidden
from ..scenes.generators import drafted
from ..scenes.motion import REST, offsets
from ..scenes.obstacles import hulls_of
from ..scenes.solids import Layouts, Solids
from .compile import Untraceable
from .compile.tracer import call_outside
from .random import SCENES, Draw, Random
from .snapshots import Arrays, Kept, Snapshot
from .state import FAR, Array, ByName, clip, is_traced, looked_up, parts_of, stack

_FURTHEST = 1e5  # m: of a craft that is lost


class Frozen(NamedTuple):
    """Layouts that stay as they are."""

    shared: ByName
    """As of `Scenery.shared`."""
    layouts: Layouts
    """To which its addresses lead."""


class Scenery(Kept):
    """Layouts of W worlds. The first solid of each is level ground, which rays see, and no distance
    knows: it is physics of its own.

    Attributes:
        scene: What is laid out.
        given: Seeds of the given layouts; none where each episode has a new one.
        most: Most solids of a layout, as `solids` has them.
        seeds: Of each world's layout, int64, shape (W,).
        layouts: Solids of all layouts in use.
        which: Number of each world's layout, shape (W,).
        moves: Whether solids move.
        hidden: Names as of `solids_around`.
        rows: As of `rows_of`; traced while code is compiled.
        openings: Of each world's layout, as of `generators.Draft.ways`, shape (W, K, 6); traced
            likewise.
    """

    arrays = ("seeds",)

    def __init__(
        self,
        scene: SceneConfig,
        own: Solids,
        worlds: int,
        hidden: Sequence[str] = (),
        thrown: Solids | None = None,
    ) -> None:
        """`own`: what stands in every layout, of the vehicle's file; `thrown`: what `move` throws
        there.
        """
        self._thrown = thrown or Solids.none()
        self.scene = scene
        self.hidden = hidden
        self.moves = scene.type.moves or len(self._thrown) > 0
        self.given = [one.seed for one in scene.given_scenes]
        self.seeds: Array = np.full(worlds, self.given[0] if self.given else -1, np.int64)
        self.which: Array = np.zeros(worlds, np.int64)
        self._always = Solids.ground() + own
        laid = [self.solids(seed) for seed in self.given]
        self.most: int = max(map(len, laid), default=scene.values.most + len(self._thrown))
        self.layouts = Layouts.of(*[self._always + one for one in laid])
        self.openings: Array = np.zeros((worlds, *drafted(scene, 0).ways.shape))
        opened = [drafted(scene, seed).ways for seed in self.given]
        self._openings = np.array([self._checked(one) for one in opened])
        if self.moves:  # each world has a time of its own
            self._motions = np.zeros((worlds, self.most, len(REST)))
            self._places = np.zeros((worlds, self.most, 3))
            self.layouts = Layouts.empty(worlds, len(self._always.columns) + self.most)
            self.which = np.arange(worlds)
            self._lay(np.flatnonzero(self.seeds >= 0))
        self.rows: Array
        self._frozen: Frozen | None
        self._point()

    def __bool__(self) -> bool:
        """Whether anything may stand there."""
        return not self.given or self.layouts.kinds.shape[1] > 1

    def solids(self, seed: int) -> Solids:
        """What stands in a layout, without ground and `own`."""
        return self._thrown + Solids.of_layout(self.scene, seed)

    @property
    def varies(self) -> bool:
        """Whether episodes differ in their layouts, or times in one."""
        return len(self.given) != 1 or self.moves

    @property
    def numbers(self) -> Array:
        """Which of the given scenes each world has, shape (W,)."""
        return np.searchsorted(self.given, self.seeds)

    def snapshot(self) -> Snapshot:
        """Copies by name: nothing where all have the same layout."""
        return super().snapshot() if self.varies else {}

    def begin(self, random: Random, mask: Array, ahead: int = 0) -> None:
        """Draw the layouts of the worlds of a mask, bool, (W, A), as of `Draw`. Compiled code does
        not draw: it gets the seeds.
        """
        if not self.varies or is_traced(mask):
            return
        share = Draw(random, SCENES, mask, ahead).uniform(0.0, 1.0)[:, 0]
        if self.given:
            drawn = looked_up(np.array(self.given), np.floor(share * len(self.given)))
        else:
            number = np.floor(share * NEW_SEEDS).astype(np.int64)
            drawn = 2 * number + (self.scene.layouts == "unseen")
        self.take(np.where(mask[:, 0], drawn, self.seeds))
        self.move(mask, np.zeros(len(mask)))

    def take(self, seeds: Array) -> None:
        """Give worlds the layouts of these seeds, shape (W,)."""
        old, self.seeds = self.seeds, seeds
        if is_traced(seeds):
            return
        if self.given and not self.moves:
            self.which = self.numbers
        else:
            self._lay(np.flatnonzero((seeds != old) & (seeds >= 0)))
        self._point()

    def move(self, mask: Array, time: Array, starts: Array | None = None) -> None:
        """Solids of the worlds of a mask, (W, A), go from where they are to where they are at times
        of their episodes, s, (W,): straight ahead. What is thrown starts at times, s, (W, T).
        """
        if not self.moves:
            return
        self._frozen = None
        if starts is not None:
            self._motions[:, : len(self._thrown), 3] = starts
        rows = np.flatnonzero(mask[:, 0])
        centers = self._places[rows] + offsets(self._motions[rows], time[rows, None])
        centers = centers.transpose(0, 2, 1)
        self.ways[rows] = centers - self.centers[rows]
        self.centers[rows] = centers

    def restore(self, arrays: Arrays) -> None:
        """Put a snapshot back."""
        if self.varies:
            self.take(arrays["seeds"].copy())

    def shared(self) -> ByName:
        """What compiled code reads of each world, by the names of attributes, (W, ...)."""
        shared = {"rows": self.rows} if self else {}
        if self.openings.size:
            shared["openings"] = self.openings
        return shared

    def frozen(self) -> Frozen:
        """A copy of what stands there now, until something moves or is laid out."""
        if self._frozen is None:
            kinds, tables = self.layouts
            layouts = Layouts(kinds.copy(), tables.copy())
            shared = {name: array.copy() for name, array in self.shared().items()}
            if self:
                shared["rows"] = rows_of(layouts, self.which)
            self._frozen = Frozen(shared, layouts)
        return self._frozen

    def distance(
        self, position: Array, due: Array = None, left: float = 0.0, radius: float = 0.0
    ) -> Array:
        """From positions, (W, A, 3), to the nearest solid, m, float32, (W, A): at most `FAR`.

        Only where `due`, bool, (W, A), is true, elsewhere 0, and then without a derivative; None
        is all. While a share of their ways is `left` to solids that move, with a radius, as of
        `kernels`. Raises `InputError` where solids are hidden.
        """
        refuse_hidden(self.hidden, "a task that reads distances")
        near = _single(position)
        left = left if self.moves else 0.0
        if not self:
            return np.zeros_like(near[..., 0]) + np.float32(FAR)
        if due is not None:
            near = _held(near)
        mask = near[..., 0] == near[..., 0] if due is None else due
        if is_traced(near):
            return self._called("nearest", mask, stack([*parts_of(near), left, radius]))
        found = np.zeros(mask.shape, np.float32)
        code = kernels.compiled()
        run = code.gaps if code else kernels.gaps_by_numpy
        points = np.ascontiguousarray(near)
        run(*self.layouts, self.which, points, mask, np.float32(left), np.float32(radius), found)
        return clip(found, np.float32(-FAR), np.float32(FAR))

    def touched(self, position: Array, radius: float) -> str:
        """Name of the first solid but the ground that a sphere touches in the first world."""
        solids = self._always + self.solids(int(self.seeds[0]))
        for number, name in enumerate(solids.names[1:], 1):
            if solids[number : number + 1].distance(position) <= radius:
                return name
        return next(iter(self.hidden), "a solid")

    def along(self, position: Array, direction: Array) -> Array:
        """From positions along unit vectors, (W, A, 3), to the first solid, as `distance`.

        Without a derivative, which has no bound where a ray grazes an edge.
        """
        near = _held(_single(position))
        ray = _held(_single(direction))
        if is_traced(near):
            return self._called("first", near[..., 0] == near[..., 0], near, ray)
        kinds, tables = self.layouts
        found = np.empty(near.shape[:-1], np.float32)
        for world, layout in enumerate(self.which.tolist()):
            found[world] = kernels.first_by_numpy(
                kinds[layout], tables[layout], near[world].T, ray[world].T
            )
        return np.minimum(found, np.float32(FAR))

    def _called(self, function: str, mask: Array, *vectors: Array) -> Array:
        """What compiled code gives for each drone of a mask, (W, A)."""
        code = kernels.compiled()
        if code is None:
            raise Untraceable("a scene needs Numba, which the extra `fast` brings")
        layout = [row[:, None] for row in parts_of(self.rows)]
        numbers = [number for vector in vectors for number in parts_of(vector)]
        return clip(
            call_outside(getattr(code, function).address, mask, *layout, *numbers), -FAR, FAR
        )

    def _lay(self, worlds: NDArray[np.int64]) -> None:
        """Lay out what these worlds have: each has a row of its own."""
        if not worlds.size:
            return
        count = len(self.seeds)
        drafts = [drafted(self.scene, seed) for seed in self.seeds[worlds].tolist()]
        self.openings[worlds] = [self._checked(draft.ways) for draft in drafts]
        layouts = [self._thrown + solids for solids in Solids.of_drafts(drafts)]
        made = dict(zip(worlds.tolist(), layouts, strict=True))
        old = self.layouts.kinds
        largest = max(len(one.columns) for one in made.values())
        most = max(old.shape[1], len(self._always.columns) + largest)
        if old.shape != (count, most):
            self.layouts = self.layouts.enlarged(count, most)
            self.which = np.arange(count)
        for world, solids in made.items():
            self.layouts.put(world, self._always, solids)
            if self.moves:
                self._motions[world, : len(solids)] = solids.motions
                self._motions[world, len(solids) :] = REST
                self._places[world] = self.centers[world].T

    def _checked(self, found: Array) -> Array:
        """Openings of a layout. Raises `InputError` unless there are as many as in all others."""
        if found.shape != self.openings.shape[1:]:
            raise InputError(
                f"scene: expected {self.openings.shape[1]} openings in each layout of "
                f"{self.scene.name}, got {len(found)}"
            )
        return found

    @property
    def centers(self) -> Array:
        """Centers of what stands in the layouts, a view, (S, 3, P)."""
        return self._rows(slice(3))

    @property
    def ways(self) -> Array:
        """Its ways in the control step that ends there, m, a view, (S, 3, P)."""
        return self._rows(kernels.WAYS)

    def _rows(self, rows: slice) -> Array:
        first = len(self._always.columns)
        return self.layouts.tables[:, rows, first : first + self.most]

    def _point(self) -> None:
        """Set `rows`, and the openings of given layouts."""
        if self.given and not self.moves:
            self.openings = self._openings[self.which]
        self.rows = rows_of(self.layouts, self.which)
        self._frozen = None


def rows_of(layouts: Layouts, which: Array) -> NDArray[np.uint64]:
    """Of each world's layout how many primitives it has, and the addresses of their kinds and of
    their table, (W, 3).
    """
    rows = np.empty((len(which), 3), np.uint64)
    rows[:, 0] = layouts.kinds.shape[1]
    arrays: tuple[Array, Array] = layouts
    for column, array in enumerate(arrays, 1):
        rows[:, column] = array.ctypes.data + array[:1].nbytes * which
    return rows


def _held(vectors: Array) -> Array:
    """The same float32, which derivatives take as constants: whole numbers have none."""
    return vectors.view(np.int32).view(np.float32)


def _single(vectors: Array) -> Array:
    return clip(vectors, -_FURTHEST, _FURTHEST).astype(np.float32)


def solids_around(vehicle: Vehicle, scene: SceneConfig) -> tuple[Solids, Sequence[str]]:
    """Obstacles of a vehicle's file, in place of which a scene's file stands.

    And names of what collides on `mujoco` alone, for distances and rays do not know it: meshes of
    either file, and obstacles of a vehicle's that move.
    """
    if scene.is_file:
        return Solids.none(), list(hulls_of(scene.embedded().content))
    model = vehicle.model
    ours = craft_geoms(model)
    which = ~ours & can_touch(model, ours)
    stands = model.body_weldid[model.geom_bodyid] == 0
    known = which & stands & (model.geom_type != mjtGeom.mjGEOM_MESH)
    hidden = np.flatnonzero(which & ~known).tolist()
    names = [model.geom(i).name or f"geom {i} of the vehicle" for i in hidden]
    return Solids.of_model(model, known).standing(), names
