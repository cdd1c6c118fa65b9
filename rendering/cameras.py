"""Pictures that the cameras of drones take of their worlds: colours, depth, objects.

A picture shows exactly the state that `take` gets: no time passes. Pictures have a model of their
own; the physics does not see it.

Pixels: row 0 is the top, column 0 the left; the middle of the first pixel is at (0.5, 0.5).
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

import mujoco
import numpy as np
from mujoco import MjModel, MjsBody

from ..models.cameras import FARTHEST, View, place_camera, place_cameras
from ..models.fleet import members_of
from ..models.mjcf import swarm_spec
from ..models.swarm import drone_names
from ..models.vehicle import Vehicle, owners
from ..scenes import SceneConfig
from ..scenes.build import add_scene, move_geoms
from ..scenes.looks import PICTURED
from ..scenes.marks import Mark
from .gl import Offscreen
from .stage import LOOKS, scale_drawing

Array = np.ndarray
Arrays = Mapping[str, Array]
NOTHING = "nothing"
"""Name of what a segmentation picture has where it sees no object: number 0."""
GOAL = "goal"
"""Of the body of a drone's marks that move, behind the drone's name and a slash."""
PAYLOAD = "payload"
"""Of the body of the payload, which all drones of a world share."""
_NEAREST = 0.05  # Where drawing begins, over the vehicle's radius
_THINNEST = 0.04  # Thickness of a disc, over the height at which the lowest craft rests
_PLAIN = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom that has that of its material
_UNNAMED = "unnamed"
_HIDDEN = 5  # a group of geoms that is not drawn


class Cameras:
    """Cameras of W worlds of A drones. Raises `InputError`, and `take` raises `NoOpenGL`.

    Marks are those of the task's spec: gates, discs and balls, fixed in the world or moving with
    each drone's goal. A view is one array of pictures, all of one size. `fine` draws smooth edges
    and shadows, and takes several times as long.

    Attributes:
        views: As given.
        objects: Names of objects; a segmentation picture has their indices.
        model: What is drawn.
        data: Of the world that was drawn last.
        pictures: The last picture of each drone by the view's name, shape (N, H, W, channels).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        views: Sequence[View],
        shape: tuple[int, int] = (1, 1),
        *,
        scene: str | SceneConfig = "plain",
        marks: Sequence[Mark] = (),
        payload: bool = False,
        fine: bool = False,
    ) -> None:
        self.views = tuple(views)
        self._shape = shape
        names = drone_names(shape[1])
        self.model = drawn_model(vehicle, shape[1], scene, marks, payload=payload)
        self.data = mujoco.MjData(self.model)
        self._scene = scene
        self.objects, self._object = objects_in(self.model)
        rows = shape[0] * shape[1]
        self.pictures = {
            view.name: np.zeros((rows, *view.shape), view.dtype) for view in self.views
        }
        self._cameras = {view.name: self._camera_ids(view, names) for view in self.views}
        self._geoms: dict[int, Array] = {}
        self._moved = {
            GOAL: self._mocap_ids([f"{name}/{GOAL}" for name in names]),
            PAYLOAD: self._mocap_ids([PAYLOAD]),
        }
        self._fine = fine
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED

    def _camera_ids(self, view: View, names: Sequence[str]) -> list[int]:
        """The camera of each drone of a world; a fixed camera counts for all drones."""
        name = view.camera.name
        fixed = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if fixed >= 0:
            return [fixed] * len(names)
        return [self.model.camera(f"{drone}/{name}").id for drone in names]

    def _mocap_ids(self, names: Sequence[str]) -> list[int]:
        """Those of the bodies of these names that the model has."""
        ids = [mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name) for name in names]
        return [int(self.model.body_mocapid[body]) for body in ids if body >= 0]

    @cached_property
    def _drawing(self) -> Offscreen:
        """Opened with the first picture, so that a process may be forked before."""
        height = max(view.shape[0] for view in self.views)
        width = max(view.shape[1] for view in self.views)
        return Offscreen(self.model, width, height, fine=self._fine)

    def open(self) -> None:
        """Open OpenGL, as `take` does in its thread. A second call does nothing."""
        with self._drawing.current():
            pass

    def take(self, due: Arrays, state: Arrays) -> None:
        """Take pictures of the worlds as they are.

        `due` has, by view name, the drones that take a picture, bool, shape (N,).

        The state has `position` (N, 3) and `quaternion` (N, 4), and, where there are any, `goal`
        and `payload` (N, 3): MuJoCo's world frame, m, and `time` of their episodes, (N,), s.
        """
        of_world = {name: np.reshape(mask, self._shape) for name, mask in due.items()}
        needed = np.any(list(of_world.values()), axis=(0, 2))
        with self._drawing.current():
            for world in np.flatnonzero(needed).tolist():
                rows = self._pose(state, world)
                mine = {name: mask[world] for name, mask in of_world.items()}
                self._draw_world(rows.start, mine)

    def _pose(self, state: Arrays, world: int) -> slice:
        """Put the model where a state has a world; the rows of the world's drones."""
        drones = self._shape[1]
        rows = slice(world * drones, (world + 1) * drones)
        if "time" in state:
            move_geoms(self.model, self._scene, float(state["time"][rows.start]))
        poses = self.data.qpos.reshape(drones, 7)
        poses[:, :3] = state["position"][rows]
        poses[:, 3:] = state["quaternion"][rows]
        for name, bodies in self._moved.items():
            if bodies and name in state:
                self.data.mocap_pos[bodies] = state[name][rows][: len(bodies)]
        place_cameras(self.model, self.data)
        return rows

    def _draw_world(self, first: int, due: Arrays) -> None:
        """Pictures of the world that `data` is in. Views of one camera share its drawings."""
        drawn: dict[tuple[int, int, int, bool], tuple[Array, Array]] = {}
        for view in self.views:
            height, width, _ = view.shape
            for drone in np.flatnonzero(due[view.name]).tolist():
                drawing = self._cameras[view.name][drone], width, height, view.kind != "rgb"
                if drawing not in drawn:
                    drawn[drawing] = self._draw(*drawing)
                picture, depth = drawn[drawing]
                if view.kind == "depth":
                    picture = depth
                self.pictures[view.name][first + drone] = picture.reshape(view.shape)

    def _draw(self, camera: int, width: int, height: int, objects: bool) -> tuple[Array, Array]:
        """Colours, uint8 (H, W, 3), or numbers of objects, int32 (H, W), and in this case their
        depth, float32 (H, W), m. The first row is on top.
        """
        scene = self._drawing.scene
        self._camera.fixedcamid = camera
        # MuJoCo centres infinite planes on the scene's camera, so update it first.
        mujoco.mjv_updateCamera(self.model, self.data, self._camera, scene)
        discs = own_discs(self.model, camera)
        groups = self.model.geom_group[discs]
        if objects:
            self.model.geom_group[discs] = _HIDDEN
        self._drawing.update(self.data, self._camera)
        self.model.geom_group[discs] = groups
        for flag in mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR:
            scene.flags[flag.value] = objects
        colors = np.empty((height, width, 3), np.uint8)
        depth = np.empty((height, width), np.float32)
        self._drawing.draw(colors, depth if objects else None)
        colors = colors[::-1]
        if not objects:
            return colors, depth
        return self._object[self._geom_numbers(camera, colors)], self._meters(depth[::-1])

    def _geom_numbers(self, camera: int, colors: Array) -> Array:
        """Number of the geom of each pixel of the last picture, from 1; 0: none."""
        scene = self._drawing.scene
        if camera not in self._geoms:  # the same geoms in each picture, in one order
            geom = mujoco.mjtObj.mjOBJ_GEOM.value
            geoms = np.zeros(scene.ngeom + 1, np.int32)
            for drawn in scene.geoms[: scene.ngeom]:
                if drawn.segid >= 0 and drawn.objtype == geom:
                    geoms[drawn.segid + 1] = drawn.objid + 1
            self._geoms[camera] = geoms
        codes = colors @ np.array((1, 1 << 8, 1 << 16))
        numbers: Array = self._geoms[camera][codes]
        return numbers

    def _meters(self, depth: Array) -> Array:
        """Depth along the camera's axis, float32, m, from OpenGL's depth: 1 near, 0 far."""
        extent = self.model.stat.extent
        near = float(np.float32(self.model.vis.map.znear * extent))
        far = float(np.float32(self.model.vis.map.zfar * extent))
        meters = near * far / (near + depth.astype(np.float64) * (far - near))
        return np.minimum(meters, FARTHEST).astype(np.float32)

    def close(self) -> None:
        """Free the context. A second call does nothing."""
        if "_drawing" in vars(self):
            self._drawing.close()


