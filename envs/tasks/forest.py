"""To a goal through what stands in the way: `rotorgram/Forest-v0`, through a wood, and
`rotorgram/Warehouse-v0`, through rows of racks whose aisles may be closed.
"""

from types import MappingProxyType
from typing import Annotated, Any, ClassVar

import numpy as np

from ...models import InputError
from ...models.fields import Limits, NumberOrPair, immutable
from ...scenes import SceneConfig
from ...scenes.aisles import AISLE, DEPTH, PASSAGE, ROW
from ...sim import (
    Array,
    Draw,
    InitialState,
    body_x,
    body_z,
    clip,
    exp,
    length,
    parts_of,
    square_root,
    stack,
    total,
)
from ..spec import ArraySpec
from ..state import State
from .goal import (
    MAX_RATE,
    MAX_SPEED,
    Number,
    NumberOrRange,
    NumbersTask,
    along,
    ends_of,
    turned,
)
from .measures import METRICS, begin_measures, measures_of, update_measures
from .task import Outcome, TaskOptions

EDGE = 2.0
"""From the ends of the wood to start and goal, m."""
_WAY = (10.0, 100.0)  # m
_BEHIND = 3.0  # m: that a craft may be behind start or goal
_SPEEDING = 0.025  # s/m: cost of a step that is faster than wanted, by up to 1 m/s
_ASIDE = 0.015  # 1/m: cost of another height than the goal's, by up to 1 m
_NEAR = 0.03  # cost of a step that touches; e times less each 0.25 m further off
_CHANGE = 0.005  # cost of the square of a change of the action, up to 2
_ARRIVAL = 1.0
_FAST = 1.05  # of the wanted speed: more speed earns nothing
_KNOWN = 10.0  # m: the largest distance that a critic knows
_TIME = 0.02  # in a warehouse: cost of a step
_SAID = 1.0  # s: how long the order is said at its start
_PLACES = np.stack(np.meshgrid((0.0, 1.0, 2.0, 3.0, 4.5, 6.0), (-1.5, 0.0, 1.5), indexing="ij"))
"""From where it knows distances: forward and left, m, shape (2, 6, 3)."""


@immutable
class ForestOptions(TaskOptions):
    """Options of `rotorgram/Forest-v0`."""

    density: Annotated[float, Limits(1e-3, 0.5, "1/m²")] = 0.1
    """Trees per square metre."""
    speed: Annotated[NumberOrRange, NumberOrPair(0.5, 20.0, "m/s")] = 3.0
    """Wanted speed, m/s; of a pair, each episode draws one between."""
    way: Annotated[float, Limits(*_WAY, "m")] = 30.0
    """From start to goal, m."""
    width: Annotated[float, Limits(10.0, 100.0, "m")] = 16.0
    """Of the wood, m."""
    privileged: bool = False
    """Whether a critic sees `distances`."""


