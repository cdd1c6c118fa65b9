"""What tasks of flight to a goal share: their observation, and the memory of an episode."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import numpy as np

from ...models import InputError
from ...models.fields import Limits, immutable
from ...sim import (
    SEEN,
    Array,
    Draw,
    Wrench,
    atan2,
    body_x,
    body_z,
    clip,
    cos,
    length,
    looked_up,
    parts_of,
    sin,
    stack,
    to_body,
    world_z,
    wrapped,
)
from ..spec import ArraySpec, Metric
from ..state import State
from .task import Outcome, Task, TaskOptions

ERROR_SCALE = 0.5  # Distance at which the reward for nearness crosses zero, m
HEADING_WEIGHT = 0.2  # Cost of a heading half a turn off
RATE_WEIGHT = 0.02  # Cost of a body rate of 1 rad/s
PASSING_REWARD = 1.0  # Of a course: added in a step in which a point or gate is passed
COURSE_RATE_WEIGHT = 0.002  # Of a course: cost of a body rate of 1 rad/s
COURSE_TIME_COST = 0.04  # Of a course: of each step
FASTEST_COUNTED = 20.0  # A faster body rate costs no more, rad/s
WORST_RATES = -RATE_WEIGHT * FASTEST_COUNTED
COURSE_WORST_RATES = -COURSE_RATE_WEIGHT * FASTEST_COUNTED
COURSE_WORST_STEP = -COURSE_TIME_COST + COURSE_WORST_RATES
LEAST_TILT_COSINE = 0.0
"""Cosine of the tilt (90°) past which the craft counts as flipped over."""
SHIFT = ("goal_x", "goal_y", "goal_z")  # parameters of events that move a goal
BODY_ACTIONS = ("rotors", "wrench", "rates")  # Those that act in the body frame
AIR = 0.6  # Least room under a craft that starts, m
FURTHEST = 1e4  # Furthest goal, m
MAX_SPEED = 100.0  # Speed past which an observation is clipped, m/s
MAX_RATE = 100.0  # Body rate past which an observation is clipped, rad/s


class Number(NamedTuple):
    """A number of an observation."""

    name: str
    unit: str
    low: float
    high: float


# Metrics of several tasks.
POSITION_ERROR = Metric(name="position_error", unit="m", settled=0.1, held=0.1, symbol="e")
FLIGHT_TIME = Metric(name="flight_time", unit="s", final=True)

Frame = Literal["body", "world"]
"""Of an option: the frame of an observation."""

NumberOrRange = float | tuple[float, float]
"""Of an option: a number, or (low, high) to draw one for each episode."""

Point = Annotated[tuple[float, float, float], Limits(-FURTHEST, FURTHEST, "m", count=3)]
"""Of an option: x, y, z in MuJoCo's world frame (z up), m."""

Distance = Annotated[float, Limits(0.0, FURTHEST, "m")]
"""Of an option, m."""

Size = Annotated[float, Limits(0.01, FURTHEST, "m")]
"""Of an option: a length that is not 0, m."""

Margin = Annotated[float, Limits(0.1, FURTHEST, "m")]
"""Of an option: how far a craft may leave its way, m."""

Speed = Annotated[float, Limits(0.0, MAX_SPEED, "m/s")]
"""Of an option, m/s."""

SlowSpeed = Annotated[float, Limits(0.01, MAX_SPEED, "m/s")]
"""Of an option: a limit of a speed, m/s."""

Upright = Annotated[float, Limits(0.1, 90.0, "degrees")]
"""Of an option: a limit of a tilt, degrees."""

Tilt = Annotated[float, Limits(0.0, 80.0, "degrees")]
"""Of an option: largest tilt at the start, degrees."""

Heading = Annotated[float, Limits(-360.0, 360.0, "degrees")]
"""Of an option: a direction about z, degrees, anticlockwise from x."""


@immutable
class FramedOptions(TaskOptions):
    """Options of a task with an observation in the body frame or in that of the world."""

    frame: Frame | None = None
    """Frame of the observation; by default that in which the action acts: `body` with the actions
    `rotors`, `wrench` and `rates`, `world` with the others."""


class NumbersTask(Task):
    """Base of tasks that observe one row of numbers, which they keep within its bounds."""

    def define_numbers(self, numbers: Sequence[Number], frame: str) -> None:
        """Set `observation` and its bounds."""
        names, units, lows, highs = zip(*numbers, strict=True)
        array = ArraySpec(
            name="observation",
            shape=(len(numbers),),
            low=lows,
            high=highs,
            unit=units,
            frame=frame,
            components=names,
        )
        self.observation = (array,)
        self._bounds = array.bounds()

    def crashed(self, state: State, outside: Array) -> Array:
        """Whether drones are outside of their band, touch anything, or flipped over, (W, A).

        An episode that begins tilted further, by the parameter `start_tilt`, may tilt further.
        """
        further = state.parameters.get("start_tilt", 0.0)
        least = LEAST_TILT_COSINE - sin(math.radians(1.0) * np.minimum(further, 90.0))
        return outside | state.touching | (state.tilt_cosine < least)