# ---- the model that is drawn


def drawn_model(
    vehicle: Vehicle, drones: int, scene: str | SceneConfig, marks: Sequence[Mark], *, payload: bool
) -> MjModel:
    """What is drawn: craft with their cameras, what surrounds them, the task's marks."""
    names = drone_names(drones)
    crafts = members_of(vehicle, drones)
    spec, bodies = swarm_spec([craft.path for craft in crafts], names)
    add_scene(spec, scene)
    for name, body, craft in zip(names, bodies, crafts, strict=True):
        for camera in craft.cameras:
            if camera not in craft.file_cameras:
                place_camera(spec, body, camera, f"{name}/")
    if payload:
        hung = spec.worldbody.add_body(name=PAYLOAD, mocap=True)
        _add(hung, PAYLOAD, "sphere", (0.12 * crafts[0].radius,) * 3)
    thinnest = _THINNEST * min(craft.rest_height for craft in crafts)
    for number, mark in enumerate(marks):
        if not mark.moves:
            _add_mark(spec.worldbody, f"task/{mark.shape}_{number}", mark, thinnest)
            continue
        for name in names:
            goal = spec.body(f"{name}/{GOAL}")
            goal = goal or spec.worldbody.add_body(name=f"{name}/{GOAL}", mocap=True)
            _add_mark(goal, f"task/{mark.shape}_{number} of {name}", mark, thinnest)
    model = spec.compile()
    scale_drawing(model, vehicle.radius, 0.0)
    extent = model.stat.extent
    nearest = _NEAREST * min(craft.radius for craft in crafts)
    model.vis.map.znear = nearest / extent
    model.vis.map.zfar = FARTHEST / extent
    return model


