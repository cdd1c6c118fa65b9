"""`Dodge-v0`: who waits is hit, and who is not hit for 12 s succeeds."""

import numpy as np
import pytest
from rotorgram.envs import Loop
from rotorgram.envs.config import EnvConfig

from flights import Shares, state_of, task_of

DODGE = "rotorgram/Dodge-v0"


def waits(scene: str | None, worlds: int, aside: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Loop:
    """Flies back to the goal, or to a place aside, m, until the end of each episode."""
    options = {} if scene is None else {"scene": scene}
    loop = Loop(EnvConfig.from_keywords(DODGE, backend="rigid", **options), worlds)
    scale = loop.spec.action_scale
    loop.advance(np.zeros((worlds, 4)), np.ones(worlds, bool), list(range(worlds)))
    ended = np.zeros(worlds, bool)
    for _ in range(300):
        to_goal = loop.observations["observation"][:, :3]
        actions = np.column_stack((1.5 * (to_goal + aside), np.zeros(worlds))) / scale
        loop.advance(np.clip(actions, -1, 1), None, None, ended)
        ended = ended | loop.done
    assert ended.all()
    return loop


def test_who_waits_is_hit() -> None:
    loop = waits(None, 32)
    metrics = loop.metrics
    assert (metrics["touched"] == 1).all()
    assert (metrics["success"] == 0).all()
    assert (metrics["least_clearance"] < 0.02).all()  # at the end of a step that touched
    assert (loop.steps > 20).all()  # nothing comes at once
    assert len(set(loop.world.scenery.seeds)) == 32


@pytest.mark.parametrize("aside", [(0.0, 0.0, 1.8), (1.8, 0.0, 0.0)])
def test_no_place_in_the_band_is_safe(aside: tuple[float, ...]) -> None:
    metrics = waits(None, 32, aside).metrics
    assert metrics["touched"].sum() > 5
    assert (metrics["touched"] + metrics["success"] == 1).all()


def test_where_nothing_comes_it_succeeds() -> None:
    metrics = waits("plain", 2).metrics
    assert metrics["success"] == pytest.approx(1.0)
    assert metrics["touched"] == pytest.approx(0.0)
    assert (metrics["position_error"] < 0.1).all()
    assert (metrics["least_clearance"] > 100).all()
    assert metrics["flight_time"] == pytest.approx(12.0)
    assert (metrics["mean_speed"] < 0.1).all()


def test_speeds_and_clearance_by_hand() -> None:
    """Steps of 0.04 s at 5 m/s and at 1 m/s, 0.4 m and 0.7 m off, the second touching."""
    task = task_of(DODGE)
    task.begin(Shares((0.5, 0.5, 0.5), 0.0, 0.5, 0.5))
    at_goal = {"position": (0.0, 0.0, 2.0)}
    first = state_of(**at_goal, velocity=(3.0, 0.0, 4.0), known_clearance=0.4, time=0.04)
    task.update_memory(first)
    second = state_of(
        **at_goal, velocity=(0.0, 1.0, 0.0), known_clearance=0.7, time=0.08, touching=True
    )
    task.update_memory(second)
    metrics = task.outcome(second).metrics
    expected = {
        "success": 0,
        "touched": 1,
        "mean_speed": 3.0,
        "top_speed": 5.0,
        "least_clearance": 0.4,
        "flight_time": 0.08,
        "position_error": 0,
        "heading_error": 0,
    }
    assert {name: float(metrics[name]) for name in expected} == pytest.approx(expected)
    assert [metric.name for metric in task.metrics] == list(expected)


def test_success_counts_at_the_end_alone() -> None:
    config = EnvConfig.from_keywords(DODGE, backend="rigid", scene="plain", episode_length=5)
    loop = Loop(config, 1)
    loop.advance(np.zeros((1, 4)), np.ones(1, bool), [0])
    found = []
    for _ in range(5):
        loop.advance(np.zeros((1, 4)))
        found.append(loop.metrics["success"][0])
    assert found == [0, 0, 0, 0, 1]
