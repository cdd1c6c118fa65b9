"""Policies that remember: a GRU by finite differences, over sequences, in rollouts and learning."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from nets import bound, config_of
from rotorgram.agents import Config, EpisodeRecorder, PPOConfig, VPGConfig, make_agent
from rotorgram.agents.a2c import A2C, A2CConfig
from rotorgram.agents.layers import Weights
from rotorgram.agents.memory import GRU, Sequences
from rotorgram.agents.networks import Network
from rotorgram.agents.policies import NetworkPolicy
from rotorgram.agents.ppo import PPO
from rotorgram.agents.rollouts import Collector
from rotorgram.envs.autoreset import AdvancingVectorEnv
from rotorgram.envs.spec import ArraySpec
from rotorgram.models.errors import InputError
from scripted import CALM, LOSSES, Script, Scripted, log_of, spec_of

INPUTS = 3
UNITS = 4
STEPS = 6
NUMBER = 5
SEEN = ArraySpec(name="seen", shape=(INPUTS,))
SMALL = Config(memory=UNITS, hidden=(3,), activation="tanh")


def dice(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def network_of(config: Config = SMALL) -> tuple[Network, Weights]:
    network = Network([SEEN], 2, config)
    weights = bound(network)
    weights.values[:] = dice(1).normal(size=weights.values.size)
    return network, weights


def sequences_of(seed: int = 2) -> tuple[np.ndarray, Sequences]:
    """Inputs (n, T·S), time by time, and states at the start; a third of the rows begin anew."""
    rng = dice(seed)
    inputs = rng.normal(size=(INPUTS, STEPS * NUMBER)).astype(np.float32)
    begins = rng.random((STEPS, NUMBER)) < 0.3
    state = rng.normal(size=(UNITS, NUMBER)).astype(np.float32)
    return inputs, Sequences(state, begins, ~np.zeros_like(begins))


def test_a_step_by_hand() -> None:
    """h = 0.5, x = 1; z = sigmoid(1 + 0.5), r = sigmoid(-1 + 0.25), c = tanh(0.3 + 0.8 · r · 0.5).

    z = 0.817574, r = 0.320821, c = tanh(0.428329) = 0.403929, and h' = c + z (h - c) = 0.482474.
    """
    layer = GRU(1, 1)
    weights = Weights.zeros(layer.shapes)
    weights.arrays["weight"][:] = [[0.0, 1.0], [0.0, -1.0], [0.1, 0.2]]
    weights.arrays["recurrent"][:] = [[1.0], [0.5], [0.8]]
    layer.bind(weights)
    layer.state = np.array([[0.5]], np.float32)
    found = layer.forward(np.ones((2, 1), np.float32))
    np.testing.assert_allclose(found, [[1.0], [0.482474]], atol=1e-6)
    np.testing.assert_allclose(layer.state, [[0.482474]], atol=1e-6)


def test_a_sequence_is_a_loop_over_time_with_resets() -> None:
    network, _ = network_of()
    inputs, sequences = sequences_of()
    found = network.forward(inputs, sequences).copy().reshape(2, STEPS, NUMBER)
    memory = network.memory
    assert memory
    memory.state = sequences.state.copy()
    for step in range(STEPS):
        memory.forget(sequences.begins[step])
        row = inputs.reshape(INPUTS, STEPS, NUMBER)[:, step]
        np.testing.assert_allclose(network.forward(row), found[:, step], rtol=1e-5, atol=1e-6)


def test_states_and_gradients_are_those_of_torch() -> None:
    """Of a sequence without resets; torch's order of the gates is r, z, c."""
    network, weights = network_of(config_of((), "tanh", memory=UNITS))
    inputs, sequences = sequences_of()
    never = np.zeros_like(sequences.begins)
    torch_gru = torch.nn.GRU(INPUTS, UNITS)
    order = np.r_[UNITS : 2 * UNITS, :UNITS, 2 * UNITS : 3 * UNITS]
    weight = weights.arrays["layers.0.weight"][order]
    recurrent = weights.arrays["layers.0.recurrent"][order]
    with torch.no_grad():
        torch_gru.weight_ih_l0.copy_(torch.tensor(weight[:, 1:]))
        torch_gru.bias_ih_l0.copy_(torch.tensor(weight[:, 0]))
        torch_gru.weight_hh_l0.copy_(torch.tensor(recurrent))
        torch_gru.bias_hh_l0.zero_()
    seen = torch.tensor(inputs.reshape(INPUTS, STEPS, NUMBER).transpose(1, 2, 0))
    states, _ = torch_gru(seen, torch.tensor(sequences.state.T[None]))
    last = torch.tensor(weights.arrays["layers.1.weight"])
    outputs = last[:, 0] + states @ last[:, 1:].T
    found = network.forward(inputs, replace(sequences, begins=never))
    expected = outputs.detach().numpy().reshape(-1, 2)
    np.testing.assert_allclose(found.T, expected, rtol=1e-5, atol=1e-5)
    slope = dice(3).normal(size=(2, STEPS * NUMBER)).astype(np.float32)
    outputs.backward(torch.tensor(slope.T.reshape(STEPS, NUMBER, 2)))
    network.learn(slope)
    by_weight = torch_gru.weight_ih_l0.grad
    by_recurrent = torch_gru.weight_hh_l0.grad
    assert by_weight is not None
    assert by_recurrent is not None
    ours = weights.gradients["layers.0.weight"][order]
    np.testing.assert_allclose(ours[:, 1:], by_weight, rtol=1e-4, atol=1e-5)
    ours = weights.gradients["layers.0.recurrent"][order]
    np.testing.assert_allclose(ours, by_recurrent, rtol=1e-4, atol=1e-5)


