"""Analytic policy gradients, and with values: that they learn, stop and resume."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nets import arrays_of
from rotorgram.agents import EpisodeRecorder, find_preset, load, make_agent, store
from rotorgram.agents.apg import APG, SHAC, APGConfig, SHACConfig
from rotorgram.agents.rollouts import Collector, Diverged, Rollout
from rotorgram.cli import main
from rotorgram.envs import LocalVectorEnv, Outcome, register
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.state import State
from rotorgram.envs.tasks.hover import Hover
from rotorgram.models.errors import InputError
from rotorgram.training.settings import Run
from rotorgram.training.training import Training

HOVER = "rotorgram/Hover-v0"
CLIMB = "test/Climb-v0"
DOUBLE = {"name": "rigid", "dtype": "float64"}
LEAST = -4.0  # of the logarithm of the noise's size


class Climb(Hover):
    """Its reward is the speed upwards, m/s."""

    def outcome(self, state: State) -> Outcome:
        return replace(super().outcome(state), reward={"climb": state.velocity[..., 2]})


def agent_of(
    env_id: str = HOVER, drones: int = 8, config: APGConfig | None = None, **options: Any
) -> tuple[APG, EpisodeRecorder]:
    settings = {"backend": DOUBLE, "autoreset_mode": "Disabled", **options}
    log = EpisodeRecorder(LocalVectorEnv(env_id, drones, **settings), 3)
    name = "shac" if isinstance(config, SHACConfig) else "apg"
    agent = make_agent(name, log, config or APGConfig(), 3)
    assert isinstance(agent, APG)
    return agent, log


def flown(agent: APG, log: EpisodeRecorder, steps: int) -> Rollout:
    collector = Collector(log, np.random.default_rng(0), agent._actor)
    return agent.collect(collector, steps * log.num_envs)


def after(changes: dict[str, tuple[int, float]]) -> APG:
    """An agent and its gradient after 12 steps, with some numbers of its weights changed."""
    config = APGConfig(gamma=1.0, max_grad_norm=1e9, activation="tanh", hidden=(8, 8))
    agent, log = agent_of(config=config, start_band=0.2)
    arrays, _ = arrays_of(agent)
    # Rotors far from alike: body rates of 0 have no derivative of their size.
    arrays["actor.layers.2.weight"][:, 0] = (0.3, -0.1, 0.2, 0.1)
    for name, (place, change) in changes.items():
        arrays[name].flat[place] += change
    agent.gradient(flown(agent, log, 12))
    return agent


@pytest.mark.parametrize(
    ("name", "place"), [("layers.2.weight", 0), ("layers.2.weight", 7), ("layers.0.weight", 9)]
)
def test_the_gradient_is_the_derivative_of_the_mean_reward(name: str, place: int) -> None:
    """Against a difference: of 12 steps of 8 drones, through the policy's later actions too."""
    name = f"actor.{name}"
    _, gradients = arrays_of(after({}))
    size = 0.02
    high = after({name: (place, size)}).terms["gain"]
    low = after({name: (place, -size)}).terms["gain"]
    slope = gradients[name].flat[place]
    assert abs(slope) > 1e-6
    assert slope == pytest.approx((low - high) / (2 * size), rel=0.02)


