"""The policy that flies is the policy that learns, in the units of the space."""

from typing import Any

import numpy as np
import pytest
from drones import cases
from nets import policy_of, random_policy
from rotorgram.agents.config import Config
from rotorgram.agents.policies import ActionMap, NetworkPolicy, flat
from rotorgram.agents.presets import preset
from rotorgram.envs.spec import ArraySpec, Discrete
from rotorgram.models.errors import InputError
from scripted import spec_of

BOX = spec_of()
CHOICE = spec_of(Discrete(choices=3))


def constant(spec: Any, *outputs: float) -> NetworkPolicy:
    """A policy that gives the same for every observation of three numbers."""
    policy = random_policy(spec, size=0.0)
    policy.weights.arrays["layers.1.weight"][:, 0] = outputs
    return policy


@pytest.mark.parametrize("spec", [BOX, CHOICE], ids=["box", "discrete"])
@pytest.mark.parametrize(("hidden", "activation"), [((16,), "relu"), ((8, 4), "tanh")])
def test_a_loaded_policy_gives_what_the_learning_one_gives(
    spec: Any, hidden: tuple[int, ...], activation: str
) -> None:
    learning = random_policy(spec, hidden, activation)
    policy = policy_of(learning.weights.arrays, spec, activation)
    numbers = np.random.default_rng(0).normal(size=(50, 3))
    observations = numbers.astype(np.float32)
    expected = learning.outputs(observations)
    found = policy.outputs(observations)
    np.testing.assert_array_equal(found, expected)
    first = policy.outputs(observations[:1])
    np.testing.assert_allclose(first, expected[:1], rtol=1e-5, atol=1e-5)


def test_outputs_are_squashed() -> None:
    """Two layers of ones: 16 · sum of the observation, here 16 · 1.3."""
    shapes = random_policy(BOX).network.shapes
    layers = {name: np.ones(shape, np.float32) for name, shape in shapes.items()}
    layers["layers.0.weight"][:, 0] = 0.0
    layers["layers.1.weight"][:, 0] = 0.0, -20.3
    seen = np.array([[1, 0.3, 0]], np.float32)
    noise = np.zeros(2, np.float32)
    policy = policy_of(layers | {"log_std": noise}, BOX)
    found = policy.outputs(seen)
    np.testing.assert_allclose(found, [[20.8, 0.5]], rtol=1e-5)
    squashed = policy_of(layers, BOX, squash=True)
    middle, half = squashed.actions.middle[0], squashed.actions.half[0]
    expected = middle + half * np.array([1, np.tanh(0.5)])
    np.testing.assert_allclose(squashed.act(seen[0]), expected, rtol=1e-5)
    with_noise = policy_of(layers | {"log_std": noise}, BOX, squashed=True)
    np.testing.assert_array_equal(with_noise.act(seen[0]), squashed.act(seen[0]))
    assert not np.allclose(policy.act(seen[0]), squashed.act(seen[0]))


DRAWS = 40_000


def drawn_of(policy: NetworkPolicy, observation: np.ndarray) -> np.ndarray:
    """Many actions for the same observation."""
    noise = policy.head.noise(np.random.default_rng(0), DRAWS)
    observations = np.repeat(observation, DRAWS, axis=0)
    return policy.head.sample(policy.outputs(observations), noise)


def test_gaussian_sampling_has_the_mean_and_deviation_of_the_policy() -> None:
    policy = random_policy(BOX)
    observation = np.ones((1, 3), np.float32)
    drawn = drawn_of(policy, observation)
    std = np.exp(policy.weights.arrays["log_std"])
    mean = policy.outputs(observation)[0]
    np.testing.assert_allclose(drawn.mean(0), mean, atol=5 * std.max() / 200)
    np.testing.assert_allclose(drawn.std(0), std, rtol=0.02)
    assert drawn.dtype == np.float32


def test_categorical_sampling_has_the_probabilities_of_the_policy() -> None:
    policy = random_policy(CHOICE)
    observation = np.zeros((1, 3), np.float32)
    drawn = drawn_of(policy, observation)
    counts = np.bincount(drawn[:, 0].astype(int), minlength=3)
    shares = np.exp(policy.outputs(observation)[0])
    expected = shares / shares.sum()
    np.testing.assert_allclose(counts / DRAWS, expected, atol=0.012)
    envs = policy.actions.to_envs(drawn)
    assert envs.dtype == np.int64
    assert envs.shape == (DRAWS,)


@pytest.mark.parametrize("case", cases("mapped_actions"))
def test_zero_is_the_middle_of_the_space_and_one_its_bound(case: Any) -> None:
    low = (0.0, -2.0, 10.0, -np.inf)
    high = (100.0, 2.0, 20.0, 3.0)
    spec = spec_of(ArraySpec(name="a", shape=(2, 2), low=low, high=high))
    policy = constant(spec, *case["outputs"])
    assert policy.act(np.zeros(3, np.float32)).tolist() == case["action"]


def test_a_choice_is_the_largest_output() -> None:
    policy = constant(CHOICE, 0.0, 1.0, 0.5)
    assert policy.act(np.zeros(3, np.float32)) == 1


def test_actions_of_whole_numbers_are_refused() -> None:
    whole = ArraySpec(name="a", shape=(1,), dtype="int32")
    with pytest.raises(InputError, match="action: expected a choice or numbers of type float"):
        ActionMap(whole)


def test_observations_of_many_arrays_are_joined_in_the_order_of_the_spec() -> None:
    arrays = (ArraySpec(name="b", shape=(2,)), ArraySpec(name="a", shape=(1, 2), dtype="uint8"))
    spec = spec_of(observation=arrays)
    one = {"a": np.array([[3, 4]], np.uint8), "b": np.array([1, 2], np.float32)}
    assert flat(one, spec).tolist() == [1, 2, 3, 4]
    many = {name: np.stack([array, array]) for name, array in one.items()}
    assert flat(many, spec, 2).tolist() == [[1, 2, 3, 4]] * 2
    assert flat(one, spec).dtype == np.float32


@pytest.mark.parametrize(("name", "shape"), cases("wrong_weights"))
def test_weights_that_do_not_fit_are_refused(name: str, shape: tuple[int, ...]) -> None:
    weights = random_policy(BOX).weights.arrays
    weights[name] = np.zeros(shape, np.float32)
    with pytest.raises(InputError, match="policy: expected weights of shapes"):
        NetworkPolicy.load(weights, BOX, Config())


def test_a_missing_weight_is_refused() -> None:
    weights = random_policy(BOX).weights.arrays
    del weights["log_std"]
    with pytest.raises(InputError, match="policy: expected weights of shapes"):
        NetworkPolicy.load(weights, BOX, Config())


def test_the_paper_s_networks_have_one_hidden_layer_of_16_relu_units() -> None:
    config = preset("a2c", "paper")
    assert config.hidden == (16,)
    assert config.activation == "relu"
