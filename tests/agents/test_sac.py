"""SAC: each gradient against torch, differences and numbers by hand; updates against SB3's."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nets import mlp_of
from rotorgram.agents import (
    EpisodeRecorder,
    SACConfig,
    make_agent,
    preset,
)
from rotorgram.agents.rollouts import Rollout
from rotorgram.agents.sac import SAC, ReplayBuffer, SquashedActor
from rotorgram.agents.sb3 import SB3Agent
from rotorgram.envs import LocalVectorEnv
from rotorgram.models.errors import InputError
from scripted import CALM, LOSSES, Scripted, log_of

ENV = "rotorgram/Elevation-v0"
N, K, BATCH = 3, 2, 64  # of scripted drones
SMALL = {"hidden": (8, 7), "batch_size": 16, "learning_starts": 40, "buffer_size": 200}


def normal(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)


def actor_of(sizes: tuple[int, ...], activation: str = "relu", size: float = 0.0) -> SquashedActor:
    """Of random weights of such a size."""
    network, weights = mlp_of(sizes, activation)
    weights.values[:] = size * normal(weights.values.size)
    actor = SquashedActor(network)
    actor.bind(weights)
    return actor


def agent_of(**changes: Any) -> SAC:
    agent = make_agent("sac", log_of(Scripted(CALM)), SACConfig(**{**SMALL, **changes}), 0)
    assert isinstance(agent, SAC)
    return agent


def batch_of(size: int = BATCH) -> tuple[np.ndarray, ...]:
    """States, actions, next states, rewards, ends."""
    ends = (np.arange(size) % 5 == 0).astype(np.float32)
    return (normal(size, N, seed=1), np.tanh(normal(size, K, seed=2)), normal(size, N, seed=3),
            normal(size, seed=4), ends)  # fmt: skip


def test_log_probability_of_a_squashed_gaussian_by_hand() -> None:
    """Mean 0.5, σ 1, noise 0.3: u = 0.8, log N = -0.963939, log(1 - tanh² 0.8) = -0.581507."""
    actor = actor_of((1, 1, 2))
    actor.weights.arrays["layers.1.bias"][:] = 0.5, 0.0
    actions, logs = actor.draw(np.ones((1, 1), np.float32), np.array([[0.3]], np.float32))
    assert actions[0, 0] == pytest.approx(0.6640368, rel=1e-6)
    assert logs[0] == pytest.approx(-0.382431, abs=1e-5)


def test_a_deviation_at_its_limit_has_no_gradient() -> None:
    actor = actor_of((1, 1, 2))
    bias = actor.weights.arrays["layers.1.bias"]
    for log_std, wanted in ((3.0, 2.0), (-25.0, -20.0)):
        bias[:] = 0.0, log_std
        actions, _ = actor.draw(np.ones((1, 1), np.float32), np.array([[0.1]], np.float32))
        assert actions[0, 0] == pytest.approx(math.tanh(0.1 * math.exp(wanted)), rel=1e-5)
        actor.backward(np.ones((1, 1), np.float32), 1.0)
        assert actor.weights.gradients["layers.1.bias"][1] == 0


def named_as_sb3(agent: SAC) -> dict[str, np.ndarray]:
    """The weights of ours under the names of SB3's policy."""
    weights = agent.weights.arrays
    last = len(agent.config.hidden)
    state: dict[str, np.ndarray] = {}
    for kind in ("weight", "bias"):
        for i in range(last):
            state[f"actor.latent_pi.{2 * i}.{kind}"] = weights[f"actor.layers.{i}.{kind}"]
        mean, log_std = np.split(weights[f"actor.layers.{last}.{kind}"], 2)
        state[f"actor.mu.{kind}"] = mean
        state[f"actor.log_std.{kind}"] = log_std
    for prefix, arrays in (
        ("critic", agent.weights.part("critic.").arrays),
        ("critic_target", agent.targets.arrays),
    ):
        for name, array in arrays.items():
            net, _, layer, kind = name.split(".")
            state[f"{prefix}.qf{net}.{2 * int(layer)}.{kind}"] = array
    return state


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_updates_are_those_of_sb3(activation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"activation": activation, "learning_rate": 0.003, "alpha": 0.3, "tau": 0.02}
    agent = agent_of(**settings)
    theirs = make_agent("sb3-sac", log_of(Scripted(CALM)), agent.config, 0)
    assert isinstance(theirs, SB3Agent)
    tensors = {k: torch.from_numpy(array.copy()) for k, array in named_as_sb3(agent).items()}
    theirs.model.policy.load_state_dict(tensors)
    theirs.model._current_progress_remaining = 1.0
    noises: list[np.ndarray] = []
    draw = "torch.distributions.normal._standard_normal"
    monkeypatch.setattr(draw, lambda *_, **__: torch.from_numpy(noises.pop(0)))
    for step in range(12):
        batch = tuple(np.roll(part, step, axis=0) for part in batch_of())
        states, actions, next_states, rewards, ends = batch
        noise = normal(BATCH, K, seed=50 + step)
        ahead = normal(BATCH, K, seed=90 + step)
        noises += [noise, ahead]  # SB3 draws at the states first
        samples = _samples(states, actions, next_states, ends[:, None], rewards[:, None], None)
        monkeypatch.setattr(theirs.model.replay_buffer, "sample", lambda *_, s=samples, **__: s)
        theirs.model.train(1, BATCH)
        agent.update(batch, noise, ahead)
        if step not in (0, 11):
            continue
        close = 2e-5 if step == 0 else 4e-4
        kept = theirs.state()
        for name, array in named_as_sb3(agent).items():
            expected = kept[f"policy.{name}"]
            np.testing.assert_allclose(array, expected, rtol=1e-3, atol=close, err_msg=name)
        told = theirs.scalars()
        got = agent.scalars()
        for name in ("actor_loss", "critic_loss", "ent_coef", "ent_coef_loss"):
            expected = told[f"train/{name}"]
            assert got[f"train/{name}"] == pytest.approx(expected, rel=2e-3, abs=1e-4), name


