"""Analytic policy gradients: the derivative of the reward itself, through the physics.

Back-propagation through time: without a value function as in Wiedemann et al., ICRA 2023, arXiv
2209.13052, and with one as in Xu et al., ICLR 2022, arXiv 2204.07137. It needs the derivative of
the env's step, which compiled code in this process has.
"""

import numpy as np

from ..envs.compiled import CompiledLoop
from ..models.errors import InputError
from ..models.fields import PositiveInt, immutable
from .config import Config, Positive, Share
from .episodes import EpisodeRecorder
from .layers import Floats, Weights, named
from .learner import Learner
from .networks import make_network
from .optimizers import Adam, clip_norm
from .rollouts import Collector, Numbers, Rollout, advantages


@immutable
class APGConfig(Config):
    """Analytic policy gradients. Defaults are ours."""

    horizon: PositiveInt = 80
    """Steps of each drone in an update, through which it differentiates."""
    max_grad_norm: Positive = 1.0
    """The gradient, as one vector, is scaled down to this length."""
    most_of_one: Positive | None = None
    """Bound of one drone's derivatives by its actions: their norm is at most this many times the
    median of all drones, because those of a craft that is hard to hold grow with every step. A
    drone with one that is not finite counts as 0. Null: no bound.
    """

    remembers = False

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("anneal_clip", "squashed"):
            if getattr(self, name):
                raise InputError(f"{name}: expected false with the derivative of rewards, got true")


class APG(Learner):
    """Climb the discounted rewards of short flights, by their derivative.

    A flight begins where the last one ended. An action counts with all that follows from it until
    the flight or the episode ends, through the policy's later actions too. What rays and pictures
    show counts as given, and privileged arrays, which are for a critic, are skipped.
    """

    config: APGConfig

    def __init__(self, log: EpisodeRecorder, config: APGConfig, seed: int) -> None:
        super().__init__(log, config, seed)
        loop = getattr(log.env, "loop", None)
        machine = loop.machine() if isinstance(loop, CompiledLoop) else None
        if machine is None or not machine.is_whole or log.actions.discrete:
            raise InputError(
                f"{type(self).__name__.lower()}: expected continuous actions and an env that is "
                "compiled, in this process (--backend rigid --no-udp), got another one"
            )
        self._drones = log.num_envs
        self._machine = machine
        self._derivative = machine.derivative()

    def collect(self, collector: Collector, most: int) -> Rollout:
        """Fly `horizon` steps of all drones, and keep what derivatives need."""
        machine = self._machine
        machine.tape = []
        rollout = collector.steps(min(most, self.config.horizon * self._drones))
        self._tape = machine.tape
        machine.tape = None
        return rollout

    def gradient(self, rollout: Rollout) -> None:
        """Of minus the mean of the discounted rewards."""
        (output,) = outputs = self._both.forward(rollout.rows(rollout.observations).T)
        _, entropy = self._actor.head.score(output, rollout.rows(rollout.actions).T)
        self.terms = {"gain": rollout.rows(rollout.rewards).mean(), "entropy": entropy}
        output[...] = rollout.rows(self.slopes(rollout)).T
        self._both.learn(outputs)
        clip_norm(self.weights.slopes, self.config.max_grad_norm)

    def slopes(self, rollout: Rollout) -> Floats:
        """Derivatives of minus the mean of the discounted rewards by drawn actions, (T, N, k)."""
        config = self.config
        actions = self._actor.actions
        network = self._actor.network
        steps = len(rollout.actions)
        weights = config.gamma ** np.arange(steps) * (-config.reward_scale / len(rollout))
        by_rewards = weights[:, np.newaxis] * rollout.kept
        if config.reward_clip is not None:
            by_rewards *= np.abs(rollout.rewards) < config.reward_clip
        worlds = rollout.ends.reshape(steps, -1, len(self.spec.agents))
        ended = np.asarray(worlds.all(axis=2))
        ended[-1] = True
        slopes = np.zeros_like(rollout.actions)
        by_observations = self.beyond(rollout)
        for step in reversed(range(steps)):
            drawn = rollout.actions[step]
            sent = actions.to_envs(drawn)
            slope = self._derivative.back(
                self._tape[step], sent, by_rewards[step], by_observations[step], ended[step]
            )
            slope *= actions.half
            slope[sent != actions.middle + actions.half * drawn] = 0.0  # it was clipped
            slopes[step] = slope
            if step:
                network.forward(rollout.observations[step].T)
                goes_on = ~rollout.ends[step - 1, :, np.newaxis]
                by_observations[step - 1] += goes_on * network.back(slope.T).T
        if config.most_of_one:
            self._bound(slopes, config.most_of_one)
        return slopes

    def _bound(self, slopes: Floats, most_of_one: float) -> None:
        """Scale each drone's slopes (T, N, k) down, as `most_of_one` says."""
        sizes = np.sqrt(np.square(slopes).sum(axis=(0, 2)))
        fine = np.isfinite(sizes)
        if not fine.any():  # training diverged, which is raised later
            return
        most = most_of_one * np.median(sizes[fine])
        large = fine & (sizes > most)
        slopes[:, large] *= (most / sizes[large])[:, np.newaxis]
        slopes[:, ~fine] = 0.0
        self.terms["bounded"] = np.mean(large | ~fine)

    def beyond(self, rollout: Rollout) -> Floats:
        """Derivatives of the loss of what follows the rollout, by what an actor observes after each
        step, (T, N, n).
        """
        steps, drones = rollout.kept.shape
        return np.zeros((steps, drones, self._actor.network.inputs), np.float32)


