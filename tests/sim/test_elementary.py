"""Elementary functions: errors in units in the last place (ulp), odd arguments; sums, tables."""

import math
from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from rotorgram.sim import elementary
from rotorgram.sim.state import interpolated, length, looked_up, remainder, square_root, total

KINDS = (np.float32, np.float64)
COUNT = 2000
SPECIAL = (0.0, -0.0, 1e-300, -1e-40, 0.5, -1.0, 1.5707963267948966, 88.4, -710.0, 1e5, 1e12)
ODD = (math.inf, -math.inf, math.nan)
WHOLE = 1e4


def even(low: float, high: float) -> NDArray[np.float64]:
    return np.random.default_rng(1).uniform(low, high, COUNT)


def decades(low: float, high: float) -> NDArray[np.float64]:
    """Numbers with both signs, of even logarithms."""
    dice = np.random.default_rng(2)
    return np.float64(10.0) ** dice.uniform(low, high, COUNT) * dice.choice((-1.0, 1.0), COUNT)


def near_quarters(most: float) -> NDArray[np.float64]:
    """The numbers next to multiples of a quarter turn, where sine or cosine is nearly 0."""
    return np.rint(even(1.0, most / 1.6)) * (math.pi / 2)


ANGLES = (even(-3.2, 3.2), even(-WHOLE, WHOLE), near_quarters(WHOLE), decades(-12, 0))
STEPS = (even(-1.0, 1.0), even(-87.0, 88.0), decades(-12, 0))
SIZES = (even(0.5, 2.0), abs(decades(-30, 30)))
# Each function, what is exact, samples of its arguments, and the largest error, ulp.
ERRORS: list[tuple[str, Any, Any, float]] = [
    ("sin", mpmath.sin, [(x,) for x in ANGLES], 2.5),
    ("cos", mpmath.cos, [(x,) for x in ANGLES], 2.5),
    ("exp", mpmath.exp, [(x,) for x in STEPS], 1.5),
    ("expm1", mpmath.expm1, [(x,) for x in STEPS], 2.5),
    ("log", mpmath.log, [(x,) for x in SIZES], 1.0),
    ("atan2", mpmath.atan2, [(even(-1, 1), -even(-1, 1)[::-1]), (decades(-8, 8),) * 2], 2.5),
    # Barometer and gusts: |y log x| is up to 8.5, and 2.4.
    ("power", mpmath.power, [(even(0.2, 1.7), np.array(5.2559))], 1 + 3 * 8.5),
    ("power", mpmath.power, [(even(0.18, 1.0), np.array(y)) for y in (0.4, 1.2)], 1 + 3 * 2.4),
]


def in_ulp(found: NDArray[Any], exact: list[Any]) -> NDArray[np.float64]:
    """Errors, in spacings of the found kind at the exact values."""
    units = np.spacing(np.abs(np.array(exact, float)).astype(found.dtype)).tolist()
    pairs = zip(found.tolist(), exact, units, strict=True)
    return np.array([float(abs(value - right) / unit) for value, right, unit in pairs])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("name", "exactly", "samples", "most"), ERRORS)
def test_errors(name: str, exactly: Any, samples: Any, most: float, kind: Any) -> None:
    function = getattr(elementary, name)
    for sample in samples:
        arguments = [values.astype(kind) for values in np.broadcast_arrays(*sample)]
        found = function(*arguments)
        assert found.dtype == kind
        with mpmath.workdps(40):
            rows = zip(*(values.tolist() for values in arguments), strict=True)
            exact = [exactly(*map(mpmath.mpf, row)) for row in rows]
            errors = in_ulp(found, exact)
        assert errors.max() < most
        assert errors.max() > 0  # which a copy of the exact values would have


ONE = ("sin", "cos", "wrapped", "exp", "expm1", "log")
TWO = ("atan2", "power")


@pytest.mark.parametrize("name", [*ONE, *TWO])
def test_numbers_have_the_bits_of_arrays(name: str) -> None:
    function = getattr(elementary, name)
    many = np.concatenate([*ANGLES, *STEPS, *SIZES, SPECIAL, ODD])
    second = np.random.default_rng(3).permutation(many) if name in TWO else many
    arguments = (abs(many), second) if name == "power" else (many, second)[: 1 + (name in TWO)]
    with np.errstate(invalid="ignore", over="ignore"):
        batch = function(*arguments)
        alone = [function(*row) for row in zip(*(x.tolist() for x in arguments), strict=True)]
        first = function(*(np.array(x[0]) for x in arguments))
    assert {type(value) for value in alone} == {float}
    assert np.float64(first).tobytes() == batch[0].tobytes()
    is_right = ~np.isnan(batch)  # bits inside a NaN differ
    assert np.array(alone)[is_right].tobytes() == batch[is_right].tobytes()
    assert np.isnan(alone).tolist() == (~is_right).tolist()


