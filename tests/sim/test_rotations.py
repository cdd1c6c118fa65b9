"""Rotations against values worked out by hand."""

from math import pi, sqrt
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rotorgram.models.matrices import rotation, times
from rotorgram.sim import rotations
from tables import SIM

HALF = sqrt(0.5)
LEFT = np.array((HALF, 0.0, 0.0, HALF))  # 90° about z: the nose along y
V = np.array((1.0, 2.0, 3.0))


@pytest.mark.parametrize(("function", "arguments", "expected"), SIM["rotations"]["rows"])
def test_by_hand(function: str, arguments: list[Any], expected: list[float]) -> None:
    """As a single drone has them, and as a batch of two."""
    for size in ((), (2, 1)):
        given = [np.broadcast_to(vector, (*size, len(vector))) for vector in arguments]
        turned = getattr(rotations, function)(*given)
        assert turned.shape == (*size, len(expected))
        assert_allclose(turned - expected, 0.0, atol=1e-15)


def test_a_rotation_vector_turns_the_body() -> None:
    roll = np.array((pi / 2, 0.0, 0.0))
    turned = rotations.advanced(LEFT, roll)
    assert_allclose(turned, [0.5] * 4, atol=1e-15)
    batch = rotations.advanced(np.tile(LEFT, (2, 1, 1)), np.tile(roll, (2, 1, 1)))
    expected = np.full((2, 1, 4), 0.5)
    assert_allclose(batch, expected, atol=1e-15)
    still = rotations.advanced(2 * LEFT, np.zeros(3))
    assert_allclose(still, LEFT, atol=1e-15)  # normalised
    many = np.array((1.0, 0.0, 0.0, 0.0))
    degree = np.radians((0.0, 0.0, 1.0))
    for _ in range(90):
        many = rotations.advanced(many, degree)
    assert_allclose(many, LEFT, atol=1e-13)


def test_vectors_by_their_components() -> None:
    assert rotations.cross(V, (4.0, 5.0, 6.0)) == (-3.0, 6.0, -3.0)
    turn = rotation(LEFT)
    expected = (-2.0, 1.0, 3.0)
    assert times(turn, V) == pytest.approx(expected)
    found = times(rotations.transposed(turn), V)
    expected = (2.0, -1.0, 3.0)
    assert found == pytest.approx(expected)


def test_euler_angles() -> None:
    """Yaw by 90°, then a roll by 90° about the new nose."""
    found = rotations.euler(np.full(4, 0.5))
    expected = (pi / 2, 0.0, pi / 2)
    assert found == pytest.approx(expected)
