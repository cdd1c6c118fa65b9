"""Collecting experience: a policy flies, and every transition is kept."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from .policies import NetworkPolicy

__all__ = ["Collector", "Rollout"]


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """T transitions in the order in which they were flown."""

    observations: np.ndarray
    """float32, shape (T, n)."""
    actions: np.ndarray
    """As drawn, not clipped: float32, shape (T, k); (T, 1) if discrete."""
    rewards: np.ndarray
    """float64, shape (T,)."""
    next_observations: np.ndarray
    """What each step led to, before any reset: float32, shape (T, n)."""
    terminated: np.ndarray
    """bool, shape (T,)."""
    truncated: np.ndarray
    """bool, shape (T,)."""

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def ends(self) -> np.ndarray:
        """Whether an episode ended with the step: bool, shape (T,)."""
        ends: np.ndarray = self.terminated | self.truncated
        return ends


class Collector:
    """Flies a policy on an env, episode after episode, across calls.

    Args:
        env: The env.
        rng: Draws the actions.
        observation: What the policy sees next, where the env stands in an episode already.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        rng: np.random.Generator,
        observation: np.ndarray | None = None,
    ) -> None:
        self._env = env
        self._rng = rng
        self.observation = observation

    def steps(self, policy: NetworkPolicy, count: int) -> Rollout:
        """So many transitions; the last episode goes on in the next call."""
        return self._collect(policy, count, lambda steps, _: steps == count)

    def episodes(self, policy: NetworkPolicy, count: int, most_steps: int) -> Rollout:
        """So many whole episodes; the last is broken off where `most_steps` are flown before."""
        return self._collect(
            policy, 256, lambda steps, ended: ended == count or steps == most_steps
        )

    def _collect(
        self, policy: NetworkPolicy, block: int, enough: Callable[[int, int], bool]
    ) -> Rollout:
        env, rows, ended = self._env, _Rows(), 0
        observation = self.observation
        if observation is None:
            observation, _ = env.reset()
        while True:
            for noise in policy.draw_noise(self._rng, block):
                action = policy.sample(observation, noise)
                after, reward, terminated, truncated, _ = env.step(policy.to_env(action))
                rows.append((observation, action, float(reward), after, terminated, truncated))
                observation = after
                if terminated or truncated:
                    ended += 1
                    observation, _ = env.reset()
                if enough(len(rows), ended):
                    self.observation = observation
                    return rows.rollout()


class _Rows(list[tuple[np.ndarray, np.ndarray, float, np.ndarray, bool, bool]]):
    def rollout(self) -> Rollout:
        observations, actions, rewards, after, terminated, truncated = zip(*self, strict=True)
        return Rollout(
            observations=np.array(observations),
            actions=np.array(actions),
            rewards=np.array(rewards, np.float64),
            next_observations=np.array(after),
            terminated=np.array(terminated, bool),
            truncated=np.array(truncated, bool),
        )
