"""Returns and advantages against values worked out by hand."""

import numpy as np
import pytest
from rotorgram.agents.rollouts import advantages, discounted_sums, rewards_to_go, step_of_episode


def flags(*values: int) -> np.ndarray:
    return np.array(values, bool)


def test_rewards_to_go_by_hand() -> None:
    rewards = np.array([1.0, 2.0, 4.0, 8.0])
    returns = rewards_to_go(rewards, flags(0, 0, 0, 1), gamma=0.5)
    np.testing.assert_array_equal(returns, [1 + 1 + 1 + 1, 2 + 2 + 2, 4 + 4, 8])


def test_rewards_to_go_does_not_cross_the_end_of_an_episode() -> None:
    rewards = np.array([1.0, 10.0, 100.0, 1000.0])
    returns = rewards_to_go(rewards, flags(0, 1, 0, 1), gamma=1.0)
    np.testing.assert_array_equal(returns, [11, 10, 1100, 1000])


def test_one_step_advantage_is_equation_3() -> None:
    got = advantages(
        np.array([1.0, 1.0]),
        values=np.array([2.0, 3.0]),
        next_values=np.array([3.0, 5.0]),
        terminated=flags(0, 0),
        truncated=flags(0, 0),
        gamma=0.5,
        gae_lambda=0.0,
    )
    np.testing.assert_array_equal(got, [1 + 1.5 - 2, 1 + 2.5 - 3])


@pytest.mark.parametrize("gae_lambda", [0.0, 0.5, 1.0])
def test_value_is_carried_over_truncation_and_not_over_termination(gae_lambda: float) -> None:
    def last(terminated: int, truncated: int) -> float:
        return advantages(
            np.array([0.0, 1.0]),
            values=np.array([0.0, 0.0]),
            next_values=np.array([0.0, 100.0]),
            terminated=flags(0, terminated),
            truncated=flags(0, truncated),
            gamma=0.9,
            gae_lambda=gae_lambda,
        )[1]

    assert last(1, 0) == 1.0
    assert last(0, 1) == 1.0 + 90.0
    assert last(1, 1) == 1.0, "both set: it is terminated"


def test_lambda_sums_discounted_errors_and_stops_at_ends() -> None:
    got = advantages(
        np.array([1.0, 1.0, 1.0]),
        values=np.zeros(3),
        next_values=np.array([0.0, 7.0, 0.0]),
        terminated=flags(0, 0, 0),
        truncated=flags(0, 1, 0),
        gamma=1.0,
        gae_lambda=0.5,
    )
    np.testing.assert_array_equal(got, [1 + 0.5 * 8, 8, 1])


def test_constant_reward_through_time_limits_has_its_closed_form() -> None:
    """With V = 1 / (1 - gamma) everywhere, a reward of 1 is no surprise: all advantages vanish."""
    value = 1 / (1 - 0.98)
    got = advantages(
        np.ones(100),
        values=np.full(100, value),
        next_values=np.full(100, value),
        terminated=np.zeros(100, bool),
        truncated=np.arange(100) % 10 == 9,
        gamma=0.98,
        gae_lambda=0.95,
    )
    np.testing.assert_allclose(got, 0, atol=1e-12)


def test_step_of_episode() -> None:
    assert step_of_episode(flags(0, 0, 1, 1, 0, 1, 0)).tolist() == [0, 1, 2, 0, 0, 1, 0]
    assert step_of_episode(flags(0, 0, 0)).tolist() == [0, 1, 2]
    assert step_of_episode(flags(1)).tolist() == [0]
    both = np.stack([flags(0, 1, 0, 0), flags(0, 0, 0, 1)], axis=1)
    assert step_of_episode(both).tolist() == [[0, 0], [1, 1], [0, 2], [1, 3]]


def test_drones_beside_each_other_are_summed_each_for_itself() -> None:
    rewards = np.array([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]])
    ends = np.array([[False, True], [False, False], [False, False]])
    got = rewards_to_go(rewards, ends, gamma=0.5)
    np.testing.assert_array_equal(got, [[1 + 1 + 1, 10], [2 + 2, 20 + 20], [4, 40]])


def test_sums_of_any_length_are_those_of_the_recursion() -> None:
    dice = np.random.default_rng(0)
    for length in (1, 2, 3, 7, 64, 100):
        values = dice.normal(size=length)
        factors = dice.uniform(size=length)
        expected = [values[t] + sum(np.prod(factors[t:u]) * values[u] for u in range(t + 1, length))
                    for t in range(length)]  # fmt: skip
        np.testing.assert_allclose(discounted_sums(values, factors), expected, rtol=1e-12)
