"""The waypoints task against values worked out by hand; a pilot flies it."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import GOAL_OFFSET, observed, rows_of
from pilot import Pilot, fly, limited
from rotorgram.models import Vehicle

from flights import Shares, state_of, task_of

ID = "rotorgram/Waypoints-v0"


def begun(*places: tuple[float, float, float], **options: Any) -> Any:
    """A task whose start and points lie at these shares of the box from one side to the other."""
    task = task_of(ID, **{"points": len(places) - 1, **options})
    task.begin(Shares(*places))
    return task


def moved(task: Any, *position: float, **rest: Any) -> Any:
    state = state_of(position=position, **rest)
    task.update_memory(state)
    return task.outcome(state)


MIDDLE = (0.5, 0.5, 0.5)
EAST = (1.0, 0.5, 0.5)
ABOVE = (1.0, 0.5, 1.0)


def test_starts_and_points_by_hand() -> None:
    task = task_of(ID, points=2, center=(1.0, 2.0, 6.0), box=(2.0, 4.0, 1.0))
    pose = task.begin(Shares((0.0, 0.5, 1.0), EAST, MIDDLE))
    assert pose.position.tolist() == [-1.0, 2.0, 7.0]
    assert pose.quaternion is None
    assert task.goal(state_of()).tolist() == [3.0, 2.0, 6.0]


@rows_of("waypoints: observation by hand", "action, expected")
def test_observation_by_hand(action: str, expected: list[float]) -> None:
    """Body x is along y of the world, body y along z, body z along x."""
    # At (0, 0, 5), to (3, 0, 5) and (3, 0, 6.5).
    task = begun(MIDDLE, EAST, ABOVE, action=action)
    state = state_of(position=(1.0, -1.0, 4.0), velocity=(1.0, 2.0, 3.0), quaternion=[0.5] * 4)
    seen = observed(task, state)
    assert seen == pytest.approx(expected, abs=1e-12)
    frame, other = ("body", "attitude") if action == "rotors" else ("world", "rotors")
    same = begun(MIDDLE, EAST, ABOVE, action=other, frame=frame)
    assert observed(same, state).tolist() == seen.tolist()
    (spec,) = task.observation
    assert spec.components[:3] == GOAL_OFFSET
    assert spec.components[-1] == "point after - position z"
    _, high = spec.bounds()
    diagonal = math.hypot(6.0, 6.0, 4.5)
    assert high[0] == pytest.approx(2 * diagonal)
    moved(task, 3.0, 0.0, 5.0)  # the last point is also the one after it
    seen = observed(task, state_of(position=(3.0, 0.0, 6.0)))
    assert seen[:3] == pytest.approx([0, 0, 0.5])
    assert seen[-3:] == pytest.approx([0, 0, 0.5])


def test_progress_and_passing_by_hand() -> None:
    task = begun(MIDDLE, EAST, ABOVE, radius=0.5)
    outcome = moved(task, 1.0, 0.0, 5.0, body_rates=(3.0, 0.0, 4.0))
    expected = {"progress": 1.0, "passing": 0.0, "time": -0.04, "rates": -0.01, "termination": 0.0}
    told = {name: float(value) for name, value in outcome.reward.items()}
    assert told == pytest.approx(expected)
    outcome = moved(task, 0.5, 0.0, 5.0)
    assert outcome.reward["progress"] == pytest.approx(-0.5)
    outcome = moved(task, 2.5, 0.0, 5.0)
    assert outcome.metrics["points_left"] == 2  # 0.5 m away is not nearer
    outcome = moved(task, 2.6, 0.0, 5.0, time=0.08)
    assert outcome.reward["progress"] == pytest.approx(0.1)
    assert outcome.reward["passing"] == 1.0
    assert outcome.metrics["points_left"] == 1
    assert outcome.metrics["flight_time"] == pytest.approx(0.08)
    assert not outcome.terminated
    # The way to the next point counts from here: to (3, 0, 6.5) it was hypot(0.4, 1.5).
    outcome = moved(task, 3.0, 0.0, 6.4)
    whole = math.hypot(0.4, 1.5)
    assert outcome.reward["progress"] == pytest.approx(whole - 0.1)
    assert outcome.metrics["points_left"] == 0
    assert outcome.terminated
    assert outcome.reward["termination"] == 0.0


@rows_of("waypoints: ends", "place, rest, ends")
def test_ends(place: tuple[float, float, float], rest: dict[str, Any], ends: bool) -> None:
    task = begun(MIDDLE, (0.0, 0.0, 0.0), ABOVE)
    outcome = moved(task, *place, **rest)
    assert bool(outcome.terminated) == ends
    assert outcome.reward["termination"] == pytest.approx(-8.0 * ends)


@pytest.mark.parametrize("name", [None, "crazyflie2"])
def test_a_pilot_flies_it(name: str | None) -> None:
    env = gym.make_vec(ID, 8, vehicle=name, autoreset_mode="Disabled")
    pilot = Pilot(Vehicle.load(name))

    def wanted(seen: np.ndarray) -> np.ndarray:
        speed = limited(2 * seen[:, :3], 2.0)
        return 2 * (speed - seen[:, 3:6])

    metrics = fly(env, pilot, wanted, 3, ())
    left, time = metrics[-1].T
    assert left.tolist() == [0.0] * 8
    assert time.max() < 15.0
