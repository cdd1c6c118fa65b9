"""Vanilla Policy Gradient: the paper's Algorithm 1, Equations 1 and 2."""

import numpy as np

from .episodes import EpisodeLog
from .learner import Learner, Terms
from .networks import torch
from .policies import NetworkPolicy
from .presets import VPGConfig
from .returns import rewards_to_go, step_of_episode
from .rollouts import Collector, Rollout

__all__ = ["VPG"]


class VPG(Learner):
    """Raise the log-probability of every action by the return that followed it.

    The gradient of Equation 2, R_t · grad log P(a_t | s_t), averaged over the steps of an update.
    Algorithm 1 prints the update without R; Equation 2 has it, and so have we.
    """

    def __init__(self, log: EpisodeLog, config: VPGConfig, seed: int) -> None:
        super().__init__(log, config, seed)
        self.config = config

    def collect(self, collector: Collector, policy: NetworkPolicy, most: int) -> Rollout:
        """Fly whole episodes with one policy."""
        return collector.episodes(policy, self.config.episodes_per_update, most)

    def loss(self, rollout: Rollout) -> torch.Tensor:
        """Minus the mean of R_t · log P(a_t | s_t)."""
        log_probability, entropy = self._actor.score(
            torch.from_numpy(rollout.rows(rollout.observations)),
            torch.from_numpy(rollout.rows(rollout.actions)),
        )
        gain = (log_probability * torch.from_numpy(self.weights(rollout))).mean()
        self.terms = Terms(gain=gain.detach(), entropy=entropy.detach())
        return -gain

    def weights(self, rollout: Rollout) -> np.ndarray:
        """R_t, less a baseline and scaled where the config says so: float32, shape (rows,)."""
        sums = rewards_to_go(rollout.rewards, rollout.ends, self.config.gamma)
        returns = rollout.rows(sums)
        step = rollout.rows(step_of_episode(rollout.ends))
        if self.config.baseline == "time":
            returns = returns - (np.bincount(step, returns) / np.bincount(step))[step]
        elif self.config.baseline == "linear":
            returns = returns - linear_fit(rollout.rows(rollout.observations), step, returns)
        if self.config.normalize:
            returns = returns / (returns.std() + 1e-8)
        return returns.astype(np.float32)


def linear_fit(observations: np.ndarray, step: np.ndarray, returns: np.ndarray) -> np.ndarray:
    """Least squares of the returns over the observation, its square, and powers of time.

    The features are those of Duan et al. 2016 ("Benchmarking deep reinforcement learning for
    continuous control"), section 4.2. A weight of 1e-5 on the squared coefficients keeps the fit
    defined where they are not independent.

    Args:
        observations: float32, shape (rows, n).
        step: Number of each within its episode, shape (rows,).
        returns: float64, shape (rows,).
    """
    seen, time = observations.astype(np.float64), step / max(int(step.max()), 1)
    powers = time[:, np.newaxis] ** np.arange(4)
    features = np.concatenate((powers, seen, seen**2), axis=1)
    features /= np.abs(features).max(axis=0) + 1e-8
    gram = features.T @ features + 1e-5 * len(step) * np.eye(features.shape[1])
    fit: np.ndarray = features @ np.linalg.solve(gram, features.T @ returns)
    return fit
