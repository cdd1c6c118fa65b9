"""Elementary functions from + - * / rint floor frexp and where: the same bits on every processor.

Each works in the precision of its argument, float32 or float64. Series are Taylor's where no source
is named.
"""

from math import factorial

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.floating]

_TURN = 0.6366197723675814  # 2 / π
_SQRT_HALF = 0.7071067811865476
_SINGLE = np.dtype(np.float32)
# By whether the precision is single, a number as a sum of floats: all but the last have few bits,
# 10 and 32 of π / 2, 14 and 40 of log(2), so that their products with whole numbers are exact.
_HALF_PI = {
    True: (1.5703125, 0.00048351287841796875, 3.1385570764541626e-07, 6.077100506506192e-11),
    False: (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21),
}
_LOG2_PARTS = {
    True: (0.693115234375, 3.1946184945309415e-05),
    False: (0.6931471805592082, 7.371002565167799e-13),
}


def polynomial(x: Real, coefficients: list[float]) -> Real:
    """A polynomial by Horner's rule, the highest power of at least one first."""
    highest, *rest = coefficients
    result = x * highest + rest[0]
    for coefficient in rest[1:]:
        result = result * x + coefficient
    return result


def sin(x: Real) -> Real:
    """Sine of an angle, rad; right for |x| up to 1e4."""
    return _wave(x, 0.0)


def cos(x: Real) -> Real:
    """Cosine of an angle, rad; right for |x| up to 1e4."""
    return _wave(x, 1.0)


def _wave(x: Real, quarters: float) -> Real:
    """Sine of x plus `quarters` quarter turns: reduction by Cody and Waite, then a series."""
    is_single = x.dtype == _SINGLE
    near = np.rint(x * _TURN)
    rest = x
    for part in _HALF_PI[is_single]:
        rest = rest - near * part
    quarter = near + quarters
    quarter = quarter - 4.0 * np.floor(quarter * 0.25)
    square = rest * rest
    terms = 5 if is_single else 9
    odd = [(-1) ** n / factorial(2 * n + 1) for n in range(1, terms)]
    even = [(-1) ** n / factorial(2 * n) for n in range(2, terms + 1)]
    sine = rest + rest * (square * polynomial(square, odd[::-1]))
    cosine = 1.0 - (0.5 * square - square * (square * polynomial(square, even[::-1])))
    is_cosine = (quarter == 1.0) | (quarter == 3.0)
    value = np.where(is_cosine, cosine, sine)
    return np.where(quarter >= 2.0, -value, value)


def log(x: Real) -> Real:
    """Natural logarithm of finite numbers above 0. As fdlibm's e_log.c."""
    is_single = x.dtype == _SINGLE
    fraction, exponent = np.frexp(x)
    is_low = fraction < _SQRT_HALF
    fraction = np.where(is_low, fraction + fraction, fraction)
    power = exponent.astype(x.dtype) - is_low
    f = fraction - 1.0
    s = f / (2.0 + f)
    z = s * s
    terms = 6 if is_single else 13
    series = [2.0 / (2 * n + 1) for n in range(1, terms)]
    rest = z * polynomial(z, series[::-1])
    half = 0.5 * f * f
    upper, lower = _LOG2_PARTS[is_single]
    return power * upper - ((half - (s * (half + rest) + power * lower)) - f)
