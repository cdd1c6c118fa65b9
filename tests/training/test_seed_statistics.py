"""Statistics over seeds against values computed by hand, and against `rliable`."""

import math

import numpy as np
import pytest
from rotorgram.training.statistics import (
    bootstrap_difference,
    bootstrap_interval,
    iqm,
    share_interval,
)


def test_the_interquartile_mean_is_that_of_rliable():
    # rliable 1.2.0: `aggregate_iqm` of seven runs on two tasks.
    first = [0.9, 0.7, 0.8, 0.3, 0.6, 0.85, 0.65, 0.2, 0.4, 0.1, 0.5, 0.6, 0.35, 0.45]
    second = [0.5, 0.55, 0.8, 0.2, 0.4, 0.45, 0.6, 0.3, 0.4, 0.2, 0.15, 0.25, 0.05, 0.7]
    assert iqm(first) == pytest.approx(0.53125, abs=1e-12)
    assert iqm(second) == pytest.approx(0.38125, abs=1e-12)


def test_a_level_of_its_own_widens_an_interval():
    values = np.random.default_rng(3).normal(10.0, 1.0, size=40)
    _, low, high = bootstrap_difference(values, values - 9.0)
    _, lowest, highest = bootstrap_difference(values, values - 9.0, 0.9875)
    assert lowest < low < high < highest


def test_wilsons_intervals_of_shares():  # fault 66
    # Of n out of n it begins at n / (n + z²), z = 1.96, and of none it is the mirror image.
    assert share_interval(50, 50) == (pytest.approx(50 / 53.8415, rel=1e-5), 1.0)
    assert share_interval(0, 50) == (0.0, pytest.approx(3.8415 / 53.8415, rel=1e-5))
    # Newcombe, Statistics in Medicine 17, 1998, table I: 81 of 263 and 15 of 148.
    assert share_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert share_interval(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert all(math.isnan(end) for end in share_interval(0, 0))


def test_iqm_cuts_a_quarter_from_each_end():
    assert iqm([1.0, 2.0, 3.0, 100.0]) == 2.5
    assert iqm([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 700.0]) == 3.5
    assert iqm([1.0, 2.0, 6.0]) == 3.0  # nothing to cut below four
    assert iqm([math.nan, 4.0]) == 4.0
    assert math.isnan(iqm([]))


def test_bootstrap_interval():
    assert bootstrap_interval([3.0] * 5) == (3.0, 3.0)
    assert all(math.isnan(end) for end in bootstrap_interval([3.0]))
    assert all(math.isnan(end) for end in bootstrap_interval([3.0, math.nan]))
    # Of two values, a quarter of the resamples holds one alone: the 95 % interval spans both.
    assert bootstrap_interval([1.0, 2.0]) == (1.0, 2.0)
    values = np.random.default_rng(3).normal(10.0, 1.0, size=40)
    low, high = bootstrap_interval(values)
    assert low < iqm(values) < high
    # The standard error of the mean of 40 would be 0.16, and the interval 0.62 wide.
    assert 0.4 < high - low < 1.2
    assert bootstrap_interval(values) == (low, high)


def test_bootstrap_difference():
    assert bootstrap_difference([5.0] * 3, [2.0] * 4) == (3.0, 3.0, 3.0)
    difference, low, high = bootstrap_difference([1.0, 2.0], [0.0, 4.0])
    assert difference == -0.5
    assert low == -3.0
    assert high == 2.0
    difference, low, high = bootstrap_difference([1.0], [0.0, 4.0])
    assert difference == -1.0
    assert math.isnan(low)
    assert math.isnan(high)
