"""What all sensors share: settings, bounds of readings, and how they are sampled."""

import math
from collections.abc import Mapping
from statistics import NormalDist
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ... import models
from ...models import InputError
from ...models.coefficients import COEFFICIENTS
from ...models.fields import Limits, check, check_names
from ..snapshots import Kept
from ..state import Array, chosen, clip, some
from ..world import World

FURTHEST = 1e5  # Largest coordinate of a reading, m
MAX_SPEED = 1e3  # Largest speed of a reading along an axis, m/s
MAX_DELAY = 1000  # Longest delay, control steps
UNIT = 1.001  # Bound of a unit quaternion's components

Values = Mapping[str, Any]
"""Settings by name: numbers, tuples of numbers, None."""
Bounds = tuple[tuple[float, ...], tuple[float, ...]]
"""Least and largest value of each component."""


class Setting(NamedTuple):
    """A setting of a sensor."""

    default: float | tuple[float, ...] | None
    limits: Limits
    coefficient: str = ""
    """The coefficient of the vehicle that replaces the default.

    Without both, the option has to give the value.
    """


def coefficients(prefix: str, *needs: str, **defaults: float) -> dict[str, Setting]:
    """Settings that a vehicle's file may give, by the prefix and their names.

    Those of `needs` have no default: the vehicle or the option has to give them.
    """
    settings = {}
    for name in (*needs, *defaults):
        coefficient = f"sensors.{prefix}{name}"
        settings[name] = Setting(defaults.get(name), COEFFICIENTS[coefficient], coefficient)
    return settings


SAMPLING = {
    # Readings per second: the control rate over a whole number. None: the control rate.
    "rate": Setting(None, Limits(1e-3, 1e6, "Hz")),
    # Age of a reading when it is observed: a whole number of control periods.
    "delay": Setting(0.0, Limits(0.0, 10.0, "s")),
    # Probability that a reading is lost: the one before stays.
    "dropout": Setting(0.0, Limits(0.0, 0.99)),
}


class Source(Kept):
    """Base of sensors and of the estimate.

    Class attributes:
        name: In the option `sensors`, and of the observation's array.
        frame: Of the reading; so are `components` and `units`.
        top: Upper bound of each component, unless `bounds` computes it.
    """

    name: ClassVar[str]
    frame: ClassVar[str]
    components: ClassVar[tuple[str, ...]]
    units: ClassVar[tuple[str, ...]]
    top: ClassVar[tuple[float, ...]]

    @classmethod
    def bounds(cls, values: Values) -> Bounds:
        """Bounds of a reading with these settings."""
        return tuple(-bound for bound in cls.top), cls.top


