"""Advantage Actor-Critic: the paper's Algorithm 2, Equation 3."""

import numpy as np

from .learner import Learner
from .networks import Critic, nn, torch
from .policies import NetworkPolicy, flat_size
from .presets import A2CConfig
from .rollouts import Collector, Rollout, advantages


class A2C(Learner):
    """Two networks: the critic learns V(s), the actor follows the advantage.

    Algorithm 2 weighs the actor's gradient by Q in step 3; the text and Equation 3 by A, as here.
    The critic descends the squared error to r + gamma · V(s'), held still, which is step 5.
    """

    config: A2CConfig

    def others(self) -> dict[str, nn.Module]:
        """The critic."""
        self._critic = Critic(flat_size(self.spec), hidden=self.config.hidden)
        return {"critic": self._critic}

    def collect(self, collector: Collector, policy: NetworkPolicy, most: int) -> Rollout:
        """Fly a fixed number of steps, across episodes."""
        return collector.steps(policy, min(self.config.steps_per_update, most))

    def loss(self, rollout: Rollout) -> torch.Tensor:
        """Minus the mean of A · log P, plus the weighted squared error of the value."""
        config = self.config
        values = self._values(rollout.observations)
        advantage = rollout.rows(self.advantages(rollout, values.detach().numpy()))
        values = values[torch.from_numpy(rollout.kept)]
        held = values.detach()
        targets = torch.from_numpy(advantage.astype(np.float32)) + held
        if config.normalize and len(advantage) > 1:
            advantage = (advantage - advantage.mean()) / (advantage.std(ddof=1) + 1e-8)
        log_probability, entropy = self._actor.score(
            torch.from_numpy(rollout.rows(rollout.observations)),
            torch.from_numpy(rollout.rows(rollout.actions)),
        )
        gain = (log_probability * torch.from_numpy(advantage.astype(np.float32))).mean()
        value_loss = (targets - values).square().mean()
        loss: torch.Tensor = config.vf_coef * value_loss - gain - config.ent_coef * entropy.mean()
        self.terms = {"gain": gain, "entropy": entropy, "value_loss": value_loss}
        self.terms |= {"values": held, "targets": targets}
        return loss

    def advantages(self, rollout: Rollout, values: np.ndarray) -> np.ndarray:
        """A_t of every row, float64, shape (T, N), from V(s_t), shape (T, N)."""
        with torch.no_grad():
            following = self._values(rollout.next_observations).numpy()
        return advantages(
            rollout.rewards,
            values.astype(np.float64),
            following.astype(np.float64),
            rollout.terminated,
            rollout.truncated,
            gamma=self.config.gamma,
            gae_lambda=self.config.gae_lambda,
        )

    def _values(self, observations: np.ndarray) -> torch.Tensor:
        """V(s), shape (T, N), of observations, shape (T, N, n)."""
        shape = observations.shape
        values: torch.Tensor = self._critic(torch.from_numpy(observations.reshape(-1, shape[-1])))
        return values.reshape(shape[:-1])
