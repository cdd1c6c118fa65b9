"""Normal numbers of every step: each world's stream is its own, however many are drawn at once."""

from typing import Any

import numpy as np
import pytest
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim import make_world
from rotorgram.sim.random import NumpyNoise

USE = (3, 1)


def noise_of(shape: tuple[int, ...] = (), size: int = 2, seed: int = 5) -> NumpyNoise:
    """A noise whose worlds have the seeds seed, seed + 1..."""
    noise, worlds = NumpyNoise(shape, size, USE), shape[0] if shape else 1
    noise.seed(range(worlds), [seed + i for i in range(worlds)])
    return noise


def stream(seed: int, rows: int, size: int = 2, use: tuple[int, ...] = USE) -> np.ndarray:
    """What the stream of a seed's child gives, written out."""
    child = np.random.SeedSequence(seed, spawn_key=use)
    return np.random.default_rng(child).standard_normal((rows, size))


def test_a_single_world_has_the_numbers_of_its_seeds_child() -> None:
    noise = noise_of()
    drawn = np.array([noise.normal() for _ in range(600)])  # more than are drawn at once
    np.testing.assert_array_equal(drawn, stream(5, 600))


def test_a_batch_is_so_many_single_worlds() -> None:
    noise = noise_of((3, 1))
    drawn = np.array([noise.normal() for _ in range(600)])
    assert drawn.shape == (600, 3, 1, 2)
    for world in range(3):
        np.testing.assert_array_equal(drawn[:, world, 0], stream(5 + world, 600))


def test_many_worlds_draw_fewer_at_once_and_the_same() -> None:
    """2^16 worlds of 64 numbers: two rows at once."""
    noise = NumpyNoise((1 << 16, 1), 64, USE)
    noise.seed([9], [4])
    mask = (np.arange(1 << 16) == 9)[:, None]
    drawn = [noise.normal(mask)[9, 0] for _ in range(5)]
    np.testing.assert_array_equal(drawn, stream(4, 5, 64))


@pytest.mark.parametrize("worlds", [1, 3])
def test_a_world_outside_the_mask_stays_where_it_is(worlds: int) -> None:
    noise = noise_of((worlds, 1) if worlds > 1 else ())
    noise.normal()
    held: Any = np.arange(worlds)[:, None] > 0 if worlds > 1 else np.bool_(False)
    first = noise.normal(held)
    assert first.shape == ((3, 1, 2) if worlds > 1 else (2,))
    np.testing.assert_array_equal(first.reshape(worlds, 2)[0], (0.0, 0.0))
    after = noise.normal().reshape(worlds, 2)
    np.testing.assert_array_equal(after[0], stream(5, 2)[1])
    for world in range(1, worlds):
        np.testing.assert_array_equal(after[world], stream(5 + world, 3)[2])


def test_a_seed_begins_its_worlds_stream_and_no_other() -> None:
    noise = noise_of((2, 1))
    noise.normal()
    noise.seed([0, 1], [7, None])
    drawn = noise.normal()[:, 0]
    np.testing.assert_array_equal(drawn, (stream(7, 1)[0], stream(6, 2)[1]))
    single = noise_of()
    single.normal()
    single.seed([0], [7])
    np.testing.assert_array_equal(single.normal(), stream(7, 1)[0])


def test_what_was_given_stays_as_it_was() -> None:
    for shape in ((), (2, 1)):
        noise = noise_of(shape)
        first = noise.normal()
        kept = first.copy()
        for _ in range(300):
            noise.normal()
        np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("worlds", [1, 2])
def test_a_world_seeds_its_noises_and_its_starts_stay(worlds: int) -> None:
    world, every = make_world(Vehicle.load(), worlds), np.ones((worlds, 1), bool)
    noises = [world.noise(3, 1), world.noise(2, USE)]
    world.seed(every, [11 + i for i in range(worlds)])
    for _ in range(10):
        for noise in noises:
            noise.normal()
    starts = np.reshape(world.draw(every).uniform(0.0, 1.0), worlds)
    world.seed(every, [11 + i for i in range(worlds)])
    for i in range(worlds):
        child = np.random.SeedSequence(11 + i, spawn_key=(0,))
        assert starts[i] == np.random.default_rng(child).uniform()
    for noise, size, use in zip(noises, (3, 2), ((1,), USE), strict=True):
        numbers = noise.normal().reshape(worlds, size)
        for i in range(worlds):
            np.testing.assert_array_equal(numbers[i], stream(11 + i, 1, size, use)[0])
