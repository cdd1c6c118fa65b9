"""Optimal reciprocal collision avoidance: each drone for itself, from what it hears of others.

J. van den Berg, S. J. Guy, M. Lin and D. Manocha, "Reciprocal n-Body Collision Avoidance",
Robotics Research, STAR 70, Springer 2011, in three dimensions.

    rotorgram evaluate examples/orca.py:Orca --env rotorgram/Crossing-v0 --drones 8
"""

from collections.abc import Mapping
from math import hypot, sqrt
from typing import ClassVar

import numpy as np
from rotorgram.agents.geometric import level_action
from rotorgram.agents.policies import Array, Observation, flat
from rotorgram.envs import EnvSpec
from rotorgram.models import InputError

HORIZON = 3.0  # Time ahead for which nothing may touch, s
ROOM = 1.15  # Spheres are taken for larger, since a velocity is not reached at once
APPROACH = 0.8  # Wanted velocity over the distance from the goal, 1/s
SPEED = 0.6  # Share of the range of the velocity that is asked for
_ROUNDS = 60  # Most rounds of projections
_DONE = 1e-6  # m/s

Vector = tuple[float, float, float]
Plane = tuple[Vector, float]
"""A normal n and a number c: velocities v with n · v >= c are allowed."""


class Orca:
    """Flies straight to the goal, with the nearest velocity that avoids all neighbours.

    Each of two drones takes half of the change of velocity that keeps their spheres apart for
    `HORIZON` seconds, and relies on the other for the rest. That is a half-space of velocities for
    each neighbour; of those that all allow, within the range of speed, the nearest to the wanted
    one is flown. The simulator flies it: the env's action is that of the level `velocity`.

    The observation has to be that of a task for several drones (`envs/tasks/swarm.py`). Raises
    `InputError` for an env that lacks what it needs.
    """

    options: ClassVar[Mapping[str, object]] = {"action": "velocity"}
    """Options of the env that it flies."""

    def __init__(self, spec: EnvSpec) -> None:
        action = spec.action
        seen = spec.observation[0]
        if action.components[:1] != ("velocity x",):
            raise InputError(
                "orca: expected actions of the level velocity (--action velocity), "
                f"got {', '.join(action.components) or 'others'}"
            )
        names = list(seen.components)
        first = "neighbour 1 - position x"
        if first not in names:
            raise InputError(f"orca: expected a task for several drones, got {spec.env_id}")
        self._radius = 2 * ROOM * spec.constant("radius", "orca")
        self._scale = spec.action_scale
        self._goal, self._velocity, self._nose = (
            names.index(f"{name} x") for name in ("goal - position", "velocity", "nose")
        )
        self._others = range(names.index(first), len(names), 7)
        ahead = "target velocity x"
        self._ahead = names.index(ahead) if ahead in names else None
        self._spec = spec

    def reset(self) -> None:
        """Nothing of an episode is kept."""

    def act(self, observation: Observation) -> Array:
        """Velocity and yaw rate as the env's action, float32, shape (4,)."""
        numbers = flat(observation, self._spec).astype(np.float64).tolist()

        def vector(first: int) -> Vector:
            return numbers[first], numbers[first + 1], numbers[first + 2]

        own = vector(self._velocity)
        goal = vector(self._goal)
        moves = (0.0, 0.0, 0.0) if self._ahead is None else vector(self._ahead)
        most = SPEED * self._scale.item(0)
        wanted = _within(_sum(moves, goal, APPROACH), most)
        planes = [
            avoiding(vector(at), vector(at + 3), own, self._radius, self._spec.control_period)
            for at in self._others
            if numbers[at + 6]
        ]
        velocity = nearest(wanted, planes, most)
        c, s, _ = vector(self._nose)
        size = hypot(c, s) or 1.0
        return level_action(velocity, c / size, s / size, 0.0, self._scale)


def avoiding(there: Vector, moves: Vector, own: Vector, radius: float, period: float) -> Plane:
    """Own velocities that take half of the care for a neighbour: the paper's Equation 5.

    Args:
        there: Position of the neighbour minus the own, m.
        moves: Its velocity minus the own, m/s.
        own: Velocity, m/s.
        radius: Distance that the positions have to keep, m.
        period: Time in which spheres that overlap have to part, s.
    """
    approach = (-moves[0], -moves[1], -moves[2])
    square = _dot(there, there)
    apart = square > radius * radius
    horizon = HORIZON if apart else period
    # The obstacle is a cone along `there`, cut off by a sphere about `there` / horizon.
    to_cap = _sum(approach, there, -1.0 / horizon)
    size = sqrt(_dot(to_cap, to_cap))
    along = _dot(to_cap, there)
    if not apart or (along < 0.0 and along * along > radius * radius * size * size):
        away = to_cap
        change = radius / horizon - size
    else:
        # The point t · `there` of the axis whose sphere, of radius t R, is nearest on its side.
        leg = square - radius * radius
        cross = square * _dot(approach, approach) - _dot(there, approach) ** 2
        share = (_dot(there, approach) + radius * sqrt(max(cross, 0.0) / leg)) / square
        away = _sum(approach, there, -share)
        size = sqrt(_dot(away, away))
        change = radius * share - size
    if size < 1e-9:  # straight at the middle: to the right, as at sea
        x, y, z = there
        away = (y, -x, 0.0) if hypot(x, y) > 1e-9 else (z or 1.0, 0.0, 0.0)
        size = hypot(*away)
    normal = (away[0] / size, away[1] / size, away[2] / size)
    return normal, _dot(normal, own) + 0.5 * change


def nearest(wanted: Vector, planes: list[Plane], most: float) -> Vector:
    """The allowed velocity next to the wanted one and no faster than `most`, m/s.

    Dykstra's alternating projections. Where nothing is allowed, it ends between the planes.
    """
    found = wanted
    left: list[Vector] = [(0.0, 0.0, 0.0)] * (len(planes) + 1)
    for _ in range(_ROUNDS):
        before = found
        for place in range(len(left)):
            point = _sum(found, left[place], 1.0)
            if place == len(planes):
                found = _within(point, most)
            else:
                normal, least = planes[place]
                found = _sum(point, normal, max(0.0, least - _dot(normal, point)))
            left[place] = _sum(point, found, -1.0)
        change = _sum(found, before, -1.0)
        if _dot(change, change) < _DONE * _DONE:
            break
    return found


def _within(velocity: Vector, most: float) -> Vector:
    size = sqrt(_dot(velocity, velocity))
    return velocity if size <= most else _sum((0.0, 0.0, 0.0), velocity, most / size)


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _sum(a: Vector, b: Vector, times: float) -> Vector:
    return a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2]
