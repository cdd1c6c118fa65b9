"""Sensors and an onboard estimate, as options of every task; `docs/sensors.md` is their page.

A sensor is sampled at the end of a control step, from the exact state there: one with a rate below
the control rate holds its last reading in between. A reset gives a first reading, which a delay
holds too. Each sensor has random numbers of its own, so that none moves those of another.

World frame: x east, y north, z up. Arrays have the leading axes of the world, none for one drone.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models.coefficients import COEFFICIENTS
from ..models.errors import InputError
from ..models.fields import Limits, check, limits_of
from .rotations import advanced, between, cross, parts_of, to_body, to_world, world_z
from .snapshots import Arrays, Kept, joined, part_of
from .state import Array, WorldState, clip, component, stack

if TYPE_CHECKING:
    from ..models.vehicle import Vehicle
    from .world import World

FIELD: Final = (1.287, 21.532, -43.231)
"""Earth's magnetic field at Zurich (47.377° N, 8.542° E, 408 m) on 2025-01-01: east, north and up,
µT. World Magnetic Model WMM2025, NOAA NCEI and British Geological Survey."""

SEA_LEVEL_PRESSURE: Final = 101_325.0  # Pa. These are those of ISO 2533:1975
SEA_LEVEL_TEMPERATURE: Final = 288.15  # K
LAPSE_RATE: Final = 0.0065  # K/m, up to 11 km
_EXPONENT: Final = 9.80665 / (287.052_87 * LAPSE_RATE)
LOWEST, HIGHEST = -5_000.0, 11_000.0  # Heights that the barometer tells, m

FURTHEST: Final = 1e5  # Largest coordinate of a reading, m
MAX_SPEED: Final = 1e3  # Largest speed of a reading along an axis, m/s
MAX_DELAY: Final = 1000  # Longest delay, control steps
GYRO_RANGE: Final = math.radians(2000.0)  # rad/s: the largest setting of the BMI088
ACCELEROMETER_RANGE: Final = 24 * 9.80665  # m/s²: the same

_UNIT: Final = 1.001  # Bound of a unit quaternion's components
_ESTIMATE: Final = "estimate"


def isa_pressure(height: Array) -> Array:
    """Pressure of the International Standard Atmosphere, Pa, at a geopotential height in m.

    p = p₀ (1 - L h / T₀)^(g₀ / R L), ISO 2533:1975, in the troposphere: up to 11 km.
    """
    return SEA_LEVEL_PRESSURE * (1 - LAPSE_RATE / SEA_LEVEL_TEMPERATURE * height) ** _EXPONENT


def isa_height(pressure: Array) -> Array:
    """The reverse of `isa_pressure`: the pressure altitude, m."""
    share = (pressure / SEA_LEVEL_PRESSURE) ** (1 / _EXPONENT)
    return SEA_LEVEL_TEMPERATURE / LAPSE_RATE * (1 - share)


class Reading(NamedTuple):
    """What a sensor adds to an observation; the names are those of an `ArraySpec`."""

    name: str
    shape: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    unit: tuple[str, ...]
    frame: str
    components: tuple[str, ...]


# ---- settings


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings that are no coefficients of a vehicle."""

    rate: Annotated[float | None, Limits(1e-3, 1e6, "Hz")] = None
    """Readings per second: the control rate over a whole number. None: the control rate."""
    delay: Annotated[float, Limits(0.0, 10.0, "s")] = 0.0
    """Age of a reading when it is told: a whole number of control periods."""
    dropout: Annotated[float, Limits(0.0, 0.99)] = 0.0
    """Probability that a reading is lost: the one before stays."""
    field: Annotated[tuple[float, ...], Limits(-100.0, 100.0, "µT", count=3)] = FIELD
    """Magnetic field in the world frame."""
    altitude: Annotated[float, Limits(-1e3, 9e3, "m")] = 0.0
    """Height of the ground above sea level."""
    attitude_time: Annotated[float, Limits(1e-3, 1e4, "s")] = 1.0
    """Time constant with which the estimated attitude follows what measures it."""
    height_time: Annotated[float, Limits(1e-3, 1e4, "s")] = 1.0
    """The same of height and climb rate, which follow the barometer."""
    position_time: Annotated[float, Limits(1e-3, 1e4, "s")] = 1.0
    """The same of position and velocity, which follow motion capture and GPS."""


