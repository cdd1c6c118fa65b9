"""The vector field histogram VFH+: a pilot that steers around what a level lidar sees.

I. Ulrich and J. Borenstein, "VFH+: Reliable Obstacle Avoidance for Fast Mobile Robots", ICRA 1998.

    rotorgram evaluate examples/vfh.py:Vfh --env rotorgram/Forest-v0
"""

import math
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np
from rotorgram.agents.policies import Array, Observation
from rotorgram.envs import EnvSpec
from rotorgram.envs.spec import component_names
from rotorgram.models import InputError

SECTORS = 72
"""Of the polar histogram: α = 5°."""
WIDE = 10
"""Sectors of a wide opening, s_max."""
WEIGHTS = (5.0, 2.0, 2.0)
"""Costs of the angles to the target, to the flown direction and to the last choice, μ1 to μ3."""
ROOM = 0.1
"""Between craft and obstacles, m: r_s of the paper."""
TURNING = 6.0
"""Largest acceleration in a turn, m/s²."""
BRAKING = 4.0
"""Deceleration that the speed allows for, m/s²."""
LOOK = (0.6, 0.5)
"""An obstacle nearer than this blocks: at rest, m, and more for each m/s, s."""
HYSTERESIS = 1.2
"""A blocked sector is free again from so many times this distance on."""
LOW, HIGH = 0.3, 3.5
"""Heights of obstacles, m: what is lower is ground, and what is higher leaves room."""
SLOWEST = 0.5
"""Speed that is asked for at least where a direction is free, m/s."""
CLIMB = 1.5
"""Wanted climb over the difference in height to the goal, 1/s."""
_ALPHA = 2 * math.pi / SECTORS
_CENTERS = _ALPHA * np.arange(SECTORS)
_NUMBERS = (
    "wanted velocity x", "wanted velocity y", "goal - height", "velocity x", "velocity y",
    "thrust axis x", "thrust axis y", "thrust axis z", "height",
)  # fmt: skip


class Choice(NamedTuple):
    """What N drones do next, world frame turned by the heading."""

    sector: Array
    """Of the histogram, shape (N,)."""
    free: Array
    """Whether there is a free direction, bool, shape (N,)."""
    distance: Array
    """To the first obstacle that way, m, shape (N,)."""