def test_gradients_through_resets_are_those_of_differences() -> None:
    network, weights = network_of()
    inputs, sequences = sequences_of()
    slope = dice(3).normal(size=(2, STEPS * NUMBER)).astype(np.float32)

    def loss() -> float:
        return float((network.forward(inputs, sequences).astype(np.float64) * slope).sum())

    loss()
    network.learn(slope.copy())
    gradient = weights.slopes.copy()
    step = np.float32(2.0**-7)
    differences = np.empty(weights.values.size)
    for place in range(weights.values.size):
        value = weights.values[place]
        weights.values[place] = value + step
        above = loss()
        weights.values[place] = value - step
        differences[place] = (above - loss()) / (2 * float(step))
        weights.values[place] = value
    np.testing.assert_allclose(gradient, differences, rtol=2e-3, atol=5e-3)
    assert np.abs(gradient).max() > 1.0


# ---- policies


SPEC = spec_of(observation=[SEEN])


def policy_of(spec: Any = SPEC) -> NetworkPolicy:
    policy = NetworkPolicy(spec, SMALL)
    weights = Weights.zeros(policy.shapes)
    weights.values[:] = dice(1).normal(size=weights.values.size)
    policy.bind(weights)
    return policy


def acts(policy: NetworkPolicy, count: int) -> list[list[float]]:
    seen = np.ones(INPUTS, np.float32)
    return [np.ravel(policy.act(seen)).tolist() for _ in range(count)]


def test_a_policy_remembers_until_it_is_reset_and_a_copy_has_a_state_of_its_own() -> None:
    policy = policy_of()
    first = acts(policy, 3)
    assert first[0] != first[1]
    other = copy.deepcopy(policy)
    further = acts(policy, 2)
    assert further[0] != first[0]
    assert acts(other, 2) == further
    policy.reset()
    other.reset()
    assert acts(policy, 3) == first
    loaded = NetworkPolicy.load(policy.weights.arrays, SPEC, SMALL)
    assert acts(loaded, 3) == first
    assert acts(other, 3) == first


# ---- rollouts and learning


def learner_of(script: Script, kind: type[A2C] = PPO, **settings: Any) -> tuple[Any, Collector]:
    config = PPOConfig if kind is PPO else A2CConfig
    given = {"steps_per_update": 7 * len(script), "gamma": 0.9, **settings}
    log = log_of(Scripted(script))
    agent: Any = kind(log, config(memory=UNITS, **given), 3)
    agent.weights.values[:] *= 2
    return agent, Collector(log, dice(5), agent._actor)


