"""Moments of flights, the stage that shows them with goals, paths and cameras, and its pictures."""

import math
from collections import deque
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, get_args

import mujoco
import numpy as np
from mujoco import MjModel, MjvScene, mjtGeom
from numpy.typing import ArrayLike

from ..models.cameras import place_cameras
from ..models.errors import InputError, one_line, shortened
from ..models.fields import Limits, check_fields, immutable
from ..models.files import read_own_toml
from ..models.fleet import load_vehicles, members_of
from ..models.mjcf import swarm_spec
from ..models.swarm import drone_names
from ..models.vehicle import owners, radius_of
from ..scenes import SceneConfig
from ..scenes.build import SCENE_PREFIX, add_scene, move_geoms
from ..scenes.marks import Mark, Point
from ..scenes.returns import Reading
from .gl import Lines, Offscreen

Array = np.ndarray

Camera = Literal["chase", "front", "side", "top", "onboard"]
CAMERAS = get_args(Camera)

_MAX_METRICS = 4  # with a line of their own
_TRAIL = 150  # control steps of a path
_EVERY = 3  # control steps of one piece of it
LOOKS = read_own_toml(__file__, "looks")
"""Colours and views of a stage."""
MAX_NAMES = 16
"""Drones of one world whose names are shown; more would hide them."""
_FAR_POINT = 0.004  # by how much points are larger, per distance
_FEW = 64  # rays that are drawn whole, not only where they end
_ONBOARD = "stage/onboard"
_SIDES = Limits(16, 8192, "pixels", whole=True)

# Lengths below are in radii of the craft.
_SEAT = (0.03, 0.0, 0.3)  # of the camera on board, above the canopies of all vehicles
_SPREAD = 8.8  # of the craft of a world, which are about as many in each direction
_NEAR = 0.14  # at most: where drawing begins
_LOWER = 0.06  # of their distance front and side look below the goal
_BACK = 2.6  # distance of a camera per distance between craft and goal
_FOVY = 50.0  # vertical field of view of every camera but `onboard`, degrees
_DISTANT = 40.0  # of a goal that no picture shows together with the craft
_FAR = 10.0  # Cameras move back until craft and goal are as far apart, or as at the start


@immutable
class Moment:
    """One craft after one control step. Positions are in the world frame, m."""

    position: Point
    """x, y, z."""
    attitude: tuple[float, ...]
    """Quaternion from body to world: w, x, y, z."""
    thrusts: tuple[float, ...]
    """F1 to FR, N."""
    goal: Point | None = None
    """Position to reach or hold; None if the task has no goal."""
    payload: Point | None = None
    """Position of what hangs below it on a cable; None if nothing does."""
    metrics: tuple[tuple[str, str], ...] = ()
    """Names and values of the task's metrics for an overlay, the headline first."""
    marks: tuple[Mark, ...] = ()
    """What is to be seen of the task; where there is any, no disc is drawn at the goal."""
    readings: Sequence[Reading] = field(default=(), compare=False)
    """Of sensors with rays, which are drawn."""
    reward: float = 0.0
    """Of the step that led here."""
    step: int = 0
    """Control steps since the episode began; 0 at its start."""
    episode: int = 0
    """Episodes before this one."""
    time: float = 0.0
    """Since the episode began, s."""

    @property
    def lines(self) -> Lines:
        """Names and values for an overlay."""
        thrusts = " ".join(f"{thrust:.3g}" for thrust in self.thrusts)
        rotors = len(self.thrusts)
        return [
            *self.metrics[:_MAX_METRICS],
            ("elevation", f"{self.position[2]:.2f} m"),
            (f"F1 to F{rotors}" if rotors > 1 else "F1", f"{thrusts} N"),
            ("reward", f"{self.reward:+.3f}"),
            ("step", str(self.step)),
            ("episode", str(self.episode)),
        ]


