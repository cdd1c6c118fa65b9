"""Networks and gradients by hand: against torch, finite differences and written-out numbers."""

from typing import Any

import numpy as np
import pytest
import torch
from drones import log_of
from nets import bound, config_of, mlp_of, random_policy
from rotorgram.agents.config import Config
from rotorgram.agents.layers import Affine, Layer, Relu, Tanh, Weights, orthogonal
from rotorgram.agents.networks import Network
from rotorgram.agents.optimizers import Adam, clip_norm
from rotorgram.agents.policies import NetworkPolicy
from rotorgram.agents.vpg import VPG, VPGConfig
from rotorgram.envs.spec import ArraySpec, Discrete
from scripted import spec_of

DICE = np.random.default_rng(0)
INPUTS = 5
BATCH = 17


def normal(*shape: int) -> np.ndarray:
    return DICE.normal(size=shape).astype(np.float32)


def actor(*, discrete: bool) -> NetworkPolicy:
    action = Discrete(choices=3) if discrete else ArraySpec(name="action", shape=(3,))
    return random_policy(spec_of(action, [ArraySpec(name="seen", shape=(INPUTS,))]), size=0.5)


def tensors(weights: Weights) -> dict[str, torch.Tensor]:
    return {k: torch.tensor(a, requires_grad=True) for k, a in weights.arrays.items()}


def torch_mlp(arrays: dict[str, torch.Tensor], inputs: torch.Tensor, activation: str) -> Any:
    count = sum(name.startswith("layers.") for name in arrays)
    for i in range(count):
        weight = arrays[f"layers.{i}.weight"]
        inputs = weight[:, 0] + inputs @ weight[:, 1:].T
        if i < count - 1:
            inputs = torch.relu(inputs) if activation == "relu" else torch.tanh(inputs)
    return inputs


def agree(weights: Weights, expected: dict[str, torch.Tensor]) -> None:
    for name, gradient in weights.gradients.items():
        theirs = expected[name].grad
        assert theirs is not None
        np.testing.assert_allclose(gradient, theirs, rtol=2e-5, atol=2e-6, err_msg=name)


def test_arrays_are_views_of_one() -> None:
    weights = Weights.zeros({"a.x": (2, 3), "b.x": (2,), "b.y": (1, 2)})
    weights.part("b.").arrays["y"][:] = 7
    weights.gradients["a.x"][1] = 3
    assert weights.values.tolist() == [0, 0, 0, 0, 0, 0, 0, 0, 7, 7]
    assert weights.slopes.tolist() == [0, 0, 0, 3, 3, 3, 0, 0, 0, 0]


@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("hidden", [(16,), (8, 9), (7, 6, 5)])
def test_gradients_are_those_of_torch(hidden: tuple[int, ...], activation: str) -> None:
    net, weights = mlp_of((INPUTS, *hidden, 2), activation)
    weights.values[:] = 0.5 * normal(weights.values.size)
    seen = normal(BATCH, INPUTS)
    slope = normal(BATCH, 2)
    theirs = tensors(weights)
    output = torch_mlp(theirs, torch.from_numpy(seen), activation)
    weighted = output * torch.from_numpy(slope)
    weighted.sum().backward()
    found = net.forward(seen.T).T
    np.testing.assert_allclose(found, output.detach(), rtol=1e-5, atol=1e-5)
    net.learn(slope.T)
    agree(weights, theirs)


