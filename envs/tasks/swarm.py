"""Tasks of several drones, each with a goal of its own: Formation, Crossing and Escort."""

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np

from ...models.fields import Limits, immutable
from ...sim import Array, Draw, InitialState, clip, cos, length, looked_up, sin, stack, total
from ..spec import Metric
from ..state import State
from .goal import (
    HEADING_WEIGHT,
    MAX_SPEED,
    POSITION_ERROR,
    WORST_RATES,
    Distance,
    GoalTask,
    Margin,
    Number,
    Point,
    Size,
    Speed,
    along,
    check_height,
    heading_cost,
    nearness,
)
from .task import Outcome, TaskOptions

MAX_DRONES = 128
APPROACH_WEIGHT = 0.1  # Of a speed of 1 m/s towards the goal, in each step
TINY = 1e-9  # m
JITTER = 0.2  # Of a start, in each axis, over the distance between starts


@immutable
class SwarmOptions(TaskOptions):
    """Options that the tasks for several drones share."""

    center: Point = (0.0, 0.0, 10.0)
    """Middle of starts and goals: x, y, z in MuJoCo's world frame (z up), m."""
    spacing: Annotated[float, Limits(2.0, 1e3, "diameters")] = 3.0
    """Distance between neighbouring starts, and goals, over the diameter of the vehicle. Below 3,
    drones at their goals may be so near each other that it costs reward."""
    margin: Margin = 10.0
    """An episode terminates for a drone that is so much further from its goal than any start, m."""
    neighbours: Annotated[int, Limits(0, 16, "drones", whole=True)] = 7
    """Drones in the observation of each: the nearest that it hears."""
    radio_range: Distance = 100.0
    """Furthest distance at which a drone is heard, m."""
    radio_delay: Annotated[int, Limits(0, 100, "control steps", whole=True)] = 0
    """Control steps from what a drone says to where it is heard."""
    radio_loss: Annotated[float, Limits(0.0, 1.0)] = 0.0
    """Share of messages that are lost, each for itself: of one drone to another in one step."""


