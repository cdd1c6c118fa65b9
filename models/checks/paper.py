"""Checks of the paper's vehicle beside mechanics: the paper's numbers, or ours if it gives none.

`constants` has the numbers of the paper. Its drone has a mass "concentrated in the centre", so it
would have no inertia: the parts below are ours, as are numbering and reaction of the rotors.
"""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from ..constants import GRAVITY, MASS, MAX_THRUST, NUM_ROTORS, SIDE
from ..errors import InputError
from ..vehicle import Vehicle
from ._measure import DRAG, HEIGHT, SPIN, TRUNCATION, Check, RigidBody, fly, forces, ready

__all__ = ["closed_form_inertia", "examine_paper"]

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

_PAPER: Final = "paper, section 2.2"
_GEOMETRY: Final = "closed form of our geometry"


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
    izz = hub_z + NUM_ROTORS * (arm_across + motor_z)
    return ixx, izz


def examine_paper(vehicle: Vehicle, body: RigidBody) -> Iterator[Check]:
    """The additional checks: with air and drag, if there are any, for the paper has none.

    Raises:
        InputError: It has another number of rotors.
    """
    if vehicle.num_rotors != NUM_ROTORS:
        raise InputError(
            f"vehicle: expected the {NUM_ROTORS} rotors of the paper, got {vehicle.num_rotors}"
        )
    yield from _numbers(vehicle, body)
    yield from _rotors(vehicle, body)
    yield from _flights(vehicle)
    yield from _spinning_top(vehicle)
    yield from _drag(vehicle)


def _numbers(vehicle: Vehicle, body: RigidBody) -> Iterator[Check]:
    """Mass, inertia, centre of mass and height of rest."""
    yield Check("mass of the paper", MASS, body.mass, "kg", _PAPER)
    off = float(np.linalg.norm(body.center_of_mass))
    yield Check("centre of mass off the geometrical centre", 0.0, off, "m", _PAPER)
    ixx, izz = closed_form_inertia()
    inertia = body.inertia
    for name, expected, value in (
        ("inertia Ixx", ixx, inertia[0, 0]),
        ("inertia Iyy", ixx, inertia[1, 1]),
        ("inertia Izz", izz, inertia[2, 2]),
        ("largest product of inertia", 0.0, np.abs(inertia - np.diag(np.diag(inertia))).max()),
    ):
        yield Check(name, expected, float(value), "kg·m²", _GEOMETRY)
    yield Check("height of rest", _REST_HEIGHT, vehicle.rest_height, "m", _GEOMETRY)


def _rotors(vehicle: Vehicle, body: RigidBody) -> Iterator[Check]:
    """Total thrust at the limits, and the torques of each rotor: y, −x and ±k per newton."""
    model = vehicle.model
    for asked, expected in ((150.0, NUM_ROTORS * MAX_THRUST), (-50.0, 0.0)):
        thrust = float(forces(vehicle, model, body, asked)[2])
        name = f"thrust of all four when asked for {asked:g} N each"
        yield Check(name, expected, thrust, "N", f"{_PAPER}: 0 to 100 N")
    square = f"{_PAPER}: square; numbering ours"
    for i, (name, (x, y, sign)) in enumerate(_ROTORS.items()):
        torque = forces(vehicle, model, body, MAX_THRUST * np.eye(NUM_ROTORS)[i])[3:] / MAX_THRUST
        for axis, expected, measured, source in (
            ("roll", y * SIDE / 2, torque[0], square),
            ("pitch", -x * SIDE / 2, torque[1], square),
            ("yaw", sign * _REACTION, torque[2], "assumption of ours"),
        ):
            line = f"{name} rotor: {axis} torque per newton"
            yield Check(line, expected, float(measured), "m", source)


def _flights(vehicle: Vehicle) -> Iterator[Check]:
    """Acceleration of two seconds without thrust, at 49 N each and at 100 N each."""
    hover = MASS * GRAVITY / NUM_ROTORS
    for how, thrust, expected, source in (
        ("no thrust", 0.0, -GRAVITY, "g = 9.8 m/s²"),
        (f"{hover:g} N each", hover, 0.0, "m g / 4 = 49 N"),
        ("100 N each", MAX_THRUST, NUM_ROTORS * MAX_THRUST / MASS - GRAVITY, "4 · 100 N / m − g"),
    ):
        data = ready(vehicle, vehicle.model, thrust)
        measured = 2 / fly(vehicle.model, data, 2.0) ** 2 * (float(data.qpos[2]) - HEIGHT)
        name = f"2 s at {how}: acceleration"
        yield Check(name, expected, measured, "m/s²", f"{_PAPER}: {source}")


def _spinning_top(vehicle: Vehicle) -> Iterator[Check]:
    """With Ixx = Iyy the rates about x and y turn about body z at (Izz − Ixx) / Ixx · ωz."""
    data = ready(vehicle, vehicle.model)
    data.qvel[3:] = SPIN
    seconds = fly(vehicle.model, data, 10.0)
    ixx, izz = closed_form_inertia()
    turned = complex(*SPIN[:2]) * np.exp(1j * (izz - ixx) / ixx * SPIN[2] * seconds)
    miss = math.dist(data.qvel[3:], (turned.real, turned.imag, SPIN[2]))
    name = "tumbling 10 s: body rates against the symmetric top"
    yield Check(name, 0.0, miss, "rad/s", "rigid-body mechanics", TRUNCATION)


def _drag(vehicle: Vehicle) -> Iterator[Check]:
    """With drag d, hovering at 10 m/s: v(t) = 10 exp(−d t), and a turn about z goes on."""
    dragged = Vehicle.load(vehicle.path, linear_drag=0.5)
    data = ready(dragged, dragged.model, dragged.hover_thrust)
    data.qvel[:] = (10.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    expected = 10 * math.exp(-0.5 * fly(dragged.model, data, 2.0))
    speed, turn = float(data.qvel[0]), float(data.qvel[5])
    yield Check("speed after 2 s of drag 0.5 /s from 10 m/s", expected, speed, "m/s", DRAG)
    yield Check("turn of 1 rad/s after 2 s of linear drag", 1.0, turn, "rad/s", DRAG)
