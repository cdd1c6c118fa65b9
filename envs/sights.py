"""Pictures as observations: which drones take which one when, of the state that a step ended in."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..models.cameras import FARTHEST, View, cameras_of, chosen_views
from ..models.errors import expect
from ..models.fleet import members_of
from ..sim import Array, WorldState, on_host
from ..sim.random import CAMERAS, Streams
from .spec import ArraySpec
from .tasks.task import Task

_BOUNDS = {"rgb": (0.0, 255.0), "depth": (0.0, FARTHEST), "flow": (-np.inf, np.inf)}


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


class Sights:
    """The cameras of a loop's drones."""

    def __init__(self, task: Task, shape: tuple[int, int]) -> None:
        from ..rendering.cameras import Cameras

        self._task, self._rows, self._drones = task, shape[0] * shape[1], shape[1]
        self._streams = Streams(shape[0], CAMERAS)
        self.views = views_of(task, shape[1])
        self._cameras: Cameras = Cameras(
            task.vehicle,
            self.views,
            shape,
            world=task.options.world,
            marks=task.marks,
            payload=bool(task.effects.get("payload")),
        )
        self._goes = any(mark.moves for mark in task.marks)
        self.arrays = arrays_of(self.views, self._cameras.objects)
        self.close = self._cameras.close

    def seed(self, mask: Array, seeds: Sequence[int | None] | Array) -> None:
        """Seed the noise of the drones of a mask, bool, shape (N,); seeds (N,)."""
        ids = np.flatnonzero(_rows(mask, self._rows)[:: self._drones]).tolist()
        self._streams.seed(ids, [seeds[world * self._drones] for world in ids])

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
        self._cameras.take(due, fresh, rows, self._streams.of)
        pictures: dict[str, Array] = {
            name: picture.copy() for name, picture in self._cameras.pictures.items()
        }
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
