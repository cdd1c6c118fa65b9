"""Where the flights of a film come from: they are those that were flown."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from peers import ANY, Running
from pictures import SHORT
from rotorgram.agents.pid import PID
from rotorgram.envs import ElevationEnv
from rotorgram.experiments.evaluate import evaluation_seed, fly
from rotorgram.experiments.flights import flown_tracks, recorded_tracks
from rotorgram.experiments.pairs import socket_pair
from rotorgram.udp import RemoteVectorEnv, Simulator


def test_a_recorded_flight_is_the_one_that_was_flown(tmp_path: Path) -> None:
    journal = tmp_path / "pid.mcap"
    with socket_pair(SHORT, record=journal) as env:
        for episode in range(2):
            fly(env, PID(SHORT), evaluation_seed(episode))
        env.reset(seed=3)  # given up at once: no episode
        env.reset(seed=4)
        env.step(np.zeros(1, np.float32))  # cut off
    flown = flown_tracks(PID(SHORT), SHORT, [0, 1])
    recorded = recorded_tracks(journal, [0, 1, 2])
    for one, other in zip(flown, recorded, strict=False):
        assert repr(one) == repr(other)  # every bit of every number
        assert (len(one.moments), one.ending, one.seconds) == (26, "truncated", 0.5)
    last = recorded[2]
    assert (len(last.moments), last.ending, last.moments[1].episode) == (2, "cut off", 2)
    start = last.moments[0]
    assert start.target == pytest.approx(5.0, abs=1e-6)
    assert (start.step, start.reward) == (0, 0.0)
    with pytest.raises(ValueError, match=r"episode: expected 0 to 2 in .*, got 3"):
        recorded_tracks(journal, [3])


def test_any_drone_of_any_session(tmp_path: Path) -> None:
    journal = tmp_path / "two.mcap"
    options: dict[str, Any] = {"timeout": 5, "connect_timeout": 5, "connect": False}
    options |= {"num_envs": 2, "autoreset_mode": "Disabled"}
    actions = np.full((2, 1), 0.25, np.float32)
    with closing(RemoteVectorEnv(ANY, record=journal, **options)) as remote:
        running = Running(Simulator(server=remote.address, bind=ANY, num_envs=2))
        remote.reset(seed=[7, 8])
        for _ in range(5):
            remote.step(actions)
        remote.reset(options={"reset_mask": np.array([False, True])})  # the first one waits
        for _ in range(3):
            remote.step(actions)
    running.join()
    env = ElevationEnv()
    for seed, drone, steps in ((7, 0, 8), (8, 1, 5)):
        _, info = env.reset(seed=seed)
        heights = [info["Y"]]
        for _ in range(steps):
            heights.append(env.step(actions[0])[4]["Y"])
        (found,) = recorded_tracks(journal, [0], drone=drone)
        assert [moment.position[1] for moment in found.moments] == heights
        assert found.ending == "cut off"
    (second,) = recorded_tracks(journal, [1], drone=1, session=1)
    assert [(moment.step, moment.episode) for moment in second.moments] == [
        (step, 1) for step in range(4)
    ]
    for choice, sentence in (
        ({"drone": 2}, "drone: expected 0 to 1 in .*, got 2"),
        ({"drone": -1}, "drone: expected 0 to 1"),
        ({"session": 2}, "session: expected 1 to 1, got 2"),
        ({"session": 0}, "session: expected 1 to 1, got 0"),
    ):
        with pytest.raises(ValueError, match=sentence):
            recorded_tracks(journal, [0], **choice)


def test_what_holds_no_flight_is_one_sentence(tmp_path: Path) -> None:
    journal = tmp_path / "nothing.mcap"
    with socket_pair(SHORT, record=journal) as env:
        env.reset(seed=0)
    with pytest.raises(ValueError, match="expected an episode in which something was flown"):
        recorded_tracks(journal, [0])
    (tmp_path / "text.mcap").write_text("no journal")
    with pytest.raises(ValueError, match="expected an MCAP file"):
        recorded_tracks(tmp_path / "text.mcap", [0])
    with pytest.raises(ValueError, match=r"nowhere\.mcap: expected a journal"):
        recorded_tracks(tmp_path / "nowhere.mcap", [0])


def test_random_flights_are_the_same_for_the_same_episode() -> None:
    first, second = flown_tracks(None, SHORT, [0, 1])
    (again,) = flown_tracks(None, SHORT, [1])
    assert repr(again) == repr(second)
    assert repr(first) != repr(second)