class Forest(NumbersTask):
    """Fly through a wood that was never seen to a goal behind it.

    ## Observation

    `observation`, `float32`, shape (16 + k,) for k numbers of an action, in the world frame turned
    by the heading, forward, left and up: the wanted velocity, which points to the goal in the
    plane, m/s (2); the goal's height above the craft, m; velocity, m/s (3); the direction of the
    thrust (3); body rates, body frame, rad/s (3); height, m; the way to the goal in the plane, m;
    wanted speed, m/s; time left at that speed, s; the last action (k).

    `depth`, `float32`, shape (6, 32): a depth camera of 120°, m. The option `sensors` takes others.

    With `privileged` also `distances`, `float32`, shape (6, 3), for the critic alone: to the
    nearest solid, up to 10 m, from points at the craft's height, 0 m to 6 m forward, and 1.5 m
    right, straight on, and 1.5 m left.

    ## Action

    By the option `action`; with `velocity` velocity and yaw rate.

    ## Reward

    What the way to the goal became shorter by in this step, over the wanted speed, s, but no more
    than 1.05 steps; -0.025 s/m times what the speed is above 1.05 of the wanted one, up to 1 m/s;
    -0.015 1/m times the difference in height to the goal, up to 1 m; -0.03 exp(-clearance /
    0.25 m); -0.005 times the square of the change of the action, up to 2; 1 at the goal; and -8 on
    a step that terminates elsewhere. All are ours.

    ## Start, termination, truncation

    At rest, level, looking at the goal, 1.3 m to 2.2 m high.

    *Terminated*: within 1 m of the goal in the plane and in height; by contact; a tilt above 90°;
    beside the wood, 3 m behind start or goal, or higher than 4 m. *Truncated*: after 400 steps of
    0.05 s.
    """

    Options: ClassVar[type[TaskOptions]] = ForestOptions
    heights = (1.3, 2.2)
    """Lowest and highest start and goal, m."""
    ceiling = 4.0
    """A craft does not fly over what stands there, m."""
    reached = 1.0
    """Largest distance of an arrival from the goal, in the plane and in height, m."""
    worst_step = -(_SPEEDING + _ASIDE + _NEAR + 2 * _CHANGE)
    action = "velocity"
    control_period = 0.05
    episode_length = 400
    defaults = MappingProxyType(
        {
            "vehicle": ("hummingbird",),
            "backend": "rigid",
            "sensors": {"depth": {"rows": 6, "columns": 32, "fov": 120.0}},
        }
    )
    metrics = METRICS

    @classmethod
    def scene(cls, options: Any) -> SceneConfig:
        """A new wood in each episode."""
        size = options.way + 2 * EDGE, options.width
        more = {"density": options.density, "size": size, "clear": "ends"}
        return SceneConfig(name="forest", layouts="new", options=more)

    def setup(self) -> None:
        """See the class."""
        options = self.options
        self.define_way(options.way, options.width)
        if options.privileged:
            distances = ArraySpec(
                name="distances",
                shape=_PLACES.shape[1:],
                low=0.0,
                high=_KNOWN,
                unit="m",
                axes=("forward", "left"),
                privileged=True,
            )
            self.observation = (*self.observation, distances)

    def define_way(self, way: float, width: float) -> None:
        """Set `observation`, for a way to the goal and the width about it, m."""
        self._half = way / 2
        self._aside = width / 2
        furthest = way + width
        numbers = along("wanted velocity", "m/s", MAX_SPEED, "xy")
        numbers.append(Number("goal - height", "m", -10.0, 10.0))
        numbers += along("velocity", "m/s", MAX_SPEED) + along("thrust axis", "1", 1.001)
        numbers += along("body rate", "rad/s", MAX_RATE)
        numbers += [
            Number("height", "m", -10.0, 100.0),
            Number("way", "m", 0.0, furthest),
            Number("wanted speed", "m/s", 0.0, MAX_SPEED),
            Number("time left", "s", -100.0, 100.0),
        ]
        for name in self.controller.components:
            numbers.append(Number(f"last {name}", "1", -1.0, 1.0))
        self.define_numbers(numbers, "world turned by the heading; body rates: body")

    def begin(self, draw: Draw) -> InitialState:
        """At rest before what is to be crossed, looking at the goal."""
        height = draw.uniform(*self.heights, (2,))
        memory = self.memory
        memory.height = height[..., 1]
        memory.speed = draw.uniform(*ends_of(self.options.speed))
        memory.way = 2 * self._half
        memory.progress = memory.change = 0.0
        begin_measures(self)
        memory.last = np.zeros_like(height, shape=(*self.shape, len(self.controller.components)))
        return InitialState(position=stack((-self._half, 0.0, height[..., 0])))

    def goal(self, state: State) -> Array:
        """Behind what is to be crossed."""
        return stack((self._half, 0.0, self.memory.height))

    def update_memory(self, state: State) -> None:
        """How much shorter the way became, and how much the action changed."""
        memory = self.memory
        way = self.way(state.position)
        memory.progress = memory.way - way
        memory.way = way
        change = state.action - memory.last
        memory.change = total(change * change)
        memory.last = 1.0 * state.action
        update_measures(self, state)

    def observe(self, state: State) -> dict[str, Array]:
        """See the class."""
        memory = self.memory
        x, y, _ = parts_of(body_x(state.quaternion))
        size = distance_of(x, y) + 1e-9
        c, s = x / size, y / size
        to_goal = self.goal(state) - state.position
        way = Forest.way(self, state.position)  # straight on, also where racks are in it
        wanted = memory.speed / (way + 1e-6)
        ahead = turned(wanted[..., None] * to_goal, c, s)
        velocity = turned(state.velocity, c, s)
        axis = turned(body_z(state.quaternion), c, s)
        left = way / memory.speed
        parts = (
            *parts_of(ahead)[:2], to_goal[..., 2], *parts_of(velocity), *parts_of(axis),
            *parts_of(state.body_rates), state.position[..., 2], way, memory.speed,
            left, *parts_of(memory.last),
        )  # fmt: skip
        observed = {"observation": clip(stack(parts), *self._bounds)}
        if any(array.privileged for array in self.observation):
            numbers = (*parts_of(state.position), c, s)
            x, y, z, cosine, sine = [number[..., None, None] for number in numbers]
            forward, left = _PLACES
            along = x + cosine * forward - sine * left
            across = y + sine * forward + cosine * left
            points = stack((along, across, z + 0.0 * left))
            distances = state.distance(points.reshape(len(points), -1, 3))
            observed["distances"] = clip(distances, 0.0, _KNOWN)
        return observed

    def outcome(self, state: State) -> Outcome:
        """Progress, and the end at the goal, by contact or beside the wood."""
        memory = self.memory
        position = state.position
        off = abs(position[..., 2] - memory.height)
        arrived = (memory.way < self.reached) & (off < self.reached)
        beside = (
            (abs(position[..., 1]) > self._aside)
            | (abs(position[..., 0]) > self._half + _BEHIND)
            | (position[..., 2] > self.ceiling)
        )
        crashed = self.crashed(state, beside)
        success = arrived > crashed
        speed = length(state.velocity)
        most = _FAST * self.control_period
        terms = {
            "progress": np.minimum(memory.progress / memory.speed, most),
            "speeding": -_SPEEDING * clip(speed - _FAST * memory.speed, 0.0, 1.0),
            "height": -_ASIDE * np.minimum(off, 1.0),
            "nearness": -_NEAR * exp(-np.maximum(state.clearance, 0.0) / 0.25),
            "change": -_CHANGE * np.minimum(memory.change, 2.0),
            "arrival": _ARRIVAL * success,
            "termination": self.crash(crashed),
        }
        metrics = measures_of(self, state, success)
        return Outcome(reward=terms, terminated=crashed | success, metrics=metrics)

    def way(self, position: Array) -> Array:
        """Length of the way to the goal, of which the reward counts the progress, m, (W, A): in
        the plane.
        """
        x, y, _ = parts_of(position)
        return distance_of(self._half - x, y)


