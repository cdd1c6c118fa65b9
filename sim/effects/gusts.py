"""Dryden turbulence of MIL-F-8785C: spectra of 3.7.1.2, scales and intensities of 3.7.3.4.

Three velocities of the air: u along the mean wind, v across it and w vertical. Each is white noise
through a filter, whose spectrum over the angular frequency ω, one-sided, (m/s)²/(rad/s), is

    Φ_u = σ_u² · 2 L_u / (π V) · 1 / (1 + (ω L_u / V)²)
    Φ_v = σ_v² · L_v / (π V) · (1 + 3 (ω L_v / V)²) / (1 + (ω L_v / V)²)², and Φ_w alike.

V is the speed at which the field passes. With the height h in feet, L_w = h, L_u = L_v =
h / (0.177 + 0.000823 h)^1.2, σ_w = 0.1 W20 and σ_u = σ_v = σ_w / (0.177 + 0.000823 h)^0.4.
"""

import math

from ..elementary import exp, expm1, power
from ..snapshots import Kept
from ..state import Array, chosen, clip, parts_of, square_root, stack

FOOT = 0.3048  # m
LOWEST, HIGHEST = 10 * FOOT, 1000 * FOOT  # m: where the low-altitude model is defined
LEAST_SPEED = 1.0
"""Least speed at which the field passes a drone, m/s. The specification is for aircraft, which do
not stand in the air; this is our choice."""
NUMBERS = 5  # Normal numbers that a step takes

Vector = tuple[Array, Array, Array]


class Gusts(Kept):
    """Gusts of W worlds. A drone keeps the scales of the height at which its episode began.

    Args:
        wind_speed: W20, the wind speed at a height of 20 feet, m/s.
        mean_wind: Velocity of the mean wind, world frame, m/s, three numbers.
        timestep: Physics step, s.
    """

    arrays = ("_filters", "_state")
    _filters: Array = None
    _state: Array = None

    def __init__(self, wind_speed: float, mean_wind: tuple[float, ...], timestep: float) -> None:
        self._sigma = 0.1 * wind_speed
        x, y, z = mean_wind
        across = math.sqrt(x * x + y * y)
        self._along = (1.0, 0.0) if across == 0 else (x / across, y / across)
        self._speed = max(LEAST_SPEED, math.sqrt(x * x + y * y + z * z))
        self._step = timestep

    def begin(self, mask: Array, height: Array, normal: Array, factor: Array = 1.0) -> None:
        """Begin in the stationary state; height in m, shape (W, A), normal (W, A, 5).

        The factor scales the gusts, one for all or (W, A).
        """
        n = parts_of(normal)
        feet = clip(height + 0.0 * n[0], LOWEST, HIGHEST) / FOOT  # float64, as the normals
        shape = 0.177 + 0.000823 * feet
        sigma = self._sigma * factor
        sigmas = sigma / power(shape, 0.4), sigma + 0.0 * feet
        lengths = FOOT * feet / power(shape, 1.2), FOOT * feet
        r = self._step * self._speed / lengths[0]
        filters = [exp(-r), sigmas[0] * square_root(-expm1(-2 * r)), *sigmas]
        # Of a filter of second order, with z₁' = (noise - z₁) / T and z₂' = (z₁ - z₂) / T, the
        # stationary covariance is σ²/2 · ((1, 1/2), (1/2, 1/2)): v = √3 z₁ + (1 - √3) z₂ has σ².
        # The noise of a step has the covariance ((q11, q12), (q12, q22)).
        for sigma, length in zip(sigmas, lengths, strict=True):
            r = self._step * self._speed / length
            e = exp(-r)
            half = 0.5 * sigma * sigma
            q11 = -half * expm1(-2 * r)
            q12 = half / 2 * (1 - e * e * (1 + 2 * r))
            q22 = half / 2 * (1 - e * e * (1 + 2 * r + 2 * r * r))
            a = square_root(q11)
            # In a short step the last is less than what rounding leaves of the difference.
            filters += [e, r, a, q12 / a, square_root(q22 - q12 * q12 / q11)]
        self._filters = chosen(mask, stack(filters), self._filters)
        _, _, along, up, *_ = parts_of(self._filters)
        start = [along * n[0]]
        for index, sigma in ((1, along), (3, up)):
            z1 = n[index]
            z2 = n[index + 1]
            start += [math.sqrt(0.5) * sigma * z1, math.sqrt(0.125) * sigma * (z1 + z2)]
        self._state = chosen(mask, stack(start), self._state)

    def step(self, mask: Array | None, normal: Array) -> None:
        """Advance by a physics step; normal (W, A, 5)."""
        f = parts_of(self._filters)
        z = parts_of(self._state)
        n = parts_of(normal)
        new = [f[0] * z[0] + f[1] * n[0]]
        for i, (e, r, a, b, c) in ((1, f[4:9]), (3, f[9:])):
            new += [
                e * z[i] + a * n[i],
                e * (z[i + 1] + r * z[i]) + b * n[i] + c * n[i + 1],
            ]
        self._state = chosen(mask, stack(new), self._state)

    @property
    def velocity(self) -> Vector:
        """Of the gust, world frame, m/s, three of shape (W, A)."""
        z = parts_of(self._state)
        x, y = self._along
        root = math.sqrt(3)
        u = z[0]
        v, w = (root * z[i] + (1 - root) * z[i + 1] for i in (1, 3))
        return x * u - y * v, y * u + x * v, w
