"""The algorithms against the paper's equations, on problems with known answers; and resuming."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from rotorgram.agents import A2CConfig, VPGConfig, make_agent, preset
from rotorgram.agents.a2c import A2C
from rotorgram.agents.checkpoints import CheckpointError, load
from rotorgram.agents.episodes import EpisodeLog, ResumeError, episode_seed
from rotorgram.agents.policies import NetworkPolicy
from rotorgram.agents.rollouts import Collector, Rollout
from rotorgram.agents.vpg import VPG
from rotorgram.envs import ElevationConfig
from rotorgram.envs.elevation import ElevationEnv
from rotorgram.experiments.evaluate import evaluation_seed, fly_episodes
from rotorgram.experiments.training import Run, Training

BOX = spaces.Box(-1, 1, (1,), np.float32)


class Constant(gym.Env[np.ndarray, Any]):
    """Reward 1 at every step, whatever is done; episodes are cut after 8 steps."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = BOX

    def __init__(self, ending: str) -> None:
        self._ending = ending
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self._steps += 1
        over = self._steps == 8
        terminated, truncated = over and self._ending == "end", over and self._ending == "limit"
        return np.zeros(1, np.float32), 1.0, terminated, truncated, {}


def rollout(**changes: Any) -> Rollout:
    fields = {
        "observations": np.array([[0.5], [-1.0], [2.0]], np.float32),
        "actions": np.array([[1.5], [-0.5], [0.0]], np.float32),
        "rewards": np.array([1.0, 2.0, 4.0]),
        "next_observations": np.array([[-1.0], [2.0], [0.0]], np.float32),
        "terminated": np.array([False, False, True]),
        "truncated": np.array([False, False, False]),
    }
    return Rollout(**{**fields, **changes})


def gradient_of(agent: VPG | A2C, data: Rollout) -> dict[str, np.ndarray]:
    agent._optimizer.zero_grad()
    agent.loss(data).backward()
    return {n: p.grad.numpy() for n, p in agent.networks["actor"].named_parameters()}


def score_gradients(agent: VPG | A2C, data: Rollout) -> list[dict[str, np.ndarray]]:
    """grad log P(a_t | s_t) for every t, by torch.distributions on an independent path."""
    network = agent.networks["actor"]
    result = []
    for observation, action in zip(data.observations, data.actions, strict=True):
        network.zero_grad()
        mean = network(torch.from_numpy(observation[np.newaxis]))
        normal = torch.distributions.Normal(mean, network.log_std.exp())
        normal.log_prob(torch.from_numpy(action)).sum().backward()
        result.append({n: p.grad.numpy().copy() for n, p in network.named_parameters()})
    return result


def test_vpg_follows_equation_2() -> None:
    agent = VPG(Constant("end"), VPGConfig(gamma=0.5), seed=0)
    data = rollout()
    returns = [1 + 1 + 1, 2 + 2, 4]
    scores = score_gradients(agent, data)
    for name, gradient in gradient_of(agent, data).items():
        expected = -sum(r * s[name] for r, s in zip(returns, scores, strict=True)) / 3
        np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-6)


def test_a2c_actor_follows_the_advantage_of_equation_3() -> None:
    agent = A2C(Constant("end"), A2CConfig(gamma=0.5, steps_per_update=3), seed=0)
    data = rollout()
    with torch.no_grad():
        value = agent.networks["critic"](torch.from_numpy(data.observations)).numpy()
    advantage = [
        1 + 0.5 * value[1] - value[0],
        2 + 0.5 * value[2] - value[1],
        4 - value[2],
    ]
    scores = score_gradients(agent, data)
    for name, gradient in gradient_of(agent, data).items():
        expected = -sum(a * s[name] for a, s in zip(advantage, scores, strict=True)) / 3
        np.testing.assert_allclose(gradient, expected, rtol=1e-4, atol=1e-5)


def test_a2c_critic_descends_the_squared_td_error_with_a_held_target() -> None:
    agent = A2C(Constant("end"), A2CConfig(gamma=0.5, steps_per_update=3), seed=0)
    data = rollout()
    critic = agent.networks["critic"]
    gradient_of(agent, data)
    bias = critic.output.bias.grad.item()
    with torch.no_grad():
        value = critic(torch.from_numpy(data.observations)).numpy()
    errors = [1 + 0.5 * value[1] - value[0], 2 + 0.5 * value[2] - value[1], 4 - value[2]]
    # d/db of 0.5 * mean(error^2) with dV/db = 1 and the target constant
    assert bias == pytest.approx(-np.mean(errors), rel=1e-4)


