"""The MuJoCo spec of a vehicle's TOML file: built from its tables, or completed from its model."""

import math
import os
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import MjsBody, MjSpec, mjtGeom

from .cameras import ORIGIN, UP, place_camera
from .coefficients import COEFFICIENTS, PREFIX, as_tuple
from .errors import InputError
from .files import find_in_package, read_own_toml
from .vehicle_file import Box, Cylinder, PlacedRotor, VehicleFile

Vector = Sequence[float] | np.ndarray

DEFAULT_TIMESTEP = 0.01
"""Physics step of a file without one, s."""
DEFAULT_GRAVITY = 9.81
"""Downward acceleration of a file without one, m/s²."""
_LOOKS = read_own_toml(__file__, "craft")


def craft_spec(file: VehicleFile, base: MjSpec | None = None) -> MjSpec:
    """The vehicle alone, without ground; `base` is the spec of its model, changed in place."""
    spec = base or MjSpec()
    spec.modelname = file.name
    urdf = file.model is not None and file.model.suffix.lower() == ".urdf"
    if urdf or file.model is None:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        spec.option.timestep = DEFAULT_TIMESTEP
        spec.option.gravity = (0.0, 0.0, -DEFAULT_GRAVITY)
    if file.timestep:
        spec.option.timestep = file.timestep
    if file.gravity:
        spec.option.gravity = (0.0, 0.0, -file.gravity)
    if file.model is None:
        _build(spec, file)
    else:
        if urdf:
            _free_root(spec, file.model.parent)
        _add_rotors(spec, file)
    for number in file.numbers:
        if number.name in COEFFICIENTS:
            name = PREFIX + number.name
            numeric = spec.numeric(name) or spec.add_numeric(name=name)
            numeric.data = as_tuple(number.value)
            numeric.size = len(numeric.data)
    for craft in free_bodies(spec)[:1]:
        for camera in file.cameras:
            body = spec.worldbody if camera.stands else craft
            place_camera(spec, body, camera)
    return spec


def free_bodies(spec: MjSpec) -> list[MjsBody]:
    """The bodies with a free joint: the craft of a spec."""
    free = mujoco.mjtJoint.mjJNT_FREE
    return [body for body in spec.bodies if any(joint.type == free for joint in body.joints)]


def _add_actuator(
    spec: MjSpec, file: VehicleFile, rotor: PlacedRotor, site: mujoco.MjsSite
) -> None:
    """A motor at a site: thrust along the rotor's axis, and a reaction about it."""
    axis = np.multiply(rotor.axis, 1 / math.hypot(*rotor.axis))
    torque = file.rotors.reaction or 0.0
    spec.add_actuator(
        name=rotor.name,
        target=site.name,
        trntype=mujoco.mjtTrn.mjTRN_SITE,
        gear=(*axis, *np.multiply(axis, torque if rotor.turn == "cw" else -torque)),
        ctrllimited=True,
        ctrlrange=file.rotors.thrust,
    )


def _add_geom(
    body: MjsBody,
    name: str,
    kind: str,
    colour: str,
    size: Vector,
    *,
    group: int = 2,
    mass: float = 0.0,
    solid: bool = False,
    **place: object,
) -> None:
    """A geom that is drawn; a solid one collides."""
    body.add_geom(
        name=name,
        type=getattr(mjtGeom, f"mjGEOM_{kind.upper()}"),
        rgba=_LOOKS["colours"][colour],
        size=(*size, 0.0, 0.0)[:3],
        group=group,
        mass=mass,
        contype=int(solid),
        conaffinity=int(solid),
        **place,
    )


# ---- from the tables


