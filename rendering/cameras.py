"""Pictures that the cameras of drones take of their worlds: colours, depth, objects, optical flow.

A picture shows exactly the state that `take` gets: no time passes. Pictures have a model of their
own; the physics does not see it.

Pixels: row 0 is the top, column 0 the left; the middle of the first pixel is at (0.5, 0.5).
A camera's frame here: x right, y down, z along its axis, as in computer vision.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Final

import mujoco
import numpy as np

from ..models.cameras import FARTHEST, MAX_PIXELS, Camera, Optics, View
from ..models.errors import InputError
from ..models.fleet import members_of
from ..models.lens import Lens
from ..models.swarm import drone_names
from ..models.vehicle import Vehicle
from ..scenes.marks import Mark
from .camera_model import GOAL, PAYLOAD, drawn_model, objects_in, own_discs
from .gl import Offscreen

_ROOM: Final = 1000  # geoms beyond those of the model
_HIDDEN: Final = 5  # a group of geoms that is not drawn
_FINER: Final = 2  # pixels of the pinhole's picture per pixel of a lens that distorts
_FLIP: Final = np.array((1.0, -1.0, -1.0))  # from MuJoCo's camera frame to that of vision


class Cameras:
    """Cameras of W worlds of A drones. Raises `InputError`, and `take` raises `NoOpenGL`.

    Marks are those of the task's spec: gates, discs and balls, fixed in the world or moving with
    each drone's goal. A view is one array of pictures, all of one size. `fine` draws smooth edges
    and shadows, and takes several times as long.

    Attributes:
        views: As given.
        objects: Names of objects; a segmentation picture has their indices.
        pictures: The last picture of each drone by the view's name, shape (N, H, W, channels).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        views: Sequence[View],
        shape: tuple[int, int] = (1, 1),
        *,
        scene: str = "plain",
        marks: Sequence[Mark] = (),
        payload: bool = False,
        fine: bool = False,
    ) -> None:
        if not views:
            raise InputError("cameras: expected one picture or more, got none")
        self.views = tuple(views)
        self._shape = shape
        self._names = drone_names(shape[1])
        self.model = drawn_model(vehicle, self._names, scene, marks, payload=payload)
        self.data = mujoco.MjData(self.model)
        self._poses = _Poses(self.model, self._names)
        self.objects, self._object = objects_in(self.model, self._names)
        eyes: dict[tuple[int, tuple[int, int]], _Eye] = {}
        crafts = [{one.name: one for one in x.cameras} for x in members_of(vehicle, shape[1])]
        self._eyes: dict[str, list[_Eye]] = {}
        for view in self.views:
            size = view.shape[:2]
            for number, craft in zip(self._camera_ids(view), crafts, strict=True):
                if (number, size) not in eyes:
                    eyes[number, size] = _Eye(self.model, number, size, craft[view.camera.name])
                self._eyes.setdefault(view.name, []).append(eyes[number, size])
        rows = shape[0] * shape[1]
        self.pictures = {
            view.name: np.zeros((rows, *view.shape), view.dtype) for view in self.views
        }
        self._before = np.tile(self._poses.now(self.data), (shape[0], 1))
        self.model.vis.quality.offsamples = 4 if fine else 0
        self._scene = mujoco.MjvScene(self.model, self.model.ngeom + _ROOM)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = fine
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED

    def _camera_ids(self, view: View) -> list[int]:
        """The camera of each drone of a world; a fixed camera counts for all drones."""
        name = view.camera.name
        fixed = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if fixed >= 0:
            return [fixed] * len(self._names)
        return [self.model.camera(f"{drone}/{name}").id for drone in self._names]

    @cached_property
    def _drawing(self) -> Offscreen:
        """Opened with the first picture, so that a process may be forked before."""
        sizes = [eye.drawn for eyes in self._eyes.values() for eye in eyes]
        height, width = (max(side) for side in zip(*sizes, strict=True))
        return Offscreen(self.model, width, height)

    def open(self) -> None:
        """Open OpenGL, as `take` does in its thread. A second call does nothing."""
        with self._drawing.current():
            pass

    def take(
        self,
        due: Mapping[str, np.ndarray],
        fresh: np.ndarray,
        state: Mapping[str, np.ndarray],
        dice: Callable[[int], np.random.Generator] | None = None,
        of: np.ndarray | None = None,
    ) -> None:
        """Take pictures of the worlds as they are.

        `due` has, by view name, the drones that take a picture, bool, shape (N,). `fresh` has the
        drones that have just begun an episode: their optical flow is 0, for there is no earlier
        frame.

        The state has `position` (N, 3) and `quaternion` (N, 4), and, where there are any, `goal`
        and `payload` (N, 3): MuJoCo's world frame, m. `flow` is since the last call. `dice` gives
        the generator of a world's noise; None: no noise. `of` has the worlds that are drawn, bool,
        shape (W,); None: all.
        """
        worlds, drones = self._shape
        of_world = {name: np.reshape(mask, (worlds, drones)) for name, mask in due.items()}
        needed = np.stack([mask.max(axis=1) for mask in of_world.values()]).max(axis=0)
        flows = any(view.kind == "flow" for view in self.views)
        first = fresh.reshape(worlds, drones).max(axis=1)
        with self._drawing.current():
            for world in range(worlds):
                if of is not None and not of[world]:
                    continue
                if not needed[world] and not flows:
                    continue
                rows = slice(world * drones, (world + 1) * drones)
                self._poses.set(self.data, {name: x[rows] for name, x in state.items()})
                if needed[world]:
                    mine = {name: mask[world] for name, mask in of_world.items()}
                    before = None if first[world] else self._before[world]
                    self._draw_world(rows, mine, before, dice and dice(world))
                if flows:
                    self._before[world] = self._poses.now(self.data)

    def snapshot(self) -> dict[str, np.ndarray]:
        """The last pictures, and the poses of each world's last frame, by name."""
        pictures = {name: taken.copy() for name, taken in self.pictures.items()}
        return {**pictures, "before": self._before.copy()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Put a snapshot back."""
        for name, array in (self.pictures | {"before": self._before}).items():
            array[:] = arrays[name]

    def lens(
        self, name: str, state: Mapping[str, np.ndarray], drone: int = 0, world: int = 0
    ) -> Lens:
        """The lens of a view's camera, of a drone of a world, in a state as of `take`."""
        drones = self._shape[1]
        rows = slice(world * drones, (world + 1) * drones)
        self._poses.set(self.data, {name: x[rows] for name, x in state.items()})
        return self._eyes[name][drone].lens(self.data)

    def _draw_world(
        self,
        rows: slice,
        due: Mapping[str, np.ndarray],
        before: np.ndarray | None,
        dice: np.random.Generator | None,
    ) -> None:
        """Pictures of the world that `data` is in."""
        shots: dict[_Eye, _Shot] = {}
        for view in self.views:
            for drone in np.flatnonzero(due[view.name]).tolist():
                eye = self._eyes[view.name][drone]
                shot = shots.setdefault(eye, _Shot())
                picture = self._picture(view, eye, shot, before, dice)
                self.pictures[view.name][rows.start + drone] = picture

    def _picture(
        self,
        view: View,
        eye: "_Eye",
        shot: "_Shot",
        before: np.ndarray | None,
        dice: np.random.Generator | None,
    ) -> np.ndarray:
        """A view's picture; views of one camera share its drawings by `shot`."""
        if view.kind == "rgb":
            if shot.rgb is None:
                colors, _ = self._render(eye, objects=False)
                shot.rgb = colors if dice is None else _exposed(colors, eye.optics, dice)
            return shot.rgb
        if shot.depth is None:
            shot.geoms, shot.depth = self._render(eye, objects=True)
        if view.kind == "depth":
            return shot.depth[..., None]
        if view.kind == "segmentation":
            numbers: np.ndarray = self._object[shot.geoms]
            return numbers[..., None]
        if before is None:
            return np.zeros(view.shape, np.float32)
        flow: np.ndarray = np.nan_to_num(self._flow(eye, shot.geoms, shot.depth, before))
        return flow

    def _render(self, eye: "_Eye", *, objects: bool) -> tuple[np.ndarray, np.ndarray]:
        """Colours, uint8 (H, W, 3); or numbers of geoms from 1, 0 for none, int32 (H, W), and their
        depth, float32 (H, W), m. The first row is on top.
        """
        scene = self._scene
        view_of = self._camera
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        view_of.fixedcamid = eye.camera
        # MuJoCo centres infinite planes on the scene's camera, so update it first.
        mujoco.mjv_updateCamera(self.model, self.data, view_of, scene)
        groups = self.model.geom_group[eye.discs]
        if objects:
            self.model.geom_group[eye.discs] = _HIDDEN
        mujoco.mjv_updateScene(self.model, self.data, self._option, None, view_of, every, scene)
        self.model.geom_group[eye.discs] = groups
        for flag in mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR:
            scene.flags[flag.value] = objects
        colors = np.empty((*eye.drawn, 3), np.uint8)
        depth = np.empty(eye.drawn, np.float32)
        if eye.source is not None:
            eye.source.aim(scene)
        self._drawing.draw(scene, colors, depth if objects else None)
        colors = colors[::-1]
        depth = depth[::-1]
        if not objects:
            return colors if eye.source is None else eye.source.blended(colors), depth
        if eye.source is not None:
            colors = eye.source.nearest(colors)
            depth = eye.source.nearest(depth)
        return self._number(eye, colors), self._meters(depth)

    def _number(self, eye: "_Eye", colors: np.ndarray) -> np.ndarray:
        """Number of the geom of each pixel of the last picture, from 1; 0: none."""
        scene = self._scene
        if len(eye.numbers) != scene.ngeom + 1:  # the same geoms in each picture, in one order
            geom = mujoco.mjtObj.mjOBJ_GEOM.value
            eye.numbers = np.zeros(scene.ngeom + 1, np.int32)
            for drawn in scene.geoms[: scene.ngeom]:
                if drawn.segid >= 0 and drawn.objtype == geom:
                    eye.numbers[drawn.segid + 1] = drawn.objid + 1
        code = colors.astype(np.uint32)
        numbers: np.ndarray = eye.numbers[code[..., 0] | code[..., 1] << 8 | code[..., 2] << 16]
        return numbers

    def _meters(self, depth: np.ndarray) -> np.ndarray:
        """Depth along the camera's axis, float32, m, from OpenGL's depth: 1 near, 0 far."""
        extent = self.model.stat.extent
        clip = self.model.vis.map
        near, far = (float(np.float32(end * extent)) for end in (clip.znear, clip.zfar))
        meters = near * far / (near + depth.astype(np.float64) * (far - near))
        limited: np.ndarray = np.minimum(meters, FARTHEST).astype(np.float32)
        return limited

    def _flow(
        self, eye: "_Eye", geoms: np.ndarray, depth: np.ndarray, before: np.ndarray
    ) -> np.ndarray:
        """Motion of each pixel's point since the poses `before`, right and down, pixels.

        NaN where the point was beside or behind the camera then.
        """
        now = self._poses.frames(self.data)
        lens = eye.lens(self.data)
        state = self._poses.now(self.data)
        self._poses.restore(self.data, before)
        past = self._poses.frames(self.data)
        old = eye.lens(self.data)
        self._poses.restore(self.data, state)
        bodies = np.append(0, self.model.geom_bodyid)[geoms.ravel()]
        depth = depth.ravel()
        rays = eye.rays
        middles = eye.middles
        flow = np.empty(middles.shape, np.float32)
        still = np.array_equal(lens.rotation, old.rotation)
        still &= np.array_equal(lens.translation, old.translation)
        # The body with most pixels first, over the whole picture without a mask: faster; the others
        # overwrite theirs.
        pixels = np.bincount(bodies)
        most, *others = np.argsort(-pixels)[: np.count_nonzero(pixels)].tolist()
        for body in (most, *others):
            which = slice(None) if body == most else bodies == body
            if still and all(map(np.array_equal, now[body], past[body])):
                flow[which] = 0.0
                continue
            (place, axes) = now[body]
            (old_place, old_axes) = past[body]
            turn = old.rotation @ old_axes @ axes.T
            start = turn @ (-lens.rotation.T @ lens.translation - place)
            start += old.rotation @ old_place + old.translation
            was = turn @ lens.rotation.T @ rays[:, which] * depth[which] + start[:, None]
            flow[which] = middles[which] - old.pixels(was.T)
        return flow.reshape(*eye.size, 2)

    def close(self) -> None:
        """Free the context. A second call does nothing."""
        if "_drawing" in vars(self):
            self._drawing.close()


def _exposed(colors: np.ndarray, optics: Optics, dice: np.random.Generator) -> np.ndarray:
    """Colours as a sensor reads them: see `Optics`."""
    (photons, reading) = optics.noise
    spread = optics.exposure
    if not (photons or reading or spread):
        return colors
    light = colors / 255 * np.exp2(spread * dice.standard_normal())
    light += np.sqrt(photons**2 * light + reading**2) * dice.standard_normal(colors.shape)
    read: np.ndarray = np.rint(255 * np.clip(light, 0.0, 1.0)).astype(np.uint8)
    return read


class _Shot:
    """What was drawn of an eye in one state."""

    rgb: np.ndarray | None = None
    depth: np.ndarray | None = None
    geoms: np.ndarray = np.zeros((0, 0), np.int32)


class _Eye:
    """A camera of a model, in pictures of one size (H, W). Raises `InputError`."""

    def __init__(
        self, model: mujoco.MjModel, number: int, size: tuple[int, int], camera: Camera
    ) -> None:
        self.camera = number
        self.size = size
        self.optics = camera.optics
        self._matrix = _matrix(model, number, size)
        self.numbers = np.zeros(0, np.int32)
        """Numbers of geoms from 1, by the colour code of segmentation."""
        self.discs = own_discs(model, number) if camera.carried else np.zeros(0, int)
        """Geoms that depth and segmentation leave out."""
        distorts = any(self.optics.distortion)
        self.source = _Source(self._still, size) if distorts else None
        self.drawn = self.source.size if self.source else size

    @property
    def _still(self) -> Lens:
        return Lens(self._matrix, np.eye(3), np.zeros(3), self.optics.distortion)

    def lens(self, data: mujoco.MjData) -> Lens:
        """Its lens where the model is."""
        rotation = (data.cam_xmat[self.camera].reshape(3, 3) * _FLIP).T
        place = -rotation @ data.cam_xpos[self.camera]
        return self._still._replace(rotation=rotation, translation=place)

    @cached_property
    def rays(self) -> np.ndarray:
        """As of `Lens.rays`, shape (3, H W)."""
        return np.ascontiguousarray(self._still.rays(*self.size).reshape(-1, 3).T)

    @cached_property
    def middles(self) -> np.ndarray:
        """Columns and rows of the middles of the pixels, shape (H W, 2)."""
        return np.indices(self.size)[::-1].reshape(2, -1).T + 0.5


class _Source:
    """A pinhole's picture, finer, from which a lens that distorts takes its own (H, W)."""

    def __init__(self, lens: Lens, size: tuple[int, int]) -> None:
        (height, width) = size
        pitch = 1 / _FINER / np.diagonal(lens.matrix)[:2]
        along = np.arange(width + 1.0)
        down = np.arange(height + 1.0)
        edges = [(x, y) for x in along for y in (0, height)] + [
            (x, y) for y in down for x in (0, width)
        ]
        seen = lens.rays_of(np.array(edges))[:, :2]
        low = seen.min(axis=0)
        high = seen.max(axis=0)
        width, height = (int(side) for side in np.ceil((high - low) / pitch))
        most = max(width, height)
        if most > _FINER * MAX_PIXELS:
            expected = f"a lens that needs at most {_FINER * MAX_PIXELS} pixels of a pinhole a side"
            raise InputError(f"distortion: expected {expected}, got {most}")
        self.size = height, width
        self._low = low
        self._high = low + pitch * (width, height)
        # Columns and rows, from the first pixel's middle.
        self._at = (lens.rays(*size)[..., :2] - low) / pitch - 0.5

    def aim(self, scene: mujoco.MjvScene) -> None:
        """Set the scene camera's frustum to what the lens sees."""
        (left, top) = self._low
        (right, bottom) = self._high
        for camera in scene.camera:
            near = camera.frustum_near
            camera.frustum_center = near * (left + right) / 2
            camera.frustum_width = near * (right - left) / 2
            camera.frustum_bottom = -near * bottom
            camera.frustum_top = -near * top

    def nearest(self, picture: np.ndarray) -> np.ndarray:
        """The lens's picture from the nearest pixels, for numbers that must not be mixed."""
        columns, rows = np.rint(self._at).astype(int).transpose(2, 0, 1)
        taken: np.ndarray = picture[rows, columns]
        return taken

    def blended(self, colors: np.ndarray) -> np.ndarray:
        """The lens's picture by bilinear interpolation, for colours."""
        columns, rows = np.floor(self._at).astype(int).transpose(2, 0, 1)
        right, down = (self._at % 1.0).transpose(2, 0, 1)[..., None]
        upper, lower = (
            (1 - right) * colors[row, columns] + right * colors[row, columns + 1]
            for row in (rows, rows + 1)
        )
        mixed: np.ndarray = np.rint((1 - down) * upper + down * lower).astype(np.uint8)
        return mixed


class _Poses:
    """Poses of the craft, and of what goes with them."""

    def __init__(self, model: mujoco.MjModel, names: Sequence[str]) -> None:
        self._model = model
        free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
        self._at = model.jnt_qposadr[free][:, None] + np.arange(7)
        bodies = {GOAL: [f"{name}/{GOAL}" for name in names], PAYLOAD: [PAYLOAD]}
        self._mocap = {
            kind: [int(model.body(name).mocapid[0]) for name in own]
            for kind, own in bodies.items()
            if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, own[0]) >= 0
        }

    def set(self, data: mujoco.MjData, state: Mapping[str, np.ndarray]) -> None:
        """Put them where a state has them."""
        data.qpos[self._at[:, :3]] = state["position"]
        data.qpos[self._at[:, 3:]] = state["quaternion"]
        for kind, bodies in self._mocap.items():
            if kind in state:
                data.mocap_pos[bodies] = state[kind][: len(bodies)]
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


def _matrix(model: mujoco.MjModel, camera: int, size: tuple[int, int]) -> np.ndarray:
    """K of a camera of a model, shape (3, 3), pixels."""
    height, width = size
    if model.cam_sensorsize[camera].any():
        focal = model.cam_intrinsic[camera]
        scale = np.array((width, height)) / model.cam_sensorsize[camera]
        fx, fy = focal[:2] * scale
        cx = width / 2 - focal[2] * scale[0]
        cy = height / 2 - focal[3] * scale[1]
    else:
        fx = fy = 0.5 * height / np.tan(np.radians(model.cam_fovy[camera]) / 2)
        cx = width / 2
        cy = height / 2
    return np.array(((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0)))
