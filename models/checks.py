"""The physical examination: simulated motions of a vehicle, compared with closed forms.

Any vehicle is held to mechanics and to what `Vehicle` derives from its compiled model; the paper's
is held to the paper's numbers too, and to ours where it gives none.

World frame: z up. Body frame: x forward, y left, z up. SI units and radians throughout.
"""

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import QUAD_XML
from .constants import GRAVITY, MASS, MAX_THRUST, NUM_ROTORS, SIDE
from .errors import expect
from .vehicle import Vehicle

Array = NDArray[np.float64]

_LEAST_TIMESTEP: Final = 1e-4  # s: 20 s of flights take seconds
_STEPS_AT_ONCE: Final = 1000  # Ctrl-C waits for no more
_HEIGHT: Final = 1000.0  # m: flights begin here, and none reaches the floor
_SPIN: Final = (1.0, 2.0, 3.0)  # rad/s: tumbling begins about no axis of symmetry

_EXACT: Final = 1e-9  # Tolerance where the integrator is exact: the rounding errors of a flight
# Tolerance for tumbling flight, where RK4 truncates: 4e-7 rad/s in ten seconds at 10 ms for the
# paper's vehicle. MuJoCo's Euler misses by 1 rad/s.
_TRUNCATION: Final = 1e-6

# Sources of expected values.
_MODEL: Final = "compiled model"
_MECHANICS: Final = "rigid-body mechanics"
_DRAG: Final = "Unity's Rigidbody.drag, in the limit of small steps"
_PAPER: Final = "paper, section 2.2"
_GEOMETRY: Final = "closed form of our geometry"

# The paper's drone has a mass "concentrated in the centre", so it would have no inertia: the parts
# below are ours, as are numbering and reaction of the rotors.
_HUB_MASS, _HUB_WIDTH, _HUB_HEIGHT = 12.0, 0.44, 0.14  # kg, m: a box
_ARM_MASS, _ARM_RADIUS = 1.2, 0.035  # kg, m: a cylinder from the centre to its motor
_MOTOR_MASS, _MOTOR_RADIUS, _MOTOR_HEIGHT = 0.8, 0.09, 0.12  # kg, m: an upright cylinder
_REST_HEIGHT = 0.4  # m: the centre above the floor
_REACTION = 0.05  # N·m per newton
_ROTORS: Final = {  # (x, y) in half sides of the square, and sign of the reaction
    "front left": (1, 1, 1),
    "front right": (1, -1, -1),
    "rear right": (-1, -1, 1),
    "rear left": (-1, 1, -1),
}


@dataclass(frozen=True)
class Check:
    """One line of the examination."""

    name: str
    expected: float
    measured: float
    unit: str
    """Of the three numbers; empty for pure numbers."""
    source: str
    """Of the expected value."""
    tolerance: float = _EXACT

    @property
    def passed(self) -> bool:
        """Whether measured and expected agree; NaN never does."""
        return abs(self.measured - self.expected) <= self.tolerance


def examine(vehicle: Vehicle, *, paper: bool | None = None) -> list[Check]:
    """Run the whole examination on a vehicle; its model does not change.

    With `paper` it is compared with the paper's numbers too; None: if it is the vehicle of this
    package. Raises `InputError` if MuJoCo warns in flight, or the physics step is below 0.1 ms.
    """
    expected = f"a physics step of at least {_LEAST_TIMESTEP:g} s to be examined"
    long = vehicle.timestep >= _LEAST_TIMESTEP
    expect(long, "vehicle", expected, f"{vehicle.timestep:g}")
    model = copy.copy(vehicle.model)  # without air and drag
    model.opt.density = model.opt.viscosity = 0.0
    model.opt.wind = model.dof_damping[:3] = 0.0
    craft = _Craft(vehicle, model)
    parts = [_mass, _rotors, _free_fall, _hover, _climb, _tumbling, _resting, _linear_drag]
    checks = [check for part in parts for check in part(craft)]
    if paper if paper is not None else vehicle.path == QUAD_XML.resolve():
        expected, rotors = f"the {NUM_ROTORS} rotors of the paper", vehicle.num_rotors
        expect(rotors == NUM_ROTORS, "vehicle", expected, f"{rotors}")
        craft = _Craft(vehicle, vehicle.model)  # with air and drag, if any, for the paper has none
        parts = [_paper_numbers, _paper_rotors, _paper_flights, _spinning_top, _paper_drag]
        checks += [check for part in parts for check in part(craft)]
    return checks


