"""Render modes of the envs. Code that draws is imported on first use."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from ..models.errors import InputError, shortened
from ..models.fleet import members_of
from ..scenes import SceneConfig
from ..sim.sensors.range_sensors import RangeSensor
from .spec import EnvSpec, Metric

if TYPE_CHECKING:
    from ..rendering import Canvas, Moment, Stage
    from ..rendering.live import LiveView
    from .loop import Loop

RENDER_MODES = ["human", "rgb_array"]


class Renderer:
    """`render` of an env: a picture of each world, or a window with the first in real time."""

    def __init__(self, mode: str | None, loop: "Loop") -> None:
        if mode is not None and mode not in RENDER_MODES:
            raise InputError(
                f"render_mode: expected None, 'human' or 'rgb_array', got {shortened(mode)}"
            )
        self._mode = mode
        self._loop = loop
        self._canvas: Canvas | None = None
        self._view: LiveView | None = None
        self._shown: list[Moment] = []
        self._drawn: SceneConfig | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Without what is open."""
        return vars(self) | {"_canvas": None, "_view": None, "_shown": []}

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Pictures, uint8, shape (height, width, 3); None in other modes than `rgb_array`.

        Raises `ResetNeeded` if a drone has had no episode.
        """
        if self._mode is None:
            gym.logger.warn("render: expected render_mode='rgb_array' or 'human', got None")
            return None
        episodes = np.ravel(self._loop.record.episodes)
        if not episodes.all():
            raise gym.error.ResetNeeded("render: expected a call of reset() first")
        now = moments(self._loop, (episodes - 1).tolist())
        if self._mode == "human":
            self._show(now)
            return None
        from ..rendering import Canvas

        drones = self._loop.config.drones
        one = len(now) == drones
        size = (480, 360) if one else (240, 180)
        pictures = []
        for first in range(0, len(now), drones):
            scene = self._scene(first // drones)
            if self._canvas is None:
                self._canvas = Canvas(self._stage(scene, trail=one), *size)
            canvas = self._canvas
            canvas.stage.show(*now[first : first + drones])
            pictures.append(canvas.draw())
        return tuple(pictures)

    def _show(self, now: "list[Moment]") -> None:
        from ..rendering import live

        shown = now[: self._loop.config.drones]  # of the first world
        scene = self._scene(0)
        if self._view is None:
            pace = live.Pace(self._loop.spec.control_period)
            self._view = live.LiveView(self._stage(scene, trail=True), pace)
        if shown != self._shown:  # `step` shows by itself, and a script may ask once more
            self._shown = shown
            self._view.draw_in_time(*shown)

    def _scene(self, world: int) -> SceneConfig:
        """What surrounds the drones of a world. A canvas or a window of another is closed."""
        scenery = self._loop.world.scenery
        scene = scenery.scene.with_seed(int(scenery.seeds[world])).shown
        if scene != self._drawn:
            self.close()
            self._drawn = scene
        return scene

    def _stage(self, scene: SceneConfig, *, trail: bool) -> "Stage":
        """Of a world."""
        from ..rendering import Stage

        drones = self._loop.config.drones
        crafts = members_of(self._loop.vehicle, drones)
        return Stage(scene, drones, vehicle=[str(one.path) for one in crafts], trail=trail)

    def close(self) -> None:
        """Close the canvas or the window."""
        for opened in (self._canvas, self._view):
            if opened is not None:
                opened.close()
        self._canvas = self._view = None


def moments(loop: "Loop", episodes: Sequence[int]) -> "list[Moment]":
    """The current `Moment` of every drone; `episodes` are the numbers of their episodes.

    Rays begin where the drones are now, also those of a reading that was taken before.
    """
    telemetry = loop.telemetry
    steps = loop.steps
    rewards = loop.rewards
    found = []
    for i, episode in enumerate(episodes):
        row = {name: values[i] for name, values in telemetry.items()}
        reward = float(rewards[i])
        step = int(steps[i])
        pose = np.concatenate((row["position"], row["attitude"]))
        readings = [
            sensor.reading(loop.observations[sensor.name][i], pose)
            for sensor in loop.instruments
            if isinstance(sensor, RangeSensor)
        ]
        found.append(
            moment(loop.spec, row, reward=reward, step=step, episode=episode, readings=readings)
        )
    return found


def metric_line(metric: Metric, value: float) -> tuple[str, str]:
    """Symbol or name of a metric, and its value with four digits and the unit."""
    whole = len(f"{abs(value):.0f}")
    number = f"{value:.{max(4 - whole, 0)}f}" if metric.unit else f"{value:.4g}"
    name = metric.symbol or metric.name.replace("_", " ")
    return name, f"{number} {metric.unit}".strip()


def moment(spec: EnvSpec, telemetry: Mapping[str, Any], *, step: int = 0, **rest: Any) -> "Moment":
    """The `Moment` of one drone, with `step`, `reward`, `episode` and `readings` as `Moment` has
    them.

    Telemetry is arrays by name: `position` (3,), `attitude` (4,), `thrust` (R,), and, if there are
    any, `metrics` (M,), `goal` (3,) and `payload` (3,).
    """
    from ..rendering import Moment

    numbers: dict[str, Any] = {}
    for name in ("position", "attitude", "thrust", "metrics", "goal", "payload"):
        if name in telemetry:
            numbers[name] = tuple(np.asarray(telemetry[name], float).tolist())
    thrusts = numbers.pop("thrust")
    values = zip(spec.metrics, numbers.pop("metrics", ()), strict=False)
    metrics = [metric_line(metric, value) for metric, value in values]
    return Moment(
        **numbers,
        thrusts=thrusts,
        metrics=tuple(metrics),
        marks=spec.marks,
        time=spec.control_period * step,
        step=step,
        **rest,
    )
