"""Pictures that the cameras of drones take of their worlds: colours, depth, objects, optical flow.

Each is of the state that it is given, exactly: nothing moves and no sensor is read in between. The
model that is drawn is another than that of the physics, which never knows of it.

Pixels: row 0 is the top, column 0 the left; the middle of the first pixel is at (0.5, 0.5).
A camera's frame here: x right, y down, z along its axis, as in computer vision.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from ..models.cameras import FARTHEST, View, add_cameras
from ..models.fleet import members_of
from ..models.scene import build_swarm
from ..models.swarm import drone_names
from ..models.vehicle import Vehicle
from .gl import Offscreen
from .stage import scale_drawing

NOTHING: Final = "nothing"
"""Name of what a segmentation picture has where it sees no object: number 0."""
_NEAREST: Final = 0.05  # Where drawing begins, over the vehicle's radius
_ROOM: Final = 10_000  # geoms
_UNNAMED: Final = "unnamed"
_GOAL: Final = "goal"
_PAYLOAD: Final = "payload"
_COLOR: Final = {"gate": (0.96, 0.42, 0.08, 1.0), "disc": (0.13, 0.78, 0.52, 1.0)}
_FLIP: Final = np.array((1.0, -1.0, -1.0))  # from MuJoCo's camera frame to that of vision


class Lens(NamedTuple):
    """How points of the world come to pixels: p = K (R x + t), then over its third number."""

    matrix: np.ndarray
    """K, shape (3, 3), pixels."""
    rotation: np.ndarray
    """R, shape (3, 3), from the world's frame to the camera's."""
    translation: np.ndarray
    """t, shape (3,), m."""

    def project(self, points: np.ndarray) -> np.ndarray:
        """Columns and rows of points of the world, shape (..., 3), m: shape (..., 2), pixels."""
        seen = (points @ self.rotation.T + self.translation) @ self.matrix.T
        pixels: np.ndarray = seen[..., :2] / seen[..., 2:]
        return pixels

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Points of the world that the pixels of a depth picture (H, W) see, (H, W, 3), m."""
        rows, columns = np.indices(depth.shape) + 0.5
        k = self.matrix
        x, y = (columns - k[0, 2]) / k[0, 0], (rows - k[1, 2]) / k[1, 1]
        seen = np.stack((x * depth, y * depth, depth), axis=-1)
        points: np.ndarray = (seen - self.translation) @ self.rotation
        return points