@immutable
class SHACConfig(APGConfig):
    """Short-horizon actor-critic (Xu et al. 2022). Defaults: where it says so, theirs."""

    horizon: int = 32
    """Steps of each drone in an update, through which it differentiates (Xu et al.)."""
    gae_lambda: Share = 0.95
    """Lambda of the values that the critic learns (Xu et al.)."""
    critic_learning_rate: Positive | None = None
    """Of the critic's weights; null: the same."""
    epochs: PositiveInt = 2
    """Passes of the critic over a rollout."""
    minibatches: PositiveInt = 4
    """Parts of a rollout, each for one step of the critic."""


class SHAC(APG):
    """Short-horizon actor-critic: a flight that goes on counts with its value.

    The critic descends the squared error to TD(λ), after the actor's gradient. Not as in the
    article: it has no target network, Adam has its usual constants, the noise stays as large, and
    an episode may end at any step of a rollout, where powers of gamma run on.
    """

    config: SHACConfig

    def __init__(self, log: EpisodeRecorder, config: SHACConfig, seed: int) -> None:
        super().__init__(log, config, seed)
        self._critic = make_network(self._actor.spec.observation, 1, config)
        self._critic_weights = Weights.zeros(self._critic.shapes)
        self._critic.bind(self._critic_weights)
        self._critic.initialise(self._rng, 1.0)
        self._critic_optimizer = Adam(self._critic_weights, self.epsilon)
        self._arrays["critic"] = self._critic_weights.values
        self._arrays |= named("critic.optimizer.", self._critic_optimizer.state)

    def gradient(self, rollout: Rollout) -> None:
        """That of APG, with values; then the critic learns."""
        super().gradient(rollout)
        config = self.config
        values = self._values(rollout.observations)
        found = advantages(
            rollout.rewards,
            values,
            self._values(rollout.next_observations),
            rollout.terminated,
            rollout.truncated,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
        )
        seen = rollout.rows(rollout.observations)
        targets = rollout.rows((values + found).astype(np.float32))
        self.terms |= {"values": rollout.rows(values), "targets": targets}
        own_rate = config.critic_learning_rate or config.learning_rate
        rate = self.rate * own_rate / config.learning_rate
        for _ in range(config.epochs):
            order = self._rng.permutation(len(targets))
            for chosen in np.array_split(order, min(config.minibatches, len(order))):
                errors = self._critic.forward(seen[chosen].T) - targets[chosen]
                self.terms["value_loss"] = np.square(errors).mean()
                errors *= 2 / len(chosen)
                self._critic.learn(errors)
                clip_norm(self._critic_weights.slopes, config.max_grad_norm)
                self._critic_optimizer.step(rate)

    def beyond(self, rollout: Rollout) -> Floats:
        """Of the value where a flight goes on, after the last step and after a truncation."""
        config = self.config
        self._values(rollout.next_observations)
        steps, drones = rollout.kept.shape
        slopes = self._critic.back(np.ones((1, steps * drones), np.float32)).T
        slopes = slopes.reshape(steps, drones, -1)
        goes_on = rollout.truncated.copy()
        goes_on[-1] = True
        goes_on &= rollout.kept & ~rollout.terminated
        weights = config.gamma ** np.arange(1, steps + 1) * (-1 / len(rollout))
        by_after = slopes * (weights[:, np.newaxis] * goes_on)[..., np.newaxis]
        return by_after.astype(np.float32)

    def _values(self, observations: Floats) -> Numbers:
        """V of observations (T, N, n), (T, N)."""
        *lead, size = observations.shape
        values = self._critic.forward(observations.reshape(-1, size).T)
        return values.reshape(lead).astype(np.float64)