class Stage:
    """The craft of one world over an airport or a plain floor, each with a goal and a path.

    Several have names, which the pictures show, and paths and goals in a colour of their own. A
    stage simulates nothing: it shows moments. What is wrong raises `InputError`.

    Attributes:
        radius: Of a sphere about the body's origin that holds the craft, m. Cameras, goals and
            paths scale with it.
        model: With all visual elements.
        data: Poses of the last moments.
        moments: The last moments.
    """

    def __init__(
        self,
        scene: str | SceneConfig = "airport",
        drones: int = 1,
        *,
        vehicle: Path | str | Sequence[str] | None = None,
        trail: bool = True,
    ) -> None:
        if not drones >= 1:
            raise InputError(f"drones: expected 1 or more, got {drones}")
        self.drones = drones
        self.vehicle = load_vehicles(vehicle, drones)
        paths = [craft.path for craft in members_of(self.vehicle, drones)]
        try:
            spec, crafts = swarm_spec(paths, drone_names(drones))
            add_scene(spec, scene)
            # It sees nose, front rotors and horizon.
            crafts[0].add_camera(name=_ONBOARD, xyaxes=(0, -1, 0, 0.30, 0, 0.954), fovy=70)
            self.model = spec.compile()
        except InputError:
            raise
        except ValueError as error:  # a texture is missing, which the physics does not need
            raise InputError(
                f"vehicle: expected a file that can be drawn, got: {one_line(error)}"
            ) from None
        self._scene = scene
        self.radius = _drawn_radius(self.model)
        self.model.camera(_ONBOARD).pos = np.multiply(_SEAT, self.radius)
        spread = _SPREAD * math.isqrt(drones - 1) * self.radius
        scale_drawing(self.model, self.radius, spread)
        self.data = mujoco.MjData(self.model)
        self.moments: tuple[Moment, ...] = ()
        length = _TRAIL // _EVERY if trail else 0
        self._paths: list[deque[Array]] = [deque(maxlen=length) for _ in range(drones)]
        # Distance between a single craft and its goal for which a camera makes room, m.
        self._reach = 0.0
        self._focus: Array | None = None
        mujoco.mj_forward(self.model, self.data)

    def show(self, *moments: Moment) -> None:
        """Put every craft where its moment has it, and extend its path. Raises `InputError`."""
        craft = self.vehicle
        rotors = len(moments[0].thrusts)
        if rotors != craft.num_rotors:
            raise InputError(
                f"vehicle: expected a file with {rotors} rotors, as in the flight, "
                f"got {craft.path.name} with {craft.num_rotors}"
            )
        before = self.moments or moments
        self.moments = moments
        poses = self.data.qpos.reshape(self.drones, 7)
        drones = zip(moments, before, poses, self._paths, strict=True)
        for moment, last, pose, path in drones:
            pose[:3] = moment.position
            pose[3:] = moment.attitude
            if moment.step == 0 or moment.step < last.step or moment.episode != last.episode:
                path.clear()
                self._reach = 0.0
            if moment.step // _EVERY != last.step // _EVERY or not path:  # steps may be left out
                path.append(pose[:3].copy())
            if moment.goal is not None:
                reach = float(np.linalg.norm(np.subtract(moment.goal, pose[:3])))
                if self._reach:
                    reach = min(reach, _FAR * self.radius)
                self._reach = max(self._reach, reach)
        move_geoms(self.model, self._scene, moments[0].time)
        place_cameras(self.model, self.data)

    def camera(self, name: Camera | Literal["free"]) -> mujoco.MjvCamera:
        """A camera for the last moments. All but `onboard` see every craft, and goals of one world.

        `chase` and `top` go with the craft; `front`, `side` and `free`, where a viewer's camera
        begins, look at the goal if there is one, and move back from a craft that is far from it.
        A name of none raises `InputError`.
        """
        camera = mujoco.MjvCamera()
        if name == "onboard":
            camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            camera.fixedcamid = self.model.camera(_ONBOARD).id
            return camera
        views = LOOKS["views"]
        if name not in views:
            raise InputError(f"camera: expected one of {', '.join(CAMERAS)}, got {shortened(name)}")
        camera.azimuth, camera.elevation, distance, holds = views[name]
        camera.distance = distance * self.radius
        if self.drones > 1:  # the goals of one world lie apart, often far from their craft
            places = np.array([*self._points, *self._goals])
            camera.distance += float(np.ptp(places, axis=0).max())
        elif holds < math.inf:
            camera.distance += _BACK * max(self._reach - holds * self.radius, 0.0)
        camera.lookat[:] = self.focus if holds < math.inf else self._points.mean(axis=0)
        if name in ("front", "side"):  # above the ground
            camera.lookat[2] = max(camera.lookat[2] - _LOWER * camera.distance, 0.0)
        return camera

    def follow(self, camera: mujoco.MjvCamera) -> None:
        """Turn a viewer's camera towards the goal, or the craft where that is too far from it;
        afterwards move it with that.
        """
        is_far = self.drones == 1 and self._reach > _DISTANT * self.radius
        focus = self._points[0].copy() if is_far else self.focus
        if self._focus is None:
            view = self.camera("chase" if is_far else "free")
            for name in ("azimuth", "elevation", "distance", "lookat"):
                setattr(camera, name, getattr(view, name))
        else:  # keep what the mouse has changed
            camera.lookat[:] += focus - self._focus
        self._focus = focus

    @property
    def focus(self) -> Array:
        """Mean of the goals, or of the craft if there are none, MuJoCo's frame, shape (3,), m."""
        goals = self._goals
        points = np.array(goals) if goals else self._points
        return np.asarray(points.mean(axis=0))

    def decorate(self, scene: MjvScene, *, goals: bool = True) -> None:
        """Add marks, payloads, fading paths, ends of rays, and discs at the goals if wanted."""
        radius = self.radius
        marked = any(moment.marks for moment in self.moments)
        labels = drone_names(self.drones) if 1 < self.drones <= MAX_NAMES else ()
        cable = (*LOOKS["cable"], 1.0)
        for drone, moment in enumerate(self.moments):
            here = self._points[drone]
            goal = moment.goal
            payload = moment.payload
            for mark in moment.marks:
                if mark.moves or drone == 0:  # all drones of a world tell the same
                    _draw_mark(scene, mark, goal)
            if payload is not None:
                size = (0.12 * radius,) * 3
                _decorate(scene, "sphere", size, payload, (*LOOKS["payload"], 1.0))
                _connect(scene, "capsule", 0.012 * radius, here, payload, cable)
            if labels:
                above = here + np.array((0.0, 0.0, 0.9 * radius))
                label = _decorate(scene, "label", (0.1,) * 3, above, cable)
                if label is not None:
                    label.label = f"{labels[drone]}   "  # without the spaces its end is cut off
            color = LOOKS["drones"][drone % len(LOOKS["drones"])]
            if goals and goal is not None and not marked:
                size = (0.93 * radius, 0.0033 * radius, 0.0)  # radius, half of its height
                own = color if self.drones > 1 else LOOKS["goal"]
                _decorate(scene, "cylinder", size, goal, (*own, 0.3))
            path = self._paths[drone]
            for number, (start, end) in enumerate(pairwise([*path, here]), 1):
                if not np.array_equal(start, end):
                    rgba = (*color, 0.85 * number / len(path))
                    _connect(scene, "capsule", 0.019 * radius, start, end, rgba)
        for moment in self.moments:  # last: they may be more than a scene takes
            for reading in moment.readings:
                _draw_reading(scene, reading, 0.015 * self.radius)

    @property
    def lines(self) -> Lines:
        """Names and values for the overlay of a viewer: those of the first craft."""
        lines = self.moments[0].lines
        if self.drones == 1:
            return lines
        drones = ("drones", f"{self.drones}, numbers of the first")
        return [drones, ("least distance", f"{self.least_distance:.2f} m"), *lines]

    @property
    def least_distance(self) -> float | None:
        """Least distance between the origins of two drones of the world now, m; None of one."""
        if self.drones == 1:
            return None
        points = self._points
        apart = np.linalg.norm(points[:, None] - points, axis=-1)
        return float(apart[np.triu_indices(self.drones, 1)].min())

    @property
    def _goals(self) -> list[Point]:
        return [moment.goal for moment in self.moments if moment.goal is not None]

    @property
    def _points(self) -> Array:
        """Positions of the craft, MuJoCo's frame, shape (drones, 3), m."""
        return np.asarray(self.data.qpos.reshape(self.drones, 7)[:, :3])