_SETTINGS: Final = limits_of(Settings)
_SAMPLING: Final = ("rate", "delay", "dropout")


def checked_sensors(given: Any) -> dict[str, Any]:
    """The option `sensors` of a task as plain values in one order. Raises `InputError`.

    By sensor its settings by name, or True for none; False leaves it out. `observe` is "added" or
    "estimate".
    """
    known = [*SENSOR_TYPES, _ESTIMATE, "observe"]
    if not isinstance(given, Mapping):
        raise InputError(f"sensors: expected settings by sensor, got {given!r:.80}")
    for name in given:
        if name not in known:
            raise InputError(f"sensors: expected some of {', '.join(known)}, got {name!r:.300}")
    sensors: dict[str, Any] = {}
    for name in known[:-1]:
        settings = given.get(name)
        if settings is None or settings is False:
            continue
        if not (settings is True or isinstance(settings, Mapping)):
            raise InputError(
                f"sensors.{name}: expected true, or settings by name, got {settings!r:.80}"
            )
        sensors[name] = {} if settings is True else _checked_settings(name, settings)
    observe = given.get("observe", "added")
    if observe not in ("added", _ESTIMATE):
        raise InputError(f"sensors.observe: expected 'added' or 'estimate', got {observe!r:.300}")
    if observe == _ESTIMATE:
        if _ESTIMATE not in sensors:
            raise InputError("sensors: expected estimate, which is to be observed, got none")
        sensors["observe"] = observe
    if not (_ESTIMATE not in sensors or "imu" in sensors):
        raise InputError("sensors: expected imu, which estimate needs, got none")
    return sensors


def _limits(name: str) -> dict[str, Limits]:
    """Limits of all settings of a sensor, by their names."""
    if name == _ESTIMATE:
        names = ("attitude_time", "height_time", "position_time")
        return {one: _SETTINGS[one] for one in names}
    kind = SENSOR_TYPES[name]
    numbers = {
        one: COEFFICIENTS[f"sensors.{kind.prefix}{one}"] for one in (*kind.needs, *kind.defaults)
    }
    return numbers | {one: _SETTINGS[one] for one in (*kind.settings, *_SAMPLING)}


