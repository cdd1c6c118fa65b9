"""Sensors with many rays: depth cameras, lidars and time-of-flight arrays.

They see the solids of a layout. `range_sensors.toml` has their models.
"""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any
from zlib import crc32

import numpy as np

from ...models.errors import InputError
from ...models.fields import Choice, Limits, check
from ...models.files import read_own_toml
from ...scenes import Layouts, Rays, returns
from ...scenes.rays import MAX_PLACE, MAX_REACH
from ...scenes.returns import RANGES, ErrorModel, Reading
from ..random import words_of
from ..rotations import to_world
from ..state import Array, ByName, clip
from .base import SAMPLING, Setting, Values, checked_settings, sampling, setting_of
from .instruments import Instrument, Moment

_TABLES = read_own_toml(__file__, "range_sensors")
_SETTINGS = {name: setting_of(row) for name, row in _TABLES.pop("settings").items()}
_SETTINGS |= {name: SAMPLING[name] for name in ("rate", "delay")}
MODELS: Mapping[str, Mapping[str, Values]] = _TABLES
"""Settings by kind and model."""
_PATTERNS = {
    "depth": ("rows", "columns", "fov"),
    "lidar": ("rows", "columns", "low", "high"),
    "tof": ("rows", "columns", "fov"),
}
"""Settings of the rays by kind."""
_BEYOND = 1.001  # of its reach: rays end where nothing returns
KINDS = RANGES
"""In this order they are observed."""


def checked(kind: str, given: Values) -> Values:
    """Settings of a sensor as plain values. Raises `InputError`."""
    models = Choice(tuple(MODELS[kind]))
    model = check(f"sensors.{kind}.model", models, given.get("model", models.words[0]))
    others = {name for pattern in _PATTERNS.values() for name in pattern}
    if "directions" not in MODELS[kind][model]:
        others -= set(_PATTERNS[kind])
    settings = {"model": Setting(None, models)}
    settings |= {name: one for name, one in _SETTINGS.items() if name not in others}
    return checked_settings(kind, settings, {"model": model, **given})


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
        model = MODELS[kind][given["model"]]
        defaults = {name: setting.default for name, setting in _SETTINGS.items()}
        values = {**defaults, **model, **given}
        where = f"sensors.{kind}"
        most = values["max_rate"]
        if (values["rate"] or 0.0) > most:
            raise InputError(
                f"{where}.rate: expected at most {most:g} Hz of a {values['model']}, "
                f"got {values['rate']:g} Hz"
            )
        every, lag = sampling(where, values["rate"], values["delay"], period)
        if values["rate"] is None:
            every = max(1, math.ceil(1 / (most * period) - 1e-6))
        super().__init__({kind: every}, lag, latest)
        self.name = kind
        self._radius = radius
        self._use = crc32(f"sensor {kind}".encode())
        sensor = _rays_of(kind, values)
        turn = _turn(math.radians(values["yaw"]), math.radians(values["pitch"]))
        along = sensor.directions[..., 0].ravel()
        self._is_flat = kind != "lidar" and "directions" not in model
        self._scale = (along if self._is_flat else np.ones_like(along)).astype(np.float32)
        self._mount = np.array(values["position"])
        self.errors = ErrorModel(**{name: values[name] for name in ErrorModel._fields})
        if self.errors.near >= self.errors.reach:
            raise InputError(
                f"{where}.reach: expected more than near = {self.errors.near:g} m, "
                f"got {self.errors.reach:g}"
            )
        self.shape = sensor.directions.shape[:2]
        ends = _BEYOND * self.errors.reach / self._scale
        check(f"{where}: its longest ray", Limits(0.0, MAX_REACH, "m"), float(ends.max()))
        self.rays = Rays(sensor.directions @ turn.T, ends.reshape(self.shape))
        grid = ("ring", "azimuth") if kind == "lidar" else ("row", "column")
        self.axes = () if "directions" in model else grid
        what = "along the axis of the sensor" if self._is_flat else "along each ray"
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
        return Reading(self.name, distances, reach, self._is_flat, origin, points)

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
        run(flat, self._scale, self._neighbours, words, self.errors.numbers(), read)
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

    @cached_property
    def _neighbours(self) -> Array:
        """As `returns.by_numpy` has them: to the right and below."""
        rows, columns = self.shape
        if not self.errors.edge_dropout:
            return np.zeros((0, 1 + rows * columns), np.int32)
        has = np.ones((2, rows, columns), np.int32)
        has[0, :, -1] = has[1, -1] = 0
        steps = np.array([[1], [columns]], np.int32)
        return np.concatenate((steps, has.reshape(2, -1)), axis=1)


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
    if kind == "lidar" and values["low"] > values["high"]:
        raise InputError(
            "sensors.lidar: expected low <= high, "
            f"got {values['low']:g} and {values['high']:g} degrees"
        )
    pattern = [values[name] for name in _PATTERNS[kind]]
    return Rays.rings(*pattern) if kind == "lidar" else Rays.pinhole(*pattern)


def _turn(yaw: float, pitch: float) -> np.ndarray:
    """From the sensor's frame to the body's: first tilted up by the pitch, then turned left."""
    c, s, p, q = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    return np.array([[c * p, -s, -c * q], [s * p, c, -s * q], [q, 0.0, p]])
