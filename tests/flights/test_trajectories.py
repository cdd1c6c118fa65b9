"""Trajectories: in batches as one after the other, and from a journal as they were flown."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401  # makes the envs known
from peers import ANY, Running
from rotorgram.agents.pid import PID
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.flights.trajectories import (
    EpisodeSet,
    Trajectory,
    evaluation_seed,
    flown_trajectories,
    fly_episodes,
)
from rotorgram.models.errors import InputError
from rotorgram.training.metrics import Headline, measure_episode
from rotorgram.udp import RemoteVectorEnv, Simulator
from rotorgram.udp.spawn import spawn_simulator

ELEVATION = "rotorgram/Elevation-v0"
SHORT: dict[str, Any] = {"episode_length": 25}  # half a second
CONFIG = EnvConfig.from_keywords(ELEVATION, **SHORT)
SPEC = env_spec(CONFIG)


def same(one: Trajectory, other: Trajectory) -> bool:
    """Whether every bit of every number is the same."""
    if (one.ending, one.episode, one.spec) != (other.ending, other.episode, other.spec):
        return False
    if one.rewards.tobytes() != other.rewards.tobytes():
        return False
    bits = {name: values.tobytes() for name, values in one.telemetry.items()}
    return bits == {name: values.tobytes() for name, values in other.telemetry.items()}


def config_of(**options: Any) -> EnvConfig:
    return EnvConfig.from_keywords(ELEVATION, **options)


def local(drones: int = 1, **options: Any) -> LocalVectorEnv:
    return LocalVectorEnv(config_of(**options), drones, autoreset_mode="Disabled")


class Clumsy:
    """Full thrust in episodes that begin below the target: they end at different steps."""

    def reset(self) -> None:
        """Forget the start."""
        self._up: bool | None = None

    def act(self, observation: np.ndarray) -> np.ndarray:
        if self._up is None:
            self._up = bool(observation[0] > 0)
        return np.array([1.0 if self._up else 0.0], np.float32)


@pytest.mark.parametrize("drones", [2, 5, 8])
def test_a_batch_is_bit_for_bit_as_one_after_the_other(drones: int) -> None:
    with closing(local(episode_length=120)) as env:
        alone = fly_episodes(env, Clumsy(), 5)
    with closing(local(drones, episode_length=120)) as env:
        together = fly_episodes(env, Clumsy(), 5)
    assert len({len(one) for one in alone}) > 1  # some crash
    assert {one.ending for one in alone} == {"terminated", "truncated"}
    assert all(map(same, alone, together))


def test_a_batch_over_udp_is_bit_for_bit_as_in_process() -> None:
    flown = flown_trajectories(PID(SPEC), CONFIG, range(3))
    with spawn_simulator(CONFIG, num_envs=2) as env:
        assert all(map(same, flown, fly_episodes(env, PID(SPEC), 3)))


def test_a_trajectory_is_what_the_env_tells() -> None:
    (flown,) = flown_trajectories(PID(SPEC), CONFIG, [3])
    with closing(gym.make(ELEVATION, **SHORT).unwrapped) as env:
        observation, info = env.reset(seed=evaluation_seed(3))
        policy = PID(SPEC)
        heights = [info["z"]]
        errors = [info["elevation_error"]]
        rewards = []
        for _ in range(25):
            observation, reward, *_, info = env.step(policy.act(observation))
            heights.append(info["z"])
            errors.append(info["elevation_error"])
            rewards.append(reward)
    assert len(flown) == 25
    assert flown.ending == "truncated"
    assert flown.seconds == 0.5
    assert flown.episode == 3
    assert flown.telemetry["position"][:, 2].tolist() == heights
    assert flown.headline.tolist() == errors
    assert flown.rewards.tolist() == rewards
    assert [flown.step_at(s) for s in (-1.0, 0.0, 0.06, 0.07, 9.0)] == [0, 0, 3, 3, 25]
    row = measure_episode(flown, Headline.of(SPEC))
    assert row["episode"] == 3
    assert row["length"] == 25
    # A quarter of 25 steps is 6.
    assert row["steady"] == pytest.approx(np.mean(np.abs(errors[-6:])), rel=1e-12)
    assert row["return"] == pytest.approx(sum(rewards), rel=1e-12)


def test_sets_of_evaluation_episodes_share_no_seed() -> None:
    sets: tuple[EpisodeSet, ...] = ("final", "curve", "tuning")
    seeds = {evaluation_seed(episode, of) for of in sets for episode in range(100)}
    assert len(seeds) == 300


def test_a_recorded_trajectory_is_the_one_that_was_flown(tmp_path: Path) -> None:
    journal = tmp_path / "pid.mcap"
    with spawn_simulator(CONFIG, num_envs=1, record=journal) as env:
        flown = fly_episodes(env, PID(SPEC), 2)
        env.reset(seed=3)  # given up at once: no episode
        env.reset(seed=4)
        env.step(np.zeros((1, 1), np.float32))  # cut off
    recorded = recorded_trajectories(journal, [0, 1, 2])
    assert all(map(same, flown, recorded))
    last = recorded[2]
    assert len(last) == 1
    assert last.ending == "cut off"
    assert last.episode == 2
    with pytest.raises(ValueError, match=r"episode: expected 0 to 2 in .*, got 3"):
        recorded_trajectories(journal, [3])


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
        remote.reset(options={"reset_mask": np.array([False, True])})  # the first one is frozen
        for _ in range(3):
            remote.step(actions)
    running.join()
    with closing(gym.make(ELEVATION).unwrapped) as env:
        for seed, drone, steps in ((7, 0, 8), (8, 1, 5)):
            _, info = env.reset(seed=seed)
            heights = [info["z"]]
            for _ in range(steps):
                heights.append(env.step(actions[0])[4]["z"])
            (found,) = recorded_trajectories(journal, [0], drone=drone)
            assert found.telemetry["position"][:, 2].tolist() == heights
            assert found.ending == "cut off"
    (second,) = recorded_trajectories(journal, [1], drone=1, session=1)
    assert len(second) == 3
    assert second.episode == 1
    everybody = recorded_trajectories(journal, drone=None)
    numbers = [(one.drone, one.episode, one.seed, len(one)) for one in everybody]
    assert numbers == [(0, 0, 7, 8), (1, 0, 8, 5), (1, 1, None, 3)]
    for choice, sentence in (
        ({"drone": 2}, "drone: expected 0 to 1 in .*, got 2"),
        ({"drone": -1}, "drone: expected 0 to 1"),
        ({"session": 2}, "session: expected 1 to 1, got 2"),
        ({"session": 0}, "session: expected 1 to 1, got 0"),
    ):
        with pytest.raises(ValueError, match=sentence):
            recorded_trajectories(journal, [0], **choice)


def test_a_journal_without_a_step_is_one_sentence(tmp_path: Path) -> None:
    journal = tmp_path / "nothing.mcap"
    with spawn_simulator(CONFIG, record=journal) as env:
        env.reset(seed=0)
    with pytest.raises(ValueError, match="expected an episode with a step in it"):
        recorded_trajectories(journal, [0])
    (tmp_path / "text.mcap").write_text("no journal")
    with pytest.raises(ValueError, match="expected an MCAP file"):
        recorded_trajectories(tmp_path / "text.mcap", [0])
    with pytest.raises(FileNotFoundError):
        recorded_trajectories(tmp_path / "nowhere.mcap", [0])


def test_an_observation_may_have_the_name_of_telemetry() -> None:
    """As that of another env of Gymnasium, whose numbers are no telemetry of ours."""
    with closing(local()) as env:
        named = replace(env.env_spec.observation[0], name="position")
        env.env_spec = replace(env.env_spec, observation=(named,))
        (flown,) = fly_episodes(env, PID(SPEC), 1, observations=["position"])
    (usual,) = flown_trajectories(PID(SPEC), config_of(), [0])
    np.testing.assert_array_equal(flown.telemetry["position"], usual.telemetry["position"])
    assert flown.observations["position"].shape == (len(flown) + 1, 3)


class Twisted:
    """Gives two numbers where the env wants one."""

    def reset(self) -> None:
        pass

    def act(self, observation: np.ndarray) -> np.ndarray:
        return np.zeros(2, np.float32)


def test_an_action_of_a_wrong_shape_is_one_sentence() -> None:
    sentence = r"^twisted: expected an action of shape \(1,\), got \(2,\)$"
    with pytest.raises(InputError, match=sentence):
        flown_trajectories(Twisted(), CONFIG, [0])


def test_random_trajectories_are_the_same_for_the_same_episode() -> None:
    first, second = flown_trajectories(None, CONFIG, [0, 1])
    (again,) = flown_trajectories(None, CONFIG, [1])
    assert same(again, second)
    assert first.rewards.tolist() != second.rewards.tolist()
