"""The policy that flies (NumPy) is the policy that learns (torch)."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from rotorgram.agents.networks import Actor, Critic, arrays_of, load_arrays
from rotorgram.agents.policies import NetworkPolicy

BOX = spaces.Box(-1, 1, (2,), np.float32)


def actor(space: spaces.Space, seed: int = 0) -> Actor:
    torch.manual_seed(seed)
    result = Actor(3, space)
    with torch.no_grad():
        for parameter in result.parameters():
            parameter.add_(torch.randn_like(parameter))
    return result


@pytest.mark.parametrize("space", [BOX, spaces.Discrete(3)], ids=["box", "discrete"])
def test_numpy_and_torch_agree(space: spaces.Space) -> None:
    network = actor(space)
    policy = NetworkPolicy(arrays_of(network))
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    expected = network(torch.from_numpy(observations)).detach().numpy()
    got = np.array([policy.output(o) for o in observations])
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)


def test_gaussian_log_probability_and_entropy() -> None:
    network = actor(BOX)
    observations, actions = torch.randn(20, 3), 3 * torch.randn(20, 2)
    reference = torch.distributions.Normal(network(observations), network.log_std.exp())
    log_probability, entropy = network.score(observations, actions)
    torch.testing.assert_close(log_probability, reference.log_prob(actions).sum(1))
    torch.testing.assert_close(entropy, reference.entropy().sum(1))


def test_categorical_log_probability_and_entropy() -> None:
    network = actor(spaces.Discrete(3))
    observations, actions = torch.randn(20, 3), torch.randint(3, (20, 1)).float()
    reference = torch.distributions.Categorical(logits=network(observations))
    log_probability, entropy = network.score(observations, actions)
    torch.testing.assert_close(log_probability, reference.log_prob(actions.squeeze(1)))
    torch.testing.assert_close(entropy, reference.entropy())


def test_gaussian_sampling_has_the_mean_and_deviation_of_the_policy() -> None:
    network = actor(BOX)
    policy = NetworkPolicy(arrays_of(network))
    observation = np.ones(3, np.float32)
    noise = policy.draw_noise(np.random.default_rng(0), 40_000)
    drawn = np.array([policy.sample(observation, row) for row in noise])
    std = np.exp(network.log_std.detach().numpy())
    np.testing.assert_allclose(drawn.mean(0), policy.output(observation), atol=5 * std.max() / 200)
    np.testing.assert_allclose(drawn.std(0), std, rtol=0.02)
    assert drawn.dtype == np.float32


def test_categorical_sampling_has_the_probabilities_of_the_policy() -> None:
    network = actor(spaces.Discrete(3), seed=3)
    policy = NetworkPolicy(arrays_of(network))
    observation = np.zeros(3, np.float32)
    noise = policy.draw_noise(np.random.default_rng(0), 40_000)
    counts = np.bincount([int(policy.sample(observation, row)[0]) for row in noise], minlength=3)
    expected = torch.softmax(network(torch.zeros(1, 3)), 1).detach().numpy()[0]
    np.testing.assert_allclose(counts / 40_000, expected, atol=0.012)


def test_only_the_env_gets_clipped_actions() -> None:
    weights = {
        "hidden.weight": np.zeros((16, 1), np.float32),
        "hidden.bias": np.zeros(16, np.float32),
        "output.weight": np.zeros((1, 16), np.float32),
        "output.bias": np.array([5.0], np.float32),
        "log_std": np.array([0.0], np.float32),
    }
    policy = NetworkPolicy(weights)
    drawn = policy.sample(np.zeros(1, np.float32), np.array([2.0], np.float32))
    assert drawn.tolist() == [7.0]
    assert policy.to_env(drawn).tolist() == [1.0]
    assert policy.act(np.zeros(1, np.float32)).tolist() == [1.0]


def test_the_first_policy_holds_the_thrust() -> None:
    torch.manual_seed(0)
    policy = NetworkPolicy(arrays_of(Actor(3, BOX)))
    assert np.abs(policy.act(np.array([3, 5, 1], np.float32))).max() < 0.1


def test_critic_gives_one_value_a_row() -> None:
    assert Critic(3)(torch.zeros(7, 3)).shape == (7,)


def test_the_paper_s_networks_have_one_hidden_layer_of_16_relu_units() -> None:
    arrays = arrays_of(Actor(1, spaces.Box(-1, 1, (1,), np.float32)))
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
    with torch.no_grad():
        network.log_std.copy_(torch.tensor([9.0, -9.0]))
    network.clamp_()
    assert network.log_std.tolist() == [1.0, -4.0]
