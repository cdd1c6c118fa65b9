"""What a vehicle's file says beyond its rigid body: the coefficients of effects and sensors.

An MJCF file has them as custom numerics named "rotorgram/GROUP.NAME" (`rotorgram/rotors.radius`),
and a vehicle's TOML file as NAME in the table GROUP. None: the file does not say it, and what needs
it cannot be switched on. SI units; body axes x forward, y left, z up.
"""

from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any, Final

import numpy as np

from .errors import InputError, expect

PREFIX: Final = "rotorgram/"


@dataclass(frozen=True)
class Limits:
    """What a coefficient may be: so many finite numbers from low to high, in a unit."""

    unit: str
    low: float
    high: float
    count: int | None = 1
    """How many numbers; None: one or more."""


def _number(unit: str, low: float, high: float, count: int | None = 1) -> Any:
    return field(default=None, metadata={"limits": Limits(unit, low, high, count)})


@dataclass(frozen=True, kw_only=True)
class Rotors:
    """Rotors, all alike."""

    radius: float | None = _number("m", 1e-3, 10.0)
    """Of the disc."""
    thrust_coefficient: float | None = _number("N s²/rad²", 1e-12, 1.0)
    """k in: thrust = k · speed²."""
    time_constant: float | None = _number("s", 1e-4, 10.0)
    """Of the speed's first-order answer to its command."""
    time_constant_down: float | None = _number("s", 1e-4, 10.0)
    """The same where the speed falls. None: as `time_constant`."""
    curve: tuple[float, ...] | None = _number("1", -10.0, 10.0, None)
    """c₀, c₁, c₂... in: thrust / largest thrust = c₀ + c₁ u + c₂ u² ... at throttle u, 0 to 1."""
    drag: float | None = _number("N s²/(rad m)", 0.0, 1.0)
    """k in: drag = -k · speed · velocity of the air past the rotor, in its plane."""
    inflow: float | None = _number("N s²/(rad m)", 0.0, 1.0)
    """k in: loss of thrust = k · speed · velocity of the rotor along its axis."""
    lift: float | None = _number("N s²/m²", 0.0, 10.0)
    """k in: gain of thrust = k · squared velocity of the air past the rotor, in its plane."""
    power: float | None = _number("W/N^1.5", 1e-3, 1e4)
    """k in: electrical power = k · thrust^1.5."""


@dataclass(frozen=True, kw_only=True)
class Drag:
    """Drag of the body, at its center of mass, along its axes."""

    linear: tuple[float, ...] | None = _number("N s/m", 0.0, 1e4, 3)
    """c in: force = -c · velocity of the air past it."""
    quadratic: tuple[float, ...] | None = _number("N s²/m²", 0.0, 1e4, 3)
    """c in: force = -c · speed · velocity, both of the air past it."""
    angular: tuple[float, ...] | None = _number("N m s", 0.0, 1e4, 3)
    """c in: torque = -c · body rates."""
    moment: tuple[float, ...] | None = _number("N s", -1e4, 1e4, 2)
    """c in: torque = (c₁ v_y, -c₂ v_x, 0), v the velocity through the air: rotors that flap, and
    drag above the center of mass."""


@dataclass(frozen=True, kw_only=True)
class Battery:
    """A battery: an open-circuit voltage that falls with the charge, behind a resistance."""

    full: float | None = _number("V", 0.1, 1e4)
    """Open-circuit voltage when it is full. The vehicle's largest thrust is given at this one."""
    empty: float | None = _number("V", 0.1, 1e4)
    """Open-circuit voltage when it is empty; in between it falls in proportion to the charge."""
    capacity: float | None = _number("A h", 1e-3, 1e4)
    resistance: float | None = _number("Ohm", 0.0, 100.0)
    """Of the battery and the wires."""


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Datasheet numbers of sensors. Densities: standard deviation per square root of hertz."""

    gyro_noise: float | None = _number("rad/s/√Hz", 0.0, 1.0)
    """White noise density of the gyroscope: the angle random walk."""
    gyro_walk: float | None = _number("rad/s²/√Hz", 0.0, 1.0)
    """Density of its bias's random walk: the rate random walk."""
    gyro_bias: float | None = _number("rad/s", 0.0, 10.0)
    """Standard deviation of its bias when it is switched on."""
    gyro_scale: float | None = _number("1", 0.0, 0.5)
    """Standard deviation of its error of scale."""
    accelerometer_noise: float | None = _number("m/s²/√Hz", 0.0, 10.0)
    accelerometer_walk: float | None = _number("m/s³/√Hz", 0.0, 10.0)
    accelerometer_bias: float | None = _number("m/s²", 0.0, 10.0)
    accelerometer_scale: float | None = _number("1", 0.0, 0.5)
    magnetometer_noise: float | None = _number("µT", 0.0, 1e3)
    """Standard deviation of a reading."""
    barometer_noise: float | None = _number("Pa", 0.0, 1e4)
    """Standard deviation of a reading."""
    barometer_walk: float | None = _number("Pa/s/√Hz", 0.0, 1e3)
    range_noise: float | None = _number("m", 0.0, 10.0)
    range_limit: float | None = _number("m", 0.01, 1e4)
    """Longest distance that the rangefinder sees."""
    gyro_range: float | None = _number("rad/s", 0.1, 1e3)
    """Largest rate that the gyroscope reads, along each axis."""
    accelerometer_range: float | None = _number("m/s²", 1.0, 1e4)
    gps_noise: float | None = _number("m", 0.0, 1e3)
    """Standard deviation of a horizontal coordinate."""
    gps_vertical_noise: float | None = _number("m", 0.0, 1e3)
    gps_velocity_noise: float | None = _number("m/s", 0.0, 100.0)
    """Standard deviation along each axis."""
    mocap_noise: float | None = _number("m", 0.0, 10.0)
    """Standard deviation of a coordinate that motion capture measures."""
    mocap_angle_noise: float | None = _number("rad", 0.0, 1.0)
    """Standard deviation of the attitude that it measures, about each axis."""