@immutable
class WarehouseOptions(TaskOptions):
    """Options of `rotorgram/Warehouse-v0`."""

    speed: Annotated[NumberOrRange, NumberOrPair(0.3, 5.0, "m/s")] = 1.2
    """Wanted speed, m/s; of a pair, each episode draws one between."""
    rows: Annotated[int, Limits(1, 8, whole=True)] = 2
    """Of racks, one after the other."""
    aisles: Annotated[int, Limits(2, 8, whole=True)] = 2
    """Through each row; all but one are closed at their far end."""


class Warehouse(Forest):
    """Fly to a goal behind rows of racks, through the aisles that were named at the start.

    One aisle of each row leads through it. The others end after 2.4 m, which the craft sees no
    sooner than from within, for its sensor reaches 2 m. The order, which says the open ones, lasts
    1 s; the goal stands behind all rows. There is no time for a search: who forgot which aisle of
    the second row is open has to guess.

    ## Observation

    That of `Forest-v0`, without `depth`. `order`, `float32`, shape (rows,): y of the middles of
    the open aisles, row by row, in half the width of the hall; 0 after the first second.

    `tof`, `float32`, shape (8, 8): a VL53L5CX, which looks 45° ahead, up to 2 m. The option
    `sensors` takes others.

    ## Action

    By the option `action`; with `velocity` velocity and yaw rate.

    ## Reward

    That of `Forest-v0`, for the way through the open aisles, which in a closed aisle leads back
    first; and -0.02 on each step. A crash costs 10.

    ## Start, termination, truncation

    At rest, level, looking at the goal, 0.9 m to 1.3 m high.

    *Terminated*: within 0.5 m of the goal in the plane and in height; by contact; a tilt above 90°;
    or higher than 2 m. *Truncated*: after 150 steps of 0.1 s.
    """

    Options = WarehouseOptions
    heights = (0.9, 1.3)
    ceiling = 2.0
    reached = 0.5
    worst_step = Forest.worst_step - _TIME
    control_period = 0.1
    episode_length = 150
    defaults = MappingProxyType(
        {
            "vehicle": ("crazyflie2",),
            "backend": "rigid",
            "sensors": {"tof": {"model": "vl53l5cx", "reach": 2.0}},
        }
    )

    @classmethod
    def scene(cls, options: WarehouseOptions) -> SceneConfig:
        """New aisles in each episode."""
        size = ROW - DEPTH + ROW * options.rows, AISLE * options.aisles
        return SceneConfig(name="aisles", layouts="new", options={"size": size})

    def setup(self) -> None:
        """See the class."""
        scene = self.config.scene
        if scene.name != "aisles":
            raise InputError(f"scene: expected aisles with {self.config.env_id}, got {scene}")
        rows, aisles = scene.values.counts
        self.define_way(ROW * rows, AISLE * aisles)
        order = ArraySpec(
            name="order",
            shape=(rows,),
            low=-1.0,
            high=1.0,
            unit="1",
            components=tuple(f"open aisle of row {row}" for row in range(rows)),
        )
        self.observation = (*self.observation, order)

    def begin(self, draw: Draw) -> InitialState:
        """Before the first row, looking at the goal."""
        start = super().begin(draw)
        memory = self.memory
        # x and y of the middles of the open aisles, m.
        memory.doors = draw.openings[..., :2] + 0.0 * start.position[..., None, :1]
        memory.way = self.way(start.position)
        return start

    def observe(self, state: State) -> dict[str, Array]:
        """See the class."""
        is_said = state.time < _SAID
        doors = parts_of(self.memory.doors[..., 1])
        order = stack([np.where(is_said, door / self._aside, 0.0) for door in doors])
        return {**super().observe(state), "order": order}

    def outcome(self, state: State) -> Outcome:
        """That of `Forest-v0`, with the cost of time."""
        outcome = super().outcome(state)
        outcome.reward["time"] = -_TIME
        return outcome

    def way(self, position: Array) -> Array:
        """Through the open aisles that are ahead, m, (W, A).

        From before a row it leads to its open aisle, along that, and on. From a closed aisle it
        leads back to its mouth first.
        """
        x, y, _ = parts_of(position)
        way = super().way(position)
        last_x, last_y, left = self._half + 0.0 * x, 0.0 * y, 0.0 * x
        for row in reversed(range(self.config.scene.values.counts[0])):
            middle, door = parts_of(self.memory.doors[..., row, :])
            mouth, end = middle - DEPTH / 2, middle + DEPTH / 2
            left = left + distance_of(last_x - end, last_y - door)
            inside = end - x + left
            back = x - mouth + abs(y - door) + DEPTH + left
            within = np.where(abs(y - door) < PASSAGE / 2, inside, back)
            before = distance_of(mouth - x, y - door) + DEPTH + left
            way = np.where(x < mouth, before, np.where(x < end, within, way))
            last_x, last_y, left = mouth, door, left + DEPTH
        return way


def distance_of(x: Array, y: Array) -> Array:
    """Length of a vector in the plane."""
    return square_root(x * x + y * y)