class _Craft:
    """A vehicle as one of its models flies, and as it answers to known forces and torques."""

    def __init__(self, vehicle: Vehicle, model: mujoco.MjModel) -> None:
        self.vehicle, self.model = vehicle, model
        data = self.ready()
        rest = self.acceleration(data)
        answers = []
        for wrench in np.eye(6):
            data.qfrc_applied[:] = wrench
            answers.append(self.acceleration(data) - rest)
        # Of the free joint, at rest and level: (6, 6), kg, kg·m, kg·m².
        self.mass_matrix = m = np.asarray(np.linalg.inv(np.array(answers).T), np.float64)
        self.mass = float(m[2, 2])
        self.center_of_mass = c = np.array((m[1, 5], m[2, 3], m[0, 4])) / self.mass
        # About the centre of mass, body axes, (3, 3), kg·m².
        self.inertia = m[3:, 3:] - self.mass * (c @ c * np.eye(3) - np.outer(c, c))

    def unpowered(self) -> "_Craft":
        """The same with rotors that give no thrust, not even their least."""
        model = copy.copy(self.model)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
        return _Craft(self.vehicle, model)

    def ready(self, thrust: ArrayLike = 0.0) -> Any:
        """New `MjData`: level, at rest, at `_HEIGHT`; thrusts in N, one for all rotors or (R,)."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = (0.0, 0.0, _HEIGHT, 1.0, 0.0, 0.0, 0.0)
        data.ctrl[:] = np.asarray(thrust) / [rotor.newtons for rotor in self.vehicle.rotors]
        return data

    def acceleration(self, data: Any) -> Array:
        """Of the free joint: (6,), m/s², rad/s²."""
        mujoco.mj_forward(self.model, data)
        return np.array(data.qacc)

    def forces(self, thrust: ArrayLike = 0.0, velocity: ArrayLike = 0.0) -> Array:
        """Force and torque about its origin, level, less its weight: (6,), N, N·m.

        `thrust` as of `ready`; `velocity` in the world frame, (3,), m/s.
        """
        data = self.ready(thrust)
        data.qvel[:3] = velocity
        fall = (0, 0, -self.vehicle.gravity, 0, 0, 0)
        return self.mass_matrix @ (self.acceleration(data) - fall)

    def fly(self, data: Any, seconds: float) -> float:
        """Step for `seconds`, as a whole number of steps; returns the time flown, s.

        Raises `InputError` if MuJoCo warned of anything. It resets bad states silently otherwise.
        """
        steps = left = max(1, round(seconds / self.model.opt.timestep))
        while left > 0:
            mujoco.mj_step(self.model, data, nstep=min(left, _STEPS_AT_ONCE))
            left -= _STEPS_AT_ONCE
        for kind, warning in zip(mujoco.mjtWarning.__members__, data.warning, strict=False):
            expect(not warning.number, "vehicle", "a flight without warnings", f"{kind} of MuJoCo")
        return float(steps * self.model.opt.timestep)

    def climb(self, thrust: ArrayLike) -> float:
        """Mean acceleration of a vertical flight of two seconds from rest, m/s²."""
        data = self.ready(thrust)
        return 2 / self.fly(data, 2.0) ** 2 * (float(data.qpos[2]) - _HEIGHT)


def _turned(data: Any, vector: Array) -> Array:
    """A vector of the body frame in the world frame, (3,)."""
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, vector, data.qpos[3:])
    return turned


def _size(values: np.ndarray) -> float:
    """Euclidean length of all elements."""
    return float(np.linalg.norm(values))


def _mass(craft: _Craft) -> Iterator[Check]:
    """Mass, centre of mass and inertia, from the answers to known forces and torques."""
    vehicle = craft.vehicle
    yield Check("mass", vehicle.mass, craft.mass, "kg", _MODEL, _EXACT * vehicle.mass)
    off = _size(craft.center_of_mass - vehicle.center_of_mass)
    yield Check("centre of mass: difference", 0.0, off, "m", _MODEL)
    off, size = _size(craft.inertia - vehicle.inertia), _size(vehicle.inertia)
    yield Check("inertia: difference of the matrices", 0.0, off, "kg·m²", _MODEL, _EXACT * size)


def _rotors(craft: _Craft) -> Iterator[Check]:
    """Effect and limits of each rotor, and of all rotors together."""
    vehicle, columns = craft.vehicle, []
    low, high = vehicle.thrust_low, vehicle.thrust_high
    idle = craft.forces(low)
    for i, rotor in enumerate(vehicle.rotors):
        one = np.where(np.arange(vehicle.num_rotors) == i, high, low)
        pushed = (craft.forces(one) - idle) / (rotor.high - rotor.low)
        torque = pushed[3:] - np.cross(craft.center_of_mass, pushed[:3])
        columns.append(np.append(pushed[2], torque))
        off = _size(columns[i] - vehicle.allocation[:, i])
        name = f"{rotor.name}: difference of thrust and torques per newton"
        yield Check(name, 0.0, off, "", _MODEL)
    vertical, weight = vehicle.allocation[0], vehicle.mass * vehicle.gravity
    for more_or_less, asked, given in (
        ("more than they have", high + 50.0, high),
        ("less", low - 50.0, low),
    ):
        name = f"thrust of all when asked for {more_or_less}"
        measured = float(craft.forces(asked)[2])
        yield Check(name, float(vertical @ given), measured, "N", _MODEL, _EXACT * weight)
    rank = float(np.linalg.matrix_rank(np.array(columns), rtol=1e-6))
    source = "thrust and three torques, each without the others"
    yield Check("rank of the allocation matrix", 4.0, rank, "", source, 0.0)


def _free_fall(craft: _Craft) -> Iterator[Check]:
    """Depth of a fall: g t² / 2. Semi-implicit Euler misses by g h t / 2."""
    craft = craft.unpowered()
    data = craft.ready()
    depth = craft.vehicle.gravity * craft.fly(data, 2.0) ** 2 / 2
    yield Check("free fall in 2 s", depth, _HEIGHT - float(data.qpos[2]), "m", _MECHANICS)


def _hover(craft: _Craft) -> Iterator[Check]:
    """With hover thrusts the craft neither accelerates nor turns, and keeps its position."""
    data = craft.ready(craft.vehicle.hover_thrust)
    answer = craft.acceleration(data)
    craft.fly(data, 5.0)
    for name, value, unit in (
        ("acceleration", answer[:3], "m/s²"),
        ("angular acceleration", answer[3:], "rad/s²"),
        ("drift in 5 s", data.qpos[:3] - (0.0, 0.0, _HEIGHT), "m"),
    ):
        yield Check(f"hover: {name}", 0.0, _size(value), unit, _MECHANICS)


def _climb(craft: _Craft) -> Iterator[Check]:
    """Acceleration of a climb at the largest multiple of the hover's thrusts, from the height."""
    vehicle, name = craft.vehicle, "climb at the largest balanced thrust"
    most = float(np.min(vehicle.thrust_high / vehicle.hover_thrust))
    expected, measured = vehicle.gravity * (most - 1), craft.climb(most * vehicle.hover_thrust)
    yield Check(name, expected, measured, "m/s²", _MECHANICS, _EXACT * max(1.0, most))


