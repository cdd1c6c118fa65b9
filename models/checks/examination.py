"""The physical examination: simulated motions of a vehicle, compared with closed forms.

Every figure is measured in simulation (accelerations under known forces and torques, positions
after a flight). Any vehicle is held to mechanics and to what `Vehicle` derives from its compiled
model; the paper's vehicle is held to the paper's numbers too (`paper.py`).
`tests/test_physics.py` shows that damaged models fail; `rotorgram check-model` prints the checks.

Frames: world x, y, z with z up; body x forward, y left, z up. SI units and radians throughout.
"""

import copy
from collections.abc import Iterator
from typing import Final

import mujoco
import numpy as np

from .. import QUAD_XML
from ..errors import InputError
from ..vehicle import Vehicle
from ._measure import (
    DRAG,
    EXACT,
    HEIGHT,
    SPIN,
    TRUNCATION,
    Check,
    RigidBody,
    fly,
    forces,
    in_vacuum,
    ready,
    rigid_body,
)
from .paper import examine_paper

__all__ = ["examine"]

_LEAST_TIMESTEP: Final = 1e-4  # s: 20 s of flights take seconds
_MODEL: Final = "compiled model"
_MECHANICS: Final = "rigid-body mechanics"


def examine(vehicle: Vehicle, *, paper: bool | None = None) -> list[Check]:
    """Run the whole examination on a vehicle; its model does not change.

    Args:
        vehicle: Any.
        paper: Compare it with the paper's numbers too. None: if it is the vehicle of this package.

    Raises:
        InputError: MuJoCo warned during a flight, or the physics step is below 0.1 ms.
    """
    if vehicle.timestep < _LEAST_TIMESTEP:
        raise InputError(
            f"vehicle: expected a physics step of at least {_LEAST_TIMESTEP:g} s to be examined, "
            f"got {vehicle.timestep:g}"
        )
    model = in_vacuum(vehicle)
    body = rigid_body(vehicle, model)
    checks = [
        *_body(vehicle, body),
        *_rotors(vehicle, model, body),
        *_free_fall(vehicle, model),
        *_hover(vehicle, model),
        *_climb(vehicle, model),
        *_tumbling(vehicle, model, body),
        *_resting(vehicle),
        *_linear_drag(vehicle, model, body),
    ]
    if paper if paper is not None else vehicle.path == QUAD_XML.resolve():
        checks += examine_paper(vehicle, body)
    return checks


def _body(vehicle: Vehicle, body: RigidBody) -> Iterator[Check]:
    """Mass, centre of mass and inertia, from the answers to known forces and torques."""
    yield Check("mass", vehicle.mass, body.mass, "kg", _MODEL, EXACT * vehicle.mass)
    off = _size(body.center_of_mass - vehicle.center_of_mass)
    yield Check("centre of mass: difference", 0.0, off, "m", _MODEL)
    off, size = _size(body.inertia - vehicle.inertia), _size(vehicle.inertia)
    yield Check("inertia: difference of the matrices", 0.0, off, "kg·m²", _MODEL, EXACT * size)


def _rotors(vehicle: Vehicle, model: mujoco.MjModel, body: RigidBody) -> Iterator[Check]:
    """Effect and limits of each rotor, and of all rotors together."""
    low, high = vehicle.thrust_low, vehicle.thrust_high
    idle = forces(vehicle, model, body, low)
    columns = []
    for i, rotor in enumerate(vehicle.rotors):
        one = np.where(np.arange(vehicle.num_rotors) == i, high, low)
        pushed = (forces(vehicle, model, body, one) - idle) / (rotor.high - rotor.low)
        columns.append(np.append(pushed[2], pushed[3:] - np.cross(body.center_of_mass, pushed[:3])))
        off = _size(columns[i] - vehicle.allocation[:, i])
        name = f"{rotor.name}: difference of thrust and torques per newton"
        yield Check(name, 0.0, off, "", _MODEL)
    vertical, weight = vehicle.allocation[0], vehicle.mass * vehicle.gravity
    for more_or_less, asked, given in (
        ("more than they have", high + 50.0, high),
        ("less", low - 50.0, low),
    ):
        name = f"thrust of all when asked for {more_or_less}"
        measured = float(forces(vehicle, model, body, asked)[2])
        yield Check(name, float(vertical @ given), measured, "N", _MODEL, EXACT * weight)
    rank = float(np.linalg.matrix_rank(np.array(columns), rtol=1e-6))
    source = "six degrees of freedom, four of them to be had singly"
    yield Check("rank of the allocation matrix", 4.0, rank, "", source, 0.0)


