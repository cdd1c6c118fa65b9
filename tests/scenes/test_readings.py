"""What a range sensor reads: the same bits by NumPy and by Numba, and the errors that it says."""

from typing import Any

import numpy as np
import pytest
from rotorgram.scenes import returns
from rotorgram.scenes.returns import ErrorModel
from rotorgram.sim.random import words_of

EXACT = ErrorModel(0.1, 10.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def read(ranges: Any, errors: ErrorModel, words: Any, columns: int = 1, scale: Any = 1.0) -> Any:
    """By both, which have to agree to the bit."""
    code = returns.compiled()
    assert code
    given = np.array(ranges, np.float32)
    count = given.shape[1]
    by = np.full(count, scale, np.float32)
    found = []
    for run in (code.readings, returns.by_numpy):
        out = np.empty_like(given)
        run(given, by, columns, np.array(words, np.uint32), errors.numbers(), out)
        found.append(out)
    assert found[0].tobytes() == found[1].tobytes()
    return found[0]


def random_words(count: int, rows: int = 1000) -> Any:
    return np.random.default_rng(1).integers(0, 2**32, (rows, count), dtype=np.uint32)


def test_words_are_those_of_philox() -> None:
    code = returns.compiled()
    assert code
    dice = np.random.default_rng(2)
    keys = dice.integers(0, 2**32, (50, 2), dtype=np.uint32)
    episodes, steps = dice.integers(0, 2**20, (2, 50), dtype=np.uint32)
    words = np.empty((50, 24), np.uint32)
    code.words(keys, np.uint64(0xFEDCBA98), episodes, steps, words)
    assert (words == words_of(keys, 0xFEDCBA98, episodes, steps, 24)).all()


def test_without_errors_a_reading_is_the_distance() -> None:
    ranges = np.array([[0.05, 0.2, 5.0, 9.99, 10.0, 20.0]])
    words = random_words(6, 1)
    assert read(ranges, EXACT, words) == pytest.approx(
        np.array([[10.0, 0.2, 5.0, 9.99, 10.0, 10.0]])
    )
    half = read(ranges, EXACT, words, scale=0.5)  # along the axis of a camera
    assert half == pytest.approx(np.array([[10.0, 0.1, 2.5, 4.995, 5.0, 10.0]]))


def test_the_noise_has_the_size_that_it_says() -> None:
    errors = ErrorModel(0.0, 100.0, 0.02, 0.01, 0.003, 0.0, 0.0)
    distances = np.array([1.0, 3.0, 8.0, 20.0])
    words = random_words(4, 100_000)
    got = read(np.tile(distances, (100_000, 1)), errors, words)
    sigma = 0.02 + 0.01 * distances + 0.003 * distances**2
    assert got.mean(axis=0) == pytest.approx(distances, abs=0.02)
    assert got.std(axis=0) == pytest.approx(sigma, rel=0.01)


def test_returns_are_lost_and_at_edges_more() -> None:
    errors = ErrorModel(0.0, 10.0, 0.0, 0.0, 0.0, 0.1, 0.5)
    ranges = np.tile([2.0, 2.0, 2.0, 2.0, 4.0, 4.0, 4.0, 4.0], (50_000, 1))
    lost = read(ranges, errors, random_words(8, 50_000), 8) == 10.0
    expected = [0.1, 0.1, 0.1, 0.55, 0.55, 0.1, 0.1, 0.1]
    assert lost.mean(axis=0) == pytest.approx(expected, abs=0.01)
    small = np.tile([2.0, 2.1] * 4, (50_000, 1))  # less than a tenth
    lost = read(small, errors, random_words(8, 50_000), 8) == 10.0
    assert lost.mean(axis=0) == pytest.approx(0.1, abs=0.01)


def test_edges_of_a_grid() -> None:
    """Three rows of three: the middle is near, and its four neighbours are at an edge with it."""
    errors = ErrorModel(0.0, 10.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    ranges = np.full((1, 9), 5.0)
    ranges[0, 4] = 1.0
    lost = read(ranges, errors, random_words(9, 1), 3) == 10.0
    assert lost[0].astype(int).tolist() == [0, 1, 0, 1, 1, 1, 0, 1, 0]
