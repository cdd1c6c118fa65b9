"""Episodes and rollouts of any number of drones: seeds, logs, resuming, SB3's side."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from drones import ENV, OPTIONS
from drones import vector as drones_of
from nets import random_policy
from rotorgram.agents import Config, EpisodeRecorder, ResumeError, make_agent, preset
from rotorgram.agents.episodes import episode_seed
from rotorgram.agents.rollouts import Collector
from rotorgram.agents.sb3 import RecordedEnv, SB3VecEnv
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import evaluation_seed
from rotorgram.models.errors import InputError
from rotorgram.training.study import open_env

N = 5


def vector(drones: int = N, mode: str = "Disabled", **options: Any) -> LocalVectorEnv:
    return drones_of(drones, mode, **{**OPTIONS, **options})


def collector_of(drones: int, **options: Any) -> tuple[EpisodeRecorder, Collector]:
    log = EpisodeRecorder(vector(drones, **options), 0)
    policy = random_policy(log.spec, size=0.3)
    return log, Collector(log, np.random.default_rng(0), policy)


def random_actions(dice: np.random.Generator, drones: int = N) -> np.ndarray:
    return dice.uniform(-1, 1, (drones, 1)).astype(np.float32)


# ---- episodes


def test_no_two_episodes_have_the_same_seed() -> None:
    """Of trainings, and of evaluations of any set and training."""
    training = {episode_seed(run, episode) for run in range(20) for episode in range(300)}
    sets: tuple[Any, ...] = ("final", "curve", "tuning")
    runs = (None, 0, 1, 2)
    numbers = range(100)
    evaluation = {evaluation_seed(k, of, run) for of in sets for run in runs for k in numbers}
    assert len(training) == 20 * 300
    assert len(evaluation) == 3 * 4 * 100
    assert training.isdisjoint(evaluation)


def test_every_episode_has_the_seed_of_its_number() -> None:
    """All drones do the same, so that any of them may have flown an episode."""
    log = EpisodeRecorder(vector(), seed=3)
    env = RecordedEnv(log, Config())
    env.reset()
    for _ in range(100):
        env.step(np.full((N, 1), 0.3))
    assert log.env_steps == 100 * N
    numbers = [episode.episode for episode in log.episodes]
    assert sorted(numbers)[: 2 * N] == list(range(2 * N))
    again = gym.make(ENV, disable_env_checker=True, **OPTIONS)
    for episode in log.episodes:
        again.reset(seed=episode_seed(3, episode.episode))
        rewards = []
        sizes = []
        terminated = truncated = False
        while not (terminated or truncated):
            _, reward, terminated, truncated, info = again.step(np.full(1, 0.3, np.float32))
            rewards.append(reward)
            sizes.append(abs(info["elevation_error"]))
        assert episode.length == len(rewards)
        assert (episode.terminated, episode.truncated) == (terminated, truncated)
        assert episode.total_reward == pytest.approx(sum(rewards), rel=1e-9)
        assert episode.mean_size == pytest.approx(np.mean(sizes), rel=1e-9)


def test_kept_steps_are_those_of_the_episodes() -> None:
    log = EpisodeRecorder(vector(1), seed=5, keep_steps=True)
    dice = np.random.default_rng(1)
    log.start()
    for _ in range(70):
        if log.done[0]:
            log.begin(log.done)
        log.fly(random_actions(dice, 1))
    steps = log.steps()
    assert steps["value"].shape == (70,)
    first = log.episodes[0]
    assert first.episode == 0
    assert first.first_step == 0
    own = steps["episode"] == 0
    assert own.sum() == first.length
    assert first.mean_size == pytest.approx(np.abs(steps["value"][own]).mean(), rel=1e-5)


def test_a_step_for_sb3_is_gymnasiums_same_step() -> None:
    log = EpisodeRecorder(vector(), seed=0)
    env = RecordedEnv(log, Config())
    env.reset()
    dice = np.random.default_rng(0)
    ended = 0
    for _ in range(60):
        observations, rewards, terminated, truncated, info = env.step(random_actions(dice))
        if (terminated | truncated).any():
            ends = info["_final_obs"]
            ended += int(ends.sum())
            assert (ends == terminated | truncated).all()
            error = abs(info["final_obs"][ends & ~terminated, 0])
            expected = (0.5 - error) / (0.5 + error)
            np.testing.assert_allclose(rewards[ends & ~terminated], expected, rtol=1e-5)
            # The next has begun: at rest, hovering.
            assert not observations[ends, 1:].any()
    assert ended == len(log.episodes)
    assert ended > N


@pytest.mark.parametrize("steps", [0, 1, 37])
@pytest.mark.parametrize("drones", [1, 4])
def test_resuming_brings_every_drone_to_where_it_was(drones: int, steps: int) -> None:
    logs = [EpisodeRecorder(vector(drones), 1) for _ in range(2)]
    first, second = (RecordedEnv(log, Config()) for log in logs)
    dice = np.random.default_rng(7)
    first.reset()
    for _ in range(steps):
        first.step(random_actions(dice, drones))
    logs[1].resume(logs[0].position())
    for _ in range(45):
        actions = random_actions(dice, drones)
        for ours, theirs in zip(first.step(actions)[:4], second.step(actions)[:4], strict=True):
            assert ours.tobytes() == theirs.tobytes()
    kept = [[replace(e, seconds=0.0) for e in log.episodes] for log in logs]
    assert kept[0] == kept[1]


@pytest.mark.parametrize("changes", [{"effects": {"linear_drag": 0.1}}, {"episode_length": 5}])
def test_resuming_elsewhere_is_refused(changes: dict[str, Any]) -> None:
    log = EpisodeRecorder(vector(2), 1)
    log.start()
    for _ in range(10):
        log.fly(np.full((2, 1), 0.1, np.float32))
    with pytest.raises(ResumeError, match="does not repeat the episodes"):
        EpisodeRecorder(vector(2, **changes), 1).resume(log.position())


class Losing(LocalVectorEnv):
    """Loses the simulator of its second half while the first half is reset, once."""

    armed = False

    def advance(
        self, actions: Any, resets: Any = None, seeds: Any = None, frozen: Any = None, *rest: Any
    ) -> None:
        super().advance(actions, resets, seeds, frozen, *rest)
        self.lost = np.zeros(self.num_envs, bool)
        if self.armed and frozen is not None and resets.any() and frozen[-1]:
            self.armed = False
            self.struck = frozen[-2:].copy()
            self.lost[-2:] = self.struck
            self.truncated = self.lost.copy()


def test_a_simulator_lost_while_others_begin() -> None:
    env = Losing(ENV, 4, autoreset_mode="Disabled", **OPTIONS)
    # With this seed the first drone's episode ends alone, while both drones of the second half fly.
    log = EpisodeRecorder(env, 3)
    same_step = RecordedEnv(log, Config())
    same_step.reset()
    dice = np.random.default_rng(0)
    seen = False
    for step in range(80):
        env.armed = step > 5 and not seen
        observations, _, terminated, truncated, info = same_step.step(random_actions(dice, 4))
        if step > 5 and not seen and not env.armed:
            seen = True
            # The frozen drones are truncated too, and begin anew.
            assert env.struck.all()
            assert truncated[-2:][env.struck].all()
            assert (info["_final_obs"] == terminated | truncated).all()
            assert not observations[terminated | truncated, 1:].any()
    assert seen
    assert any(episode.simulator_lost for episode in log.episodes)


# ---- rollouts


@pytest.mark.parametrize("drones", [1, N])
def test_a_rollout_keeps_final_observations_and_goes_on(drones: int) -> None:
    log, collector = collector_of(drones)
    rollouts = [collector.steps(20 * drones - drones // 2) for _ in range(3)]
    assert sum(map(len, rollouts)) == log.env_steps
    observations, after, ends, kept = (
        np.concatenate([getattr(rollout, name) for rollout in rollouts])
        for name in ("observations", "next_observations", "ends", "kept")
    )
    assert kept.shape == (60, drones)
    # A step is spent for an episode that began within the rollouts, if others were flying.
    assert (~kept).sum() <= len(log.episodes)
    assert (drones > 1) == (not kept.all())
    same = (observations[1:] == after[:-1]).all(axis=2)
    going_on = ~ends[:-1]
    assert same[going_on].all()
    starts = kept[1:] & ends[:-1]
    assert not observations[1:][starts][:, 1:].any(), "at rest, hovering"


@pytest.mark.parametrize("drones", [1, N])
def test_whole_episodes_of_every_drone(drones: int) -> None:
    log, collector = collector_of(drones)
    for number in range(1, 4):
        rollout = collector.episodes(drones + 1, 10**6)
        assert ((rollout.terminated | rollout.truncated) & rollout.kept).sum() == 2 * drones
        assert len(log.episodes) == 2 * drones * number
        assert len(rollout) == sum(e.length for e in log.episodes[-2 * drones :])
    assert log.env_steps == sum(e.length for e in log.episodes)


def test_episodes_are_broken_off_where_the_training_ends() -> None:
    """A part of an episode is not learnt from, but it was flown; a single drone keeps its last."""
    for drones, learnt, flown in ((N, 0, 25), (1, 23, 23)):
        log, collector = collector_of(drones, flight_band=3.0)
        rollout = collector.episodes(1, 23)
        assert len(rollout) == learnt
        assert log.env_steps == flown


# ---- Stable-Baselines3


def test_sb3_sees_final_observations_and_truncations() -> None:
    env = SB3VecEnv(vector(mode="SameStep"))
    env.seed(3)
    first = env.reset()
    other = vector(mode="SameStep")
    assert first.tobytes() == other.reset(seed=3)[0].tobytes()
    dice = np.random.default_rng(0)
    kinds = set()
    for _ in range(80):
        actions = random_actions(dice)
        observations, rewards, dones, infos = env.step(actions)
        theirs = other.step(actions)
        assert observations.tobytes() == theirs[0].tobytes()
        assert rewards.dtype == np.float32
        assert dones.tolist() == (theirs[2] | theirs[3]).tolist()
        for i, info in enumerate(infos):
            if not dones[i]:
                assert info == {}
                continue
            assert info["terminal_observation"].tobytes() == theirs[4]["final_obs"][i].tobytes()
            assert info["TimeLimit.truncated"] == theirs[3][i]
            kinds.add(info["TimeLimit.truncated"])
    assert kinds == {True, False}


def test_sb3_wants_same_step() -> None:
    with pytest.raises(InputError, match="expected a vector env with autoreset SAME_STEP"):
        SB3VecEnv(vector(2))


# ---- over UDP


def test_over_udp_the_training_is_the_same_and_goes_on() -> None:
    config = preset("a2c", "tuned", steps_per_update=64)
    flown = EnvConfig.from_keywords(ENV, **OPTIONS)

    def trained(env: Any) -> tuple[EpisodeRecorder, dict[str, np.ndarray]]:
        log = EpisodeRecorder(env, 1)
        agent = make_agent("a2c", log, config, 1)
        agent.train(log, 512, lambda: True)
        return log, agent.policy().weights.arrays

    here, expected = trained(vector(4))
    with open_env(True, flown, 4) as env:
        _, actor = trained(env)
        for name, weight in expected.items():
            assert weight.tobytes() == actor[name].tobytes()
        again = EpisodeRecorder(env, 1)
        again.resume(here.position())
        assert again.observations.tobytes() == here.observations.tobytes()
