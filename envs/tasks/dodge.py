"""`rotorgram/Dodge-v0`: keep a place between balls that are thrown and posts that cross it."""

from types import MappingProxyType
from typing import Any

import numpy as np

from ...models.fields import immutable
from ...scenes import SceneConfig
from ...sim import Draw, InitialState, exp
from ..state import State
from .goal import Distance, Point, Tilt
from .hover import Hover, HoverOptions
from .measures import METRICS, begin_measures, measures_of, update_measures
from .task import Outcome

_LIDAR = {"model": "os0", "rows": 10, "columns": 48, "low": -30.0, "high": 45.0}
_NEAR = 0.5  # cost of a step that touches; e times less each 0.5 m further off


@immutable
class DodgeOptions(HoverOptions):
    """Options of `rotorgram/Dodge-v0`."""

    goal: Point = (0.0, 0.0, 2.0)
    """Place to keep: x, y, z in MuJoCo's world frame (z up), m."""
    start_band: Distance = 0.3
    """Largest distance of the start from the goal along each axis, m."""
    start_tilt: Tilt = 0.0
    """Largest tilt at the start, degrees, about a horizontal axis drawn uniformly."""
    flight_band: Distance = 2.0
    """An episode terminates when the craft is further than this from its goal, m."""


class Dodge(Hover):
    """Keep a place and a heading between balls that are thrown at it and posts that cross it.

    ## Observation

    `observation`, `float32`, shape (15 + R,): that of `Hover-v0`.

    `lidar`, `float32`, shape (10, 48): distances in 10 rings from 30° below to 45° above, m. They
    tell where solids are, and not where they go: a policy has to compare them with the last ones.

    ## Action

    By the option `action`; with `velocity` velocity and yaw rate.

    ## Reward

    That of `Hover-v0` with s = 2 m, because a craft that moves aside should earn more than one that
    crashes; and -0.5 exp(-clearance / 0.5 m).

    ## Start, termination, truncation

    At rest, level, within 0.3 m of the goal along each axis (`start_band`), before any ball flies.
    The scene is `traffic`, with a layout of its own in each episode.

    *Terminated*: further than 2 m from the goal (`flight_band`), a tilt above 90°, or contact.
    *Truncated*: after 300 steps of 0.04 s, when the last ball has passed.
    """

    Options = DodgeOptions
    near = 2.0
    worst_step = Hover.worst_step - _NEAR
    action = "velocity"
    control_period = 0.04
    episode_length = 300
    defaults = MappingProxyType(
        {"vehicle": ("hummingbird",), "backend": "rigid", "sensors": {"lidar": _LIDAR}}
    )
    metrics = (*METRICS, *Hover.metrics)

    @classmethod
    def scene(cls, options: Any) -> SceneConfig:
        """New throws in each episode."""
        return SceneConfig(name="traffic", layouts="new")

    def begin(self, draw: Draw) -> InitialState:
        """See the class."""
        begin_measures(self)
        return super().begin(draw)

    def update_memory(self, state: State) -> None:
        """Measure the step."""
        update_measures(self, state)

    def outcome(self, state: State) -> Outcome:
        """That of `Hover`, with the cost of what is near."""
        outcome = super().outcome(state)
        outcome.reward["nearness"] = -_NEAR * exp(-np.maximum(state.clearance, 0.0) / 0.5)
        lasted = state.time > (self.episode_length - 0.5) * self.control_period
        outcome.metrics.update(measures_of(self, state, lasted > outcome.terminated))
        return outcome