class GoalTask(NumbersTask):
    """Base of tasks that are flown to a goal, with an observation of 15 + R numbers and more.

    Goal minus position, m; velocity, m/s; the directions of body x, the nose, and of body z, the
    thrust: all in the world, turned by the wanted heading. Then the body rates, rad/s, and the
    thrust of each rotor over its hover thrust, minus 1; with the action `wrench` the nine numbers
    of `sim.control.SEEN` take their place. `docs/observations.md`
    lists the numbers of every task by index.

    Numbers are clipped: positions at twice the flight band, speeds at 100 m/s, rates at 100 rad/s.
    A derived class calls `define_observation` in `setup`, and gives further numbers in `further`.
    It has an option `goal`, or overrides the method.

    Where the options are `FramedOptions`, the first two vectors may be in the body frame, and the
    direction of world z in it takes the place of nose and thrust axis: 12 + R numbers that no
    heading changes. In a task that `heads` somewhere three more follow it, the wanted direction of
    the nose.
    """

    heads = False
    """Whether the observation in the body frame has the wanted direction of the nose."""

    wanted = 0.0
    """Heading that the frame of the observation is turned by, rad, anticlockwise from x."""

    @property
    def body(self) -> bool:
        """Whether the observation is in the body frame."""
        if not isinstance(self.options, FramedOptions):
            return False
        usual = "body" if self.action in BODY_ACTIONS else "world"
        return (self.options.frame or usual) == "body"

    def define_observation(self, band: float, further: Sequence[Number] = ()) -> None:
        """Set `observation`: positions up to twice the band, m, and further numbers after them."""
        numbers = along("goal - position", "m", 2 * band) + along("velocity", "m/s", MAX_SPEED)
        for name in self._directions():
            numbers += along(name, "1", 1.001)
        numbers += along("body rate", "rad/s", MAX_RATE)
        numbers += self._thrusts()
        numbers += further
        frame = "body" if self.body else "world turned by the wanted heading; body rates: body"
        self.define_numbers(numbers, frame)

    def _directions(self) -> Sequence[str]:
        """Which directions are seen."""
        if not self.body:
            return "nose", "thrust axis"
        return ("up", "wanted nose") if self.heads else ("up",)

    def _thrusts(self) -> list[Number]:
        """What is seen of the rotors."""
        if isinstance(self.controller, Wrench):
            return [Number(name, "1", -3.0, 3.0) for name in SEEN]
        vehicle = self.vehicle
        # Of any vehicle, where there are several.
        weakest = np.atleast_2d(vehicle.thrust_low / vehicle.hover_thrust - 1).min(axis=0)
        strongest = np.atleast_2d(vehicle.thrust_high / vehicle.hover_thrust - 1).max(axis=0)
        limits = zip((weakest - 0.001).tolist(), (strongest + 0.001).tolist(), strict=True)
        return [
            Number(f"thrust {rotor} over hover", "1", low, high)
            for rotor, (low, high) in enumerate(limits, 1)
        ]

    def observe(self, state: State) -> dict[str, Array]:
        """See the table of the class; further numbers are those of `further`."""
        position = state.position
        quaternion = state.quaternion
        to_place = self.place(state) - position
        vectors = [self.framed(state, vector) for vector in (to_place, state.velocity)]
        if self.body:
            vectors.append(world_z(quaternion))
            if self.heads:
                ahead = at((cos(self.wanted), sin(self.wanted), 0.0), position[..., 0])
                vectors.append(to_body(quaternion, ahead))
        else:
            vectors += [self.turned(axis) for axis in (body_x(quaternion), body_z(quaternion))]
        dtype = state.thrust.dtype
        if isinstance(self.controller, Wrench):
            thrust = stack(self.controller.seen(state)).astype(dtype)
        else:
            thrust = state.thrust / np.asarray(self.vehicle.hover_thrust, dtype) - 1.0
        parts = [*vectors, state.body_rates, thrust, *self.further(state)]
        bounds = [bound.astype(dtype) for bound in self._bounds]
        return {"observation": clip(np.concat(parts, axis=-1), *bounds)}

    def framed(self, state: State, vectors: Array) -> Array:
        """World vectors in the frame of the observation, shape (W, A, 3)."""
        if self.body:
            return to_body(state.quaternion, vectors)
        return self.turned(vectors)

    def further(self, state: State) -> Sequence[Array]:
        """Further vectors, (W, A, k), of the observation, as they were defined."""
        return ()

    def goal(self, state: State) -> Array:
        """The option `goal`, the same for every drone, moved by events."""
        goal = at(self.options.goal, state.position[..., 0])
        way = [state.parameters[name] for name in SHIFT if name in state.parameters]
        return goal + stack(way) if way else goal

    def offset(self, draw: Draw) -> Array:
        """Of a start, within the option `start_band` along each axis, m, (W, A, 3)."""
        band = self.options.start_band
        return draw.uniform(-band, band, (3,))

    def tilted(self, draw: Draw) -> Array:
        """Quaternions, (W, A, 4), within the option `start_tilt` about any level axis."""
        tilt = draw.uniform(0.0, math.radians(self.options.start_tilt))
        azimuth = draw.uniform(-math.pi, math.pi)
        sine = sin(tilt / 2)
        w = cos(tilt / 2)
        return stack((w, sine * cos(azimuth), sine * sin(azimuth), 0.0))

    def distance(self, state: State) -> Array:
        """From each drone to its goal, m, shape (W, A)."""
        return length(self.goal(state) - state.position)

    def heading_error(self, state: State) -> Array:
        """Of each nose from the wanted heading, degrees, (W, A)."""
        x, y, _ = parts_of(body_x(state.quaternion))
        return wrapped(atan2(y, x) - self.wanted) * (180 / math.pi)

    def place(self, state: State) -> Array:
        """Where each drone should be, world frame, m, shape (W, A, 3)."""
        return self.goal(state)

    def judged(
        self,
        state: State,
        terms: dict[str, Array],
        crashed: Array,
        metrics: dict[str, Array],
        finished: Array = False,
        rate_weight: float = RATE_WEIGHT,
    ) -> Outcome:
        """Terms of a reward, and what body rates and a crash cost.

        A crash ends the episode, and so does a task that is finished: then nothing is a crash.
        """
        reward = {
            **terms,
            "rates": rates_cost(state, rate_weight),
            "termination": self.crash(crashed > finished),
        }
        return Outcome(reward=reward, terminated=crashed | finished, metrics=metrics)

    def turned(self, vectors: Array) -> Array:
        """World vectors in the world frame turned by the wanted heading, shape (..., 3)."""
        if self.wanted == 0.0:
            return vectors
        return turned(vectors, cos(self.wanted), sin(self.wanted))


