"""Bounds of the elevation task against flights computed by hand."""

import numpy as np
import pytest
from bounds import (
    bang_bang,
    course_time,
    elevation_bounds,
    elevation_reward,
    landing_time,
    payload_time,
    racing_time,
    waypoints_time,
)
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.tasks.racing import RacingOptions
from rotorgram.envs.tasks.waypoints import WaypointsOptions
from rotorgram.models.vehicle import Vehicle
from scipy import sparse
from scipy.optimize import linprog


def flown(distance: float, towards: float, against: float, **rest: float) -> np.ndarray:
    accelerations = np.array([towards]), np.array([against])
    return bang_bang(np.array([distance]), 250, 0.02, *accelerations, **rest)[0]


def seconds(*times: float) -> list[int]:
    """Places of the steps that end at these times."""
    return [round(time / 0.02) - 1 for time in times]


def test_equal_accelerations_meet_in_the_middle() -> None:
    # 4 m at 1 m/s²: two seconds of thrust, two of braking.
    left = flown(4.0, 1.0, 1.0)
    found = left[seconds(1, 2, 3, 4, 5)]
    assert found == pytest.approx([3.5, 2.0, 0.5, 0.0, 0.0], abs=1e-4)


def test_unequal_accelerations_switch_earlier_or_later() -> None:
    # t_1 = sqrt(2 d b / (a (a + b))) and t_2 = a t_1 / b: 1 s and 3 s for d = 6 m, a = 3, b = 1.
    left = flown(6.0, 3.0, 1.0)
    found = left[seconds(1, 4)]
    assert found == pytest.approx([4.5, 0.0], abs=1e-4)


def test_limited_changes_take_four_equal_parts() -> None:
    # Steps of 0.1 m/s² each 0.02 s are 5 m/s³. Four parts of n steps, from 0 to 0.1 n m/s² and
    # back, twice: the sum of sums gives 2 n³ · 0.1 · 0.02² m.
    steps = 20
    distance = 2 * steps**3 * 0.1 * 0.02**2
    left = flown(distance, 50.0, 50.0, change=0.1)
    after = left[4 * steps :]
    assert abs(after).max() < 1e-4
    assert left[4 * steps - 4] > 1e-4
    assert left[2 * steps - 1] == pytest.approx(left[0] / 2, rel=0.05)


def test_drag_makes_way_and_braking_shorter() -> None:
    slowed = flown(2.0, 3.0, 1.0, drag=1.0)
    free = flown(2.0, 3.0, 1.0)
    assert slowed[49] > free[49]
    short = flown(1.0, 3.0, 1.0, drag=1.0)
    assert abs(short[-1]) < 1e-4


def test_returns_of_the_papers_task() -> None:
    starts = (np.arange(40) - 19.5) / 20
    paper = Vehicle.load()
    bounds = elevation_bounds(EnvConfig(), paper, starts)
    # (s - |E|) / (s + |E|) with s = 0.5 m, over |E| uniform in 0 to 1 m: log 3 - 1 per step.
    assert bounds["hover"] == pytest.approx(250 * (np.log(3) - 1), rel=0.005)
    assert bounds["time-optimal"] == pytest.approx(232, abs=1)
    # Nothing is better than to be there at once, and thrust without inertia is better than with.
    without_inertia = EnvConfig(task={"thrust_scale": 100.0})
    free = elevation_bounds(without_inertia, paper, starts)
    assert bounds["time-optimal"] < free["time-optimal"] < 250
    rewards = elevation_reward(np.array([0.0, 0.5, -1.5]))
    assert rewards.tolist() == [1.0, 0.0, -0.5]


def test_offsets_limit_the_acceleration_and_not_its_change() -> None:
    config = EnvConfig(action="offset", effects={"linear_drag": 2.0})
    vehicle = Vehicle.load(linear_drag=2.0)
    bounds = elevation_bounds(config, vehicle, np.array([1.0]))
    left = flown(1.0, 4.0, 4.0, drag=2.0)  # four rotors, 20 N each, 20 kg
    assert bounds["time-optimal"] == pytest.approx(elevation_reward(left).sum())


def test_least_time_to_land_by_hand() -> None:
    # 400 N on 20 kg at 9.8 m/s²: it falls at 9.8 and brakes at 10.2 m/s². From v² / 19.6 +
    # (v² - 1) / 20.4 = 4 m follow v = 6.365 m/s, v / 9.8 = 0.6495 s and (v - 1) / 10.2 = 0.526 s.
    paper = Vehicle.load()
    assert landing_time(4.0, 1.0, paper) == pytest.approx(1.1755, abs=1e-3)
    assert landing_time(0.05, 1.0, paper) == pytest.approx(np.sqrt(0.1 / 9.8))  # a mere fall
    assert landing_time(4.0, 1e-9, paper) > landing_time(4.0, 1.0, paper)


