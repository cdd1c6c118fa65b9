"""Returns and advantages against values worked out by hand."""

import numpy as np
import pytest
from rotorgram.agents.returns import advantages, rewards_to_go
from rotorgram.agents.vpg import step_of_episode


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
        trace=0.0,
    )
    np.testing.assert_array_equal(got, [1 + 1.5 - 2, 1 + 2.5 - 3])


@pytest.mark.parametrize("trace", [0.0, 0.5, 1.0])
def test_value_is_carried_over_truncation_and_not_over_termination(trace: float) -> None:
    def last(terminated: int, truncated: int) -> float:
        return advantages(
            np.array([0.0, 1.0]),
            values=np.array([0.0, 0.0]),
            next_values=np.array([0.0, 100.0]),
            terminated=flags(0, terminated),
            truncated=flags(0, truncated),
            gamma=0.9,
            trace=trace,
        )[1]

    assert last(1, 0) == 1.0
    assert last(0, 1) == 1.0 + 90.0
    assert last(1, 1) == 1.0, "both set: it is terminated"


def test_trace_sums_discounted_errors_and_stops_at_ends() -> None:
    got = advantages(
        np.array([1.0, 1.0, 1.0]),
        values=np.zeros(3),
        next_values=np.array([0.0, 7.0, 0.0]),
        terminated=flags(0, 0, 0),
        truncated=flags(0, 1, 0),
        gamma=1.0,
        trace=0.5,
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
        trace=0.95,
    )
    np.testing.assert_allclose(got, 0, atol=1e-12)


def test_step_of_episode() -> None:
    assert step_of_episode(flags(0, 0, 1, 1, 0, 1, 0)).tolist() == [0, 1, 2, 0, 0, 1, 0]
    assert step_of_episode(flags(0, 0, 0)).tolist() == [0, 1, 2]
    assert step_of_episode(flags(1)).tolist() == [0]
