"""What a vehicle's file says beyond its rigid body: the coefficients of effects and sensors.

An MJCF file has them as custom numerics named "rotorgram/GROUP.NAME" (`rotorgram/rotors.radius`),
and a vehicle's TOML file as NAME in the table GROUP. None: the file does not say it, and what needs
it cannot be switched on. SI units; body axes x forward, y left, z up.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final

from .errors import InputError
from .fields import Limits, check, check_names, limits_of

PREFIX: Final = "rotorgram/"


@dataclass(frozen=True, kw_only=True)
class Rotors:
    """Rotors, all alike."""

    radius: Annotated[float | None, Limits(1e-3, 10.0, "m")] = None
    """Of the disc."""
    thrust_coefficient: Annotated[float | None, Limits(1e-12, 1.0, "N s²/rad²")] = None
    """k in: thrust = k · speed²."""
    time_constant: Annotated[float | None, Limits(1e-4, 10.0, "s")] = None
    """Of the speed's first-order answer to its command."""
    time_constant_down: Annotated[float | None, Limits(1e-4, 10.0, "s")] = None
    """The same where the speed falls. None: as `time_constant`."""
    curve: Annotated[tuple[float, ...] | None, Limits(-10.0, 10.0, "1", count=None)] = None
    """c₀, c₁, c₂... in: thrust / largest thrust = c₀ + c₁ u + c₂ u² ... at throttle u, 0 to 1."""
    drag: Annotated[float | None, Limits(0.0, 1.0, "N s²/(rad m)")] = None
    """k in: drag = -k · speed · velocity of the air past the rotor, in its plane."""
    inflow: Annotated[float | None, Limits(0.0, 1.0, "N s²/(rad m)")] = None
    """k in: loss of thrust = k · speed · velocity of the rotor along its axis."""
    lift: Annotated[float | None, Limits(0.0, 10.0, "N s²/m²")] = None
    """k in: gain of thrust = k · squared velocity of the air past the rotor, in its plane."""
    power: Annotated[float | None, Limits(1e-3, 1e4, "W/N^1.5")] = None
    """k in: electrical power = k · thrust^1.5."""


@dataclass(frozen=True, kw_only=True)
class Drag:
    """Drag of the body, at its center of mass, along its axes."""

    linear: Annotated[tuple[float, ...] | None, Limits(0.0, 1e4, "N s/m", count=3)] = None
    """c in: force = -c · velocity of the air past it."""
    quadratic: Annotated[tuple[float, ...] | None, Limits(0.0, 1e4, "N s²/m²", count=3)] = None
    """c in: force = -c · speed · velocity, both of the air past it."""
    angular: Annotated[tuple[float, ...] | None, Limits(0.0, 1e4, "N m s", count=3)] = None
    """c in: torque = -c · body rates."""
    moment: Annotated[tuple[float, ...] | None, Limits(-1e4, 1e4, "N s", count=2)] = None
    """c in: torque = (c₁ v_y, -c₂ v_x, 0), v the velocity through the air: rotors that flap, and
    drag above the center of mass."""


@dataclass(frozen=True, kw_only=True)
class Battery:
    """A battery: an open-circuit voltage that falls with the charge, behind a resistance."""

    full: Annotated[float | None, Limits(0.1, 1e4, "V")] = None
    """Open-circuit voltage when it is full. The vehicle's largest thrust is given at this one."""
    empty: Annotated[float | None, Limits(0.1, 1e4, "V")] = None
    """Open-circuit voltage when it is empty; in between it falls in proportion to the charge."""
    capacity: Annotated[float | None, Limits(1e-3, 1e4, "A h")] = None
    resistance: Annotated[float | None, Limits(0.0, 100.0, "Ohm")] = None
    """Of the battery and the wires."""


