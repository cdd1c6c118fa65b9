"""The model of a world that cameras draw, and the names of its objects.

Pictures have a model of their own; the physics does not see it.
"""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from mujoco import MjModel, MjsBody, mjtGeom

from ..models.cameras import FARTHEST, place_camera
from ..models.fleet import members_of
from ..models.mjcf import swarm_spec
from ..models.swarm import drone_names
from ..models.vehicle import Vehicle
from ..scenes import add_scene
from ..scenes.marks import Mark
from .stage import LOOKS, scale_drawing

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


def objects_of(
    vehicle: Vehicle, drones: int, scene: str, marks: Sequence[Mark], *, payload: bool
) -> tuple[str, ...]:
    """`Cameras.objects` of such cameras, without an OpenGL."""
    return objects_in(drawn_model(vehicle, drones, scene, marks, payload=payload))[0]


def drawn_model(
    vehicle: Vehicle, drones: int, scene: str, marks: Sequence[Mark], *, payload: bool
) -> MjModel:
    """What is drawn: craft with their cameras, what surrounds them, the task's marks."""
    names = drone_names(drones)
    crafts = members_of(vehicle, drones)
    spec, bodies = swarm_spec([craft.path for craft in crafts], names)
    add_scene(spec, scene)
    for name, body, craft in zip(names, bodies, crafts, strict=True):
        for camera in craft.cameras:
            if camera not in craft.file_cameras:
                place_camera(spec, body, replace(camera, name=f"{name}/{camera.name}"))
    if payload:
        hung = spec.worldbody.add_body(name=PAYLOAD, mocap=True)
        _add(hung, PAYLOAD, mjtGeom.mjGEOM_SPHERE, (0.12 * crafts[0].radius,) * 3)
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


def own_discs(model: MjModel, camera: int) -> np.ndarray:
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
    discs: np.ndarray = np.flatnonzero(own & (alpha < 1))
    return discs


def _add(body: MjsBody, name: str, kind: mjtGeom, size: Sequence[float], **more: object) -> None:
    """A geom that is only drawn."""
    shape = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    geom = body.add_geom(name=name, type=shape, size=size, **more)
    geom.contype = geom.conaffinity = 0
    geom.mass = 0.0
    geom.group = 1


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


def objects_in(model: MjModel) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of a model's objects, and the object number of each geom, after a leading 0.

    All geoms of a craft are one object. So are geoms of the world with names of two or more slashes
    that agree up to the last one. A geom of the world without a name has that of its material.
    """
    known = {NOTHING: 0}
    numbers = [0]
    crafts = model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    names = drone_names(len(crafts))
    roots = dict(zip(model.body_rootid[crafts].tolist(), names, strict=True))
    for number in range(model.ngeom):
        geom = model.geom(number)
        material = int(geom.matid[0])
        name = geom.name or (model.material(material).name if material >= 0 else _UNNAMED)
        head, _, _ = name.rpartition("/")
        label = head if "/" in head else name
        root = int(model.body_rootid[geom.bodyid[0]])
        numbers.append(known.setdefault(roots.get(root, label), len(known)))
    return tuple(known), np.array(numbers, np.int32)
