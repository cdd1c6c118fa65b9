"""The hover task against values worked out by hand: nothing assumes the first task."""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import TABLES, check_outcome, everyone, loop_of, observed, rows_of, zero_actions
from rotorgram.models.vehicle import Vehicle

from flights import state_of, task_of

ID = "rotorgram/Hover-v0"
HEXA = Path(__file__).parents[1] / "data" / "hexa.xml"


def test_observation_by_hand() -> None:
    """Turned left by 90 degrees where the nose shall point along y: all is seen from there."""
    task = task_of(ID, goal=(1.0, 2.0, 6.0), heading=90.0)
    state = state_of(**TABLES["hover: observation by hand, state"])
    seen = observed(task, state)
    expected = TABLES["hover: observation by hand, expected"]
    assert seen == pytest.approx(expected, abs=1e-12)
    # Rolled left by 30 degrees: the thrust points to the right, -y.
    rolled = state_of(about=((1, 0, 0), 30.0))
    tilted = observed(task_of(ID), rolled)
    root = math.sqrt(3) / 2
    assert tilted[6:12] == pytest.approx([1, 0, 0, 0, -0.5, root], abs=1e-12)


def test_observations_are_clipped_to_their_bounds() -> None:
    task = task_of(ID)
    far = state_of(position=(1e6, 0, 5), velocity=(0, -1e6, 0), body_rates=(0, 0, 1e6))
    seen = observed(task, far)
    assert seen[0] == -6.0
    assert seen[4] == -100.0
    assert seen[14] == 100.0


@rows_of("hover: outcome by hand", "change, terms, terminated", ids=str)
def test_outcome_by_hand(change: dict[str, Any], terms: dict[str, float], terminated: bool) -> None:
    state = state_of(**change)
    outcome = task_of(ID).outcome(state)
    check_outcome(outcome, terms, terminated)


def test_metrics_by_hand() -> None:
    task = task_of(ID, goal=(0.0, 3.0, 9.0), heading=170.0)
    state = state_of(about=((0, 0, 1), -170.0))
    metrics = task.outcome(state).metrics
    assert metrics["position_error"] == pytest.approx(5.0)
    assert metrics["heading_error"] == pytest.approx(20.0)  # 190 to the left of it: past the back


def test_thrust_below_zero_is_observed(tmp_path: Path) -> None:
    """-20 N over 49 N: rotors that push down as well."""
    text = Vehicle.load().path.read_text()
    reverse = text.replace('ctrlrange="0 100"', 'ctrlrange="-20 100"')
    file = tmp_path / "reverse.xml"
    file.write_text(reverse)
    task = task_of(ID, vehicle=file)
    state = state_of(thrust=(-20.0,) * 4)
    seen = observed(task, state)
    assert seen[15:] == pytest.approx([-20 / 49 - 1] * 4)


@pytest.mark.parametrize("file", [None, HEXA], ids=["paper", "hexa"])
def test_actions_are_thrusts_between_the_limits(file: Path | None) -> None:
    vehicle = Vehicle.load(file)
    loop = loop_of(ID, vehicle=file)
    every = everyone(1)
    n = vehicle.num_rotors
    hover = vehicle.hover_thrust
    low = vehicle.thrust_low
    high = vehicle.thrust_high
    expected = {0.0: hover, 1.0: high, -1.0: low, 9.0: high, -0.5: (hover + low) / 2}
    for action, thrust in expected.items():
        loop.advance(zero_actions(1, n), every, [0])
        loop.advance(np.full((1, n), action, np.float32))
        (told,) = loop.telemetry["thrust"]
        np.testing.assert_allclose(told, thrust, rtol=1e-12)


def test_a_single_rotor_turns_the_craft() -> None:
    """Front left pushes: the nose and the left side rise, and it turns against that rotor."""
    env = gym.make(ID, start_band=0.0, start_tilt=0.0, start_heading=0.0)
    env.reset(seed=0)
    info: dict[str, float] = {}
    action = np.array([0.2, 0, 0, 0], np.float32)
    for _ in range(10):
        *_, info = env.step(action)
    assert info["qy"] < -1e-3  # nose up
    assert info["qx"] > 1e-3  # left side up
    assert info["heading_error"] > 0.01  # to the left, as its reaction is about +z


def distance(shares: np.ndarray) -> float:
    """Of Kolmogorov and Smirnov, from uniform shares."""
    even = np.linspace(0, 1, len(shares))
    distances = np.abs(np.sort(shares) - even)
    return float(distances.max())


def test_starts_fill_their_bands() -> None:
    env: Any = gym.make_vec(ID, num_envs=2000, goal=(3.0, -2.0, 7.0), heading=50.0)
    _, info = env.reset(seed=0)
    for name, goal in (("x", 3.0), ("y", -2.0), ("z", 7.0)):
        assert distance((info[name] - goal + 1) / 2) < 1.95 / math.sqrt(2000)
        assert info[f"goal_{name}"].tolist() == [goal] * 2000
    aside = np.hypot(info["qx"], info["qy"])
    tilt = np.degrees(2 * np.arcsin(aside))
    assert distance(tilt / 30.0) < 1.95 / math.sqrt(2000)
    assert 30.0 - 0.1 < tilt.max() <= 30.0 + 1e-9
    errors = info["heading_error"]
    assert abs(errors).max() < 36.0  # 30, and what the tilt adds
    assert abs(errors.mean()) < 1.5
