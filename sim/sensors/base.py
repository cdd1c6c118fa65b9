"""What all sensors share: settings, bounds of readings, and how they are sampled."""

import math
from collections.abc import Mapping
from statistics import NormalDist
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ... import models
from ...models.coefficients import COEFFICIENTS
from ...models.errors import InputError
from ...models.fields import Limits, check, check_names
from ..snapshots import Kept
from ..state import Array, chosen, clip, component, kept, some
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
        prefix: What its coefficients' names begin with in a vehicle's file.
        needs: Coefficients that the vehicle or the option has to give.
        defaults: Coefficients that may be missing.
        own: Settings that are no coefficients of a vehicle.
        columns: Normal numbers that a reading takes; `draw` gets as many at a reset.

    Attributes:
        values: All settings.
        interval: Time between two readings, s.
    """

    prefix: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ("noise",)
    defaults: ClassVar[Mapping[str, float]] = {}
    own: ClassVar[Mapping[str, Setting]] = {}
    columns: ClassVar[int]
    arrays: ClassVar[tuple[str, ...]] = ("_now", "_held")
    lists = ("_late",)

    def __init__(self, values: Values, period: float, world: World) -> None:
        self._every = values["every"]
        self._lag = values["lag"]
        self.values = values
        self.interval = self._every * period
        self.world = world
        self._low, self._high = map(np.array, self.bounds(values))
        # One number more than the sensor takes decides whether a reading is lost.
        self._noise = world.random.noise(f"sensor {self.name}", self.columns + 1)
        dropout = values["dropout"]
        self._lost = round(NormalDist().inv_cdf(dropout), 12) if dropout else -math.inf
        self._now: Array = 0.0  # what is observed, with its flag
        self._held: Array = 0.0  # the last reading that was taken
        self._late: list[Array] = []  # those on their way, the oldest first

    @classmethod
    def settings(cls) -> Mapping[str, Setting]:
        settings: dict[str, Setting] = {}
        for name in (*cls.needs, *cls.defaults):
            coefficient = cls.prefix + name
            limits = COEFFICIENTS[f"sensors.{coefficient}"]
            settings[name] = Setting(cls.defaults.get(name), limits, coefficient)
        return {**settings, **cls.own, **SAMPLING}

    @classmethod
    def checked(cls, given: Values) -> dict[str, Any]:
        """Settings by name as plain values. Raises `InputError`."""
        settings = cls.settings()
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
        for name, (value, _, coefficient) in cls.settings().items():
            if coefficient:
                own = vehicle.coefficients[f"sensors.{coefficient}"]
                value = value if own is None else own
            value = given.get(name, value)
            if coefficient and value is None:
                raise InputError(
                    f"sensors.{cls.name}: expected {name} here, or sensors.{coefficient} in the "
                    "vehicle's file, got none"
                )
            values[name] = value
        rate = values["rate"]
        every = 1.0 if rate is None else 1 / (rate * period)
        values["every"] = round(every)
        if values["every"] < 1 or not _is_whole(every):
            raise InputError(
                f"sensors.{cls.name}.rate: expected the control rate of {1 / period:g} Hz over a "
                f"whole number, got {rate:g} Hz"
            )
        delay = values["delay"]
        values["lag"] = round(delay / period)
        if values["lag"] > MAX_DELAY or not _is_whole(delay / period):
            raise InputError(
                f"sensors.{cls.name}.delay: expected a whole number of control periods of "
                f"{period:g} s, at most {MAX_DELAY}, got {delay:g} s"
            )
        return values

    @property
    def value(self) -> Array:
        """What is observed now, shape (W, A, k)."""
        return self._now[..., :-1]

    @property
    def fresh(self) -> Array:
        """1 where it was not observed before, and 0 elsewhere, shape (W, A)."""
        return component(self._now, -1)

    def begin(self, mask: Array) -> None:
        """First reading of the drones of a mask."""
        self.draw(mask, self._noise.normal(mask)[..., :-1])
        first = self._read(self._noise.normal(mask))
        self._held = chosen(mask, first, self._held)
        self._now = chosen(mask, _flagged(first, 1.0), self._now)
        old = _flagged(first, 0.0)
        self._late = [chosen(mask, old, late) for late in self._late or [old] * self._lag]

    def sample(self, mask: Array, steps: Array) -> None:
        """After a control step of the drones of a mask; `steps` counts those of each episode."""
        due = mask & (steps % self._every == 0)
        fresh = due
        if some(due):
            normal = self._noise.normal(due)
            fresh = due & (component(normal, -1) >= self._lost)
            self._held = chosen(fresh, self._read(normal), self._held)
        arriving, *queued = [*self._late, _flagged(self._held, fresh)]
        self._now = chosen(mask, arriving, self._now)
        self._late = list(kept(mask, queued, self._late))

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


def _is_whole(steps: float) -> bool:
    return abs(steps - round(steps)) < 1e-6 * max(steps, 1.0)


def _flagged(reading: Array, fresh: Array) -> Array:
    """A reading and its flag."""
    *lead, size = reading.shape
    both = np.empty_like(reading, np.float64, shape=(*lead, size + 1))
    both[..., :-1] = reading
    both[..., -1] = fresh
    return both
