"""Rotations against values worked out by hand."""

from math import pi, sqrt
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rotorgram.sim import rotations

HALF = sqrt(0.5)
LEFT = np.array((HALF, 0.0, 0.0, HALF))  # 90° about z: the nose along y
ROLLED = np.array((HALF, HALF, 0.0, 0.0))  # 90° about x: body y up, body z along -y
V = np.array((1.0, 2.0, 3.0))


def both(*arrays: np.ndarray) -> list[list[Any]]:
    """As a single drone has them, and as a batch of two."""
    return [list(arrays), [np.broadcast_to(a, (2, 1, a.shape[-1])) for a in arrays]]


@pytest.mark.parametrize(
    ("function", "arguments", "expected"),
    [
        (rotations.to_world, (LEFT, V), (-2.0, 1.0, 3.0)),
        (rotations.to_body, (LEFT, V), (2.0, -1.0, 3.0)),
        (rotations.to_world, (ROLLED, V), (1.0, -3.0, 2.0)),
        (rotations.to_body, (ROLLED, V), (1.0, 3.0, -2.0)),
        (rotations.body_z, (ROLLED,), (0.0, -1.0, 0.0)),
        (rotations.world_z, (ROLLED,), (0.0, 1.0, 0.0)),
        (rotations.body_x, (LEFT,), (0.0, 1.0, 0.0)),
        # First to the left, then rolled about the new nose: body z points along world x.
        (rotations.multiplied, (LEFT, ROLLED), (0.5, 0.5, 0.5, 0.5)),
        (rotations.between, (LEFT, np.array((0.5, 0.5, 0.5, 0.5))), (HALF, HALF, 0.0, 0.0)),
    ],
)
def test_by_hand(function: Any, arguments: Any, expected: Any) -> None:
    for given in both(*arguments):
        turned = function(*given)
        assert_allclose(turned, np.broadcast_to(expected, turned.shape), atol=1e-15)


def test_a_rotation_vector_turns_the_body() -> None:
    for attitude, angle in both(LEFT, np.array((pi / 2, 0.0, 0.0))):
        turned = rotations.advanced(attitude, angle)
        assert_allclose(turned, np.full(turned.shape, 0.5), atol=1e-15)
    still = rotations.advanced(2 * LEFT, np.zeros(3))
    assert_allclose(still, LEFT, atol=1e-15)  # normalised
    many = np.array((1.0, 0.0, 0.0, 0.0))
    for _ in range(90):
        many = rotations.advanced(many, np.radians((0.0, 0.0, 1.0)))
    assert_allclose(many, LEFT, atol=1e-13)


def test_vectors_by_their_components() -> None:
    assert rotations.cross(V, (4.0, 5.0, 6.0)) == (-3.0, 6.0, -3.0)
    turn = rotations.matrix(LEFT)
    assert rotations.times(turn, V) == pytest.approx((-2.0, 1.0, 3.0))
    assert rotations.times(rotations.transposed(turn), V) == pytest.approx((2.0, -1.0, 3.0))


def test_euler_angles() -> None:
    """Yaw by 90°, then a roll by 90° about the new nose."""
    assert rotations.euler(np.full(4, 0.5)) == pytest.approx((pi / 2, 0.0, pi / 2))
