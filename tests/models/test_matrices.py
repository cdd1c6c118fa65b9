"""Products and inverses in a stated order."""

import numpy as np
from numpy.testing import assert_allclose
from rotorgram.models.matrices import inverse, product, right_inverse, settled


def test_inverse() -> None:
    dice = np.random.default_rng(4)
    factors = dice.normal(size=(5, 4, 4))
    matrices = factors @ factors.swapaxes(1, 2) + np.eye(4)
    found = inverse(matrices)
    assert_allclose(found, np.linalg.inv(matrices), rtol=1e-10, atol=1e-12)
    assert inverse(matrices[2]).tobytes() == found[2].tobytes()
    # The second row is three times the first.
    found = inverse(np.array(((2.0, 6.0, 0.0), (6.0, 18.0, 0.0), (0.0, 0.0, 4.0))))
    assert found.tolist() == [[0.5, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.25]]


def test_a_product_is_summed_from_the_first_to_the_last() -> None:
    ones = np.ones((4, 1))
    assert product(np.array([[1e16, 1.0, -1e16, 1.0]]), ones).tolist() == [
        [1.0]
    ]  # 1e16 + 1 is 1e16
    dice = np.random.default_rng(5)
    a = dice.normal(size=(7, 2, 3))
    b = dice.normal(size=(3, 5))
    assert_allclose(product(a, b), a @ b, rtol=1e-12, atol=1e-14)


def test_the_least_solution() -> None:
    """A row of zeros, as of a craft without a torque, takes nothing."""
    found = right_inverse(np.array([[3.0, 4.0], [0.0, 0.0]]))
    assert_allclose(found, [[0.12, 0.0], [0.16, 0.0]], rtol=1e-15)  # 3 · 0.12 + 4 · 0.16 = 1
    dice = np.random.default_rng(6)
    wide = dice.normal(size=(4, 6))
    assert_allclose(right_inverse(wide), np.linalg.pinv(wide), rtol=1e-9, atol=1e-12)


def test_what_rounding_leaves_is_settled() -> None:
    """On arm64 MuJoCo's compiler gives other last bits than on x86-64."""
    numbers = np.array([0.0008250825082508254, 0.1, -1e-19, -0.0])
    others = np.array([0.0008250825082508252, 0.1, 2e-18, 0.0])
    assert settled(numbers).tobytes() == settled(others).tobytes()
    assert settled(numbers)[1] == 0.1
    small = settled(np.array([0.0005600000000000035, -5.4e-23]), 0.00056)
    assert small.tobytes() == np.array([0.00056, 0.0]).tobytes()