def _checked_settings(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    known = _limits(name)
    settings = {}
    for key, value in given.items():
        if key not in known:
            raise InputError(
                f"sensors.{name}: expected some of {', '.join(known)}, got {key!r:.300}"
            )
        number = check(f"sensors.{name}.{key}", known[key], value)
        settings[key] = list(number) if isinstance(number, tuple) else number
    return settings


def _resolved(
    name: str, given: Mapping[str, Any], vehicle: "Vehicle", period: float
) -> dict[str, Any]:
    """All settings of a sensor: those given, else the vehicle's, else the defaults.

    With `every` and `lag`, control steps between readings and of the delay. Raises `InputError`.
    """
    values: dict[str, Any] = {
        one: getattr(Settings(), one) for one in _limits(name) if one in _SETTINGS
    }
    if name == _ESTIMATE:
        return values | dict(given)
    kind = SENSOR_TYPES[name]
    for one in (*kind.needs, *kind.defaults):
        told = getattr(vehicle.coefficients.sensors, kind.prefix + one)
        if one in kind.needs and one not in given and told is None:
            raise InputError(
                f"sensors.{name}: expected {one} here, or sensors.{kind.prefix}{one} in the "
                "vehicle's file, got none"
            )
        values[one] = kind.defaults.get(one) if told is None else told
    values |= given
    values["every"] = _steps(f"{name}.rate", values["rate"], period) if values["rate"] else 1
    values["lag"] = _steps(f"{name}.delay", values["delay"], period)
    return values


def _steps(name: str, value: float, period: float) -> int:
    """A rate or delay in control steps. Raises `InputError` if they are no whole number."""
    is_rate = name.endswith("rate")
    steps = 1 / (value * period) if is_rate else value / period
    right = abs(steps - round(steps)) < 1e-6 * max(steps, 1.0) and round(steps) >= is_rate
    right = right and (is_rate or steps < MAX_DELAY + 0.5)
    what = f"the control rate of {1 / period:g} Hz over a whole number"
    late = f"a whole number of control periods of {period:g} s, at most {MAX_DELAY}"
    what = what if is_rate else late
    if not right:
        raise InputError(
            f"sensors.{name}: expected {what}, got {value:g} {'Hz' if is_rate else 's'}"
        )
    return round(steps)


def readings_of(
    sensors: Mapping[str, Any], vehicle: "Vehicle", period: float
) -> tuple[Reading, ...]:
    """What sensors add to an observation, from `checked_sensors`. Raises `InputError`."""
    settings = {
        name: _resolved(name, given, vehicle, period)
        for name, given in sensors.items()
        if name != "observe"
    }
    if sensors.get("observe") == _ESTIMATE:
        return ()
    return tuple(
        _ESTIMATE_READING if name == _ESTIMATE else SENSOR_TYPES[name](values, 1.0).reading
        for name, values in settings.items()
    )


# ---- what is measured


def specific_force(world: "World") -> Array:
    """Acceleration less that of gravity at the body's origin, body frame, m/s², shape (W, A, 3).

    R^T (a - g), with the attitude R and the acceleration a at the end of the control step, under
    the thrusts and the forces of the air of its last physics step.
    """
    state = world.state
    gravity = np.array((0.0, 0.0, world.vehicle.gravity))
    return to_body(state.quaternion, world.acceleration() + gravity)


class Sensor(Kept):
    """Base of sensors: a model of errors. `values` are all settings, `interval` is in s.

    Class attributes:
        name: In the option, and of the observation's array.
        prefix: What its coefficients' names begin with in a vehicle's file.
        needs: Coefficients that the vehicle or the option has to give.
        defaults: Coefficients that nobody has to give.
        settings: Names in `Settings`, besides those that every sensor has.
        columns: Normal numbers that a reading takes, and a reset.
        frame: Of the reading, and so are `components` and `units`.
    """

    name: ClassVar[str]
    prefix: ClassVar[str]
    needs: ClassVar[tuple[str, ...]] = ("noise",)
    defaults: ClassVar[Mapping[str, float]] = {}
    settings: ClassVar[tuple[str, ...]] = ()
    columns: ClassVar[int]
    frame: ClassVar[str] = ""
    components: ClassVar[tuple[str, ...]]
    units: ClassVar[tuple[str, ...]]

    def __init__(self, values: Mapping[str, Any], interval: float) -> None:
        self.values = values
        self.interval = interval

    def bounds(self) -> tuple[list[float], list[float]]:
        """(low, high) of each component."""
        raise NotImplementedError

    @property
    def reading(self) -> Reading:
        """Spec of a reading."""
        low, high = (tuple(end) for end in self.bounds())
        names = self.components
        return Reading(self.name, (len(names),), low, high, self.units, self.frame, names)

    def begin(self, mask: Array, normal: Array) -> None:
        """Draw an episode's errors for the drones of a mask."""

    def read(self, world: "World", normal: Array) -> Array:
        """A reading, shape (W, A, k). The normals of drones that are not read are 0."""
        raise NotImplementedError


class Imu(Sensor):
    """Gyroscope and accelerometer at the body's origin.

    reading = (1 + scale) · exact + bias + white noise, for each axis. White noise of density N read
    every T has σ = N / √T; the bias walks by K √T between readings. (IEEE Std 952-1997, annex C.)
    """

    name = "imu"
    prefix = ""
    arrays = ("_bias", "_scale")
    needs = ("gyro_noise", "accelerometer_noise")
    defaults: ClassVar[Mapping[str, float]] = {
        "gyro_walk": 0.0, "gyro_bias": 0.0, "gyro_scale": 0.0, "gyro_range": GYRO_RANGE,
        "accelerometer_walk": 0.0, "accelerometer_bias": 0.0, "accelerometer_scale": 0.0,
        "accelerometer_range": ACCELEROMETER_RANGE,
    }  # fmt: skip
    columns = 12
    frame = "body"
    components = tuple(f"{what} {axis}" for what in ("gyro", "accelerometer") for axis in "xyz")
    units = ("rad/s",) * 3 + ("m/s²",) * 3

    def __init__(self, values: Mapping[str, Any], interval: float) -> None:
        super().__init__(values, interval)
        self._white = self._both("noise") / math.sqrt(interval)
        self._step = self._both("walk") * math.sqrt(interval)
        self._bias: Array = 0.0
        self._scale: Array = 0.0

    def _both(self, what: str) -> np.ndarray:
        return np.repeat([self.values[f"gyro_{what}"], self.values[f"accelerometer_{what}"]], 3)

    def bounds(self) -> tuple[list[float], list[float]]:
        """Plus and minus the ranges."""
        high = self._both("range")
        return (-high).tolist(), high.tolist()

    def begin(self, mask: Array, normal: Array) -> None:
        """Bias and error of scale."""
        bias = self._both("bias")
        scale = self._both("scale")
        self._bias = _chosen(mask, bias * normal[..., :6], self._bias)
        self._scale = _chosen(mask, scale * normal[..., 6:], self._scale)

    def read(self, world: "World", normal: Array) -> Array:
        """Rates and specific force, as the class has them."""
        exact = np.concat((world.state.body_rates, specific_force(world)), axis=-1)
        high = self._both("range")
        reading = (1 + self._scale) * exact + self._bias + self._white * normal[..., :6]
        self._bias = self._bias + self._step * normal[..., 6:]
        return clip(reading, -high, high)


class Magnetometer(Sensor):
    """Earth's field in the body frame; white noise."""

    name = "magnetometer"
    prefix = "magnetometer_"
    columns = 3
    settings = ("field",)
    frame = "body"
    components = ("field x", "field y", "field z")
    units = ("µT",) * 3

    def bounds(self) -> tuple[list[float], list[float]]:
        """Plus and minus 1 mT, far from any reading but for a wrong noise."""
        return [-1e3] * 3, [1e3] * 3

    def read(self, world: "World", normal: Array) -> Array:
        """Field and noise."""
        field = np.array(self.values["field"]) + 0.0 * normal
        noise = self.values["noise"] * normal
        return clip(to_body(world.state.quaternion, field) + noise, -1e3, 1e3)


class Barometer(Sensor):
    """Pressure altitude: the height at which the standard atmosphere has the pressure it reads.

    White noise and a walk from 0 on act on the pressure, that of the standard atmosphere at the
    body's origin.
    """

    name = "barometer"
    prefix = "barometer_"
    columns = 2
    arrays = ("_bias",)
    defaults: ClassVar[Mapping[str, float]] = {"walk": 0.0}
    settings = ("altitude",)
    frame = "above sea level"
    components = ("pressure altitude",)
    units = ("m",)

    def __init__(self, values: Mapping[str, Any], interval: float) -> None:
        super().__init__(values, interval)
        self._step = values["walk"] * math.sqrt(interval)
        self._bias: Array = 0.0
        self._ends = isa_pressure(HIGHEST), isa_pressure(LOWEST)

    def bounds(self) -> tuple[list[float], list[float]]:
        """Of the troposphere, and below the sea."""
        return [LOWEST - 1], [HIGHEST + 1]

    def begin(self, mask: Array, normal: Array) -> None:
        """No walk yet."""
        self._bias = _chosen(mask, 0.0 * normal[..., :1], self._bias)

    def read(self, world: "World", normal: Array) -> Array:
        """Height by the pressure."""
        # An array of a single drone too: a power of Python's numbers may differ by a bit.
        height = world.state.position[..., 2:] + self.values["altitude"]
        exact = isa_pressure(clip(height, LOWEST, HIGHEST))
        pressure = exact + self._bias + self.values["noise"] * normal[..., :1]
        self._bias = self._bias + self._step * normal[..., 1:]
        return isa_height(clip(pressure, *self._ends))


class Rangefinder(Sensor):
    """Distance from the body's origin along its -z axis, by a ray; white noise."""

    name = "rangefinder"
    prefix = "range_"
    columns = 1
    needs = ("noise", "limit")
    frame = "body, along -z"
    components = ("distance",)
    units = ("m",)

    def bounds(self) -> tuple[list[float], list[float]]:
        """0 to the limit, which it reads where there is nothing."""
        return [0.0], [self.values["limit"]]

    def read(self, world: "World", normal: Array) -> Array:
        """Distance, 0 to the limit."""
        distance = clip(world.below(), 0.0, self.values["limit"])
        return clip(stack((distance,)) + self.values["noise"] * normal, 0.0, self.values["limit"])


class Gps(Sensor):
    """Position and velocity; white noise."""

    name = "gps"
    prefix = "gps_"
    columns = 6
    needs = ("noise", "vertical_noise", "velocity_noise")
    frame = "world"
    components = ("x", "y", "z", "vx", "vy", "vz")
    units = ("m",) * 3 + ("m/s",) * 3

    def bounds(self) -> tuple[list[float], list[float]]:
        """Far beyond any flight."""
        high = [FURTHEST] * 3 + [MAX_SPEED] * 3
        return [-x for x in high], high

    def read(self, world: "World", normal: Array) -> Array:
        """Position and velocity of the body's origin."""
        level, vertical, speed = (self.values[name] for name in self.needs)
        sigma = np.array((level, level, vertical, speed, speed, speed))
        exact = np.concat((world.state.position, world.state.velocity), axis=-1)
        low, high = (np.array(end) for end in self.bounds())
        return clip(exact + sigma * normal, low, high)


class MotionCapture(Sensor):
    """Position and attitude; white noise, of the attitude about the body's axes."""

    name = "motion_capture"
    prefix = "mocap_"
    columns = 6
    needs = ("noise", "angle_noise")
    frame = "world; quaternion: body to world"
    components = ("x", "y", "z", "qw", "qx", "qy", "qz")
    units = ("m",) * 3 + ("1",) * 4

    def bounds(self) -> tuple[list[float], list[float]]:
        """Far beyond any flight; a unit quaternion."""
        high = [FURTHEST] * 3 + [_UNIT] * 4
        return [-x for x in high], high

    def read(self, world: "World", normal: Array) -> Array:
        """Position and quaternion of the body."""
        state = world.state
        position = state.position + self.values["noise"] * normal[..., :3]
        angle = self.values["angle_noise"] * normal[..., 3:]
        turned = advanced(state.quaternion, angle)
        return np.concat((clip(position, -FURTHEST, FURTHEST), turned), axis=-1)


SENSOR_TYPES: Final[Mapping[str, type[Sensor]]] = {
    kind.name: kind for kind in (Imu, Magnetometer, Barometer, Rangefinder, Gps, MotionCapture)
}
"""In this order they are observed."""

_ESTIMATE_READING: Final = Reading(
    _ESTIMATE,
    (13,),
    (-FURTHEST,) * 3 + (-MAX_SPEED,) * 3 + (-_UNIT,) * 4 + (-2 * MAX_SPEED,) * 3,
    (FURTHEST,) * 3 + (MAX_SPEED,) * 3 + (_UNIT,) * 4 + (2 * MAX_SPEED,) * 3,
    ("m",) * 3 + ("m/s",) * 3 + ("1",) * 4 + ("rad/s",) * 3,
    "world; body rates: body",
    ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "wx", "wy", "wz"),
)


