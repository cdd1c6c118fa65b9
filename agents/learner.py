"""Base of the algorithms: fly, update, repeat; stop and resume at any update."""

import json
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ..models.errors import InputError
from .config import Config
from .episodes import EpisodeRecorder
from .networks import Floats, Weights, bind_all, check_shapes, make_network, named, part_of
from .normalization import Moments
from .optimizers import Adam
from .policies import NetworkPolicy, flat_size
from .rollouts import Collector, Diverged, Explorer, Rollout

if TYPE_CHECKING:
    from .checkpoints import Checkpoint

OnUpdate = Callable[[], bool]
"""Called after every rollout and its update; training stops where it returns False."""


class Learner:
    """Base of our own algorithms: fly, learn, repeat.

    Attributes:
        weights: Of all networks: `actor.…`, and of a critic `critic.…`.
        explorer: Draws the actions of a training.
        optimizer: Adam of the actor's weights, perhaps of others too.
        parts: What keeps a state of its own besides the weights, by name.
        memory: What the policy remembers of each drone, shape (N, m).
        rate: Learning rate of the next update.
        terms: Numbers of the last update.
    """

    weights: Weights
    explorer: Explorer
    optimizer: Adam
    parts: dict[str, Adam | Moments]

    def __init__(self, log: EpisodeRecorder, config: Config, seed: int) -> None:
        self.spec = log.spec
        self.config = config
        self._weights_seed, self._rng = seeds_of(seed)
        self.memory: Floats = np.zeros((log.num_envs, 0), np.float32)
        self.rate = config.learning_rate
        self.terms: dict[str, Any] = {}

    @abstractmethod
    def collect(self, collector: Collector, most: int) -> Rollout:
        """Fly at most `most` env steps for one update; an empty rollout makes no update."""

    @abstractmethod
    def learn(self, rollout: Rollout) -> None:
        """Learn from a rollout."""

    @abstractmethod
    def actor(self) -> dict[str, Floats]:
        """Weights of the policy, as a checkpoint has them: copies."""

    def train(self, log: EpisodeRecorder, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, from the current state on. Raises `Diverged`."""
        collector = Collector(log, self._rng, self.explorer, self.memory)
        while log.env_steps < env_steps:
            before = log.env_steps
            rollout = self.collect(collector, env_steps - before)
            if self.config.anneal:
                self.rate = self.config.learning_rate * (1 - before / env_steps)
            if len(rollout):
                with np.errstate(over="ignore", invalid="ignore"):  # Diverged is raised below
                    self.learn(rollout)
                if not np.isfinite(self.weights.values).all():
                    raise diverged(self.optimizer.steps)
            if not on_update():
                return

    def policy(self) -> NetworkPolicy:
        """The current policy, without exploration: a copy."""
        return NetworkPolicy.load(self.actor(), self.spec, self.config)

    def arrays(self) -> dict[str, np.ndarray]:
        """What the next update depends on, besides `parts` and the generator: no copies."""
        return {"weights": self.weights.values}

    def state(self) -> dict[str, np.ndarray]:
        """All that the next update depends on: copies."""
        arrays = {name: array.copy() for name, array in self.arrays().items()}
        for name, part in self.parts.items():
            arrays |= named(f"{name}.", part.arrays())
        return arrays | {"rng": generator_array(self._rng)}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` or `KeyError` unless it is whole."""
        for name, values in self.arrays().items():
            check_shapes(name, {name: state[name]}, {name: values.shape})
            values[...] = state[name]
        for name, part in self.parts.items():
            part.load(part_of(state, f"{name}."))
        set_generator(self._rng, state["rng"])
        self.terms = {}

    def losses(self) -> dict[str, float]:
        """Numbers of the last update by name."""
        return self.terms

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, as in `docs/algorithms/README.md`; none before the first."""
        if not self.terms:
            return {}
        numbers = self.losses() | {"learning_rate": self.rate, "n_updates": self.optimizer.steps}
        return {f"train/{name}": float(value) for name, value in numbers.items()}


class PolicyGradient(Learner):
    """Base of the algorithms that learn from what the current policy has just flown.

    Attributes:
        moments: Of the observations, where they are normalised; the observations of the next update
            have no part in them yet.
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

    def __init__(self, log: EpisodeRecorder, config: Config, seed: int) -> None:
        super().__init__(log, config, seed)
        self._actor = self.explorer = NetworkPolicy(log.spec, config)
        size = self._actor.network.memory
        if size and self.central:
            raise InputError("network: expected one without a memory for a central critic")
        self.memory = np.zeros((log.num_envs, size), np.float32)
        rng = np.random.default_rng(self._weights_seed)
        if self.has_critic:
            drones = len(log.spec.agents) if self.central else 1
            self._critic = make_network(flat_size(log.spec) * drones, 1, config)
            self.weights = bind_all({"actor.": self._actor, "critic.": self._critic})
        else:
            self.weights = bind_all({"actor.": self._actor})
        self._actor.initialise(rng, config.log_std)
        if self.has_critic:
            self._critic.initialise(rng, 1.0)
        self.optimizer = Adam(self.weights, self.epsilon)
        self.parts = {"optimizer": self.optimizer}
        self.moments = self._actor.moments
        if self.moments is not None:
            self.parts["observations"] = self.moments

    @abstractmethod
    def gradient(self, rollout: Rollout) -> None:
        """Set the gradients of the loss that one step of Adam lowers, and its `terms`."""

    def update(self, rollout: Rollout) -> None:
        """Move the weights: by one step of Adam."""
        self.gradient(rollout)
        self.optimizer.step(self.rate)

    def learn(self, rollout: Rollout) -> None:
        self.update(rollout)
        self._actor.head.clamp()
        if self.moments is not None:
            seen = rollout.rows(rollout.observations)
            self.moments.add(seen[:, : flat_size(self.spec)])

    def inputs(self, observations: Floats) -> Floats:
        """Observations as the networks take them: normalised, if the config says so."""
        return self._actor.inputs(observations)

    def actor(self) -> dict[str, Floats]:
        return self._actor.arrays()

    def arrays(self) -> dict[str, np.ndarray]:
        memory = {"memory": self.memory} if self.memory.size else {}
        return super().arrays() | memory

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

    def losses(self) -> dict[str, float]:
        terms = dict(self.terms)
        numbers = {"policy_loss": -terms.pop("gain"), "entropy_loss": -terms.pop("entropy")}
        if "values" in terms:
            targets = terms.pop("targets")
            spread = np.var(targets)
            left = np.var(targets - terms.pop("values"))
            numbers["explained_variance"] = 1 - float(left) / float(spread) if spread else np.nan
        deviations = self.weights.arrays.get("actor.log_std")
        if deviations is not None:
            numbers["std"] = np.exp(deviations).mean()
        return numbers | terms


def diverged(updates: int) -> Diverged:
    """The error of weights that are not finite after `updates` updates."""
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
