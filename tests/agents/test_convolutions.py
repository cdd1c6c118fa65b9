"""Convolutions over images and rings: against torch's, with the arrays that specs have."""

import numpy as np
import pytest
import torch
from contracts import spec_with
from nets import bound
from rotorgram.agents import Config
from rotorgram.agents.layers import Weights
from rotorgram.agents.networks import CNN, Network
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.spec import IMAGE, PICTURE, RINGS, ArraySpec, SpecError
from rotorgram.models import InputError
from torch import Tensor
from torch.nn import functional

DICE = np.random.default_rng(0)
BATCH = 5
PLAIN = ArraySpec(name="plain", shape=(4,))
DEPTH = ArraySpec(name="picture", shape=(6, 9), axes=IMAGE)
LIDAR = ArraySpec(name="lidar", shape=(3, 10), axes=RINGS)
AFTER = ArraySpec(name="after", shape=(2,))
ARRAYS = [PLAIN, DEPTH, LIDAR, AFTER]
SMALL = Config(network="cnn", filters=(3, 2), hidden=(7,), activation="tanh")


def normal(*shape: int) -> np.ndarray:
    return DICE.normal(size=shape).astype(np.float32)


def network_of(kind: type[Network] = CNN) -> tuple[Network, Weights]:
    network = kind(ARRAYS, 2, SMALL)
    weights = bound(network)
    weights.values[:] = 0.5 * normal(weights.values.size)
    return network, weights


def image_features(picture: Tensor, weights: list[Tensor]) -> Tensor:
    """Two convolutions of 3 × 3 with the stride 2; the edges are repeated."""
    found = picture[:, None]
    for weight in weights:
        padded = functional.pad(found, (1, 1, 1, 1), mode="replicate")
        kernel = weight[:, 1:].reshape(len(weight), -1, 3, 3)
        found = torch.tanh(functional.conv2d(padded, kernel, weight[:, 0], stride=2))
    return found.flatten(1)


def ring_features(found: Tensor, weights: list[Tensor]) -> Tensor:
    """Two convolutions of 3 along the azimuths, with the stride 2; rings are channels."""
    for weight in weights:
        padded = functional.pad(found, (1, 1), mode="circular")
        kernel = weight[:, 1:].reshape(len(weight), -1, 3)
        found = torch.tanh(functional.conv1d(padded, kernel, weight[:, 0], stride=2))
    return found.flatten(1)


def by_torch(arrays: dict[str, Tensor], inputs: Tensor) -> Tensor:
    plain, picture, lidar, after = inputs.split([4, 54, 30, 2], dim=1)
    picture_weights = [arrays[f"layers.0.layers.0.layers.{i}.weight"] for i in range(2)]
    lidar_weights = [arrays[f"layers.0.layers.1.layers.{i}.weight"] for i in range(2)]
    seen = image_features(picture.reshape(-1, 6, 9), picture_weights)
    around = ring_features(lidar.reshape(-1, 3, 10), lidar_weights)
    found = torch.cat((plain, seen, around, after), dim=1)
    hidden, last = (arrays[f"layers.{i}.weight"] for i in (1, 2))
    found = torch.tanh(hidden[:, 0] + found @ hidden[:, 1:].T)
    return last[:, 0] + found @ last[:, 1:].T


def test_outputs_and_gradients_are_those_of_torch() -> None:
    """Sizes along the axes: 6, 3, 2 and 9, 5, 3 of the image; 10, 5, 3 of the rings."""
    network, weights = network_of()
    theirs = {k: torch.tensor(a, requires_grad=True) for k, a in weights.arrays.items()}
    seen = normal(BATCH, 90)
    inputs = torch.tensor(seen, requires_grad=True)
    expected = by_torch(theirs, inputs)
    found = network.forward(seen.T).T
    np.testing.assert_allclose(found, expected.detach(), rtol=1e-5, atol=1e-5)
    slope = normal(BATCH, 2)
    expected.backward(torch.from_numpy(slope))
    network.learn(slope.T.copy())
    for name, gradient in weights.gradients.items():
        grad = theirs[name].grad
        assert grad is not None
        np.testing.assert_allclose(gradient, grad, rtol=1e-4, atol=1e-5, err_msg=name)
    network.forward(seen.T)
    by_inputs = network.back(slope.T.copy())
    assert inputs.grad is not None
    np.testing.assert_allclose(by_inputs.T, inputs.grad, rtol=1e-4, atol=1e-5)


