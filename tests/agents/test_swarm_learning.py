"""Learning with several drones in a world: who counts, what the critic sees, and resuming."""

from typing import Any

import numpy as np
import pytest
from drones import cases
from nets import arrays_of
from rotorgram.agents import Config, EpisodeRecorder, ResumeError, make_agent, preset
from rotorgram.agents.rollouts import Collector, Rollout
from rotorgram.agents.sb3 import RecordedEnv
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.training.settings import Run
from rotorgram.training.training import Training
from swarms import RISE

SMALL = {"steps_per_update": 48, "epochs": 2, "minibatches": 2}


def log_of(worlds: int = 1, drones: int = 2, seed: int = 0, **options: Any) -> EpisodeRecorder:
    env = LocalVectorEnv(RISE, worlds * drones, drones=drones, autoreset_mode="Disabled", **options)
    return EpisodeRecorder(env, seed, keep_steps=True)


def env_of(drones: int = 3, episode_length: int = 90) -> LocalVectorEnv:
    options = {"drones": drones, "episode_length": episode_length}
    return LocalVectorEnv(RISE, 6, autoreset_mode="Disabled", **options)


def run_of(algorithm: str) -> Run:
    small = {"episodes_per_update": 3} if algorithm == "vpg" else SMALL
    config = preset(algorithm, "tuned", **small)
    env = EnvConfig(env_id=RISE, episode_length=90)
    return Run(algorithm=algorithm, config=config, seed=1, env_steps=1200, num_envs=6, env=env)


class Climbers:
    """A policy of which every second drone, from the first on, climbs; the others hover."""

    memory = None

    def __init__(self) -> None:
        self.head = self

    def noise(self, rng: np.random.Generator, steps: int) -> np.ndarray:
        return np.zeros((steps, 1), np.float32)

    def outputs(self, observations: np.ndarray) -> np.ndarray:
        actions = np.zeros((len(observations), 1), np.float32)
        actions[::2] = 1.0
        return actions

    def sample(self, outputs: np.ndarray, noise: np.ndarray) -> np.ndarray:
        return outputs


def flown(log: EpisodeRecorder, count: int) -> Rollout:
    policy: Any = Climbers()
    return Collector(log, np.random.default_rng(0), policy).steps(count)


def test_one_that_is_out_flies_no_env_step() -> None:
    log = log_of()
    rollout = flown(log, 60)  # thirty steps of two drones: an episode of the second
    climb, hover = log.episodes
    assert climb.terminated
    assert climb.episode == 0
    assert climb.length < 30
    assert hover.truncated
    assert hover.episode == 1
    assert hover.length == 30
    assert rollout.kept.sum(axis=0).tolist() == [climb.length, 30]
    assert log.env_steps == climb.length + 30
    assert len(rollout) == log.env_steps
    assert (rollout.rewards[~rollout.kept] == 0).all()
    assert np.bincount(log.steps()["episode"]).tolist() == [climb.length, 30]
    # All were out: the world has begun anew, both drones with it.
    running = log.position().flown
    assert running
    assert running.numbers.tolist() == [2, 3]
    assert running.lengths.tolist() == [0, 0]


def test_a_world_begins_as_a_whole_and_spends_a_row_while_another_flies_on() -> None:
    log = log_of(worlds=2, episode_length=10)
    log.start()
    first = np.array([True, True, False, False])
    log.fly(np.zeros((4, 1), np.float32), None, first)  # the first world is a step behind
    rollout = flown(log, 48)
    rows, drones = np.nonzero(rollout.truncated)
    assert rows.tolist() == [8, 8, 9, 9]
    assert drones.tolist() == [2, 3, 0, 1]
    assert not rollout.kept[9, 2:].any()  # the row after it begins the second world
    assert not rollout.kept[10, :2].any()
    assert rollout.kept.sum(axis=0).tolist() == [11] * 4


