"""Dryden turbulence, low-altitude model of MIL-F-8785C, section 3.7.

Three velocities of the air: u along the mean wind, v across it and w vertical. Each is white noise
through a filter, whose spectrum over the angular frequency ω, one-sided, (m/s)²/(rad/s), is

    Φ_u = σ_u² · 2 L_u / (π V) · 1 / (1 + (ω L_u / V)²)
    Φ_v = σ_v² · L_v / (π V) · (1 + 3 (ω L_v / V)²) / (1 + (ω L_v / V)²)², and Φ_w alike.

V is the speed at which the field passes. With the height h in feet, L_w = h, L_u = L_v =
h / (0.177 + 0.000823 h)^1.2, σ_w = 0.1 W20 and σ_u = σ_v = σ_w / (0.177 + 0.000823 h)^0.4.
"""

import math
from typing import Any, Final

import numpy as np

from ..state import Array, on_host, stack

FOOT: Final = 0.3048  # m
LOWEST, HIGHEST = 10 * FOOT, 1000 * FOOT  # m: where the low-altitude model is defined
LEAST_SPEED: Final = 1.0
"""Least speed at which the field passes a drone, m/s. The specification is for aircraft, which do
not stand in the air; this is our choice."""
NUMBERS: Final = 5  # Normal numbers that a step takes


class Gusts:
    """Gusts of W worlds. A drone keeps the scales of the height at which its episode began.

    Args:
        wind_speed: W20, the wind speed at a height of 20 feet, m/s.
        mean_wind: Velocity of the mean wind, world frame, m/s, three numbers.
        timestep: Physics step, s.
    """

    def __init__(
        self, wind_speed: float, mean_wind: tuple[float, ...], timestep: float, xp: Any
    ) -> None:
        self._sigma = 0.1 * wind_speed
        across = math.hypot(mean_wind[0], mean_wind[1])
        self._along = (1.0, 0.0) if across == 0 else (mean_wind[0] / across, mean_wind[1] / across)
        self._speed = max(LEAST_SPEED, math.hypot(*mean_wind))
        self._step, self._xp = timestep, xp
        self._filters: Array = None
        self._state: Array = None

    def begin(self, mask: Array, height: Array, normal: Array) -> None:
        """Begin in the stationary state; height in m, shape (W, A), normal (W, A, 5)."""
        feet = np.clip(on_host(height).astype(np.float64), LOWEST, HIGHEST) / FOOT
        shape = 0.177 + 0.000823 * feet
        sigmas = self._sigma / shape**0.4, self._sigma + 0.0 * feet
        lengths = FOOT * feet / shape**1.2, FOOT * feet
        first = np.exp(-self._step * self._speed / lengths[0])
        filters = [first, sigmas[0] * np.sqrt(1 - first * first)]
        # Of a filter of second order, with z₁' = (noise - z₁) / T and z₂' = (z₁ - z₂) / T, the
        # stationary covariance is σ²/2 · ((1, 1/2), (1/2, 1/2)): v = √3 z₁ + (1 - √3) z₂ has σ².
        # The noise of a step has the covariance ((q11, q12), (q12, q22)).
        for sigma, length in zip(sigmas, lengths, strict=True):
            r = self._step * self._speed / length
            e, half = np.exp(-r), 0.5 * sigma * sigma
            q11 = half * (1 - e * e)
            q12 = half / 2 * (1 - e * e * (1 + 2 * r))
            q22 = half / 2 * (1 - e * e * (1 + 2 * r + 2 * r * r))
            a = np.sqrt(q11)
            filters += [e, r, a, q12 / a, np.sqrt(q22 - q12 * q12 / q11)]
        put = {"dtype": normal.dtype, "device": normal.device}
        table = self._xp.asarray(np.stack(filters, axis=-1), **put)
        along, up = (self._xp.asarray(np.asarray(sigma), **put) for sigma in sigmas)
        start = [along * normal[..., 0]]
        for index, sigma in ((1, along), (3, up)):
            z1, z2 = normal[..., index], normal[..., index + 1]
            start += [math.sqrt(0.5) * sigma * z1, math.sqrt(0.125) * sigma * (z1 + z2)]
        chosen = mask[..., None]
        self._filters = self._kept(chosen, table, self._filters)
        self._state = self._kept(chosen, stack(start), self._state)

    def step(self, mask: Array | None, normal: Array) -> Array:
        """Advance by a physics step; normal (W, A, 5). The gust, world frame, m/s, (W, A, 3)."""
        f, z = self._filters, self._state
        new = [f[..., 0] * z[..., 0] + f[..., 1] * normal[..., 0]]
        for axis in range(2):
            e, r, a, b, c = (f[..., 2 + 5 * axis + i] for i in range(5))
            z1, z2 = z[..., 1 + 2 * axis], z[..., 2 + 2 * axis]
            n1, n2 = normal[..., 1 + 2 * axis], normal[..., 2 + 2 * axis]
            new += [e * z1 + a * n1, e * (z2 + r * z1) + b * n1 + c * n2]
        state = stack(new)
        self._state = state if mask is None else self._kept(mask[..., None], state, z)
        return self.now

    @property
    def now(self) -> Array:
        """The gust, world frame, m/s, shape (W, A, 3)."""
        z, (x, y), root = self._state, self._along, math.sqrt(3)
        u = z[..., 0]
        v, w = (root * z[..., i] + (1 - root) * z[..., i + 1] for i in (1, 3))
        return stack((x * u - y * v, y * u + x * v, w))

    def _kept(self, chosen: Array, new: Array, old: Array) -> Array:
        return new if old is None else self._xp.where(chosen, new, old)
