"""The policy that flies (NumPy) is the policy that learns (torch), in the units of the space."""

from typing import Any

import numpy as np
import pytest
import torch
from rotorgram.agents.networks import Actor, Critic, arrays_of, load_arrays
from rotorgram.agents.policies import ActionMap, NetworkPolicy, flat
from rotorgram.envs.spec import ArraySpec, Discrete
from rotorgram.models.errors import InputError
from scripted import spec_of

BOX = spec_of()
CHOICE = spec_of(Discrete(n=3))


def actor(spec: Any, seed: int = 0) -> Actor:
    torch.manual_seed(seed)
    actions = ActionMap(spec.action)
    result = Actor(3, actions.outputs, discrete=actions.discrete)
    with torch.no_grad():
        for parameter in result.parameters():
            parameter.add_(torch.randn_like(parameter))
    return result


def constant(spec: Any, *outputs: float) -> NetworkPolicy:
    """A policy that gives the same for every observation of three numbers."""
    weights = {
        "hidden.weight": np.zeros((16, 3), np.float32),
        "hidden.bias": np.zeros(16, np.float32),
        "output.weight": np.zeros((len(outputs), 16), np.float32),
        "output.bias": np.array(outputs, np.float32),
    }
    if not isinstance(spec.action, Discrete):
        weights["log_std"] = np.zeros(len(outputs), np.float32)
    return NetworkPolicy(weights, spec)


@pytest.mark.parametrize("spec", [BOX, CHOICE], ids=["box", "discrete"])
def test_numpy_and_torch_agree(spec: Any) -> None:
    network = actor(spec)
    policy = NetworkPolicy(arrays_of(network), spec)
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    expected = network(torch.from_numpy(observations)).detach().numpy()
    np.testing.assert_allclose(policy.output(observations), expected, rtol=1e-5, atol=1e-5)
    each = np.array([policy.output(row[np.newaxis])[0] for row in observations])
    np.testing.assert_allclose(each, expected, rtol=1e-5, atol=1e-5)


def test_log_probability_and_entropy() -> None:
    network = actor(BOX)
    observations, actions = torch.randn(20, 3), 3 * torch.randn(20, 2)
    assert network.log_std is not None
    reference = torch.distributions.Normal(network(observations), network.log_std.exp())
    log_probability, entropy = network.score(observations, actions)
    torch.testing.assert_close(log_probability, reference.log_prob(actions).sum(1))
    torch.testing.assert_close(entropy, reference.entropy().sum(1))
    network = actor(CHOICE)
    actions = torch.randint(3, (20, 1)).float()
    choices = torch.distributions.Categorical(logits=network(observations))
    log_probability, entropy = network.score(observations, actions)
    torch.testing.assert_close(log_probability, choices.log_prob(actions.squeeze(1)))
    torch.testing.assert_close(entropy, choices.entropy())


def test_gaussian_sampling_has_the_mean_and_deviation_of_the_policy() -> None:
    network = actor(BOX)
    policy = NetworkPolicy(arrays_of(network), BOX)
    observation = np.ones((1, 3), np.float32)
    noise = policy.draw_noise(np.random.default_rng(0), 40_000)
    drawn = policy.sample(np.repeat(observation, 40_000, axis=0), noise)
    assert network.log_std is not None
    std = np.exp(network.log_std.detach().numpy())
    mean = policy.output(observation)[0]
    np.testing.assert_allclose(drawn.mean(0), mean, atol=5 * std.max() / 200)
    np.testing.assert_allclose(drawn.std(0), std, rtol=0.02)
    assert drawn.dtype == np.float32


def test_categorical_sampling_has_the_probabilities_of_the_policy() -> None:
    network = actor(CHOICE, seed=3)
    policy = NetworkPolicy(arrays_of(network), CHOICE)
    noise = policy.draw_noise(np.random.default_rng(0), 40_000)
    drawn = policy.sample(np.zeros((40_000, 3), np.float32), noise)
    counts = np.bincount(drawn[:, 0].astype(int), minlength=3)
    expected = torch.softmax(network(torch.zeros(1, 3)), 1).detach().numpy()[0]
    np.testing.assert_allclose(counts / 40_000, expected, atol=0.012)
    envs = policy.actions.to_envs(drawn)
    assert (envs.dtype, envs.shape) == (np.int64, (40_000,))


def test_only_the_env_gets_clipped_actions() -> None:
    policy = constant(BOX, 5.0, 0.25)
    drawn = policy.sample(np.zeros((1, 3), np.float32), np.array([[2.0, 0.0]], np.float32))
    assert drawn.tolist() == [[7.0, 0.25]]
    assert policy.actions.to_envs(drawn).tolist() == [[1.0, 0.25]]
    assert policy.act(np.zeros(3, np.float32)).tolist() == [1.0, 0.25]


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
    weights = arrays_of(actor(BOX))
    for wrong in (
        {k: v for k, v in weights.items() if k != "log_std"},
        {**weights, "log_std": np.zeros(3, np.float32)},
        {**weights, "hidden.weight": np.zeros((16, 4), np.float32)},
        {**weights, "output.bias": np.zeros((2, 1), np.float32)},
        {},
    ):
        with pytest.raises(InputError, match="policy: expected weights of shapes"):
            NetworkPolicy(wrong, BOX)


def test_the_first_policy_holds_the_thrust() -> None:
    torch.manual_seed(0)
    policy = NetworkPolicy(arrays_of(Actor(3, 2)), BOX)
    assert np.abs(policy.act(np.array([3, 5, 1], np.float32))).max() < 0.1


def test_the_paper_s_networks_have_one_hidden_layer_of_16_relu_units() -> None:
    arrays = arrays_of(Actor(1, 1))
    assert {k: v.shape for k, v in arrays.items()} == {
        "log_std": (1,),
        "hidden.weight": (16, 1),
        "hidden.bias": (16,),
        "output.weight": (1, 16),
        "output.bias": (1,),
    }
    critic = Critic(1)
    load_arrays(critic, {
        "hidden.weight": np.ones((16, 1), np.float32),
        "hidden.bias": np.zeros(16, np.float32),
        "output.weight": np.ones((1, 16), np.float32),
        "output.bias": np.zeros(1, np.float32),
    })  # fmt: skip
    assert critic(torch.tensor([[2.0], [-2.0]])).tolist() == [32.0, 0.0]


def test_standard_deviation_is_bounded() -> None:
    network = actor(BOX)
    assert network.log_std is not None
    with torch.no_grad():
        network.log_std.copy_(torch.tensor([9.0, -9.0]))
    network.clamp_()
    assert network.log_std.tolist() == [1.0, -4.0]
