"""The world as it is looked at: craft, targets, paths and cameras."""

import copy
import math
from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Final, Literal, get_args

import mujoco
import numpy as np

from ..models import QUAD_XML, SCENE_XML, attach_airport
from .moment import Moment

__all__ = ["CAMERAS", "WORLDS", "Camera", "NextGeom", "Stage", "World", "scene_geoms"]

Camera = Literal["chase", "front", "side", "top", "onboard"]
World = Literal["airport", "plain"]
CAMERAS: Final[tuple[Camera, ...]] = get_args(Camera)
WORLDS: Final[tuple[World, ...]] = get_args(World)

NextGeom = Callable[[], mujoco.MjvGeom | None]
"""Gives a geom to be filled in, or None where there is no more room."""

_SPACING: Final = 4.0
"""Between craft that fly side by side, m."""
_TRAIL: Final = 150
"""Control steps that a path reaches back."""
_EVERY: Final = 3
"""Control steps of one piece of a path."""
_DISC = (0.13, 0.78, 0.52, 0.30)
_PATH = (1.0, 0.85, 0.25)
_LOWER: Final = 0.75
"""How far below the target front and side look, m: the strip of E covers the picture's lower end,
and a craft 3 m below its target is still above it."""
_VIEWS: Final[dict[str, tuple[float, float, float]]] = {
    "chase": (0.0, -17.0, 7.0),
    "front": (180.0, -7.0, 12.5),  # from a little above the target: its disc is seen
    "side": (90.0, -7.0, 12.5),
    "top": (0.0, -89.9, 10.0),
}
"""Azimuth and elevation in degrees, distance in m."""


class Stage:
    """Craft over an airport or a plain floor. It flies nothing: it shows what was flown.

    Args:
        world: `airport` or `plain`.
        drones: Craft side by side, each with a target and a path.
        trail: Whether paths are drawn.

    Attributes:
        model: With everything that is only looked at.
        data: Poses of what was shown last.
        moments: What was shown last.
    """

    def __init__(self, world: World = "airport", drones: int = 1, *, trail: bool = True) -> None:
        if world not in WORLDS:
            raise ValueError(f"world: expected {' or '.join(WORLDS)}, got {world!r}")
        if drones < 1:
            raise ValueError(f"drones: expected 1 or more, got {drones}")
        self.drones = drones
        self._offsets = _grid(drones)
        self.model = _compile(world, self._offsets)
        self.data = mujoco.MjData(self.model)
        self.moments: tuple[Moment, ...] = ()
        self._paths: list[deque[np.ndarray]] = [
            deque(maxlen=_TRAIL // _EVERY if trail else 0) for _ in range(drones)
        ]
        mujoco.mj_forward(self.model, self.data)

    def twin(self) -> "Stage":
        """A stage of the same model, with poses and paths of its own: one canvas draws both."""
        twin = copy.copy(self)
        twin.data, twin.moments = mujoco.MjData(self.model), ()
        twin._paths = [deque(maxlen=path.maxlen) for path in self._paths]
        mujoco.mj_forward(twin.model, twin.data)
        return twin

    def show(self, *moments: Moment) -> None:
        """Put every craft where its moment has it, and go on with its path."""
        if len(moments) != self.drones:
            raise ValueError(f"moments: expected {self.drones}, got {len(moments)}")
        before, self.moments = self.moments or moments, moments
        poses = self.data.qpos.reshape(self.drones, 7)
        for i, (moment, last) in enumerate(zip(moments, before, strict=True)):
            pose, path = poses[i], self._paths[i]
            pose[:] = moment.qpos
            pose[:2] += self._offsets[i]
            if moment.step == 0 or moment.step < last.step or moment.episode != last.episode:
                path.clear()
            if moment.step // _EVERY != last.step // _EVERY or not path:  # steps may be left out
                path.append(pose[:3].copy())
        self.data.ctrl[:] = np.concatenate([moment.thrusts for moment in moments])
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)  # what cameras and lights follow
        mujoco.mj_camlight(self.model, self.data)

    def camera(self, name: Camera) -> mujoco.MjvCamera:
        """Where to look from now. All but `onboard` see every craft; front and side stand still."""
        camera = mujoco.MjvCamera()
        if name == "onboard":
            camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            camera.fixedcamid = self.model.camera("onboard").id
            return camera
        if name not in _VIEWS:
            raise ValueError(f"camera: expected one of {', '.join(CAMERAS)}, got {name!r}")
        centres = self.data.qpos.reshape(self.drones, 7)[:, :3]
        camera.lookat[:] = centres.mean(axis=0)
        if name in ("front", "side") and self.moments:
            target = sum(moment.target for moment in self.moments) / self.drones
            camera.lookat[2] = max(target - _LOWER, 0.0)  # the camera stays above the ground
        camera.azimuth, camera.elevation, camera.distance = _VIEWS[name]
        camera.distance += np.ptp(self._offsets, axis=0).max()
        return camera

    def decorate(self, next_geom: NextGeom, *, discs: bool = True) -> None:
        """Add the discs that mark the targets, unless they are not wanted, and the fading paths."""
        for moment, offset, path in zip(self.moments, self._offsets, self._paths, strict=False):
            here = moment.qpos[:3] + np.array((*offset, 0.0))
            if discs:
                _disc(next_geom, np.array((here[0], here[1], moment.target)))
            points = [*path, here]
            for number, (start, end) in enumerate(pairwise(points), 1):
                _piece(next_geom, start, end, number / len(path))


