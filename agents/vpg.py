"""Vanilla Policy Gradient: the paper's Algorithm 1, Equations 1 and 2."""

import numpy as np

from .learner import Learner
from .policies import NetworkPolicy
from .presets import VPGConfig
from .rollouts import Collector, Rollout, rewards_to_go, step_of_episode


class VPG(Learner):
    """Raise the log-probability of every action by the return that followed it.

    The gradient of Equation 2, R_t · grad log P(a_t | s_t), averaged over the steps of an update.
    Algorithm 1 prints the update without R; Equation 2 has it, as we do.
    """

    config: VPGConfig

    def collect(self, collector: Collector, policy: NetworkPolicy, most: int) -> Rollout:
        """Fly whole episodes with one policy."""
        return collector.episodes(policy, self.config.episodes_per_update, most)

    def gradient(self, rollout: Rollout) -> None:
        """Of minus the mean of R_t · log P(a_t | s_t)."""
        weights = self.returns(rollout)
        log_probability, entropy = self._actor.score(
            self.inputs(rollout.rows(rollout.observations)), rollout.rows(rollout.actions)
        )
        self._actor.backward(-weights / len(weights))
        self.terms = {"gain": (log_probability * weights).mean(), "entropy": entropy}

    def returns(self, rollout: Rollout) -> np.ndarray:
        """R_t, less a baseline and scaled where the config says so: float32, shape (rows,)."""
        sums = rewards_to_go(rollout.rewards, rollout.ends, self.config.gamma)
        returns = rollout.rows(sums)
        if self.config.baseline == "time":
            step = rollout.rows(step_of_episode(rollout.ends))
            returns = returns - (np.bincount(step, returns) / np.bincount(step))[step]
        if self.config.normalize:
            returns = returns / (returns.std() + 1e-8)
        return returns.astype(np.float32)
