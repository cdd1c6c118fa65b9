"""Returns and advantages, as pure functions of trajectories.

Time is the first axis, drones may be the second: every array has the shape (T,) or (T, N).
`terminated` and `truncated` mark the last transition of an episode. A value is carried over a
truncation and never over a termination; a recursion stops at either, and at the last row.
"""

import numpy as np


def discounted_sums(values: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """S_t = v_t + f_t · S_t+1, where S is 0 after the last row: float64, shape of `values`.

    A factor is 0 where a sum stops. The rows are combined in pairs, pairs of pairs and so on:
    log2(T) NumPy operations on all of them take the place of T operations on one.
    """
    sums = values.astype(np.float64)
    factors = factors.astype(np.float64)
    span = 1
    while span < len(sums):
        sums[:-span] += factors[:-span] * sums[span:]
        factors[:-span] *= factors[span:]
        factors[-span:] = 0.0
        span *= 2
    return sums


def rewards_to_go(rewards: np.ndarray, ends: np.ndarray, gamma: float) -> np.ndarray:
    """R_t = sum of gamma^(t' - t) · r_t' to the episode's end (paper, Algorithm 1, step 2)."""
    return discounted_sums(rewards, gamma * ~ends)


def advantages(
    rewards: np.ndarray,
    values: np.ndarray,
    next_values: np.ndarray,
    terminated: np.ndarray,
    truncated: np.ndarray,
    *,
    gamma: float,
    gae_lambda: float,
) -> np.ndarray:
    """Generalised advantage estimates, float64; with `gae_lambda` = 0 the paper's Equation 3.

    A_t = r_t + gamma · V(s_t+1) - V(s_t), where V after a termination is 0, and s_t+1 is the state
    that the step led to, before any reset. `gae_lambda` is the decay of the sum over later errors.
    """
    errors: np.ndarray = rewards + gamma * np.where(terminated, 0.0, next_values) - values
    if gae_lambda == 0.0:
        return errors
    return discounted_sums(errors, gamma * gae_lambda * ~(terminated | truncated))


def step_of_episode(ends: np.ndarray) -> np.ndarray:
    """Number of each step within its episode, where the first row begins at 0."""
    index = np.arange(len(ends)).reshape(-1, *(1,) * (ends.ndim - 1))
    starts = np.zeros(ends.shape, int)
    starts[1:] = np.where(ends[:-1], index[1:], 0)
    result: np.ndarray = index - np.maximum.accumulate(starts)
    return result
