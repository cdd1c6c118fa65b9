"""`rotorgram/Landing-v0`: touch down softly on a pad that moves over the ground."""

import math
from typing import Annotated, Literal

import numpy as np

from ...models.errors import InputError, shortened
from ...models.fields import NumberOrPair, immutable
from ...sim import Array, Draw, InitialState, cos, length, sin, stack
from ..spec import Mark, Metric
from ..state import State
from .goal import (
    COURSE_RATE_WEIGHT,
    COURSE_WORST_RATES,
    Distance,
    GoalTask,
    NumberOrRange,
    Size,
    SlowSpeed,
    Upright,
    along,
    check_band,
    check_room,
    ends_of,
    rates_cost,
)
from .task import Outcome, TaskOptions

MATCHING_TIME = 0.5  # Progress that 1 m/s less relative speed is worth, over 1 m less way, s
LANDING_REWARD = 20.0  # Added to the reward of a step that ends with a landing
TIME_COST = 0.1  # Of each step
FASTEST_PAD = 20.0  # m/s

Motion = Literal["circle", "line"]


@immutable
class LandingOptions(TaskOptions):
    """Options of `rotorgram/Landing-v0`."""

    motion: Motion = "circle"
    """Path of the pad about (0, 0): a `circle`, or a `line` on which it swings to and fro."""
    pad_path: Size = 2.0
    """Radius of the circle, or half the length of the line, m."""
    pad_speed: Annotated[NumberOrRange, NumberOrPair(0.0, FASTEST_PAD, "m/s")] = (0.0, 1.0)
    """Speed of the pad, m/s, on a line the largest: a number, or (low, high) to draw one uniformly
    for each episode."""
    pad_radius: Size = 0.5
    """A landing's largest horizontal distance of the body's origin from the pad's centre, m."""
    sink: SlowSpeed = 1.0
    """A landing's largest vertical speed, m/s."""
    drift: SlowSpeed = 0.5
    """A landing's largest horizontal speed relative to the pad, m/s."""
    tilt: Upright = 15.0
    """A landing's largest tilt, degrees."""
    start_height: Size = 4.0
    """Mean height at the start above that of a craft on the ground, m."""
    start_band: Distance = 1.0
    """Largest distance of the start from (0, 0, mean height) along each axis, m."""
    flight_band: Size = 10.0
    """An episode terminates when the craft is further than this from the pad, m."""

    def check(self) -> None:
        """Check the options of this task. Raises `InputError`."""
        if self.start_height - self.start_band < 0.5:
            raise InputError(
                "start_band: expected at most start_height - 0.5 m, "
                f"got {shortened(self.start_band)}"
            )
        reach = self.pad_path + math.sqrt(2) * self.start_band
        furthest = length(np.array((reach, self.start_height + self.start_band)))
        check_band(self.flight_band, "the furthest start", furthest)