def _tumbling(craft: _Craft) -> Iterator[Check]:
    """Ten seconds of torque-free tumbling: conserved quantities, and the path of the fall."""
    craft = craft.unpowered()
    before, after = craft.ready(), craft.ready()
    before.qvel[3:] = after.qvel[3:] = _SPIN
    seconds = craft.fly(after, 10.0)
    inertia, center = craft.inertia, craft.center_of_mass
    spins = [np.array(data.qvel[3:]) for data in (before, after)]
    start, end = (_turned(d, inertia @ s) for d, s in zip((before, after), spins, strict=True))
    # The path of the centre of mass: from its first place and velocity on, and where it is.
    place, there = (data.qpos[:3] + _turned(data, center) for data in (before, after))
    velocity = before.qvel[:3] + _turned(before, np.cross(spins[0], center))
    fallen = place + velocity * seconds - (0, 0, craft.vehicle.gravity * seconds**2 / 2)
    first, last = (float(spin @ inertia @ spin) for spin in spins)
    for name, value, unit in (
        ("relative change of angular momentum", _size(end - start) / _size(start), ""),
        ("relative change of energy", last / first - 1, ""),
        ("centre of mass off its path", _size(there - fallen), "m"),
    ):
        yield Check(f"tumbling 10 s: {name}", 0.0, value, unit, _MECHANICS, _TRUNCATION)


