"""`rotorgram/Recovery-v0`: thrown at any attitude and spinning, come to rest where it began."""

import math
from typing import Annotated

import numpy as np

from ...models.drawn import columns
from ...models.fields import Limits, immutable
from ...sim import Array, Draw, InitialState, cos, length, sin, square_root, stack
from ..spec import Metric
from ..state import State
from .goal import (
    WORST_RATES,
    FramedOptions,
    GoalTask,
    Heading,
    Point,
    Size,
    SlowSpeed,
    Speed,
    Upright,
    at,
    check_band,
    check_height,
    heading_cost,
    nearness,
)
from .task import Outcome

ERROR_SCALE = 1.0  # Distance at which the reward for nearness crosses zero, m
TILT_WEIGHT = 0.25  # Cost of a tilt of 90°; upside down it is twice as much
STOP_TIME = 0.5  # Longest time to stop the spin about an axis by all torque about it, s


@immutable
class RecoveryOptions(FramedOptions):
    """Options of `rotorgram/Recovery-v0`."""

    goal: Point = (0.0, 0.0, 20.0)
    """Where it is thrown, and has to come back to: x, y, z in MuJoCo's world frame (z up), m."""
    start_speed: Speed = 3.0
    """Largest speed at the start, m/s, in a direction drawn uniformly."""
    spin: Annotated[float, Limits(0.0, 100.0, "rad/s")] = 10.0
    """Largest rate about each body axis at the start, rad/s; no faster than the vehicle's largest
    torque about that axis stops in 0.5 s."""
    near: Size = 0.5
    """A craft has recovered while it is nearer to the goal than this, m, ..."""
    slow: SlowSpeed = 0.5
    """... slower than this, m/s, ..."""
    upright: Upright = 15.0
    """... and tilted by less than this, degrees."""
    flight_band: Size = 15.0
    """An episode terminates when the craft is further than this from its goal, m."""
    heading: Heading | None = None
    """Direction of the nose to come to rest in, degrees about z; none: any will do."""

    def check(self) -> None:
        """Check the options of this task. Raises `InputError`."""
        check_band(self.flight_band, "near", self.near)


class Recovery(GoalTask):
    """Thrown at any attitude, moving and spinning: turn upright and come back to rest.

    ## Observation, `float32`, shape (12 + R,) or (15 + R,)

    Which torque turns a craft upright follows from where up is in its body frame, whatever its
    heading. With `frame="body"`: goal minus position, velocity, direction of world z, body rates,
    and the thrust of each rotor over its hover thrust, minus 1, all in the body frame. With
    `frame="world"`: those of `GoalTask`.

    Numbers are clipped: positions at twice the flight band, speeds at 100 m/s, rates at 100 rad/s.

    ## Action

    By the option `action`; with `rotors` the thrust of each rotor: 0 is hover, -1 its least, 1 its
    largest.

    ## Reward

    (s - d) / (s + d) for the distance d to the goal with s = 1 m; -0.25 (1 - cosine of the tilt);
    with the option `heading`, what its error costs in `Hover-v0`; -0.02 s/rad times the size of the
    body rates, up to 20 rad/s; and -190 on the step that terminates: a fall costs more than a slow
    recovery.

    ## Metrics

    It has `recovered` (1 or 0) while it is nearer than 0.5 m to the goal (`near`), slower than
    0.5 m/s (`slow`) and tilted by less than 15° (`upright`). `recovery_time` is the time at the
    last step until now at which it had not, and `height_lost` that between the start and the lowest
    point until now.

    ## Start, termination, truncation

    At the goal, at hover thrust; the attitude uniform over all rotations (Shoemake, "Uniform random
    rotations", Graphics Gems III, 1992); the speed uniform up to 3 m/s (`start_speed`), its
    direction uniform on the sphere; the rate about each body axis uniform up to 10 rad/s (`spin`)
    or what the largest torque about that axis stops in 0.5 s: 0.5 rad/s about z for the paper's
    vehicle.

    *Terminated*: further than 15 m from the goal (`flight_band`), or contact. *Truncated*: after
    400 steps of 0.02 s.

    Attributes:
        spin: Largest rate about each body axis at the start, rad/s, shape (3,).
    """

    Options = RecoveryOptions
    worst_step = -1.0 - 2 * TILT_WEIGHT + WORST_RATES
    episode_length = 400
    metrics = (
        Metric(name="recovered", unit="", goal="high", held=0.9),
        Metric(name="recovery_time", unit="s"),
        Metric(name="height_lost", unit="m"),
        Metric(name="position_error", unit="m", settled=0.5, held=0.5),
    )

    def setup(self) -> None:
        """See the class."""
        options = self.options
        vehicle = self.vehicle
        check_height("goal", options.goal[2], vehicle.rest_height)
        turning = [min(vehicle.turning(axis), vehicle.turning(-axis)) for axis in np.eye(3)]
        self.spin = np.minimum(options.spin, STOP_TIME * np.array(turning))
        self.heads = options.heading is not None
        self.wanted = math.radians(options.heading or 0.0)
        self.define_observation(options.flight_band)
        self._least_upright = cos(math.radians(options.upright))

    def begin(self, draw: Draw) -> InitialState:
        """At the goal, thrown."""
        options = self.options
        turn = math.pi
        share = draw.uniform(0.0, 1.0)
        a = draw.uniform(-turn, turn)
        b = draw.uniform(-turn, turn)
        long = np.sqrt(share)
        short = np.sqrt(1.0 - share)
        parts = (long * cos(b), short * sin(a), short * cos(a), long * sin(b))
        speed = draw.uniform(0.0, options.start_speed)
        climb = draw.uniform(-1.0, 1.0)
        azimuth = draw.uniform(-turn, turn)
        level = square_root(1.0 - climb * climb) * speed
        velocity = stack((level * cos(azimuth), level * sin(azimuth), climb * speed))
        rates = draw.uniform(-1.0, 1.0, (3,))
        spin = self.spin
        if draw.craft is not None:
            spin = np.minimum(options.spin, STOP_TIME * columns(draw.craft)["turning"])
        self.memory.missed = 0.0  # time of the last step that was not recovered, s
        self.memory.lowest = options.goal[2]  # m
        return InitialState(
            position=at(options.goal, share),
            quaternion=stack(parts),
            velocity=velocity,
            body_rates=rates * spin,
        )

    def update_memory(self, state: State) -> None:
        """The last step that was not recovered, and the lowest point."""
        memory = self.memory
        height = state.position[..., 2]
        memory.missed = np.where(self._recovered(state), memory.missed, state.time)
        memory.lowest = np.minimum(height, memory.lowest)

    def outcome(self, state: State) -> Outcome:
        """Nearness to the goal, tilt and spin; the end at a crash or outside the band."""
        distance = self.distance(state)
        terminated = (distance > self.options.flight_band) | state.touching
        terms = {
            "position": nearness(distance, ERROR_SCALE),
            "tilt": TILT_WEIGHT * (state.tilt_cosine - 1.0),
        }
        if self.heads:
            terms["heading"] = heading_cost(self.heading_error(state))
        metrics = {
            "recovered": self._recovered(state) * 1.0,
            "recovery_time": self.memory.missed,
            "height_lost": self.options.goal[2] - self.memory.lowest,
            "position_error": distance,
        }
        return self.judged(state, terms, terminated, metrics)

    def _recovered(self, state: State) -> Array:
        """Whether it is near, slow and upright, bool, shape (W, A)."""
        options = self.options
        near = self.distance(state) < options.near
        slow = length(state.velocity) < options.slow
        return near & slow & (state.tilt_cosine > self._least_upright)
