"""`rotorgram/Hover-v0`: hold a position and a heading with independent rotors."""

import math
from typing import Annotated, ClassVar

from ...models.fields import Limits, immutable
from ...sim import Draw, InitialState, atan2, body_x, cos, parts_of, sin, stack, wrapped
from ..spec import Metric
from ..state import State
from .goal import (
    ERROR_SCALE,
    POSITION_ERROR,
    WORST_RATES,
    Distance,
    GoalTask,
    Heading,
    Point,
    Tilt,
    at,
    check_cube,
    check_height,
    nearness,
)
from .task import Outcome, TaskOptions

HEADING_WEIGHT = 0.2  # Cost of a heading half a turn off


@immutable
class HoverOptions(TaskOptions):
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
        x, y, _ = parts_of(body_x(state.quaternion))
        off = atan2(y, x) - self.wanted
        heading = wrapped(off) * (180 / math.pi)
        crashed = self.crashed(state, distance > self.options.flight_band)
        terms = {
            "position": nearness(distance, self.near),
            "heading": -HEADING_WEIGHT / 180 * abs(heading),
        }
        metrics = {"position_error": distance, "heading_error": heading}
        return self.judged(state, terms, crashed, metrics)