class Cameras:
    """Cameras of W worlds of A drones. Raises `InputError`, and `take` raises `NoOpenGL`.

    Marks are those of the task's spec: gates, discs and balls of its world, or at each drone's goal
    where they move. Views are what is taken, of one size each; `fine` draws smooth edges and
    shadows, in several times the time.

    Attributes:
        views: As given.
        objects: Names of the numbers of segmentation pictures, in their order.
        pictures: By the names of the views, shape (N, H, W, channels): what each drone took last.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        views: Sequence[View],
        shape: tuple[int, int] = (1, 1),
        *,
        world: str = "plain",
        marks: Sequence[Any] = (),
        payload: bool = False,
        fine: bool = False,
    ) -> None:
        self.views, self._shape = tuple(views), shape
        self._names = drone_names(shape[1])
        self.model = _model(vehicle, self._names, world, marks, payload=payload)
        self.data = mujoco.MjData(self.model)
        self._poses = _Poses(self.model, self._names)
        self.objects, self._object = _objects(self.model, self._names)
        self._ids = {view.name: self._camera_ids(view) for view in self.views}
        rows = shape[0] * shape[1]
        self.pictures = {
            view.name: np.zeros((rows, *view.shape), view.dtype) for view in self.views
        }
        self._before: list[np.ndarray | None] = [None] * shape[0]
        self.model.vis.quality.offsamples = 4 if fine else 0
        self._scene = mujoco.MjvScene(self.model, _ROOM)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = fine
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._numbers = np.zeros(0, np.int32)

    def _camera_ids(self, view: View) -> list[int]:
        """The camera of each drone of a world; of one that stands there the same."""
        name = view.camera.name
        one = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if one >= 0:
            return [one] * len(self._names)
        return [self.model.camera(f"{drone}/{name}").id for drone in self._names]

    @cached_property
    def _drawing(self) -> Offscreen:
        """Opened with the first picture, so that a process may be forked before."""
        sizes = [view.shape for view in self.views]
        width, height = max(size[1] for size in sizes), max(size[0] for size in sizes)
        return Offscreen(self.model, width, height)

    def take(self, due: Mapping[str, np.ndarray], fresh: np.ndarray, **state: Any) -> None:
        """Take pictures of the worlds as they are.

        `due` has by the name of a view which drones take one, bool, shape (N,); `fresh` which have
        just begun an episode, before which there was no other step, so that nothing flows. The
        state: `position` (N, 3) and `quaternion` (N, 4), and, where there are any, `goal` and
        `payload` (N, 3): MuJoCo's world frame, m. `flow` is since the last call.
        """
        worlds, drones = self._shape
        of_world = {name: np.reshape(mask, (worlds, drones)) for name, mask in due.items()}
        needed = np.stack([mask.max(axis=1) for mask in of_world.values()]).max(axis=0)
        flows = any(view.kind == "flow" for view in self.views)
        first = fresh.reshape(worlds, drones).max(axis=1)
        with self._drawing.current():
            for world in range(worlds):
                if not (needed[world] or flows):
                    continue
                rows = slice(world * drones, (world + 1) * drones)
                self._poses.set(self.data, {name: x[rows] for name, x in state.items()})
                if needed[world]:
                    mine = {name: mask[world] for name, mask in of_world.items()}
                    self._draw_world(rows, mine, None if first[world] else self._before[world])
                if flows:
                    self._before[world] = self._poses.now(self.data)

    def lens(self, name: str, drone: int = 0, world: int = 0, **state: Any) -> Lens:
        """The lens of a view's camera, of a drone of a world, in a state as of `take`."""
        drones = self._shape[1]
        rows = slice(world * drones, (world + 1) * drones)
        self._poses.set(self.data, {name: x[rows] for name, x in state.items()})
        view = next(view for view in self.views if view.name == name)
        return _lens(self.model, self.data, self._ids[name][drone], view)

    def _draw_world(
        self, rows: slice, due: Mapping[str, np.ndarray], before: np.ndarray | None
    ) -> None:
        """Pictures of the world that `data` is in."""
        drawn: dict[tuple[int, tuple[int, ...]], _Buffers] = {}
        for view in self.views:
            for drone in np.flatnonzero(due[view.name]).tolist():
                camera = self._ids[view.name][drone]
                buffers = drawn.setdefault((camera, view.shape[:2]), _Buffers())
                picture = self._picture(view, camera, buffers, before)
                self.pictures[view.name][rows.start + drone] = picture

    def _picture(
        self, view: View, camera: int, buffers: "_Buffers", before: np.ndarray | None
    ) -> np.ndarray:
        """A view's picture by a camera, from what was drawn for others of it and their size."""
        if view.kind == "rgb":
            if buffers.rgb is None:
                buffers.rgb = self._render(view, camera, objects=False)[0]
            return buffers.rgb
        if buffers.depth is None:
            buffers.codes, depth = self._render(view, camera, objects=True)
            buffers.depth = self._meters(depth)
        if view.kind == "depth":
            return buffers.depth[..., None]
        if view.kind == "segmentation":
            numbers: np.ndarray = self._object[self._number(buffers.codes)]
            return numbers[..., None]
        return self._flow(view, camera, buffers, before)

    def _render(self, view: View, camera: int, *, objects: bool) -> tuple[np.ndarray, np.ndarray]:
        """Colours, uint8 (H, W, 3), and OpenGL's depth, float32 (H, W), the first row on top."""
        scene, (height, width, _) = self._scene, view.shape
        view_of, every = self._camera, mujoco.mjtCatBit.mjCAT_ALL.value
        view_of.fixedcamid = camera
        # The scene lays an endless floor around the camera that it had: without this the last one.
        mujoco.mjv_updateCamera(self.model, self.data, view_of, scene)
        mujoco.mjv_updateScene(self.model, self.data, self._option, None, view_of, every, scene)
        for flag in mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR:
            scene.flags[flag.value] = objects
        colors = np.empty((height, width, 3), np.uint8)
        depth = np.empty((height, width), np.float32)
        self._drawing.draw(scene, colors, depth if objects else None)
        return colors[::-1], depth[::-1]

    def _number(self, colors: np.ndarray) -> np.ndarray:
        """Number of the geom of each pixel of the last picture, from 1; 0: none."""
        scene = self._scene
        if len(self._numbers) != scene.ngeom + 1:  # the same geoms in each picture, in one order
            geom = mujoco.mjtObj.mjOBJ_GEOM.value
            self._numbers = np.zeros(scene.ngeom + 1, np.int32)
            for one in scene.geoms[: scene.ngeom]:
                if one.segid >= 0 and one.objtype == geom:
                    self._numbers[one.segid + 1] = one.objid + 1
        code = colors.astype(np.uint32)
        numbers: np.ndarray = self._numbers[code[..., 0] | code[..., 1] << 8 | code[..., 2] << 16]
        return numbers

    def _meters(self, depth: np.ndarray) -> np.ndarray:
        """Depth along the camera's axis, float32, m, of OpenGL's: 1 near, 0 far."""
        extent, clip = self.model.stat.extent, self.model.vis.map
        near, far = (float(np.float32(end * extent)) for end in (clip.znear, clip.zfar))
        meters = near * far / (near + depth.astype(np.float64) * (far - near))
        told: np.ndarray = np.minimum(meters, FARTHEST).astype(np.float32)
        return told

    def _flow(
        self, view: View, camera: int, buffers: "_Buffers", before: np.ndarray | None
    ) -> np.ndarray:
        """Pixels by which what a pixel sees has moved since before, right and down, (H, W, 2)."""
        if before is None:
            return np.zeros(view.shape, np.float32)
        assert buffers.depth is not None
        lens = _lens(self.model, self.data, camera, view)
        points = lens.points(buffers.depth.astype(np.float64))
        bodies = np.append(0, self.model.geom_bodyid)[self._number(buffers.codes)]
        now, moved = self._poses.frames(self.data), points.copy()
        state = self._poses.now(self.data)
        self._poses.restore(self.data, before)
        past, old_lens = self._poses.frames(self.data), _lens(self.model, self.data, camera, view)
        self._poses.restore(self.data, state)
        for body in np.unique(bodies).tolist():
            if not all(map(np.array_equal, now[body], past[body])):
                (place, axes), (old_place, old_axes) = now[body], past[body]
                which = bodies == body
                moved[which] = (points[which] - place) @ axes @ old_axes.T + old_place
        flow: np.ndarray = (lens.project(points) - old_lens.project(moved)).astype(np.float32)
        return flow

    def close(self) -> None:
        """Free the context. A second call does nothing."""
        if "_drawing" in vars(self):
            self._drawing.close()