@pytest.mark.parametrize("script", [CALM, LOSSES, LOSSES[:1]], ids=["calm", "losses", "one"])
def test_what_is_learnt_from_is_what_was_flown(script: Script) -> None:
    """Three rollouts: outputs of the rows that are learnt from are those of a loop over time."""
    agent, collector = learner_of(script)
    env = collector.log.env
    policy = agent.policy()
    done = [0] * len(script)
    loops: list[Any] = [copy.deepcopy(policy) for _ in script]
    for _ in range(3):
        rollout = agent.collect(collector, 1000)
        sequences = agent.sequences(rollout, 0)
        rows = rollout.observations.reshape(-1, INPUTS).T
        outputs = agent._actor.network.forward(rows, sequences)
        outputs = outputs.T.reshape(*rollout.kept.shape, -1)
        agent.columns(rollout)
        for drone, rows_flown in enumerate(env.flown):
            expected = []
            for row in rows_flown[done[drone] :]:
                output = loops[drone].outputs(row.observation[None])[0].copy()
                if not row.lost:
                    expected.append(output)
                if row.ends:
                    loops[drone].reset()
            done[drone] = len(rows_flown)
            found = outputs[rollout.kept[:, drone], drone]
            np.testing.assert_allclose(found, np.array(expected), rtol=1e-4, atol=1e-5)
            kept = rollout.outputs[rollout.kept[:, drone], drone]
            np.testing.assert_allclose(kept, np.array(expected), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("script", [CALM, LOSSES, CALM[:1]], ids=["calm", "losses", "one"])
def test_values_are_carried_over_a_truncation_by_the_state_there(script: Script) -> None:
    """Advantages with lambda 0: r + gamma V(s', h) - V(s, h), where h comes by a loop over time."""
    agent, collector = learner_of(script, A2C)
    env = collector.log.env
    critic = copy.deepcopy(agent._critic)
    states = [np.zeros((UNITS, 1), np.float32) for _ in script]
    done = [0] * len(script)

    def value(observation: np.ndarray, state: np.ndarray) -> float:
        critic.memory.state = state.copy()
        return float(critic.forward(observation[:, None]).item())

    for _ in range(3):
        rollout = agent.collect(collector, 1000)
        estimates, _, _ = agent.advantages(rollout)
        for drone, rows in enumerate(env.flown):
            expected = []
            for row in rows[done[drone] :]:
                here = value(row.observation, states[drone])
                after = critic.memory.state.copy()
                ahead = 0.0 if row.terminated else 0.9 * value(row.after, after)
                if not row.lost:
                    expected.append(row.reward + ahead - here)
                states[drone] = np.zeros_like(after) if row.ends else after
            done[drone] = len(rows)
            found = estimates[rollout.kept[:, drone], drone]
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_minibatches_are_whole_drones_and_lost_rows_do_not_count() -> None:
    """Adding up the gradients of single drones, by their rows, gives that of all at once."""
    agent, collector = learner_of(LOSSES, A2C, ent_coef=0.01)
    rollout = agent.collect(collector, 1000)
    assert not rollout.kept.all()
    sequences = agent.sequences(rollout)
    columns = agent.columns(rollout)
    agent.minibatch(*columns, sequences=sequences)
    whole = agent.weights.slopes.copy()
    total = np.zeros_like(whole)
    for drone in range(len(LOSSES)):
        own = np.array([drone])
        some = [column[:, own] for column in columns]
        agent.minibatch(*some, sequences=sequences.take(own))
        total += agent.weights.slopes * (rollout.kept[:, drone].sum() / len(rollout))
    np.testing.assert_allclose(whole, total, rtol=1e-3, atol=1e-5)
    # What a lost row holds changes nothing.
    wild = [
        np.where(_like(column, rollout.kept), column, np.float32(3.0)) for column in columns[1:]
    ]
    agent.minibatch(columns[0], *wild, sequences=sequences)
    assert agent.weights.slopes.tobytes() == whole.tobytes()


def _like(column: np.ndarray, kept: np.ndarray) -> np.ndarray:
    return kept.reshape(*kept.shape, *(1 for _ in column.shape[2:]))


@pytest.mark.parametrize("algorithm", ["ppo", "a2c"])
def test_a_training_that_stops_goes_on_to_the_bit(algorithm: str) -> None:
    def agent_of() -> tuple[Any, EpisodeRecorder]:
        log = log_of(Scripted(CALM))
        kind = {"ppo": PPOConfig, "a2c": A2CConfig}[algorithm]
        config = kind(memory=UNITS, steps_per_update=12, learning_rate=0.01)
        return make_agent(algorithm, log, config, 3), log

    whole, log = agent_of()
    whole.train(log, 60, lambda: True)
    part, log = agent_of()
    updates = iter([True, True, False])
    part.train(log, 60, lambda: next(updates))
    state = part.state()
    assert np.abs(state["memory"]).max() > 0
    other, _ = agent_of()
    other.set_state(state)
    other.train(log, 60, lambda: True)
    for name, array in whole.state().items():
        assert other.state()[name].tobytes() == array.tobytes(), name


@pytest.mark.parametrize("algorithm", ["vpg", "apg", "sb3-ppo"])
def test_others_refuse_a_memory(algorithm: str) -> None:
    from rotorgram.agents.apg import APGConfig

    configs: dict[str, Any] = {"vpg": VPGConfig, "apg": APGConfig}
    config = configs.get(algorithm, PPOConfig)
    refused = r"^(memory: expected 0 with .*, got 8; ppo trains one|.* and reach with SB3, .*)$"
    with pytest.raises(InputError, match=refused):
        make_agent(algorithm, log_of(Scripted(CALM)), config(memory=8), 0)


# ---- a task that needs it


class Cue(AdvancingVectorEnv):
    """A number of -1 or 1 at the first of five steps; the last step rewards its sign."""

    LENGTH = 5

    def __init__(self, drones: int) -> None:
        self.closed = False
        action = ArraySpec(name="action", shape=(1,), low=-1.0, high=1.0)
        observation = ArraySpec(name="seen", shape=(1,), low=-1.0, high=1.0)
        self._take_spec(spec_of(action, [observation]), drones, "Disabled")
        self._dice = dice(6)
        self._cues = np.ones(drones)
        self._steps = np.zeros(drones, int)
        self.telemetry = {"metrics": np.zeros((drones, 1))}
        self.lost = np.zeros(drones, bool)
        self.observations = np.zeros((drones, 1), np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.advance(None, np.ones(self.num_envs, bool))
        return self.observations, {}

    def advance(
        self, actions: Any, resets: Any = None, seeds: Any = None, frozen: Any = None
    ) -> None:
        begins = np.zeros(self.num_envs, bool) if resets is None else resets
        moves = ~begins if frozen is None else ~begins & ~frozen
        self._steps = np.where(begins, 0, self._steps + moves)
        drawn = self._dice.choice([-1.0, 1.0], self.num_envs)
        self._cues = np.where(begins, drawn, self._cues)
        self.observations = np.where(begins, drawn, 0.0).astype(np.float32)[:, None]
        self.terminated = moves & (self._steps == self.LENGTH)
        self.truncated = np.zeros(self.num_envs, bool)
        chosen = np.zeros(self.num_envs) if actions is None else actions[:, 0]
        self.rewards = np.where(self.terminated, self._cues * chosen, 0.0)


def returns_of(memory: int) -> float:
    """Mean reward of the last episodes of a training: 0 without a clue, 1 at best."""
    drones = 16
    log = EpisodeRecorder(Cue(drones), 0)
    config = PPOConfig(
        memory=memory, hidden=(8,), activation="tanh", learning_rate=0.01, gae_lambda=1.0,
        steps_per_update=20 * drones, minibatches=4, epochs=8,
    )  # fmt: skip
    make_agent("ppo", log, config, 0).train(log, 16_000, lambda: True)
    rewards: Sequence[float] = [episode.total_reward for episode in log.episodes[-200:]]
    return float(np.mean(rewards))


def test_a_cue_at_the_first_step_is_remembered_to_the_last() -> None:
    assert returns_of(memory=8) > 0.8
    assert abs(returns_of(memory=0)) < 0.25
