"""Sensors with many rays: depth cameras, lidars and time-of-flight arrays.

They see the solids of a layout. `models/range_sensors.toml` has their models.
"""

import math
from typing import Any
from zlib import crc32

import numpy as np

from ...models import InputError, Vehicle
from ...models.coefficients import COEFFICIENTS, RANGE_DEFAULTS, RANGE_MODELS, of_group
from ...models.fields import Choice, Limits, check
from ...scenes import Layouts, Rays, returns
from ...scenes.rays import MAX_PLACE, MAX_REACH
from ...scenes.returns import RANGES, ErrorModel, Reading
from ..random import words_of
from ..rotations import to_world
from ..state import Array, ByName, clip
from .base import Values, checked_settings, sampling
from .instruments import Instrument, Moment

_BEYOND = 1.001  # of its reach: rays end where nothing returns
KINDS = RANGES
"""In this order they are observed."""


def checked(kind: str, given: Values) -> Values:
    """Settings of a sensor as plain values. Raises `InputError`."""
    models = Choice(tuple(RANGE_MODELS[kind]))
    model = check(f"sensors.{kind}.model", models, given.get("model", models.words[0]))
    rules = of_group(f"sensors.{kind}.{model}", COEFFICIENTS)
    return checked_settings(kind, {"model": models, **rules}, given)


def mounted(sensors: Values, vehicle: Vehicle) -> Values:
    """The option `sensors`, as of `checked`, over the settings of a vehicle's file.

    A sensor takes the settings that the file has of its model, or of the first model if the option
    names none. Raises `InputError`, which names the file if its settings do not go together.
    """
    merged = dict(sensors)
    known = {name: value for name, value in vehicle.coefficients.items() if value is not None}
    for kind in RANGE_MODELS.keys() & sensors.keys():
        given = sensors[kind]
        for model in RANGE_MODELS[kind]:
            own = of_group(f"sensors.{kind}.{model}", known)
            if own and given.get("model", model) == model:
                own["model"] = model
                _completed(kind, own, f"{vehicle.path.name}: sensors.{kind}")
                merged[kind] = {**own, **given}
                break
    return merged


def _completed(kind: str, given: Values, where: str) -> Values:
    """All settings: those given, else those of the model, else the defaults.

    Raises `InputError` where they do not go together; `where` stands before it.
    """
    model = given.get("model", next(iter(RANGE_MODELS[kind])))
    values = {"rate": None, **RANGE_DEFAULTS, **RANGE_MODELS[kind][model], **given}
    most = values["max_rate"]
    if (values["rate"] or 0.0) > most:
        raise InputError(
            f"{where}.rate: expected at most {most:g} Hz of a {model}, got {values['rate']:g} Hz"
        )
    if values["near"] >= values["reach"]:
        raise InputError(
            f"{where}.reach: expected more than near = {values['near']:g} m, "
            f"got {values['reach']:g}"
        )
    if kind == "lidar" and values["low"] > values["high"]:
        raise InputError(
            f"{where}: expected low <= high, got {values['low']:g} and {values['high']:g} degrees"
        )
    return values


