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


def judged(
    next_values: list[float],
    gae_lambda: float,
    *,
    gamma: float = 1.0,
    values: tuple[float, ...] = (0.0, 0.0, 0.0),
    terminated: tuple[int, ...] = (0, 0, 0),
    truncated: tuple[int, ...] = (0, 0, 0),
) -> list[float]:
    """Advantages of three rewards of 1."""
    estimates = advantages(
        np.ones(3),
        np.array(values),
        np.array(next_values),
        flags(*terminated),
        flags(*truncated),
        gamma=gamma,
        gae_lambda=gae_lambda,
    )
    return list(estimates)


def test_one_step_advantage_is_equation_3() -> None:
    got = judged([3.0, 5.0, 7.0], 0.0, gamma=0.5, values=(2.0, 3.0, 5.0))
    assert got == [1 + 1.5 - 2, 1 + 2.5 - 3, 1 + 3.5 - 5]


@pytest.mark.parametrize("gae_lambda", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(
    ("terminated", "truncated", "last"), [(1, 0, 1.0), (0, 1, 91.0), (1, 1, 1.0)]
)
def test_value_is_carried_over_truncation_and_not_over_termination(
    gae_lambda: float, terminated: int, truncated: int, last: float
) -> None:
    ends = {"terminated": (0, 0, terminated), "truncated": (0, 0, truncated)}
    got = judged([0.0, 0.0, 100.0], gae_lambda, gamma=0.9, **ends)
    assert got[2] == last


def test_lambda_sums_discounted_errors_and_stops_at_ends() -> None:
    got = judged([0.0, 7.0, 0.0], 0.5, truncated=(0, 1, 0))
    assert got == [1 + 0.5 * 8, 8, 1]


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