@pytest.mark.parametrize(("ending", "value"), [("limit", 10.0), ("end", None)])
def test_critic_bootstraps_through_the_limit_and_not_through_the_end(
    ending: str, value: float | None
) -> None:
    """One state, reward 1, gamma 0.9: V = 1 / (1 - 0.9) = 10 if a limit cuts the episodes.

    If they end, TD(0) on one state settles at the mean target: V = 1 + 0.9 · 7/8 · V = 4.7059.
    """
    config = A2CConfig(gamma=0.9, steps_per_update=64, learning_rate=0.02)
    log = EpisodeLog(Constant(ending), seed=0)
    agent = A2C(log, config, seed=0)
    agent.train(log, 120_000, lambda: True)
    got = agent.networks["critic"](torch.zeros(1, 1)).item()
    assert got == pytest.approx(value or 1 / (1 - 0.9 * 7 / 8), rel=0.02)


def test_time_baseline_leaves_nothing_of_a_reward_that_no_action_changes() -> None:
    agent = VPG(Constant("limit"), VPGConfig(baseline="time", episodes_per_update=4), seed=0)
    log = EpisodeLog(Constant("limit"), seed=0)
    collector = Collector(log, np.random.default_rng(0))
    data = collector.episodes(NetworkPolicy(agent.actor()), 4, 10_000)
    assert len(data) == 32
    np.testing.assert_allclose(agent.weights(data), 0, atol=1e-6)


def test_collector_keeps_final_observations_and_goes_on() -> None:
    log = EpisodeLog(ElevationEnv(episode_length=5), seed=0)
    agent = make_agent("a2c", log, A2CConfig(), 0)
    collector = Collector(log, np.random.default_rng(0))
    first = collector.steps(NetworkPolicy(agent.actor()), 7)
    second = collector.steps(NetworkPolicy(agent.actor()), 7)
    joined = np.concatenate([first.observations, second.observations])
    after = np.concatenate([first.next_observations, second.next_observations])
    ends = np.concatenate([first.ends, second.ends])
    assert np.flatnonzero(ends).tolist() == [4, 9]
    same = [np.array_equal(after[t], joined[t + 1]) for t in range(13)]
    assert same == [t not in (4, 9) for t in range(13)]


def test_episode_seeds_differ_between_runs_and_episodes() -> None:
    seeds = {episode_seed(run, k) for run in range(20) for k in range(50)}
    assert len(seeds) == 1000


def test_log_counts_what_was_flown() -> None:
    log = EpisodeLog(ElevationEnv(episode_length=3), seed=5)
    log.reset()
    observation, *_ = log.step(np.ones(1, np.float32))
    log.step(np.ones(1, np.float32))
    *_, truncated, _ = log.step(np.ones(1, np.float32))
    (episode,) = log.episodes
    assert truncated
    assert (episode.length, episode.first_step, episode.truncated) == (3, 0, True)
    assert log.errors[0] == observation[0]
    assert list(log.thrusts) == [54.0, 59.0, 64.0]
    assert episode.total_reward == pytest.approx(sum(log.rewards))


def small_run(algorithm: str, **changes: Any) -> Run:
    size = {"episodes_per_update": 2} if algorithm == "vpg" else {"steps_per_update": 70}
    return Run(
        algorithm=algorithm,
        config=preset(algorithm, "tuned", **size, **changes),
        env=ElevationConfig(episode_length=100),
        seed=4,
        env_steps=1400,
    )


def stop_after(count: int) -> Callable[[], bool]:
    calls = iter(range(count - 1, -1, -1))
    return lambda: next(calls) > 0


@pytest.mark.parametrize("algorithm", ["vpg", "a2c", "sb3-a2c"])
def test_resuming_gives_the_numbers_of_an_unbroken_run(algorithm: str, tmp_path: Path) -> None:
    run, path = small_run(algorithm), tmp_path / "checkpoint.safetensors"
    unbroken = Training(run, ElevationEnv(episode_length=100))
    assert unbroken.train()
    broken = Training(run, ElevationEnv(episode_length=100))
    stop = stop_after(4)

    def store_and_stop() -> bool:
        go_on = stop()
        if not go_on:
            broken.store(path)
        return go_on

    assert not broken.train(store_and_stop)
    at_stop = list(broken.log.episodes)
    torch.manual_seed(99)  # nothing may depend on what the process did before
    resumed = Training.resume(load(path), ElevationEnv(episode_length=100), at_stop)
    assert resumed.log.env_steps < 1400
    assert resumed.train()
    for name, expected in unbroken.agent.state().items():
        np.testing.assert_array_equal(resumed.agent.state()[name], expected, err_msg=name)
    strip = [(e.episode, e.length, e.total_reward) for e in unbroken.log.episodes]
    assert [(e.episode, e.length, e.total_reward) for e in resumed.log.episodes] == strip