def _resting(craft: _Craft) -> Iterator[Check]:
    """Dropped by 5 cm, the craft settles; soft contact lets it sink in by some 0.1 mm."""
    craft = _Craft(craft.vehicle, craft.vehicle.model)  # with air and drag, if there are any
    data, rest = craft.ready(), craft.vehicle.rest_height
    data.qpos[2] = rest + 0.05
    craft.fly(data, 5.0)
    height = float(data.qpos[2])
    yield Check("at rest on the floor: height", rest, height, "m", _MODEL, 1e-3)
    for name, value, unit in (("speed", data.qvel[:3], "m/s"), ("turning", data.qvel[3:], "rad/s")):
        yield Check(f"at rest on the floor: {name}", 0.0, _size(value), unit, _MECHANICS, 1e-6)


def _linear_drag(craft: _Craft) -> Iterator[Check]:
    """With the option `linear_drag` d, speed v is met by a force of −d m v and by no torque."""
    vehicle, drag, velocity = craft.vehicle, 0.5, np.array((6.0, -8.0, 10.0))
    model = copy.copy(craft.model)
    model.dof_damping[:] = Vehicle.load(vehicle.path, linear_drag=drag).model.dof_damping
    added = _Craft(vehicle, model).forces(velocity=velocity) - craft.forces()
    tolerance = _EXACT * vehicle.mass * vehicle.gravity
    for name, value, unit in (
        ("force", added[:3] + drag * vehicle.mass * velocity, "N"),
        ("torque about the body's origin", added[3:], "N·m"),
    ):
        yield Check(f"linear drag: difference of {name}", 0.0, _size(value), unit, _DRAG, tolerance)


def closed_form_inertia() -> tuple[float, float]:
    """(Ixx = Iyy, Izz) of the paper's vehicle about the centre, kg·m², from our geometry.

    Hub: a box. Each arm: a cylinder whose centre lies half its length out along a diagonal; of its
    moments along (a) and across (c) itself, x sees (a + c) / 2 and z sees c, and the products of
    inertia of the four cancel. Each motor: an upright cylinder, moved by Steiner's theorem.
    """
    length = SIDE / math.sqrt(2)
    hub_x = _HUB_MASS * (_HUB_WIDTH**2 + _HUB_HEIGHT**2) / 12
    hub_z = _HUB_MASS * _HUB_WIDTH**2 / 6
    arm_along = _ARM_MASS * _ARM_RADIUS**2 / 2
    arm_across = _ARM_MASS * ((3 * _ARM_RADIUS**2 + length**2) / 12 + (length / 2) ** 2)
    motor_x = _MOTOR_MASS * ((3 * _MOTOR_RADIUS**2 + _MOTOR_HEIGHT**2) / 12 + length**2 / 2)
    motor_z = _MOTOR_MASS * (_MOTOR_RADIUS**2 / 2 + length**2)
    ixx = hub_x + NUM_ROTORS * ((arm_along + arm_across) / 2 + motor_x)
    return ixx, hub_z + NUM_ROTORS * (arm_across + motor_z)