class Swarm(GoalTask):
    """Base of tasks that several drones fly, each to a goal of its own, without touching.

    The observation is that of `GoalTask`, further numbers of the task, and of each neighbour, the
    nearest first, seven numbers:

    | quantity | unit | frame |
    |---|---|---|
    | its position minus the own, as far as it was heard | m | world |
    | its velocity minus the own | m/s | world |
    | 1; 0, as all numbers before, where there is none | 1 | |

    A derived class calls `prepare_slots` in `setup`; or it sets `reach` before `prepare`, and has
    `goal`.
    """

    metrics = (POSITION_ERROR, Metric(name="clearance", unit="m", goal="high"))
    min_drones = 2
    max_drones = MAX_DRONES
    has_radio = True
    action = "velocity"
    episode_length = 500
    worst_step = -2.5 - HEADING_WEIGHT + WORST_RATES  # -1 as far away as can be, -1.5 of room
    space = 4.0
    """Clearance below which another drone costs, in radii."""
    reach = 0.0
    """Furthest distance of a start from its goal, m."""

    def prepare(self, further: Sequence[Number] = ()) -> None:
        """Set `observation`: that of `GoalTask`, further numbers, and the neighbours."""
        from ...models.fleet import members_of  # which imports MuJoCo

        options = self.options
        vehicle = self.vehicle
        check_height("center", options.center[2], vehicle.rest_height + JITTER * self.gap)
        self.band = self.reach + options.margin
        numbers = [*further]
        for number in range(1, options.neighbours + 1):
            name = f"neighbour {number}"
            numbers += along(f"{name} - position", "m", options.radio_range)
            numbers += along(f"{name} velocity - velocity", "m/s", MAX_SPEED)
            numbers.append(Number(f"{name} is there", "1", -1.0, 1.0))
        self.define_observation(self.band, numbers)
        self._radii = np.array([one.radius for one in members_of(vehicle, self.count)])

    def prepare_slots(self, slots: np.ndarray, further: Sequence[Number] = ()) -> None:
        """Prepare for goals at such offsets from the center, (A, 3), over the gap between them, and
        for starts in `cells`.
        """
        self._slots = slots * self.gap
        starts = np.abs(grid(self.count)).max(axis=0) * self.gap + JITTER * self.gap
        self.reach = length(np.abs(self._slots).max(axis=0) + starts)
        self.prepare(further)

    @property
    def count(self) -> int:
        """A."""
        return self.shape[1]

    @property
    def center(self) -> Array:
        """Middle of starts and goals: world frame, m, shape (3,)."""
        return np.array(self.options.center)

    @property
    def gap(self) -> float:
        """Distance between neighbouring starts, and goals, m."""
        spacing: float = self.options.spacing
        return 2 * spacing * self.vehicle.radius

    def cells(self, draw: Draw) -> Array:
        """Starts: cells of a level grid about the center, one for each drone by lot, shape (W, A,
        3), world frame, m.
        """
        jitter = draw.uniform(-JITTER, JITTER, (3,)) * self.gap
        lots = draw.uniform(0.0, 1.0)
        places = np.argsort(lots, axis=-1, kind="stable").astype(float)
        cells = looked_up(grid(self.count), places) * self.gap
        return jitter + self.center + cells

    def further(self, state: State) -> list[Array]:
        """The numbers of the neighbours, shape (W, A, 7 k) in all."""
        assert state.neighbours is not None
        return [state.neighbours.reshape(*self.shape, 7 * self.options.neighbours)]

    def ended(self, state: State) -> Array:
        """Whether a drone has touched anything, flipped over, or left for good, bool, (W, A)."""
        return self.crashed(state, self.distance(state) > self.band)

    def outcome(self, state: State) -> Outcome:
        """Nearness to the goal, approach, room and heading; the end at a crash, a flip-over, or
        outside the band.
        """
        to_goal = self.goal(state) - state.position
        distance = length(to_goal)
        room = self.clearance(state)
        terms = {
            "position": nearness(distance, self.gap / 2),
            "approach": approach(to_goal, state.velocity - self.goal_velocity()),
            "room": self.proximity_penalty(room),
            "heading": heading_cost(self.heading_error(state)),
        }
        metrics = {"position_error": distance, "clearance": room}
        return self.judged(state, terms, self.ended(state), metrics)

    def goal_velocity(self) -> Array:
        """Velocity of each drone's goal, world frame, m/s, shape (W, A, 3), or 0."""
        return 0.0

    def clearance(self, state: State) -> Array:
        """Distance between a drone's sphere, of `Vehicle.radius`, and the nearest other, m, (W, A).

        Below 0 spheres overlap.
        """
        apart = length(state.position[:, :, None] - state.position[:, None])
        apart = np.where(np.eye(self.count, dtype=bool), np.inf, apart)
        return (apart - (self._radii[:, None] + self._radii)).min(axis=-1)

    def proximity_penalty(self, room: Array) -> Array:
        """Reward for a clearance, (W, A): `-space / 4` where spheres touch, 0 from `space` on."""
        return -self.space / 4 * clip(1.0 - room / (self.space * self._radii), 0.0, 1.5)

    def goal(self, state: State) -> Array:
        """The slot of each drone."""
        return self.center + self._slots + 0.0 * state.position


def approach(way: Array, velocity: Array) -> Array:
    """Reward for a speed along a way to a goal, (W, A)."""
    return APPROACH_WEIGHT * total(way * velocity) / (length(way) + TINY)


def shared(drawn: Array) -> Array:
    """Numbers that the drones of a world share, (W, A): those of the first."""
    return drawn[:, :1] + 0.0 * drawn


def ring(count: int) -> Array:
    """Places on a level ring, neighbours 1 apart, shape (A, 3); of two drones they are 1 apart."""
    return on_circle(angles(count), 1.0) * (0.5 / sin(np.pi / count))


def angles(count: int) -> np.ndarray:
    """Directions of places on a ring, rad, shape (A,)."""
    return 2 * np.pi * np.arange(count) / count


def on_circle(angle: Array, radius: float, height: float = 0.0) -> Array:
    """Places on a level circle, shape (..., 3), from a point below its middle."""
    return stack((radius * cos(angle), radius * sin(angle), height))


def line(count: int) -> Array:
    """Places on a line along y, 1 apart, shape (A, 3)."""
    return stack((0.0, np.arange(count) - (count - 1) / 2, 0.0))


