"""The policy that flies is the policy that learns, in the units of the space."""

from typing import Any

import numpy as np
import pytest
from nets import policy_of, random_policy
from rotorgram.agents.config import Config
from rotorgram.agents.policies import ActionMap, NetworkPolicy, flat
from rotorgram.agents.presets import preset
from rotorgram.envs.spec import ArraySpec, Discrete
from rotorgram.models.errors import InputError
from scripted import spec_of

BOX = spec_of()
CHOICE = spec_of(Discrete(n=3))


def constant(spec: Any, *outputs: float) -> NetworkPolicy:
    """A policy that gives the same for every observation of three numbers."""
    weights = {
        "layers.0.weight": np.zeros((16, 3), np.float32),
        "layers.0.bias": np.zeros(16, np.float32),
        "layers.1.weight": np.zeros((len(outputs), 16), np.float32),
        "layers.1.bias": np.array(outputs, np.float32),
    }
    if not isinstance(spec.action, Discrete):
        weights["log_std"] = np.zeros(len(outputs), np.float32)
    return policy_of(weights, spec)


@pytest.mark.parametrize("spec", [BOX, CHOICE], ids=["box", "discrete"])
@pytest.mark.parametrize(("hidden", "activation"), [((16,), "relu"), ((8, 4), "tanh")])
def test_a_loaded_policy_gives_what_the_learning_one_gives(
    spec: Any, hidden: tuple[int, ...], activation: str
) -> None:
    learning = random_policy(spec, hidden, activation)
    policy = policy_of(learning.arrays(), spec, activation)
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    expected = learning.network.forward(observations)
    np.testing.assert_array_equal(policy.output(observations), expected)
    first = policy.output(observations[:1])
    np.testing.assert_allclose(first, expected[:1], rtol=1e-5, atol=1e-5)


def test_observations_are_normalised_and_outputs_squashed() -> None:
    """Two layers of ones: 16 · sum of (o - mean) · scale, here 16 · (0.5 · 2 + 3 · 0.1)."""
    weights = {
        name: np.ones(shape, np.float32)
        for name, shape in random_policy(BOX).network.shapes.items()
    }
    weights |= {"layers.0.bias": np.zeros(16, "f"), "layers.1.bias": np.array([0, -20.3], "f")}
    weights |= {"log_std": np.zeros(2, "f"), "observation.mean": np.array([1, 2, 3], "f"),
                "observation.scale": np.array([2, 0.1, 1], "f")}  # fmt: skip
    seen = np.array([[1.5, 5, 3]], np.float32)
    policy = policy_of(weights, BOX)
    np.testing.assert_allclose(policy.output(seen), [[20.8, 0.5]], rtol=1e-5)
    assert seen.tolist() == [[1.5, 5, 3]]
    layers = {name: array for name, array in weights.items() if name.startswith("layers.")}
    squashed = policy_of(layers, BOX, squash=True)
    shifted = np.array([[1, 0.3, 0]], np.float32)
    np.testing.assert_allclose(squashed.output(shifted), [[1, np.tanh(0.5)]], rtol=1e-5)


def test_gaussian_sampling_has_the_mean_and_deviation_of_the_policy() -> None:
    policy = random_policy(BOX)
    observation = np.ones((1, 3), np.float32)
    noise = policy.head.noise(np.random.default_rng(0), 40_000)
    drawn = policy.sample(np.repeat(observation, 40_000, axis=0), noise)
    std = np.exp(policy.arrays()["log_std"])
    mean = policy.output(observation)[0]
    np.testing.assert_allclose(drawn.mean(0), mean, atol=5 * std.max() / 200)
    np.testing.assert_allclose(drawn.std(0), std, rtol=0.02)
    assert drawn.dtype == np.float32


def test_categorical_sampling_has_the_probabilities_of_the_policy() -> None:
    policy = random_policy(CHOICE)
    noise = policy.head.noise(np.random.default_rng(0), 40_000)
    drawn = policy.sample(np.zeros((40_000, 3), np.float32), noise)
    counts = np.bincount(drawn[:, 0].astype(int), minlength=3)
    shares = np.exp(policy.output(np.zeros((1, 3), np.float32))[0])
    expected = shares / shares.sum()
    np.testing.assert_allclose(counts / 40_000, expected, atol=0.012)
    envs = policy.actions.to_envs(drawn)
    assert envs.dtype == np.int64
    assert envs.shape == (40_000,)


def test_zero_is_the_middle_of_the_space_and_one_its_bound() -> None:
    action = ArraySpec(name="a", shape=(2, 2), low=(0.0, -2.0, 10.0, -np.inf),
                       high=(100.0, 2.0, 20.0, 3.0))  # fmt: skip
    spec = spec_of(action)
    seen = np.zeros(3, np.float32)
    assert constant(spec, 0, 0, 0, 0).act(seen).tolist() == [[50, 0], [15, 0]]
    assert constant(spec, 0.5, 1, -1, 2).act(seen).tolist() == [[75, 2], [10, 2]]
    assert constant(spec, 9, -9, 9, 9).act(seen).tolist() == [[100, -2], [20, 3]]
    assert constant(CHOICE, 0.0, 1.0, 0.5).act(seen) == 1
    with pytest.raises(InputError, match="action: expected a choice or numbers of type float"):
        ActionMap(ArraySpec(name="a", shape=(1,), dtype="int32"))


def test_observations_of_many_arrays_are_joined_in_the_order_of_the_spec() -> None:
    arrays = (ArraySpec(name="b", shape=(2,)), ArraySpec(name="a", shape=(1, 2), dtype="uint8"))
    spec = spec_of(observation=arrays)
    one = {"a": np.array([[3, 4]], np.uint8), "b": np.array([1, 2], np.float32)}
    assert flat(one, spec).tolist() == [1, 2, 3, 4]
    many = {name: np.stack([array, array]) for name, array in one.items()}
    assert flat(many, spec, 2).tolist() == [[1, 2, 3, 4]] * 2
    assert flat(one, spec).dtype == np.float32


def test_weights_that_do_not_fit_are_refused() -> None:
    weights = random_policy(BOX).arrays()
    for wrong in (
        {k: v for k, v in weights.items() if k != "log_std"},
        {**weights, "log_std": np.zeros(3, np.float32)},
        {**weights, "layers.0.weight": np.zeros((16, 4), np.float32)},
        {**weights, "layers.1.bias": np.zeros((2, 1), np.float32)},
        {**weights, "layers.2.bias": np.zeros(2, np.float32)},
        {**weights, "observation.mean": np.zeros(3, np.float32)},
        {},
    ):
        with pytest.raises(InputError, match="policy: expected weights of shapes"):
            NetworkPolicy.load(wrong, BOX, Config())


def test_the_paper_s_networks_have_one_hidden_layer_of_16_relu_units() -> None:
    config = preset("a2c", "paper")
    assert config.hidden == (16,)
    assert config.activation == "relu"
