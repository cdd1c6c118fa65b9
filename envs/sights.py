"""Pictures as observations: which drones take which one when, of the state that a step ended in."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from ..models import scenes_of
from ..models.cameras import FARTHEST, View, cameras_of, chosen_views
from ..models.errors import expect
from ..models.fleet import members_of
from ..sim import Array, WorldState, on_host
from ..sim.random import CAMERAS, SCENES, Streams
from .spec import ArraySpec
from .tasks.task import Task

if TYPE_CHECKING:
    from ..rendering.cameras import Cameras

_MOST_THREADS: Final = 16
_BOUNDS: Final = {"rgb": (0.0, 255.0), "depth": (0.0, FARTHEST), "flow": (-np.inf, np.inf)}


def views_of(task: Task, drones: int) -> tuple[View, ...]:
    """What the option `cameras` of a task chooses. Raises `InputError`."""
    words = task.options.cameras
    kinds = dict.fromkeys(members_of(task.vehicle, drones))
    first, *others = (chosen_views(words, cameras_of(one)) for one in kinds)
    for views in others:
        names = [[view.name for view in some] for some in (first, views)]
        expect(
            names[0] == names[1], "cameras", f"{', '.join(names[0])} of all vehicles", f"{names[1]}"
        )
        for ours, its in zip(first, views, strict=True):
            a, b = ours.camera, its.camera
            same = (ours.shape, a.every, a.carried) == (its.shape, b.every, b.carried)
            same &= a.carried or a == b  # of a world there is one alone
            expected = "one of the same size and rate on all vehicles, or the same in their world"
            expect(same, f"camera {ours.name}", expected, "others")
    return first


def arrays_of(views: Sequence[View], objects: Sequence[str]) -> tuple[ArraySpec, ...]:
    """The arrays of pictures; objects are the names of what a segmentation tells apart."""
    return tuple(
        ArraySpec(
            name=view.name,
            shape=view.shape,
            dtype=view.dtype,
            low=_BOUNDS.get(view.kind, (0.0, 0.0))[0],
            high=_BOUNDS.get(view.kind, (0.0, len(objects) - 1.0))[1],
            unit=view.unit,
            frame=view.frame,
            categories=tuple(objects) if view.kind == "segmentation" else (),
        )
        for view in views
    )


def objects_of_all(scenes: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Names of the objects of several scenes, each once, in the order in which they come."""
    return tuple(dict.fromkeys(name for names in scenes for name in names))


class _Painter(NamedTuple):
    """What draws some worlds when they have one scene: it shares nothing with the others."""

    cameras: "Cameras"
    scene: int
    objects: np.ndarray
    """Numbers of its objects among those of all scenes."""
    worlds: np.ndarray
    """bool, shape (W,)."""


class Sights:
    """The cameras of a loop's drones.

    Threads draw its worlds, as many as there are cores; a world's pictures do not depend on them.
    """

    def __init__(self, task: Task, shape: tuple[int, int]) -> None:
        from ..rendering.cameras import Cameras

        self._task, self._shape, self._rows = task, shape, shape[0] * shape[1]
        self._noise, self._draws = Streams(shape[0], CAMERAS), Streams(shape[0], SCENES)
        self.views = views_of(task, shape[1])
        scenes = scenes_of(task.options.world)
        self._count = len(scenes)
        self._scene = np.zeros(shape[0], int)  # of each world
        self._threads = min(os.cpu_count() or 1, shape[0], _MOST_THREADS)
        parts = np.arange(shape[0]) % -(-self._threads // len(scenes))
        drawn = [
            (number, part, Cameras(
                task.vehicle, self.views, shape, world=scene, marks=task.marks,
                payload=bool(task.effects.get("payload")),
            ))
            for number, scene in enumerate(scenes)
            for part in range(parts.max() + 1)
        ]  # fmt: skip
        names = objects_of_all([cameras.objects for _, _, cameras in drawn])
        self._painters = [
            _Painter(
                cameras,
                number,
                np.array([names.index(one) for one in cameras.objects], np.int32),
                parts == part,
            )
            for number, part, cameras in drawn
        ]
        self._goes = any(mark.moves for mark in task.marks)
        self.arrays = arrays_of(self.views, names)

    @cached_property
    def _pool(self) -> ThreadPoolExecutor:
        """Started with the first picture, so that a process may be forked before."""
        return ThreadPoolExecutor(self._threads, "cameras")

    def close(self) -> None:
        """Free what draws. A second call does nothing."""
        if "_pool" in vars(self):
            self._pool.shutdown()
        for painter in self._painters:
            painter.cameras.close()

    def seed(self, mask: Array, seeds: Sequence[int | None] | Array) -> None:
        """Seed noise and scenes of the drones of a mask, bool, shape (N,); seeds (N,)."""
        drones = self._shape[1]
        ids = np.flatnonzero(_rows(mask, self._rows)[::drones]).tolist()
        for streams in (self._noise, self._draws):
            streams.seed(ids, [seeds[world * drones] for world in ids])

    def look(
        self, state: WorldState, steps: Array, flown: Array | None, begun: Array | None
    ) -> dict[str, Array]:
        """New arrays of all pictures, shape (N, H, W, channels).

        A drone takes one with the first state of an episode, and with every so many control steps
        of it; `flown` and `begun` are masks as of `Loop._look`, `steps` those of the episodes.
        """
        n = self._rows
        everybody = np.ones(n, bool)
        fresh = ~everybody if begun is None else _rows(begun, n).astype(bool)
        flying = everybody if flown is None else _rows(flown, n).astype(bool)
        count = _rows(steps, n)
        due = {
            view.name: fresh | (flying & (count % view.camera.every == 0)) for view in self.views
        }
        names = "position", "quaternion", "velocity", "body_rates"
        told: dict[str, Any] = {name: getattr(state, name) for name in names}
        if state.payload is not None:
            told["payload"] = state.payload
        if self._goes:
            told["goal"] = self._task.goal(state)
        rows = {name: _rows(values, n) for name, values in told.items()}
        pictures: dict[str, Array] = {
            view.name: np.empty((n, *view.shape), view.dtype) for view in self.views
        }
        if self._count > 1:
            for world in np.flatnonzero(fresh.reshape(self._shape).any(axis=1)).tolist():
                self._scene[world] = self._draws.of(world).integers(self._count)

        def paint(one: _Painter) -> None:
            worlds = one.worlds & (self._scene == one.scene)
            one.cameras.take(due, fresh, rows, self._noise.of, worlds)
            mine = np.repeat(worlds, self._shape[1])
            for view in self.views:
                seen = one.cameras.pictures[view.name][mine]
                told = one.objects[seen] if view.kind == "segmentation" else seen
                pictures[view.name][mine] = told

        at_work = [one for one in self._painters if (self._scene[one.worlds] == one.scene).any()]
        for one in at_work:
            one.cameras.open()
        if len(at_work) > 1:
            list(self._pool.map(paint, at_work))
        else:
            paint(at_work[0])
        xp = self._task.xp
        if xp is np:
            return pictures
        return {
            name: xp.asarray(picture, device=state.position.device)
            for name, picture in pictures.items()
        }


def _rows(values: Array, count: int) -> np.ndarray:
    """A row for each drone, on the host."""
    array = on_host(values) if hasattr(values, "detach") else np.asarray(values)
    width = array.size // count
    return array.reshape((count, width) if width > 1 else (count,))
