"""Vanilla Policy Gradient: the paper's Algorithm 1, Equations 1 and 2."""

from typing import Any

import numpy as np
import torch

from .learner import Learner, Terms, seeds_of, sizes
from .networks import Actor
from .policies import NetworkPolicy
from .presets import VPGConfig
from .returns import rewards_to_go
from .rollouts import AnyCollector, Rollout

__all__ = ["VPG", "step_of_episode"]


class VPG(Learner):
    """Raise the log-probability of every action by the return that followed it.

    The gradient of Equation 2, R_t · grad log P(a_t | s_t), averaged over the steps of an update.
    Algorithm 1 prints the update without R; Equation 2 has it, and so have we.

    Args:
        env: Gives the sizes; it is not kept.
        config: Hyperparameters.
        seed: Seed of the run: weights and actions.
    """

    def __init__(self, env: Any, config: VPGConfig, seed: int) -> None:
        size, actions = sizes(env)
        torch_seed, rng = seeds_of(seed)
        torch.manual_seed(torch_seed)
        self.config = config
        self._actor = Actor(size, actions, hidden=config.hidden, log_std=config.log_std)
        super().__init__(
            {"actor": self._actor},
            learning_rate=config.learning_rate,
            anneal=config.anneal,
            rng=rng,
        )

    def collect(self, collector: AnyCollector, policy: NetworkPolicy, most: int) -> Rollout:
        """Fly whole episodes with one policy."""
        return collector.episodes(policy, self.config.episodes_per_update, most)

    def loss(self, rollout: Rollout) -> torch.Tensor:
        """Minus the mean of R_t · log P(a_t | s_t)."""
        weights = self.weights(rollout)
        log_probability, entropy = self._actor.score(
            torch.from_numpy(rollout.observations), torch.from_numpy(rollout.actions)
        )
        gain = (log_probability * torch.from_numpy(weights)).mean()
        self.terms = Terms(gain=gain.detach(), entropy=entropy.detach())
        return -gain

    def weights(self, rollout: Rollout) -> np.ndarray:
        """R_t, less a baseline and scaled where the config says so: float32, shape (T,)."""
        returns = rewards_to_go(rollout.rewards, rollout.ends, self.config.gamma)
        if self.config.baseline == "time":
            step = step_of_episode(rollout.ends)
            returns -= (np.bincount(step, returns) / np.bincount(step))[step]
        if self.config.normalize:
            returns /= returns.std() + 1e-8
        return returns.astype(np.float32)


def step_of_episode(ends: np.ndarray) -> np.ndarray:
    """Number of the step within its episode, shape (T,), where the first begins at 0."""
    index = np.arange(len(ends))
    starts = np.where(np.roll(ends, 1), index, 0)
    starts[0] = 0
    result: np.ndarray = index - np.maximum.accumulate(starts)
    return result
