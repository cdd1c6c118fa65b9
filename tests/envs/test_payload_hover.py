"""The payload task against values worked out by hand."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import (
    GOAL_OFFSET,
    TABLES,
    check_outcome,
    everyone,
    loop_of,
    observed,
    rows_of,
    spec_with,
    zero_actions,
)
from pilot import Pilot, fly, limited
from rotorgram.models import Vehicle
from worlds import alone

from flights import Shares, about, state_of, task_of

ID = "rotorgram/PayloadHover-v0"
AT_GOAL = {"payload": (0.0, 0.0, 4.0), "payload_velocity": (0.0, 0.0, 0.0)}  # the craft at 5 m


def test_a_start_by_hand() -> None:
    """Tilted by 7.5° about y, moving along -x, at the thrust that carries 20 kg and 2 kg."""
    shares = Shares((1.0, 0.5, 0.0), 0.5, 0.75, 0.0, 0.5)
    pose = task_of(ID).begin(shares)
    assert pose.position == pytest.approx([1.0, 0.0, 4.0])
    assert pose.quaternion == pytest.approx(about((0, 1, 0), 7.5), abs=1e-12)
    assert pose.velocity == pytest.approx([-1.0, 0.0, 0.0])
    assert pose.thrust == pytest.approx([1.1 * 49.0] * 4)


@pytest.mark.parametrize("vehicle", ["paper", "crazyflie2"])
def test_the_task_hangs_the_payload_itself(vehicle: str) -> None:
    """The world has it, the spec tells it, and what the effects say of it is replaced."""
    efficiency = [1.0, 1.0, 0.9, 1.0]
    options: dict[str, Any] = {"payload_share": 0.2, "cable": 0.7}
    options["effects"] = {"efficiency": efficiency}
    told = spec_with(ID, **options, vehicle=vehicle)
    assert "payload" in [array.name for array in told.telemetry]
    assert told.options["effects"] == {"efficiency": efficiency}
    assert spec_with(ID, **told.options, vehicle=vehicle) == told
    loop = loop_of(ID, vehicle=vehicle, **options)
    loop.advance(zero_actions(1, 4), everyone(1), [0])
    state = alone(loop.world)
    assert state.position - state.payload == pytest.approx([0.0, 0.0, 0.7])
    assert state.payload_velocity.tolist() == state.velocity.tolist()
    seen = loop.observations["observation"]
    assert seen[0, 19:] == pytest.approx([0, 0, -0.7, 0, 0, 0])


def test_observation_by_hand() -> None:
    task = task_of(ID, goal=(1.0, 2.0, 6.0))
    state = state_of(**TABLES["payload hover: observation by hand, state"])
    seen = observed(task, state)
    expected = TABLES["payload hover: observation by hand, expected"]
    assert seen == pytest.approx(expected, abs=1e-12)
    assert task.goal(state).tolist() == [1.0, 2.0, 6.0]
    (spec,) = task.observation
    assert spec.components[:3] == GOAL_OFFSET
    assert spec.components[19] == "payload - position x"
    assert spec.components[24] == "payload velocity - velocity z"
    _, high = spec.bounds()
    assert high[[0, 19, 24]].tolist() == [6.0, 2.0, 100.0]


@rows_of("outcome by hand", "change, terms, terminated", ids=str)
def test_outcome_by_hand(change: dict[str, Any], terms: dict[str, float], terminated: bool) -> None:
    state = state_of(**{**AT_GOAL, **change})
    outcome = task_of(ID).outcome(state)
    check_outcome(outcome, terms, terminated)


def test_metrics_by_hand() -> None:
    """30° to the side on a cable of 1 m, under a craft at 5 m."""
    below = math.sqrt(3) / 2
    payload = (0.5, 0.0, 5.0 - below)
    state = state_of(**{**AT_GOAL, "payload": payload})
    metrics = task_of(ID).outcome(state).metrics
    away = math.hypot(0.5, 1 - below)
    assert metrics["payload_error"] == pytest.approx(away)
    assert metrics["swing"] == pytest.approx(30.0)


def swinging_pilot(seen: np.ndarray, rotors: int) -> np.ndarray:
    """Linear-quadratic gains for a point that carries a pendulum of 1 m and a tenth of its mass,
    with a lag of 0.2 s; the last term is the acceleration that it has."""
    offset = seen[:, :3]
    speed = seen[:, 3:6]
    axis = seen[:, 9:12]
    payload = seen[:, 15 + rotors :]
    hung = payload[:, :3]
    moving = payload[:, 3:6]
    of_craft = 3.2 * offset - 4.0 * speed
    of_payload = 3.3 * hung + 2.1 * moving
    wanted = of_craft + of_payload - 7.0 * axis
    wanted[:, 2] = 4 * offset[:, 2] - 4 * speed[:, 2]
    return limited(wanted, 5.0)


@pytest.mark.parametrize("vehicle", ["paper", "crazyflie2", "heavy_hexa"])
def test_a_pilot_damps_the_swing(vehicle: str) -> None:
    """From all of 16 starts: below 5 cm and 1° for the last second."""
    craft = Vehicle.load(vehicle)
    env: Any = gym.make_vec(ID, num_envs=16, autoreset_mode="Disabled", vehicle=vehicle)
    carried = (0, 0, 0.1 * craft.gravity)
    pilot = Pilot(craft, 100.0, 20.0)

    def wanted(seen: np.ndarray) -> np.ndarray:
        return 1.1 * swinging_pilot(seen, craft.num_rotors) + carried

    errors = fly(env, pilot, wanted)
    assert len(errors) == 250
    first = errors[:100].max(axis=(0, 1))
    assert first.min() > 0.5  # it does swing at first
    last = errors[200:].max(axis=(0, 1))
    assert (last < (0.05, 1.0)).all()


@rows_of("hovering without the payload drops it", "share, factor")
def test_hovering_without_the_payload_drops_it(share: float, factor: float) -> None:
    """Action 0 carries the craft alone: both sink with g · 0.1 / 1.1, in 2 s by 1.8 m. The mass of
    a payload may be drawn as that of any."""
    drawn = {"payload": f"uniform({factor}, {factor})"}
    still = {"start_band": 0.0, "start_speed": 0.0, "start_tilt": 0.0}
    env: Any = gym.make(ID, **still, payload_share=share, randomize=drawn)
    env.reset(seed=0)
    action = np.zeros(4, np.float32)
    for _ in range(100):
        _, _, terminated, _, info = env.step(action)
        assert not terminated
    assert info["payload_error"] == pytest.approx(9.8 / 11 * 2.0, rel=0.01)
    assert info["swing"] == pytest.approx(0.0, abs=1e-6)
