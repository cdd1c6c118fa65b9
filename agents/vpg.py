"""Vanilla Policy Gradient: the paper's Algorithm 1, Equations 1 and 2."""

from typing import Literal

import numpy as np

from ..models.errors import InputError
from ..models.fields import PositiveInt, immutable
from .config import Config
from .layers import Floats
from .learner import Learner
from .rollouts import Collector, Rollout, discounted_sums, step_of_episode


@immutable
class VPGConfig(Config):
    """Vanilla Policy Gradient (paper, section 2.3, Algorithm 1). Defaults: the paper's setting."""

    episodes_per_update: PositiveInt = 1
    """Episodes flown with one policy ("a set of drone data"; the paper gives no number)."""
    baseline: Literal["none", "time"] = "none"
    """Taken off the returns: nothing (paper), or their mean at the same step of the episode."""
    normalize: bool = False
    """Divide the returns of an update by their standard deviation."""

    remembers = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.baseline == "time" and self.episodes_per_update == 1:
            raise InputError(
                "episodes_per_update: expected 2 or more with baseline 'time', where a single "
                "episode is its own mean, got 1"
            )

    def least_steps(self, drones: int, episode_length: int) -> int:
        return drones * episode_length if drones > 1 else 1


class VPG(Learner):
    """Raise the log-probability of every action by the return that followed it.

    The gradient of Equation 2, R_t · grad log P(a_t | s_t), averaged over the steps of an update.
    Algorithm 1 prints the update without R; Equation 2 has it, as we do. Privileged arrays of an
    observation are for a critic, and skipped.
    """

    config: VPGConfig

    def collect(self, collector: Collector, most: int) -> Rollout:
        """Fly whole episodes with one policy."""
        return collector.episodes(self.config.episodes_per_update, most)

    def gradient(self, rollout: Rollout) -> None:
        """Of minus the mean of R_t · log P(a_t | s_t)."""
        weights = self.returns(rollout)
        observations = rollout.rows(rollout.observations)
        actions = rollout.rows(rollout.actions)
        (output,) = outputs = self._both.forward(observations.T)
        log_probability, entropy = self._actor.head.score(output, actions.T)
        output[...] = self._actor.head.back(weights * (-1 / len(weights)), 0.0)
        self._both.learn(outputs)
        self.terms = {"gain": (log_probability * weights).mean(), "entropy": entropy}

    def returns(self, rollout: Rollout) -> Floats:
        """R_t minus the baseline, scaled if `normalize`, shape (rows,)."""
        # The sum of gamma^(t' - t) · r_t' to the episode's end (Algorithm 1, step 2).
        sums = discounted_sums(rollout.rewards, self.config.gamma * ~rollout.ends)
        returns = rollout.rows(sums)
        if self.config.baseline == "time":
            step = rollout.rows(step_of_episode(rollout.ends))
            means = np.bincount(step, returns) / np.bincount(step)
            returns = returns - means[step]
        if self.config.normalize:
            returns = returns / (returns.std() + 1e-8)
        return returns.astype(np.float32)