def test_through_a_wood_the_gradient_is_that_with_the_depth_held() -> None:
    """Against a difference in which each step shows what the depth camera showed before."""
    steps, count, size = 8, 16, 2e-3
    config = APGConfig(gamma=1.0, max_grad_norm=1e9, activation="tanh", hidden=(8,), log_std=-3.0)
    options: dict[str, Any] = {"density": 0.2, "effects": {"motor_lag": True}}
    agent, log = agent_of("rotorgram/Forest-v0", count, config, **options)
    arrays, gradients = arrays_of(agent)
    arrays["actor.layers.1.weight"][:, 0] = (0.15, 0.02, 0.01, 0.0)
    flown(agent, log, 30)
    env: Any = log.env
    start = env.snapshot()
    rollout = flown(agent, log, steps)
    assert rollout.kept.all()
    network = agent._actor.network
    means = [network.forward(seen.T).T.copy() for seen in rollout.observations]
    noise = rollout.actions - np.array(means)
    agent.gradient(rollout)
    gradient = gradients["actor.layers.1.weight"].copy()

    def mean_reward(change: float, place: tuple[int, int]) -> float:
        arrays["actor.layers.1.weight"][place] += change
        env.restore(start)
        total = 0.0
        for step in range(steps):
            seen = rollout.observations[step].copy()
            seen[:, :20] = env.observations["observation"]
            env.advance(network.forward(seen.T).T + noise[step])
            total += env.rewards.mean() / steps
        arrays["actor.layers.1.weight"][place] -= change
        return total

    assert mean_reward(0.0, (0, 0)) == pytest.approx(rollout.rewards.mean(), rel=1e-6)
    for place in [(0, 0), (1, 0), (2, 0), (0, 3), (1, 5), (2, 8)]:
        high, low = (mean_reward(change, place) for change in (size, -size))
        expected = (low - high) / (2 * size)
        assert gradient[place] == pytest.approx(expected, rel=0.02, abs=2e-5), place
    assert abs(gradient).max() > 1e-3


def climbing(steps: int, kind: type[APGConfig] = APGConfig, **options: Any) -> tuple[APG, Rollout]:
    """An agent that gives 0.1 whatever it sees, with as little noise as there may be."""
    register(CLIMB, Climb)
    config = kind(gamma=0.5, log_std=LEAST)
    level = {"start_tilt": 0.0, "start_heading": 0.0}
    agent, log = agent_of(CLIMB, 3, config, **level, **options)
    arrays, _ = arrays_of(agent)
    for array in arrays.values():
        array[...] = 0.0
    arrays["actor.layers.1.weight"][:, 0] = 0.1
    arrays["actor.log_std"][...] = LEAST
    return agent, flown(agent, log, steps)


def test_an_action_counts_with_all_that_follows() -> None:
    """A rotor's output of 1 is 51 N more than hover, on 20 kg for 0.02 s: 0.051 m/s from then on.

    Of 3 drones and 4 steps, discounted from the first step of the flight on.
    """
    agent, rollout = climbing(4)
    shares = np.array([1 + 0.5 + 0.25 + 0.125, 0.5 + 0.25 + 0.125, 0.25 + 0.125, 0.125])
    expected = -0.051 / 12 * shares[:, None, None] * np.ones((4, 3, 4))
    assert agent.slopes(rollout) == pytest.approx(expected, rel=1e-2)


def test_nothing_counts_after_the_end_of_an_episode() -> None:
    """Two episodes of 2 steps: those of the second change nothing of the first."""
    agent, rollout = climbing(4, episode_length=2)
    assert rollout.truncated.tolist() == [[False] * 3, [True] * 3] * 2
    shares = np.array([1 + 0.5, 0.5, 0.25 + 0.125, 0.125])
    expected = -0.051 / 12 * shares[:, None, None] * np.ones((4, 3, 4))
    assert agent.slopes(rollout) == pytest.approx(expected, rel=1e-2)


def test_a_clipped_action_has_no_derivative() -> None:
    """An output of 1.1 is one of 1 to the env, and so is one of 1.2."""
    agent, rollout = climbing(2)
    actions = rollout.actions.copy()
    actions[1, 0, 2] = 1.1
    slopes = agent.slopes(replace(rollout, actions=actions))
    assert slopes[1, 0].tolist() == pytest.approx([-0.051 / 12] * 2 + [0.0, -0.051 / 12], rel=1e-2)