def _build(spec: MjSpec, file: VehicleFile) -> None:
    """Masses, geoms that collide, geoms that are drawn, and the rotors.

    Missing lengths are those of quad.xml, in the proportion of the spans.
    """
    spec.compiler.degree = False
    rotors = [(rotor, rotor.position or ORIGIN) for rotor in file.rotors.list]
    reach = max(math.hypot(*place) for _, place in rotors)
    reach = max(reach, file.rotors.radius or 0.0, 1e-2)
    unit = reach / math.sqrt(2)  # 1 m of quad.xml
    half = np.multiply(file.body.size or _sides(file.body.parts, unit), 0.5)
    motor = 0.06 * unit
    lowest = max(half[2], *(motor - place[2] for _, place in rotors))
    clearance = file.body.ground_clearance or lowest + 0.33 * unit
    if clearance <= lowest:
        raise InputError(
            f"body.ground_clearance: expected more than {lowest:.4g} m, which hub and rotors need, "
            f"got {clearance:g}"
        )
    body = spec.worldbody.add_body(name="craft", pos=(0.0, 0.0, clearance))
    body.add_freejoint(name="free")
    _add_mass(body, file)
    seen = 3 if file.body.parts else 1  # if parts are drawn, hub and motors are not
    _add_geom(body, "hub", "box", "carbon", half, group=seen, solid=True)
    for rotor, place in rotors:
        size = (0.09 * unit, motor)
        turn = _along(rotor.axis)
        name = f"motor {rotor.name}"
        _add_geom(body, name, "cylinder", "silver", size, pos=place, group=seen, solid=True, **turn)
    _add_skids(body, half, unit, clearance)
    for name, (colour, sides, place) in _LOOKS["on_hub"].items():
        size = np.multiply(half, sides)
        _add_geom(body, name, "ellipsoid", colour, size, pos=np.multiply(half, place))
    radius = file.rotors.radius or 0.4 * _nearest([place for _, place in rotors], reach)
    for number, (rotor, place) in enumerate(rotors, 1):
        if not file.body.parts and math.hypot(*place[:2]) > half[0]:
            ends = (*ORIGIN, *place)
            _add_geom(body, f"arm{number}", "cylinder", "carbon", (0.035 * unit,), fromto=ends)
        up = np.multiply(rotor.axis, 0.09 * unit / math.hypot(*rotor.axis))
        above = np.add(place, up)
        colour = "front_disc" if place[0] > 1e-6 * reach else "disc"
        _add_disc(body, f"disc{number}", rotor, radius, above, colour)
        blade = np.multiply((0.97, 0.09, 0.018), radius)
        turn = _along(rotor.axis) or {"euler": (0.0, 0.0, 0.4 + 1.5 * number)}
        _add_geom(body, "", "ellipsoid", "carbon", blade, pos=above, **turn)
        site = body.add_site(name=rotor.name, pos=place, group=4, size=(0.02 * unit, 0.005, 0.005))
        _add_actuator(spec, file, rotor, site)


def _along(axis: Vector) -> dict[str, Any]:
    """Orientation of a geom with this z axis."""
    return {} if tuple(axis) == UP else {"zaxis": axis}


def _add_disc(
    body: MjsBody, name: str, rotor: PlacedRotor, radius: float, place: Vector, colour: str
) -> None:
    size = (radius, 0.01 * radius)
    _add_geom(body, name, "cylinder", colour, size, pos=place, **_along(rotor.axis))


def _sides(parts: Sequence[Box | Cylinder], unit: float) -> Vector:
    """Of the hub of a file without its size: of the heaviest box, if there are any."""
    boxes = [part for part in parts if isinstance(part, Box)]
    if not boxes:
        return np.multiply((0.44, 0.44, 0.14), unit)
    return max(boxes, key=lambda box: box.mass).size


