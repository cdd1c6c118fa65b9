"""The physical examination: what a vehicle does, measured by flying it, against closed forms.

Every figure is measured in simulation (accelerations under known forces and torques, positions
after a flight). Any vehicle is held to mechanics and to what `Vehicle` derives from its compiled
model; the paper's vehicle is held to the paper's numbers too (`paper.py`).
`tests/test_physics.py` shows that damaged models fail; `rotorgram check-model` prints the checks.

Frames: world x, y, z with z up; body x forward, y left, z up. SI units and radians throughout.
"""

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from .. import QUAD_XML
from ..errors import InputError
from ..vehicle import Vehicle
from ._measure import HEIGHT, RigidBody, fly, forces, in_vacuum, ready, rigid_body

__all__ = ["EXACT", "SPIN", "TRUNCATION", "Check", "examine"]

EXACT: Final = 1e-9
"""Tolerance where the integrator is exact: it leaves room for rounding over a flight, no more."""

TRUNCATION: Final = 1e-6
"""Tolerance for tumbling flight, where RK4 truncates: 4e-7 rad/s in ten seconds at 10 ms for the
paper's vehicle. MuJoCo's Euler misses by 1 rad/s."""

SPIN: Final = (1.0, 2.0, 3.0)
"""Body rates with which tumbling begins, rad/s: about no axis of symmetry."""
_LEAST_TIMESTEP: Final = 1e-4  # s: 20 s of flights take seconds
_MODEL: Final = "compiled model"


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the examination."""

    name: str
    """What was measured."""
    measured: float
    """The value that the simulation gave."""
    expected: float = 0.0
    """The value worked out beforehand."""
    tolerance: float = EXACT
    """Largest difference that passes."""
    unit: str = ""
    """Unit of the three numbers; empty for pure numbers."""
    source: str = "rigid-body mechanics"
    """Where the expected value comes from."""

    @property
    def passed(self) -> bool:
        """Whether measured and expected agree; NaN never does."""
        return abs(self.measured - self.expected) <= self.tolerance


def examine(vehicle: Vehicle, *, paper: bool | None = None) -> list[Check]:
    """Fly a vehicle through the whole examination; its model is left as it was.

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
        from .paper import examine_paper

        checks += examine_paper(vehicle, body)
    return checks


def _body(vehicle: Vehicle, body: RigidBody) -> Iterator[Check]:
    """Mass, centre of mass and inertia, from the answers to known forces and torques."""
    yield Check(
        name="mass",
        expected=vehicle.mass,
        measured=body.mass,
        tolerance=EXACT * vehicle.mass,
        unit="kg",
        source=_MODEL,
    )
    yield Check(
        name="centre of mass: difference",
        measured=_size(body.center_of_mass - vehicle.center_of_mass),
        unit="m",
        source=_MODEL,
    )
    yield Check(
        name="inertia: difference of the matrices",
        measured=_size(body.inertia - vehicle.inertia),
        tolerance=EXACT * _size(vehicle.inertia),
        unit="kg·m²",
        source=_MODEL,
    )


def _rotors(vehicle: Vehicle, model: mujoco.MjModel, body: RigidBody) -> Iterator[Check]:
    """What a newton of each rotor does, what limits it, and what all can do together."""
    low, high = vehicle.thrust_low, vehicle.thrust_high
    idle = forces(vehicle, model, body, low)
    columns = []
    for i, rotor in enumerate(vehicle.rotors):
        one = np.where(np.arange(vehicle.num_rotors) == i, high, low)
        pushed = (forces(vehicle, model, body, one) - idle) / (rotor.high - rotor.low)
        columns.append(np.append(pushed[2], pushed[3:] - np.cross(body.center_of_mass, pushed[:3])))
        yield Check(
            name=f"{rotor.name}: difference of thrust and torques per newton",
            measured=_size(columns[i] - vehicle.allocation[:, i]),
            source=_MODEL,
        )
    vertical = vehicle.allocation[0]
    limits = {"more than they have": (high + 50.0, high), "less": (low - 50.0, low)}
    for name, (asked, given) in limits.items():
        yield Check(
            name=f"thrust of all when asked for {name}",
            expected=float(vertical @ given),
            measured=float(forces(vehicle, model, body, asked)[2]),
            tolerance=EXACT * vehicle.mass * vehicle.gravity,
            unit="N",
            source=_MODEL,
        )
    yield Check(
        name="rank of the allocation matrix",
        expected=4.0,
        measured=float(np.linalg.matrix_rank(np.array(columns), rtol=1e-6)),
        tolerance=0.0,
        source="six degrees of freedom, four of them to be had singly",
    )