class RangeSensor(Instrument):
    """A sensor with rays on each drone: distances, m, float32, (W, A, rows, columns).

    `depth` and `tof` are measured along the sensor's axis, `lidar` along each ray. Where nothing
    returns they read `reach`.

    Attributes:
        name: `depth`, `lidar` or `tof`.
        rays: In the body frame.
        axes: Names of the axes of rows and columns; none of rays in single directions.
        errors: Of its readings.
    """

    def __init__(
        self, kind: str, given: Values, period: float, latest: int = 0, radius: float = 0.0
    ) -> None:
        """From `checked`, with the period of a control step, s; no observation is later than
        `latest` steps besides. Other drones are balls of a radius, m. Raises `InputError`.
        """
        where = f"sensors.{kind}"
        values = _completed(kind, given, where)
        every, lag = sampling(where, values["rate"], values["delay"], period)
        if values["rate"] is None:
            every = max(1, math.ceil(1 / (values["max_rate"] * period) - 1e-6))
        super().__init__({kind: every}, lag, latest)
        self.name = kind
        self._radius = radius
        self._use = crc32(f"sensor {kind}".encode())
        sensor = _rays_of(kind, values)
        turn = _turn(math.radians(values["yaw"]), math.radians(values["pitch"]))
        along = sensor.directions[..., 0].ravel()
        is_flat = kind != "lidar" and "directions" not in values
        self._scale = (along if is_flat else np.ones_like(along)).astype(np.float32)
        self._mount = np.array(values["position"])
        self.errors = ErrorModel(**{name: values[name] for name in ErrorModel._fields})
        self.shape = sensor.directions.shape[:2]
        ends = _BEYOND * self.errors.reach / self._scale
        check(f"{where}: its longest ray", Limits(0.0, MAX_REACH, "m"), float(ends.max()))
        self.rays = Rays(sensor.directions @ turn.T, ends.reshape(self.shape))
        grid = ("ring", "azimuth") if kind == "lidar" else ("row", "column")
        self.axes = () if "directions" in values else grid
        what = "along the axis of the sensor" if is_flat else "along each ray"
        self.frame = f"body, {what}"

    def read(self, moment: Moment, due: ByName) -> ByName:
        return {self.name: self._read(moment, due[self.name])}

    def taken(self, steps: int) -> int:
        """The control step after which the reading was taken that is observed after `steps`."""
        before = max(steps - self._lag, 0)
        return before - before % self.every[self.name]

    def reading(self, distances: Array, pose: Array) -> Reading:
        """One that was taken, m, (rows, columns), where a drone had a position, m, and a quaternion
        from body to world, (7,).
        """
        reach = self.errors.reach
        ranges = np.where(distances < reach, distances, np.nan) / self._scale.reshape(self.shape)
        rays = self._mount + self.rays.directions * ranges[..., None]
        position, attitude = np.split(pose, [3])
        origin = position + to_world(attitude, self._mount)
        points = position + to_world(attitude, rays)
        return Reading(self.name, distances, reach, origin, points)

    def _read(self, moment: Moment, due: Array) -> Array:
        worlds, drones = due.shape
        out = np.zeros((worlds, drones, *self.shape), np.float32)
        chosen = ... if due.all() else due
        scenery = moment.scenery
        place = moment.position[chosen].reshape(-1, 3)
        turn = moment.quaternion[chosen].reshape(-1, 4)
        if not len(place):
            return out
        if self._mount.any():
            place = place + to_world(turn, self._mount + 0.0 * place)
        which = np.broadcast_to(scenery.which[:, None], due.shape)[chosen].ravel()
        place = clip(place, -MAX_PLACE, MAX_PLACE)
        ranges = self.rays.cast(scenery.layouts, place, turn, which=which)
        if drones > 1:
            balls = Layouts.of_balls(_others(moment.position)[chosen], self._radius)
            rows = np.arange(len(place))
            hits = self.rays.cast(balls, place, turn, which=rows)
            ranges = np.minimum(ranges, hits)
        flat = ranges.reshape(len(place), -1)
        words = self._words(moment, due, chosen, flat.shape)
        read = np.empty_like(flat)
        code = returns.compiled()
        run = code.readings if code else returns.by_numpy
        run(flat, self._scale, self.shape[1], words, self.errors.numbers(), read)
        out[chosen] = read.reshape(out[chosen].shape)
        return out

    def _words(self, moment: Moment, due: Array, chosen: Any, shape: tuple[int, int]) -> Array:
        """Random words of each ray of the drones that are due."""
        if not self.errors.draws:
            return np.full(shape, returns.CALM, np.uint32)
        worlds, drones = due.shape
        size = -(-shape[1] // 4) * 4
        rows = worlds * drones
        words = np.empty((worlds, drones * size), np.uint32)
        steps = moment.steps[:, 0].astype(np.uint32)
        code = returns.compiled()
        keys = np.ascontiguousarray(moment.keys)
        if code:
            code.words(keys, np.uint64(self._use), moment.episode, steps, words)
        else:
            words[:] = words_of(keys, self._use, moment.episode, steps, drones * size)
        return np.ascontiguousarray(words.reshape(rows, size)[due.ravel(), : shape[1]])


def _others(position: Array) -> Array:
    """Positions of the other drones of a world, for each drone, (W, A, A - 1, 3)."""
    drones = position.shape[1]
    rows = np.arange(drones)[:, None]
    after = np.arange(1, drones)
    return position[:, (rows + after) % drones]


def _rays_of(kind: str, values: Values) -> Rays:
    """In the sensor's frame."""
    if "directions" in values:
        return Rays([values["directions"]])
    names = ("low", "high") if kind == "lidar" else ("fov",)
    pattern = [values[name] for name in ("rows", "columns", *names)]
    return Rays.rings(*pattern) if kind == "lidar" else Rays.pinhole(*pattern)


def _turn(yaw: float, pitch: float) -> np.ndarray:
    """From the sensor's frame to the body's: first tilted up by the pitch, then turned left."""
    c, s, p, q = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    return np.array([[c * p, -s, -c * q], [s * p, c, -s * q], [q, 0.0, p]])