def _free_fall(vehicle: Vehicle, model: mujoco.MjModel) -> Iterator[Check]:
    """Depth of a fall: g t² / 2. Semi-implicit Euler misses by g h t / 2."""
    model = _unpowered(model)
    data = ready(vehicle, model)
    depth = vehicle.gravity * fly(model, data, 2.0) ** 2 / 2
    yield Check("free fall in 2 s", depth, HEIGHT - float(data.qpos[2]), "m", _MECHANICS)


def _hover(vehicle: Vehicle, model: mujoco.MjModel) -> Iterator[Check]:
    """With hover thrusts the craft neither accelerates nor turns, and keeps its position."""
    data = ready(vehicle, model, vehicle.hover_thrust)
    mujoco.mj_forward(model, data)
    answer = np.array(data.qacc)
    fly(model, data, 5.0)
    for name, value, unit in (
        ("acceleration", answer[:3], "m/s²"),
        ("angular acceleration", answer[3:], "rad/s²"),
        ("drift in 5 s", data.qpos[:3] - (0.0, 0.0, HEIGHT), "m"),
    ):
        yield Check(f"hover: {name}", 0.0, _size(value), unit, _MECHANICS)


def _climb(vehicle: Vehicle, model: mujoco.MjModel) -> Iterator[Check]:
    """Acceleration of a climb at the largest multiple of the hover's thrusts, from the height."""
    hover = vehicle.hover_thrust
    most = float(np.min(vehicle.thrust_high[hover > 0] / hover[hover > 0]))
    data = ready(vehicle, model, most * hover)
    measured = 2 / fly(model, data, 2.0) ** 2 * (float(data.qpos[2]) - HEIGHT)
    expected, name = vehicle.gravity * (most - 1), "climb at the largest balanced thrust"
    yield Check(name, expected, measured, "m/s²", _MECHANICS, EXACT * max(1.0, most))


def _tumbling(vehicle: Vehicle, model: mujoco.MjModel, body: RigidBody) -> Iterator[Check]:
    """Ten seconds of torque-free tumbling: conserved quantities, and the path of the fall."""
    model = _unpowered(model)
    before, after = ready(vehicle, model), ready(vehicle, model)
    before.qvel[3:] = after.qvel[3:] = SPIN
    seconds = fly(model, after, 10.0)
    start, end = body.angular_momentum(before), body.angular_momentum(after)
    fallen = body.place(before) + body.velocity(before) * seconds
    fallen[2] -= vehicle.gravity * seconds**2 / 2
    energy = body.spin_energy(after) / body.spin_energy(before) - 1
    for name, value, unit in (
        ("relative change of angular momentum", _size(end - start) / _size(start), ""),
        ("relative change of energy", energy, ""),
        ("centre of mass off its path", _size(body.place(after) - fallen), "m"),
    ):
        yield Check(f"tumbling 10 s: {name}", 0.0, value, unit, _MECHANICS, TRUNCATION)


def _resting(vehicle: Vehicle) -> Iterator[Check]:
    """Dropped by 5 cm, the craft settles; soft contact lets it sink in by some 0.1 mm."""
    data = ready(vehicle, vehicle.model)
    data.qpos[2] = vehicle.rest_height + 0.05
    fly(vehicle.model, data, 5.0)
    rest, height = vehicle.rest_height, float(data.qpos[2])
    yield Check("at rest on the floor: height", rest, height, "m", _MODEL, 1e-3)
    for name, value, unit in (("speed", data.qvel[:3], "m/s"), ("turning", data.qvel[3:], "rad/s")):
        yield Check(f"at rest on the floor: {name}", 0.0, _size(value), unit, _MECHANICS, 1e-6)


def _linear_drag(vehicle: Vehicle, model: mujoco.MjModel, body: RigidBody) -> Iterator[Check]:
    """With the option `linear_drag` d, speed v is met by a force of −d m v and by no torque."""
    drag, velocity = 0.5, np.array((6.0, -8.0, 10.0))
    dragged = copy.copy(model)
    dragged.dof_damping[:] = Vehicle.load(vehicle.path, linear_drag=drag).model.dof_damping
    added = forces(vehicle, dragged, body, velocity=velocity) - forces(vehicle, model, body)
    tolerance = EXACT * vehicle.mass * vehicle.gravity
    for name, value, unit in (
        ("force", added[:3] + drag * vehicle.mass * velocity, "N"),
        ("torque about the body's origin", added[3:], "N·m"),
    ):
        yield Check(f"linear drag: difference of {name}", 0.0, _size(value), unit, DRAG, tolerance)


def _unpowered(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy with rotors that give no thrust, not even their least."""
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return model


def _size(values: np.ndarray) -> float:
    """Euclidean length of all elements."""
    return float(np.linalg.norm(values))