class Vfh:
    """Flies at the goal, in the next free direction of the paper's polar histogram.

    The four stages are the paper's: the primary histogram with obstacles enlarged by the size of
    the craft, the binary one with hysteresis, the masked one with the circles that a craft at its
    speed can fly, and the selection of a direction by its cost. A laser's return is certain: the
    nearest one of a sector takes the place of a sum over the cells of a grid.

    The observation has to have the numbers of `Forest-v0` and a lidar of one ring. Loops beneath
    the level `velocity` fly it: they are those of `geometric`. It keeps one state per drone of a
    batch. Raises `InputError` for an env that lacks what it needs.
    """

    options: ClassVar[Mapping[str, object]] = {
        "action": "velocity",
        "sensors": {"lidar": {"model": "rplidar_a1"}},
    }
    """Options of the env that it flies."""

    def __init__(self, spec: EnvSpec) -> None:
        names = spec.action.components
        if names[:1] != ("velocity x",):
            raise InputError(
                "vfh: expected actions of the level velocity (--action velocity), "
                f"got {', '.join(names) or 'others'}"
            )
        places = {name: i for i, name in enumerate(component_names(spec.observation[0]))}
        missing = [name for name in _NUMBERS if name not in places]
        if missing:
            raise InputError(f"vfh: expected the observation {missing[0]!r}, got none")
        shapes = {array.name: array.shape for array in spec.observation}
        rows, columns = shapes.get("lidar", (0, 0))
        if rows != 1 or columns % SECTORS:
            got = f"{rows} of {columns}" if rows else "no lidar"
            raise InputError(f"vfh: expected a lidar of one ring of {5 * SECTORS} rays, got {got}")
        self._at = [places[name] for name in _NUMBERS]
        lidar = next(array for array in spec.observation if array.name == "lidar")
        self._reach = float(lidar.bounds()[1].max())
        self._radius = spec.constant("radius", "vfh") + ROOM
        self._scale = spec.action_scale
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._blocked: Array | None = None
        self._last: Array | None = None

    def act(self, observation: Observation) -> Array:
        """Velocity and yaw rate as the env's action, float32, shape (4,)."""
        assert isinstance(observation, Mapping)
        action: Array = self.actions({name: x[None] for name, x in observation.items()})[0]
        return action

    def actions(self, observations: Mapping[str, Array]) -> Array:
        """The same of N drones at once: float32, shape (N, 4)."""
        numbers = observations["observation"].astype(float)[:, self._at].T
        wanted_x, wanted_y, climb, *flown, ax, ay, az, height = numbers
        obstacles = seen(observations["lidar"][:, 0], np.stack((ax, ay, az)), height, self._reach)
        speed = np.hypot(wanted_x, wanted_y)
        target = np.arctan2(wanted_y, wanted_x)
        choice = self._choose(obstacles, target, np.stack(flown))
        slowed = np.sqrt(2 * BRAKING * np.maximum(choice.distance - self._radius, 0.0))
        asked = np.where(choice.free, np.minimum(speed, np.maximum(slowed, SLOWEST)), 0.0)
        angle = _CENTERS[choice.sector]
        direct = abs(_turn(angle - target)) <= _ALPHA
        angle = np.where(direct, target, angle)
        asked_climb = CLIMB * climb
        actions = np.column_stack(
            (asked * np.cos(angle), asked * np.sin(angle), asked_climb, 0.0 * asked)
        )
        clipped: Array = np.clip(actions / self._scale, -1.0, 1.0).astype(np.float32)
        return clipped

    def _choose(self, obstacles: Array, target: Array, flown: Array) -> Choice:
        """A direction for each drone, for obstacles as of `seen`."""
        speed = np.hypot(*flown)
        heading = np.where(speed > SLOWEST, np.arctan2(flown[1], flown[0]), 0.0)
        nearest = histogram(obstacles, self._radius)
        look = (LOOK[0] + LOOK[1] * speed)[:, None]
        if self._blocked is not None:
            look = np.where(self._blocked, HYSTERESIS * look, look)
        self._blocked = nearest < look
        free = ~(self._blocked | masked(obstacles, self._radius, heading, speed))
        open_ways = candidates(free, target)
        last = target if self._last is None else _CENTERS[self._last]
        cost = np.zeros(free.shape)
        for weight, angle in zip(WEIGHTS, (target, heading, last), strict=True):
            cost += weight * abs(_turn(_CENTERS - angle[:, None]))
        sector = np.where(open_ways, cost, np.inf).argmin(axis=1)
        self._last = sector
        drone = np.arange(len(sector))
        return Choice(sector, open_ways[drone, sector], nearest[drone, sector])


def seen(ranges: Array, thrust_axis: Array, height: Array, reach: float) -> Array:
    """The nearest return of each sector of N drones: x forward and y left, m, shape (2, N, 72).

    The lidar tilts with the craft: returns are turned into the level frame of the heading, and
    those of the ground and of crowns are left out. Sectors without a return have infinite numbers.

    Args:
        ranges: Along rays that begin ahead and turn to the left, m, shape (N, C).
        thrust_axis: Body z in the world turned by the heading, shape (3, N).
        height: Of the craft, m, shape (N,).
        reach: Range of a ray that sees nothing, m.
    """
    count = ranges.shape[1]
    azimuth = 2 * np.pi * np.arange(count) / count
    forward, left = ranges * np.cos(azimuth), ranges * np.sin(azimuth)
    ax, ay, az = thrust_axis[..., None]
    size = np.hypot(az, ax)
    # Body x is (az, 0, -ax) over its size: it has no part to the left; body y is z × x.
    x = (forward * az - left * ax * ay) / size
    y = left * size
    z = (-forward * ax - left * ay * az) / size
    above = z + height[:, None]
    is_obstacle = (ranges < 0.99 * reach) & (above > LOW) & (above < HIGH)
    level = np.where(is_obstacle, np.hypot(x, y), np.inf)
    distance = level.reshape(len(ranges), SECTORS, -1)
    first = distance.argmin(axis=2)[..., None]
    points = np.where(is_obstacle, np.stack((x, y)), np.inf).reshape(2, *distance.shape)
    return np.take_along_axis(points, first[None], axis=3)[..., 0]


