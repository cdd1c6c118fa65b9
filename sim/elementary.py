"""Elementary functions from + - * /, sqrt, rint, floor, bits and where: the same bits everywhere.

NumPy's and C's differ in their last bits between processors. These work in the precision of their
arguments, float32 or float64, and give numbers for numbers. Errors are in units in the last place
(ulp) of the exact value; NaN gives NaN. Series are Taylor's where no source is named.
"""

import math
from collections.abc import Callable, Sequence
from functools import wraps
from math import factorial
from types import SimpleNamespace
from typing import Any

import numpy as np

from ..models.files import read_own_toml
from .compile import once
from .compile.tracer import add_function
from .state import Array

_TURN = 0.6366197723675814  # 2 / π
_SQRT_HALF = 0.7071067811865476
_EIGHTH = 0.41421356237309503  # tan(π / 8)
_INFINITY = math.inf
_NAN = math.nan
_LAYOUTS = {"float32": (np.int32, 23, 127), "float64": (np.int64, 52, 1023)}
"""Whole numbers with the bits of a float, bits of its fraction, and its exponent of 1."""


def _precision(sines: int, powers: int, logs: int, **constants: Any) -> SimpleNamespace:
    """Constants of a precision, and series of so many terms, the highest power first."""
    cosine, sine = wave_series(sines + 1)
    return SimpleNamespace(
        sine=sine[1:-1],  # without the first terms, x of the sine, 1 - x² / 2 of the cosine
        cosine=cosine[:-2],
        exponential=[1.0 / factorial(n) for n in range(2, powers)][::-1],
        logarithm=[2.0 / (2 * n + 1) for n in range(1, logs)][::-1],
        **constants,
    )


def wave_series(count: int) -> tuple[list[float], list[float]]:
    """So many terms of cos(x) and of sin(x) / x in x², the highest power first."""
    terms = range(count)[::-1]
    cosine = [(-1) ** n / factorial(2 * n) for n in terms]
    sine = [(-1) ** n / factorial(2 * n + 1) for n in terms]
    return cosine, sine


_TABLES = read_own_toml(__file__, "elementary")
_SINGLE = _precision(**_TABLES["float32"])
_DOUBLE = _precision(**_TABLES["float64"])


# ---- of arrays, and of numbers, which are Python's


def _elementary(function: Callable[..., Array]) -> Callable[..., Array]:
    """Its compiled code is there once. Python's numbers, alone, give one, computed in float64."""
    of_arrays = once()(function)

    @wraps(function)
    def call(*values: Array) -> Array:
        for value in values:
            if not isinstance(value, float | int):
                return of_arrays(*values)
        with np.errstate(all="ignore"):
            return of_arrays(*map(np.float64, values)).item()

    return call


def _constants(*values: Array) -> SimpleNamespace:
    """Of the precision of the first array."""
    dtypes = [value.dtype for value in values if hasattr(value, "dtype")]
    return _SINGLE if dtypes[:1] == [np.float32] else _DOUBLE


def _split(x: Array) -> tuple[Array, Array]:
    """A fraction from 1/2 to 1 and a power of 2, whose product is a normal number above 0.

    The fraction is a product too, so that it has a derivative.
    """
    whole, digits, one = _LAYOUTS[x.dtype.name]
    power = ((x.view(whole) >> digits) - (one - 1)).astype(x.dtype)
    return _scaled(x, -power), power


def _scaled(x: Array, power: Array) -> Array:
    """A number times a power of 2, in two steps, of which only the last one can round."""
    whole, digits, one = _LAYOUTS[x.dtype.name]
    power = power.astype(whole)
    half = power >> 1
    for part in (half, power - half):
        x = x * ((part + one) << digits).view(x.dtype)
    return x


def polynomial(x: Array, coefficients: Sequence[float]) -> Array:
    """A polynomial by Horner's rule, the highest power of at least one first."""
    result = x * coefficients[0] + coefficients[1]
    for coefficient in coefficients[2:]:
        result = result * x + coefficient
    return result


# ---- of angles


@_elementary
def sin(x: Array) -> Array:
    """Sine of an angle, rad, within 2.5 ulp; NaN beyond 3e6, of float32 beyond 2e4."""
    return _wave(x, 0.0)


@_elementary
def cos(x: Array) -> Array:
    """Cosine of an angle, as `sin`."""
    return _wave(x, 1.0)


