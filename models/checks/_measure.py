"""Measurements of the examination: responses to known forces and torques, and flights.

Frames: world x, y, z with z up; body x forward, y left, z up. SI units and radians throughout.
"""

import copy
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..vehicle import Vehicle

__all__ = [
    "DRAG",
    "EXACT",
    "HEIGHT",
    "SPIN",
    "TRUNCATION",
    "Check",
    "RigidBody",
    "fly",
    "forces",
    "in_vacuum",
    "ready",
    "rigid_body",
]

Array = NDArray[np.float64]

HEIGHT: Final = 1000.0
"""Initial height of flights, m: none of them reaches the floor."""

EXACT: Final = 1e-9
"""Tolerance where the integrator is exact: the rounding errors of a flight."""

TRUNCATION: Final = 1e-6
"""Tolerance for tumbling flight, where RK4 truncates: 4e-7 rad/s in ten seconds at 10 ms for the
paper's vehicle. MuJoCo's Euler misses by 1 rad/s."""

SPIN: Final = (1.0, 2.0, 3.0)
"""Body rates with which tumbling begins, rad/s: about no axis of symmetry."""

DRAG: Final = "Unity's Rigidbody.drag, in the limit of small steps"
"""Source of the checks of linear drag."""

_STEPS_AT_ONCE: Final = 1000  # Ctrl-C waits for no more


@dataclass(frozen=True)
class Check:
    """One line of the examination."""

    name: str
    """Name of the measured quantity."""
    expected: float
    """Expected value."""
    measured: float
    """Measured value."""
    unit: str
    """Unit of the three numbers; empty for pure numbers."""
    source: str
    """Source of the expected value."""
    tolerance: float = EXACT
    """Largest difference that passes."""

    @property
    def passed(self) -> bool:
        """Whether measured and expected agree; NaN never does."""
        return abs(self.measured - self.expected) <= self.tolerance


@dataclass(frozen=True)
class RigidBody:
    """Properties of a body, identified from its response to known forces and torques."""

    mass_matrix: Array
    """Of the free joint, at rest and level: (6, 6), kg, kg·m, kg·m²."""

    @property
    def mass(self) -> float:
        """kg."""
        return float(self.mass_matrix[2, 2])

    @property
    def center_of_mass(self) -> Array:
        """Body frame, (3,), m."""
        m = self.mass_matrix
        return np.array((m[1, 5], m[2, 3], m[0, 4])) / self.mass

    @property
    def inertia(self) -> Array:
        """About the centre of mass, body axes, (3, 3), kg·m²."""
        c = self.center_of_mass
        return self.mass_matrix[3:, 3:] - self.mass * (c @ c * np.eye(3) - np.outer(c, c))

    def angular_momentum(self, data: Any) -> Array:
        """About the centre of mass, world frame, (3,), kg·m²/s."""
        return _turned(data, self.inertia @ data.qvel[3:])

    def spin_energy(self, data: Any) -> float:
        """Kinetic energy of the rotation, J."""
        return float(data.qvel[3:] @ self.inertia @ data.qvel[3:]) / 2

    def place(self, data: Any) -> Array:
        """Position of the centre of mass, world frame, (3,), m."""
        return np.array(data.qpos[:3]) + _turned(data, self.center_of_mass)

    def velocity(self, data: Any) -> Array:
        """Of the centre of mass, world frame, (3,), m/s."""
        turning = np.cross(data.qvel[3:], self.center_of_mass)
        return np.array(data.qvel[:3]) + _turned(data, turning)


def in_vacuum(vehicle: Vehicle) -> mujoco.MjModel:
    """A copy of its model without air and drag: a rigid body with thrusts."""
    model = copy.copy(vehicle.model)
    model.opt.density = model.opt.viscosity = 0.0
    model.opt.wind = model.dof_damping[:3] = 0.0
    return model


def ready(vehicle: Vehicle, model: mujoco.MjModel, thrust: ArrayLike = 0.0) -> Any:
    """New `MjData`: level, at rest, at `HEIGHT`; thrusts in N, one for all rotors or (R,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = (0.0, 0.0, HEIGHT, 1.0, 0.0, 0.0, 0.0)
    data.ctrl[:] = np.asarray(thrust) / [rotor.newtons for rotor in vehicle.rotors]
    return data


def fly(model: mujoco.MjModel, data: Any, seconds: float) -> float:
    """Step `data` for `seconds`, as a whole number of steps; returns the time flown, s.

    Raises:
        InputError: MuJoCo warned of anything. It resets bad states silently otherwise.
    """
    steps = left = max(1, round(seconds / model.opt.timestep))
    while left > 0:
        mujoco.mj_step(model, data, nstep=min(left, _STEPS_AT_ONCE))
        left -= _STEPS_AT_ONCE
    for kind, warning in zip(mujoco.mjtWarning.__members__, data.warning, strict=False):
        if warning.number:
            raise InputError(f"vehicle: expected a flight without warnings, got {kind} of MuJoCo")
    return float(steps * model.opt.timestep)


def rigid_body(vehicle: Vehicle, model: mujoco.MjModel) -> RigidBody:
    """Push and turn it by a newton and a newton metre about each axis, at rest and level."""
    data = ready(vehicle, model)
    rest = _acceleration(model, data)
    answers = []
    for wrench in np.eye(6):
        data.qfrc_applied[:] = wrench
        answers.append(_acceleration(model, data) - rest)
    return RigidBody(np.asarray(np.linalg.inv(np.array(answers).T), np.float64))


def forces(
    vehicle: Vehicle,
    model: mujoco.MjModel,
    body: RigidBody,
    thrust: ArrayLike = 0.0,
    velocity: ArrayLike = 0.0,
) -> Array:
    """Force and torque about the body's origin on the level craft, less its weight: (6,), N, N·m.

    Args:
        thrust: N, one for all rotors or (R,).
        velocity: World frame, (3,), m/s.
    """
    data = ready(vehicle, model, thrust)
    data.qvel[:3] = velocity
    return body.mass_matrix @ (_acceleration(model, data) - (0, 0, -vehicle.gravity, 0, 0, 0))


def _acceleration(model: mujoco.MjModel, data: Any) -> Array:
    mujoco.mj_forward(model, data)
    return np.array(data.qacc)


def _turned(data: Any, vector: Array) -> Array:
    """A vector of the body frame in the world frame, (3,)."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, vector, data.qpos[3:])
    return turned