def own_discs(model: MjModel, camera: int) -> Array:
    """Numbers of the geoms of a camera's craft that are seen through, as its rotors' discs are.

    None of a camera that no craft carries.
    """
    root = model.body_rootid[model.cam_bodyid[camera]]
    fixed = model.cam_mode[camera] == mujoco.mjtCamLight.mjCAMLIGHT_FIXED.value
    if not fixed or not model.body_jntnum[root]:
        return np.zeros(0, int)
    plain = (model.geom_rgba == _PLAIN).all(axis=1)
    materials = np.append(model.mat_rgba[:, 3], 1.0)[model.geom_matid]
    alpha = np.where(plain, materials, model.geom_rgba[:, 3])
    own = model.body_rootid[model.geom_bodyid] == root
    return np.flatnonzero(own & (alpha < 1))


def _add(body: MjsBody, name: str, kind: str, size: Sequence[float], **more: object) -> None:
    """A geom that is only drawn."""
    shape = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    body.add_geom(name=name, type=shape, size=size, **PICTURED, **more)


def _add_mark(body: MjsBody, name: str, mark: Mark, thickness: float) -> None:
    """A mark of a task, as viewers show it; discs have a thickness, m."""
    rgba = (*LOOKS["marks"][mark.shape], 1.0)
    parts = mark.parts(thickness)
    for number, part in enumerate(parts):
        own = f"{name}/{number}" if len(parts) > 1 else name
        start = np.add(mark.position, part.start)
        end = np.add(mark.position, part.end)
        place = {"pos": start}
        if part.kind != "sphere":
            place = {"fromto": np.concatenate((start, end))}
        size = (part.radius, 0.0, 0.0)
        _add(body, own, part.kind, size, rgba=rgba, **place)


def objects_in(model: MjModel) -> tuple[tuple[str, ...], Array]:
    """Names of a model's objects, and the object number of each geom, after a leading 0.

    All geoms of a craft are one object. So are geoms of the world with names of two or more slashes
    that agree up to the last one. A geom of the world without a name has that of its material.
    """
    known = {NOTHING: 0}
    numbers = [0]
    owner = owners(model)
    names = drone_names(int(owner.max()) + 1)
    for number in range(model.ngeom):
        geom = model.geom(number)
        material = int(geom.matid[0])
        name = geom.name or (model.material(material).name if material >= 0 else _UNNAMED)
        head, _, _ = name.rpartition("/")
        label = head if "/" in head else name
        drone = owner[geom.bodyid[0]]
        if drone >= 0:
            label = names[drone]
        numbers.append(known.setdefault(label, len(known)))
    return tuple(known), np.array(numbers, np.int32)
