"""`rotorgram/Warehouse-v0`: to a goal behind rows of racks whose aisles may be closed."""

from types import MappingProxyType
from typing import Annotated

import numpy as np

from ...models import InputError
from ...models.fields import Limits, NumberOrPair, immutable
from ...scenes import SceneConfig
from ...scenes.aisles import AISLE, DEPTH, PASSAGE, ROW
from ...sim import Array, Draw, InitialState, parts_of, stack
from ..spec import ArraySpec
from ..state import State
from .forest import Forest, distance_of
from .goal import NumberOrRange
from .task import Outcome, TaskOptions

_TIME = 0.02  # cost of a step
_SAID = 1.0
"""How long the order is said at the start, s."""


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