@pytest.mark.parametrize("discrete", [False, True], ids=["continuous", "discrete"])
def test_log_probability_entropy_and_their_gradients_are_those_of_torch(discrete: bool) -> None:
    ours = actor(discrete=discrete)
    seen = normal(BATCH, INPUTS)
    actions = 2 * normal(BATCH, 3)
    if discrete:
        actions = DICE.integers(3, size=(BATCH, 1)).astype(np.float32)
    theirs = tensors(ours.weights)
    output = torch_mlp(theirs, torch.from_numpy(seen), "relu")
    given = torch.from_numpy(actions)
    if discrete:
        choices: Any = torch.distributions.Categorical(logits=output)
        expected = choices.log_prob(given[:, 0])
        entropy = choices.entropy().mean()
    else:
        choices = torch.distributions.Normal(output, theirs["log_std"].exp())
        expected = choices.log_prob(given).sum(1)
        entropy = choices.entropy().sum(1).mean()
    got, mean = ours.head.score(ours.network.forward(seen.T), actions.T)
    np.testing.assert_allclose(got, expected.detach(), rtol=1e-5, atol=1e-5)
    assert mean == pytest.approx(entropy.item(), rel=1e-5)
    slope = normal(BATCH)
    weighted = expected * torch.from_numpy(slope)
    loss = weighted.sum() - 0.7 * entropy
    loss.backward()
    ours.network.learn(ours.head.back(slope, -0.7))
    agree(ours.weights, theirs)


def test_adam_is_torch_s() -> None:
    weights = Weights.zeros({"w": (40,)})
    weights.values[:] = normal(40)
    theirs = torch.tensor(weights.values.copy(), requires_grad=True)
    reference = torch.optim.Adam([theirs], lr=0.01)
    ours = Adam(weights, 1e-8)
    for step in range(50):
        scale = 10.0 ** (step % 5 - 3)
        weights.slopes[:] = scale * normal(40)
        theirs.grad = torch.from_numpy(weights.slopes.copy())
        reference.step()
        ours.step(0.01)
        np.testing.assert_allclose(weights.values, theirs.detach(), rtol=1e-6, atol=2e-7)


def test_a_norm_is_clipped_as_in_torch() -> None:
    slopes = np.array([3, 4], np.float32)
    clip_norm(slopes, 6.0)
    assert slopes.tolist() == [3, 4]
    clip_norm(slopes, 0.5)
    np.testing.assert_allclose(slopes, [0.3, 0.4], rtol=1e-6)


@pytest.mark.parametrize("shape", [(16, 3), (3, 16), (4, 4)])
def test_the_first_weights_are_orthogonal(shape: tuple[int, int]) -> None:
    q = orthogonal(np.random.default_rng(1), shape, 2.0)
    product = q @ q.T if shape[0] < shape[1] else q.T @ q
    identity = np.eye(min(shape))
    np.testing.assert_allclose(product, 4 * identity, atol=1e-12)
    other = orthogonal(np.random.default_rng(2), shape, 2.0)
    assert not np.allclose(q, other)


def test_an_actor_begins_near_zero_and_a_net_with_gains() -> None:
    ours = VPG(log_of(), VPGConfig(log_std=-0.5), 0).policy()
    arrays = ours.weights.arrays
    first = arrays["layers.0.weight"]
    columns = np.linalg.norm(first[:, 1:], axis=0)
    rows = np.linalg.norm(arrays["layers.1.weight"], axis=1)
    np.testing.assert_allclose(columns, 2**0.5, rtol=1e-5)
    np.testing.assert_allclose(rows, 0.01, rtol=1e-5)
    assert arrays["log_std"].tolist() == [-0.5]
    assert not first[:, 0].any()


class Squashed(Network):
    """It begins and ends with layers without weights."""

    def build(self, inputs: int, outputs: int, config: Config) -> list[Layer]:
        return [Tanh(), Affine(inputs, outputs), Relu()]


def test_activations_may_come_first_and_last() -> None:
    network = Squashed([ArraySpec(name="seen", shape=(2,))], 3, VPGConfig())
    weights = bound(network)
    network.initialise(np.random.default_rng(0), 0.01)
    inputs = np.array([[0.5], [-2.0]], np.float32)
    network.forward(inputs)
    assert inputs.tolist() == [[0.5], [-2.0]]
    columns = np.linalg.norm(weights.arrays["layers.0.weight"][:, 1:], axis=0)
    np.testing.assert_allclose(columns, 0.01, rtol=1e-5)