def _free_fall(vehicle: Vehicle, model: mujoco.MjModel) -> Iterator[Check]:
    """Depth of a fall: g t² / 2. Semi-implicit Euler misses by g h t / 2."""
    data = ready(vehicle, _unpowered(model))
    seconds = fly(_unpowered(model), data, 2.0)
    yield Check(
        name="free fall in 2 s",
        expected=vehicle.gravity * seconds**2 / 2,
        measured=HEIGHT - float(data.qpos[2]),
        unit="m",
    )


def _hover(vehicle: Vehicle, model: mujoco.MjModel) -> Iterator[Check]:
    """At the hover's thrusts nothing accelerates or turns, and the craft stays where it was."""
    data = ready(vehicle, model, vehicle.hover_thrust)
    mujoco.mj_forward(model, data)
    answer = np.array(data.qacc)
    fly(model, data, 5.0)
    values = {
        "acceleration": (answer[:3], "m/s²"),
        "angular acceleration": (answer[3:], "rad/s²"),
        "drift in 5 s": (data.qpos[:3] - (0.0, 0.0, HEIGHT), "m"),
    }
    for name, (value, unit) in values.items():
        yield Check(name=f"hover: {name}", measured=_size(value), unit=unit)


def _climb(vehicle: Vehicle, model: mujoco.MjModel) -> Iterator[Check]:
    """Acceleration of a climb at the largest multiple of the hover's thrusts, from the height."""
    hover = vehicle.hover_thrust
    most = float(np.min(vehicle.thrust_high[hover > 0] / hover[hover > 0]))
    data = ready(vehicle, model, most * hover)
    seconds = fly(model, data, 2.0)
    yield Check(
        name="climb at the largest balanced thrust",
        expected=vehicle.gravity * (most - 1),
        measured=2 * (float(data.qpos[2]) - HEIGHT) / seconds**2,
        tolerance=EXACT * max(1.0, most),
        unit="m/s²",
    )


def _tumbling(vehicle: Vehicle, model: mujoco.MjModel, body: RigidBody) -> Iterator[Check]:
    """Ten seconds of torque-free tumbling: what is conserved, and where the fall leads."""
    model = _unpowered(model)
    before, after = ready(vehicle, model), ready(vehicle, model)
    before.qvel[3:] = after.qvel[3:] = SPIN
    seconds = fly(model, after, 10.0)
    momentum = body.angular_momentum(before)
    fallen = body.place(before) + body.velocity(before) * seconds
    fallen[2] -= vehicle.gravity * seconds**2 / 2
    values = {
        "relative change of angular momentum": (
            _size(body.angular_momentum(after) - momentum) / _size(momentum),
            "",
        ),
        "relative change of energy": (body.spin_energy(after) / body.spin_energy(before) - 1, ""),
        "centre of mass off its path": (_size(body.place(after) - fallen), "m"),
    }
    for name, (value, unit) in values.items():
        yield Check(name=f"tumbling 10 s: {name}", measured=value, tolerance=TRUNCATION, unit=unit)


def _resting(vehicle: Vehicle) -> Iterator[Check]:
    """Dropped by 5 cm, the craft settles; soft contact lets it sink in by some 0.1 mm."""
    data = ready(vehicle, vehicle.model)
    data.qpos[2] = vehicle.rest_height + 0.05
    fly(vehicle.model, data, 5.0)
    yield Check(
        name="at rest on the floor: height",
        expected=vehicle.rest_height,
        measured=float(data.qpos[2]),
        tolerance=1e-3,
        unit="m",
        source=_MODEL,
    )
    for name, value, unit in (("speed", data.qvel[:3], "m/s"), ("turning", data.qvel[3:], "rad/s")):
        yield Check(
            name=f"at rest on the floor: {name}", measured=_size(value), tolerance=1e-6, unit=unit
        )


def _linear_drag(vehicle: Vehicle, model: mujoco.MjModel, body: RigidBody) -> Iterator[Check]:
    """With the option `linear_drag` d, speed v is met by a force of −d m v and by no torque."""
    drag, velocity = 0.5, np.array((6.0, -8.0, 10.0))
    dragged = copy.copy(model)
    dragged.dof_damping[:] = Vehicle.load(vehicle.path, linear_drag=drag).model.dof_damping
    added = forces(vehicle, dragged, body, velocity=velocity) - forces(vehicle, model, body)
    weight = vehicle.mass * vehicle.gravity
    for name, value, unit in (
        ("force", added[:3] + drag * vehicle.mass * velocity, "N"),
        ("torque about the body's origin", added[3:], "N·m"),
    ):
        yield Check(
            name=f"linear drag: difference of {name}",
            measured=_size(value),
            tolerance=EXACT * weight,
            unit=unit,
            source="Unity's Rigidbody.drag, in the limit of small steps",
        )


def _unpowered(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose rotors do nothing, not even their least."""
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return model


def _size(values: np.ndarray) -> float:
    """Euclidean length of all elements."""
    return float(np.linalg.norm(values))