def test_least_time_to_carry_a_payload_by_hand() -> None:
    # 400 N on 22 kg: 18.18 m/s², of which sqrt(18.18² - 9.8²) = 15.31 m/s² are left for the side.
    assert payload_time(1.0, 0.1, Vehicle.load()) == pytest.approx(2 / np.sqrt(15.315), abs=1e-3)


@pytest.mark.parametrize("start", [0.2, 0.9])
def test_the_largest_return_is_nearly_that_of_the_time_optimal_flight(start: float) -> None:
    # Accelerations of 90 steps, m/s², which change by 1 at most, and the sizes |E| after each.
    # (s - x) / (s + x) is convex, so the tangent at a flight's sizes lies below it: a linear
    # program that lowers the sizes weighted by the slopes never lowers the return.
    steps = 90
    period = 0.02
    late = np.subtract.outer(np.arange(steps), np.arange(steps))
    way = np.where(late >= 0, (late + 0.5) * period**2, 0.0)
    change = sparse.diags([1.0, -1.0], [0, -1], (steps, steps))
    size = -sparse.identity(steps)
    none = sparse.csr_matrix((steps, steps))
    limits = sparse.bmat([[change, none], [-change, none], [-way, size], [way, size]])
    most = np.repeat([1.0, 1.0, -start, start], steps)
    # It starts too low: towards the target it climbs, with 10.2 m/s² at most, and falls with 9.8.
    box = [(-9.8, 10.2)] * steps + [(0, None)] * steps
    slopes = np.ones(steps)
    returns = [-np.inf]
    while len(returns) < 4 or returns[-1] > returns[-2] + 1e-3:
        weights = np.concatenate([np.zeros(steps), slopes])
        found = linprog(weights, limits, most, bounds=box)
        sizes = found.x[steps:]
        flown_return = float(elevation_reward(sizes).sum())
        returns.append(flown_return + 250 - steps)
        slopes = 1 / (0.5 + sizes) ** 2
    best = max(returns)
    optimal = elevation_bounds(EnvConfig(), Vehicle.load(), np.array([start]))
    assert best - 0.3 < optimal["time-optimal"] < best + 0.05


def test_least_time_of_a_course_by_hand() -> None:
    start = (0.0, 0.0, 0.0)
    east = (2.0, 0.0, 0.0)
    none = np.zeros(2)
    # 1 m/s² without gravity: 2 m take sqrt(2 · 2) s, and there and back 2 sqrt(2) + sqrt(2 · 2) s.
    there = np.array((start, east))
    assert course_time(there, none[:1], 1.0, 0.0) == pytest.approx(2.0)
    back = np.array((start, east, start))
    expected = 2 * np.sqrt(2) + 2
    assert course_time(back, none, 1.0, 0.0) == pytest.approx(expected)
    # A radius of 0.5 m: 1.5 m there, 1 m back.
    near = course_time(back, none + 0.5, 1.0, 0.0)
    assert near == pytest.approx(2 * np.sqrt(1.5) + np.sqrt(2))
    # A point on the way does not stop it, and one within reach of the start takes no time.
    on = np.array((start, (1.0, 0.0, 0.0), east))
    assert course_time(on, none, 1.0, 0.0) == pytest.approx(2.0)
    assert course_time(there, np.array((2.0,)), 1.0, 0.0) == 0.0
    # Along u of 30° above the way, 2 m away: cos 30° · 2 m by 5 - 3 sin 30° m/s².
    level = course_time(there, none[:1], 5.0, 3.0)
    angles = np.radians(np.arange(0, 80, 10))
    ratios = np.cos(angles) / (5 - 3 * np.sin(angles))
    largest = ratios.max()
    assert level == pytest.approx(np.sqrt(2 * 2 * largest))
    # Level flight has 4 of the 5 m/s², and nothing is faster: sqrt(2 · 2 / 4) s, within 1 %.
    assert 0.99 < level <= 1.0


def test_courses_of_a_vehicle_with_more_points_or_rounds_take_longer() -> None:
    paper = Vehicle.load()
    few = waypoints_time(WaypointsOptions(points=2), paper, 8)
    many = waypoints_time(WaypointsOptions(points=4), paper, 8)
    assert 0.0 < few < many
    once = racing_time(RacingOptions(laps=1), paper)
    twice = racing_time(RacingOptions(laps=2), paper)
    assert 0.0 < once < twice