def _samples(*columns: np.ndarray | None) -> Any:
    from stable_baselines3.common.type_aliases import ReplayBufferSamples

    return ReplayBufferSamples(*(None if c is None else torch.from_numpy(c) for c in columns))


# ---- the buffer


def rollout(values: list[float], **flags: list[bool]) -> Rollout:
    """Steps of one drone, all numbers of a step alike."""
    column = np.array(values, np.float32)[:, None, None]
    never = np.zeros((len(values), 1), bool)
    given = {name: np.array(flag)[:, None] for name, flag in flags.items()}
    marks = {"terminated": never, "truncated": never, "kept": ~never} | given
    seen = np.repeat(column, 2, axis=2)
    rewards = column[..., 0] + 0.5
    return Rollout(seen, column + 0.25, rewards, next_observations=seen + 1, **marks)


def test_the_buffer_keeps_the_last_transitions() -> None:
    buffer = ReplayBuffer(4, 2, 1)
    buffer.add(rollout([1, 2, 3], terminated=[False, False, True]))
    assert len(buffer) == 3
    states, actions, next_states, rewards, ends = buffer.take(np.array([2, 0]))
    assert states.tolist() == [[3, 3], [1, 1]]
    assert actions.tolist() == [[3.25], [1.25]]
    assert next_states.tolist() == [[4, 4], [2, 2]]
    assert rewards.tolist() == [3.5, 1.5]
    assert ends.tolist() == [1, 0]
    # A truncation is no end; the row that is not kept is no transition.
    buffer.add(rollout([4, 5, 6], truncated=[True, False, False], kept=[True, False, True]))
    assert len(buffer) == 4
    assert buffer.added == 5
    states, *_, ends = buffer.take(np.arange(4))
    assert states[:, 0].tolist() == [6, 2, 3, 4]
    assert ends.tolist() == [0, 0, 1, 0]