def test_bytes_of_pictures_come_in_as_0_to_1() -> None:
    """Others stay, as whole numbers of another range; the first sees 2 x, the second 1 + 5 x."""
    pixels = ArraySpec(name="front", shape=(1, 1, 3), dtype="uint8", low=0.0, high=255.0)
    count = ArraySpec(name="gates", shape=(1,), dtype="uint8", low=0.0, high=9.0)
    network = Network([count, pixels], 2, config_of((), "tanh"))
    weights = bound(network)
    weights.arrays["layers.0.weight"][:] = [[0, 2, 0, 0, 2], [1, 0, 5, 0, 0]]
    inputs = np.array([[3.0], [51.0], [7.0], [255.0]], np.float32)
    np.testing.assert_allclose(network.forward(inputs), [[8.0], [2.0]], rtol=1e-6)
    by_inputs = network.back(np.array([[1.0], [1.0]], np.float32))
    np.testing.assert_allclose(by_inputs, [[2.0], [5 / 255], [0.0], [2 / 255]], rtol=1e-6)


def scales_as_torch(
    network: Network,
    weights: Weights,
    inputs: np.ndarray,
    tensor: torch.Tensor,
    scaled: torch.Tensor,
) -> None:
    """The outputs and all gradients are torch's, of an MLP that sees the scaled tensor."""
    arrays = tensors(weights)
    outputs = torch_mlp(arrays, scaled, "tanh")
    got = network.forward(inputs)
    np.testing.assert_allclose(got, outputs.detach().numpy().T, rtol=1e-5, atol=1e-6)
    slope = normal(2, BATCH)
    outputs.backward(torch.tensor(slope.T))
    network.learn(slope.copy())
    agree(weights, arrays)
    network.forward(inputs)
    back = network.back(slope.copy())
    theirs = tensor.grad
    assert theirs is not None
    np.testing.assert_allclose(back, theirs.numpy().T, rtol=1e-4, atol=1e-5)


def test_distances_come_in_as_nearness() -> None:
    shapes = ((1, 2), (1, 1, 1))  # of rays, and of a picture
    near = [ArraySpec(name=f"near {s}", shape=s, low=0.0, unit="m") for s in shapes]
    plain = [ArraySpec(name=f"plain {n}", shape=(n,)) for n in (1, 2)]
    arrays = [plain[0], near[0], plain[1], near[1]]
    network = Network(arrays, 2, config_of((4,), "tanh"))
    weights = bound(network)
    weights.values[:] = normal(weights.values.size)
    inputs = np.abs(normal(6, BATCH)) * 3.0
    tensor = torch.tensor(inputs.T, requires_grad=True)
    nearness = 2 / (1 + tensor / 2) - 0.5
    is_near = torch.tensor([False, True, True, False, False, True])
    scales_as_torch(network, weights, inputs, tensor, torch.where(is_near, nearness, tensor))


@pytest.mark.parametrize(("reach", "unit"), [(2.0, 1.0), (0.5, 0.5)])
def test_lengths_come_in_softened(reach: float, unit: float) -> None:
    units = ("m", "m/s", "m")
    seen = ArraySpec(name="seen", shape=(3,), low=-9.0, high=9.0, unit=units)
    height = ArraySpec(name="height", shape=(1,), low=0.0, high=9.0, unit="m")
    last = ArraySpec(name="last", shape=(2,), low=-9.0, high=9.0, unit="m")
    network = Network([seen, height, last], 2, config_of((4,), "tanh", reach=reach))
    weights = bound(network)
    weights.values[:] = normal(weights.values.size)
    inputs = normal(6, BATCH) * 3.0
    tensor = torch.tensor(inputs.T, requires_grad=True)
    is_length = torch.tensor([True, False, True, False, True, True])
    softened = tensor / unit / (1 + tensor.abs() / reach)
    scales_as_torch(network, weights, inputs, tensor, torch.where(is_length, softened, tensor))