def _paper_numbers(craft: _Craft) -> Iterator[Check]:
    """Mass, inertia, centre of mass and height of rest."""
    yield Check("mass of the paper", MASS, craft.mass, "kg", _PAPER)
    off = _size(craft.center_of_mass)
    yield Check("centre of mass off the geometrical centre", 0.0, off, "m", _PAPER)
    (ixx, izz), inertia = closed_form_inertia(), craft.inertia
    for name, expected, value in (
        ("inertia Ixx", ixx, inertia[0, 0]),
        ("inertia Iyy", ixx, inertia[1, 1]),
        ("inertia Izz", izz, inertia[2, 2]),
        ("largest product of inertia", 0.0, np.abs(inertia - np.diag(np.diag(inertia))).max()),
    ):
        yield Check(name, expected, float(value), "kg·m²", _GEOMETRY)
    yield Check("height of rest", _REST_HEIGHT, craft.vehicle.rest_height, "m", _GEOMETRY)


def _paper_rotors(craft: _Craft) -> Iterator[Check]:
    """Total thrust at the limits, and the torques of each rotor: y, −x and ±k per newton."""
    for asked, expected in ((150.0, NUM_ROTORS * MAX_THRUST), (-50.0, 0.0)):
        thrust = float(craft.forces(asked)[2])
        name = f"thrust of all four when asked for {asked:g} N each"
        yield Check(name, expected, thrust, "N", f"{_PAPER}: 0 to 100 N")
    square = f"{_PAPER}: square; numbering ours"
    for i, (name, (x, y, sign)) in enumerate(_ROTORS.items()):
        torque = craft.forces(MAX_THRUST * np.eye(NUM_ROTORS)[i])[3:] / MAX_THRUST
        for axis, expected, measured, source in (
            ("roll", y * SIDE / 2, torque[0], square),
            ("pitch", -x * SIDE / 2, torque[1], square),
            ("yaw", sign * _REACTION, torque[2], "assumption of ours"),
        ):
            line = f"{name} rotor: {axis} torque per newton"
            yield Check(line, expected, float(measured), "m", source)


def _paper_flights(craft: _Craft) -> Iterator[Check]:
    """Acceleration of two seconds without thrust, at 49 N each and at 100 N each."""
    hover = MASS * GRAVITY / NUM_ROTORS
    for how, thrust, expected, source in (
        ("no thrust", 0.0, -GRAVITY, "g = 9.8 m/s²"),
        (f"{hover:g} N each", hover, 0.0, "m g / 4 = 49 N"),
        ("100 N each", MAX_THRUST, NUM_ROTORS * MAX_THRUST / MASS - GRAVITY, "4 · 100 N / m − g"),
    ):
        name, measured = f"2 s at {how}: acceleration", craft.climb(thrust)
        yield Check(name, expected, measured, "m/s²", f"{_PAPER}: {source}")


def _spinning_top(craft: _Craft) -> Iterator[Check]:
    """With Ixx = Iyy the rates about x and y turn about body z at (Izz − Ixx) / Ixx · ωz."""
    data = craft.ready()
    data.qvel[3:] = _SPIN
    seconds = craft.fly(data, 10.0)
    ixx, izz = closed_form_inertia()
    turned = complex(*_SPIN[:2]) * np.exp(1j * (izz - ixx) / ixx * _SPIN[2] * seconds)
    miss = math.dist(data.qvel[3:], (turned.real, turned.imag, _SPIN[2]))
    name = "tumbling 10 s: body rates against the symmetric top"
    yield Check(name, 0.0, miss, "rad/s", _MECHANICS, _TRUNCATION)


def _paper_drag(craft: _Craft) -> Iterator[Check]:
    """With drag d, hovering at 10 m/s: v(t) = 10 exp(−d t), and a turn about z goes on."""
    vehicle = Vehicle.load(craft.vehicle.path, linear_drag=0.5)
    craft = _Craft(vehicle, vehicle.model)
    data = craft.ready(vehicle.hover_thrust)
    data.qvel[:] = (10.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    expected = 10 * math.exp(-0.5 * craft.fly(data, 2.0))
    speed, turn = float(data.qvel[0]), float(data.qvel[5])
    yield Check("speed after 2 s of drag 0.5 /s from 10 m/s", expected, speed, "m/s", _DRAG)
    yield Check("turn of 1 rad/s after 2 s of linear drag", 1.0, turn, "rad/s", _DRAG)