def _add_mass(body: MjsBody, file: VehicleFile) -> None:
    """Mass and inertia as given, or parts that have them."""
    table = file.body
    for number, part in enumerate(table.parts, 1):
        if isinstance(part, Box):
            kind = "box"
            size = np.multiply(part.size, 0.5)
            turn: dict[str, Any] = {"euler": (0.0, 0.0, part.yaw)}
        else:
            kind = "cylinder"
            size = (part.radius, part.length / 2)
            turn = _along(part.axis)
        name = f"part{number}"
        place = part.position
        _add_geom(body, name, kind, "carbon", size, pos=place, mass=part.mass, group=1, **turn)
    if table.parts:
        return
    body.explicitinertial = True
    body.mass = table.mass
    body.ipos = table.center_of_mass or ORIGIN
    if len(table.inertia) == 3:
        body.inertia = table.inertia
    else:
        body.fullinertia = table.inertia


def _add_skids(body: MjsBody, half: Vector, unit: float, clearance: float) -> None:
    """Two skids that collide, each on two struts."""
    thick = min(0.03 * unit, (clearance - half[2]) / 2)
    low = thick - clearance
    long = 0.5 * unit
    for side, y in (("left", 0.45 * unit), ("right", -0.45 * unit)):
        ends = (-long, y, low, long, y, low)
        name = f"skid {side}"
        _add_geom(body, name, "capsule", "silver", (thick,), fromto=ends, group=1, solid=True)
        for x in (-0.6 * long, 0.6 * long):
            top = (math.copysign(0.7 * half[0], x), math.copysign(0.8 * half[1], y), -half[2] / 2)
            _add_geom(body, "", "capsule", "silver", (0.7 * thick,), fromto=(*top, x, y, low))


def _nearest(places: Sequence[Vector], reach: float) -> float:
    """Shortest distance between two rotors that are not above each other, m."""
    distances = [math.dist(a[:2], b[:2]) for a, b in combinations(places, 2)]
    return min((one for one in distances if one > 0.1 * reach), default=reach)


# ---- from a model's file


def _free_root(spec: MjSpec, folder: Path) -> None:
    """Find the meshes of a URDF file's packages, and free its first link."""
    for mesh in spec.meshes:
        if mesh.file.startswith("package:"):
            found = find_in_package(mesh.file, folder)
            if found is None:
                raise InputError(
                    "model.file: expected its meshes in its folder or one above, "
                    f"got no file for {mesh.file}"
                )
            mesh.file = os.path.relpath(found, folder)
    spec.compiler.fusestatic = False  # it would fuse the root with the world
    root = spec.worldbody.first_body()
    if root is None:
        raise InputError("model.file: expected a URDF file with links, got none")
    if not list(root.joints):
        root.add_freejoint()


def _add_rotors(spec: MjSpec, file: VehicleFile) -> None:
    """Add the rotors of the list to a model without actuators."""
    rotors = file.rotors.list
    if rotors and list(spec.actuators):
        raise InputError(
            "rotors.list: expected none for a model's file with actuators, which are its rotors, "
            f"got {len(rotors)} of them"
        )
    for number, rotor in enumerate(rotors, 1):
        site = _rotor_site(spec, file, rotor, f"rotors.list[{number}]")
        _add_actuator(spec, file, rotor, site)


def _rotor_site(spec: MjSpec, file: VehicleFile, rotor: PlacedRotor, where: str) -> mujoco.MjsSite:
    """The site of a rotor: one of the model, or a new one on one of its bodies."""
    if rotor.site is None:
        kind = "body"
        parts = spec.bodies
    else:
        kind = "site"
        parts = spec.sites
    name = rotor.site or rotor.link or rotor.body
    known = [part.name for part in parts if part.name != "world"]
    if name not in known:
        words = ", ".join(known)
        raise InputError(f"{where}: expected a {kind} of the model's file: {words}, got {name!r}")
    if rotor.site is not None:
        return spec.site(name)
    body = spec.body(name)
    for joint in list(body.joints):  # a propeller that turns is welded on
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    place = rotor.position or ORIGIN
    if file.rotors.radius is not None:
        _add_disc(body, "", rotor, file.rotors.radius, place, "disc")
    return body.add_site(name=f"rotor/{rotor.name}", pos=place, group=4)
