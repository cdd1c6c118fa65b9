"""Pictures as observations: which drones take which one when, of the state that a step ended in."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..models.cameras import FARTHEST, View, chosen_views
from ..sim.sensors.instruments import Instrument, Moment
from ..sim.state import ByName
from .spec import PICTURE, ArraySpec
from .tasks.task import Task

if TYPE_CHECKING:
    from ..rendering.cameras import Cameras

_MAX_THREADS = 16
_UNITS = {"depth": "m"}
_SEEN = ("position", "quaternion", "payload", "goal")
"""What pictures show of a moment."""


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
            axes=PICTURE,
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


class Pictures(Instrument):
    """The cameras of a loop's drones.

    Threads draw its worlds, as many as there are cores; a world's pictures do not depend on them.

    Args:
        task: Its config chooses the cameras.
    """

    def __init__(self, task: Task) -> None:
        from ..rendering.cameras import Cameras

        self.views = chosen_views(task.config.cameras, task.vehicle.cameras)
        every = {view.name: view.camera.every for view in self.views}
        super().__init__(every, 0, task.config.drawn.most_steps("observation_delay"))
        self._shape = shape = task.shape
        self._period = task.control_period
        scenes = task.config.scene.given_scenes
        threads = min(os.cpu_count() or 1, shape[0], _MAX_THREADS)
        # It starts them with the first picture, so that a process may be forked before.
        self._pool = ThreadPoolExecutor(threads, "cameras")
        parts = np.arange(shape[0]) % -(-threads // len(scenes))
        payload = task.config.effects.payload > 0
        self._painters = []
        for number, one in enumerate(scenes):
            for part in range(parts.max() + 1):
                cameras = Cameras(
                    task.vehicle, self.views, shape, scene=one, marks=task.marks, payload=payload
                )
                self._painters.append(_Painter(cameras, number, parts == part))
        self._names = objects_of_all([painter.cameras.objects for painter in self._painters])

    def close(self) -> None:
        """Free what draws. A second call does nothing."""
        self._pool.shutdown()
        for painter in self._painters:
            painter.cameras.close()

    def read(self, moment: Moment, due: ByName) -> ByName:
        """All pictures, shape (W, A, height, width, channels)."""
        scenes = moment.scenery.numbers
        count = moment.steps.size
        seen = {name: getattr(moment, name) for name in _SEEN}
        state = {name: x.reshape(count, -1) for name, x in seen.items() if x is not None}
        state["time"] = self._period * moment.steps.ravel()
        pictures = {
            view.name: np.zeros((*self._shape, *view.shape), view.dtype) for view in self.views
        }

        def paint(painter: _Painter) -> None:
            worlds = painter.worlds & (scenes == painter.scene)
            mine = {name: (mask & worlds[:, None]).ravel() for name, mask in due.items()}
            painter.cameras.take(mine, state)
            for view in self.views:
                rows = mine[view.name]
                picture = painter.cameras.pictures[view.name][rows]
                if view.kind == "segmentation":
                    numbers = [self._names.index(name) for name in painter.cameras.objects]
                    picture = np.array(numbers, np.int32)[picture]
                pictures[view.name].reshape(-1, *view.shape)[rows] = picture

        painters = []
        for painter in self._painters:
            if (scenes[painter.worlds] == painter.scene).any():
                painter.cameras.open()
                painters.append(painter)
        if len(painters) > 1:
            list(self._pool.map(paint, painters))
        else:
            paint(painters[0])
        return pictures