def test_a_clipped_reward_has_no_derivative() -> None:
    """Of two steps the first one's reward is cut: the second action counts as before."""
    agent, rollout = climbing(2)
    before = agent.slopes(rollout)
    agent.config = replace(agent.config, reward_clip=0.5)
    rewards = np.array([[0.5] * 3, [0.1] * 3])
    after = agent.slopes(replace(rollout, rewards=rewards))
    assert after[1].tolist() == before[1].tolist()
    assert after[0] == pytest.approx(before[1], rel=1e-2)  # by the second reward alone


def test_what_one_drone_counts_has_a_bound() -> None:
    """Two of three drones count with their last reward alone."""
    agent, rollout = climbing(3)
    kept = rollout.kept.copy()
    kept[:-1, [0, 2]] = False
    part = replace(rollout, kept=kept)
    free = agent.slopes(part)
    agent.config = replace(agent.config, most_of_one=2.0)
    bounded = agent.slopes(part)
    assert bounded[:, 0].tolist() == free[:, 0].tolist()
    sizes = np.linalg.norm(free, axis=(0, 2))
    assert sizes[1] > 4 * sizes[0]
    assert bounded[:, 1] == pytest.approx(free[:, 1] * (2 * sizes[0] / sizes[1]), rel=1e-4)
    assert agent.terms["bounded"] == pytest.approx(1 / 3)


def test_a_drone_whose_derivatives_are_no_numbers_counts_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    agent, rollout = climbing(2)
    free = agent.slopes(rollout)
    agent.config = replace(agent.config, most_of_one=2.0)
    back = agent._derivative.back

    def broken(*args: Any) -> np.ndarray:
        slope = back(*args)
        slope[1] = np.nan
        return slope

    monkeypatch.setattr(agent._derivative, "back", broken)
    slopes = agent.slopes(rollout)
    assert agent.terms["bounded"] == pytest.approx(1 / 3)
    assert not slopes[:, 1].any()
    assert slopes[:, [0, 2]].tolist() == free[:, [0, 2]].tolist()


def test_if_no_derivative_is_a_number_training_has_diverged() -> None:
    config = SHACConfig(horizon=4, most_of_one=3.0)
    agent, log = agent_of(drones=4, config=config)
    assert isinstance(agent, SHAC)
    agent._critic_weights.values[...] = np.nan
    with pytest.raises(Diverged, match="weights are not finite after update 1"):
        agent.train(log, 64, lambda: True)


@pytest.mark.parametrize(
    ("name", "others"), [("anneal_clip", {"reward_clip": 8.0}), ("squashed", {})]
)
def test_what_it_cannot_differentiate_is_refused(name: str, others: dict[str, float]) -> None:
    sentence = f"{name}: expected false with the derivative of rewards, got true"
    with pytest.raises(InputError, match=sentence):
        APGConfig(**{name: True}, **others)


def valued(steps: int, **options: Any) -> tuple[SHAC, Rollout]:
    """As `climbing`, and V(s) is 3 s/m times the speed upwards plus 6."""
    agent, rollout = climbing(steps, SHACConfig, **options)
    assert isinstance(agent, SHAC)
    judge = agent._critic_weights.arrays
    for array in judge.values():
        array[...] = 0.0
    judge["layers.0.weight"][0, [0, 6]] = (2.0, 1.0)  # the bias, and the sixth number
    judge["layers.1.weight"][0, 1] = 3.0
    return agent, rollout


def test_a_flight_that_goes_on_counts_with_its_value() -> None:
    agent, rollout = valued(3)
    shares = np.array([1 + 0.5 + 0.25, 0.5 + 0.25, 0.25]) + 0.125 * 3
    expected = -0.051 / 9 * shares[:, None, None] * np.ones((3, 3, 4))
    assert agent.slopes(rollout) == pytest.approx(expected, rel=1e-2)


