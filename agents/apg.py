"""Analytic policy gradients: the derivative of the reward itself, through the physics.

Back-propagation through time, as in Wiedemann et al., ICRA 2023, arXiv 2209.13052, without a value
function. It needs the derivative of the env's step, which compiled code in this process has.
"""

import numpy as np

from ..envs.compiled import CompiledLoop
from ..models.errors import InputError
from ..models.fields import PositiveInt, immutable
from .config import Config, Positive
from .episodes import EpisodeRecorder
from .layers import Floats
from .learner import Learner
from .optimizers import clip_norm
from .rollouts import Collector, Rollout


@immutable
class APGConfig(Config):
    """Analytic policy gradients. Defaults are ours."""

    horizon: PositiveInt = 80
    """Steps of each drone in an update, through which it differentiates."""
    max_grad_norm: Positive = 1.0
    """The gradient, as one vector, is scaled down to this length."""

    remembers = False


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
                "apg: expected continuous actions and an env that is compiled, in this process "
                "(--backend rigid --no-udp), got another one"
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
        output[...] = rollout.rows(self.slopes(rollout)).T
        self._both.learn(outputs)
        clip_norm(self.weights.slopes, self.config.max_grad_norm)
        self.terms = {"gain": rollout.rows(rollout.rewards).mean(), "entropy": entropy}

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
        by_observations = np.zeros((self._drones, network.inputs), np.float32)
        for step in reversed(range(steps)):
            drawn = rollout.actions[step]
            sent = actions.to_envs(drawn)
            slope = self._derivative.back(
                self._tape[step], sent, by_rewards[step], by_observations, ended[step]
            )
            slope *= actions.half
            slope[sent != actions.middle + actions.half * drawn] = 0.0  # it was clipped
            slopes[step] = slope
            network.forward(rollout.observations[step].T)
            by_observations = network.back(slope.T).T
        return slopes
