"""Philox 4x32-10 by its published answers; numbers as functions of seed, use, episode and step."""

import math
from zlib import crc32

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim import make_world
from rotorgram.sim.random import (
    START,
    Draw,
    Random,
    normal,
    philox,
    uniform,
    words_of,
)
from tables import SIM
from worlds import begin


@pytest.mark.parametrize(("counter", "key", "words"), SIM["philox"]["rows"])
def test_published_answers(counter: list[int], key: list[int], words: list[int]) -> None:
    counters = np.array([counter, (1, 2, 3, 4)], np.uint32)
    found = philox(counters, np.array(key, np.uint32))
    assert found.dtype == np.uint32
    assert found[0].tolist() == words


def test_words_are_those_of_block_step_episode_and_use() -> None:
    key = np.array((7, 8), np.uint32)
    words = words_of(key, 3, episode=5, step=9, count=6)
    blocks = philox(np.array([(0, 9, 5, 3), (1, 9, 5, 3)], np.uint32), key).ravel()
    assert words.tolist() == blocks[:6].tolist()
    second = words_of(key, 3, 5, 9, 2, first=1)
    assert second.tolist() == words[4:].tolist()


def test_uniform_and_normal_by_hand() -> None:
    words = np.array((0, 2**31, 2**30, 2**32 - 1), np.uint32)
    assert uniform(words).tolist() == [0.0, 0.5, 0.25, 1 - 2.0**-32]
    # Box and Muller: sqrt(-2 log(1 - 1/2)) at a quarter turn, and at no turn of size 0.
    found = normal(np.array((2**31, 0, 2**30, 0), np.uint32))
    expected = (0.0, 0.0, math.sqrt(2 * math.log(2)), 0.0)
    assert_allclose(found, expected, atol=1e-15)


def test_normal_numbers_are_normal() -> None:
    keys = np.zeros((1000, 2), np.uint32)
    keys[:, 0] = np.arange(1000)
    zeros = np.zeros(1000)
    many = normal(words_of(keys, 1, zeros, zeros, 52)).ravel()
    count = many.size
    assert abs(many.mean()) < 4 / math.sqrt(count)
    assert abs(many.std() - 1) < 4 / math.sqrt(2 * count)
    found = abs((many < -1).mean() - 0.158655)
    assert found < 4 * math.sqrt(0.1335 / count)
    assert len(np.unique(many)) == count


# --- the counters of worlds -----------------------------------------------------------------------


def random_of(*shape: int, seed: int = 5) -> Random:
    """Worlds with the seeds seed, seed + 1..., in their first episode."""
    random = Random(shape)
    random.seed(None, [seed + i for i in range(shape[0])])
    random.begin(None)
    return random


def numbers(seed: int, step: int, count: int = 2, episode: int = 1) -> list[float]:
    """What a noise with the name "wind" gives to one world."""
    key = np.array((seed, 0), np.uint32)
    found: list[float] = normal(words_of(key, crc32(b"wind"), episode, step, count)).tolist()
    return found


def test_a_single_drone_has_the_numbers_of_its_seed() -> None:
    noise = random_of(1, 1).noise("wind", 2)
    for step in range(100):
        found = noise.normal()[0, 0].tolist()
        assert found == numbers(5, step)


@pytest.mark.parametrize("drones", [1, 3])
def test_a_batch_is_so_many_single_worlds(drones: int) -> None:
    noise = random_of(3, drones).noise("wind", 2)
    for step in range(100):
        rows = noise.normal().reshape(3, -1)
        for world in range(3):
            found = rows[world].tolist()
            assert found == numbers(5 + world, step, 2 * drones)


def test_a_world_outside_of_the_mask_stays_where_it_is() -> None:
    noise = random_of(3, 1).noise("wind", 2)
    noise.normal()
    held = noise.normal(np.array([[False], [True], [True]]))
    assert held[0].tolist() == [[0.0, 0.0]]
    after = noise.normal()[:, 0]
    assert after[0].tolist() == numbers(5, 1)
    assert after[2].tolist() == numbers(7, 2)
    single = random_of(1, 1).noise("wind", 2)
    found = single.normal(np.array([[False]])).tolist()
    assert found == [[[0.0, 0.0]]]
    assert single.normal()[0, 0].tolist() == numbers(5, 0)


def test_an_episode_begins_with_other_numbers_and_a_seed_repeats_them() -> None:
    random = random_of(2, 1)
    noise = random.noise("wind", 2)
    noise.normal()
    random.begin(np.array([[False], [True]]))
    first, second = noise.normal()[:, 0].tolist()
    assert first == numbers(5, 1)
    assert second == numbers(6, 0, episode=2)
    random.seed(None, [9, None])
    random.begin(np.array([[True], [False]]))
    first, second = noise.normal()[:, 0].tolist()
    assert first == numbers(9, 0)
    assert second == numbers(6, 1, episode=2)


def test_a_draw_begins_the_episode_of_the_reset_that_follows() -> None:
    random = Random((1, 1))
    random.seed(None, [3])
    shares = []
    for episode in (1, 2):
        shares.append(Draw(random, START, None, ahead=1).uniform(0.0, 1.0).item())
        random.begin(None)
        assert random.episode.tolist() == [episode]
    random.begin(None)  # without a draw
    assert random.episode.tolist() == [3]
    key = np.array((3, 0), np.uint32)
    for share, episode in zip(shares, (1, 2), strict=True):
        words = words_of(key, START, episode, 0, 1)
        assert share == uniform(words).item()


def test_draws_follow_each_other_in_blocks() -> None:
    random = random_of(2, 3)
    draw = Draw(random, START, np.repeat([[False], [True]], 3, axis=1))
    first = draw.uniform(2.0, 4.0)
    second = draw.normal(3.0, (2,))
    assert first[0].tolist() == [0.0] * 3
    found = second[0].tolist()
    assert found == [[0.0] * 2] * 3
    words = words_of(np.array((6, 0), np.uint32), START, 1, 0, 12)
    uniforms = 2.0 + 2.0 * uniform(words[:3])
    normals = 3.0 * normal(words[4:10])
    assert first[1].tolist() == uniforms.tolist()
    assert second[1].ravel().tolist() == normals.tolist()
    many = draw.uniform(0.0, 1.0, (50,))  # more than are computed at once
    assert len(np.unique(many[1])) == 150


def test_what_was_given_stays_as_it_was() -> None:
    for shape in ((1, 1), (2, 1)):
        noise = random_of(*shape).noise("wind", 2)
        first = noise.normal()
        kept = first.copy()
        for _ in range(300):
            noise.normal()
        assert first.tolist() == kept.tolist()


def test_unseeded_worlds_differ() -> None:
    found = len(np.unique(Random((4, 1)).keys))
    assert found > 4


@pytest.mark.parametrize("worlds", [1, 2])
def test_a_seed_repeats_the_starts_of_a_world(worlds: int) -> None:
    world = make_world(Vehicle.load(), worlds)
    every = np.ones((worlds, 1), bool)
    starts = []
    for _ in range(2):
        world.random.seed(every, range(11, 11 + worlds))
        for _ in range(2):
            share = world.draw(every).uniform(0.0, 1.0)
            begin(world, position=(0.0, 0.0, 5.0))
            starts.append(np.ravel(share).tolist())
    first, second, *again = starts
    assert again == [first, second]
    assert first != second