def _wave(x: Array, quarters: float) -> Array:
    """Sine of x plus `quarters` quarter turns."""
    p = _constants(x)
    near = np.rint(x * _TURN)
    rest = _without(p, x, near)
    quarter = near + quarters
    quarter = quarter - 4.0 * np.floor(quarter * 0.25)
    square = rest * rest
    sine = rest + rest * (square * polynomial(square, p.sine))
    cosine = 1.0 - (0.5 * square - square * (square * polynomial(square, p.cosine)))
    is_cosine = (quarter == 1.0) | (quarter == 3.0)
    value = np.where(is_cosine, cosine, sine)
    return np.where(quarter >= 2.0, -value, value)


@_elementary
def wrapped(x: Array) -> Array:
    """The angle between -π and π, rad, that differs from x by whole turns; NaN as of `sin`."""
    p = _constants(x)
    return _without(p, x, 4.0 * np.rint(x * (0.25 * _TURN)))


def _without(p: SimpleNamespace, x: Array, quarters: Array) -> Array:
    """An angle less so many quarter turns: reduction by Cody and Waite."""
    x = np.where(abs(x) < p.furthest, x, _NAN)
    for part in p.half_pi:
        x = x - quarters * part
    return x


@_elementary
def atan2(y: Array, x: Array) -> Array:
    """Angle of the point (x, y), rad, within 2.5 ulp, for sizes below 1e37; zeros as in C."""
    p = _constants(y, x)
    across = abs(x)
    up = abs(y)
    is_steep = up > across
    large = np.where(is_steep, up, across)
    small = np.where(is_steep, across, up)
    large = np.where(large == 0.0, 1.0, large)
    is_far = small > _EIGHTH * large
    above = np.where(is_far, small - large, small)
    ratio = above / np.where(is_far, small + large, large)
    square = ratio * ratio
    series = polynomial(square, p.arc)
    if p.arc_below:
        series = series / polynomial(square, p.arc_below)
    angle = ratio + ratio * (square * series)
    high, low = p.half_turn
    angle = np.where(is_far, 0.25 * high + (angle + 0.25 * low), angle)
    angle = np.where(is_steep, 0.5 * high + (0.5 * low - angle), angle)
    is_behind = np.copysign(1.0, x) < 0.0
    angle = np.where(is_behind, high + (low - angle), angle)
    return np.copysign(angle, y)


# ---- exponentials


@_elementary
def exp(x: Array) -> Array:
    """Exponential function, within 2.5 ulp.

    0 below -708 and infinite above 709, of float32 below -87 and above 88.
    """
    p = _constants(x)
    rest, power = _reduced(p, x)
    value = _scaled(1.0 + rest, power)
    value = np.where(x < p.low, 0.0, value)
    return _ended(p, x, value)


@_elementary
def expm1(x: Array) -> Array:
    """exp(x) - 1, within 2.5 ulp; infinite where `exp` is."""
    p = _constants(x)
    rest, power = _reduced(p, x)
    scale = _scaled(1.0 + 0.0 * rest, power)
    return _ended(p, x, scale * rest + (scale - 1.0))


def _reduced(p: SimpleNamespace, x: Array) -> tuple[Array, Array]:
    """A number r and a power n of 2: exp(x) = (1 + r) 2ⁿ."""
    inside = np.where(x > p.low, x, p.low)
    inside = np.where(inside < p.high, inside, p.high)
    power = np.rint(inside * 1.4426950408889634)
    high, low = p.log2
    rest = (inside - power * high) - power * low
    return rest + rest * rest * polynomial(rest, p.exponential), power


def _ended(p: SimpleNamespace, x: Array, value: Array) -> Array:
    """A value that grows with x, beyond the range too."""
    value = np.where(x > p.high, _INFINITY, value)
    return np.where(x == x, value, x)


@_elementary
def log(x: Array) -> Array:
    """Natural logarithm, within 2.5 ulp, as fdlibm's e_log.c.

    -infinity of 0 and of numbers below the normal ones, NaN of negative ones.
    """
    p = _constants(x)
    fraction, power = _split(abs(x))
    is_low = fraction < _SQRT_HALF
    fraction = np.where(is_low, fraction + fraction, fraction)
    power = np.where(is_low, power - 1.0, power)
    above = fraction - 1.0
    s = above / (2.0 + above)
    square = s * s
    rest = square * polynomial(square, p.logarithm)
    half = 0.5 * above * above
    high, low = p.log2
    value = power * high - ((half - (s * (half + rest) + power * low)) - above)
    value = np.where(x < p.least, -_INFINITY, value)
    value = np.where(x < _INFINITY, value, x)
    return np.where(x < 0.0, _NAN, value)


def power(x: Array, y: Array) -> Array:
    """x to the power y, for normal numbers x > 0, within 1 + 3 |y log x| ulp."""
    return exp(y * log(x))


for _ours in (sin, cos, atan2, exp, expm1, log):
    add_function(getattr(np, _ours.__name__), _ours)  # of traced code
