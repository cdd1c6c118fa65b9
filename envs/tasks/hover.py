"""Hold a position and a heading: `rotorgram/Hover-v0`, with independent rotors, and
`rotorgram/Dodge-v0`, between balls that are thrown and posts that cross it.
"""

import math
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import numpy as np

from ...models.fields import Limits, immutable
from ...scenes import SceneConfig
from ...sim import Draw, InitialState, cos, exp, parts_of, sin, stack
from ..spec import Metric
from ..state import State
from .goal import (
    ERROR_SCALE,
    HEADING_WEIGHT,
    POSITION_ERROR,
    WORST_RATES,
    Distance,
    Frame,
    FramedOptions,
    GoalTask,
    Heading,
    Point,
    Tilt,
    at,
    check_cube,
    check_height,
    heading_cost,
    nearness,
)
from .measures import METRICS, begin_measures, measures_of, update_measures
from .task import Outcome

_LIDAR = {"model": "os0", "rows": 10, "columns": 48, "low": -30.0, "high": 45.0}
_NEAR = 0.5  # cost of a step that touches; e times less each 0.5 m further off


@immutable
class HoverOptions(FramedOptions):
    """Options of `rotorgram/Hover-v0`."""

    goal: Point = (0.0, 0.0, 5.0)
    """Position to hold: x, y, z in MuJoCo's world frame (z up), m."""
    heading: Heading = 0.0
    """Direction of the nose to hold, degrees about z, anticlockwise from x."""
    start_band: Distance = 1.0
    """Largest distance of the start from the goal along each axis, m."""
    start_tilt: Tilt = 30.0
    """Largest tilt at the start, degrees, about a horizontal axis drawn uniformly."""
    start_heading: Annotated[float, Limits(0.0, 180.0, "degrees")] = 30.0
    """Largest error of the heading at the start, degrees."""
    flight_band: Distance = 3.0
    """An episode terminates when the craft is further than this from its goal, m."""
    frame: Frame | None = "world"
    """Frame of the observation."""

    def check(self) -> None:
        """Check the options of this task. Raises `InputError`."""
        check_cube(self.flight_band, self.start_band)


class Hover(GoalTask):
    """Hold a position and a heading, each rotor on its own, from tilted starts.

    ## Observation, `float32`, shape (15 + R,)

    Goal minus position, velocity, directions of the nose and of the thrust, body rates, and thrust
    of each rotor, as `GoalTask` has them.

    Numbers are clipped: positions at twice the flight band, speeds at 100 m/s, rates at 100 rad/s.

    ## Action, `Box(-1, 1, (R,), float32)`

    Thrust of each rotor: 0 is hover, -1 its least, 1 its largest.

    ## Reward

    (s - d) / (s + d) for the distance d to the goal with s = 0.5 m; -0.2 |heading error| / 180°;
    -0.02 s/rad times the size of the body rates, up to 20 rad/s; and -160 on the step that
    terminates.

    ## Start, termination, truncation

    At rest, within 1 m of the goal along each axis (`start_band`), tilted by up to 30°
    (`start_tilt`), the heading off by up to 30° (`start_heading`), at hover thrust.

    *Terminated*: further than 3 m from the goal (`flight_band`), a tilt above 90°, or contact.
    *Truncated*: after 250 steps of 0.02 s.
    """

    Options = HoverOptions
    heads = True
    near = ERROR_SCALE
    """Distance at which the reward for nearness crosses zero, m."""
    worst_step = -1.0 - HEADING_WEIGHT + WORST_RATES
    metrics: ClassVar[tuple[Metric, ...]] = (
        POSITION_ERROR,
        Metric(name="heading_error", unit="deg", settled=5.0, signed=True),
    )

    def setup(self) -> None:
        """See the class."""
        options = self.options
        check_height("goal", options.goal[2], self.vehicle.rest_height + options.start_band)
        self.wanted = math.radians(options.heading)
        self.define_observation(options.flight_band)

    def begin(self, draw: Draw) -> InitialState:
        """At rest near the goal, tilted and turned."""
        options = self.options
        offset = self.offset(draw)
        w, x, y, _ = parts_of(self.tilted(draw))
        off = math.radians(options.start_heading)
        heading = (self.wanted + draw.uniform(-off, off)) / 2
        # First tilted about a horizontal axis, then turned about the vertical.
        c = cos(heading)
        s = sin(heading)
        quaternion = stack((c * w, c * x - s * y, c * y + s * x, s * w))
        return InitialState(position=at(options.goal, w) + offset, quaternion=quaternion)

    def outcome(self, state: State) -> Outcome:
        """Nearness to goal and heading; the end at a crash, a flip-over, or outside the band."""
        distance = self.distance(state)
        heading = self.heading_error(state)
        crashed = self.crashed(state, distance > self.options.flight_band)
        terms = {
            "position": nearness(distance, self.near),
            "heading": heading_cost(heading),
        }
        metrics = {"position_error": distance, "heading_error": heading}
        return self.judged(state, terms, crashed, metrics)


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
