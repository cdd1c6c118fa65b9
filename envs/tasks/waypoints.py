"""`rotorgram/Waypoints-v0`: fly to some points, one after the other."""

from typing import Annotated

import numpy as np

from ...models.fields import Limits, immutable
from ...sim import Array, Draw, InitialState, length
from ..spec import Mark, Metric
from ..state import State
from .goal import (
    COURSE_RATE_WEIGHT,
    COURSE_TIME_COST,
    COURSE_WORST_STEP,
    FLIGHT_TIME,
    FURTHEST,
    PASSING_REWARD,
    FramedOptions,
    GoalTask,
    Margin,
    Point,
    along,
    check_height,
    row_of,
)
from .task import Outcome

MAX_POINTS = 64


@immutable
class WaypointsOptions(FramedOptions):
    """Options of `rotorgram/Waypoints-v0`."""

    points: Annotated[int, Limits(1, MAX_POINTS, whole=True)] = 4
    """Points of an episode, 1 to 64."""
    center: Point = (0.0, 0.0, 5.0)
    """Middle of the box in which points and start are drawn: x, y, z in MuJoCo's world frame, m."""
    box: Annotated[tuple[float, float, float], Limits(0.0, FURTHEST, "m", count=3)] = (
        3.0,
        3.0,
        1.5,
    )
    """From that middle to the sides of the box, along x, y and z, m."""
    radius: Annotated[float, Limits(1e-3, FURTHEST, "m")] = 0.3
    """A point is reached by a craft that is nearer to it than this at a control step, m."""
    margin: Margin = 3.0
    """An episode terminates when the craft is further outside the box than this, m."""


class Waypoints(GoalTask):
    """Reach points one after the other, as soon as possible; with the last the episode ends.

    ## Observation, `float32`, shape (15 + R,) or (18 + R,)

    Those of `GoalTask`, whose goal is the next point; then the point after it minus position, of
    the last point the same. All are in the `frame`.

    Numbers are clipped: positions at the diagonal of the box and its margin, speeds at 100 m/s,
    rates at 100 rad/s.

    ## Action

    By the option `action`; with `rotors` the thrust of each rotor: 0 is hover, -1 its least, 1 its
    largest.

    ## Reward

    By how much the craft came nearer to the point in this step, 1/m; 1 on the step that reaches
    it; -0.04; -0.002 s/rad times the size of the body rates, up to 20 rad/s; and -8 on a step that
    terminates with points left. Progress pays 1 for a metre, not for a step: with 0.02 s/rad, as
    `Hover` has it, and -20 for a crash a turn costs more than it brings, and a craft that hovers
    loses nothing.

    ## Metrics

    `points_left`, those that were not reached, and `flight_time`, s, until now.

    ## Start, termination, truncation

    At rest and level, at hover thrust, at a point of the box.

    *Terminated*: the last point is reached; further than 3 m outside the box (`margin`), or
    contact. Any tilt is allowed. *Truncated*: after 750 steps of 0.02 s.
    """

    Options = WaypointsOptions
    worst_step = COURSE_WORST_STEP
    episode_length = 750
    metrics = (
        Metric(name="points_left", unit="", settled=0.5, held=0.5, final=True),
        FLIGHT_TIME,
    )

    def setup(self) -> None:
        """See the class."""
        options = self.options
        check_height("center", options.center[2], self.vehicle.rest_height + options.box[2])
        self.marks = (Mark(shape="ball", size=options.radius, moves=True),)
        self._sides = tuple(side + options.margin for side in options.box)
        furthest = 2 * length(np.array(self._sides))
        self.define_observation(furthest / 2, along("point after - position", "m", furthest))

    def begin(self, draw: Draw) -> InitialState:
        """At rest, level, somewhere in the box; the points are drawn alike."""
        options = self.options
        center = np.array(options.center)
        box = np.array(options.box)
        start, *points = [
            center + box * draw.uniform(-1.0, 1.0, (3,)) for _ in range(options.points + 1)
        ]
        memory = self.memory
        memory.points = np.stack(points, axis=-2)
        memory.distance = length(points[0] - start)
        memory.reached = memory.progress = memory.passed = 0.0
        return InitialState(position=start)

    def update_memory(self, state: State) -> None:
        """Count the point that was reached, and how much nearer the craft came."""
        memory = self.memory
        distance = self.distance(state)
        left = memory.reached < self.options.points
        passed = (distance < self.options.radius) & left
        memory.progress = memory.distance - distance
        memory.passed = passed * 1.0
        memory.reached = memory.reached + passed
        memory.distance = self.distance(state)

    def further(self, state: State) -> tuple[Array]:
        """The way to the point after the next."""
        after = self._point(self.memory.reached + 1.0)
        return (self.framed(state, after - state.position),)

    def outcome(self, state: State) -> Outcome:
        """Progress to the next point; the end at the last one, or far away."""
        options = self.options
        memory = self.memory
        left = options.points - memory.reached
        off = abs(state.position - np.array(options.center))
        crashed = (off > self._sides).any(axis=-1) | state.touching
        terms = {
            "progress": memory.progress,
            "passing": PASSING_REWARD * memory.passed,
            "time": -COURSE_TIME_COST,
        }
        metrics = {"points_left": left, "flight_time": state.time}
        return self.judged(state, terms, crashed, metrics, left < 0.5, COURSE_RATE_WEIGHT)

    def goal(self, state: State) -> Array:
        """The next point."""
        return self._point(self.memory.reached)

    def _point(self, index: Array) -> Array:
        """A point by its number from 0, the last for any larger one, shape (..., 3)."""
        return row_of(self.memory.points, np.minimum(index, self.options.points - 1.0))
