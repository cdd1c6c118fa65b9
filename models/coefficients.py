"""What a vehicle's file says beyond its rigid body: the coefficients of effects and sensors.

An MJCF file has them as custom numerics named "rotorgram/GROUP.NAME" (`rotorgram/rotors.radius`),
and a vehicle's TOML file as NAME in the table GROUP. None: the file does not say it, and what needs
it cannot be switched on. SI units; body axes x forward, y left, z up.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Final

from .errors import InputError
from .fields import Limits, check, check_names, limits_of, optional

PREFIX = "rotorgram/"


@dataclass(frozen=True, kw_only=True)
class Rotors:
    """Rotors, all alike."""

    radius: float | None = optional(1e-3, 10.0, "m")
    """Of the disc."""
    thrust_coefficient: float | None = optional(1e-12, 1.0, "N s²/rad²")
    """k in: thrust = k · speed²."""
    time_constant: float | None = optional(1e-4, 10.0, "s")
    """Of the speed's first-order answer to its command."""
    time_constant_down: float | None = optional(1e-4, 10.0, "s")
    """The same where the speed falls. None: as `time_constant`."""
    curve: tuple[float, ...] | None = optional(-10.0, 10.0, "1", count=None)
    """c₀, c₁, c₂... in: thrust / largest thrust = c₀ + c₁ u + c₂ u² ... at throttle u, 0 to 1."""
    drag: float | None = optional(0.0, 1.0, "N s²/(rad m)")
    """k in: drag = -k · speed · velocity of the air past the rotor, in its plane."""
    inflow: float | None = optional(0.0, 1.0, "N s²/(rad m)")
    """k in: loss of thrust = k · speed · velocity of the rotor along its axis."""
    lift: float | None = optional(0.0, 10.0, "N s²/m²")
    """k in: gain of thrust = k · squared velocity of the air past the rotor, in its plane."""
    power: float | None = optional(1e-3, 1e4, "W/N^1.5")
    """k in: electrical power = k · thrust^1.5."""


@dataclass(frozen=True, kw_only=True)
class Drag:
    """Drag of the body, at its center of mass, along its axes."""

    linear: tuple[float, ...] | None = optional(0.0, 1e4, "N s/m", count=3)
    """c in: force = -c · velocity of the air past it."""
    quadratic: tuple[float, ...] | None = optional(0.0, 1e4, "N s²/m²", count=3)
    """c in: force = -c · speed · velocity, both of the air past it."""
    angular: tuple[float, ...] | None = optional(0.0, 1e4, "N m s", count=3)
    """c in: torque = -c · body rates."""
    moment: tuple[float, ...] | None = optional(-1e4, 1e4, "N s", count=2)
    """c in: torque = (c₁ v_y, -c₂ v_x, 0), v the velocity through the air: rotors that flap, and
    drag above the center of mass."""


@dataclass(frozen=True, kw_only=True)
class Battery:
    """A battery: an open-circuit voltage that falls with the charge, behind a resistance."""

    full: float | None = optional(0.1, 1e4, "V")
    """Open-circuit voltage when it is full. The vehicle's largest thrust is given at this one."""
    empty: float | None = optional(0.1, 1e4, "V")
    """Open-circuit voltage when it is empty; in between it falls in proportion to the charge."""
    capacity: float | None = optional(1e-3, 1e4, "A h")
    resistance: float | None = optional(0.0, 100.0, "Ohm")
    """Of the battery and the wires."""


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Datasheet numbers of sensors. Densities: standard deviation per square root of hertz."""

    gyro_noise: float | None = optional(0.0, 1.0, "rad/s/√Hz")
    """White noise density of the gyroscope: the angle random walk."""
    gyro_walk: float | None = optional(0.0, 1.0, "rad/s²/√Hz")
    """Density of its bias's random walk: the rate random walk."""
    gyro_bias: float | None = optional(0.0, 10.0, "rad/s")
    """Standard deviation of its bias when it is switched on."""
    gyro_scale: float | None = optional(0.0, 0.5, "1")
    """Standard deviation of its error of scale."""
    accelerometer_noise: float | None = optional(0.0, 10.0, "m/s²/√Hz")
    accelerometer_walk: float | None = optional(0.0, 10.0, "m/s³/√Hz")
    accelerometer_bias: float | None = optional(0.0, 10.0, "m/s²")
    accelerometer_scale: float | None = optional(0.0, 0.5, "1")
    magnetometer_noise: float | None = optional(0.0, 1e3, "µT")
    """Standard deviation of a reading."""
    barometer_noise: float | None = optional(0.0, 1e4, "Pa")
    """Standard deviation of a reading."""
    barometer_walk: float | None = optional(0.0, 1e3, "Pa/s/√Hz")
    range_noise: float | None = optional(0.0, 10.0, "m")
    range_limit: float | None = optional(0.01, 1e4, "m")
    """Longest distance that the rangefinder sees."""
    gyro_range: float | None = optional(0.1, 1e3, "rad/s")
    """Largest rate that the gyroscope reads, along each axis."""
    accelerometer_range: float | None = optional(1.0, 1e4, "m/s²")
    gps_noise: float | None = optional(0.0, 1e3, "m")
    """Standard deviation of a horizontal coordinate."""
    gps_vertical_noise: float | None = optional(0.0, 1e3, "m")
    gps_velocity_noise: float | None = optional(0.0, 100.0, "m/s")
    """Standard deviation along each axis."""
    mocap_noise: float | None = optional(0.0, 10.0, "m")
    """Standard deviation of a coordinate that motion capture measures."""
    mocap_angle_noise: float | None = optional(0.0, 1.0, "rad")
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
        for name in names.split():
            if self._value(name) is None:
                raise InputError(
                    f"vehicle: expected {name} in the vehicle's file, which {what} needs, got none"
                )
        return tuple(map(self._value, names.split()))

    def _value(self, name: str) -> Any:
        return attrgetter(name)(self)

    @classmethod
    def read(cls, numbers: Mapping[str, object]) -> "Coefficients":
        """From numbers and lists of numbers by "group.name". Raises `InputError`."""
        groups: dict[str, dict[str, Any]] = {group: {} for group in GROUPS}
        for name, value in numbers.items():
            group, _, key = name.partition(".")
            alike = [word for word in COEFFICIENTS if word.startswith(group + ".")]
            check_names([name], alike or COEFFICIENTS, "vehicle")
            groups[group][key] = check(name, COEFFICIENTS[name], value)
        return cls(**{group: GROUPS[group](**values) for group, values in groups.items()})

    def numbers(self) -> dict[str, tuple[float, ...]]:
        """The reverse of `read`: the coefficients of the file, by "group.name"."""
        found = {name: self._value(name) for name in COEFFICIENTS}
        return {name: as_tuple(value) for name, value in found.items() if value is not None}


def as_tuple(value: float | tuple[float, ...]) -> tuple[float, ...]:
    """A number, or several, as a tuple."""
    return value if isinstance(value, tuple) else (value,)


GROUPS = {"rotors": Rotors, "drag": Drag, "battery": Battery, "sensors": Sensors}
COEFFICIENTS: Final[dict[str, Limits]] = {}
"""The limits of every coefficient, by "group.name"."""
for _group, _kind in GROUPS.items():
    COEFFICIENTS.update(limits_of(_kind, f"{_group}."))