@pytest.mark.parametrize("kind", KINDS)
def test_rules_beyond_the_domains(kind: Any) -> None:
    inf, nan = math.inf, math.nan
    furthest = {np.float32: 2e4, np.float64: 3e6}[kind]
    cases: list[tuple[Callable[[Any], Any], float, float]] = [
        (elementary.sin, 0.0, 0.0),
        (elementary.cos, 0.0, 1.0),
        (elementary.sin, furthest, nan),
        (elementary.cos, -inf, nan),
        (elementary.exp, 0.0, 1.0),
        (elementary.exp, -710.0, 0.0),
        (elementary.exp, -inf, 0.0),
        (elementary.exp, 710.0, inf),
        (elementary.exp, inf, inf),
        (elementary.expm1, 0.0, 0.0),
        (elementary.expm1, -1000.0, -1.0),
        (elementary.expm1, 710.0, inf),
        (elementary.log, 1.0, 0.0),
        (elementary.log, 0.0, -inf),
        (elementary.log, 5e-324, -inf),
        (elementary.log, -1.0, nan),
        (elementary.log, inf, inf),
    ]
    cases += [(getattr(elementary, name), nan, nan) for name in ONE]
    for function, x, expected in cases:
        with np.errstate(invalid="ignore"):
            found = function(np.full(3, x, kind))
        assert found.dtype == kind
        np.testing.assert_array_equal(found, np.full(3, expected), str((function, x)))


@pytest.mark.parametrize(("y", "x"), [(a, b) for a in (0.0, -0.0, 1.0, -2.0) for b in SPECIAL[:2]])
def test_atan2_of_zeros_as_c(y: float, x: float) -> None:
    for one, other in ((y, x), (x, y)):
        found = elementary.atan2(one, other)
        exact = math.atan2(one, other)
        assert found == pytest.approx(exact, rel=3e-16, abs=0)
        assert math.copysign(1.0, found) == math.copysign(1.0, exact)


def test_a_wrapped_angle_differs_by_whole_turns() -> None:
    angles = even(-50.0, 50.0)
    found = elementary.wrapped(angles)
    assert abs(found).max() <= math.pi
    turns = (angles - found) / (2 * math.pi)
    assert_allclose(turns, np.rint(turns), atol=1e-14)
    assert elementary.wrapped(3.0) == 3.0


def test_a_number_beside_an_array() -> None:
    many = np.array((0.5, -2.0), np.float32)
    for found, expected in (
        (elementary.atan2(1.0, many), elementary.atan2(np.ones_like(many), many)),
        (elementary.atan2(many, 1.0), elementary.atan2(many, np.ones_like(many))),
        (elementary.power(2.0, many), elementary.power(np.full_like(many, 2.0), many)),
    ):
        assert found.dtype == np.float32
        assert_allclose(found, expected, rtol=1e-6)


# --- sums, whole numbers and tables of sim/state.py -----------------------------------------------


def test_a_sum_goes_from_the_first_to_the_last() -> None:
    values = np.array((1e16, 1.0, -1e16, 1.0))
    assert total(values) == 1.0  # 1e16 + 1 is 1e16
    assert total(values[::-1]) == 0.0
    many = np.tile(values, (3, 5, 1))
    assert total(many).tolist() == [[1.0] * 5] * 3
    assert total(np.asfortranarray(many)).tolist() == [[1.0] * 5] * 3
    assert length(np.array((2.0, 3.0, 6.0))) == 7.0
    assert length(np.tile((2.0, 3.0, 6.0), (2, 1))).tolist() == [7.0, 7.0]


def test_roots_of_rounded_numbers() -> None:
    assert square_root(-1e-20) == 0.0
    assert math.isnan(square_root(math.nan))
    assert square_root(np.array((-1e-20, 4.0))).tolist() == [0.0, 2.0]


def test_whole_numbers() -> None:
    index = np.arange(5000.0)
    for count in (1, 3, 7, 49, 500):
        assert remainder(index, count).tolist() == (index % count).tolist()
        assert remainder(index.astype(np.float32), count).tolist() == (index % count).tolist()
    assert remainder(9.0, 4) == 1.0


def test_tables() -> None:
    rows = np.arange(12.0).reshape(4, 3)
    assert looked_up(rows, 2.0).tolist() == [6.0, 7.0, 8.0]
    assert looked_up(rows, 9.0).tolist() == looked_up(rows, 3.0).tolist()
    assert looked_up(rows, np.array([[-1.0], [1.0]])).tolist() == [
        [[0.0, 1.0, 2.0]],
        [[3.0, 4.0, 5.0]],
    ]
    squares = np.arange(5.0) ** 2
    index = np.array((-1.0, 0.0, 1.5, 3.75, 4.0, 7.0))
    expected = [0.0, 0.0, 2.5, 14.25, 16.0, 16.0]
    assert interpolated(squares, index).tolist() == expected
    assert [interpolated(squares, x) for x in index.tolist()] == expected
