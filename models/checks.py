"""The physical examination: what the vehicle does, measured by flying it, against closed forms.

Every figure is measured in simulation (accelerations under known forces and torques, positions
after a flight) and compared with a value worked out on paper. `tests/test_physics.py` asserts the
checks and shows that broken models fail them; `rotorgram check-model` prints them.

Frames: world x, y, z with z up; body x forward, y left, z up. SI units and radians throughout.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from ._measure import (
    HEIGHT,
    SPIN,
    acceleration,
    angular_momentum,
    fly,
    measured_allocation,
    measured_inertia,
    measured_mass,
    ready,
    spin_energy,
    tumble,
)
from .constants import (
    ARM_LENGTH,
    ARM_MASS,
    ARM_RADIUS,
    GRAVITY,
    HOVER_THRUST,
    HUB_MASS,
    HUB_SIZE,
    MASS,
    MAX_CLIMB_ACCELERATION,
    MAX_THRUST,
    MOTOR_HEIGHT,
    MOTOR_MASS,
    MOTOR_RADIUS,
    NUM_ROTORS,
    REST_HEIGHT,
    ROTOR_POSITIONS,
    YAW_MOMENT_CONSTANT,
    YAW_SIGNS,
)
from .loading import apply_linear_drag

__all__ = ["Check", "closed_form_inertia", "examine"]

_PAPER: Final = "paper, section 2.2"
_GEOMETRY: Final = "closed form of our geometry"
_MECHANICS: Final = "rigid-body mechanics"
_EXACT: Final = 1e-9
"""Tolerance where the integrator is exact: it leaves room for rounding over a flight, no more."""
_TRUNCATION: Final = 1e-7
"""Tolerance for tumbling flight, where RK4 truncates: 3e-8 rad/s here in ten seconds.
MuJoCo's Euler misses by 0.5 rad/s."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One line of the examination."""

    name: str
    """What was measured."""
    expected: float
    """The value worked out by hand."""
    measured: float
    """The value that the simulation gave."""
    tolerance: float
    """Largest difference that passes."""
    unit: str
    """Unit of the three numbers; empty for pure numbers."""
    source: str
    """Where the expected value comes from."""

    @property
    def passed(self) -> bool:
        """Whether measured and expected agree; NaN never does."""
        return abs(self.measured - self.expected) <= self.tolerance


def examine(model: mujoco.MjModel) -> list[Check]:
    """Fly `model` through the whole examination; the model itself is left as it was.

    Raises:
        ValueError: if the model is not one free body with four actuators.
        RuntimeError: if MuJoCo warns during a flight (it resets bad states silently otherwise).
    """
    found = (model.njnt, model.nq, model.nv, model.nu)
    if found != (1, 7, 6, NUM_ROTORS):
        raise ValueError(
            f"expected one free joint and {NUM_ROTORS} actuators: (njnt, nq, nv, nu) = "
            f"(1, 7, 6, {NUM_ROTORS}), got {found}"
        )
    return [check for measure in _EXAMINATION for check in measure(model)]


def closed_form_inertia() -> tuple[float, float]:
    """(Ixx = Iyy, Izz) about the centre, kg·m², from the geometry in `constants`.

    Hub: a box. Each arm: a cylinder whose centre lies half its length out along a diagonal; of its
    moments along (a) and across (c) itself, x sees (a + c) / 2 and z sees c, and the products of
    inertia of the four cancel. Each motor: an upright cylinder, moved by Steiner's theorem.
    """
    width_x, width_y, height = HUB_SIZE
    hub_x = HUB_MASS * (width_y**2 + height**2) / 12
    hub_z = HUB_MASS * (width_x**2 + width_y**2) / 12
    arm_along = ARM_MASS * ARM_RADIUS**2 / 2
    arm_across = ARM_MASS * ((3 * ARM_RADIUS**2 + ARM_LENGTH**2) / 12 + (ARM_LENGTH / 2) ** 2)
    motor_x = MOTOR_MASS * ((3 * MOTOR_RADIUS**2 + MOTOR_HEIGHT**2) / 12 + ARM_LENGTH**2 / 2)
    motor_z = MOTOR_MASS * (MOTOR_RADIUS**2 / 2 + ARM_LENGTH**2)
    ixx = hub_x + NUM_ROTORS * ((arm_along + arm_across) / 2 + motor_x)
    izz = hub_z + NUM_ROTORS * (arm_across + motor_z)
    return ixx, izz


