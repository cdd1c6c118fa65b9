"""`Gates-v0`: the track of a layout, by hand and in flight."""

import math
from typing import Any

import numpy as np
import pytest
from contracts import loop_of
from rotorgram.models import InputError
from rotorgram.scenes import SceneConfig, Solids
from rotorgram.scenes.generators import drafted

from flights import Shares, state_of, task_of

GATES = "rotorgram/Gates-v0"
# Eight gates along x, 4 m apart, 2 m high, passed to the front, 1.5 m wide.
TRACK = np.array([(4.0 * i, 0.0, 2.0, 1.0, 0.0, 0.75) for i in range(8)])


def begun(**options: Any) -> Any:
    task = task_of(GATES, **options)
    shares = Shares((0.5, 0.5, 0.5))
    shares.openings = TRACK
    return task, task.begin(shares)


def left(task: Any, *position: float) -> float:
    state = state_of(position=position)
    task.update_memory(state)
    return float(task.outcome(state).metrics["gates_left"])


def test_a_start_is_before_the_first_gate() -> None:
    _, pose = begun()
    assert pose.position == pytest.approx([-1.2, 0.0, 2.0])  # 4 m of a track of 50 m, here 15 m
    assert pose.quaternion == pytest.approx([1.0, 0.0, 0.0, 0.0])


def test_gates_are_passed_in_order_and_direction() -> None:
    task, _ = begun()
    assert left(task, 0.1, 0.0, 2.0) == 7
    assert task.goal(state_of()) == pytest.approx([4.0, 0.0, 2.0])
    assert left(task, 3.9, 0.8, 2.0) == 7
    assert left(task, 4.1, 0.8, 2.0) == 7  # beside the opening
    assert left(task, 3.9, 0.0, 2.0) == 7  # against the direction
    assert left(task, 4.1, 0.0, 2.0) == 6


def test_success_is_a_passage_of_all_gates() -> None:
    task, _ = begun()
    found = []
    for x in range(8):
        state = state_of(position=(4.0 * x + 0.1, 0.0, 2.0), time=0.5 * (x + 1))
        task.update_memory(state)
        found.append(task.outcome(state).metrics["success"])
    assert found == [0, 0, 0, 0, 0, 0, 0, 1]


def test_speeds_and_clearance_by_hand() -> None:
    """Steps of 0.02 s at 5 m/s and at 1 m/s, 0.4 m and 0.7 m off, the second touching."""
    task, _ = begun()
    first = state_of(velocity=(3.0, 0.0, 4.0), known_clearance=0.4, time=0.02)
    task.update_memory(first)
    second = state_of(velocity=(0.0, 1.0, 0.0), known_clearance=0.7, time=0.04, touching=True)
    task.update_memory(second)
    metrics = task.outcome(second).metrics
    expected = {
        "gates_left": 8,
        "flight_time": 0.04,
        "lap_time": 0,
        "success": 0,
        "touched": 1,
        "mean_speed": 3.0,
        "top_speed": 5.0,
        "least_clearance": 0.4,
    }
    assert {name: float(value) for name, value in metrics.items()} == pytest.approx(expected)
    assert [metric.name for metric in task.metrics] == list(expected)


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ("rotors", [0, -1, 0, 0, -5, 0, 0, -1, 0, 0.75]),  # of a craft that looks to the left
        ("velocity", [1, 0, 5, 0, 0, 1, 0, 0.75]),
    ],
)
def test_gates_are_seen_in_the_frame_of_the_action(action: str, expected: list[float]) -> None:
    task, _ = begun(action=action)
    state = state_of(position=(-1.0, 0.0, 2.0), about=((0.0, 0.0, 1.0), 90.0))
    seen = task.observe(state)["observation"]
    to_goal = (0, -1, 0) if action == "rotors" else (1, 0, 0)
    assert seen[:3] == pytest.approx(to_goal, abs=1e-12)
    assert seen[-len(expected) :] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_openings_are_those_of_the_layout(seed: int) -> None:
    scene = SceneConfig.parse(f"gates:{seed},size=15x15")
    solids = Solids.of_layout(scene, seed)
    openings = drafted(scene, seed).ways
    assert openings.shape == (8, 6)
    assert np.hypot(*openings[:, 3:5].T) == pytest.approx(1.0)
    assert solids.distance(openings[:, :3]) == pytest.approx(0.75)  # half of what is inside
    c, s = openings[:, 3:5].T
    aside = openings[:, :3] + 0.8 * np.column_stack((-s, c, 0.0 * c))
    assert solids.distance(aside).max() < 0.0
    starts = openings[:, :3] - 1.2 * np.column_stack((c, s, 0.0 * c))
    assert solids.distance(starts)[0] > 0.5


def flown(up: int) -> tuple[Any, Any]:
    """Loops of eight layouts after `up` steps of climb and a second forward."""
    loop = loop_of(GATES, 8, backend="rigid", action="velocity", start_band=0.0)
    actions = np.zeros((8, 4))
    loop.advance(actions, np.ones(8, bool), list(range(8)))
    ended = np.zeros(8, bool)
    for step in range(110):
        climbs = step < up
        speed = np.array((0.0, 0.0, 1.0, 0.0) if climbs else (1.5, 0.0, 0.0, 0.0))
        loop.advance(speed / loop.spec.action_scale + actions, None, None, ended)
        ended = ended | loop.terminated
    return loop, ended


def test_straight_ahead_is_the_first_gate() -> None:
    loop, _ = flown(0)
    assert (loop.metrics["gates_left"] == 7).sum() >= 7
    loop.close()


def test_a_frame_ends_the_episode() -> None:
    loop, ended = flown(45)
    assert ended.all()
    assert (loop.metrics["gates_left"] == 8).all()
    assert (loop.metrics["touched"] == 1).all()
    assert (loop.metrics["success"] == 0).all()
    assert (loop.metrics["least_clearance"] < 0.02).all()
    assert (loop.metrics["top_speed"] < 2.0).all()  # commands of 1 m/s and 1.5 m/s
    away = np.linalg.norm(loop.telemetry["position"] - loop.telemetry["goal"], axis=1)
    assert (away < math.hypot(0.75 + 0.25, 0.5)).all()
    loop.close()


def test_episodes_have_tracks_of_their_own() -> None:
    loop = loop_of(GATES, 8, backend="rigid")
    loop.advance(np.zeros((8, 4)), np.ones(8, bool), list(range(8)))
    for seed, goal in zip(loop.world.scenery.seeds, loop.telemetry["goal"], strict=True):
        scene = loop.config.scene.with_seed(int(seed))
        assert goal == pytest.approx(drafted(scene, int(seed)).ways[0, :3])
    assert len(set(loop.world.scenery.seeds.tolist())) == 8
    loop.close()


def test_what_it_cannot_fly_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"scene: expected gates with rotorgram/Gates-v0, got for"):
        task_of(GATES, scene="forest:3")
    with pytest.raises(InputError, match=r"opening: expected gates wider than the craft"):
        task_of(GATES, vehicle="paper")
    with pytest.raises(InputError, match="scene: expected a square of gates"):
        SceneConfig.parse("gates:3,size=20x15")
