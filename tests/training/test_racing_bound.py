"""The least time of a course: flights whose least time has a closed form."""

import math

import numpy as np
import pytest
from bounds import course_time

pytest.importorskip("casadi")

import casadi as ca
from least_time import of_craft, of_point_mass, slope
from rotorgram.envs import LocalVectorEnv
from rotorgram.models.vehicle import Vehicle

LIFT, GRAVITY = 20.0, 9.8
LEVEL = math.sqrt(LIFT**2 - GRAVITY**2)  # largest acceleration at one height
START = np.array((1.0, 2.0, 5.0))
SMALL = 1e-3


def gate(ahead: float, aside: float, direction: float = 1.0) -> tuple[float, ...]:
    """A gate of 1 m so far from the start, which is passed along x or against it."""
    x, y, z = START
    return x + ahead, y + aside, z, direction, 0.0, 0.5


def through_points(*ways: tuple[float, float, float]) -> float:
    """Least time from the start to places this far from it, in their order."""
    targets = np.array([(*(START + way), SMALL) for way in ways])
    return of_point_mass(len(ways), 4, LIFT, GRAVITY)(START, targets)


@pytest.mark.parametrize(
    ("way", "acceleration"),
    [
        ((10.0, 0.0, 0.0), LEVEL),
        ((0.0, 0.0, 10.0), LIFT - GRAVITY),
        ((0.0, 0.0, -10.0), LIFT + GRAVITY),
    ],
)
def test_a_straight_line_from_rest(way: tuple[float, float, float], acceleration: float) -> None:
    expected = math.sqrt(2 * (10.0 - SMALL) / acceleration)
    assert through_points(way) == pytest.approx(expected, rel=1e-4)


def test_up_and_back_is_bang_bang() -> None:
    """Thrust up, then down until the way back ends: speed is 0 at the upper point alone."""
    up, down = LIFT - GRAVITY, LIFT + GRAVITY
    expected = math.sqrt(2 * 3.0 * (1 / up + 1 / down)) + math.sqrt(2 * 3.0 / down)
    found = through_points((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    assert found == pytest.approx(expected, rel=5e-3)  # thrust changes at ten even times


def test_a_gate_is_passed_at_its_nearest_corner_below() -> None:
    """Thrust of one direction: |way · 2 / t² + gravity| is the lift, a quadratic for 2 / t²."""
    found = of_point_mass(1, 6, LIFT, GRAVITY)(START, np.array([gate(4.0, 2.0)]))
    squared = 4.0**2 + 1.5**2 + 0.5**2
    falls = 0.5 * GRAVITY
    acceleration = (falls + math.sqrt(falls**2 + squared * LEVEL**2)) / squared
    assert found == pytest.approx(math.sqrt(2 / acceleration), rel=1e-4)


def test_a_gate_is_not_passed_against_its_direction() -> None:
    """The way back through the gate needs another turn."""
    solve = of_point_mass(2, 6, LIFT, GRAVITY)
    last = gate(8.0, 0.0)
    along = solve(START, np.array([gate(4.0, 0.0), last]))
    against = solve(START, np.array([gate(4.0, 0.0, -1.0), last]))
    assert along < against - 0.3


def test_it_lies_above_the_bound_of_single_directions() -> None:
    dice = np.random.default_rng(5)
    places = START + dice.uniform(-3.0, 3.0, (4, 3))
    weaker = course_time(np.vstack((START, places)), np.full(4, 0.3), LIFT, GRAVITY)
    targets = np.column_stack((places, np.full(4, 0.3)))
    found = of_point_mass(4, 4, LIFT, GRAVITY)(START, targets)
    assert weaker < found < 2 * weaker


@pytest.mark.parametrize(("name", "first"), [("paper", 0), ("skydio_x2", 6)])
def test_the_craft_moves_as_in_the_simulator(name: str, first: int) -> None:
    """Of `skydio_x2` its turns: the simulator slows it by drag."""
    vehicle = Vehicle.load(name)
    env = LocalVectorEnv("rotorgram/Hover-v0", 5, vehicle=name, action="rotors", backend="rigid")
    env.reset(seed=3)
    dice = np.random.default_rng(4)
    state, thrust = ca.MX.sym("state", 13), ca.MX.sym("thrust", vehicle.num_rotors)
    derivative = ca.Function("slope", [state, thrust], [slope(vehicle, state, thrust)])
    names = ("position", "velocity", "attitude", "body_rates")
    period, parts = env.config.control_period, 20
    for _ in range(15):
        before = np.column_stack([env.telemetry[own] for own in names])
        env.advance(dice.uniform(-0.6, 0.6, (5, vehicle.num_rotors)).astype(np.float32))
        after = np.column_stack([env.telemetry[own] for own in names])
        for row, expected, thrusts in zip(before, after, env.telemetry["thrust"], strict=True):
            for _ in range(parts):
                half = row + period / parts / 2 * derivative(row, thrusts).full()[:, 0]
                row = row + period / parts * derivative(half, thrusts).full()[:, 0]
            row[6:10] /= np.linalg.norm(row[6:10])
            np.testing.assert_allclose(row[first:], expected[first:], atol=2e-5)
    assert np.abs(after[:, 10:]).max() > 1.0
    env.close()


def flight_of(position: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States and thrusts of a craft that hovers: where a search may begin."""
    state = np.concatenate((position, np.zeros(3), (1.0, 0.0, 0.0, 0.0), np.zeros(3)))
    return np.tile(state, (steps + 1, 1)), np.full((steps + 1, 4), 49.0)


def test_the_craft_climbs_by_all_its_thrust() -> None:
    vehicle = Vehicle.load()
    states, thrusts = flight_of(START, 100)
    above = START + np.array((0.0, 0.0, 10.0))
    targets = np.array([(*above, SMALL)])
    found = of_craft(vehicle, 1, 4)(states, thrusts, np.array([100]), 0.02, targets)
    acceleration = vehicle.thrust_high.sum() / vehicle.mass - vehicle.gravity
    assert found == pytest.approx(math.sqrt(2 * (10.0 - SMALL) / acceleration), rel=1e-3)


def test_the_craft_needs_longer_than_a_point_where_it_has_to_turn() -> None:
    vehicle = Vehicle.load()
    states, thrusts = flight_of(START, 100)
    ahead = START + np.array((5.0, 0.0, 0.0))
    targets = np.array([(*ahead, 0.3)])
    lift = vehicle.thrust_high.sum() / vehicle.mass
    point = of_point_mass(1, 4, lift, vehicle.gravity)(START, targets)
    found = of_craft(vehicle, 1, 4)(states, thrusts, np.array([100]), 0.02, targets)
    assert 1.05 * point < found < 2 * point
