"""Base of the algorithms: fly, update, repeat; stop and resume at any update."""

import json
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, TypeVar

import numpy as np

from .checkpoints import Checkpoint
from .episodes import EpisodeLog
from .networks import MLP, Actor, Adam, Weights, mlp_shapes
from .normalization import Moments
from .policies import ActionMap, NetworkPolicy, flat_size
from .rollouts import Collector, Diverged, Rollout

Item = TypeVar("Item")

OnUpdate = Callable[[], bool]
"""Called after every rollout and its update; training stops where it returns False."""


class Learner:
    """Base of our own algorithms: `collect` and `gradient`, or `update`, are theirs.

    Attributes:
        weights: Of all networks: `actor.…`, and of a critic `critic.…`.
        optimizer: Adam of all weights.
        rate: Learning rate of the next update.
        moments: Of the observations, where they are normalised; those of the next update have no
            part in them yet.
        terms: Of the loss of the last update: `gain`, the mean of weight · log P, which the actor
            climbs; `entropy` of the policy, nats; and of a critic `value_loss`, the mean squared
            error of the values, with `values`, V(s_t) before the update, and their `targets`,
            shape (T,). Other terms are logged under their names.
    """

    has_critic: ClassVar[bool] = False
    central: ClassVar[bool] = False
    """Whether the critic sees the observations of all drones of a world."""

    def __init__(self, log: EpisodeLog, config: Any, seed: int) -> None:
        weights_seed, self._rng = seeds_of(seed)
        self.spec, self.config = log.spec, config
        actions, inputs = ActionMap(log.spec.action), flat_size(log.spec)
        shapes = named("actor.", mlp_shapes((inputs, *config.hidden, actions.outputs)))
        if not actions.discrete:
            shapes["actor.log_std"] = (actions.outputs,)
        if self.has_critic:
            seen = inputs * (len(log.spec.agents) if self.central else 1)
            shapes |= named("critic.", mlp_shapes((seen, *config.hidden, 1)))
        self.weights = Weights.zeros(shapes)
        dice = np.random.default_rng(weights_seed)
        self._actor = Actor(self.weights.part("actor."), config.activation)
        self._actor.initialise(dice, config.log_std)
        if self.has_critic:
            self._critic = MLP(self.weights.part("critic."), config.activation)
            self._critic.initialise(dice, 1.0)
        self.optimizer, self.rate = Adam(self.weights), config.learning_rate
        self.moments = Moments(inputs) if config.normalize_observations else None
        self.terms: dict[str, Any] = {}

    def collect(self, collector: Collector, policy: NetworkPolicy, most: int) -> Rollout:
        """Fly for one update, at most so many env steps; an empty rollout makes none."""
        raise NotImplementedError

    def gradient(self, rollout: Rollout) -> None:
        """Set the gradients of the loss that one step of Adam lowers, and its `terms`."""
        raise NotImplementedError

    def update(self, rollout: Rollout) -> None:
        """Learn from a rollout: by one step of Adam."""
        self.gradient(rollout)
        self.optimizer.step(self.rate)

    def train(self, log: EpisodeLog, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, from the current state on. Raises `Diverged`."""
        collector = Collector(log, self._rng)
        while log.env_steps < env_steps:
            before = log.env_steps
            rollout = self.collect(collector, self.policy(), env_steps - before)
            if self.config.anneal:
                self.rate = self.config.learning_rate * (1 - before / env_steps)
            if len(rollout):
                with np.errstate(over="ignore", invalid="ignore"):  # told below
                    self.update(rollout)
                self._actor.clamp()
                if self.moments is not None:
                    self.moments.add(rollout.rows(rollout.observations))
                if not np.isfinite(self.weights.values).all():
                    raise diverged(self.optimizer.steps)
            if not on_update():
                return

    def inputs(self, observations: np.ndarray) -> np.ndarray:
        """Observations as the networks take them: normalised, if the config says so."""
        if self.moments is None:
            return observations
        return (observations - self.moments.mean) * self.moments.scale

    def actor(self) -> dict[str, np.ndarray]:
        """Weights for `NetworkPolicy`: copies."""
        arrays = {name: array.copy() for name, array in self._actor.weights.arrays.items()}
        if self.moments is not None:
            moments = {"mean": self.moments.mean, "scale": self.moments.scale}
            arrays |= named("observation.", moments)
        return arrays

    def policy(self) -> NetworkPolicy:
        """The current policy: a copy."""
        return NetworkPolicy(self.actor(), self.spec, self.config.activation)

    def state(self) -> dict[str, np.ndarray]:
        """All that the next update depends on: weights, Adam's moments and the generator."""
        arrays = {"weights": self.weights.values.copy(), "rng": generator_array(self._rng)}
        if self.moments is not None:
            arrays |= named("observations.", self.moments.arrays())
        return arrays | named("optimizer.", self.optimizer.arrays())

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` or `KeyError` unless it is whole."""
        values, weights = self.weights.values, state["weights"]
        if weights.shape != values.shape:
            raise ValueError(f"weights: expected {values.shape}, got {weights.shape}")
        values[...] = weights
        self.optimizer.load(part_of(state, "optimizer."))
        if self.moments is not None:
            self.moments.load(part_of(state, "observations."))
        set_generator(self._rng, state["rng"])
        self.terms = {}

    def start_from(self, kept: Checkpoint) -> None:
        """Take over the policy of another training with its normalisation, and a critic's weights.

        The noise begins anew, at `log_std`. Raises `ValueError` or `KeyError` unless they fit.
        """
        self._actor.net.weights.load(part_of(kept.actor, "layers."))
        weights = kept.state["weights"]
        if self.has_critic and weights.shape == self.weights.values.shape:
            critic = self._critic.weights.values
            critic[...] = weights[-critic.size :]
        if self.moments is not None:
            self.moments.load(part_of(kept.state, "observations."))

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, as in `docs/algorithms/README.md`; none before the first."""
        if not self.terms:
            return {}
        terms = dict(self.terms)
        numbers = {
            "train/policy_loss": -float(terms.pop("gain")),
            "train/entropy_loss": -float(terms.pop("entropy")),
            "train/learning_rate": float(self.rate),
            "train/n_updates": float(self.optimizer.steps),
        }
        if "values" in terms:
            targets = terms.pop("targets")
            spread = float(np.var(targets))
            left = float(np.var(targets - terms.pop("values")))
            numbers["train/explained_variance"] = 1 - left / spread if spread else np.nan
        numbers |= {f"train/{name}": float(value) for name, value in terms.items()}
        if self._actor.log_std is not None:
            numbers["train/std"] = float(np.exp(self._actor.log_std).mean())
        return numbers


def diverged(updates: int) -> Diverged:
    """The error of weights that are not finite after so many updates."""
    what = f"weights are not finite after update {updates}"
    return Diverged(f"training diverged: {what}; try a lower learning_rate")


def named(prefix: str, items: Mapping[str, Item]) -> dict[str, Item]:
    """The same with a prefix to every name."""
    return {prefix + name: item for name, item in items.items()}


def part_of(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """Those whose names begin so, without it."""
    return {k.removeprefix(prefix): array for k, array in arrays.items() if k.startswith(prefix)}


def seeds_of(seed: int) -> tuple[int, np.random.Generator]:
    """Seed of the weights and generator of the actions, independent of each other."""
    weights = np.random.SeedSequence(seed, spawn_key=(0,)).generate_state(1, np.uint64)[0]
    return int(weights), np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))


def generator_array(rng: np.random.Generator) -> np.ndarray:
    """State of a generator: JSON, as bytes."""
    return np.frombuffer(json.dumps(rng.bit_generator.state).encode(), np.uint8)


def set_generator(rng: np.random.Generator, array: np.ndarray) -> None:
    """Take over what `generator_array` gave. Raises `ValueError` or `TypeError` for another."""
    rng.bit_generator.state = json.loads(array.tobytes())