def scene_geoms(scene: mujoco.MjvScene) -> NextGeom:
    """What gives the next free geom of a scene."""

    def next_geom() -> mujoco.MjvGeom | None:
        if scene.ngeom == scene.maxgeom:
            return None
        scene.ngeom += 1
        return scene.geoms[scene.ngeom - 1]

    return next_geom


def _compile(world: World, offsets: Sequence[tuple[float, float]]) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(SCENE_XML))
    if world == "airport":
        attach_airport(spec)
    elif len(offsets) == 1:
        spec.visual.map.shadowclip = 0.6  # further out the floor would shade itself, in speckles
    # Above the canopy and a little downwards: nose, front rotors and horizon are in the picture.
    spec.body("quad").add_camera(
        name="onboard", pos=(0.05, 0.0, 0.45), xyaxes=(0, -1, 0, 0.30, 0, 0.954), fovy=70
    )
    for number in range(1, len(offsets)):
        frame = spec.worldbody.add_frame(pos=(*offsets[number], 0.0))
        spec.attach(mujoco.MjSpec.from_file(str(QUAD_XML)), frame=frame, prefix=f"{number}/")
    # Software draws them too: finer ones cost more than they show.
    spec.visual.quality.shadowsize = min(spec.visual.quality.shadowsize, 2048)
    spec.visual.quality.offsamples = 4
    return spec.compile()


def _grid(drones: int) -> list[tuple[float, float]]:
    """Places of so many craft, x and y in m: rows as square as can be, the first at the origin."""
    columns = math.isqrt(drones - 1) + 1
    return [(-_SPACING * (i // columns), -_SPACING * (i % columns)) for i in range(drones)]


def _disc(next_geom: NextGeom, centre: np.ndarray) -> None:
    size = (1.7, 0.006, 0.0)  # radius, half of its height
    _decoration(next_geom, mujoco.mjtGeom.mjGEOM_CYLINDER, size, centre, _DISC)


def _piece(next_geom: NextGeom, start: np.ndarray, end: np.ndarray, freshness: float) -> None:
    kind, rgba = mujoco.mjtGeom.mjGEOM_CAPSULE, (*_PATH, 0.85 * freshness)
    if not np.array_equal(start, end):
        geom = _decoration(next_geom, kind, (1.0, 1.0, 1.0), start, rgba)
        if geom is not None:
            mujoco.mjv_connector(geom, kind, 0.035, start, end)


def _decoration(
    next_geom: NextGeom,
    kind: mujoco.mjtGeom,
    size: tuple[float, ...],
    centre: np.ndarray,
    rgba: tuple[float, ...],
) -> mujoco.MjvGeom | None:
    """A geom that casts no shadow; None where there is no more room."""
    if (geom := next_geom()) is not None:
        color = np.array(rgba, np.float32)
        mujoco.mjv_initGeom(geom, kind, np.array(size), centre, np.eye(3).ravel(), color)
        geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    return geom