def test_so_does_an_episode_that_was_cut_off_and_no_crash() -> None:
    """Two episodes of two steps; then all crash in the last one."""
    agent, rollout = valued(4, episode_length=2)
    value = 3 * np.array([0.25, 0.25, 0.0625, 0.0625])
    shares = np.array([1 + 0.5, 0.5, 0.25 + 0.125, 0.125])
    expected = -0.051 / 12 * (shares + value)[:, None, None] * np.ones((4, 3, 4))
    assert agent.slopes(rollout) == pytest.approx(expected, rel=1e-2)
    terminated = rollout.terminated.copy()
    terminated[-1] = True
    crashed = agent.slopes(replace(rollout, terminated=terminated))
    assert crashed[:2] == pytest.approx(expected[:2], rel=1e-2)
    expected = -0.051 / 12 * shares[2:, None, None] * np.ones((2, 3, 4))
    assert crashed[2:] == pytest.approx(expected, rel=1e-2)


def test_the_critic_learns_the_sum_of_what_follows() -> None:
    """With λ = 1: the discounted rewards of the rollout and the value after it."""
    agent, rollout = valued(4)
    agent.config = replace(agent.config, gae_lambda=1.0)
    last = 3 * (rollout.next_observations[-1, :, 5] + 2)
    sums = [last]
    for rewards in rollout.rewards[::-1]:
        sums.append(rewards + 0.5 * sums[-1])
    losses = []
    for _ in range(40):
        agent.gradient(rollout)
        losses.append(agent.terms["value_loss"])
        if len(losses) == 1:
            expected = np.concatenate(sums[:0:-1])
            assert agent.terms["targets"] == pytest.approx(expected, rel=1e-4)
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize("kind", [APGConfig, SHACConfig])
def test_it_learns(kind: type[APGConfig]) -> None:
    gains = []
    config = kind(hidden=(16,), activation="tanh", learning_rate=0.02, horizon=80)
    agent, log = agent_of(drones=16, config=config)

    def keep() -> bool:
        gains.append(agent.terms["gain"])
        return True

    agent.train(log, 80 * 16 * 20, keep)
    assert np.mean(gains[-4:]) > np.mean(gains[:4]) + 1.0


@pytest.mark.parametrize(("name", "kind"), [("apg", APGConfig), ("shac", SHACConfig)])
def test_it_resumes_to_the_bit(name: str, kind: type[APGConfig], tmp_path: Path) -> None:
    config = kind(horizon=10, hidden=(8,))
    options: dict[str, Any] = {"backend": "rigid", "episode_length": 25}
    env = EnvConfig.from_keywords(HOVER, **options)
    run = Run(env=env, algorithm=name, config=config, seed=1, env_steps=320, num_envs=8)

    def vector() -> LocalVectorEnv:
        return LocalVectorEnv(HOVER, 8, autoreset_mode="Disabled", **options)

    whole = Training(run, vector())
    assert whole.train()
    part = Training(run, vector())
    updates = iter([True])
    assert not part.train(lambda: next(updates, False))
    store(part.checkpoint(), tmp_path / "kept")
    rest = Training.resume(load(tmp_path / "kept"), vector())
    assert rest.train()
    for part_of, array in whole.agent.state().items():
        assert rest.agent.state()[part_of].tobytes() == array.tobytes(), part_of


@pytest.mark.parametrize(
    "options",
    [
        {"backend": "mujoco"},
        {"backend": {"name": "rigid", "compiled": False}},
        {"env_id": "rotorgram/Elevation-v0", "action_type": "discrete"},
    ],
)
def test_what_it_cannot_learn_in(options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="apg: expected continuous actions and an env that is"):
        agent_of(**options)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["train", "apg", "--env", HOVER, "--num-envs", "4", "--env-steps", "160"]
    words += ["--set", "horizon=20"]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    assert "trained 160 of 160 env steps" in capsys.readouterr().out
    assert main([*words, "--out", str(tmp_path / "other"), "--udp"]) == 1
    assert "in this process (--backend rigid --no-udp)" in capsys.readouterr().err
    assert find_preset("apg", "tuned", HOVER).backend == "rigid"
