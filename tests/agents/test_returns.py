"""Returns and advantages against values worked out by hand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.agents.rollouts import advantages, discounted_sums, step_of_episode

CASES: dict[str, Any] = json.loads(
    (Path(__file__).parents[1] / "data" / "returns.json").read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", CASES["returns"])
def test_rewards_to_go_by_hand(name: str) -> None:
    case = CASES["returns"][name]
    ends = np.array(case["ends"], bool)
    rewards = np.array(case["rewards"], float)
    returns = discounted_sums(rewards, case["gamma"] * ~ends)
    assert returns.tolist() == case["expected"]


@pytest.mark.parametrize("name", CASES["advantages"])
def test_advantages_by_hand(name: str) -> None:
    """Of three rewards of 1."""
    case = CASES["advantages"][name]
    terminated = np.array(case["terminated"], bool)
    truncated = np.array(case["truncated"], bool)
    values = np.array(case["values"])
    after = np.array(case["next_values"])
    factors = {"gamma": case["gamma"], "gae_lambda": case["gae_lambda"]}
    rewards = np.ones(3)
    got = advantages(rewards, values, after, terminated, truncated, **factors)
    assert got.tolist() == case["expected"]


@pytest.mark.parametrize("gae_lambda", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("terminated", [False, True])
@pytest.mark.parametrize("truncated", [False, True])
def test_value_is_carried_over_truncation_and_not_over_termination(
    gae_lambda: float, terminated: bool, truncated: bool
) -> None:
    last = np.array([False, False, True])
    none = np.zeros(3)
    after = np.array([0.0, 0.0, 100.0])
    ends = last & terminated, last & truncated
    rewards = np.ones(3)
    got = advantages(rewards, none, after, *ends, gamma=0.9, gae_lambda=gae_lambda)
    expected = 1.0 if terminated else 91.0
    assert got[2] == expected


@pytest.mark.parametrize("name", CASES["steps"])
def test_step_of_episode(name: str) -> None:
    case = CASES["steps"][name]
    ends = np.array(case["ends"], bool)
    steps = step_of_episode(ends)
    assert steps.tolist() == case["expected"]


@pytest.mark.parametrize("length", [1, 2, 3, 7, 64, 100])
def test_sums_of_any_length_are_those_of_the_recursion(length: int) -> None:
    dice = np.random.default_rng(0)
    values = dice.normal(size=length)
    factors = dice.uniform(size=length)
    expected = []
    following = 0.0
    for value, factor in zip(values[::-1], factors[::-1], strict=True):
        following = value + factor * following
        expected.insert(0, following)
    found = discounted_sums(values, factors)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
