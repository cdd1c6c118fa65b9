"""Training with many drones: seeds of episodes, rollouts drone by drone, resuming, SB3's side."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from peers import ANY, Running
from rotorgram.agents import preset
from rotorgram.agents.checkpoints import load
from rotorgram.agents.episodes import ResumeError, episode_seed
from rotorgram.agents.policies import NetworkPolicy
from rotorgram.agents.returns import advantages
from rotorgram.agents.rollouts import VectorCollector
from rotorgram.agents.sb3_vec import SB3VecEnv
from rotorgram.agents.vector_episodes import VectorEpisodeLog
from rotorgram.cli import main
from rotorgram.envs import ENV_ID, ElevationConfig, ElevationVectorEnv
from rotorgram.experiments.training import Run, Training, is_finished
from rotorgram.udp import RemoteVectorEnv, Simulator
from stable_baselines3 import PPO

N = 5
OPTIONS: dict[str, Any] = {"episode_length": 30, "start_band": 0.3, "flight_band": 0.4}


@contextmanager
def remote(simulators: int, drones: int, mode: str = "Disabled") -> Iterator[RemoteVectorEnv]:
    with closing(
        RemoteVectorEnv(
            ANY,
            num_simulators=simulators,
            num_envs=simulators * drones,
            connect=False,
            autoreset_mode=mode,
        )
    ) as env:
        running = [
            Running(Simulator(server=env.address, bind=ANY, num_envs=drones, **OPTIONS))
            for _ in range(simulators)
        ]
        env.connect()
        yield env
    for one in running:
        one.join()


def policy(seed: int = 0) -> NetworkPolicy:
    dice = np.random.default_rng(seed)
    shapes = {"hidden.weight": (16, 3), "hidden.bias": (16,), "output.weight": (1, 16)}
    weights = {k: 0.3 * dice.normal(size=s).astype(np.float32) for k, s in shapes.items()}
    return NetworkPolicy(
        {**weights, "output.bias": np.zeros(1, np.float32), "log_std": np.zeros(1, np.float32)}
    )


def random_actions(dice: np.random.Generator, drones: int = N) -> np.ndarray:
    return dice.uniform(-1, 1, (drones, 1)).astype(np.float32)


# ---- episodes


def test_every_episode_has_the_seed_of_its_number() -> None:
    log = VectorEpisodeLog(ElevationVectorEnv(N, **OPTIONS), seed=3)
    log.reset()
    dice, flown = np.random.default_rng(0), []
    for _ in range(100):
        flown.append(random_actions(dice))
        log.step(flown[-1])
    assert log.env_steps == 100 * N
    assert len(log.episodes) >= 3 * N
    numbers = [episode.episode for episode in log.episodes]
    assert sorted(numbers)[: 2 * N] == list(range(2 * N))
    with closing(gym.make(ENV_ID, **OPTIONS)) as single:
        for episode in log.episodes:
            # Which drone flew it? The one whose actions repeat it, from the step where it began.
            first = episode.first_step // N
            returns = []
            for drone in range(N):
                single.reset(seed=episode_seed(3, episode.episode))
                rewards: list[float] = []
                for actions in flown[first : first + episode.length]:
                    _, reward, terminated, truncated, _ = single.step(actions[drone])
                    rewards.append(float(reward))
                    if terminated or truncated:
                        break
                if len(rewards) == episode.length and terminated == episode.terminated:
                    returns.append(sum(rewards))
            assert episode.total_reward in returns
            assert episode.truncated != episode.terminated


def test_a_step_is_gymnasiums_same_step() -> None:
    log = VectorEpisodeLog(ElevationVectorEnv(N, **OPTIONS), seed=0)
    log.reset()
    dice, ended = np.random.default_rng(0), 0
    for _ in range(60):
        observations, rewards, terminated, truncated, info = log.step(random_actions(dice))
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


@pytest.mark.parametrize("where", ["here", "over UDP"])
def test_resuming_brings_every_drone_to_where_it_was(where: str) -> None:
    @contextmanager
    def env() -> Iterator[Any]:
        if where == "here":
            yield ElevationVectorEnv(4, **OPTIONS)
        else:
            with remote(2, 2) as other:
                yield other

    for steps in (0, 1, 37):
        with env() as one, env() as other:
            first, second = VectorEpisodeLog(one, 1), VectorEpisodeLog(other, 1)
            dice = np.random.default_rng(7)
            first.reset()
            for _ in range(steps):
                first.step(random_actions(dice, 4))
            second.resume(first.position(), first.episodes)
            for _ in range(45):
                actions = random_actions(dice, 4)
                results = first.step(actions), second.step(actions)
                for ours, theirs in zip(results[0][:4], results[1][:4], strict=True):
                    assert ours.tobytes() == theirs.tobytes()
            kept = [[replace(e, seconds=0.0) for e in log.episodes] for log in (first, second)]
            assert kept[0] == kept[1]


def test_resuming_elsewhere_is_refused() -> None:
    first = VectorEpisodeLog(ElevationVectorEnv(2, **OPTIONS), 1)
    first.reset()
    for _ in range(10):
        first.step(np.full((2, 1), 0.1))
    for changes in ({"linear_drag": 0.1}, {"episode_length": 5}):
        env = ElevationVectorEnv(2, **{**OPTIONS, **changes})
        with pytest.raises(ResumeError, match="does not repeat the episodes"):
            VectorEpisodeLog(env, 1).resume(first.position(), [])
    with pytest.raises(ResumeError, match="expected a training with 3 drones"):
        VectorEpisodeLog(ElevationVectorEnv(3), 1).resume(first.position(), [])


# ---- rollouts


def test_a_rollout_is_drone_by_drone() -> None:
    log = VectorEpisodeLog(ElevationVectorEnv(N, **OPTIONS), 0)
    collector = VectorCollector(log, np.random.default_rng(0))
    known = flown = 0
    for _ in range(3):
        rollout = collector.steps(policy(), 20 * N - 3)  # rounded up
        ended = log.episodes[known:]
        known = len(log.episodes)
        # One step of 20 for each episode that began within them.
        assert 20 * N - len(ended) <= len(rollout) <= 20 * N
        assert log.env_steps - flown == len(rollout)
        flown = log.env_steps
        following, after = rollout.observations[1:], rollout.next_observations[:-1]
        going_on = ~rollout.ends[:-1]
        assert (following[going_on] == after[going_on]).all()
        # What comes after an end is the start of an episode, or the next drone's.
        assert (following[~going_on] != after[~going_on]).any(axis=1).all()
        assert not (rollout.terminated & rollout.truncated).any()


def test_advantages_of_a_rollout_are_those_of_each_drone() -> None:
    log = VectorEpisodeLog(ElevationVectorEnv(N, **OPTIONS), 0)
    rollout = VectorCollector(log, np.random.default_rng(0)).steps(policy(), 25 * N)
    dice = np.random.default_rng(1)
    values, following = dice.normal(size=(2, len(rollout)))
    arguments = (rollout.rewards, values, following, rollout.terminated, rollout.truncated)
    together = advantages(*arguments, gamma=0.98, trace=0.9)
    starts = np.flatnonzero(np.append(True, rollout.ends))
    assert starts[-1] == len(rollout)  # nothing is carried from one stretch to the next
    for first, last in pairwise(starts):
        alone = advantages(*(a[first:last] for a in arguments), gamma=0.98, trace=0.9)
        assert together[first:last].tobytes() == alone.tobytes()


def test_whole_episodes_of_every_drone() -> None:
    log = VectorEpisodeLog(ElevationVectorEnv(N, **OPTIONS), 0)
    collector = VectorCollector(log, np.random.default_rng(0))
    for number in range(1, 4):
        rollout = collector.episodes(policy(), N + 1, 10**6)
        assert int(rollout.ends.sum()) == 2 * N
        assert rollout.ends[-1]
        assert len(log.episodes) == 2 * N * number
        lengths = [e.length for e in log.episodes[-2 * N :]]
        starts = np.flatnonzero(np.append(True, rollout.ends[:-1]))
        assert sorted(np.diff(np.append(starts, len(rollout)))) == sorted(lengths)
        assert not rollout.observations[starts, 1:].any()  # at rest, hovering
    assert log.env_steps == sum(e.length for e in log.episodes)


def test_episodes_are_broken_off_where_the_training_ends() -> None:
    """A part of an episode is not learnt from, but it was flown; a single drone keeps its last."""
    log = VectorEpisodeLog(ElevationVectorEnv(N), 0)
    rollout = VectorCollector(log, np.random.default_rng(0)).episodes(policy(), 1, 23)
    assert (len(rollout), log.env_steps) == (0, 25)
    assert rollout.observations.shape == (0, 3)
    log = VectorEpisodeLog(ElevationVectorEnv(1), 0)
    rollout = VectorCollector(log, np.random.default_rng(0)).episodes(policy(), 1, 23)
    assert len(rollout) == log.env_steps == 23


def test_policies_of_many_are_those_of_each() -> None:
    dice = np.random.default_rng(0)
    one = policy()
    observations = dice.normal(size=(50, 3)).astype(np.float32)
    noise = one.draw_noise(dice, 50)
    each = np.array([one.sample(o, n) for o, n in zip(observations, noise, strict=True)])
    np.testing.assert_allclose(one.samples(observations, noise), each, rtol=1e-5, atol=1e-6)
    weights = {"hidden.weight": np.ones((4, 1)), "hidden.bias": np.zeros(4),
               "output.weight": np.eye(3, 4), "output.bias": np.zeros(3)}  # fmt: skip
    discrete = NetworkPolicy({k: v.astype(np.float32) for k, v in weights.items()})
    observations, noise = observations[:, :1], discrete.draw_noise(dice, 50)
    each = np.array([discrete.sample(o, n) for o, n in zip(observations, noise, strict=True)])
    assert discrete.samples(observations, noise).tobytes() == each.tobytes()


# ---- training


SMALL = {
    "vpg": {"episodes_per_update": 3},
    "a2c": {"steps_per_update": 64},
    "sb3-a2c": {"steps_per_update": 64},
}


def run_of(algorithm: str, **options: Any) -> Run:
    return Run(
        algorithm=algorithm,
        config=preset(algorithm, "tuned", **SMALL[algorithm]),
        env=ElevationConfig(**OPTIONS, **options),
        seed=5,
        env_steps=1024,
        num_envs=4,
    )


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
@pytest.mark.parametrize("algorithm", SMALL)
def test_a_training_that_was_stopped_ends_as_if_it_had_not(
    algorithm: str, kind: str, tmp_path: Path
) -> None:
    run = run_of(algorithm, action_type=kind)
    options = {**OPTIONS, "action_type": kind}
    unbroken = Training(run, ElevationVectorEnv(4, **options))
    assert unbroken.train()
    stopped = Training(run, ElevationVectorEnv(4, **options))
    updates = iter(range(3))
    assert not stopped.train(lambda: next(updates, None) != 2)
    stopped.store(tmp_path / "c")
    kept = load(tmp_path / "c")
    assert kept.num_envs == 4
    assert not is_finished(kept)
    torch.manual_seed(99)
    resumed = Training.resume(kept, ElevationVectorEnv(4, **options), stopped.log.episodes)
    assert resumed.train()
    assert is_finished(resumed.checkpoint())
    assert resumed.log.env_steps == unbroken.log.env_steps
    for ours, theirs in ((resumed.agent.state(), unbroken.agent.state()),
                         (resumed.agent.actor(), unbroken.agent.actor())):  # fmt: skip
        assert set(ours) == set(theirs)
        for name in ours:
            assert ours[name].tobytes() == theirs[name].tobytes(), name
    kept_episodes = [[replace(e, seconds=0.0) for e in t.log.episodes] for t in (resumed, unbroken)]
    assert kept_episodes[0] == kept_episodes[1]


def test_progress_tells_of_every_drone() -> None:
    """Of 120 drones that begin together the last 20 to end are those that flew longest."""
    run = replace(run_of("vpg"), num_envs=120, env_steps=7200)
    training = Training(run, ElevationVectorEnv(120, **OPTIONS))
    training.train()
    assert len(training.log.episodes) >= 240
    last = training.log.episodes[-120:]
    lengths = [episode.length for episode in last]
    assert np.mean(lengths[-20:]) > np.mean(lengths)
    mean = np.mean([episode.total_reward for episode in last])
    assert training.progress().mean_return == pytest.approx(mean)
    assert training.scalars()["rollout/ep_rew_mean"] == pytest.approx(mean)
    assert training.scalars()["rollout/ep_len_mean"] == pytest.approx(np.mean(lengths))


@pytest.mark.parametrize(
    ("algorithm", "settings", "note"),
    [
        ("a2c", ("--num-envs", 16), ""),
        (
            "sb3-a2c",
            ("--num-envs", 18),
            "note: an update has 15 steps of each of 18 drones, and sb3-a2c learns little from "
            "fewer than 16: try --set steps_per_update=576, a higher learning_rate, and "
            "--env-steps 57600 or more\n",
        ),
        # Rounds of 4 episodes of 5 steps: 30 updates, and one less.
        ("vpg", ("--num-envs", 4, "--env-steps", 600), ""),
        (
            "vpg",
            ("--num-envs", 4, "--env-steps", 599),
            "note: 599 env steps of 4 drones may be as few as 29 updates, and vpg learns little "
            "from fewer than 30: try --env-steps 600 or more, or fewer drones\n",
        ),
    ],
)
def test_train_says_where_the_drones_are_too_many(
    algorithm: str,
    settings: tuple[object, ...],
    note: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = ["train", algorithm, "--env-steps", 600, "--env.episode-length", 5]
    folder = tmp_path / "run"
    assert main([str(a) for a in (*arguments, *settings, "--out", folder)]) == 0
    out = capsys.readouterr().out
    assert out.startswith(note)
    assert out.count("note: ") == bool(note)


@pytest.mark.parametrize("algorithm", ["vpg", "a2c"])
def test_over_udp_the_training_is_the_same(algorithm: str) -> None:
    run = run_of(algorithm)
    here = Training(run, ElevationVectorEnv(4, **OPTIONS))
    here.train()
    with remote(2, 2) as env:
        there = Training(run, env)
        there.train()
    for name, weight in here.agent.actor().items():
        assert weight.tobytes() == there.agent.actor()[name].tobytes()


def test_a_lost_simulator_is_marked() -> None:
    arguments: dict[str, Any] = {"bind": ANY, "num_envs": 2, **OPTIONS}
    with closing(
        RemoteVectorEnv(ANY, num_envs=2, connect=False, timeout=0.5, autoreset_mode="Disabled")
    ) as env:
        first = Running(Simulator(server=env.address, **arguments))
        env.connect()
        log = VectorEpisodeLog(env, 0)
        log.reset()
        for _ in range(3):
            log.step(np.zeros((2, 1)))
        first.cut()
        other = Running(Simulator(server=env.address, **arguments))
        assert log.step(np.zeros((2, 1)))[3].all()
        assert [(e.length, e.truncated, e.simulator_lost) for e in log.episodes] == [
            (4, True, True)
        ] * 2
        for _ in range(30):
            log.step(np.zeros((2, 1)))
        assert [e.episode for e in log.episodes] == [0, 1, 2, 3]
        assert not log.episodes[-1].simulator_lost
        # The seeds of the next episodes were theirs, though the simulator was another.
        single = VectorEpisodeLog(ElevationVectorEnv(2, **OPTIONS), 0)
        single.resume(log.position(), log.episodes)
    other.join()


class Losing(ElevationVectorEnv):
    """Loses the simulator of its second half while the first half is reset, once."""

    armed = False

    def advance(self, actions: Any, resets: Any, seeds: Any = None, holds: Any = None) -> None:
        super().advance(actions, resets, seeds, holds)
        self.lost = np.zeros(self.num_envs, bool)
        if self.armed and holds is not None and resets.any() and holds[-1]:
            self.armed = False
            self.lost[-2:] = self.struck = holds[-2:]
            self.truncated, self.over = self.lost.copy(), self.over | self.lost


@pytest.mark.parametrize("wrapped", [True, False])
def test_a_simulator_lost_while_others_begin(wrapped: bool) -> None:
    env: Any = Losing(4, autoreset_mode="SameStep", **OPTIONS)
    flown: Any = VectorEpisodeLog(env, 0) if wrapped else env
    flown.reset(seed=0)
    dice, seen = np.random.default_rng(0), False
    for step in range(80):
        env.armed = step > 5 and not seen
        observations, rewards, terminated, truncated, info = flown.step(random_actions(dice, 4))
        assert len(rewards) == 4
        if step > 5 and not seen and not env.armed:
            seen = True
            # Whoever held is truncated too, with its last observation, and at a new start.
            assert truncated[-2:][env.struck].all()
            ended = terminated | truncated
            assert (info["_final_obs"] == ended).all()
            assert not observations[ended, 1:].any()
            assert not env.over.any()
    assert seen
    if wrapped:
        assert any(episode.simulator_lost for episode in flown.episodes)


def test_the_env_has_as_many_drones_as_the_run() -> None:
    with pytest.raises(ValueError, match="env: expected one of 4 drones, got 3"):
        Training(run_of("a2c"), ElevationVectorEnv(3))
    with pytest.raises(ValueError, match="num_envs: expected 1 or more, got 0"):
        replace(run_of("a2c"), num_envs=0)
    with pytest.raises(ValueError, match="env_steps: expected at least 120, got 119"):
        replace(run_of("vpg"), env_steps=119)  # an episode of each


# ---- Stable-Baselines3


def test_sb3_sees_final_observations_and_truncations() -> None:
    env = SB3VecEnv(ElevationVectorEnv(N, autoreset_mode="SameStep", **OPTIONS))
    env.seed(3)
    first = env.reset()
    other = ElevationVectorEnv(N, autoreset_mode="SameStep", **OPTIONS)
    assert first.tobytes() == other.reset(seed=3)[0].tobytes()
    dice, kinds = np.random.default_rng(0), set()
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
    with pytest.raises(ValueError, match="expected a vector env with autoreset SAME_STEP"):
        SB3VecEnv(ElevationVectorEnv(2))


def test_sb3_flies_over_the_batched_wire() -> None:
    with remote(1, 4, mode="SameStep") as env:
        model = PPO("MlpPolicy", SB3VecEnv(env), n_steps=16, batch_size=32, device="cpu")
        model.learn(128)
        assert model.num_timesteps == 128