@pytest.mark.parametrize("script", [CALM, LOSSES], ids=["calm", "losses"])
def test_every_drone_writes_what_it_flew(script: Any) -> None:
    """In the order of flight; true last observations; nothing of a lost simulator's steps."""
    env = Scripted(script)
    agent: Any = make_agent("sac", log_of(env), SACConfig(**SMALL), 0)
    agent.train(agent_log := log_of(env), 90, lambda: True)
    assert agent_log.env_steps == sum(map(len, env.flown))
    flown = {row.observation.tobytes(): row for rows in env.flown for row in rows}
    kept = [row for row in flown.values() if not row.lost]
    assert len(agent.buffer) == len(kept)
    for state, action, after, reward, ends in zip(
        *agent.buffer.take(np.arange(len(agent.buffer))), strict=True
    ):
        row = flown[state.tobytes()]
        np.testing.assert_array_equal(action, row.action)
        assert after.tobytes() == row.after.tobytes()
        assert reward == np.float32(row.reward)
        assert ends == row.terminated


def test_the_beginning_is_uniform() -> None:
    agent = agent_of(learning_starts=150)
    agent.train(log_of(Scripted(CALM)), 400, lambda: agent.warming_up)
    actions = agent.buffer.take(np.arange(len(agent.buffer)))[1]
    assert agent.optimizer.steps == 1
    assert abs(actions[:150]).max() < 1
    counts = np.histogram(actions[:150], bins=4, range=(-1, 1))[0]
    assert counts.min() > 45  # of 300 numbers 75 on average, 7.5 off by chance


# ---- trainings


def elevation(drones: int, seed: int = 5) -> EpisodeRecorder:
    options: dict[str, Any] = {"episode_length": 30, "start_band": 0.3, "flight_band": 0.4}
    return EpisodeRecorder(LocalVectorEnv(ENV, drones, autoreset_mode="Disabled", **options), seed)


def test_a_checkpoint_of_another_buffer_is_refused() -> None:
    agent = agent_of()
    state = agent.state()
    for name in ("buffer", "targets", "weights"):
        with pytest.raises(ValueError, match=f"{name}: expected"):
            agent.set_state(state | {name: np.zeros((1, 1), np.float32)})
    with pytest.raises(KeyError):
        agent.set_state({k: v for k, v in state.items() if k != "added"})


def test_the_policy_is_the_mean_of_the_actor() -> None:
    agent = agent_of()
    seen = normal(5, N)
    agent.weights.values[:] = normal(agent.weights.values.size)
    actor = agent._actor
    expected, _ = actor.draw(seen, np.zeros((5, K), np.float32))
    np.testing.assert_allclose(agent.policy().output(seen), expected, atol=1e-6)
    assert abs(expected).max() <= 1


@pytest.mark.parametrize("algorithm", ["sac", "sb3-sac"])
def test_choices_are_refused(algorithm: str) -> None:
    with pytest.raises(InputError, match="expected an env of continuous actions, got one of"):
        make_agent(algorithm, log_of(Scripted(CALM, discrete=True)), SACConfig(), 0)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"tau": 0.0}, "tau: expected a number above 0, at most 1, got 0.0"),
        ({"gradient_steps": 0}, "gradient_steps: expected a whole number of at least 1, got 0"),
        ({"target_entropy": "auto"}, "target_entropy: expected a number, or none"),
        ({"buffer_size": 50}, "buffer_size: expected learning_starts (1000) or more, got 50"),
    ],
)
def test_wrong_settings_are_one_sentence(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        SACConfig(**changes)
    assert str(caught.value).startswith(sentence)


@pytest.mark.parametrize("algorithm", ["sac", "sb3-sac"])
def test_what_is_logged_is_on_the_page(algorithm: str) -> None:
    page = Path(__file__).parents[2] / "docs" / "algorithms" / f"{algorithm}.md"
    told = set(re.findall(r"^\| `(train/\w+)`", page.read_text(encoding="utf-8"), re.MULTILINE))
    log = elevation(2)
    agent = make_agent(algorithm, log, preset(algorithm, "tuned", **SMALL), 0)
    assert agent.scalars() == {}
    agent.train(log, 48, lambda: True)
    assert set(agent.scalars()) == told
    assert agent.scalars()["train/n_updates"] >= 1
    assert agent.scalars()["train/ent_coef"] == pytest.approx(0.1, rel=0.05)
