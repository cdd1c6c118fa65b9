"""Our flights beside an independent solution of the Newton-Euler equations, and RotorPy's.

First the independent solution against closed forms, then ours against it, then the pages.
"""

import json
from dataclasses import replace
from math import exp, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.models import Vehicle
from rotorgram.models.coefficients import Coefficients

pytest.importorskip("scipy")

import rotorpy
from independent import (
    Equations,
    Row,
    at_step,
    compare,
    independent,
    markdown,
    order,
    ours,
    rotation,
    thrusts,
    vehicles,
)
from measuring import read_rows, write_rows
from tables import SIM

approx = pytest.approx
ROOT = Path(__file__).parents[2]
DATA = ROOT / "tests" / "data"
PAGE = ROOT / "docs" / "independent.md"
FLIGHTS = ROOT / "docs" / "results" / "independent" / "flights.csv"
ROTORPY = ROOT / "docs" / "results" / "rotorpy" / "hummingbird.json"
VEHICLES = vehicles()
RACER = VEHICLES["racer"]
SPIN, VELOCITY = np.array((0.5, -0.4, 0.3)), np.array((1.0, 2.0, 3.0))  # of its starts
DOWN = np.array((0.0, 0.0, -9.81))


# --- the independent solution ---------------------------------------------------------------------


def test_without_thrust_it_falls_along_a_parabola_and_keeps_its_angular_momentum() -> None:
    flight = independent(RACER, np.zeros((50, 4)), {})
    center = RACER.center_of_mass
    origin = flight.position[0]
    velocity = VELOCITY + np.cross(SPIN, center)
    for step, (position, q, rates) in enumerate(
        zip(flight.position, flight.quaternion, flight.rates, strict=True)
    ):
        t = 0.02 * step
        fallen = origin + center + velocity * t + DOWN * t * t / 2
        found = position + rotation(q) @ center
        assert found == approx(fallen, abs=1e-9)
        momentum = rotation(q) @ (np.array((4e-3, 5e-3, 8e-3)) * rates)
        expected = (2e-3, -2e-3, 2.4e-3)
        assert momentum == approx(expected, abs=1e-12)


def test_linear_drag_alike_in_all_directions_gives_an_exponential() -> None:
    """v = v_end + (v_start - v_end) exp(-c t / m), the same while the craft tumbles."""
    drag = Coefficients.read({"drag.linear": (0.3, 0.3, 0.3)})
    craft = replace(RACER, coefficients=drag)
    flight = independent(craft, np.zeros((50, 4)), {"body_drag": True, "wind": (2.0, 0.0, 0.0)})
    center = craft.center_of_mass
    rate = 0.3 / 0.6
    t = 1.0
    end = np.array((2.0, 0.0, 0.0)) + DOWN / rate
    start = VELOCITY + np.cross(SPIN, center)
    moved = end * t + (start - end) * (1 - exp(-rate * t)) / rate
    centers = [
        flight.position[i] + rotation(flight.quaternion[i]) @ center for i in (0, -1)
    ]  # fmt: skip
    found = centers[1] - centers[0]
    assert found == approx(moved, abs=1e-9)


def test_a_rotor_lags_and_drags_as_worked_out_by_hand() -> None:
    """The derivative of a level racer at 2 m/s forward; one rotor rises, one falls, two hold."""
    equations = Equations(RACER, {"motor_lag": True, "rotor_drag": True})
    root = np.array((1.0, 1.2, 1.2, 1.2))
    wanted = np.array((1.44, 1.0, 1.44, 1.44))  # roots 1.2, 1.0, 1.2, 1.2
    y = np.concatenate(((0, 0, 0), (2, 0, 0), (1, 0, 0, 0), (0, 0, 0), root))
    change = equations.derivative(0.0, y, wanted)
    assert change[:3] == approx((2, 0, 0))
    assert change[6:10] == approx((0, 0, 0, 0))
    expected = (0.2 / 0.05, -0.2 / 0.08, 0, 0)
    assert change[13:] == approx(expected)
    # Speed sqrt(T / 5e-6); drag 1e-4 · speed · 2 m/s; lift 3e-3 · 4 m²/s² each.
    drags = [1e-4 * r / sqrt(5e-6) * 2 for r in root]
    pushes = [r * r + 0.012 for r in root]
    assert change[3] == approx(-sum(drags) / 0.6)
    assert change[5] == approx(sum(pushes) / 0.6 - 9.81)
    # Rotors at (±0.14, ±0.12), 0.01 m above the center of mass; reactions ±0.02 · T.
    sides = (-0.12, -0.12, 0.12, 0.12)
    fronts = (0.14, -0.14, -0.14, 0.14)
    turns = (0.02, -0.02, 0.02, -0.02)
    roll = sum(y * f for y, f in zip(sides, pushes, strict=True)) / 4e-3
    pitch = -sum(x * f for x, f in zip(fronts, pushes, strict=True)) - 0.01 * sum(drags)
    yaw = sum(y * d for y, d in zip(sides, drags, strict=True))
    yaw += sum(k * r * r for k, r in zip(turns, root, strict=True))
    assert change[10:13] == approx((roll, pitch / 5e-3, yaw / 8e-3))


# --- ours against it ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", VEHICLES)
def test_every_vehicle_flies_as_its_equations_say(name: str) -> None:
    """Far within 1 mm and 0.01° after 2 s of varied thrusts, at the step of its file."""
    vehicle = VEHICLES[name]
    (row,) = compare(name, vehicle, ["none"], [vehicle.timestep], 2.0)
    assert row.of_file == 1
    assert row.fastest_rad_s > 0.7  # more than it began with
    assert row.position_m < 2e-6
    assert row.attitude_deg < 2e-5