@dataclass
class Canvas(AbstractContextManager["Canvas"]):
    """Pictures of a stage, all of one size in pixels. Raises `NoOpenGL` or `InputError`.

    `fast` is without shadows and smooth edges, which take most of the time where software draws.
    """

    stage: Stage
    width: Annotated[int, _SIDES] = 640
    height: Annotated[int, _SIDES] = 480
    fast: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        self._drawing = Offscreen(self.stage.model, self.width, self.height, fine=not self.fast)

    def draw(self, camera: Camera = "chase", lines: Lines = ()) -> Array:
        """The stage as it is now, with lines of text over it: a new array, uint8, (height, width,
        3).
        """
        scene = self._drawing.scene
        self._drawing.update(self.stage.data, self.stage.camera(camera))
        for light in scene.lights[: scene.nlight]:
            if light.headlight and camera == "top":  # it would add itself to the sun
                light.diffuse[:] = 0.0
        # From on board, at the goal, its disc would fill the lower half.
        self.stage.decorate(scene, goals=camera != "onboard")
        pixels = np.empty((self.height, self.width, 3), np.uint8)
        self._drawing.draw(pixels, lines=lines)
        return np.ascontiguousarray(pixels[::-1])  # OpenGL's first row is the lowest

    def close(self) -> None:
        """Free the context. A second call does nothing."""
        self._drawing.close()

    def __exit__(self, *_: object) -> None:
        self.close()


