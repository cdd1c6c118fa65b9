"""Advantage Actor-Critic: the paper's Algorithm 2, Equation 3."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..models.fields import Limits
from .config import RolloutConfig
from .learner import Learner
from .networks import Floats
from .rollouts import Collector, Mask, Numbers, Rollout, advantages


@dataclass(frozen=True, kw_only=True)
class A2CConfig(RolloutConfig):
    """Advantage Actor-Critic (paper, section 2.3, Algorithm 2). Defaults: the paper's setting.

    Serves our A2C and Stable-Baselines3's.
    """

    gae_lambda: Annotated[float, Limits(0.0, 1.0)] = 0.0
    """Lambda of generalised advantage estimation; 0 is the paper's Equation 3."""
    normalize: bool = False
    """Shift and scale the advantages of an update to mean 0 and standard deviation 1."""
    vf_coef: Annotated[float, Limits(0.0)] = 0.5
    """Weight of the squared error of the value."""
    ent_coef: Annotated[float, Limits(0.0)] = 0.0
    """Weight of the policy's entropy."""


class A2C(Learner):
    """Two networks: the critic learns V(s), the actor follows the advantage.

    Algorithm 2 weighs the actor's gradient by Q in step 3; the text and Equation 3 by A, as here.
    The critic descends the squared error to r + gamma · V(s'), held still, which is step 5.
    """

    config: A2CConfig
    has_critic = True

    def collect(self, collector: Collector, most: int) -> Rollout:
        """Fly a fixed number of steps, across episodes."""
        return collector.steps(min(self.config.steps_per_update, most))

    def gradient(self, rollout: Rollout) -> None:
        """Of minus the mean of A · log P, plus the weighted squared error of the value."""
        config = self.config
        observations = rollout.rows(rollout.observations)
        advantage = rollout.rows(self.advantages(rollout)[0]).astype(np.float32)
        values = self._critic.forward(observations)[:, 0]
        targets = values + advantage
        if config.normalize and len(advantage) > 1:
            advantage = (advantage - advantage.mean()) / (advantage.std(ddof=1) + 1e-8)
        log_probability, entropy = self._actor.score(observations, rollout.rows(rollout.actions))
        self._actor.backward(-advantage / len(advantage), -config.ent_coef)
        errors = values - targets
        self._critic.backward((2 * config.vf_coef / len(errors) * errors)[:, np.newaxis])
        gain = (log_probability * advantage).mean()
        value_loss = (errors * errors).mean()
        self.terms = {"gain": gain, "entropy": entropy, "value_loss": value_loss}
        self.terms |= {"values": values, "targets": targets}

    def advantages(self, rollout: Rollout) -> tuple[Numbers, Numbers, Floats]:
        """A_t and V(s_t) of every row, shape (T, N), and the inputs of the critic for them."""
        seen = self.seen(rollout.observations, rollout.kept)
        after = self.seen(rollout.next_observations, rollout.kept & ~rollout.terminated)
        values = self._values(seen)
        following = np.empty_like(values)
        following[:-1] = values[1:]
        # The next row has the same observation, unless an episode ends between them.
        new = rollout.ends.copy()
        new[-1] = True
        following[new] = self._values(after[new])
        estimates = advantages(
            rollout.rewards,
            values,
            following,
            rollout.terminated,
            rollout.truncated,
            gamma=self.config.gamma,
            gae_lambda=self.config.gae_lambda,
        )
        return estimates, values, seen

    def seen(self, observations: Floats, flying: Mask) -> Floats:
        """Inputs of the critic, shape (T, N, m), from observations (T, N, n): here the same.

        Of drones that are not `flying`, bool, shape (T, N), another drone may not learn.
        """
        return observations

    def _values(self, seen: Floats) -> Numbers:
        """V(s), shape (...), of inputs of the critic, shape (..., m)."""
        *lead, size = seen.shape
        values = self._critic.forward(seen.reshape(-1, size))
        return values.reshape(lead).astype(np.float64)
