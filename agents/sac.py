"""Soft Actor-Critic: Haarnoja et al. 2018, arXiv 1812.05905, with an automatic temperature."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError
from ..models.fields import Limits
from .config import RolloutConfig
from .episodes import EpisodeRecorder
from .learner import Learner
from .networks import Floats, Module, Network, Weights, bind_all, make_network
from .optimizers import Adam
from .policies import ActionMap, flat_size
from .rollouts import Collector, Rollout

if TYPE_CHECKING:
    from .checkpoints import Checkpoint

_LOG_STD: Final = np.array([-20.0, 2.0], np.float32)
"""Least and greatest logarithm of a standard deviation, as in the authors' code."""
_SMALL: Final = 1e-6  # keeps the logarithm of 1 - tanh² finite, as there
_HALF_LOG_2_PI: Final = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True, kw_only=True)
class SACConfig(RolloutConfig):
    """Soft Actor-Critic (Haarnoja et al. 2018, arXiv 1812.05905). Defaults: its Table 1.

    Serves our SAC and Stable-Baselines3's.
    """

    squashed: ClassVar[bool] = True
    hidden: tuple[int, ...] = (256, 256)
    """Units of each hidden layer of each network."""
    learning_rate: float = 0.0003
    """Of Adam: actor, critics and temperature."""
    gradient_steps: Annotated[int, Limits(1, whole=True)] = 1
    """Updates after each `steps_per_update` env steps."""
    batch_size: Annotated[int, Limits(1, whole=True)] = 256
    """Transitions of an update, drawn from the buffer."""
    buffer_size: Annotated[int, Limits(1, whole=True)] = 1_000_000
    """Transitions that are kept; a checkpoint has them."""
    learning_starts: Annotated[int, Limits(1, whole=True)] = 1_000
    """Transitions of uniform actions before the first update. Table 1 has none."""
    tau: Annotated[float, Limits(0.0, 1.0, above=True)] = 0.005
    """Share of the critics that their targets take over in each update."""
    alpha: Annotated[float, Limits(0.0, 1e30, above=True)] = 1.0
    """Temperature at the beginning. Table 1 has none."""
    target_entropy: float | None = None
    """Entropy that the temperature aims at, nats; null: minus the number of actions."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.buffer_size < self.learning_starts:
            raise InputError(
                f"buffer_size: expected learning_starts ({self.learning_starts}) or more, "
                f"got {self.buffer_size}"
            )
        if self.normalize_observations:
            raise InputError("normalize_observations: expected false with SAC, got true")


class SquashedActor:
    """Policy a = tanh(u), u Gaussian: its net gives mean and log σ of u, k numbers each."""

    def __init__(self, net: Network) -> None:
        self.net = net
        self.shapes = net.shapes

    def bind(self, weights: Weights) -> None:
        """Compute with these arrays from now on."""
        self.weights = weights
        self.net.bind(weights)

    def initialise(self, rng: np.random.Generator, log_std: float) -> None:
        """Last layer near zero: the first policy has the mean 0 and the same σ everywhere."""
        self.net.initialise(rng, 0.01)
        bias = list(self.weights.arrays.values())[-1]
        bias[len(bias) // 2 :] = log_std

    def draw(self, observations: Floats, noise: Floats) -> tuple[Floats, Floats]:
        """Actions (B, k) of standard normal noise (B, k), and log π(a | s), shape (B,)."""
        output = self.net.forward(observations)
        size = output.shape[1] // 2
        log_std = np.clip(output[:, size:], *_LOG_STD)
        spread = np.exp(log_std) * noise
        actions = np.tanh(output[:, :size] + spread)
        slope = 1 - actions * actions  # of tanh
        shifted = slope + np.float32(_SMALL)
        logs = -0.5 * noise * noise - log_std - np.float32(_HALF_LOG_2_PI) - np.log(shifted)
        free = log_std == output[:, size:]
        self.kept = spread, actions, slope, shifted, free
        return actions, logs.sum(axis=1)

    def backward(self, by_actions: Floats, by_log_probability: float) -> None:
        """Set the gradients of a loss, from its derivatives by what `draw` gave last.

        The noise is held still: u = mean + σ · noise. log π moves with u by tanh alone, for the
        density of the Gaussian part at u depends on σ only.
        """
        spread, actions, slope, shifted, free = self.kept
        by_u = (by_actions + by_log_probability * 2 * actions / shifted) * slope
        by_log_std = (by_u * spread - by_log_probability) * free
        self.net.backward(np.concatenate([by_u, by_log_std], axis=1))


class ReplayBuffer:
    """The last transitions, one row each: (s, a, s', r, whether s' is an end). float32.

    A truncated episode's last row is no end: its value is bootstrapped from the true s'.
    """

    def __init__(self, capacity: int, observation: int, action: int) -> None:
        self.rows = np.zeros((capacity, 2 * observation + action + 2), np.float32)
        self.action = action
        self.added = 0
        """Transitions since the beginning."""
        n, k = observation, action
        self._parts = slice(n), slice(n, n + k), slice(n + k, 2 * n + k)

    def __len__(self) -> int:
        return min(self.added, len(self.rows))

    def add(self, rollout: Rollout) -> None:
        """Keep the transitions of a rollout, in place of the oldest."""
        numbers = rollout.rewards[..., np.newaxis], rollout.terminated[..., np.newaxis]
        columns = rollout.observations, rollout.actions, rollout.next_observations, *numbers
        rows = np.concatenate([rollout.rows(column) for column in columns], axis=1)
        places = np.arange(self.added, self.added + len(rows)) % len(self.rows)
        self.rows[places] = rows
        self.added += len(rows)

    def take(self, places: NDArray[np.int64]) -> tuple[Floats, ...]:
        """(s, a, s', r, ends) of some rows: shapes (B, n), (B, k), (B, n), (B,), (B,)."""
        rows = self.rows[places]
        parts = [rows[:, part] for part in self._parts]
        return *parts, rows[:, -2], rows[:, -1]


class SAC(Learner):
    """Two critics learn Q(s, a) of the soft return, the actor follows the smaller of both.

    An update is the paper's Algorithm 1 with the temperature of its section 5, in the order of the
    authors' code: temperature, critics, actor, targets. Each has its own Adam.

    Attributes:
        weights: Of all networks: `actor.…`, `critic.0.…`, `critic.1.…`, and `log_alpha`.
        targets: Of the critics' targets: `0.…`, `1.…`.
        buffer: The replay buffer.
        k: Numbers of an action.
    """

    config: SACConfig

    def __init__(self, log: EpisodeRecorder, config: SACConfig, seed: int) -> None:
        super().__init__(log, config, seed)
        actions = ActionMap(log.spec.action)
        if actions.discrete:
            raise InputError("sac: expected an env of continuous actions, got one of choices")
        size = flat_size(log.spec)
        self.k = actions.outputs
        self.network = make_network(size, 2 * self.k, config)
        if self.network.memory:
            raise InputError(f"network: expected one without a memory, got {config.network}")
        self.explorer = self
        self.buffer = ReplayBuffer(config.buffer_size, size, self.k)
        self._actor = SquashedActor(self.network)
        nets = [make_network(size + self.k, 1, config) for _ in range(4)]
        self._critics = nets[:2]
        self._targets = nets[2:]
        modules: dict[str, Module] = {
            "actor.": self._actor,
            "critic.0.": nets[0],
            "critic.1.": nets[1],
        }
        self.weights = bind_all(modules, log_alpha=(1,))
        self.targets = bind_all({"0.": nets[2], "1.": nets[3]})
        rng = np.random.default_rng(self._weights_seed)
        self._actor.initialise(rng, config.log_std)
        for critic in self._critics:
            critic.initialise(rng, 1.0)
        self._of_critics = self.weights.part("critic.")
        self._of_alpha = self.weights.part("log_alpha")
        self._of_alpha.values[:] = math.log(config.alpha)
        self.targets.values[:] = self._of_critics.values
        self.optimizer = Adam(self._actor.weights)
        self._critic_adam = Adam(self._of_critics)
        self._alpha_adam = Adam(self._of_alpha)
        self.parts = {
            "optimizer.actor": self.optimizer,
            "optimizer.critic": self._critic_adam,
            "optimizer.alpha": self._alpha_adam,
        }
        aim = config.target_entropy
        self._aim = -float(self.k) if aim is None else aim

    def collect(self, collector: Collector, most: int) -> Rollout:
        """Fly a fixed number of steps, across episodes."""
        return collector.steps(min(self.config.steps_per_update, most))

    def learn(self, rollout: Rollout) -> None:
        """Keep the transitions; once `learning_starts` of them are kept, learn from the buffer."""
        self.buffer.add(rollout)
        if not self.warming_up:
            self.replay()

    def replay(self) -> None:
        """Make `gradient_steps` updates, each from other transitions."""
        shape = self.config.gradient_steps, self.config.batch_size
        places = self._rng.integers(len(self.buffer), size=shape)
        noise = self._rng.standard_normal((2, *shape, self.k), dtype=np.float32)
        for i, some in enumerate(places):
            self.update(self.buffer.take(some), noise[0, i], noise[1, i])

    @property
    def warming_up(self) -> bool:
        """Whether there are too few transitions to learn from: actions are uniform."""
        return self.buffer.added < self.config.learning_starts

    def draw_noise(self, rng: np.random.Generator, steps: int) -> Floats:
        """As `Explorer.draw_noise`."""
        shape = steps, self.k
        if self.warming_up:
            return rng.uniform(-1, 1, shape).astype(np.float32)
        return rng.standard_normal(shape, dtype=np.float32)

    def sample(self, observations: Floats, noise: Floats) -> Floats:
        """As `Explorer.sample`."""
        return noise if self.warming_up else self._actor.draw(observations, noise)[0]

    def update(self, batch: tuple[Floats, ...], noise: Floats, next_noise: Floats) -> None:
        """Learn from a batch of `ReplayBuffer.take`; noise is standard normal, shape (B, k)."""
        config = self.config
        rate = self.rate
        size = len(noise)
        states, done, next_states, rewards, ends = batch
        alpha = math.exp(self._of_alpha.values[0])
        next_actions, next_logs = self._actor.draw(next_states, next_noise)
        actions, logs = self._actor.draw(states, noise)
        surplus = float(logs.mean()) + self._aim
        alpha_loss = -float(self._of_alpha.values[0]) * surplus
        self._of_alpha.slopes[:] = -surplus
        self._alpha_adam.step(rate)

        ahead = np.minimum(*self._values(self._targets, next_states, next_actions))
        wanted = rewards + config.gamma * (1 - ends) * (ahead - np.float32(alpha) * next_logs)
        errors = [found - wanted for found in self._values(self._critics, states, done)]
        for net, error in zip(self._critics, errors, strict=True):
            net.backward(error[:, np.newaxis] / size)
        self._critic_adam.step(rate)

        found = self._values(self._critics, states, actions)
        first = found[0] <= found[1]
        by_actions = np.zeros_like(actions)
        for net, chosen in zip(self._critics, (first, ~first), strict=True):
            slope = chosen[:, np.newaxis] * np.float32(-1 / size)
            by_actions += net.by_inputs(slope)[:, states.shape[1] :]
        self._actor.backward(by_actions, alpha / size)
        self.optimizer.step(rate)
        self.targets.values[:] += config.tau * (self._of_critics.values - self.targets.values)
        critic_loss = 0.5 * sum(float(error.dot(error)) for error in errors) / size
        actor_loss = (alpha * logs - np.minimum(*found)).mean()
        self.terms = {
            "actor_loss": actor_loss,
            "critic_loss": critic_loss,
            "ent_coef": alpha,
            "ent_coef_loss": alpha_loss,
            "entropy_loss": logs.mean(),
        }

    @staticmethod
    def _values(nets: list[Network], states: Floats, actions: Floats) -> list[Floats]:
        """Q of both critics, shape (B,) each."""
        inputs = np.concatenate([states, actions], axis=1)
        return [net.forward(inputs)[:, 0] for net in nets]

    def actor(self) -> dict[str, Floats]:
        """Weights for `NetworkPolicy`, which squashes: the last layer gives the mean of u."""
        arrays = {name: array.copy() for name, array in self._actor.weights.arrays.items()}
        for name in list(arrays)[-2:]:
            arrays[name] = arrays[name][: self.k].copy()
        return arrays

    def arrays(self) -> dict[str, np.ndarray]:
        kept = self.buffer.rows[: len(self.buffer)]
        return {**super().arrays(), "targets": self.targets.values, "buffer": kept}

    def state(self) -> dict[str, np.ndarray]:
        return {**super().state(), "added": np.array(self.buffer.added)}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        self.buffer.added = int(state["added"])
        super().set_state(state)

    def start_from(self, kept: "Checkpoint") -> None:
        """Take over the weights of another training; the buffer begins empty.

        Raises `ValueError` or `KeyError` unless they fit.
        """
        self.weights.values[...] = kept.state["weights"]
        self.targets.values[...] = self._of_critics.values