def turned(vectors: Array, c: Array, s: Array) -> Array:
    """World vectors, (..., 3), in the world frame turned about z by an angle of this cosine and
    sine, (...).
    """
    x, y, z = parts_of(vectors)
    return stack((c * x + s * y, c * y - s * x, z))


def at(point: Sequence[float], like: Array) -> Array:
    """A point for every drone, (W, A, 3); `like` has a number for each."""
    return stack([0.0 * like + value for value in point])


def ends_of(range_: NumberOrRange) -> tuple[float, float]:
    """Low and high end of an option that is a number or a pair."""
    return range_ if isinstance(range_, tuple) else (range_, range_)


def along(name: str, unit: str, size: float, axes: str = "xyz") -> list[Number]:
    """A vector of an observation, none of whose numbers is larger than `size`."""
    return [Number(f"{name} {axis}", unit, -size, size) for axis in axes]


def nearness(distance: Array, scale: float = ERROR_SCALE) -> Array:
    """Reward for a distance, m, (W, A): 1 at the goal, 0 at `scale`, and -1 far away."""
    return (scale - distance) / (scale + distance)


def check_height(name: str, height: float, room: float) -> None:
    """Refuse an option whose point is too low, m, for `room` and air. Raises `InputError`."""
    least = room + AIR
    if height < least:
        raise InputError(
            f"{name}: expected a height of at least {least:.4g} m above the ground, "
            f"got {height:.4g}"
        )


def check_room(task: Task, reach: float) -> None:
    """Refuse a scene that leaves less room about the z axis than starts and goals need, m.

    Raises `InputError`.
    """
    scene = task.config.scene
    needed = reach + task.vehicle.radius
    room = scene.values.room
    if scene.is_seeded and room < needed:
        raise InputError(
            f"scene: expected one that leaves {needed:.3g} m about the z axis to "
            f"{task.config.env_id}, got {scene}, which leaves {room:.3g}"
        )


def check_band(flight_band: float, what: str, least: float) -> None:
    """Refuse a band, m, that is no larger than something. Raises `InputError`."""
    if flight_band <= least:
        raise InputError(
            f"flight_band: expected more than {what} = {least:.4g} m, got {flight_band!r}"
        )


def check_cube(flight_band: float, start_band: float) -> None:
    """Refuse a band that a start within a cube leaves. Raises `InputError`."""
    check_band(flight_band, "sqrt(3) · start_band", start_band * math.sqrt(3))


def row_of(rows: Array, index: Array) -> Array:
    """A row for each drone, (W, A, k): of its own, (W, A, rows, k), or of a table, (rows, k)."""
    if rows.ndim == 2:
        return looked_up(rows, index)
    number = index.astype(int)
    return np.take_along_axis(rows, number[..., None, None], axis=-2)[..., 0, :]


def heading_cost(error: Array) -> Array:
    """Reward for an error of the heading, degrees."""
    return -HEADING_WEIGHT / 180 * abs(error)


def rates_cost(state: State, weight: float) -> Array:
    """Reward for body rates, (W, A): minus the weight times their size, rad/s."""
    return -weight * np.minimum(length(state.body_rates), FASTEST_COUNTED)
