"""Base of the algorithms: fly, update, repeat; stop and resume at any update."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from ..envs.spec import EnvSpec
from ..models.errors import InputError
from .config import Config
from .episodes import EpisodeRecorder
from .networks import Floats, Network, Weights, make_network, named, part_of
from .normalization import Moments
from .optimizers import Adam
from .policies import NetworkPolicy, flat_size
from .rollouts import Collector, Diverged, Rollout

if TYPE_CHECKING:
    from .checkpoints import Checkpoint

OnUpdate = Callable[[], bool]
"""Called after every rollout and its update; training stops where it returns False."""


@dataclass(frozen=True)
class Networks:
    """What a learner moves."""

    weights: Weights
    """Of all networks: `actor.…`, and of a critic `critic.…`."""
    actor: NetworkPolicy
    critic: Network | None

    @classmethod
    def create(cls, spec: EnvSpec, config: Config, seed: int, critic_drones: int) -> Self:
        """New networks; the critic sees so many drones of a world, with 0 there is none."""
        actor = NetworkPolicy(spec, config)
        critic = None
        shapes = named("actor.", actor.shapes)
        if critic_drones:
            critic = make_network(flat_size(spec) * critic_drones, 1, config)
            shapes |= named("critic.", critic.shapes)
        weights = Weights.zeros(shapes)
        rng = np.random.default_rng(seed)
        actor.bind(weights.part("actor."))
        actor.initialise(rng, config.log_std)
        if critic is not None:
            critic.bind(weights.part("critic."))
            critic.initialise(rng, 1.0)
        return cls(weights, actor, critic)


class Learner:
    """Base of our own algorithms: `collect` and `gradient`, or `update`, are theirs.

    Attributes:
        weights: Of all networks: `actor.…`, and of a critic `critic.…`.
        optimizer: Adam of all weights.
        rate: Learning rate of the next update.
        moments: Of the observations, where they are normalised; the observations of the next update
            have no part in them yet.
        memory: What the policy remembers of each drone, shape (N, m).
        terms: Of the loss of the last update: `gain`, the mean of weight · log P, which the actor
            climbs; `entropy` of the policy, nats; and of a critic `value_loss`, the mean squared
            error of the values, with `values`, V(s_t) before the update, and their `targets`,
            shape (T,). Other terms are logged under their names.
    """

    epsilon: ClassVar[float] = 1e-8
    """Added by Adam to the root of the squares."""
    has_critic: ClassVar[bool] = False
    central: ClassVar[bool] = False
    """Whether the critic sees the observations of all drones of a world."""

    def __init__(
        self,
        networks: Networks,
        config: Config,
        rng: np.random.Generator,
        memory: Floats,
    ) -> None:
        self.spec = networks.actor.spec
        self.config = config
        self._rng = rng
        self.weights = networks.weights
        self._actor = networks.actor
        self.memory = memory
        if networks.critic is not None:
            self._critic = networks.critic
        self.optimizer = Adam(self.weights, self.epsilon)
        self.rate = config.learning_rate
        normalised = config.normalize_observations
        self.moments = Moments(flat_size(self.spec)) if normalised else None
        self.terms: dict[str, Any] = {}

    @classmethod
    def create(cls, log: EpisodeRecorder, config: Config, seed: int) -> Self:
        """A new agent, with networks of the kind that the config names, for the env of a log."""
        weights_seed, rng = seeds_of(seed)
        drones = len(log.spec.agents) if cls.central else int(cls.has_critic)
        networks = Networks.create(log.spec, config, weights_seed, drones)
        size = networks.actor.network.memory
        if size and cls.central:
            raise InputError("network: expected one without a memory for a central critic")
        return cls(networks, config, rng, np.zeros((log.num_envs, size), np.float32))

    def collect(self, collector: Collector, most: int) -> Rollout:
        """Fly for one update, at most so many env steps; an empty rollout makes none."""
        raise NotImplementedError

    def gradient(self, rollout: Rollout) -> None:
        """Set the gradients of the loss that one step of Adam lowers, and its `terms`."""
        raise NotImplementedError

    def update(self, rollout: Rollout) -> None:
        """Learn from a rollout: by one step of Adam."""
        self.gradient(rollout)
        self.optimizer.step(self.rate)

    def train(self, log: EpisodeRecorder, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, from the current state on. Raises `Diverged`."""
        collector = Collector(log, self._rng, self._actor, self.memory)
        while log.env_steps < env_steps:
            before = log.env_steps
            rollout = self.collect(collector, env_steps - before)
            if self.config.anneal:
                self.rate = self.config.learning_rate * (1 - before / env_steps)
            if len(rollout):
                with np.errstate(over="ignore", invalid="ignore"):  # Diverged is raised below
                    self.update(rollout)
                self._after_update(rollout)
            if not on_update():
                return

    def _after_update(self, rollout: Rollout) -> None:
        if self._actor.head is not None:
            self._actor.head.clamp()
        if self.moments is not None:
            seen = rollout.rows(rollout.observations)
            self.moments.add(seen[:, : flat_size(self.spec)])
            self._take_moments()
        if not np.isfinite(self.weights.values).all():
            raise diverged(self.optimizer.steps)

    def _take_moments(self) -> None:
        if self.moments is not None and self._actor.normaliser is not None:
            self._actor.normaliser.mean = self.moments.mean
            self._actor.normaliser.scale = self.moments.scale

    def inputs(self, observations: Floats) -> Floats:
        """Observations as the networks take them: normalised, if the config says so."""
        return self._actor.inputs(observations)

    def actor(self) -> dict[str, Floats]:
        """Weights of the policy, as a checkpoint has them: copies."""
        return self._actor.arrays()

    def policy(self) -> NetworkPolicy:
        """The current policy: a copy."""
        return NetworkPolicy.load(self.actor(), self.spec, self.config)

    def state(self) -> dict[str, np.ndarray]:
        """All that the next update depends on: weights, Adam's moments and the generator."""
        arrays = {"weights": self.weights.values.copy(), "rng": generator_array(self._rng)}
        if self.memory.size:
            arrays["memory"] = self.memory.copy()
        if self.moments is not None:
            arrays |= named("observations.", self.moments.arrays())
        return arrays | named("optimizer.", self.optimizer.arrays())

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` or `KeyError` unless it is whole."""
        arrays = {"weights": self.weights.values}
        if self.memory.size:
            arrays["memory"] = self.memory
        for name, values in arrays.items():
            if state[name].shape != values.shape:
                raise ValueError(f"{name}: expected {values.shape}, got {state[name].shape}")
            values[...] = state[name]
        self.optimizer.load(part_of(state, "optimizer."))
        if self.moments is not None:
            self.moments.load(part_of(state, "observations."))
            self._take_moments()
        set_generator(self._rng, state["rng"])
        self.terms = {}

    def start_from(self, kept: "Checkpoint") -> None:
        """Take over the policy of another training with its normalisation, and a critic's weights.

        The noise begins anew, at `log_std`. Raises `ValueError` or `KeyError` unless they fit.
        """
        own = self.weights.part("actor.").arrays
        own |= {name: array for name, array in kept.actor.items() if name.startswith("layers.")}
        self.weights.part("actor.").load(own)
        weights = kept.state["weights"]
        if self.has_critic and weights.shape == self.weights.values.shape:
            critic = self.weights.part("critic.").values
            critic[...] = weights[-critic.size :]
        if self.moments is not None:
            self.moments.load(part_of(kept.state, "observations."))
            self._take_moments()

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
        deviations = self.weights.arrays.get("actor.log_std")
        if deviations is not None:
            numbers["train/std"] = float(np.exp(deviations).mean())
        return numbers


def diverged(updates: int) -> Diverged:
    """The error of weights that are not finite after so many updates."""
    reason = f"weights are not finite after update {updates}"
    return Diverged(f"training diverged: {reason}; try a lower learning_rate")


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
