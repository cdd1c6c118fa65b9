"""What tasks for several drones share: who hears whom by radio, and the room between drones."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from ...models.fields import Limits
from ...sim import Array, Draw, clip
from ..state import State
from .goal import (
    MAX_SPEED,
    WORST_RATES,
    Distance,
    GoalTask,
    Margin,
    Number,
    Point,
    along,
    check_height,
    length,
    nearness,
)
from .task import Outcome, TaskOptions

MAX_DRONES: Final = 128
APPROACH_WEIGHT: Final = 0.1  # Of a speed of 1 m/s towards the goal, in each step
ROOM_WEIGHT: Final = 0.5  # Cost of spheres that touch; nothing from a diameter apart on
TINY: Final = 1e-9  # m
JITTER: Final = 0.2  # Of a start, in each axis, over the distance between starts


@dataclass(frozen=True, kw_only=True)
class SwarmOptions(TaskOptions):
    """Options that the tasks for several drones share."""

    center: Point = (0.0, 0.0, 10.0)
    """Middle of starts and goals: x, y, z in MuJoCo's world frame (z up), m."""
    spacing: Annotated[float, Limits(2.0, 1e3, "diameters")] = 3.0
    """Distance between neighbouring starts, and goals, over the diameter of the vehicle."""
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

    max_drones = MAX_DRONES
    action = "velocity"
    episode_length = 500
    worst_step = -1.0 - 2 * ROOM_WEIGHT + WORST_RATES
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
        self.has_radio = self.count > 1

    def prepare_slots(self, slots: np.ndarray, further: Sequence[Number] = ()) -> None:
        """Prepare for goals at such offsets from the center, (A, 3), over the gap between them, and
        for starts in `cells`.
        """
        self._slots = slots * self.gap
        starts = np.abs(grid(self.count)).max(axis=0) * self.gap + JITTER * self.gap
        self.reach = float(np.linalg.norm(np.abs(self._slots).max(axis=0) + starts))
        self.prepare(further)

    @property
    def count(self) -> int:
        """A."""
        return self.shape[1] if self.shape else 1

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
        start = jitter + np.array(self.options.center)
        if self.count == 1:
            return start
        places = np.argsort(lots, axis=-1, kind="stable")
        return start + grid(self.count)[places] * self.gap

    def further(self, state: State) -> list[Array]:
        """The numbers of the neighbours, shape (W, A, 7 k) in all."""
        k = self.options.neighbours
        if not k:
            return []
        if state.neighbours is None:
            nothing = 0.0 * state.position[..., :1]
            return [np.concat([nothing] * (7 * k), axis=-1)]
        return [state.neighbours.reshape(*self.shape, 7 * k)]

    def ended(self, state: State) -> Array:
        """Whether a drone has touched anything, flipped over, or left for good, bool, (W, A)."""
        return self.crashed(state, length(self.goal(state) - state.position) > self.band)

    def outcome(self, state: State) -> Outcome:
        """Nearness to the goal, approach and room; the end at a crash, a flip-over, or outside the
        band.
        """
        to_goal = self.goal(state) - state.position
        distance = length(to_goal)
        towards = to_goal * (state.velocity - self.goal_velocity())
        closing = towards[..., 0] + towards[..., 1] + towards[..., 2]
        room = self.clearance(state)
        terms = {
            "position": nearness(distance, self.gap / 2),
            "approach": APPROACH_WEIGHT * closing / (distance + TINY),
            "room": self.proximity_penalty(room),
        }
        metrics = {"position_error": distance, "clearance": room}
        return self.judged(state, terms, self.ended(state), metrics)

    def goal_velocity(self) -> Array:
        """Velocity of each drone's goal, world frame, m/s, shape (W, A, 3), or 0."""
        return 0.0

    def clearance(self, state: State) -> Array:
        """Distance between a drone's sphere, of `Vehicle.radius`, and the nearest other, m, (W, A).

        Below 0 spheres overlap. A drone alone has the range of its radio.
        """
        if self.count == 1:
            return self.options.radio_range + 0.0 * length(state.velocity)
        apart = length(state.position[:, :, None] - state.position[:, None])
        apart[:, np.arange(self.count), np.arange(self.count)] = np.inf
        return (apart - (self._radii[:, None] + self._radii)).min(axis=-1)

    def proximity_penalty(self, room: Array) -> Array:
        """Reward for a clearance, (W, A): 0 from a diameter on, `-ROOM_WEIGHT` where it is 0."""
        radius = self._radii if self.shape else self.vehicle.radius
        narrow = clip(1.0 - room / (2 * radius), 0.0, 2.0)
        return -ROOM_WEIGHT * narrow

    def goal(self, state: State) -> Array:
        """The slot of each drone."""
        slots = self._slots if self.shape else self._slots[0]
        return np.array(self.options.center) + slots + 0.0 * state.position


def ring(count: int) -> np.ndarray:
    """Places on a level ring, neighbours 1 apart, shape (A, 3); of two drones they are 1 apart."""
    if count == 1:
        return np.zeros((1, 3))
    angle = 2 * np.pi * np.arange(count) / count
    places = np.stack((np.cos(angle), np.sin(angle), 0.0 * angle), axis=-1)
    return np.asarray(places * (0.5 / np.sin(np.pi / count)))


def line(count: int) -> np.ndarray:
    """Places on a line along y, 1 apart, shape (A, 3)."""
    zero = np.zeros(count)
    return np.stack((zero, np.arange(count) - (count - 1) / 2, zero), axis=-1)


def grid(count: int) -> np.ndarray:
    """Places of a level grid, nearly a square, 1 apart, shape (A, 3)."""
    side = int(np.ceil(np.sqrt(count)))
    rows, columns = np.divmod(np.arange(count), side)
    places = np.stack((rows, columns, 0 * rows), axis=-1).astype(float)
    middle: np.ndarray = places - (places.min(axis=0) + places.max(axis=0)) / 2
    return middle
