"""The tracking task against values worked out by hand; a pilot flies every trajectory."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import GOAL_OFFSET, TABLES, observed, rows_of
from pilot import Pilot, fly, limited
from rotorgram.models import Vehicle

from flights import Shares, state_of, task_of

ID = "rotorgram/Tracking-v0"
HALF = (0.5, 0.5, 0.5)


def begun(share: float = 0.0, **options: Any) -> Any:
    task = task_of(ID, **{"trajectory": "circle", "preview": 1, **options})
    task.begin(Shares(share, HALF))
    return task


def goal_after(task: Any, steps: int) -> Any:
    state = state_of()
    for _ in range(steps):
        task.update_memory(state)
    return task.goal(state)


def test_a_circle_by_hand() -> None:
    """2 m in 10 s: after a quarter it is at the top, as fast as 2 π 2 m / 10 s."""
    task = task_of(ID, center=(1.0, 2.0, 6.0))
    pose = task.begin(Shares(0.25, (1.0, 0.5, 0.5)))
    assert pose.position == pytest.approx([1.3, 4.0, 6.0], abs=1e-9)  # 0.3 m aside
    assert pose.velocity == pytest.approx([-0.4 * math.pi, 0.0, 0.0], abs=1e-9)
    another_quarter = goal_after(task, 125)
    assert another_quarter == pytest.approx([-1.0, 2.0, 6.0])
    around = goal_after(task, 375)
    assert around == pytest.approx([1.0, 4.0, 6.0])


def test_a_lemniscate_by_hand() -> None:
    """At 45° of φ: (cos φ, sin φ cos φ) / (1 + sin² φ) = (√2 / 3, 1 / 3)."""
    task = begun(0.125, trajectory="lemniscate", radius=3.0, period=20.0)
    assert task.goal(state_of()) == pytest.approx([math.sqrt(2), 1.0, 5.0])
    table = task._table
    step = 0.02
    way = table[2:] - table[:-2]
    inner_rates = task._rates[1:-1]
    assert inner_rates == pytest.approx(way / (2 * step), abs=1e-4)


def test_observation_by_hand() -> None:
    task = begun(preview_time=5.0)  # half a round later
    state = state_of(position=(1.0, 0.5, 4.0), velocity=(1.0, 2.0, 3.0))
    seen = observed(task, state)
    expected = TABLES["tracking: observation by hand, expected"]
    assert seen == pytest.approx([*expected, 0, 0.4 * math.pi, 0, -3, -0.5, 1], abs=1e-9)
    (spec,) = task.observation
    assert spec.components[:3] == GOAL_OFFSET
    assert spec.components[-1] == "reference 5 s later - position z"


def test_reward_and_metrics_by_hand() -> None:
    state = state_of(position=(2.0, 1.5, 5.0), body_rates=(3.0, 0.0, 4.0))
    outcome = begun().outcome(state)
    assert outcome.reward["position"] == pytest.approx(-0.5)
    assert outcome.reward["rates"] == pytest.approx(-0.1)
    assert outcome.metrics["tracking_error"] == pytest.approx(1.5)
    assert outcome.metrics["reference_speed"] == pytest.approx(0.4 * math.pi)
    assert not outcome.terminated


@rows_of("tracking: ends", "state, ends")
def test_ends(state: dict[str, Any], ends: bool) -> None:
    outcome = begun().outcome(state_of(**state))
    assert bool(outcome.terminated) == ends
    assert outcome.reward["termination"] == pytest.approx(-140.0 * ends)


@rows_of("tracking: a pilot flies it", "trajectory, name")
def test_a_pilot_flies_it(trajectory: str, name: str | None) -> None:
    """Without feed-forward of the acceleration."""
    vehicle = Vehicle.load(name)
    env = gym.make_vec(ID, 4, vehicle=name, autoreset_mode="Disabled", trajectory=trajectory)
    first = 15 + vehicle.num_rotors

    def wanted(seen: np.ndarray) -> np.ndarray:
        reference = seen[:, first : first + 3]
        speed = limited(2.0 * seen[:, :3], 2.0) + reference
        return 3.0 * (speed - seen[:, 3:6])

    metrics = fly(env, Pilot(vehicle), wanted, 3)
    assert len(metrics) == 600
    assert metrics[-150:, :, 0].max() < 0.8