@dataclass(frozen=True, kw_only=True)
class Sensors:
    """Datasheet numbers of sensors. Densities: standard deviation per square root of hertz."""

    gyro_noise: Annotated[float | None, Limits(0.0, 1.0, "rad/s/√Hz")] = None
    """White noise density of the gyroscope: the angle random walk."""
    gyro_walk: Annotated[float | None, Limits(0.0, 1.0, "rad/s²/√Hz")] = None
    """Density of its bias's random walk: the rate random walk."""
    gyro_bias: Annotated[float | None, Limits(0.0, 10.0, "rad/s")] = None
    """Standard deviation of its bias when it is switched on."""
    gyro_scale: Annotated[float | None, Limits(0.0, 0.5, "1")] = None
    """Standard deviation of its error of scale."""
    accelerometer_noise: Annotated[float | None, Limits(0.0, 10.0, "m/s²/√Hz")] = None
    accelerometer_walk: Annotated[float | None, Limits(0.0, 10.0, "m/s³/√Hz")] = None
    accelerometer_bias: Annotated[float | None, Limits(0.0, 10.0, "m/s²")] = None
    accelerometer_scale: Annotated[float | None, Limits(0.0, 0.5, "1")] = None
    magnetometer_noise: Annotated[float | None, Limits(0.0, 1e3, "µT")] = None
    """Standard deviation of a reading."""
    barometer_noise: Annotated[float | None, Limits(0.0, 1e4, "Pa")] = None
    """Standard deviation of a reading."""
    barometer_walk: Annotated[float | None, Limits(0.0, 1e3, "Pa/s/√Hz")] = None
    range_noise: Annotated[float | None, Limits(0.0, 10.0, "m")] = None
    range_limit: Annotated[float | None, Limits(0.01, 1e4, "m")] = None
    """Longest distance that the rangefinder sees."""
    gyro_range: Annotated[float | None, Limits(0.1, 1e3, "rad/s")] = None
    """Largest rate that the gyroscope reads, along each axis."""
    accelerometer_range: Annotated[float | None, Limits(1.0, 1e4, "m/s²")] = None
    gps_noise: Annotated[float | None, Limits(0.0, 1e3, "m")] = None
    """Standard deviation of a horizontal coordinate."""
    gps_vertical_noise: Annotated[float | None, Limits(0.0, 1e3, "m")] = None
    gps_velocity_noise: Annotated[float | None, Limits(0.0, 100.0, "m/s")] = None
    """Standard deviation along each axis."""
    mocap_noise: Annotated[float | None, Limits(0.0, 10.0, "m")] = None
    """Standard deviation of a coordinate that motion capture measures."""
    mocap_angle_noise: Annotated[float | None, Limits(0.0, 1.0, "rad")] = None
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
            value = self._value(name)
            if value is None:
                raise InputError(
                    f"vehicle: expected {name} in the vehicle's file, which {what} needs, got none"
                )
            values.append(value)
        return tuple(values)

    def _value(self, name: str) -> float | tuple[float, ...] | None:
        group, _, key = name.partition(".")
        value: float | tuple[float, ...] | None = getattr(getattr(self, group), key)
        return value

    @classmethod
    def read(cls, numbers: Mapping[str, object]) -> "Coefficients":
        """From numbers and lists of numbers by "group.name". Raises `InputError`."""
        groups: dict[str, dict[str, Any]] = {}
        for name, value in numbers.items():
            group, _, key = name.partition(".")
            alike = [word for word in COEFFICIENTS if word.startswith(group + ".")]
            check_names([name], alike or COEFFICIENTS, "vehicle")
            groups.setdefault(group, {})[key] = check(name, COEFFICIENTS[name], value)
        return cls(**{group: GROUPS[group](**values) for group, values in groups.items()})

    def numbers(self) -> dict[str, tuple[float, ...]]:
        """The reverse of `read`: the coefficients of the file, by "group.name"."""
        found = {}
        for name in COEFFICIENTS:
            value = self._value(name)
            if value is not None:
                found[name] = value if isinstance(value, tuple) else (value,)
        return found


GROUPS: Final = {"rotors": Rotors, "drag": Drag, "battery": Battery, "sensors": Sensors}
COEFFICIENTS: Final[Mapping[str, Limits]] = {
    name: limits
    for group, kind in GROUPS.items()
    for name, limits in limits_of(kind, f"{group}.").items()
}
"""The limits of every coefficient, by "group.name"."""