def test_resuming_on_another_env_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    training = Training(small_run("a2c"), ElevationEnv(episode_length=100))
    stop = stop_after(2)
    training.train(lambda: (stop(), training.store(path))[0])
    with pytest.raises(ResumeError, match="does not repeat episode"):
        Training.resume(load(path), ElevationEnv(episode_length=100, linear_drag=1.0), [])


def test_a_checkpoint_tells_where_it_comes_from(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    training = Training(small_run("vpg"), ElevationEnv(episode_length=100))
    training.train(lambda: False)
    training.store(path)
    kept = load(path)
    assert kept.algorithm == "vpg"
    assert kept.config["baseline"] == "time"
    assert (kept.seed, kept.env_steps, kept.env["episode_length"]) == (4, 1400, 100)
    assert {"python", "rotorgram", "mujoco", "torch"} <= set(kept.versions)
    assert kept.policy().act(np.zeros(3, np.float32)).shape == (1,)
    assert not list(tmp_path.glob(".*tmp"))


@pytest.mark.parametrize("content", [b"", b"garbage" * 100, None], ids=["empty", "noise", "none"])
def test_what_is_no_checkpoint_is_refused_in_one_sentence(
    content: bytes | None, tmp_path: Path
) -> None:
    path = tmp_path / "checkpoint.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CheckpointError, match="checkpoint"):
        load(path)


@pytest.mark.parametrize("algorithm", ["vpg", "a2c", "sb3-a2c"])
@pytest.mark.parametrize("name", ["paper", "tuned"])
@pytest.mark.parametrize("action_type", ["continuous", "discrete"])
def test_every_agent_trains_with_every_preset_and_kind_of_action(
    algorithm: str, name: str, action_type: str
) -> None:
    run = Run(
        algorithm=algorithm,
        config=preset(algorithm, name),
        env=ElevationConfig(action_type=action_type, episode_length=60),
        seed=0,
        env_steps=300 if name == "paper" else 512,
    )
    training = Training(run, ElevationEnv(action_type=action_type, episode_length=60), snapshots=2)
    before = training.agent.actor()
    assert training.train()
    after = training.agent.actor()
    assert any(not np.array_equal(before[k], after[k]) for k in before)
    assert training.log.env_steps == run.env_steps
    steps = [snapshot.env_steps for snapshot in training.taken]
    assert steps == sorted(set(steps))
    assert (steps[0], steps[-1]) == (0, run.env_steps)


def test_same_seed_same_numbers_and_other_seed_other_numbers() -> None:
    def weights(seed: int) -> bytes:
        run = small_run("a2c")
        training = Training(
            Run(**{**vars(run), "seed": seed, "env_steps": 300}), ElevationEnv(episode_length=100)
        )
        training.train()
        return training.agent.actor()["output.weight"].tobytes()

    assert weights(1) == weights(1)
    assert weights(1) != weights(2)


def test_unknown_names_are_named() -> None:
    with pytest.raises(ValueError, match="algorithm: expected one of"):
        preset("ppo", "paper")
    with pytest.raises(ValueError, match="preset: expected one of"):
        preset("vpg", "best")
    with pytest.raises(ValueError, match=r"hyperparameters: expected some of .* got \['rate'\]"):
        preset("vpg", "paper", rate=1)


def test_vpg_weights_with_baseline_and_scale_by_hand() -> None:
    """Two episodes, of two steps and one, gamma 0.5: R = 2, 2, 5; the mean at step 0 is 3.5."""
    config = VPGConfig(gamma=0.5, baseline="time", episodes_per_update=2)
    data = rollout(rewards=np.array([1.0, 2.0, 5.0]), terminated=np.array([False, True, True]))
    np.testing.assert_allclose(VPG(Constant("end"), config, 0).weights(data), [-1.5, 0, 1.5])
    config = VPGConfig(gamma=0.5, baseline="time", episodes_per_update=2, normalize=True)
    scaled = VPG(Constant("end"), config, 0).weights(data)
    np.testing.assert_allclose(scaled, np.array([-1.5, 0, 1.5]) / np.sqrt(1.5), rtol=1e-6)


def test_normalising_changes_the_actor_and_leaves_the_critic_alone() -> None:
    def gradients(normalize: bool) -> tuple[dict[str, np.ndarray], np.ndarray]:
        config = A2CConfig(gamma=0.5, steps_per_update=3, normalize=normalize)
        agent = A2C(Constant("end"), config, seed=0)
        actor = gradient_of(agent, rollout())
        return actor, agent.networks["critic"].output.weight.grad.numpy()

    plain, critic = gradients(False)
    normal, same_critic = gradients(True)
    np.testing.assert_array_equal(critic, same_critic)
    agent = A2C(Constant("end"), A2CConfig(gamma=0.5, steps_per_update=3), seed=0)
    data = rollout()
    with torch.no_grad():
        v = agent.networks["critic"](torch.from_numpy(data.observations)).numpy()
    advantage = np.array([1 + 0.5 * v[1] - v[0], 2 + 0.5 * v[2] - v[1], 4 - v[2]])
    advantage -= advantage.sum() / 3
    advantage /= np.sqrt((advantage**2).sum() / 2)
    scores = score_gradients(agent, data)
    for name, gradient in normal.items():
        expected = -sum(a * s[name] for a, s in zip(advantage, scores, strict=True)) / 3
        np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=1e-5)
    assert any(not np.allclose(plain[name], normal[name]) for name in plain)


