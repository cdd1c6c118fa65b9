"""What all sensors share: their settings, the spec of their readings, white noise."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

import numpy as np

from ...models.coefficients import COEFFICIENTS
from ...models.errors import InputError
from ...models.fields import Limits, check, check_names
from ..snapshots import Kept
from ..state import Array, clip
from ..world import World

if TYPE_CHECKING:
    from ...models.vehicle import Vehicle

FURTHEST: Final = 1e5  # Largest coordinate of a reading, m
MAX_SPEED: Final = 1e3  # Largest speed of a reading along an axis, m/s
MAX_DELAY: Final = 1000  # Longest delay, control steps
UNIT: Final = 1.001  # Bound of a unit quaternion's components

Values = Mapping[str, Any]
"""Settings by name: numbers, tuples of numbers, None."""


class Setting(NamedTuple):
    """A setting that is no coefficient of a vehicle."""

    default: float | tuple[float, ...] | None
    limits: Limits


SAMPLING: Final = {
    # Readings per second: the control rate over a whole number. None: the control rate.
    "rate": Setting(None, Limits(1e-3, 1e6, "Hz")),
    # Age of a reading when it is observed: a whole number of control periods.
    "delay": Setting(0.0, Limits(0.0, 10.0, "s")),
    # Probability that a reading is lost: the one before stays.
    "dropout": Setting(0.0, Limits(0.0, 0.99)),
}


class Reading(NamedTuple):
    """What a sensor adds to an observation; the names are those of an `ArraySpec`."""

    name: str
    shape: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    unit: tuple[str, ...]
    frame: str
    components: tuple[str, ...]


class Source(Kept):
    """Base of sensors and of the estimate.

    Args:
        values: All settings.
        interval: Time between two readings, s.

    Class attributes:
        name: In the option `sensors`, and of the observation's array.
        settings: Settings that are no coefficients of a vehicle.
        frame: Of the reading; so are `components` and `units`.
    """

    name: ClassVar[str]
    settings: ClassVar[Mapping[str, Setting]] = {}
    frame: ClassVar[str] = ""
    components: ClassVar[tuple[str, ...]]
    units: ClassVar[tuple[str, ...]]

    def __init__(self, values: Values, interval: float) -> None:
        self.values = values
        self.interval = interval

    def high(self) -> list[float]:
        """Upper bound of each component."""
        raise NotImplementedError

    def low(self) -> list[float]:
        return [-bound for bound in self.high()]

    @property
    def reading(self) -> Reading:
        """Spec of a reading."""
        low = tuple(self.low())
        high = tuple(self.high())
        shape = (len(high),)
        return Reading(self.name, shape, low, high, self.units, self.frame, self.components)

    @classmethod
    def limits(cls) -> dict[str, Limits]:
        """Limits of all settings by name."""
        return {name: setting.limits for name, setting in cls.settings.items()}

    @classmethod
    def checked(cls, given: Values) -> dict[str, Any]:
        """Settings by name as plain values. Raises `InputError`."""
        limits = cls.limits()
        check_names(given, limits, f"sensors.{cls.name}")
        settings = {}
        for name, value in given.items():
            number = check(f"sensors.{cls.name}.{name}", limits[name], value)
            settings[name] = list(number) if isinstance(number, tuple) else number
        return settings

    @classmethod
    def resolved(cls, given: Values, vehicle: "Vehicle", period: float) -> dict[str, Any]:
        """All settings: those given, else those of the vehicle, else the defaults."""
        return {name: one.default for name, one in cls.settings.items()} | dict(given)


class Sensor(Source):
    """Base of sensors: exact values and white noise, within bounds.

    Class attributes:
        prefix: What its coefficients' names begin with in a vehicle's file.
        needs: Coefficients that the vehicle or the option has to give.
        defaults: Coefficients that may be missing.
        columns: Normal numbers that a reading takes, and a reset.
    """

    prefix: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ("noise",)
    defaults: ClassVar[Mapping[str, float]] = {}
    columns: ClassVar[int]

    def __init__(self, values: Values, interval: float) -> None:
        super().__init__(values, interval)
        self._low = np.array(self.low())
        self._high = np.array(self.high())

    @classmethod
    def limits(cls) -> dict[str, Limits]:
        names = (*cls.needs, *cls.defaults)
        numbers = {name: COEFFICIENTS[f"sensors.{cls.prefix}{name}"] for name in names}
        sampling = {name: setting.limits for name, setting in SAMPLING.items()}
        return numbers | super().limits() | sampling

    @classmethod
    def resolved(cls, given: Values, vehicle: "Vehicle", period: float) -> dict[str, Any]:
        """With `every` and `lag`, control steps between readings and of the delay."""
        values: dict[str, Any] = {name: one.default for name, one in SAMPLING.items()}
        values |= cls.defaults
        for name in (*cls.needs, *cls.defaults):
            own = getattr(vehicle.coefficients.sensors, cls.prefix + name)
            if own is not None:
                values[name] = own
            elif name in cls.needs and name not in given:
                raise InputError(
                    f"sensors.{cls.name}: expected {name} here, or sensors.{cls.prefix}{name} in "
                    "the vehicle's file, got none"
                )
        values |= super().resolved(given, vehicle, period)
        values["every"] = cls._every(values["rate"], period)
        values["lag"] = cls._lag(values["delay"], period)
        return values

    @classmethod
    def _every(cls, rate: float | None, period: float) -> int:
        if rate is None:
            return 1
        steps = 1 / (rate * period)
        if round(steps) < 1 or not _is_whole(steps):
            raise InputError(
                f"sensors.{cls.name}.rate: expected the control rate of {1 / period:g} Hz over a "
                f"whole number, got {rate:g} Hz"
            )
        return round(steps)

    @classmethod
    def _lag(cls, delay: float, period: float) -> int:
        steps = delay / period
        if round(steps) > MAX_DELAY or not _is_whole(steps):
            raise InputError(
                f"sensors.{cls.name}.delay: expected a whole number of control periods of "
                f"{period:g} s, at most {MAX_DELAY}, got {delay:g} s"
            )
        return round(steps)

    def begin(self, mask: Array, normal: Array) -> None:
        """Draw an episode's errors for the drones of a mask."""

    def read(self, world: World, normal: Array) -> Array:
        """A reading, shape (W, A, k). The normals of drones that are not read are 0."""
        return clip(self.measure(world, normal), self._low, self._high)

    def measure(self, world: World, normal: Array) -> Array:
        """A reading that may leave the bounds."""
        raise NotImplementedError


def _is_whole(steps: float) -> bool:
    return abs(steps - round(steps)) < 1e-6 * max(steps, 1.0)