def shown(kind: str, picture: np.ndarray) -> np.ndarray:
    """A picture (H, W, channels) of a kind in colours to look at, uint8, (H, W, 3).

    Depth: near is bright. Objects: a colour for each number. Flow: the hue is its direction.
    """
    if kind == "rgb":
        return picture
    if kind == "depth":
        near = np.log(np.maximum(picture, 1e-3))
        share = 1.0 - (near - near.min()) / max(float(np.ptp(near)), 1e-9)
        return np.repeat((255 * share).astype(np.uint8), 3, axis=-1)
    if kind == "segmentation":
        hue = picture[..., 0] * 0.618034 % 1.0
        return _hues(hue, np.where(picture[..., 0] > 0, 1.0, 0.0))
    size = np.linalg.norm(picture, axis=-1)
    hue = np.arctan2(picture[..., 1], picture[..., 0]) / (2 * np.pi) % 1.0
    return _hues(hue, size / max(float(size.max()), 1e-9))


def _hues(hue: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Colours of hues from 0 to 1 and values from 0 to 1, uint8, with three channels."""
    steps = (np.array((5.0, 3.0, 1.0)) + 6.0 * hue[..., None]) % 6.0
    share = value[..., None] * (1.0 - 0.8 * np.clip(np.minimum(steps, 4.0 - steps), 0.0, 1.0))
    return np.asarray(255 * share, np.uint8)


class _Buffers:
    """What was drawn for one camera in one size."""

    rgb: np.ndarray | None = None
    depth: np.ndarray | None = None
    codes: np.ndarray = np.zeros((0, 0, 3), np.uint8)
    """Colours that are numbers of geoms, uint8 (H, W, 3)."""


class _Poses:
    """Poses of the craft, and of what goes with them."""

    def __init__(self, model: mujoco.MjModel, names: Sequence[str]) -> None:
        self._model = model
        free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
        self._at = model.jnt_qposadr[free][:, None] + np.arange(7)
        self._mocap = {
            kind: [int(model.body(f"{name}/{kind}").mocapid[0]) for name in names]
            for kind in (_GOAL, _PAYLOAD)
            if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"{names[0]}/{kind}") >= 0
        }

    def set(self, data: mujoco.MjData, state: Mapping[str, np.ndarray]) -> None:
        """Put them where a state has them."""
        data.qpos[self._at[:, :3]] = state["position"]
        data.qpos[self._at[:, 3:]] = state["quaternion"]
        for kind, bodies in self._mocap.items():
            if kind in state:
                data.mocap_pos[bodies] = state[kind]
        self._update(data)

    def now(self, data: mujoco.MjData) -> np.ndarray:
        """All numbers of the poses."""
        return np.concatenate((data.qpos, data.mocap_pos.ravel()))

    def restore(self, data: mujoco.MjData, numbers: np.ndarray) -> None:
        """Put them where `now` had them."""
        data.qpos[:] = numbers[: len(data.qpos)]
        data.mocap_pos[:] = numbers[len(data.qpos) :].reshape(-1, 3)
        self._update(data)

    def frames(self, data: mujoco.MjData) -> list[tuple[np.ndarray, np.ndarray]]:
        """Place and axes, as columns, of each body."""
        axes = data.xmat.reshape(-1, 3, 3)
        return [(place.copy(), turn.copy()) for place, turn in zip(data.xpos, axes, strict=True)]

    def _update(self, data: mujoco.MjData) -> None:
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_camlight(self._model, data)


def objects_of(
    vehicle: Vehicle, drones: int, world: str, marks: Sequence[Any], *, payload: bool
) -> tuple[str, ...]:
    """`Cameras.objects` of such cameras, without an OpenGL."""
    names = drone_names(drones)
    return _objects(_model(vehicle, names, world, marks, payload=payload), names)[0]


def _model(
    vehicle: Vehicle, names: Sequence[str], world: str, marks: Sequence[Any], *, payload: bool
) -> mujoco.MjModel:
    """What is drawn: craft with their cameras, what surrounds them, the task's marks."""
    crafts = members_of(vehicle, len(names))
    spec = build_swarm([craft.path for craft in crafts], names, world)
    bodies = [body for body in spec.worldbody.bodies if body.name.partition("/")[0] in names]
    for name, body, craft in zip(names, bodies, crafts, strict=True):
        add_cameras(spec, body, craft, f"{name}/")
        if payload:
            hung = spec.worldbody.add_body(name=f"{name}/{_PAYLOAD}", mocap=True)
            _add(hung, "payload", mujoco.mjtGeom.mjGEOM_SPHERE, (0.12 * craft.radius,) * 3)
    for number, mark in enumerate(marks):
        if not mark.moves:
            _add_mark(spec.worldbody, f"task/{mark.shape}_{number}", mark)
            continue
        for name in names:
            goal = spec.body(f"{name}/{_GOAL}")
            goal = goal or spec.worldbody.add_body(name=f"{name}/{_GOAL}", mocap=True)
            _add_mark(goal, f"task/{mark.shape}_{number} of {name}", mark)
    model = spec.compile()
    scale_drawing(model, vehicle.radius, 0.0)
    extent = model.stat.extent
    model.vis.map.znear, model.vis.map.zfar = _NEAREST * vehicle.radius / extent, FARTHEST / extent
    return model


def _add(body: Any, name: str, kind: Any, size: Sequence[float], **more: Any) -> None:
    """A geom that is only drawn."""
    geom = body.add_geom(name=name, type=kind, size=size, **more)
    geom.contype = geom.conaffinity = 0
    geom.mass, geom.group = 0.0, 1


def _add_mark(body: Any, name: str, mark: Any) -> None:
    """A gate, a disc or a ball of a task, as viewers show it."""
    kinds, rgba = mujoco.mjtGeom, _COLOR.get(mark.shape, (0.13, 0.78, 0.52, 1.0))
    centre = np.array(mark.position)
    if mark.shape == "ball":
        _add(body, name, kinds.mjGEOM_SPHERE, (mark.size,) * 3, pos=centre, rgba=rgba)
    elif mark.shape == "disc":
        half = 0.02 * mark.size  # its lower side lies on the ground: both at one height flicker
        size, centre = (mark.size, half, 0.0), centre + np.array((0.0, 0.0, half))
        _add(body, name, kinds.mjGEOM_CYLINDER, size, pos=centre, rgba=rgba)
    else:
        turn, half = np.radians(mark.heading), mark.size / 2
        aside, up = np.array((-np.sin(turn), np.cos(turn), 0.0)), np.array((0.0, 0.0, 1.0))
        corners = [centre + half * (y * aside + z * up) for y, z in _CORNERS]
        for i, (start, end) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True)):
            ends = np.concatenate((start, end))
            thick = (0.025 * mark.size, 0.0, 0.0)
            _add(body, f"{name}/{i}", kinds.mjGEOM_CAPSULE, thick, fromto=ends, rgba=rgba)