def grid(count: int) -> Array:
    """Places of a level grid, nearly a square, 1 apart, shape (A, 3)."""
    side = int(np.ceil(np.sqrt(count)))
    rows, columns = np.divmod(np.arange(count), side)
    places = stack((rows, columns, 0)).astype(float)
    return places - (places.min(axis=0) + places.max(axis=0)) / 2


Formed = Literal["ring", "line", "grid"]
_PLACES = {"ring": ring, "line": line, "grid": grid}


@immutable
class FormationOptions(SwarmOptions):
    """Options of `rotorgram/Formation-v0`."""

    formation: Formed = "ring"
    """`ring`; `line`, along y; or `grid`, nearly a square. All are level."""


class Formation(Swarm):
    """Each drone flies from a start by lot to its own place in a formation, and holds it.

    ## Observation, `float32`, shape (15 + R + 7 k,), k = 7 (`neighbours`)

    Those of `GoalTask`, whose goal is the own place; then of each neighbour, the nearest first,
    position and velocity minus the own, and 1, or seven zeros where no further drone is heard.

    ## Action, `Box(-1, 1, (4,), float32)`

    Velocity in the frame turned by the heading, and yaw rate, as shares of their ranges (the level
    `velocity`).

    ## Reward

    (s - d) / (s + d) for the distance d to the own place, where s is half the distance between
    neighbouring starts; 0.1 s/m times the speed towards it; -0.2 |heading error| / 180°; -0.02
    s/rad times the size of the body rates, up to 20 rad/s; with less than two diameters between the
    drone's sphere and another, -1 where they touch, -1.5 at worst; and -310 on the step that
    terminates.

    ## Start, termination, truncation

    At rest, level, at hover thrust, in the cells of a grid by lot, moved by up to 0.2 of the
    distance between cells along each axis.

    *Terminated*, for this drone alone: contact, a tilt above 90°, or 10 m (`margin`) further from
    its place than any start. Its rotors stand still, and the others fly on. *Truncated*: after 500
    steps of 0.02 s.
    """

    Options = FormationOptions

    def setup(self) -> None:
        """See the class."""
        self.prepare_slots(_PLACES[self.options.formation](self.count))

    def begin(self, draw: Draw) -> InitialState:
        """At rest, level, in the cells of a grid by lot."""
        return InitialState(position=self.cells(draw))


class Crossing(Swarm):
    """Each drone flies from its place on a ring to the opposite one: all meet in the middle.

    ## Observation, `float32`, shape (15 + R + 7 k,), k = 7 (`neighbours`)

    Those of `GoalTask`, whose goal is the opposite place; then of each neighbour, the nearest
    first, position and velocity minus the own, and 1, or seven zeros where no further drone is
    heard.

    ## Action, `Box(-1, 1, (4,), float32)`

    Velocity in the frame turned by the heading, and yaw rate, as shares of their ranges (the level
    `velocity`).

    ## Reward

    (s - d) / (s + d) for the distance d to the goal, where s is half the distance between
    neighbouring starts; 0.1 s/m times the speed towards it; -0.2 |heading error| / 180°; -0.02
    s/rad times the size of the body rates, up to 20 rad/s; with less than a diameter between the
    drone's sphere and another, -0.5 where they touch, -0.75 at worst: half as much and as far as in
    the other tasks, since all have to meet; and -310 on the step that terminates.

    ## Start, termination, truncation

    At rest, level, at hover thrust, on a level ring that is turned by lot, neighbours three
    diameters (`spacing`) apart, moved by up to 0.2 of that along each axis. The ring is no smaller
    than one of six drones.

    *Terminated*, for this drone alone: contact, a tilt above 90°, or 10 m (`margin`) further from
    its goal than any start. Its rotors stand still, and the others fly on. *Truncated*: after
    1000 steps of 0.02 s.
    """

    Options = SwarmOptions
    episode_length = 1000
    space = 2.0

    def setup(self) -> None:
        """See the class."""
        radius = max(length(ring(self.count)[0]), 1.0)  # of six
        self._angles = angles(self.count)
        self._radius = radius * self.gap
        self.reach = 2 * self._radius + 2 * JITTER * self.gap
        self.prepare()

    def begin(self, draw: Draw) -> InitialState:
        """At rest, level, on the ring."""
        self.memory.turn = turn = shared(draw.uniform(-math.pi, math.pi))
        jitter = draw.uniform(-JITTER, JITTER, (3,)) * self.gap
        position = self._opposite(turn + math.pi) + jitter
        return InitialState(position=position)

    def _opposite(self, turn: Array) -> Array:
        """Where drones fly to from a ring turned by an angle, rad: world frame, m, (W, A, 3)."""
        angle = turn + self._angles + math.pi
        return self.center + on_circle(angle, self._radius)

    def goal(self, state: State) -> Array:
        """The place opposite to the start of each drone."""
        return self._opposite(self.memory.turn)


