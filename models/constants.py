"""The vehicle's numbers, for code that must not import MuJoCo (the agent's side of the wire).

`quad.xml` states the same numbers for the simulator; `tests/test_model.py` holds the two together.
Sources stand in `models/README.md`.
"""

from typing import Final

__all__ = [
    "ARM_LENGTH",
    "ARM_MASS",
    "ARM_RADIUS",
    "GRAVITY",
    "HOVER_THRUST",
    "HUB_MASS",
    "HUB_SIZE",
    "MASS",
    "MAX_CLIMB_ACCELERATION",
    "MAX_THRUST",
    "MOTOR_HEIGHT",
    "MOTOR_MASS",
    "MOTOR_RADIUS",
    "NUM_ROTORS",
    "PHYSICS_TIMESTEP",
    "REST_HEIGHT",
    "ROTOR_DIAMETER",
    "ROTOR_POSITIONS",
    "YAW_MOMENT_CONSTANT",
    "YAW_SIGNS",
]

MASS: Final = 20.0
"""Mass, kg (paper, section 2.2)."""

GRAVITY: Final = 9.8
"""Gravitational acceleration, m/s² (paper, section 2.2: 9.8, not 9.81)."""

NUM_ROTORS: Final = 4

MAX_THRUST: Final = 100.0
"""Largest thrust of one rotor, N; the smallest is 0 (paper, section 2.2)."""

HOVER_THRUST: Final = MASS * GRAVITY / NUM_ROTORS
"""Thrust of one rotor at which the craft neither climbs nor sinks: 49 N."""

MAX_CLIMB_ACCELERATION: Final = NUM_ROTORS * MAX_THRUST / MASS - GRAVITY
"""Upward acceleration at full thrust: 10.2 m/s²."""

PHYSICS_TIMESTEP: Final = 0.005
"""Step of the integrator (RK4), s. Ours; `models/README.md` has the convergence test behind it."""

ROTOR_POSITIONS: Final = ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0))
"""(x, y) of rotors 1 to 4 in the body frame (x forward, y left), m: front left, front right, rear
right, rear left. The 2 m square is the paper's (section 2.2); the numbering is ours."""

ROTOR_DIAMETER: Final = 0.8
"""Diameter of the drawn propellers, m. Ours; it enters only through `YAW_MOMENT_CONSTANT`."""

YAW_MOMENT_CONSTANT: Final = 0.05
"""Reaction torque about body z per newton of thrust, N·m/N = m. An assumption of ours."""

YAW_SIGNS: Final = (1, -1, 1, -1)
"""Sign of the reaction torque of rotors 1 to 4 about body z. Diagonal pairs share a sign, so that
the pattern differs from those of roll (+, −, −, +) and pitch (−, −, +, +)."""

REST_HEIGHT: Final = 0.4
"""Height of the centre above the floor when the craft stands on its skids, m. Ours."""

HUB_MASS: Final = 12.0
"""Mass of the hub, a box, kg. Ours, as are all the masses and sizes below: they sum to `MASS`."""

HUB_SIZE: Final = (0.44, 0.44, 0.14)
"""Full edge lengths of the hub along x, y and z, m."""

ARM_MASS: Final = 1.2
"""Mass of one arm, a cylinder from the centre to its motor, kg."""

ARM_RADIUS: Final = 0.035
"""Radius of an arm, m."""

ARM_LENGTH: Final = 2.0**0.5
"""Length of an arm, m: from the centre to a corner of the 2 m square."""

MOTOR_MASS: Final = 0.8
"""Mass of one motor, an upright cylinder at the rotor's place, kg."""

MOTOR_RADIUS: Final = 0.09
"""Radius of a motor, m."""

MOTOR_HEIGHT: Final = 0.12
"""Height of a motor, m."""
