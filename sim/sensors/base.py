"""What all sensors share: settings, bounds of readings, and how they are sampled."""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ... import models
from ...models import InputError
from ...models.coefficients import COEFFICIENTS
from ...models.fields import Limits, Rule, check, check_names
from ...models.files import read_own_toml
from ..snapshots import Kept
from ..state import Array, chosen, clip, filled, parts_of, pushed, some, stack
from ..world import World

MAX_DELAY = 1000  # Longest delay, control steps

Values = Mapping[str, Any]
"""Settings by name: numbers, tuples of numbers, None."""
Bounds = tuple[tuple[float, ...], tuple[float, ...]]
"""Least and largest value of each component."""


class Setting(NamedTuple):
    """A setting of a sensor."""

    default: float | tuple[float, ...] | None
    limits: Rule
    coefficient: str = ""
    """The coefficient of the vehicle that replaces the default.

    Without both, the option has to give the value.
    """


class About(NamedTuple):
    """What `sensors.toml` says of a sensor, or of the estimate."""

    name: str
    """In the option `sensors`, and of the observation's array."""
    frame: str
    components: Sequence[str]
    units: Sequence[str]
    settings: Mapping[str, Setting]
    top: Sequence[float] = ()
    """Upper bound of each component, unless `bounds` computes it."""
    normals: int = 0
    """Normal numbers that a reading takes; `draw` gets as many at a reset."""


def setting_of(row: Values) -> Setting:
    """A setting from its row."""
    limits = dict(row)
    default = limits.pop("default", None)
    coefficient = limits.pop("coefficient", "")
    known = COEFFICIENTS[coefficient] if coefficient else Limits(**limits)
    return Setting(default, known, coefficient)


def _about(name: str, table: Values) -> About:
    own = table.get("settings", {})
    settings = {one: setting_of(row) for one, row in own.items()}
    return About(**{**table, "name": name, "settings": settings | SAMPLING})


_TABLES = read_own_toml(__file__, "sensors")
SAMPLING = {name: setting_of(row) for name, row in _TABLES.pop("sampling").items()}
"""Settings of all sensors."""
ABOUT = {name: _about(name, table) for name, table in _TABLES.items()}
"""Of each sensor, and of the estimate."""


class Source(Kept):
    """Base of sensors and of the estimate.

    Class attributes:
        about: Its name, frame, components, units, bounds and settings.
    """

    about: ClassVar[About]

    @classmethod
    def bounds(cls, values: Values) -> Bounds:
        """Bounds of a reading with these settings."""
        top = tuple(cls.about.top)
        return tuple(-bound for bound in top), top


class Sensor(Source):
    """Base of sensors, sampled at the end of control steps of `period` s.

    Inside, a flag follows each reading: 1 if it is new, 0 if it was held.

    Attributes:
        values: All settings.
        interval: Time between two readings, s.
    """

    arrays: ClassVar[tuple[str, ...]] = ("_readings",)
    _readings: Array = None
    """What is observed, with its flag, and those on their way: (W, A, lag + 1, k + 1)."""

    def __init__(self, values: Values, period: float, world: World) -> None:
        self.values = values
        self.interval = values["every"] * period
        self.world = world
        self._low, self._high = map(np.array, self.bounds(values))
        # One number more than the sensor takes decides whether a reading is lost.
        self._noise = world.random.noise(f"sensor {self.about.name}", self.about.normals + 1)
        dropout = values["dropout"]
        self._lost = round(NormalDist().inv_cdf(dropout), 12) if dropout else -math.inf

    @classmethod
    def resolved(cls, given: Values, vehicle: "models.Vehicle", period: float) -> dict[str, Any]:
        """All settings: those given, else those of the vehicle, else the defaults.

        With `every` and `lag`, control steps between readings and of the delay.
        """
        values = {}
        where = f"sensors.{cls.about.name}"
        for name, (value, _, coefficient) in cls.about.settings.items():
            if coefficient:
                own = vehicle.coefficients[coefficient]
                value = value if own is None else own
            value = given.get(name, value)
            if coefficient and value is None:
                raise InputError(
                    f"{where}: expected {name} here, or {coefficient} in the vehicle's "
                    "file, got none"
                )
            values[name] = value
        values["every"], values["lag"] = sampling(where, values["rate"], values["delay"], period)
        return values

    @property
    def value(self) -> Array:
        """What is observed now, shape (W, A, k)."""
        return self._readings[:, :, 0, :-1]

    @property
    def fresh(self) -> Array:
        """1 where it was not observed before, and 0 elsewhere, shape (W, A)."""
        return self._readings[:, :, 0, -1]

    def begin(self, mask: Array) -> None:
        """First reading of the drones of a mask."""
        self.draw(mask, self._noise.normal(mask)[..., :-1])
        first = self._read(self._noise.normal(mask))
        readings = filled(_flagged(first, 0.0), self.values["lag"] + 1)
        readings[:, :, 0, -1] = 1.0
        self._readings = chosen(mask, readings, self._readings)

    def sample(self, mask: Array, steps: Array) -> None:
        """As `Sensors.sample`."""
        due = mask & (steps % self.values["every"] == 0)
        fresh = due
        parameters = self.world.parameters
        frozen = parameters.get(f"{self.about.name}_frozen", 0.0)
        lost = parameters.get(f"{self.about.name}_lost", 0.0)
        held = self._readings[:, :, -1, :-1] * np.expand_dims(lost == 0, -1)
        if some(due):
            normal = self._noise.normal(due)
            fresh = due & (normal[..., -1] >= self._lost) & (frozen + lost == 0)
            held = chosen(fresh, self._read(normal), held)
        readings = pushed(self._readings, _flagged(held, fresh))
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


def checked_settings(sensor: str, rules: Mapping[str, Rule], given: Values) -> Values:
    """Settings of a sensor by name as plain values. Raises `InputError`."""
    where = f"sensors.{sensor}"
    check_names(given, rules, where)
    values = {}
    for name, value in given.items():
        number = check(f"{where}.{name}", rules[name], value)
        values[name] = list(number) if isinstance(number, tuple) else number
    return values


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
    """A reading and its flag, shape (W, A, k + 1)."""
    return stack((*parts_of(reading), fresh))
