"""Soft Actor-Critic: Haarnoja et al. 2018, arXiv 1812.05905, with an automatic temperature."""

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from ..models.errors import expect
from .checkpoints import Checkpoint
from .episodes import EpisodeLog
from .learner import (
    OnUpdate,
    diverged,
    generator_array,
    named,
    part_of,
    seeds_of,
    set_generator,
)
from .networks import MLP, Adam, Weights, mlp_shapes
from .policies import ActionMap, NetworkPolicy, flat_size
from .presets import SACConfig
from .rollouts import Collector, Rollout

_LOG_STD: Final = np.array([-20.0, 2.0], np.float32)
"""Least and greatest logarithm of a standard deviation, as in the authors' code."""
_SMALL: Final = 1e-6  # keeps the logarithm of 1 - tanh² finite, as there
_HALF_LOG_2_PI: Final = 0.5 * math.log(2 * math.pi)


class SquashedActor:
    """Policy a = tanh(u), u Gaussian: its net gives mean and log σ of u, k numbers each."""

    def __init__(self, weights: Weights, activation: str) -> None:
        self.weights, self.net = weights, MLP(weights, activation)
        self._kept: Any = None  # of `draw`, for `backward`

    def initialise(self, rng: np.random.Generator, log_std: float) -> None:
        """Last layer near zero: the first policy has the mean 0 and the same σ everywhere."""
        self.net.initialise(rng, 0.01)
        bias = list(self.weights.arrays.values())[-1]
        bias[len(bias) // 2 :] = log_std

    def draw(self, observations: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
        self._kept = spread, actions, slope, shifted, free
        return actions, logs.sum(axis=1)

    def backward(self, by_actions: np.ndarray, by_log_probability: float) -> None:
        """Set the gradients of a loss, from its derivatives by what `draw` gave last.

        The noise is held still: u = mean + σ · noise. log π moves with u by tanh alone, for the
        density of the Gaussian part at u depends on σ only.
        """
        spread, actions, slope, shifted, free = self._kept
        by_u = (by_actions + by_log_probability * 2 * actions / shifted) * slope
        by_log_std = (by_u * spread - by_log_probability) * free
        self.net.backward(np.concatenate([by_u, by_log_std], axis=1))


class ReplayBuffer:
    """The last transitions, one row each: (s, a, s', r, whether s' is an end). float32.

    A truncated episode's last row is no end: its value is bootstrapped from the true s'.
    """

    def __init__(self, capacity: int, observation: int, action: int) -> None:
        self.rows = np.zeros((capacity, 2 * observation + action + 2), np.float32)
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

    def take(self, places: np.ndarray) -> tuple[np.ndarray, ...]:
        """(s, a, s', r, ends) of some rows: shapes (B, n), (B, k), (B, n), (B,), (B,)."""
        rows = self.rows[places]
        return *(rows[:, part] for part in self._parts), rows[:, -2], rows[:, -1]


class SAC:
    """Two critics learn Q(s, a) of the soft return, the actor follows the smaller of both.

    An update is the paper's Algorithm 1 with the temperature of its section 5, in the order of the
    authors' code: temperature, critics, actor, targets. Each has its own Adam.

    Attributes:
        weights: Of all networks: `actor.…`, `critic.0.…`, `critic.1.…`, and `log_alpha`.
        targets: Of the critics' targets: `0.…`, `1.…`.
        buffer: The replay buffer.
        updates: Updates so far.
    """

    def __init__(self, log: EpisodeLog, config: SACConfig, seed: int) -> None:
        weights_seed, self._rng = seeds_of(seed)
        self.spec, self.config, self.updates = log.spec, config, 0
        actions, n = ActionMap(log.spec.action), flat_size(log.spec)
        expect(not actions.discrete, "sac", "an env of continuous actions", "one of choices")
        k = actions.outputs
        critic = mlp_shapes((n + k, *config.hidden, 1))
        twins = named("0.", critic) | named("1.", critic)
        shapes = named("actor.", mlp_shapes((n, *config.hidden, 2 * k)))
        shapes |= {**named("critic.", twins), "log_alpha": (1,)}
        self.weights, self.targets = Weights.zeros(shapes), Weights.zeros(twins)
        self._of_actor, self._of_critics, self._of_alpha = parts = [
            self.weights.part(prefix) for prefix in ("actor.", "critic.", "log_alpha")
        ]
        self._adams = dict(zip(("actor", "critic", "alpha"), map(Adam, parts), strict=True))
        self._actor = SquashedActor(self._of_actor, config.activation)
        self._critics, self._targets = (
            [MLP(whole.part(f"{i}."), config.activation) for i in range(2)]
            for whole in (self._of_critics, self.targets)
        )
        dice = np.random.default_rng(weights_seed)
        self._actor.initialise(dice, config.log_std)
        for net in self._critics:
            net.initialise(dice, 1.0)
        self.targets.values[:] = self._of_critics.values
        self._of_alpha.values[:] = math.log(config.alpha)
        self._aim = -float(k) if config.target_entropy is None else config.target_entropy
        self.rate = config.learning_rate
        self.buffer = ReplayBuffer(config.buffer_size, n, k)
        self._numbers: dict[str, float] = {}

    def train(self, log: EpisodeLog, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, from the current state on. Raises `Diverged`.

        Actions are uniform until `learning_starts` transitions are kept. From then on each
        `steps_per_update` env steps, rounded up to whole steps of all drones, are followed by
        `gradient_steps` updates.
        """
        collector, config = Collector(log, self._rng), self.config
        while (before := log.env_steps) < env_steps:
            explorer = _Explorer(None if self.warming_up else self._actor, self._k)
            most = min(config.steps_per_update, env_steps - before)
            self.buffer.add(collector.steps(explorer, most))  # type: ignore[arg-type]
            if config.anneal:
                self.rate = config.learning_rate * (1 - before / env_steps)
            if not self.warming_up:
                self.learn()
            if not on_update():
                return

    def learn(self) -> None:
        """Make `gradient_steps` updates, each from other transitions. Raises `Diverged`."""
        shape = self.config.gradient_steps, self.config.batch_size
        places = self._rng.integers(len(self.buffer), size=shape)
        noise = self._rng.standard_normal((2, *shape, self._k), dtype=np.float32)
        for i, some in enumerate(places):
            self.update(self.buffer.take(some), noise[0, i], noise[1, i])
        if not np.isfinite(self.weights.values).all():
            raise diverged(self.updates)

    @property
    def warming_up(self) -> bool:
        """Whether there are too few transitions to learn from."""
        return self.buffer.added < self.config.learning_starts

    @property
    def _k(self) -> int:
        return self.spec.action.size  # type: ignore[union-attr]  # never a choice

    def update(
        self, batch: tuple[np.ndarray, ...], noise: np.ndarray, next_noise: np.ndarray
    ) -> None:
        """Learn from a batch of `ReplayBuffer.take`; noise is standard normal, shape (B, k)."""
        config, rate, size = self.config, self.rate, len(noise)
        states, done, next_states, rewards, ends = batch
        alpha = math.exp(self._of_alpha.values[0])
        next_actions, next_logs = self._actor.draw(next_states, next_noise)
        actions, logs = self._actor.draw(states, noise)
        surplus = float(logs.mean()) + self._aim
        alpha_loss = -float(self._of_alpha.values[0]) * surplus
        self._of_alpha.slopes[:] = -surplus
        self._adams["alpha"].step(rate)

        ahead = np.minimum(*self._values(self._targets, next_states, next_actions))
        wanted = rewards + config.gamma * (1 - ends) * (ahead - np.float32(alpha) * next_logs)
        errors = [found - wanted for found in self._values(self._critics, states, done)]
        for net, error in zip(self._critics, errors, strict=True):
            net.backward(error[:, np.newaxis] / size)
        self._adams["critic"].step(rate)

        found = self._values(self._critics, states, actions)
        first = found[0] <= found[1]
        by_actions = np.zeros_like(actions)
        for net, chosen in zip(self._critics, (first, ~first), strict=True):
            slope = chosen[:, np.newaxis] * np.float32(-1 / size)
            by_actions += net.backward(slope, by_inputs=True)[:, states.shape[1] :]
        self._actor.backward(by_actions, alpha / size)
        self._adams["actor"].step(rate)
        self.targets.values[:] += config.tau * (self._of_critics.values - self.targets.values)
        self.updates += 1
        critic_loss = 0.5 * sum(float(error.dot(error)) for error in errors) / size
        actor_loss = float((alpha * logs - np.minimum(*found)).mean())
        self._numbers = {
            "train/actor_loss": actor_loss,
            "train/critic_loss": critic_loss,
            "train/ent_coef": alpha,
            "train/ent_coef_loss": alpha_loss,
            "train/entropy_loss": float(logs.mean()),
        }

    @staticmethod
    def _values(nets: list[MLP], states: np.ndarray, actions: np.ndarray) -> list[np.ndarray]:
        """Q of both critics, shape (B,) each."""
        inputs = np.concatenate([states, actions], axis=1)
        return [net.forward(inputs)[:, 0] for net in nets]

    def actor(self) -> dict[str, np.ndarray]:
        """Weights for `NetworkPolicy`, which squashes: the last layer gives the mean of u."""
        arrays = {name: array.copy() for name, array in self._of_actor.arrays.items()}
        for name in list(arrays)[-2:]:
            arrays[name] = arrays[name][: self._k].copy()
        return arrays

    def policy(self) -> NetworkPolicy:
        """The current policy, without exploration: a copy."""
        return NetworkPolicy(self.actor(), self.spec, self.config.activation, squash=True)

    def state(self) -> dict[str, np.ndarray]:
        """All that the next update depends on, with the transitions that are kept."""
        arrays = {"weights": self.weights.values.copy(), "targets": self.targets.values.copy(),
                  "rng": generator_array(self._rng), "updates": np.array(self.updates),
                  "buffer": self.buffer.rows[: len(self.buffer)].copy(),
                  "added": np.array(self.buffer.added)}  # fmt: skip
        for name, adam in self._adams.items():
            arrays |= named(f"optimizer.{name}.", adam.arrays())
        return arrays

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` or `KeyError` unless it is whole."""
        added = int(state["added"])
        pairs = {"weights": self.weights.values, "targets": self.targets.values,
                 "buffer": self.buffer.rows[: max(added, 0)]}  # fmt: skip
        for name, values in pairs.items():
            if state[name].shape != values.shape:
                raise ValueError(f"{name}: expected {values.shape}, got {state[name].shape}")
        for name, values in pairs.items():
            values[...] = state[name]
        self.buffer.added, self.updates = added, int(state["updates"])
        for name, adam in self._adams.items():
            adam.load(part_of(state, f"optimizer.{name}."))
        set_generator(self._rng, state["rng"])
        self._numbers = {}

    def start_from(self, kept: Checkpoint) -> None:
        """Take over the weights of another training; the buffer begins empty.

        Raises `ValueError` or `KeyError` unless they fit.
        """
        self.weights.values[...] = kept.state["weights"]
        self.targets.values[...] = self._of_critics.values

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update, under SB3's names; none before the first."""
        if not self._numbers:
            return {}
        counts = {"train/learning_rate": self.rate, "train/n_updates": float(self.updates)}
        return self._numbers | counts


class _Explorer:
    """Draws actions for a `Collector`: of the actor as it is now, or uniform without one."""

    def __init__(self, actor: SquashedActor | None, size: int) -> None:
        self._actor, self._size = actor, size

    def draw_noise(self, rng: np.random.Generator, steps: int) -> np.ndarray:
        """For so many rows of `sample`: shape (steps, k)."""
        shape = steps, self._size
        if self._actor is None:
            return rng.uniform(-1, 1, shape).astype(np.float32)
        return rng.standard_normal(shape, dtype=np.float32)

    def sample(self, observations: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Actions, shape (N, k), of flat observations, shape (N, n)."""
        return noise if self._actor is None else self._actor.draw(observations, noise)[0]