@dataclass(frozen=True, kw_only=True)
class Coefficients:
    """All groups."""

    rotors: Rotors = Rotors()
    drag: Drag = Drag()
    battery: Battery = Battery()
    sensors: Sensors = Sensors()

    def need(self, names: str, what: str) -> tuple[Any, ...]:
        """Values of "group.name" words. Raises `InputError` that names the first that is missing.

        `what` needs them: the effect or sensor, by its name.
        """
        values = []
        for name in names.split():
            group, _, key = name.partition(".")
            value = getattr(getattr(self, group), key)
            given = f"{name} in the vehicle's file, which {what} needs"
            expect(value is not None, "vehicle", given, "none")
            values.append(value)
        return tuple(values)

    @classmethod
    def read(cls, numbers: Mapping[str, Any]) -> "Coefficients":
        """From arrays of numbers by "group.name". Raises `InputError` for any that is wrong."""
        known, given = dict(coefficient_fields()), dict[str, dict[str, Any]]()
        for name, values in numbers.items():
            group, _, key = name.partition(".")
            near = [word for word in known if word.startswith(group + ".")] or list(known)
            expect(name in known, "vehicle", f"some of {', '.join(near)}", repr(name))
            given.setdefault(group, {})[key] = checked(name, known[name], values)
        kinds: dict[str, Callable[..., Any]] = {f.name: type(f.default) for f in fields(cls)}
        return cls(**{group: kinds[group](**values) for group, values in given.items()})

    def numbers(self) -> dict[str, tuple[float, ...]]:
        """The reverse of `read`: what the file says, by "group.name"."""
        told = {}
        for name, _ in coefficient_fields():
            group, _, key = name.partition(".")
            value = getattr(getattr(self, group), key)
            if value is not None:
                told[name] = value if isinstance(value, tuple) else (value,)
        return told


def coefficient_fields() -> list[tuple[str, Field[Any]]]:
    """Every coefficient as "group.name" with its field; `metadata["limits"]` has its `Limits`."""
    groups: dict[str, Any] = {group.name: group.default for group in fields(Coefficients)}
    return [(f"{name}.{one.name}", one) for name, group in groups.items() for one in fields(group)]


def checked(name: str, one: Field[Any], values: Any) -> float | tuple[float, ...]:
    """A coefficient's value within its limits, as a float or a tuple. Raises `InputError`."""
    limits: Limits = one.metadata["limits"]
    many = limits.count or "one or more"
    numbers = "a number" if limits.count == 1 else f"{many} numbers"
    unit = "" if limits.unit == "1" else f" {limits.unit}"
    expected = f"{numbers} from {limits.low:g} to {limits.high:g}{unit}"
    try:
        array = np.asarray(values)
        right = array.dtype.kind in "iuf" and array.ndim <= 1
        flat = tuple(np.ravel(array).astype(float).tolist()) if right else ()
    except (TypeError, ValueError, OverflowError):
        flat = ()
    right = len(flat) == limits.count or (limits.count is None and len(flat) > 0)
    right = right and all(limits.low <= value <= limits.high for value in flat)
    if not right:
        raise InputError(f"{name}: expected {expected}, got {values!r:.80}")
    return flat[0] if limits.count == 1 else flat