_CORNERS: Final = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def _objects(model: mujoco.MjModel, names: Sequence[str]) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of the objects of a model, and the number of the one of each geom, behind a 0.

    All geoms of a craft are one object, and those of the world whose names begin alike up to their
    last slash, if they have two or more. Geoms of the world without a name are told apart by their
    material.
    """
    known, numbers = {NOTHING: 0}, [0]
    roots = {int(model.body(one).rootid[0]): one.partition("/")[0] for one in _bodies(model, names)}
    for number in range(model.ngeom):
        geom = model.geom(number)
        root = int(model.body_rootid[geom.bodyid[0]])
        material = int(geom.matid[0])
        name = geom.name or (model.material(material).name if material >= 0 else _UNNAMED)
        head, _, _ = name.rpartition("/")
        told = roots.get(root, head if "/" in head else name)
        numbers.append(known.setdefault(told, len(known)))
    return tuple(known), np.array(numbers, np.int32)


def _bodies(model: mujoco.MjModel, names: Sequence[str]) -> list[str]:
    """Names of the bodies with a free joint."""
    free = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    found = [model.body(int(body)).name for body in free]
    return [name for name in found if name.partition("/")[0] in names]


def _lens(model: mujoco.MjModel, data: mujoco.MjData, camera: int, view: View) -> Lens:
    height, width, _ = view.shape
    if model.cam_sensorsize[camera].any():
        focal = model.cam_intrinsic[camera]
        scale = np.array((width, height)) / model.cam_sensorsize[camera]
        fx, fy = focal[:2] * scale
        cx, cy = width / 2 + focal[2] * scale[0], height / 2 + focal[3] * scale[1]
    else:
        fx = fy = 0.5 * height / np.tan(np.radians(model.cam_fovy[camera]) / 2)
        cx, cy = width / 2, height / 2
    matrix = np.array(((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)))
    rotation = (data.cam_xmat[camera].reshape(3, 3) * _FLIP).T
    return Lens(matrix, rotation, -rotation @ data.cam_xpos[camera])
