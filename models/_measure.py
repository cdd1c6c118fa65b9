"""How the examination measures: flights, and answers to known forces and torques.

Frames: world x, y, z with z up; body x forward, y left, z up. SI units and radians throughout.
"""

from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .constants import HOVER_THRUST, NUM_ROTORS

__all__ = [
    "HEIGHT",
    "SPIN",
    "acceleration",
    "angular_momentum",
    "fly",
    "measured_allocation",
    "measured_inertia",
    "measured_mass",
    "ready",
    "spin_energy",
    "tumble",
]

Array = NDArray[np.float64]

HEIGHT: Final = 1000.0
"""Height at which flights begin, m: far enough from the floor for every one of them."""
SPIN: Final = (1.0, 2.0, 3.0)
"""Body rates with which tumbling begins, rad/s: about no axis of symmetry."""


def ready(model: mujoco.MjModel, ctrl: ArrayLike = 0.0, height: float = HEIGHT) -> Any:
    """New `MjData`: level and at rest at `height` (m), controls `ctrl` (N, scalar or (4,))."""
    data = mujoco.MjData(model)
    data.qpos[:] = (0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0)
    data.ctrl[:] = ctrl
    return data


def fly(model: mujoco.MjModel, data: Any, seconds: float) -> None:
    """Step `data` for `seconds`; RuntimeError if MuJoCo warned of anything."""
    mujoco.mj_step(model, data, nstep=round(seconds / model.opt.timestep))
    for kind, warning in zip(mujoco.mjtWarning.__members__, data.warning, strict=False):
        if warning.number:
            raise RuntimeError(f"expected a flight without warnings, got {kind} from MuJoCo")


def acceleration(
    model: mujoco.MjModel, ctrl: ArrayLike = 0.0, wrench: Sequence[float] = (0.0,) * 6
) -> Array:
    """Acceleration at rest and level, shape (6,): linear (world, m/s²), angular (body, rad/s²).

    `wrench` is an external force and torque at the centre of mass, world frame, N and N·m.
    """
    data = ready(model, ctrl)
    data.xfrc_applied[model.jnt_bodyid[0]] = wrench
    mujoco.mj_forward(model, data)
    return np.array(data.qacc)


def measured_mass(model: mujoco.MjModel) -> float:
    """Mass, kg: a force of 1 N along z over the acceleration that it adds."""
    added = acceleration(model, wrench=(0, 0, 1, 0, 0, 0)) - acceleration(model)
    return float(1.0 / added[2])


def measured_inertia(model: mujoco.MjModel) -> Array:
    """Inertia about the centre of mass, body axes, shape (3, 3), kg·m², from torques of 1 N·m."""
    rest = acceleration(model)
    turns = [acceleration(model, wrench=(0, 0, 0, *axis)) - rest for axis in np.eye(3)]
    return np.linalg.inv(np.array([turn[3:] for turn in turns]).T)


def measured_allocation(model: mujoco.MjModel) -> Array:
    """What one newton of each rotor does, shape (4, 4).

    Rows: thrust (N), roll, pitch and yaw torque (body frame, N·m); columns: rotors 1 to 4.
    """
    mass, inertia, rest = measured_mass(model), measured_inertia(model), acceleration(model)
    newtons = HOVER_THRUST
    columns = []
    for ctrl in newtons * np.eye(NUM_ROTORS):
        added = (acceleration(model, ctrl) - rest) / newtons
        columns.append([mass * added[2], *(inertia @ added[3:])])
    return np.array(columns).T


def tumble(model: mujoco.MjModel, seconds: float) -> tuple[Any, Any]:
    """(before, after) a fall of `seconds` that begins with the body rates `SPIN`."""
    before, after = ready(model), ready(model)
    before.qvel[3:] = after.qvel[3:] = SPIN
    fly(model, after, seconds)
    return before, after


def angular_momentum(inertia: Array, data: Any) -> Array:
    """Angular momentum about the centre of mass, world frame, shape (3,), kg·m²/s."""
    momentum = np.zeros(3)
    mujoco.mju_rotVecQuat(momentum, inertia @ data.qvel[3:], data.qpos[3:])
    return momentum


def spin_energy(inertia: Array, data: Any) -> float:
    """Kinetic energy of the rotation, J."""
    return float(data.qvel[3:] @ inertia @ data.qvel[3:]) / 2
