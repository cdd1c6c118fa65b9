"""Advantage Actor-Critic: the paper's Algorithm 2, Equation 3."""

from typing import Any

import numpy as np
import torch

from .learner import Learner, Terms, seeds_of, sizes
from .networks import Actor, Critic
from .policies import NetworkPolicy
from .presets import A2CConfig
from .returns import advantages
from .rollouts import AnyCollector, Rollout

__all__ = ["A2C"]


class A2C(Learner):
    """Two networks: the critic learns V(s), the actor follows the advantage.

    Algorithm 2 weighs the actor's gradient by Q in step 3; the text and Equation 3 say by the
    advantage A, and so do we. The critic descends the squared error to r + gamma · V(s'), with
    the target held still, which is step 5.

    Args:
        env: Gives the sizes; it is not kept.
        config: Hyperparameters.
        seed: Seed of the run: weights and actions.
    """

    def __init__(self, env: Any, config: A2CConfig, seed: int) -> None:
        size, actions = sizes(env)
        torch_seed, rng = seeds_of(seed)
        torch.manual_seed(torch_seed)
        self.config = config
        self._actor = Actor(size, actions, hidden=config.hidden, log_std=config.log_std)
        self._critic = Critic(size, hidden=config.hidden)
        super().__init__(
            {"actor": self._actor, "critic": self._critic},
            learning_rate=config.learning_rate,
            anneal=config.anneal,
            rng=rng,
        )

    def collect(self, collector: AnyCollector, policy: NetworkPolicy, most: int) -> Rollout:
        """Fly a fixed number of steps, across episodes."""
        return collector.steps(policy, min(self.config.steps_per_update, most))

    def loss(self, rollout: Rollout) -> torch.Tensor:
        """Minus the mean of A · log P, plus the weighted squared error of the value."""
        config = self.config
        observations = torch.from_numpy(rollout.observations)
        values = self._critic(observations)
        held = values.detach()
        advantage = self.advantages(rollout, held.numpy())
        targets = torch.from_numpy(advantage.astype(np.float32)) + held
        if config.normalize and len(advantage) > 1:
            advantage = (advantage - advantage.mean()) / (advantage.std(ddof=1) + 1e-8)
        log_probability, entropy = self._actor.score(
            observations, torch.from_numpy(rollout.actions)
        )
        gain = (log_probability * torch.from_numpy(advantage.astype(np.float32))).mean()
        value_loss = (targets - values).square().mean()
        bonus = config.entropy_weight * entropy.mean()
        loss: torch.Tensor = config.value_weight * value_loss - gain - bonus
        self.terms = Terms(
            gain=gain.detach(),
            entropy=entropy.detach(),
            value_loss=value_loss.detach(),
            values=held,
            targets=targets,
        )
        return loss

    def advantages(self, rollout: Rollout, values: np.ndarray) -> np.ndarray:
        """A_t of every step, float64, shape (T,), from V(s_t), shape (T,)."""
        with torch.no_grad():
            following = self._critic(torch.from_numpy(rollout.next_observations))
        return advantages(
            rollout.rewards,
            values.astype(np.float64),
            following.numpy().astype(np.float64),
            rollout.terminated,
            rollout.truncated,
            gamma=self.config.gamma,
            trace=self.config.trace,
        )