def test_the_thrusts_vary_and_turn_the_smallest_as_fast_as_the_page_says() -> None:
    given = thrusts(VEHICLES["tiny"])
    assert given.shape == (500, 4)
    expected = 0.3 / sqrt(3) * 0.0662
    found = given.std(axis=0)
    assert found == approx(expected, rel=0.1)
    flight = independent(VEHICLES["tiny"], given[:250], {}, 1e-9)
    assert 5 < np.linalg.norm(flight.rates, axis=1).max() < 35


@pytest.mark.parametrize(("effects", "most_m", "most_deg"), SIM["second_order"]["rows"])
def test_effects_are_of_second_order(effects: str, most_m: float, most_deg: float) -> None:
    rows = compare("racer", RACER, [effects], [0.005, 0.0025], 2.0)
    assert [row.step_ms for row in rows] == [5.0, 2.5]
    assert rows[0].position_m < most_m
    assert rows[0].attitude_deg < most_deg
    assert order(rows) == approx(2.0, abs=0.25)


def test_rotors_that_lag_drag_with_their_mean_speed() -> None:
    """With the speed of the mean thrust, which is larger, the attitude is off by 0.04°."""
    quick = Coefficients(RACER.coefficients)
    quick |= {"rotors.time_constant": 0.005, "rotors.time_constant_down": None}
    craft = replace(RACER, coefficients=quick)
    effects = {"motor_lag": True, "rotor_drag": True}
    commands = thrusts(craft, 2.0)
    flown = ours(at_step(craft, 0.005), commands, effects)
    _, degrees = flown.apart(independent(craft, commands, effects))
    assert degrees < 0.012


def test_the_rigid_body_is_of_fourth_order() -> None:
    rows = compare("tiny", VEHICLES["tiny"], ["none"], [0.01, 0.005], 2.0)
    assert order(rows) == approx(4.0, abs=0.1)


# --- the page -------------------------------------------------------------------------------------


def test_a_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    rows = compare("racer", RACER, ["none"], [0.01], 0.2)
    write_rows(tmp_path / "new" / "table.csv", rows)
    again = read_rows(tmp_path / "new" / "table.csv", Row)
    assert [row.vehicle for row in again] == ["racer", "racer"]
    assert [row.step_ms for row in again] == [10.0, 5.0]
    expected = rows[0].position_m
    assert again[0].position_m == approx(expected, rel=1e-3)


def test_the_page_shows_the_committed_table_of_every_vehicle() -> None:
    rows = read_rows(FLIGHTS, Row)
    assert markdown(rows) in PAGE.read_text()
    assert {row.vehicle for row in rows} >= set(VEHICLES)


def test_every_vehicle_meets_the_targets_at_the_step_of_its_file() -> None:
    own = [row for row in read_rows(FLIGHTS, Row) if row.effects == "none" and row.of_file]
    assert all(row.within for row in own)
    assert max(row.position_m for row in own) < 2e-5
    assert max(row.attitude_deg for row in own) < 1e-4


def test_the_committed_flights_fly_again_alike() -> None:
    (told,) = (r for r in read_rows(FLIGHTS, Row) if r.vehicle == "tiny" and r.of_file)
    (row,) = compare("tiny", VEHICLES["tiny"], ["none"], [0.005])
    for name in ("fastest_rad_s", "fastest_m_s", "position_m", "attitude_deg"):
        expected = getattr(told, name)
        assert getattr(row, name) == approx(expected, rel=0.02)


def test_the_page_shows_the_committed_flights_beside_rotorpy() -> None:
    result: dict[str, Any] = json.loads(ROTORPY.read_text())
    shown = rotorpy.markdown(result)
    assert shown in PAGE.read_text()
    assert f"RotorPy {result['rotorpy']}" in PAGE.read_text()
    for row in result["rows"]:
        # RotorPy's equations are ours: both exact solutions are the same.
        assert row["metres"]["independent"] < 1e-9
        assert row["degrees"]["independent"] < 1e-8
        assert row["metres"]["1 ms"] < 0.5 * row["metres"]["2 ms"] < 0.25 * row["metres"]["5 ms"]


def test_rotorpys_parameters_become_our_vehicle(tmp_path: Path) -> None:
    """Of made-up numbers; an order of rotors and signs of turning like RotorPy's."""
    file = tmp_path / "made_up.xml"
    file.write_text(rotorpy.mjcf(SIM["rotorpy"]))
    vehicle = Vehicle.load(file)
    told = vehicle.coefficients
    assert vehicle.mass == 0.4
    assert vehicle.gravity == 9.81
    expected = np.array(((1e-3, 0, 1e-4), (0, 2e-3, 0), (1e-4, 0, 2.5e-3)))
    assert vehicle.inertia == approx(expected, abs=1e-9)
    assert vehicle.thrust_high == approx([2.0] * 4)
    signs = [(1, 1, 1, 1), (0.2, -0.2, -0.2, 0.2), (-0.1, -0.1, 0.1, 0.1)]
    expected = np.array((*signs, (0.02, -0.02, 0.02, -0.02)))
    assert vehicle.allocation == approx(expected, abs=1e-12)
    assert told["rotors.thrust_coefficient"] == 2e-6
    assert told["rotors.time_constant"] == 0.01
    assert told["rotors.drag"] == 1e-4
    assert told["rotors.inflow"] == 2e-4
    assert told["rotors.lift"] == 3e-3
    assert told["drag.quadratic"] == (0.01, 0.02, 0.03)