@immutable
class EscortOptions(SwarmOptions):
    """Options of `rotorgram/Escort-v0`."""

    target_speed: Speed = 1.0
    """Largest speed of the target, m/s."""
    target_path: Size = 5.0
    """Furthest distance of the target from the center along x and y, m."""


class Escort(Swarm):
    """Each drone keeps its place on a ring about a target that moves on a smooth path.

    With amplitude a (`target_path`) and largest speed v (`target_speed`) the target is at
    a (sin(ω t + α), sin(c ω t + β)) from the center, level, with ω = v / (a sqrt(1 + c²)). The
    ratio c, from 0.5 to 2, and the phases are drawn for each episode.

    ## Observation, `float32`, shape (18 + R + 7 k,), k = 7 (`neighbours`)

    Those of `GoalTask`, whose goal is the own place; the velocity of the target; then of each
    neighbour, the nearest first, position and velocity minus the own, and 1, or seven zeros where
    no further drone is heard.

    ## Action, `Box(-1, 1, (4,), float32)`

    Velocity in the frame turned by the heading, and yaw rate, as shares of their ranges (the level
    `velocity`).

    ## Reward

    (s - d) / (s + d) for the distance d to the own place, where s is half the distance between
    neighbouring starts; 0.1 s/m times the speed towards it, relative to it; -0.2 |heading error| /
    180°; -0.02 s/rad times the size of the body rates, up to 20 rad/s; with less than two diameters
    between the drone's sphere and another, -1 where they touch, -1.5 at worst; and -310 on the step
    that terminates.

    ## Start, termination, truncation

    At rest, level, at hover thrust, in the cells of a grid about the target by lot, moved by up to
    0.2 of the distance between cells along each axis.

    *Terminated*, for this drone alone: contact, a tilt above 90°, or 10 m (`margin`) further from
    its place than any start. Its rotors stand still, and the others fly on. *Truncated*: after 500
    steps of 0.02 s.
    """

    Options = EscortOptions
    metrics = (
        Metric(name="position_error", unit="m", settled=0.3, held=0.3, symbol="e"),
        *Swarm.metrics[1:],
    )

    def setup(self) -> None:
        """See the class."""
        velocity = along("target velocity", "m/s", MAX_SPEED)
        self.prepare_slots(ring(self.count), velocity)

    def begin(self, draw: Draw) -> InitialState:
        """At rest, level, in the cells of a grid about the target, by lot."""
        memory = self.memory
        memory.ratio = shared(draw.uniform(0.5, 2.0))
        memory.alpha = shared(draw.uniform(-math.pi, math.pi))
        memory.beta = shared(draw.uniform(-math.pi, math.pi))
        memory.time = 0.0
        position = self.cells(draw) + self.target()[0]
        return InitialState(position=position)

    def target(self) -> tuple[Array, Array]:
        """Position from the center and velocity of the target: world frame, m, m/s, (W, A, 3)."""
        memory = self.memory
        a = self.options.target_path
        slow = self.options.target_speed / (a * np.sqrt(1.0 + memory.ratio * memory.ratio))
        fast = memory.ratio * slow
        first = slow * memory.time + memory.alpha
        second = fast * memory.time + memory.beta
        zero = 0.0 * first
        place = stack((a * sin(first), a * sin(second), zero))
        velocity = stack((a * slow * cos(first), a * fast * cos(second), zero))
        return place, velocity

    def update_memory(self, state: State) -> None:
        """Move the target."""
        self.memory.time = self.memory.time + self.control_period

    def further(self, state: State) -> list[Array]:
        """The velocity of the target, and the neighbours."""
        return [self.goal_velocity(), *super().further(state)]

    def goal_velocity(self) -> Array:
        """That of the target."""
        return self.target()[1]

    def goal(self, state: State) -> Array:
        """The place of each drone about the target."""
        return super().goal(state) + self.target()[0]