class Sensor(Source):
    """Base of sensors, sampled at the end of control steps of `period` s.

    Inside, a flag follows each reading: 1 if it is new, 0 if it was held.

    Class attributes:
        settings: By name, without those of the sampling.
        columns: Normal numbers that a reading takes; `draw` gets as many at a reset.

    Attributes:
        values: All settings.
        interval: Time between two readings, s.
    """

    settings: ClassVar[dict[str, Setting]]
    columns: ClassVar[int]
    arrays: ClassVar[tuple[str, ...]] = ("_held", "_readings")
    _held: Array = None
    """The last reading that was taken."""
    _readings: Array = None
    """What is observed, with its flag, and those on their way: (W, A, k + 1, lag + 1)."""

    def __init__(self, values: Values, period: float, world: World) -> None:
        self.values = values
        self.interval = values["every"] * period
        self.world = world
        self._low, self._high = map(np.array, self.bounds(values))
        # One number more than the sensor takes decides whether a reading is lost.
        self._noise = world.random.noise(f"sensor {self.name}", self.columns + 1)
        dropout = values["dropout"]
        self._lost = round(NormalDist().inv_cdf(dropout), 12) if dropout else -math.inf

    @classmethod
    def checked(cls, given: Values) -> dict[str, Any]:
        """Settings by name as plain values. Raises `InputError`."""
        settings = cls.settings | SAMPLING
        check_names(given, settings, f"sensors.{cls.name}")
        values = {}
        for name, value in given.items():
            number = check(f"sensors.{cls.name}.{name}", settings[name].limits, value)
            values[name] = list(number) if isinstance(number, tuple) else number
        return values

    @classmethod
    def resolved(cls, given: Values, vehicle: "models.Vehicle", period: float) -> dict[str, Any]:
        """All settings: those given, else those of the vehicle, else the defaults.

        With `every` and `lag`, control steps between readings and of the delay.
        """
        values = {}
        for name, (value, _, coefficient) in (cls.settings | SAMPLING).items():
            if coefficient:
                own = vehicle.coefficients[coefficient]
                value = value if own is None else own
            value = given.get(name, value)
            if coefficient and value is None:
                raise InputError(
                    f"sensors.{cls.name}: expected {name} here, or {coefficient} in the vehicle's "
                    "file, got none"
                )
            values[name] = value
        where = f"sensors.{cls.name}"
        values["every"], values["lag"] = sampling(where, values["rate"], values["delay"], period)
        return values

    @property
    def value(self) -> Array:
        """What is observed now, shape (W, A, k)."""
        return self._readings[..., :-1, 0]

    @property
    def fresh(self) -> Array:
        """1 where it was not observed before, and 0 elsewhere, shape (W, A)."""
        return self._readings[..., -1, 0]

    def begin(self, mask: Array) -> None:
        """First reading of the drones of a mask."""
        self.draw(mask, self._noise.normal(mask)[..., :-1])
        first = self._read(self._noise.normal(mask))
        self._held = chosen(mask, first, self._held)
        old = np.repeat(_flagged(first, 0.0), self.values["lag"], axis=-1)
        readings = np.concat((_flagged(first, 1.0), old), axis=-1)
        self._readings = chosen(mask, readings, self._readings)

    def sample(self, mask: Array, steps: Array) -> None:
        """After a control step of the drones of a mask; `steps` counts those of each episode."""
        due = mask & (steps % self.values["every"] == 0)
        fresh = due
        if some(due):
            normal = self._noise.normal(due)
            fresh = due & (normal[..., -1] >= self._lost)
            self._held = chosen(fresh, self._read(normal), self._held)
        readings = np.concat((self._readings[..., 1:], _flagged(self._held, fresh)), axis=-1)
        self._readings = chosen(mask, readings, self._readings)

    def draw(self, mask: Array, normal: Array) -> None:
        """Draw an episode's errors for the drones of a mask."""

    def measure(self, normal: Array) -> Array:
        """A reading of the present state, shape (W, A, k), which may leave the bounds.

        The normals of drones that are not read are 0.
        """
        raise NotImplementedError

    def _read(self, normal: Array) -> Array:
        """A reading within the sensor's bounds."""
        return clip(self.measure(normal[..., :-1]), self._low, self._high)


def sampling(where: str, rate: float | None, delay: float, period: float) -> tuple[int, int]:
    """Control steps between readings, and of their delay. Raises `InputError`."""
    every = 1.0 if rate is None else 1 / (rate * period)
    if round(every) < 1 or not _is_whole(every):
        raise InputError(
            f"{where}.rate: expected the control rate of {1 / period:g} Hz over a "
            f"whole number, got {rate:g} Hz"
        )
    lag = round(delay / period)
    if lag > MAX_DELAY or not _is_whole(delay / period):
        raise InputError(
            f"{where}.delay: expected a whole number of control periods of "
            f"{period:g} s, at most {MAX_DELAY}, got {delay:g} s"
        )
    return round(every), lag


def _is_whole(steps: float) -> bool:
    return abs(steps - round(steps)) < 1e-6 * max(steps, 1.0)


def _flagged(reading: Array, fresh: Array) -> Array:
    """A reading and its flag, shape (W, A, k + 1, 1)."""
    *lead, size = reading.shape
    both = np.empty_like(reading, np.float64, shape=(*lead, size + 1, 1))
    both[..., :-1, 0] = reading
    both[..., -1, 0] = fresh
    return both
