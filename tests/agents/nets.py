"""Networks and policies of chosen numbers."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from rotorgram.agents.config import Config, SACConfig
from rotorgram.agents.layers import Weights, named
from rotorgram.agents.networks import Network
from rotorgram.agents.policies import NetworkPolicy
from rotorgram.envs.spec import ArraySpec, EnvSpec


def config_of(
    hidden: tuple[int, ...], activation: str, *, squash: bool = False, **settings: Any
) -> Config:
    """With any number of hidden layers, none too."""
    kind = SACConfig if squash else Config
    config = kind(activation=activation, **settings)
    object.__setattr__(config, "hidden", hidden)
    return config


def bound(network: Network, values: np.ndarray | float = 0.0) -> Weights:
    """The weights of a network, all of these values."""
    weights = Weights.zeros(network.shapes)
    weights.values[:] = values
    network.bind(weights)
    return weights


def arrays_of(agent: Any) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Weights of a learner by name, as `critic.layers.0.weight`, and their gradients: views."""
    arrays: dict[str, np.ndarray] = {}
    gradients: dict[str, np.ndarray] = {}
    parts = {"actor.": agent._actor.weights}
    if agent.has_critic:
        parts["critic."] = agent.weights.of_one(1, agent._critic.shapes)
    for prefix, weights in parts.items():
        arrays |= named(prefix, weights.arrays)
        gradients |= named(prefix, weights.gradients)
    return arrays, gradients


def mlp_of(
    sizes: tuple[int, ...], activation: str = "relu", values: np.ndarray | float = 0.0
) -> tuple[Network, Weights]:
    """An MLP of so many inputs, units and outputs."""
    inputs, *hidden, outputs = sizes
    seen = [ArraySpec(name="seen", shape=(inputs,))]
    network = Network(seen, outputs, config_of(tuple(hidden), activation))
    return network, bound(network, values)


def policy_of(
    weights: Mapping[str, np.ndarray],
    spec: EnvSpec,
    activation: str = "relu",
    *,
    squash: bool = False,
    **settings: Any,
) -> NetworkPolicy:
    """The policy of an MLP with as many layers and units as the weights have."""
    last = sum(name.startswith("layers.") for name in weights) - 1
    hidden = tuple(len(weights[f"layers.{i}.weight"]) for i in range(last))
    config = config_of(hidden, activation, squash=squash, **settings)
    return NetworkPolicy.load(weights, spec, config)


def random_policy(
    spec: EnvSpec,
    hidden: tuple[int, ...] = (16,),
    activation: str = "relu",
    size: float = 1.0,
    **kinds: Any,
) -> NetworkPolicy:
    """A policy of random weights of such a size."""
    policy = NetworkPolicy(spec, config_of(hidden, activation, **kinds))
    weights = Weights.zeros(policy.shapes)
    weights.values[:] = size * np.random.default_rng(3).normal(size=weights.values.size)
    policy.bind(weights)
    return policy
