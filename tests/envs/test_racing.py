"""The racing task against values worked out by hand; a pilot flies every track."""

import json
import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import GOAL_OFFSET, TABLES, observed, rows_of
from pilot import Pilot, fly, limited
from rotorgram.models import Vehicle
from rotorgram.models.errors import InputError

from flights import Shares, state_of, task_of

ID = "rotorgram/Racing-v0"
# Along x, then a turn to the left: a gate at x = 2, one at y = 3; start at the origin, 5 m high.
TRACK = json.dumps(TABLES["racing: TRACK"])


def begun(**options: Any) -> Any:
    task = task_of(ID, **{"track": TRACK, **options})
    task.begin(Shares((0.5, 0.5, 0.5)))
    return task


def moved(task: Any, *position: float, **rest: Any) -> Any:
    state = state_of(position=position, **rest)
    task.update_memory(state)
    return task.outcome(state)


def test_a_start_by_hand() -> None:
    task = task_of(ID, track=TRACK, start_band=2.0)
    pose = task.begin(Shares((1.0, 0.0, 0.5)))
    assert pose.position.tolist() == [2.0, -2.0, 5.0]
    root = math.sqrt(0.5)
    assert pose.quaternion == pytest.approx([root, 0.0, 0.0, root])


@rows_of("racing: observation by hand", "action, expected")
def test_observation_by_hand(action: str, expected: list[float]) -> None:
    """Body x is along y of the world, body y along z, body z along x."""
    task = begun(action=action)
    state = state_of(position=(1.0, 0.5, 4.0), velocity=(1.0, 2.0, 3.0), quaternion=[0.5] * 4)
    seen = observed(task, state)
    assert seen == pytest.approx(expected, abs=1e-12)
    (spec,) = task.observation
    assert spec.components[:3] == GOAL_OFFSET
    _, high = spec.bounds()
    assert high[0] == pytest.approx(math.hypot(2, 3) + 10.0)
    assert task.goal(state).tolist() == [2.0, 0.0, 5.0]
    frame, other = ("body", "attitude") if action == "rotors" else ("world", "rotors")
    assert observed(begun(action=other, frame=frame), state).tolist() == seen.tolist()


@rows_of("what is a pass", "before, after, passes")
def test_what_is_a_pass(before: Any, after: Any, passes: bool) -> None:
    task = begun()
    assert moved(task, *before).metrics["gates_left"] == 2
    outcome = moved(task, *after)
    assert outcome.metrics["gates_left"] == 2 - passes
    assert outcome.reward["passing"] == passes


def test_a_lap_by_hand() -> None:
    task = begun(laps=2)
    outcome = moved(task, 1.5, 0.0, 5.0, body_rates=(3.0, 0.0, 4.0))
    expected = {"progress": 1.5, "passing": 0.0, "time": -0.04, "rates": -0.01, "termination": 0.0}
    reward = {name: float(value) for name, value in outcome.reward.items()}
    assert reward == pytest.approx(expected)
    outcome = moved(task, 2.5, 0.0, 5.0)  # 0.5 m before the gate, 0.5 m behind it
    assert outcome.reward["progress"] == pytest.approx(0.0, abs=1e-12)
    outcome = moved(task, 2.0, 2.0, 5.0)
    assert outcome.reward["progress"] == pytest.approx(math.hypot(0.5, 3.0) - 1.0)
    outcome = moved(task, 2.0, 3.5, 5.0, time=0.08)
    told = [outcome.metrics[name] for name in ("gates_left", "flight_time", "lap_time")]
    assert told == pytest.approx([2, 0.08, 0.08])
    assert not outcome.terminated
    for place in TABLES["racing: places after a pass"]:
        outcome = moved(task, *place)
        assert not outcome.terminated
    outcome = moved(task, 2.0, 3.1, 5.0, time=0.16)
    told = [outcome.metrics[name] for name in ("gates_left", "flight_time", "lap_time")]
    assert told == pytest.approx([0, 0.16, 0.08])
    assert outcome.terminated
    assert outcome.reward["termination"] == 0.0


@rows_of("ends", "place, rest, ends")
def test_ends(place: Any, rest: dict[str, Any], ends: bool) -> None:
    outcome = moved(begun(), *place, **rest)
    assert bool(outcome.terminated) == ends
    assert outcome.reward["termination"] == pytest.approx(-8.0 * ends)


def test_a_track_of_a_file_crosses_the_wire(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(
        "gates = [{ position = [1, 2, 6], heading = -90, size = 3 }]\n"
        "start = { position = [0, 0, 5], heading = 0 }\n"
    )
    task = task_of(ID, track=str(file))
    told = task.options.to_options()["track"]
    file.unlink()
    again = task_of(ID, track=told)
    again.memory.passed = 0.0
    assert again.options.track == told
    assert again.goal(state_of()).tolist() == [1.0, 2.0, 6.0]


@rows_of("wrong tracks", "content, sentence")
def test_wrong_tracks(content: Any, sentence: str) -> None:
    text = content if isinstance(content, str) else json.dumps(content)
    with pytest.raises(InputError) as error:
        task_of(ID, track=text)
    first, _, last = sentence.partition(".*")
    assert str(error.value).startswith(first.strip())
    assert last.strip() in str(error.value)


@rows_of("racing: a pilot flies it", "track, name")
def test_a_pilot_flies_it(track: str, name: str | None) -> None:
    vehicle = Vehicle.load(name)
    env = gym.make_vec(ID, 4, vehicle=name, autoreset_mode="Disabled", track=track, laps=1)
    first = 15 + vehicle.num_rotors

    def wanted(seen: np.ndarray) -> np.ndarray:
        """To a point before the gate, until the craft is on the line through its middle."""
        way = seen[:, first : first + 3]
        away = seen[:, :3]
        before = np.sum(away * way, axis=1, keepdims=True)  # how far it is ahead
        aside = away - before * way
        on_line = np.linalg.norm(aside, axis=1, keepdims=True) < 0.5
        target = away + np.where(on_line & (before > -1.0), 1.0, -2.0) * way
        return 2.0 * (limited(1.5 * target, 2.0) - seen[:, 3:6])

    metrics = fly(env, Pilot(vehicle), wanted, 3, (first - 3,))
    left, time, lap = metrics[-1].T
    assert left.tolist() == [0.0] * 4
    assert (lap == time).all()
    assert time.max() < 30.0