# --- the checks -----------------------------------------------------------------------------------


def _mass(model: mujoco.MjModel) -> list[Check]:
    """Mass, from the answer to a known force."""
    return [
        Check(
            name="mass",
            expected=MASS,
            measured=measured_mass(model),
            tolerance=_EXACT,
            unit="kg",
            source=_PAPER,
        )
    ]


def _inertia(model: mujoco.MjModel) -> list[Check]:
    """Moments of inertia against the closed form, and no products of inertia."""
    measured = measured_inertia(model)
    ixx, izz = closed_form_inertia()
    values = {
        "inertia Ixx": (ixx, measured[0, 0]),
        "inertia Iyy": (ixx, measured[1, 1]),
        "inertia Izz": (izz, measured[2, 2]),
        "largest product of inertia": (0.0, np.abs(measured - np.diag(np.diag(measured))).max()),
    }
    return [
        Check(
            name=name,
            expected=expected,
            measured=float(value),
            tolerance=_EXACT,
            unit="kg·m²",
            source=_GEOMETRY,
        )
        for name, (expected, value) in values.items()
    ]


def _free_fall(model: mujoco.MjModel) -> list[Check]:
    """Depth after two seconds without thrust: g t² / 2. Semi-implicit Euler misses by g h t / 2."""
    data = ready(model)
    fly(model, data, 2.0)
    return [
        Check(
            name="free fall in 2 s",
            expected=GRAVITY * 2.0**2 / 2,
            measured=HEIGHT - float(data.qpos[2]),
            tolerance=_EXACT,
            unit="m",
            source=f"{_PAPER}: g = 9.8 m/s²",
        )
    ]


def _hover(model: mujoco.MjModel) -> list[Check]:
    """At 49 N each nothing accelerates or turns, and ten seconds leave the craft where it was."""
    rates = acceleration(model, HOVER_THRUST)
    data = ready(model, HOVER_THRUST)
    fly(model, data, 10.0)
    drift = math.dist(data.qpos[:3], (0.0, 0.0, HEIGHT))
    values = {
        "hover: acceleration": (float(np.linalg.norm(rates[:3])), "m/s²"),
        "hover: angular acceleration": (float(np.linalg.norm(rates[3:])), "rad/s²"),
        "hover: drift in 10 s": (drift, "m"),
    }
    return [
        Check(
            name=name,
            expected=0.0,
            measured=value,
            tolerance=_EXACT,
            unit=unit,
            source=f"{_PAPER}: m g / 4 = 49 N",
        )
        for name, (value, unit) in values.items()
    ]


def _full_thrust(model: mujoco.MjModel) -> list[Check]:
    """Acceleration of a two-second climb at 100 N each, from the height gained."""
    data = ready(model, MAX_THRUST)
    fly(model, data, 2.0)
    return [
        Check(
            name="climb at full thrust",
            expected=MAX_CLIMB_ACCELERATION,
            measured=2 * (float(data.qpos[2]) - HEIGHT) / 2.0**2,
            tolerance=_EXACT,
            unit="m/s²",
            source=f"{_PAPER}: 4 · 100 N / m − g",
        )
    ]


def _clipping(model: mujoco.MjModel) -> list[Check]:
    """Total thrust when the controls ask for more than 100 N and for less than 0 N."""
    mass, fall = measured_mass(model), acceleration(model)[2]
    limits = {"at 150 N": (150.0, NUM_ROTORS * MAX_THRUST), "at −50 N": (-50.0, 0.0)}
    return [
        Check(
            name=f"thrust of all four with controls {name}",
            expected=expected,
            measured=float(mass * (acceleration(model, ctrl)[2] - fall)),
            tolerance=_EXACT,
            unit="N",
            source=f"{_PAPER}: 0 to 100 N",
        )
        for name, (ctrl, expected) in limits.items()
    ]


def _torques(model: mujoco.MjModel) -> list[Check]:
    """Roll, pitch and yaw torque per newton of each rotor: y, −x and ±k."""
    allocation = measured_allocation(model)
    checks = []
    for rotor, ((x, y), sign) in enumerate(zip(ROTOR_POSITIONS, YAW_SIGNS, strict=True)):
        values = {
            "roll": (y, f"{_PAPER}: square; numbering ours"),
            "pitch": (-x, f"{_PAPER}: square; numbering ours"),
            "yaw": (sign * YAW_MOMENT_CONSTANT, "assumption of ours"),
        }
        for row, (axis, (expected, source)) in enumerate(values.items(), start=1):
            checks.append(
                Check(
                    name=f"rotor {rotor + 1}: {axis} torque per newton",
                    expected=expected,
                    measured=float(allocation[row, rotor]),
                    tolerance=_EXACT,
                    unit="m",
                    source=source,
                )
            )
    return checks


