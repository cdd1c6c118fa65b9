"""A hundred updates from the same minibatches end with the weights that torch finds."""

from dataclasses import replace
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nets import arrays_of
from rotorgram.agents import ALGORITHMS, Config
from rotorgram.agents.ppo import PPOConfig
from rotorgram.agents.rollouts import Rollout
from rotorgram.envs.spec import ArraySpec, Discrete
from scripted import spec_of
from torch import Tensor

STEPS = 24
DRONES = 4
NET: dict[str, Any] = {"hidden": (8, 7), "activation": "tanh", "learning_rate": 0.001}
CRITIC: dict[str, Any] = {"normalize": True, "ent_coef": 0.01, "gae_lambda": 0.9}
SETTINGS: dict[str, dict[str, Any]] = {
    "vpg": NET,
    "a2c": NET | CRITIC,
    "ppo": {
        **NET,
        **CRITIC,
        "epochs": 2,
        "clip": 0.003,
        "minibatches": 5,
        "critic_learning_rate": 0.002,
    },
}
SETTINGS["mappo"] = SETTINGS["ppo"]


def agent_of(algorithm: str, *, discrete: bool) -> Any:
    """A learner that nothing has flown for: its spec has two drones in a world."""
    action = Discrete(choices=3) if discrete else ArraySpec(name="action", shape=(3,))
    spec = replace(spec_of(action), agents=("one", "two"))
    row = ALGORITHMS[algorithm]
    return row.agent(
        SimpleNamespace(spec=spec, num_envs=DRONES), row.config(**SETTINGS[algorithm]), 3
    )


def rollout(agent: Any, rng: np.random.Generator, *, discrete: bool) -> Rollout:
    """Random transitions, a few of which end an episode, as the policy flies before an update."""
    lead = (STEPS, DRONES)
    seen = rng.standard_normal((STEPS + 1, DRONES, 3), dtype=np.float32)
    actions = rng.standard_normal((*lead, 3), dtype=np.float32)
    if discrete:
        actions = rng.integers(3, size=(*lead, 1)).astype(np.float32)
    ends = rng.random((2, *lead)) < 0.1
    rewards = rng.normal(size=lead)
    rows = seen[:-1].reshape(-1, 3)
    return Rollout(
        np.zeros((0, lead[1]), np.float32),
        seen[:-1],
        agent._actor.network.forward(rows.T).T.reshape(*lead, -1).copy(),
        actions,
        rewards,
        seen[1:],
        *ends,
        kept=np.ones(lead, bool),
    )


class Reference:
    """Loss, autograd and Adam of torch, from the weights of a learner."""

    def __init__(self, agent: Any) -> None:
        config: Config = agent.config
        self.config: Any = config
        self.discrete = agent._actor.actions.discrete
        arrays, _ = arrays_of(agent)
        self.tensors = {k: torch.tensor(a, requires_grad=True) for k, a in arrays.items()}
        groups = []
        for prefix in ("actor.", "critic."):
            own = [tensor for name, tensor in self.tensors.items() if name.startswith(prefix)]
            rate = config.learning_rate
            if prefix == "critic.":
                rate = getattr(config, "critic_learning_rate", None) or rate
            if own:
                groups.append({"params": own, "lr": rate})
        self.optimizer = torch.optim.Adam(groups, eps=agent.epsilon)

    def network(self, prefix: str, inputs: Tensor) -> Tensor:
        for i in count():
            weight = self.tensors[f"{prefix}layers.{i}.weight"]
            inputs = weight[:, 0] + inputs @ weight[:, 1:].T
            if f"{prefix}layers.{i + 1}.weight" not in self.tensors:
                return inputs
            inputs = torch.tanh(inputs)
        raise AssertionError

    def score(self, inputs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probabilities and mean entropy."""
        output = self.network("actor.", inputs)
        if self.discrete:
            choices: Any = torch.distributions.Categorical(logits=output)
            return choices.log_prob(actions[:, 0]), choices.entropy().mean()
        normal: Any = torch.distributions.Normal(output, self.tensors["actor.log_std"].exp())
        return normal.log_prob(actions).sum(1), normal.entropy().sum(1).mean()

    def descend(self, loss: Tensor) -> None:
        self.optimizer.zero_grad()
        loss.backward()
        if isinstance(self.config, PPOConfig):
            torch.nn.utils.clip_grad_norm_(self.tensors.values(), self.config.max_grad_norm)
        self.optimizer.step()

    def returns(self, *columns: np.ndarray) -> None:
        """A step of VPG."""
        observations, actions, returns = map(torch.from_numpy, columns)
        log_probability, _ = self.score(observations, actions)
        self.descend(-(log_probability * returns).mean())

    def minibatch(self, *columns: np.ndarray) -> None:
        """A step of A2C, or with log-probabilities from before of PPO."""
        inputs, actions, advantage, targets, *before = map(torch.from_numpy, columns)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        log_probability, entropy = self.score(inputs[:, :3], actions)
        gains = log_probability * advantage
        if before:
            ratio = (log_probability - before[0]).exp()
            clip = self.config.clip
            gains = torch.min(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)
        errors = self.network("critic.", inputs)[:, 0] - targets
        loss = self.config.vf_coef * (errors**2).mean() - gains.mean()
        self.descend(loss - self.config.ent_coef * entropy)


@pytest.mark.parametrize("discrete", [False, True], ids=["continuous", "discrete"])
@pytest.mark.parametrize("algorithm", SETTINGS)
def test_a_hundred_updates_are_those_of_torch(algorithm: str, discrete: bool) -> None:
    agent = agent_of(algorithm, discrete=discrete)
    reference = Reference(agent)
    first = agent.weights.values.copy()
    rng = np.random.default_rng(0)
    if algorithm != "vpg":
        minibatch = agent.minibatch

        def both(*columns: np.ndarray, **_: None) -> tuple[float, ...]:
            reference.minibatch(*columns)
            terms: tuple[float, ...] = minibatch(*columns)
            return terms

        agent.minibatch = both
    while agent.optimizer.steps < 100:
        data = rollout(agent, rng, discrete=discrete)
        if algorithm == "vpg":
            columns = data.rows(data.observations), data.rows(data.actions)
            reference.returns(*columns, agent.returns(data))
        agent.update(data)
    assert np.abs(agent.weights.values - first).max() > 0.02
    assert agent.terms.get("clip_fraction", 1.0) > 0.05
    arrays, _ = arrays_of(agent)
    assert arrays.keys() == reference.tensors.keys()
    for name, tensor in reference.tensors.items():
        np.testing.assert_allclose(arrays[name], tensor.detach(), atol=1e-5, err_msg=name)