def _drawn_radius(model: MjModel) -> float:
    """Of a sphere about the body's origin that holds what is drawn of the largest craft, m."""
    craft = owners(model)[model.geom_bodyid] >= 0
    drawn = craft & (model.geom_group <= 2)
    return radius_of(model, drawn if drawn.any() else craft)


def scale_drawing(model: MjModel, radius: float, spread: float) -> None:
    """Set the near end of drawing, the shadow's fineness and our floor's squares for the craft."""
    visual = model.vis
    extent = model.stat.extent
    visual.global_.fovy = _FOVY
    visual.map.znear = min(visual.map.znear * extent, _NEAR * radius) / extent
    # Software draws shadows too: finer ones cost more than they show.
    visual.quality.shadowsize = min(visual.quality.shadowsize, 2048)
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MATERIAL, f"{SCENE_PREFIX}floor")
    if floor >= 0:
        model.mat_texrepeat[floor] *= 10.0 ** -round(math.log10(radius))
        # Further out the floor would shade itself, in speckles.
        visual.map.shadowclip = min(visual.map.shadowclip, (2.0 * radius + spread) / extent)


def _draw_mark(scene: MjvScene, mark: Mark, goal: Point | None) -> None:
    """Add a mark; a gate that is the goal has the goal's colour."""
    centre = np.array(mark.position)
    if mark.moves:
        if goal is None:
            return
        centre += goal
    color = LOOKS["marks"][mark.shape]
    if mark.shape == "gate" and goal is not None and np.abs(goal - centre).max() < 1e-3:
        color = LOOKS["goal"]
    rgba = (*color, 0.3 if mark.shape == "ball" else 0.9)
    for part in mark.parts(0.04 * mark.size):
        start = centre + part.start
        end = centre + part.end
        if part.kind == "sphere":
            _decorate(scene, part.kind, (part.radius,) * 3, start, rgba)
        else:
            _connect(scene, part.kind, part.radius, start, end, rgba)


def _draw_reading(scene: MjvScene, reading: Reading, size: float) -> None:
    """Add a cube where each ray ended, larger than `size`, m, and the rays if they are few."""
    origin = reading.origin
    colors = range_colors(reading.distances, reading.reach)
    ended = np.isfinite(reading.points[..., 0])
    points = reading.points[ended]
    sides = size + _FAR_POINT * np.linalg.norm(points - origin, axis=1)
    for point, side, color in zip(points, sides, colors[ended], strict=True):
        _decorate(scene, "box", (side,) * 3, point, (*color, 1.0))
        if ended.size <= _FEW:
            _connect(scene, "capsule", 0.3 * size, origin, point, (*color, 0.6))


def range_colors(distances: Array, reach: float) -> Array:
    """Colours of distances from 0 to `reach`, m: 0 to 1, with a last axis of 3."""
    table = np.array(LOOKS["ranges"])
    places = np.linspace(0.0, reach, len(table))
    return np.stack([np.interp(distances, places, channel) for channel in table.T], axis=-1)


def _connect(
    scene: MjvScene,
    kind: str,
    radius: float,
    start: ArrayLike,
    end: ArrayLike,
    rgba: ArrayLike,
) -> None:
    """Add a cylinder or a capsule between two points."""
    geom = _decorate(scene, kind, (1.0, 1.0, 1.0), start, rgba)
    if geom is not None:
        mujoco.mjv_connector(geom, geom.type, radius, np.asarray(start), np.asarray(end))


def _decorate(
    scene: MjvScene,
    kind: str,
    size: ArrayLike,
    centre: ArrayLike,
    rgba: ArrayLike,
) -> mujoco.MjvGeom | None:
    """Add a geom that casts no shadow; None if the scene is full."""
    if scene.ngeom == scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    color = np.array(rgba, np.float32)
    shape = getattr(mjtGeom, f"mjGEOM_{kind.upper()}")
    scene.ngeom += 1
    mujoco.mjv_initGeom(geom, shape, np.array(size), np.asarray(centre), np.eye(3).ravel(), color)
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR
    return geom