def _rank(model: mujoco.MjModel) -> list[Check]:
    """Thrust, roll, pitch and yaw can be had one without the others."""
    return [
        Check(
            name="rank of the allocation matrix",
            expected=4.0,
            measured=float(np.linalg.matrix_rank(measured_allocation(model), tol=1e-6)),
            tolerance=0.0,
            unit="",
            source="six degrees of freedom, four inputs: " + _PAPER,
        )
    ]


def _tumbling(model: mujoco.MjModel) -> list[Check]:
    """Ten seconds of torque-free tumbling: conserved quantities and the symmetric top.

    With Ixx = Iyy the rates about x and y turn about body z at (Izz − Ixx) / Ixx · ωz, for ever.
    """
    seconds = 10.0
    before, after = tumble(model, seconds)
    inertia = measured_inertia(model)
    ixx, izz = closed_form_inertia()
    start = angular_momentum(inertia, before)
    lost = np.linalg.norm(angular_momentum(inertia, after) - start) / np.linalg.norm(start)
    energy = spin_energy(inertia, after) / spin_energy(inertia, before) - 1
    turned = complex(*SPIN[:2]) * np.exp(1j * (izz - ixx) / ixx * SPIN[2] * seconds)
    miss = math.dist(after.qvel[3:], (turned.real, turned.imag, SPIN[2]))
    values = {
        "tumbling 10 s: relative change of angular momentum": (float(lost), ""),
        "tumbling 10 s: relative change of energy": (energy, ""),
        "tumbling 10 s: body rates against the symmetric top": (miss, "rad/s"),
    }
    return [
        Check(
            name=name,
            expected=0.0,
            measured=value,
            tolerance=_TRUNCATION,
            unit=unit,
            source=_MECHANICS,
        )
        for name, (value, unit) in values.items()
    ]


def _resting(model: mujoco.MjModel) -> list[Check]:
    """Dropped by 5 cm, the craft settles on its skids; soft contact lets it sink 0.1 mm."""
    data = ready(model, height=REST_HEIGHT + 0.05)
    fly(model, data, 5.0)
    values = {
        "at rest on the floor: height": (REST_HEIGHT, data.qpos[2], 1e-3, "m"),
        "at rest on the floor: speed": (0.0, np.linalg.norm(data.qvel[:3]), 1e-6, "m/s"),
        "at rest on the floor: turning": (0.0, np.linalg.norm(data.qvel[3:]), 1e-6, "rad/s"),
    }
    return [
        Check(
            name=name,
            expected=expected,
            measured=float(value),
            tolerance=tolerance,
            unit=unit,
            source=_GEOMETRY,
        )
        for name, (expected, value, tolerance, unit) in values.items()
    ]


def _linear_drag(model: mujoco.MjModel) -> list[Check]:
    """With drag d, hovering at 10 m/s: v(t) = 10 exp(−d t), and a turn about z goes on."""
    dragged = copy.copy(model)
    apply_linear_drag(dragged, 0.5)
    data = ready(dragged, HOVER_THRUST)
    data.qvel[:] = (10.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    fly(dragged, data, 2.0)
    values = {
        "speed after 2 s of drag 0.5 /s from 10 m/s": (10 * math.exp(-1), data.qvel[0], "m/s"),
        "turn of 1 rad/s after 2 s of linear drag": (1.0, data.qvel[5], "rad/s"),
    }
    return [
        Check(
            name=name,
            expected=expected,
            measured=float(value),
            tolerance=_EXACT,
            unit=unit,
            source="Unity's Rigidbody.drag, in the limit of small steps",
        )
        for name, (expected, value, unit) in values.items()
    ]


_EXAMINATION: Final[tuple[Callable[[mujoco.MjModel], list[Check]], ...]] = (
    _mass,
    _inertia,
    _free_fall,
    _hover,
    _full_thrust,
    _clipping,
    _torques,
    _rank,
    _tumbling,
    _resting,
    _linear_drag,
)
