"""What tasks of flight to a goal share: their observation, and the memory of an episode."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Final

import numpy as np

from ...models.errors import InputError
from ...models.fields import Limits
from ...sim import (
    Array,
    body_x,
    body_z,
    clip,
    component,
    stack,
    to_body,
    world_z,
)
from ..config import EnvConfig
from ..spec import ArraySpec
from ..state import State
from .task import Task

ERROR_SCALE: Final = 0.5  # Distance at which the reward for nearness crosses zero, m
RATE_WEIGHT: Final = 0.02  # Cost of a body rate of 1 rad/s
SWING_WEIGHT: Final = 0.1  # Cost of a payload that moves at 1 m/s relative to the craft
PASSING_REWARD: Final = 1.0  # Of a course: added in a step in which a point or gate is passed
COURSE_RATE_WEIGHT: Final = 0.002  # Of a course: cost of a body rate of 1 rad/s
FASTEST_COUNTED: Final = 20.0  # A faster body rate costs no more, rad/s
WORST_RATES: Final = -RATE_WEIGHT * FASTEST_COUNTED
WORST_SWING: Final = -0.4
COURSE_WORST_RATES: Final = -COURSE_RATE_WEIGHT * FASTEST_COUNTED
COURSE_WORST_STEP: Final = -0.05
LEAST_TILT_COSINE: Final = 0.0
"""Cosine of the tilt (90°) past which the craft counts as flipped over."""
AIR: Final = 0.6  # Least room under a craft that starts, m
FURTHEST: Final = 1e4  # Furthest goal, m
MAX_SPEED: Final = 100.0  # Speed past which an observation is clipped, m/s
MAX_RATE: Final = 100.0  # Body rate past which an observation is clipped, rad/s

Number = tuple[str, str, float]
"""Name, unit and largest size of a number of an observation."""


Point = Annotated[tuple[float, float, float], Limits(-FURTHEST, FURTHEST, "m", count=3)]
"""Of an option: x, y, z in MuJoCo's world frame (z up), m."""


Sides = Annotated[tuple[float, float, float], Limits(0.0, FURTHEST, "m", count=3)]
"""Of an option: lengths along x, y and z, m."""


def with_payload(config: EnvConfig, mass: float, cable: float) -> EnvConfig:
    """The config with a payload that the task's options describe. Raises `InputError`."""
    given = [name for name in ("payload", "cable") if name in config.effects.to_options()]
    if given:
        raise InputError(
            "effects: expected a payload that the options of the task describe, "
            f"got {' and '.join(given)}"
        )
    return replace(config, effects=replace(config.effects, payload=mass, cable=cable))