class Landing(GoalTask):
    """Touch down on a moving pad: inside it, slowly, and upright.

    The pad is a mark at height 0, no body of its own: what touches it touches the ground, and does
    not move along with it.

    ## Observation, `float32`, shape (17 + R,)

    Those of `GoalTask`, whose goal is the pad at the height of a craft that stands; then the
    velocity of the pad, x and y.

    Numbers are clipped: positions at twice the flight band, speeds at 100 m/s, rates at 100 rad/s.

    ## Action

    By the option `action`; with `rotors` the thrust of each rotor: 0 is hover, -1 its least, 1 its
    largest.

    ## The pad

    It moves about (0, 0) by φ(t) = φ0 + speed / path · t: on a circle of radius 2 m (`pad_path`) to
    the left or to the right, or as path · cos φ along a line in a direction that is drawn
    (`motion`). Its speed (`pad_speed`, on a line the largest) is drawn from 0 to 1 m/s, φ0 and the
    rest uniformly.

    ## Success

    Contact ends the episode. It is a landing if the body's origin is within 0.5 m of the pad's
    centre (`pad_radius`), and the craft sank with at most 1 m/s (`sink`), drifted with at most
    0.5 m/s relative to the pad (`drift`) and was tilted by at most 15° (`tilt`). Speed and tilt are
    those at the end of the control step before contact: contact itself changes them.

    ## Reward

    Progress P' - P of the potential P = -(d + 0.5 s · w) / 1 m, for the distance d to the goal and
    the speed w relative to the pad (potential-based shaping: Ng, Harada and Russell 1999);
    -0.002 s/rad times the size of the body rates, up to 20 rad/s; -0.1 for each step; 20 for a
    landing, and -14 on a step that terminates otherwise. With γ = 0.99 to stay in the air for ever
    costs 10: a touch-down that may fail is hardly worse. If time costs nothing a policy hovers
    above the pad.

    ## Start, termination, truncation

    Level and at rest, at hover thrust, within 1 m (`start_band`) of the point 4 m (`start_height`)
    above the middle of the pad's path along each axis.

    *Terminated*: contact, further than 10 m from the pad (`flight_band`), or a tilt above 90°.
    *Truncated*: after 400 steps of 0.02 s.
    """

    Options = LandingOptions
    worst_step = -TIME_COST + COURSE_WORST_RATES
    episode_length = 400
    metrics = (
        Metric(name="landed", unit="", goal="high", held=0.9, final=True),
        Metric(name="pad_distance", unit="m"),
        Metric(name="relative_speed", unit="m/s"),
    )

    def setup(self) -> None:
        """See the class."""
        options = self.options
        check_room(self, options.pad_path + options.pad_radius + options.start_band)
        fastest = ends_of(options.pad_speed)[1] + 0.001
        pad = along("velocity of the pad", "m/s", fastest, "xy")
        self.define_observation(options.flight_band, pad)
        self._least_upright = cos(math.radians(options.tilt))
        self._height = self.vehicle.rest_height
        below = (0.0, 0.0, -self._height)
        self.marks = (Mark(shape="disc", size=options.pad_radius, position=below, moves=True),)

    def begin(self, draw: Draw) -> InitialState:
        """Level and at rest above the pad's path."""
        options = self.options
        offset = self.offset(draw)
        speed = draw.uniform(*ends_of(options.pad_speed))
        direction = draw.uniform(-math.pi, math.pi)
        phase = draw.uniform(-math.pi, math.pi)
        side = draw.uniform(-1.0, 1.0)
        circle = options.motion == "circle"
        memory = self.memory
        memory.phase = phase  # rad
        memory.rate = speed / options.pad_path  # rad/s
        memory.cosine = cos(direction)  # of the line
        memory.sine = sin(direction)
        memory.side = np.where(side < 0, -1.0, 1.0) if circle else 0.0 * phase
        position = np.array((0.0, 0.0, self._height + options.start_height)) + offset
        rest = 0.0 * position
        # Velocity and cosine of the tilt after the last step before contact.
        memory.arrival = rest
        memory.upright = 1.0
        memory.potential = self._potential_of(position, rest)
        memory.progress = 0.0
        return InitialState(position=position)

    def update_memory(self, state: State) -> None:
        """Move the pad; keep speed and tilt from before contact, and what was won on the way."""
        memory = self.memory
        touching = state.touching
        memory.phase = memory.phase + memory.rate * self.control_period
        memory.arrival = np.where(touching[..., None], memory.arrival, state.velocity)
        memory.upright = np.where(touching, memory.upright, state.tilt_cosine)
        potential = self._potential_of(state.position, memory.arrival)
        memory.progress = potential - memory.potential
        memory.potential = potential

    def further(self, state: State) -> list[Array]:
        """The velocity of the pad."""
        return [self._pad_velocity()[..., :2]]

    def outcome(self, state: State) -> Outcome:
        """Progress and the end: a landing, a crash, a flip-over, or outside the band."""
        options = self.options
        touching = state.touching
        relative = self.memory.arrival - self._pad_velocity()
        away = self.goal() - state.position
        distance = length(away[..., :2])
        landed = (
            touching
            & (distance <= options.pad_radius)
            & (-relative[..., 2] <= options.sink)
            & (length(relative[..., :2]) <= options.drift)
            & (self.memory.upright >= self._least_upright)
        )
        terminated = self.crashed(state, length(away) > options.flight_band)
        return Outcome(
            reward={
                "progress": self.memory.progress,
                "time": -TIME_COST,
                "rates": rates_cost(state, COURSE_RATE_WEIGHT),
                "landing": landed * LANDING_REWARD,
                "termination": self.crash(terminated > landed),
            },
            terminated=terminated,
            metrics={
                "landed": landed * 1.0,
                "pad_distance": distance,
                "relative_speed": length(relative),
            },
        )

    def goal(self, state: State | None = None) -> Array:
        """The pad's centre, at the height of a craft that stands on it."""
        path = self.options.pad_path
        phase = self.memory.phase
        return self._turned(path * cos(phase), path * sin(phase), self._height)

    def _pad_velocity(self) -> Array:
        """World frame, m/s, (W, A, 3)."""
        path = self.options.pad_path
        memory = self.memory
        ahead = -memory.rate * (path * sin(memory.phase))
        return self._turned(ahead, memory.rate * (path * cos(memory.phase)), 0.0)

    def _turned(self, along: Array, across: Array, height: float) -> Array:
        """A vector along and across the pad's line, or on its circle, in the world frame."""
        memory = self.memory
        across = memory.side * across
        x = memory.cosine * along - memory.sine * across
        y = memory.sine * along + memory.cosine * across
        return stack((x, y, height))

    def _potential_of(self, position: Array, velocity: Array) -> Array:
        """Minus the distance to the goal, m, and what the relative speed counts."""
        speed = length(velocity - self._pad_velocity())
        return -(length(self.goal() - position) + MATCHING_TIME * speed)
