"""`rotorgram/Tracking-v0`: follow a trajectory in time."""

from typing import Annotated, Literal

import numpy as np

from ...models.fields import Limits, immutable
from ...sim import Array, Draw, InitialState, cos, length, looked_up, remainder, sin
from ..spec import Metric
from ..state import State
from .goal import (
    WORST_RATES,
    Distance,
    GoalTask,
    Point,
    Size,
    along,
    check_height,
    check_room,
    nearness,
)
from .task import Outcome, TaskOptions

Curve = Literal["circle", "lemniscate"]


@immutable
class TrackingOptions(TaskOptions):
    """Options of `rotorgram/Tracking-v0`."""

    trajectory: Curve = "circle"
    """`circle` or `lemniscate`, level and without end."""
    center: Point = (0.0, 0.0, 5.0)
    """Middle of the curve: world frame, m."""
    radius: Distance = 2.0
    """Of the circle, or half the length of the lemniscate, m."""
    period: Annotated[float, Limits(0.1, 1e4, "s")] = 10.0
    """Time of a round, s."""
    preview: Annotated[int, Limits(0, 20, whole=True)] = 3
    """Later points of the trajectory in the observation, 0 to 20."""
    preview_time: Annotated[float, Limits(0.0, 100.0, "s")] = 0.2
    """Time between these, s."""
    start_band: Distance = 0.3
    """Largest distance of the start from the trajectory along each axis, m."""
    flight_band: Size = 3.0
    """An episode terminates when the craft is further than this from where it should be, m."""


class Tracking(GoalTask):
    """Be at the right place at the right time, along a trajectory that can be seen ahead.

    ## Observation, `float32`, shape (18 + R + 3 P,) with P = 3 later points (`preview`)

    Those of `GoalTask`, whose goal is where it should be; then the velocity of the trajectory, and
    where it should be, every 0.2 s (`preview_time`), minus position.

    Numbers are clipped: positions at the size of the trajectory, speeds at 100 m/s, rates at
    100 rad/s.

    ## Action

    By the option `action`; with `rotors` the thrust of each rotor: 0 is hover, -1 its least, 1 its
    largest.

    ## Reward

    (s - d) / (s + d) for the distance d from where it should be with s = 0.5 m; -0.02 s/rad times
    the size of the body rates, up to 20 rad/s; and -140 on the step that terminates.

    ## Trajectories

    A circle and a lemniscate of Bernoulli, begun at a phase drawn uniformly.

    ## Start, termination, truncation

    Level, within 0.3 m of the trajectory along each axis (`start_band`), at its velocity, at hover
    thrust.

    *Terminated*: further than 3 m from where it should be (`flight_band`), a tilt above 90°, or
    contact. *Truncated*: after 600 steps of 0.02 s.
    """

    Options = TrackingOptions
    worst_step = -1.0 + WORST_RATES
    episode_length = 600
    metrics = (
        Metric(name="tracking_error", unit="m", settled=0.2, held=0.2, symbol="e"),
        Metric(name="reference_speed", unit="m/s"),
    )

    def setup(self) -> None:
        """See the class."""
        options = self.options
        step = self.control_period
        count = max(2, round(options.period / step))
        phases = 2 * np.pi * np.arange(count) / count
        rate = 2 * np.pi / (count * step)
        x, y, fast_x, fast_y = _CURVES[options.trajectory](cos(phases), sin(phases))
        level = 0.0 * phases
        self._rates = options.radius * rate * np.column_stack((fast_x, fast_y, level))
        self._table = options.radius * np.column_stack((x, y, level)) + np.array(options.center)
        low = self._table.min(axis=0)
        high = self._table.max(axis=0)
        check_height("trajectory", low[2], self.vehicle.rest_height + options.start_band)
        check_room(self, float(abs(self._table[:, :2]).max()) + options.start_band)
        reach = length(high - low) + 2 * options.flight_band
        numbers = along("reference velocity", "m/s", 100.0)
        self._ahead = []
        for number in range(1, options.preview + 1):
            ahead = number * options.preview_time
            numbers += along(f"reference {ahead:g} s later - position", "m", reach)
            self._ahead.append(float(round(ahead / step)))
        self.define_observation(reach / 2, numbers)

    def begin(self, draw: Draw) -> InitialState:
        """Near any point of the trajectory, at its velocity."""
        share = draw.uniform(0.0, 1.0)
        self.memory.index = np.floor(share * len(self._table))  # row of the table
        offset = self.offset(draw)
        position = self._at(self._table, 0.0) + offset
        velocity = self._at(self._rates, 0.0) + 0.0 * offset
        return InitialState(position=position, velocity=velocity)

    def update_memory(self, state: State) -> None:
        """Go on along the trajectory."""
        self.memory.index = self.memory.index + 1.0

    def further(self, state: State) -> list[Array]:
        """The velocity of the trajectory, and where it is later."""
        velocity = self._at(self._rates, 0.0) + 0.0 * state.position
        later = [self._at(self._table, ahead) - state.position for ahead in self._ahead]
        return [velocity, *later]

    def outcome(self, state: State) -> Outcome:
        """Nearness to where it should be; the end at contact, a flip-over, or too far away."""
        distance = self.distance(state)
        crashed = self.crashed(state, distance > self.options.flight_band)
        speed = length(self._at(self._rates, 0.0))
        metrics = {"tracking_error": distance, "reference_speed": speed}
        return self.judged(state, {"position": nearness(distance)}, crashed, metrics)

    def goal(self, state: State) -> Array:
        """Where it should be."""
        return self._at(self._table, 0.0)

    def _at(self, table: np.ndarray, ahead: float) -> Array:
        """Row of a table, `ahead` steps ahead: shape (..., 3)."""
        return looked_up(table, remainder(self.memory.index + ahead, len(table)))


def _circle(c: Array, s: Array) -> tuple[Array, ...]:
    """x and y on the curve of radius 1, and their slopes over the phase, by its cosine and sine."""
    return c, s, -s, c


def _lemniscate(c: Array, s: Array) -> tuple[Array, ...]:
    """As `_circle` of Bernoulli's: (cos φ, sin φ cos φ) / (1 + sin² φ)."""
    below = 1 + s * s
    fast_x = -s * (below + 2 * c * c) / (below * below)
    fast_y = ((c * c - s * s) * below - 2 * s * s * c * c) / (below * below)
    return c / below, s * c / below, fast_x, fast_y


_CURVES = {"circle": _circle, "lemniscate": _lemniscate}
