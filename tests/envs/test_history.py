"""The option `history`: the last observations side by side, on every road to an agent."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import spec_with
from rotorgram.agents import PID
from rotorgram.models.errors import InputError

HOVER = "rotorgram/Hover-v0"
ELEVATION = "rotorgram/Elevation-v0"
LATE = {"randomize": {"observation_delay": "uniform(0, 0.07)"}}
IMU = {"imu": True, "estimate": True}
MEASURED = {"vehicle": "crazyflie2", "sensors": {**IMU, "observe": "estimate"}}
READ = {"vehicle": "crazyflie2", "sensors": IMU}


def sides(rows: list[np.ndarray], count: int) -> list[np.ndarray]:
    """By hand: of each moment the last rows, where the first stands for what is before it."""
    padded = [rows[0]] * (count - 1) + rows
    return [np.concatenate(padded[i : i + count], axis=-1) for i in range(len(rows))]


def flight(env: Any, steps: int = 12) -> list[Any]:
    """Observations of an episode with random actions."""
    observation, _ = env.reset(seed=4)
    seen = [observation]
    dice = np.random.default_rng(0)
    for _ in range(steps):
        action = dice.uniform(-0.3, 0.3, env.action_space.shape).astype(np.float32)
        observation, _, terminated, *_ = env.step(action)
        assert not np.any(terminated)
        seen.append(observation)
    return seen


@pytest.mark.parametrize("options", [{}, LATE, MEASURED], ids=["plain", "late", "measured"])
@pytest.mark.parametrize("count", [2, 5])
def test_one_drone(options: dict[str, Any], count: int) -> None:
    usual = flight(gym.make(HOVER, **options))
    long = flight(gym.make(HOVER, **options, history=count))
    for one, other in zip(sides(usual, count), long, strict=True):
        assert other.tobytes() == one.tobytes()
    assert flight(gym.make(HOVER, **options, history=1))[-1].tobytes() == usual[-1].tobytes()


def test_readings_of_sensors_have_a_history_of_their_own() -> None:
    usual = flight(gym.make(HOVER, **READ))
    long = flight(gym.make(HOVER, **READ, history=3))
    for name in usual[0]:
        for one, other in zip(sides([seen[name] for seen in usual], 3), long, strict=True):
            assert other[name].tobytes() == one.tobytes()


def test_the_spec_names_every_number() -> None:
    usual = spec_with(ELEVATION)
    long = spec_with(ELEVATION, history=3)
    (one,) = usual.observation
    (three,) = long.observation
    assert three.shape == (9,)
    assert three.components[3:] == (
        "elevation error, 1 step ago", "rate of the error, 1 step ago",
        "thrust over hover, 1 step ago",
        "elevation error", "rate of the error", "thrust over hover",
    )  # fmt: skip
    assert three.components[0] == "elevation error, 2 steps ago"
    assert three.unit == ("m", "m/s", "1") * 3
    assert three.low == one.low * 3
    assert three.high == one.high * 3
    assert usual.options["history"] == 1
    assert spec_with(ELEVATION, history=1) == usual


def test_the_error_alone_with_its_past() -> None:
    """The paper's own observation: a policy sees from two of them how fast the craft climbs."""
    env = gym.make(ELEVATION, observation="error", history=4)
    env.reset(seed=1)
    for _ in range(5):
        seen, *_, info = env.step(np.ones(1, np.float32))
    assert env.observation_space.shape == (4,)
    assert seen[-1] == np.float32(info["elevation_error"])
    assert np.diff(seen).max() < 0.0  # it climbs: Y - Y' falls


def test_the_pid_reads_the_newest() -> None:
    flights = []
    for count in (1, 3):
        env = gym.make(ELEVATION, history=count)
        pid = PID(env.unwrapped.env_spec)
        observation, _ = env.reset(seed=0)
        for _ in range(100):
            observation, *_, info = env.step(pid.act(observation))
        flights.append(info["elevation_error"])
    assert flights[0] == flights[1]


@pytest.mark.parametrize("count", [0, 1001, 2.5, "all", True])
def test_a_wrong_history_gives_one_sentence(count: Any) -> None:
    expected = r"^history: expected a whole number from 1 to 1000 observations, got "
    with pytest.raises(InputError, match=expected):
        spec_with(HOVER, history=count)