def test_entropy_bonus_widens_the_policy() -> None:
    """The entropy of a Gaussian grows by 1 per unit of log_std: the loss falls by its weight."""

    def gradient(weight: float) -> float:
        config = A2CConfig(gamma=0.5, steps_per_update=3, entropy_weight=weight)
        return float(gradient_of(A2C(Constant("end"), config, seed=0), rollout())["log_std"][0])

    assert gradient(0.25) == pytest.approx(gradient(0.0) - 0.25, abs=1e-5)


@pytest.mark.parametrize("algorithm", ["vpg", "a2c", "sb3-a2c"])
@pytest.mark.parametrize("anneal", [True, False])
def test_learning_rate_falls_from_its_full_value_linearly(algorithm: str, anneal: bool) -> None:
    size = {"episodes_per_update": 2} if algorithm == "vpg" else {"steps_per_update": 16}
    config = preset(algorithm, "tuned", learning_rate=0.01, anneal=anneal, **size)
    log = EpisodeLog(Constant("limit"), seed=0)
    agent: Any = make_agent(algorithm, log, config, 0)
    optimizer = agent._optimizer if algorithm != "sb3-a2c" else agent._model.policy.optimizer
    rates: list[float] = []
    agent.train(log, 64, lambda: rates.append(optimizer.param_groups[0]["lr"]) is None)
    expected = [0.01, 0.0075, 0.005, 0.0025] if anneal else [0.01] * 4
    assert rates == pytest.approx(expected)


class Recorder(gym.Wrapper[np.ndarray, Any, np.ndarray, Any]):
    """Keeps what every step returned."""

    def __init__(self, env: gym.Env[np.ndarray, Any]) -> None:
        super().__init__(env)
        self.results: list[Any] = []

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self.results.append(result)
        return result


def copy_weights(model: Any, ours: A2C) -> None:
    theirs = model.policy.state_dict()
    paths = {
        "actor": {"hidden": "mlp_extractor.policy_net.0", "output": "action_net"},
        "critic": {"hidden": "mlp_extractor.value_net.0", "output": "value_net"},
    }
    for name, parts in paths.items():
        state = {
            f"{part}.{kind}": theirs[f"{path}.{kind}"]
            for part, path in parts.items()
            for kind in ("weight", "bias")
        }
        if name == "actor":
            state["log_std"] = theirs["log_std"]
        ours.networks[name].load_state_dict(state)