def test_returns_of_a_drone_that_is_out_stop_at_its_end() -> None:
    log = log_of()
    agent: Any = make_agent("ippo", log, preset("ippo", "tuned", gamma=1.0, gae_lambda=1.0), 0)
    agent.weights.values[:] = 0.0
    arrays_of(agent)[0]["critic.layers.1.weight"][:, 0] = 5.0  # V(s) = 5
    rollout = flown(log, 60)
    estimates = agent.advantages(rollout)[0]
    length = log.episodes[0].length
    # Rewards of 1: those that are left, after a termination nothing, after the time limit 5.
    assert estimates[:length, 0] == pytest.approx(np.arange(length, 0, -1) - 5.0)
    assert estimates[:, 1] == pytest.approx(np.arange(30, 0, -1))


def test_what_the_central_critic_sees_by_hand() -> None:
    log = log_of(worlds=2, drones=3)
    agent: Any = make_agent("mappo", log, preset("mappo", "tuned"), 0)
    observations = np.arange(18, dtype=np.float32).reshape(1, 6, 3)
    flying = np.array([[True, True, False, True, True, True]])
    seen = agent.seen(observations, flying)
    assert seen.shape == (1, 6, 9)
    # Its own, the next one's, the one's after that; the third is out.
    assert seen[0].tolist() == cases("central_critic")


def test_of_a_single_drone_the_central_critic_is_ppos() -> None:
    weights = []
    for algorithm in ("ppo", "mappo"):
        log = log_of(worlds=3, drones=1)
        agent: Any = make_agent(algorithm, log, preset(algorithm, "tuned", **SMALL), 4)
        agent.train(log, 200, lambda: True)
        weights.append(agent.weights.values.tobytes())
    assert weights[0] == weights[1]


@pytest.mark.parametrize("algorithm", ["ippo", "mappo", "vpg"])
def test_a_training_that_stops_anywhere_ends_with_the_same_bits(algorithm: str) -> None:
    run = run_of(algorithm)

    whole = Training(run, env_of())
    assert whole.train()
    assert any(e.terminated for e in whole.log.episodes)
    kept = None
    stopped = 0
    outs = 0
    while True:
        training = Training.resume(kept, env_of()) if kept else Training(run, env_of())
        updates = iter([True, False])
        ended = training.train(lambda updates=updates: next(updates, False))
        kept = training.checkpoint()
        stopped = stopped + 1
        outs += int(training.log.out.any())
        if ended:
            break
    assert stopped > (1 if algorithm == "vpg" else 4)
    assert outs or algorithm == "vpg"  # VPG updates between worlds alone
    ours = training.agent.state()
    theirs = whole.agent.state()
    assert all(ours[name].tobytes() == theirs[name].tobytes() for name in theirs)
    lengths = [[e.length for e in one.log.episodes] for one in (training, whole)]
    assert lengths[0] == lengths[1]


@pytest.mark.parametrize("case", cases("other_worlds"), ids=str)
def test_a_training_of_other_worlds_is_not_resumed(case: Any) -> None:
    training = Training(run_of("mappo"), env_of())
    assert not training.train(lambda: False)
    kept = training.checkpoint()
    other = env_of(**case["changes"])
    with pytest.raises(ResumeError) as told:
        Training.resume(kept, other)
    assert str(told.value) == case["sentence"]


def test_sb3_sees_zeros_of_one_that_is_out_until_its_world_ends() -> None:
    log = log_of()
    env = RecordedEnv(log, Config())
    env.reset()
    ends = []
    for _ in range(30):
        seen, rewards, terminated, truncated, info = env.step(np.array([[1.0], [0.0]]))
        ends.append((terminated | truncated).tolist())
    first = log.episodes[0].length
    assert [row[0] for row in ends] == [step + 1 in (first, 30) for step in range(30)]
    assert [row[1] for row in ends] == [step == 29 for step in range(30)]
    assert terminated[0]
    assert truncated[1]
    assert info["_final_obs"].tolist() == [True, True]
    assert seen[:, 2] == pytest.approx(10.0)  # both have begun again

    env.reset()
    for _ in range(first + 1):
        seen, rewards, *_ = env.step(np.array([[1.0], [0.0]]))
    assert seen[0].tolist() == [0.0, 0.0, 0.0]
    assert rewards[0] == 0.0
    assert seen[1, 2] == pytest.approx(10.0)
