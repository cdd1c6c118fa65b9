"""Barometer."""

import math

from ..elementary import power
from ..state import Array, chosen, clip
from .base import ABOUT, Bounds, Sensor, Values

SEA_LEVEL_PRESSURE = 101_325.0  # Pa. These are those of ISO 2533:1975
SEA_LEVEL_TEMPERATURE = 288.15  # K
LAPSE_RATE = 0.0065  # K/m, up to 11 km
LOWEST = -5_000.0  # m
HIGHEST = 11_000.0
_EXPONENT = 9.80665 / (287.052_87 * LAPSE_RATE)


def isa_pressure(height: Array) -> Array:
    """Pressure of the International Standard Atmosphere, Pa, at a geopotential height in m.

    p = p₀ (1 - L h / T₀)^(g₀ / R L), ISO 2533:1975, in the troposphere: up to 11 km.
    """
    share = 1 - LAPSE_RATE / SEA_LEVEL_TEMPERATURE * height
    return SEA_LEVEL_PRESSURE * power(share, _EXPONENT)


def isa_height(pressure: Array) -> Array:
    """The reverse of `isa_pressure`: the pressure altitude, m."""
    share = power(pressure / SEA_LEVEL_PRESSURE, 1 / _EXPONENT)
    return SEA_LEVEL_TEMPERATURE / LAPSE_RATE * (1 - share)


_PRESSURES = (isa_pressure(HIGHEST), isa_pressure(LOWEST))


class Barometer(Sensor):
    """Pressure altitude: the height at which the standard atmosphere has the pressure it reads.

    White noise and a walk from 0 on act on the pressure, that of the standard atmosphere at the
    body's origin. Setting: the height of the ground above sea level.
    """

    about = ABOUT["barometer"]
    arrays = (*Sensor.arrays, "_bias")

    _bias: Array = None

    @classmethod
    def bounds(cls, values: Values) -> Bounds:
        return (LOWEST - 1,), (HIGHEST + 1,)

    def draw(self, mask: Array, normal: Array) -> None:
        """No walk yet."""
        self._bias = chosen(mask, 0.0 * normal[..., :1], self._bias)

    def measure(self, normal: Array) -> Array:
        height = self.world.state.position[..., 2:] + self.values["altitude"]
        exact = isa_pressure(clip(height, LOWEST, HIGHEST))
        pressure = exact + self._bias + self.values["noise"] * normal[..., :1]
        step = self.values["walk"] * math.sqrt(self.interval)
        self._bias = self._bias + step * normal[..., 1:]
        return isa_height(clip(pressure, *_PRESSURES))
