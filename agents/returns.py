"""Returns and advantages, as pure functions of one sequence of transitions.

In every sequence `terminated` and `truncated` mark the last transition of an episode. A value is
carried over a truncation and never over a termination; a recursion stops at either.
"""

import numpy as np

__all__ = ["advantages", "rewards_to_go"]


def rewards_to_go(rewards: np.ndarray, ends: np.ndarray, gamma: float) -> np.ndarray:
    """Discounted return from each step to the end of its episode (paper, Algorithm 1, step 2).

    R_t = sum of gamma^(t' - t) · r_t' for t' = t ... T - 1.

    Args:
        rewards: float64, shape (T,).
        ends: bool, shape (T,): terminated or truncated.
        gamma: Discount.
    """
    result = np.empty(len(rewards))
    running = 0.0
    for t in range(len(rewards) - 1, -1, -1):
        running = rewards[t] + (0.0 if ends[t] else gamma * running)
        result[t] = running
    return result


def advantages(
    rewards: np.ndarray,
    values: np.ndarray,
    next_values: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    *,
    gamma: float,
    trace: float,
) -> np.ndarray:
    """Generalised advantage estimates; with `trace` = 0 the paper's Equation 3.

    A_t = r_t + gamma · V(s_t+1) - V(s_t), where V after a termination is 0.

    Args:
        rewards: float64, shape (T,).
        values: V(s_t), shape (T,).
        next_values: V(s_t+1) of the state that the step led to, before any reset, shape (T,).
        terminated: bool, shape (T,).
        truncated: bool, shape (T,).
        gamma: Discount.
        trace: Decay lambda of the sum over later errors, 0 to 1.
    """
    errors: np.ndarray = rewards + gamma * np.where(terminated, 0.0, next_values) - values
    if trace == 0.0:
        return errors
    ends = terminated | truncated
    result = np.empty(len(rewards))
    running = 0.0
    for t in range(len(rewards) - 1, -1, -1):
        running = errors[t] + (0.0 if ends[t] else gamma * trace * running)
        result[t] = running
    return result
