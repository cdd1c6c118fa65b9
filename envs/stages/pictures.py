"""Pictures as observations: which drones take which one when, of the state that a step ended in."""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...models.cameras import FARTHEST, View, chosen_views
from ...sim.scenery import Scenery
from ...sim.snapshots import Arrays
from ..spec import ArraySpec
from ..tasks.task import Task
from .record import Record, Stage

if TYPE_CHECKING:
    from ...rendering.cameras import Cameras

_MAX_THREADS = 16
_UNITS = {"depth": "m"}


def arrays_of(views: Sequence[View], objects: Sequence[str]) -> tuple[ArraySpec, ...]:
    """The arrays of pictures; objects are the names of what a segmentation tells apart."""
    highest = {"rgb": 255.0, "depth": FARTHEST, "segmentation": len(objects) - 1.0}
    arrays = []
    for view in views:
        categories = tuple(objects) if view.kind == "segmentation" else ()
        array = ArraySpec(
            name=view.name,
            shape=view.shape,
            dtype=view.dtype,
            low=0.0,
            high=highest[view.kind],
            unit=_UNITS.get(view.kind, ""),
            frame=view.camera.words,
            categories=categories,
        )
        arrays.append(array)
    return tuple(arrays)


def objects_of_all(scenes: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Names of the objects of several scenes, each once, in the order in which they come."""
    return tuple(dict.fromkeys(name for names in scenes for name in names))


class _Painter(NamedTuple):
    """What draws some worlds when they have one scene: it shares nothing with the others."""

    cameras: "Cameras"
    scene: int
    worlds: np.ndarray
    """bool, shape (W,)."""


class Pictures(Stage):
    """The cameras of a loop's drones.

    Threads draw its worlds, as many as there are cores; a world's pictures do not depend on them.

    Args:
        task: Its options choose the cameras.
        scenery: Of the world.
        shape: (W, A).
    """

    arrays = ("pictures",)

    def __init__(self, task: Task, scenery: Scenery, shape: tuple[int, int]) -> None:
        from ...rendering.cameras import Cameras

        self._task = task
        self._shape = shape
        self._scenery = scenery
        self.views = chosen_views(task.config.cameras, task.vehicle.cameras)
        self._scenes = scenery.scene.given_scenes
        threads = min(os.cpu_count() or 1, shape[0], _MAX_THREADS)
        # It starts them with the first picture, so that a process may be forked before.
        self._pool = ThreadPoolExecutor(threads, "cameras")
        parts = np.arange(shape[0]) % -(-threads // len(self._scenes))
        payload = task.config.effects.payload > 0
        self._painters = []
        for number, scene in enumerate(self._scenes):
            for part in range(parts.max() + 1):
                cameras = Cameras(
                    task.vehicle, self.views, shape, scene=scene, marks=task.marks, payload=payload
                )
                self._painters.append(_Painter(cameras, number, parts == part))
        self._names = objects_of_all([painter.cameras.objects for painter in self._painters])
        self._goal_moves = any(mark.moves for mark in task.marks)
        self._blank = {
            view.name: np.zeros((*shape, *view.shape), view.dtype) for view in self.views
        }

    def close(self) -> None:
        """Free what draws. A second call does nothing."""
        self._pool.shutdown()
        for painter in self._painters:
            painter.cameras.close()

    def step(self, record: Record) -> None:
        """Add all pictures to the observations, shape (W, A, height, width, channels).

        A drone takes one with the first state of an episode, and with every so many control steps
        of it; until then it observes its last.
        """
        state = record.state
        begun = False if record.begun is None else record.begun
        flown = True if record.flown is None else record.flown
        due = {}
        for view in self.views:
            again = flown & (record.steps % view.camera.every == 0)
            due[view.name] = np.ravel(begun | again)
        seen = {"position": state.position, "quaternion": state.quaternion}
        if state.payload is not None:
            seen["payload"] = state.payload
        if self._goal_moves:
            seen["goal"] = self._task.goal(state)
        count = record.steps.size
        rows = {name: np.reshape(values, (count, -1)) for name, values in seen.items()}
        last = vars(record).get("pictures", self._blank)
        record.pictures = {name: np.array(picture) for name, picture in last.items()}
        self._take(record.pictures, due, rows, self._scenery.which)
        record.observations = {**record.observations, **record.pictures}

    def _take(
        self,
        pictures: Arrays,
        due: Mapping[str, NDArray[np.bool_]],
        rows: Arrays,
        scenes: NDArray[np.int64],
    ) -> None:
        """Replace the pictures that are due, in worlds of these scenes, (W,)."""

        def paint(painter: _Painter) -> None:
            worlds = painter.worlds & (scenes == painter.scene)
            painter.cameras.take(due, rows, worlds)
            drones = np.repeat(worlds, self._shape[1])
            for view in self.views:
                taken = due[view.name] & drones
                picture = painter.cameras.pictures[view.name][taken]
                if view.kind == "segmentation":
                    numbers = [self._names.index(name) for name in painter.cameras.objects]
                    picture = np.array(numbers, np.int32)[picture]
                pictures[view.name].reshape(-1, *view.shape)[taken] = picture

        painters = []
        for painter in self._painters:
            if (scenes[painter.worlds] == painter.scene).any():
                painter.cameras.open()
                painters.append(painter)
        if len(painters) > 1:
            list(self._pool.map(paint, painters))
        else:
            paint(painters[0])
