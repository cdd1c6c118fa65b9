"""Sensors and an onboard estimate, as options of every task; `docs/sensors.md` is their page.

A sensor is sampled at the end of a control step, from the exact state there: one with a rate below
the control rate holds its last reading in between. A reset gives a first reading, which a delay
holds too. Each sensor has random numbers of its own, so that none moves those of another.

World frame: x east, y north, z up. Arrays have the leading axes of the world.
"""

from collections.abc import Mapping
from typing import Any

from ... import models
from ...models.errors import InputError
from ...models.fields import Choice, Flag, check, check_names, mapping
from ..snapshots import Kept
from ..state import Array, ByName, WorldState
from ..world import World
from . import range_sensors
from .barometer import Barometer
from .base import Sensor, Source, Values, checked_settings
from .estimator import Estimator
from .imu import Imu
from .simple import Battery, Gps, Magnetometer, MotionCapture, Rangefinder

SENSOR_TYPES: Mapping[str, type[Sensor]] = {
    kind.about.name: kind
    for kind in (Imu, Magnetometer, Barometer, Rangefinder, Gps, MotionCapture, Battery)
}
"""In this order they are observed."""

Settings = dict[str, Any]
_ESTIMATE = Estimator.about.name
_OBSERVED = Choice(("added", _ESTIMATE))


def checked_sensors(option: object) -> Settings:
    """The option `sensors` of a task as plain values in one order. Raises `InputError`.

    By sensor its settings by name, or True for none; False leaves it out. `estimate` is True or
    False, `observe` is "added" or "estimate".
    """
    given = mapping(option, "sensors", "settings by sensor")
    kinds = (*SENSOR_TYPES, *range_sensors.KINDS)
    check_names(given, [*kinds, _ESTIMATE, "observe"], "sensors")
    sensors: Settings = {}
    for name in kinds:
        settings = given.get(name, False)
        if settings is False:
            continue
        if settings is True:
            settings = {}
        settings = mapping(settings, f"sensors.{name}", "true, or settings by name")
        if name in SENSOR_TYPES:
            own = SENSOR_TYPES[name].about.settings
            rules = {one: setting.limits for one, setting in own.items()}
            sensors[name] = checked_settings(name, rules, settings)
        else:
            sensors[name] = range_sensors.checked(name, settings)
    if check("sensors.estimate", Flag(), given.get(_ESTIMATE, False)):
        sensors[_ESTIMATE] = True
    observe = check("sensors.observe", _OBSERVED, given.get("observe", "added"))
    if observe == _ESTIMATE:
        if _ESTIMATE not in sensors:
            raise InputError("sensors: expected estimate, which is to be observed, got none")
        sensors["observe"] = observe
    if _ESTIMATE in sensors and "imu" not in sensors:
        raise InputError("sensors: expected imu, which estimate needs, got none")
    return sensors


def _resolved(sensors: Values, vehicle: "models.Vehicle", period: float) -> dict[str, Settings]:
    """All settings by sensor."""
    return {
        name: kind.resolved(sensors[name], vehicle, period)
        for name, kind in SENSOR_TYPES.items()
        if name in sensors
    }


def readings_of(sensors: Values, vehicle: "models.Vehicle", period: float) -> list[Settings]:
    """Fields of the `ArraySpec` of each array that sensors add to an observation.

    From `checked_sensors`. Raises `InputError`.
    """
    readings: list[Settings] = []
    settings = _resolved(sensors, vehicle, period)
    kinds: list[type[Source]] = [*SENSOR_TYPES.values(), Estimator]
    for kind in kinds:
        about = kind.about
        if about.name not in sensors:
            continue
        low, high = kind.bounds(settings.get(about.name, {}))
        reading = {
            "name": about.name,
            "shape": (len(low),),
            "low": low,
            "high": high,
            "unit": tuple(about.units),
            "frame": about.frame,
            "components": tuple(about.components),
        }
        readings.append(reading)
    return [] if "observe" in sensors else readings


def range_sensors_of(
    sensors: Values, period: float, latest: int = 0, radius: float = 0.0
) -> list[range_sensors.RangeSensor]:
    """Sensors with rays, as of `RangeSensor`. Raises `InputError`."""
    return [
        range_sensors.RangeSensor(kind, sensors[kind], period, latest, radius)
        for kind in range_sensors.KINDS
        if kind in sensors
    ]


class Sensors(Kept):
    """The sensors of a world's drones, from `checked_sensors`, with `period` s between two samples.

    Raises `InputError`.
    """

    def __init__(self, sensors: Values, world: World, period: float) -> None:
        self._world = world
        settings = _resolved(sensors, world.vehicle, period)
        self._estimator = None
        if _ESTIMATE in sensors:
            self._estimator = Estimator(period, world.vehicle.gravity)
        self._sensors = {
            name: SENSOR_TYPES[name](values, period, world) for name, values in settings.items()
        }
        self._replaces = "observe" in sensors

    def begin(self, mask: Array) -> None:
        """Begin episodes of the drones of a mask, bool, shape (W, A), after a reset of theirs."""
        for sensor in self._sensors.values():
            sensor.begin(mask)
        if self._estimator is not None:
            self._estimator.begin(mask, self._world.state, self._sensors["imu"].value)

    def sample(self, mask: Array, steps: Array) -> None:
        """After a control step of the drones of a mask; the others keep their readings. `steps`
        counts those of each episode, shape (W, A).
        """
        for sensor in self._sensors.values():
            sensor.sample(mask, steps)
        if self._estimator is not None:
            self._estimator.update(mask, self._sensors)

    def parts(self) -> Mapping[str, Kept | None]:
        """The sensors and the estimator."""
        return {**self._sensors, _ESTIMATE: self._estimator}

    @property
    def readings(self) -> ByName:
        """What the observation gets, by name, shapes (W, A, k)."""
        if self._replaces:
            return {}
        readings = {name: sensor.value for name, sensor in self._sensors.items()}
        if self._estimator is not None:
            readings[_ESTIMATE] = self._estimator.estimate()
        return readings

    def seen(self) -> WorldState:
        """The state that task and controller see with `observe` "estimate"."""
        assert self._estimator is not None
        return self._estimator.seen(self._world.state)