# ---- sampling


class _Channel(Kept):
    """A sensor as it is sampled: rate, delay and dropout.

    Attributes:
        value: What is told now, shape (W, A, k).
        fresh: Whether it was not told before, bool, shape (W, A).
    """

    arrays = ("value", "fresh", "_held")
    lists = ("_late_values", "_late_fresh")

    def __init__(self, name: str, values: Mapping[str, Any], world: "World", period: float) -> None:
        self._every = values["every"]
        self._lag = values["lag"]
        self.interval = self._every * period
        self.sensor = SENSOR_TYPES[name](values, self.interval)
        self._world = world
        # One number more than the sensor takes decides whether a reading is lost.
        self._noise = world.random.noise(f"sensor {name}", self.sensor.columns + 1)
        dropout = values["dropout"]
        self._lost = NormalDist().inv_cdf(dropout) if dropout else -math.inf
        self.value: Array = 0.0
        self.fresh: Array = False
        self._held: Array = 0.0
        self._late_values: list[Array] = []  # those on their way, the oldest first
        self._late_fresh: list[Array] = []

    def begin(self, mask: Array) -> None:
        """First reading of the drones of a mask."""
        self.sensor.begin(mask, self._noise.normal(mask)[..., :-1])
        first = self.sensor.read(self._world, self._noise.normal(mask)[..., :-1])
        self.value = _chosen(mask, first, self.value)
        self._held = _chosen(mask, first, self._held)
        self.fresh = mask | (self.fresh & ~mask)
        values = self._late_values or [self.value] * self._lag
        fresh = self._late_fresh or [self.fresh] * self._lag
        self._late_values = [_chosen(mask, first, value) for value in values]
        self._late_fresh = [flag & ~mask for flag in fresh]

    def sample(self, mask: Array, steps: Array) -> None:
        """After a control step of the drones of a mask; so many steps are behind each drone."""
        due = mask if self._every == 1 else mask & (steps % self._every == 0)
        fresh = due
        if np.any(due):
            normal = self._noise.normal(due)
            reading = self.sensor.read(self._world, normal[..., :-1])
            fresh = due & (component(normal, -1) >= self._lost)
            self._held = _chosen(fresh, reading, self._held)
        if not self._lag:
            self.value = self._held
            self.fresh = _chosen(mask, fresh, self.fresh)
            return
        self.value = _chosen(mask, self._late_values[0], self.value)
        self.fresh = _chosen(mask, self._late_fresh[0], self.fresh)
        self._late_values = _pushed(mask, self._held, self._late_values)
        self._late_fresh = _pushed(mask, fresh, self._late_fresh)