def histogram(obstacles: Array, radius: float) -> Array:
    """Distance to the nearest obstacle whose enlarged sight covers each sector, m, (N, 72).

    An obstacle at the distance d covers its own direction ± γ = asin(radius / d), the paper's
    enlargement angle. Obstacles are as of `seen`.
    """
    x, y = obstacles
    known = np.isfinite(x)
    distance = np.where(known, np.hypot(x, y), np.inf)
    direction = np.where(known, np.arctan2(y, x), 0.0)
    gamma = np.arcsin(np.minimum(radius / np.maximum(distance, 1e-6), 1.0))
    away = abs(_turn(_CENTERS - direction[..., None]))
    covers = away <= np.maximum(gamma, _ALPHA / 2)[..., None]
    nearest: Array = np.where(covers, distance[..., None], np.inf).min(axis=1)
    return nearest


def masked(obstacles: Array, radius: float, heading: Array, speed: Array) -> Array:
    """Sectors that a craft cannot reach by a circle without a touch, bool, (N, 72).

    At its speed it flies circles of the radius speed² / `TURNING` at least, to the left or to the
    right. The obstacle within one of them that is nearest to the heading ends the sectors on that
    side; those behind are on neither. Angles in rad, speed in m/s, shape (N,).
    """
    x, y = obstacles
    known = np.isfinite(x)
    circle = (speed * speed / TURNING)[:, None]
    direction = np.where(known, np.arctan2(y, x), 0.0)
    from_heading = _turn(direction - heading[:, None])
    sectors = _turn(_CENTERS - heading[:, None])
    closed = np.zeros(sectors.shape, bool)
    for side in (1.0, -1.0):
        away = side * from_heading
        turn = heading[:, None] + side * np.pi / 2
        dx, dy = x - circle * np.cos(turn), y - circle * np.sin(turn)
        touches = known & (np.hypot(dx, dy) < circle + radius) & (away > 0.0)
        limit = np.where(touches, away, np.pi).min(axis=1)[:, None]
        closed |= side * sectors > np.maximum(limit, _ALPHA / 2)
    return closed


def candidates(free: Array, target: Array) -> Array:
    """Sectors to choose from, bool, (N, 72), of the free ones.

    The middle of a narrow opening; of a wide one the sectors `WIDE` / 2 within its borders, and the
    target's where it lies between them. Target in rad, shape (N,).
    """
    left = _run(free)
    right = _run(free[:, ::-1])[:, ::-1]
    narrow = left + right - 1 < WIDE
    middle = (left == right) | (left == right + 1)
    half = WIDE // 2
    inside = (left >= half) & (right >= half)
    border = (left == half) | (right == half)
    number = np.rint(target / _ALPHA).astype(int) % SECTORS
    is_target = np.arange(SECTORS) == number[:, None]
    chosen: Array = free & np.where(narrow, middle, inside & (border | is_target))
    return chosen


def _run(free: Array) -> Array:
    """How many sectors in turn are free from each one on, at most all, (N, 72)."""
    found = np.zeros(free.shape, int)
    run = np.zeros(len(free), int)
    for sector in reversed(range(2 * SECTORS)):
        run = np.where(free[:, sector % SECTORS], run + 1, 0)
        found[:, sector % SECTORS] = np.minimum(run, SECTORS)
    return found


def _turn(angle: Array) -> Array:
    """The same angle from -π to π, rad."""
    turned: Array = (angle + np.pi) % (2 * np.pi) - np.pi
    return turned