class GoalTask(Task):
    """Base of tasks that are flown to a goal, with an observation of 15 + R numbers and more.

    | index | quantity | unit | frame |
    |---|---|---|---|
    | 0-2 | goal minus position | m | world, turned by the wanted heading |
    | 3-5 | velocity | m/s | the same |
    | 6-8 | direction of body x, the nose | 1 | the same |
    | 9-11 | direction of body z, the thrust | 1 | the same |
    | 12-14 | body rates | rad/s | body |
    | 15... | thrust of each rotor over its hover thrust, minus 1 | 1 | |

    Numbers are clipped: positions at twice the flight band, speeds at 100 m/s, rates at 100 rad/s.
    A derived class calls `define_observation` in `setup` and `build_observation` in `observe`, and
    has `goal`.

    With `body` the first two vectors are in the body frame, and the direction of world z in the
    body frame takes the place of nose and thrust axis: 12 + R numbers that no heading changes.
    """

    wanted = 0.0
    """Heading that the frame of the observation is turned by, rad, anticlockwise from x."""
    body = False
    """Whether the observation is in the body frame."""

    def define_observation(self, band: float, more: Sequence[Number] = ()) -> None:
        """Set `observation`: positions up to twice the band, m, and further numbers after them."""
        vehicle = self.vehicle
        vectors = (
            ("goal - position", "m", 2 * band),
            ("velocity", "m/s", MAX_SPEED),
            *((name, "1", 1.001) for name in (("up",) if self.body else ("nose", "thrust axis"))),
            ("body rate", "rad/s", MAX_RATE),
        )
        first: list[Number] = [
            (f"{v} {axis}", unit, most) for v, unit, most in vectors for axis in "xyz"
        ]
        rotors = range(1, vehicle.num_rotors + 1)
        weakest, strongest = (  # of any vehicle, where there are several
            pick(np.atleast_2d(limit / vehicle.hover_thrust - 1), axis=0)
            for pick, limit in ((np.min, vehicle.thrust_low), (np.max, vehicle.thrust_high))
        )
        outer, inner = ([most for *_, most in numbers] for numbers in (first, more))
        low = (*(-x for x in outer), *(weakest - 0.001).tolist(), *(-x for x in inner))
        high = (*outer, *(strongest + 0.001).tolist(), *inner)
        named = [*first, *((f"thrust {i} over hover", "1", 0.0) for i in rotors), *more]
        self.observation = (
            ArraySpec(
                name="observation",
                shape=(len(named),),
                low=low,
                high=high,
                unit=tuple(unit for _, unit, _ in named),
                frame=(
                    "body" if self.body else "world turned by the wanted heading; body rates: body"
                ),
                components=tuple(name for name, *_ in named),
            ),
        )
        self._bounds = tuple(np.array(bound) for bound in (low, high))

    def build_observation(self, state: State, *more: Array, goal: Array = None) -> dict[str, Array]:
        """The observation; `more` has vectors, shape (..., k), or numbers, in the order described.

        The goal, world frame, m, shape (..., 3), is by default that of `goal`.
        """
        goal = self.goal(state) if goal is None else goal
        to_goal = goal - state.position
        quaternion = state.quaternion
        if self.body:
            turned = [to_body(quaternion, v) for v in (to_goal, state.velocity)]
            vectors = (*turned, world_z(quaternion))
        else:
            seen = (to_goal, state.velocity, body_x(quaternion), body_z(quaternion))
            vectors = tuple(map(self.turned, seen))
        thrust = state.thrust / self.vehicle.hover_thrust - 1.0
        rest = [x if getattr(x, "ndim", 0) == state.position.ndim else stack((x,)) for x in more]
        parts = (*vectors, state.body_rates, thrust, *rest)
        low, high = self._bounds
        return {"observation": clip(np.concat(parts, axis=-1), low, high)}

    def turned(self, vectors: Array) -> Array:
        """World vectors in the world frame turned by the wanted heading, shape (..., 3)."""
        if self.wanted == 0.0:
            return vectors
        c = math.cos(self.wanted)
        s = math.sin(self.wanted)
        x = vectors[..., 0]
        y = vectors[..., 1]
        return stack((c * x + s * y, c * y - s * x, vectors[..., 2]))


def at(point: Sequence[float], state: State) -> Array:
    """A point for every drone, shape (W, A, 3)."""
    zero = 0.0 * component(state.position, 0)
    return stack([zero + value for value in point])


def row_of(rows: Array, index: Array) -> Array:
    """A row for each drone, (W, A, k): of its own, (W, A, rows, k), or of a table, (rows, k)."""
    if not np.ndim(index):
        return rows[int(index)]
    number = index.astype(int)
    if rows.ndim == 2:
        return rows[number]
    return np.take_along_axis(rows, number[..., None, None], axis=-2)[..., 0, :]


def length(vectors: Array) -> Array:
    """Sizes of vectors, shape (..., 3)."""
    return np.sqrt(np.sum(vectors * vectors, axis=-1))


def rates_cost(state: State, weight: float = RATE_WEIGHT) -> Array:
    """Reward for body rates, (W, A): minus the weight times their size, rad/s."""
    return -weight * np.minimum(length(state.body_rates), FASTEST_COUNTED)


def swing_cost(state: State) -> Array:
    """Reward for the speed of a payload relative to the craft, (W, A)."""
    speed = length(state.payload_velocity - state.velocity)
    return np.maximum(-SWING_WEIGHT * speed, WORST_SWING)
