"""Base of the algorithms: fly, update, repeat; stop and resume at any update."""

import json
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from .config import Config
from .episodes import EpisodeRecorder
from .layers import ByName, Weights, named
from .networks import make_network
from .optimizers import Adam
from .policies import NetworkPolicy
from .rollouts import Collector, Diverged, Rollout

OnUpdate = Callable[[], bool]
"""Called after every rollout and its update; training stops where it returns False."""


class Learner:
    """Base of our own algorithms, which learn from what the current policy has just flown.

    Actor and critic compute together in an update, as one network: in each of its arrays the first
    row is the actor's, the second the critic's, with zeros for what only the other one has. While
    drones fly, and for values, each computes alone on the same weights.

    Attributes:
        weights: Of both: arrays of shape (2, ...), or (1, ...) without a critic.
        optimizer: Adam of all weights.
        rate: Learning rate of the next update.
        terms: Of the loss of the last update: `gain`, the mean of weight · log P, which the actor
            climbs; `entropy` of the policy, nats; and of a critic `value_loss`, the mean squared
            error of the values, with `values`, V(s_t) before the update, and their `targets`,
            shape (T,). Other terms are logged under their names.
    """

    epsilon = 1e-8
    """Added by Adam to the root of the squares."""
    has_critic = False
    central = False
    """Whether the critic sees the observations of all drones of a world."""

    def __init__(self, log: EpisodeRecorder, config: Config, seed: int) -> None:
        self.spec = log.spec
        self.config = config
        self.rate = config.learning_rate
        self.terms: dict[str, Any] = {}
        weights_seed, self._rng = seeds_of(seed)
        self._actor = actor = NetworkPolicy(log.spec, config)
        log.actions = actor.actions
        copies = len(log.spec.agents) if self.central else 1
        seen = copies * log.spec.observation if self.has_critic else actor.spec.observation
        self._both = make_network(seen, actor.actions.outputs, config)
        count = 2 if self.has_critic else 1
        shapes = {**self._both.shapes, **actor.head.shapes}
        self._shapes = {name: (count, *shape) for name, shape in shapes.items()}
        self.weights = Weights.zeros(self._shapes)
        self._both.bind(self.weights)
        actor.bind(self.weights.of_one(0, actor.shapes))
        rng = np.random.default_rng(weights_seed)
        actor.network.initialise(rng, 0.01)  # the first policy gives the middle of the actions
        actor.head.initialise(config.log_std)
        if self.has_critic:
            self._critic = make_network(seen, 1, config)
            self._critic.bind(self.weights.of_one(1, self._critic.shapes))
            self._critic.initialise(rng, 1.0)
        self.optimizer = Adam(self.weights, self.epsilon)
        self._arrays = {"weights": self.weights.values, **named("optimizer.", self.optimizer.state)}
        if actor.memory:
            # What actor and critic remember of the running episodes.
            self._memory = np.zeros((count, config.memory, log.num_envs), np.float32)
            self._arrays["memory"] = self._memory
            actor.memory.state = self._memory[0]

    @abstractmethod
    def collect(self, collector: Collector, most: int) -> Rollout:
        """Fly at most `most` env steps for one update; an empty rollout makes no update."""

    @abstractmethod
    def gradient(self, rollout: Rollout) -> None:
        """Set the gradients of the loss that one step of Adam lowers, and its `terms`."""

    def update(self, rollout: Rollout) -> None:
        """Move the weights: by one step of Adam."""
        self.gradient(rollout)
        self.optimizer.step(self.rate)

    def train(self, log: EpisodeRecorder, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, from the current state on. Raises `Diverged`."""
        collector = Collector(log, self._rng, self._actor)
        while log.env_steps < env_steps:
            before = log.env_steps
            rollout = self.collect(collector, env_steps - before)
            left = 1 - before / env_steps
            rollout = replace(rollout, rewards=self.config.scaled(rollout.rewards, left))
            if self.config.anneal:
                self.rate = self.config.learning_rate * left
            if len(rollout):
                with np.errstate(over="ignore", invalid="ignore"):  # Diverged is raised below
                    self.update(rollout)
                self._actor.head.clamp()
                if not np.isfinite(self.weights.values).all():
                    raise Diverged(f"weights are not finite after update {self.optimizer.steps}")
            if not on_update():
                return

    def policy(self) -> NetworkPolicy:
        """The current policy: a copy."""
        return NetworkPolicy.load(self._actor.weights.arrays, self.spec, self.config)

    def state(self) -> ByName:
        """All that the next update depends on: copies."""
        arrays = {name: array.copy() for name, array in self._arrays.items()}
        generator = json.dumps(self._rng.bit_generator.state).encode()
        return arrays | {"rng": np.frombuffer(generator, np.uint8)}

    def set_state(self, state: ByName) -> None:
        """Take over a state. Raises `ValueError`, `TypeError` or `KeyError` unless it is whole."""
        self._rng.bit_generator.state = json.loads(state["rng"].tobytes())
        expected = {name: array.shape for name, array in self._arrays.items()}
        got = {name: array.shape for name, array in state.items() if name != "rng"}
        if got != expected:
            raise ValueError(f"state: expected arrays of shapes {expected}, got {got}")
        for name, array in self._arrays.items():
            array[...] = state[name]
        self.terms = {}

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, as in `docs/algorithms/README.md`; none before the first."""
        if not self.terms:
            return {}
        terms = dict(self.terms)
        numbers = {"policy_loss": -terms.pop("gain"), "entropy_loss": -terms.pop("entropy")}
        if "values" in terms:
            targets = terms.pop("targets")
            spread = np.var(targets)
            left = np.var(targets - terms.pop("values"))
            numbers["explained_variance"] = 1 - float(left) / float(spread) if spread else np.nan
        deviations = self._actor.weights.arrays.get("log_std")
        if deviations is not None:
            numbers["std"] = np.exp(deviations).mean()
        numbers |= {"learning_rate": self.rate, "n_updates": self.optimizer.steps, **terms}
        return {f"train/{name}": float(value) for name, value in numbers.items()}


def seeds_of(seed: int) -> tuple[int, np.random.Generator]:
    """Seed of the weights and generator of the actions, independent of each other."""
    weights, actions = np.random.SeedSequence(seed).spawn(2)
    return int(weights.generate_state(1, np.uint64)[0]), np.random.default_rng(actions)