def test_two_networks_compute_together_as_each_alone() -> None:
    first, of_first = network_of()
    second, of_second = network_of()
    both = CNN(ARRAYS, 2, SMALL)
    weights = Weights.zeros({name: (2, *shape) for name, shape in both.shapes.items()})
    both.bind(weights)
    for number, one in enumerate((of_first, of_second)):
        for name, array in one.arrays.items():
            weights.arrays[name][number] = array
    seen = normal(90, BATCH)
    slope = normal(2, 2, BATCH)
    found = both.forward(seen).copy()
    both.learn(slope.copy())
    for number, (network, one) in enumerate(((first, of_first), (second, of_second))):
        np.testing.assert_allclose(found[number], network.forward(seen), rtol=1e-5, atol=1e-6)
        network.learn(slope[number].copy())
        for name, gradient in one.gradients.items():
            ours = weights.gradients[name][number]
            np.testing.assert_allclose(ours, gradient, rtol=1e-4, atol=1e-5, err_msg=name)


def test_a_picture_is_seen_with_its_colours() -> None:
    """Channels come last, as cameras give them: against torch, where they come first."""
    colours = ArraySpec(name="front", shape=(5, 4, 3), dtype="uint8", axes=PICTURE)
    network = CNN([PLAIN, colours], 2, SMALL)
    weights = bound(network)
    weights.values[:] = 0.5 * normal(weights.values.size)
    seen = normal(BATCH, 64)
    network.forward(seen.T)
    found = network.layers[0].forward(np.vstack((np.ones((1, BATCH)), seen.T)))[1:].T
    names = [f"layers.0.layers.0.layers.{i}.weight" for i in range(2)]
    channels = torch.from_numpy(seen[:, 4:].reshape(BATCH, 5, 4, 3)).permute(0, 3, 1, 2)
    expected = channels
    for name in names:
        weight = torch.from_numpy(weights.arrays[name].copy())
        padded = functional.pad(expected, (1, 1, 1, 1), mode="replicate")
        kernel = weight[:, 1:].reshape(len(weight), -1, 3, 3)
        expected = torch.tanh(functional.conv2d(padded, kernel, weight[:, 0], stride=2))
    np.testing.assert_allclose(found[:, :4], seen[:, :4])
    np.testing.assert_allclose(found[:, 4:], expected.flatten(1), rtol=1e-5, atol=1e-5)


def test_pictures_of_cameras_are_images_for_a_cnn() -> None:
    """Beside plain arrays alone; nothing is drawn."""
    spec = spec_with("rotorgram/Landing-v0", cameras=["down@16x12,down_depth@16x12"])
    assert [array.axes for array in spec.observation] == [(), PICTURE, PICTURE]
    network = CNN(spec.observation, 2, SMALL)
    shapes = [network.shapes[f"layers.0.layers.{i}.layers.0.weight"] for i in range(2)]
    assert shapes == [(3, 28), (3, 10)]


def test_a_ring_that_turns_turns_what_is_seen() -> None:
    """Two azimuths further: the outputs of the first convolution are one place further."""
    config = Config(network="cnn", filters=(3,), hidden=(1,))
    network = CNN([LIDAR], 1, config)
    weights = bound(network)
    weights.values[:] = normal(weights.values.size)
    seen = normal(3, 10)
    features = []
    for turned in (seen, np.roll(seen, 2, axis=1)):
        network.forward(turned.reshape(-1, 1))
        features.append(network.layers[0].forward(np.append(1, turned)[:, None])[1:, 0].copy())
    plain, further = (part.reshape(3, 5) for part in features)
    np.testing.assert_allclose(further, np.roll(plain, 1, axis=1), rtol=1e-6)
    assert np.ptp(plain) > 0.1


def test_an_mlp_takes_images_flat_and_a_cnn_of_plain_arrays_is_refused() -> None:
    mlp, _ = network_of(Network)
    assert mlp.shapes["layers.0.weight"] == (7, 91)
    with pytest.raises(InputError, match="network: expected rays in rows or rings, or pictures,"):
        CNN([PLAIN, AFTER], 2, SMALL)


@pytest.mark.parametrize(
    ("sensors", "axes"),
    [
        ({"depth": {"rows": 6, "columns": 32}}, IMAGE),
        ({"lidar": {"model": "os0"}}, RINGS),
        ({"tof": {"model": "vl53l5cx"}}, IMAGE),
        ({"tof": {"model": "multiranger"}}, ()),
    ],
)
def test_sensors_tell_their_axes(sensors: dict[str, dict[str, object]], axes: object) -> None:
    env = LocalVectorEnv("rotorgram/Forest-v0", 1, backend="rigid", sensors=sensors)
    array = env.env_spec.observation[1]
    env.close()
    assert array.axes == axes
    again = type(env.env_spec).from_json(env.env_spec.to_json())
    assert again.observation[1] == array


def test_every_axis_has_a_name_or_none() -> None:
    with pytest.raises(SpecError, match=r"picture: expected 2 names of axes, got \('row',\)"):
        ArraySpec(name="picture", shape=(6, 9), axes=("row",))