def _pushed(mask: Array, new: Array, late: list[Array]) -> list[Array]:
    """What is on its way after a step of the drones of a mask, the oldest first."""
    pairs = zip([*late[1:], new], late, strict=True)
    return [_chosen(mask, value, old) for value, old in pairs]


class Sensors(Kept):
    """The sensors of a world's drones, from `checked_sensors`, at so many s between two samples.

    Raises `InputError`.
    """

    arrays = ("_steps",)

    def __init__(self, sensors: Mapping[str, Any], world: "World", period: float) -> None:
        self._world = world
        settings = {
            name: _resolved(name, given, world.vehicle, period)
            for name, given in sensors.items()
            if name != "observe"
        }
        estimate = settings.pop(_ESTIMATE, None)
        self._channels = {
            name: _Channel(name, values, world, period) for name, values in settings.items()
        }
        self._estimator = None
        if estimate is not None:
            altitude = settings.get("barometer", {}).get("altitude", 0.0)
            field = settings.get("magnetometer", {}).get("field", FIELD)
            gravity = world.vehicle.gravity
            self._estimator = Estimator(estimate, period, gravity, altitude, field)
        self._replaces = sensors.get("observe") == _ESTIMATE
        self._steps: Array = 0

    def begin(self, mask: Array) -> None:
        """Begin episodes of the drones of a mask, bool, shape (W, A), after a reset of theirs."""
        self._steps = self._steps + 0 * mask if self._world.shape else 0
        self._steps = _chosen(mask, 0 * self._steps, self._steps)
        for channel in self._channels.values():
            channel.begin(mask)
        if self._estimator is not None:
            self._estimator.begin(mask, self._world.state, self._channels["imu"].value)

    def sample(self, mask: Array) -> None:
        """After a control step of the drones of a mask; the others keep their readings."""
        self._steps = self._steps + mask
        for channel in self._channels.values():
            channel.sample(mask, self._steps)
        if self._estimator is not None:
            self._estimator.update(mask, self._channels)

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Copies of all arrays that a later reading depends on, by name."""
        parts = {name: part.snapshot() for name, part in self._parts().items()}
        return joined(parts) | super().snapshot()

    def restore(self, arrays: Arrays) -> None:
        """Put a snapshot back, after that of the world."""
        super().restore(arrays)
        for name, part in self._parts().items():
            part.restore(part_of(arrays, name))

    def _parts(self) -> dict[str, Kept]:
        parts: dict[str, Kept] = dict(self._channels)
        for name, channel in self._channels.items():
            parts[f"{name} errors"] = channel.sensor
        if self._estimator is not None:
            parts[_ESTIMATE] = self._estimator
        return parts

    @property
    def readings(self) -> dict[str, Array]:
        """What the observation gets, by name, shapes (W, A, k)."""
        if self._replaces:
            return {}
        readings = {name: channel.value for name, channel in self._channels.items()}
        if self._estimator is not None:
            readings[_ESTIMATE] = self._estimator.reading()
        return readings

    def seen(self) -> WorldState:
        """The state that task and controller see: the exact one, or the estimate."""
        state = self._world.state
        return self._estimator.seen(state) if self._estimator and self._replaces else state


# ---- the estimate


class Estimator(Kept):
    """Complementary filter: what the IMU gives is integrated, and pulled to what measures it.

    Attitude: R. Mahony, T. Hamel, J.-M. Pflimlin, "Nonlinear Complementary Filters on the Special
    Orthogonal Group", IEEE TAC 53(5), 2008, equation 32, without its bias; the accelerometer's
    direction counts in proportion to its size over g, the magnetometer turns about the vertical
    alone. Position and velocity: a g-h filter with two equal poles (E. Brookner, "Tracking and
    Kalman Filtering Made Easy", 1998, section 1.2). The filter begins at the exact state, and
    takes a late reading for one of now.

    Args:
        times: Time constants, by the names of `Settings`, s.
        period: Time of a step, s.
        gravity: m/s².
        altitude: Of the ground above sea level, m.
        field: Earth's, world frame, shape (3,).
    """

    arrays = ("position", "velocity", "quaternion", "body_rates")

    def __init__(
        self,
        times: Mapping[str, float],
        period: float,
        gravity: float,
        altitude: float,
        field: Any,
    ) -> None:
        self._times = times
        self._period = period
        self._gravity = gravity
        self._altitude = altitude
        self._north = math.atan2(field[1], field[0])
        self.position: Array = 0.0
        self.velocity: Array = 0.0
        self.quaternion: Array = 0.0
        self.body_rates: Array = 0.0

    def begin(self, mask: Array, state: WorldState, imu: Array) -> None:
        """Take over the exact state of the drones of a mask."""
        for name in ("position", "velocity", "quaternion"):
            exact = getattr(state, name) + 0.0  # its own memory
            setattr(self, name, _chosen(mask, exact, getattr(self, name)))
        self.body_rates = imu[..., :3]

    def update(self, mask: Array, channels: Mapping[str, _Channel]) -> None:
        """A control step of the drones of a mask."""
        imu = channels["imu"].value
        period = self._period
        rates = imu[..., :3]
        force = imu[..., 3:]
        turned = advanced(self.quaternion, rates * period + self._correction(force, channels))
        gravity = np.array((0.0, 0.0, self._gravity))
        acceleration = to_world(turned, force) - gravity
        position = self.position + period * self.velocity + 0.5 * period**2 * acceleration
        velocity = self.velocity + period * acceleration
        position, velocity = self._followed(position, velocity, channels)
        self.quaternion = _chosen(mask, turned, self.quaternion)
        self.position = _chosen(mask, clip(position, -FURTHEST, FURTHEST), self.position)
        self.velocity = _chosen(mask, clip(velocity, -MAX_SPEED, MAX_SPEED), self.velocity)
        self.body_rates = _chosen(mask, rates, self.body_rates)

    def _correction(self, force: Array, channels: Mapping[str, _Channel]) -> Array:
        """Rotation vector in the body frame that pulls the attitude to what measures it, rad."""
        up = world_z(self.quaternion)
        time = self._times["attitude_time"]
        angle = (
            (1 - math.exp(-self._period / time))
            / self._gravity
            * stack(cross(parts_of(force), parts_of(up)))
        )
        if channel := channels.get("magnetometer"):
            field = to_world(self.quaternion, channel.value)
            off = self._north - np.atan2(component(field, 1), component(field, 0))
            off = np.atan2(np.sin(off), np.cos(off)) * self._gain(channel, "attitude_time")
            angle = angle + stack((off,)) * up
        if channel := channels.get("motion_capture"):
            error = between(self.quaternion, channel.value[..., 3:])
            sign = 2.0 * self._gain(channel, "attitude_time") * np.sign(component(error, 0))
            angle = angle + stack((sign,)) * error[..., 1:]
        return angle

    def _followed(
        self, position: Array, velocity: Array, channels: Mapping[str, _Channel]
    ) -> tuple[Array, Array]:
        """Position and velocity, pulled to what measures them."""
        if channel := channels.get("barometer"):
            zero = 0.0 * component(position, 2)
            off = component(channel.value, 0) - self._altitude - component(position, 2)
            g, h = self._gains(channel, "height_time")
            position = position + stack((zero, zero, g * off))
            velocity = velocity + stack((zero, zero, h * off))
        if channel := channels.get("motion_capture"):
            g, h = self._gains(channel, "position_time")
            off = channel.value[..., :3] - position
            position = position + stack((g,)) * off
            velocity = velocity + stack((h,)) * off
        if channel := channels.get("gps"):
            gain = stack((self._gain(channel, "position_time"),))
            position = position + gain * (channel.value[..., :3] - position)
            velocity = velocity + gain * (channel.value[..., 3:] - velocity)
        return position, velocity

    def _gain(self, channel: _Channel, time: str) -> Array:
        """Share of an error that a fresh reading takes away; 0 where there is none."""
        share = 1 - math.exp(-channel.interval / self._times[time])
        return share * channel.fresh + 0.0 * component(self.position, 0)

    def _gains(self, channel: _Channel, time: str) -> tuple[Array, Array]:
        """g, and h over the interval: 1 - ξ² and (1 - ξ)² for two poles at ξ."""
        pole = math.exp(-channel.interval / self._times[time])
        fresh = channel.fresh + 0.0 * component(self.position, 0)
        return (1 - pole**2) * fresh, (1 - pole) ** 2 / channel.interval * fresh

    def reading(self) -> Array:
        """Position, velocity, quaternion and rates, shape (W, A, 13)."""
        parts = (self.position, self.velocity, self.quaternion, self.body_rates)
        return np.concat(parts, axis=-1)

    def seen(self, state: WorldState) -> WorldState:
        """A state with the estimate in place of what is estimated."""
        return replace(
            state,
            position=self.position,
            velocity=self.velocity,
            quaternion=self.quaternion,
            body_rates=self.body_rates,
        )


def _chosen(mask: Array, new: Array, old: Array) -> Array:
    """`new`, (W, A) or (W, A, k), where the mask is true; elsewhere `old`, a number at first."""
    if not getattr(mask, "ndim", 0):  # a single drone's
        return new if mask else old
    if getattr(new, "ndim", 0) > mask.ndim:
        mask = mask[..., None]
    return np.where(mask, new, old)