def test_sb3_and_ours_make_the_same_updates_of_the_same_experience() -> None:
    """SB3 flies; our A2C, from the same weights, is given what it flew: ten updates agree."""
    config = A2CConfig(
        steps_per_update=64, gamma=0.98, trace=0.95, learning_rate=0.01, entropy_weight=0.01,
        normalize=True,
    )  # fmt: skip
    recorder = Recorder(ElevationEnv(episode_length=40, flight_band=1.1))
    log = EpisodeLog(recorder, seed=0)
    theirs: Any = make_agent("sb3-a2c", log, config, 0)
    model = theirs._model
    ours = A2C(log, config, seed=1)
    copy_weights(model, ours)
    buffers: list[tuple[np.ndarray, np.ndarray]] = []
    prepare = model.rollout_buffer.compute_returns_and_advantage

    def keep_buffer(*args: Any, **kwargs: Any) -> None:
        buffer = model.rollout_buffer
        buffers.append((buffer.observations[:, 0].copy(), buffer.actions[:, 0].copy()))
        prepare(*args, **kwargs)

    model.rollout_buffer.compute_returns_and_advantage = keep_buffer

    def follow() -> bool:
        observations, actions = buffers[-1]
        after, rewards, terminated, truncated, _ = zip(*recorder.results, strict=True)
        recorder.results.clear()
        ours._optimizer.zero_grad()
        data = Rollout(
            observations=observations,
            actions=actions,
            rewards=np.array(rewards),
            next_observations=np.array(after),
            terminated=np.array(terminated),
            truncated=np.array(truncated),
        )
        ours.loss(data).backward()
        ours._optimizer.step()
        return True

    theirs.train(log, 640, follow)
    assert len(buffers) == 10
    assert any(e.truncated for e in log.episodes)
    assert any(e.terminated for e in log.episodes)
    for name, expected in theirs.actor().items():
        np.testing.assert_allclose(ours.actor()[name], expected, atol=2e-4, err_msg=name)


def test_what_is_stored_is_not_clipped_and_what_is_flown_is() -> None:
    flown: list[float] = []

    class Watched(Constant):
        def step(self, action: Any) -> Any:
            flown.append(float(action[0]))
            return super().step(action)

    log = EpisodeLog(Watched("limit"), seed=0)
    agent = make_agent("a2c", log, A2CConfig(log_std=1.0), 0)
    data = Collector(log, np.random.default_rng(0)).steps(NetworkPolicy(agent.actor()), 200)
    assert np.abs(data.actions).max() > 2
    assert np.abs(flown).max() == 1.0
    np.testing.assert_array_equal(flown, np.clip(data.actions[:, 0], -1, 1))


def test_evaluation_flies_without_noise_on_seeds_of_its_own() -> None:
    training = {episode_seed(run, k) for run in range(10) for k in range(300)}
    assert training.isdisjoint(evaluation_seed(k) for k in range(100))
    policy = NetworkPolicy(make_agent("a2c", ElevationEnv(), A2CConfig(), 0).actor())
    first, second = (fly_episodes(ElevationEnv(), policy, 2) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert one.errors.tobytes() == other.errors.tobytes()


@pytest.mark.parametrize(
    ("algorithm", "changes", "sentence"),
    [
        ("a2c", {"steps_per_update": 0}, "steps_per_update: expected a whole number, 1 or more"),
        ("a2c", {"hidden": 1.5}, "hidden: expected a whole number"),
        ("a2c", {"gamma": "abc"}, "gamma: expected a number from 0 to 1, got 'abc'"),
        ("a2c", {"trace": 1.1}, "trace: expected a number from 0 to 1"),
        ("a2c", {"anneal": 1}, "anneal: expected true or false"),
        ("vpg", {"baseline": "foo"}, "baseline: expected 'none' or 'time'"),
        ("vpg", {"episodes_per_update": 1}, "episodes_per_update: expected 2 or more"),
        ("vpg", {"learning_rate": 0}, "learning_rate: expected a number above 0"),
    ],
)
def test_wrong_hyperparameters_are_one_sentence(
    algorithm: str, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        preset(algorithm, "tuned", **changes)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"seed": -1}, "seed: expected 0 or more, got -1"),
        ({"env_steps": 0}, "env_steps: expected at least 70, got 0"),
    ],
)
def test_wrong_runs_are_one_sentence(changes: dict[str, int], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Run(**{**vars(small_run("a2c")), **changes})


@pytest.mark.parametrize(("algorithm", "bound"), [("a2c", 0.1), ("vpg", 0.2)])
def test_learns_to_hold_the_target(algorithm: str, bound: float) -> None:
    """Short learning, far from its final precision: the better of two seeds comes close.

    Rounding differs between processors, and with it a single training's fate.
    """

    def late_error(actor: dict[str, np.ndarray]) -> float:
        flights = fly_episodes(ElevationEnv(), NetworkPolicy(actor), 5)
        return float(np.mean([np.abs(f.errors[-60:]).mean() for f in flights]))

    before, after = [], []
    for seed in (0, 1):
        run = Run(
            algorithm=algorithm,
            config=preset(algorithm, "tuned"),
            env=ElevationConfig(),
            seed=seed,
            env_steps=60_000,
        )
        training = Training(run, ElevationEnv())
        before.append(late_error(training.agent.actor()))
        training.train()
        after.append(late_error(training.agent.actor()))
    assert np.mean(before) > 0.3
    assert min(after) < bound
