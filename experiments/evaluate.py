"""Flying a policy without exploration, and what the flights were like."""

from dataclasses import dataclass
from typing import Any, Final

import gymnasium as gym
import numpy as np

from ..agents.policies import Policy
from ..udp import LOST
from .metrics import overshoot, settling_time, steady_state_error

__all__ = ["Flight", "evaluation_row", "evaluation_seed", "fly", "fly_episodes"]

_EVALUATION: Final = 20230324  # the day the paper appeared


def evaluation_seed(episode: int) -> int:
    """Seed of an evaluation episode: the same for every agent.

    Training seeds are spawned from two numbers (`episodes.episode_seed`), these from one, so that
    no run's seed can make them meet.
    """
    sequence = np.random.SeedSequence(_EVALUATION, spawn_key=(episode,))
    return int(sequence.generate_state(1, np.uint64)[0])


@dataclass(frozen=True, kw_only=True)
class Flight:
    """One evaluation episode of T steps."""

    start_error: float
    """Elevation error before the first step, m."""
    errors: np.ndarray
    """Elevation error after each step, m, float32, shape (T,)."""
    rewards: np.ndarray
    """float64, shape (T,)."""
    thrusts: np.ndarray
    """Thrust of rotor 1 during each step, N, float32, shape (T,)."""
    terminated: bool


def fly(env: gym.Env[np.ndarray, Any], policy: Policy, seed: int) -> Flight:
    """One episode of a policy, from a seed; once more, if its simulator was lost."""
    while (flight := _fly(env, policy, seed)) is None:
        pass
    return flight


def _fly(env: gym.Env[np.ndarray, Any], policy: Policy, seed: int) -> Flight | None:
    policy.reset()
    observation, _ = env.reset(seed=seed)
    start = float(observation[0])
    errors, rewards, thrusts = [], [], []
    terminated = truncated = False
    while not (terminated or truncated):
        observation, reward, terminated, truncated, info = env.step(policy.act(observation))
        if LOST in info:
            return None
        errors.append(observation[0])
        rewards.append(float(reward))
        thrusts.append(info.get("F1", np.nan))
    return Flight(
        start_error=start,
        errors=np.array(errors, np.float32),
        rewards=np.array(rewards),
        thrusts=np.array(thrusts, np.float32),
        terminated=terminated,
    )


def fly_episodes(env: gym.Env[np.ndarray, Any], policy: Policy, episodes: int) -> list[Flight]:
    """The first so many evaluation episodes."""
    return [fly(env, policy, evaluation_seed(episode)) for episode in range(episodes)]


def evaluation_row(flight: Flight, episode: int, control_period: float) -> dict[str, Any]:
    """A flight as a row of `evaluations.csv`, but for the columns that name the run."""
    whole = np.concatenate(([flight.start_error], flight.errors)).astype(np.float64)
    settled = settling_time(whole, control_period) if not flight.terminated else np.nan
    return {
        "episode": episode,
        "length": len(flight.errors),
        "return": float(flight.rewards.sum()),
        "steady_error": steady_state_error(flight.errors.astype(np.float64)),
        "settling_time": settled,
        "overshoot": overshoot(whole),
        "terminated": flight.terminated,
    }
