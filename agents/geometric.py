"""The controllers of the level `position`, flown to the goal of any task that tells where it is."""

import math
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from ..envs.spec import EnvSpec, component_names
from ..models.errors import InputError
from .layers import ByName, Floats
from .policies import Array, Observation, flat, lead_of

DAMPING = 0.5  # Damping ratio of a payload's swing
FILTER = 20.0  # Rate of the filters over that of the position loop
OVER = 2.5  # Gain of the velocity loop over the position loop's: `sim/control/gains.py`
JUMP = 4.0  # Speed of a goal, over the craft's largest, from which on it has jumped
_ACTION = ("offset x", "offset y", "offset z", "offset of the heading")
_PAYLOAD = ("payload - position", "payload velocity - velocity")
_VECTORS = ("goal - position", "velocity")
_AXES = ("thrust axis", "nose")


class Geometric:
    """Asks for the goal, ahead of it where it moves, and against what pushes the craft away.

    The simulator flies: the env's action is that of the level `position`. The observation has to
    have components named goal - position, velocity, nose and thrust axis x, y and z, and thrust 1,
    2... over hover, world frame turned by the wanted heading. In the body frame it has up in place
    of nose and thrust axis, and the heading is held as it is. Goal and velocity give the velocity
    and acceleration of the goal; thrust and velocity give the acceleration that wind or a payload
    causes. Each is filtered, and stands for the offset at which the loops ask for it.

    Where the observation has payload - position and payload velocity - velocity x, y and z, and the
    env the options payload_share and cable, horizontal offsets come from `swing_gains`.

    Raises `InputError` for an env that lacks what it needs.
    """

    options: ClassVar[Mapping[str, object]] = {"action": "position"}
    """Options of the env that it flies."""
    many = True

    def __init__(self, spec: EnvSpec) -> None:
        names = spec.action.components
        if names != _ACTION:
            raise InputError(
                "geometric: expected actions of the level position (--action position), "
                f"got {', '.join(names) or 'others'}"
            )
        self._gain = spec.constant("position_gain", "geometric")
        self._gravity = spec.constant("gravity", "geometric")
        self._scale = spec.action_scale
        seen = [name for array in spec.observation for name in component_names(array)]
        needed = _VECTORS if "up x" in seen else (*_VECTORS, *_AXES)
        self._at = spec.vectors("geometric", needed, (*_PAYLOAD, "up"))
        self._rotors = [i for i, name in enumerate(seen) if name.endswith(" over hover")]
        self._swing: Array | None = None
        self._pull = 0.0  # of the payload on the craft, m/s² per m that it hangs aside
        share = spec.options.get("payload_share")
        cable = spec.options.get("cable")
        if share and cable and self._at.keys() >= {*_PAYLOAD}:
            self._swing = swing_gains(self._gain, self._gravity / cable, share)
            self._pull = share * self._gravity / cable
        self._spec = spec
        self._period = spec.control_period
        self._share = -math.expm1(-FILTER * self._gain * self._period)
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._before: ByName | None = None
        self._moving = np.zeros(3)
        self._pushed = np.zeros(3)

    def act(self, observation: Observation) -> Floats:
        """Offset and heading as the env's action, float32, shape (4,)."""
        lead = lead_of(observation, self._spec)
        numbers = flat(observation, self._spec, *lead).astype(np.float64)
        now = leveled({name: numbers[..., at] for name, at in self._at.items()})
        over_hover = numbers[..., self._rotors].mean(axis=-1) if self._rotors else 0.0
        lift = np.asarray(self._gravity * (1.0 + over_hover))[..., None]
        now["force"] = lift * now["thrust axis"] - (0.0, 0.0, self._gravity)
        before = self._before or now
        goes = self._follow(now)
        self._before = now
        k = self._gain
        ahead = (goes - self._pushed) / (OVER * k * k)
        offset = now["goal - position"] + self._moving / k + ahead
        if self._swing is not None:  # the loops ask for the acceleration of `swing_gains`
            faster = (now["force"] - before["force"]) / self._period
            from_goal = -now["goal - position"]
            moves = now["velocity"] - self._moving
            payload = (now[name] for name in _PAYLOAD)
            seen = np.stack((from_goal, moves, *payload, now["force"], faster), axis=-2)
            wanted = goes - self._pushed - self._swing @ seen
            steadied = wanted / (OVER * k * k) + now["velocity"] / k
            offset[..., :2] = steadied[..., :2]
        x, y, _ = np.moveaxis(now["nose"], -1, 0)
        size = np.maximum(np.hypot(x, y), 1e-6)
        c, s = x / size, y / size
        return level_action(offset, c, s, -np.arctan2(s, c), self._scale)

    def _follow(self, now: ByName) -> Array:
        """Filter the goal's velocity and what pushes; return the goal's acceleration, m/s²."""
        before = self._before
        period = self._period
        if before is None:
            return np.zeros(3)
        moved = now["goal - position"] - before["goal - position"]
        faster = now["velocity"] - before["velocity"]
        moving = moved / period + (now["velocity"] + before["velocity"]) / 2
        pushed = faster / period - (now["force"] + before["force"]) / 2
        if self._swing is not None:
            pushed[..., :2] -= self._pull * now[_PAYLOAD[0]][..., :2]
        self._pushed = self._pushed + self._share * (pushed - self._pushed)
        fastest = np.abs(moving).max(axis=-1, keepdims=True)
        jumped = fastest > JUMP * self._scale[0] * self._gain
        change: Array = np.where(jumped, 0.0, self._share * (moving - self._moving))
        self._moving = np.where(jumped, 0.0, self._moving + change)
        return change / period


def leveled(vectors: ByName) -> ByName:
    """Vectors by name, (..., 3), with nose and thrust axis, in a frame whose z is up.

    Those with `up` among them are of the body frame: the level one has the nose at the heading 0.
    """
    if "up" not in vectors:
        return vectors
    up = vectors["up"]
    ahead = (1.0, 1e-9, 0.0) - up[..., :1] * up  # never 0
    axes = triad(ahead / np.linalg.norm(ahead, axis=-1, keepdims=True), up)
    turned = {name: (axes @ one[..., np.newaxis])[..., 0] for name, one in vectors.items()}
    return turned | {"nose": axes[..., 0], "thrust axis": axes[..., 2]}


def triad(x: Array, z: Array) -> Array:
    """Rows x, y and z of right angles, (..., 3, 3), from x and z, (..., 3)."""
    return np.stack((x, np.cross(z, x), z), axis=-2)


def level_action(vector: Array, c: Array, s: Array, turn: Array, scale: Array) -> Floats:
    """The action of a level that takes a vector and a number, float32, shape (..., 4).

    The vector, (..., 3), is of the world frame; the action has it forward, to the left and up, by
    the cosine and the sine of the heading, (...).
    """
    x, y, z = np.moveaxis(vector, -1, 0)
    parts = (c * x + s * y, c * y - s * x, z, turn + 0.0 * z)
    action = np.stack(parts, axis=-1) / scale
    level = np.hypot(action[..., :1], action[..., 1:2])
    action[..., :2] /= np.maximum(level, 1.0)
    clipped: Floats = np.clip(action, -1.0, 1.0).astype(np.float32)
    return clipped


def swing_gains(position: float, frequency: float, share: float) -> Array:
    """Gains K of the acceleration -K s that a craft with a payload asks for, shape (6,).

    The feedback of F. Goodarzi, D. Lee and T. Lee, "Geometric Stabilization of a Quadrotor UAV with
    a Payload Connected by Flexible Cable", arXiv 1309.6717, 2014, section III: position, velocity,
    and direction and rate of the cable, linear about the payload at rest below. Along each
    horizontal axis, with x of the craft, d of the payload minus x, and the acceleration f of the
    tilted thrust, which follows the wanted one u in the loops of `sim/control/gains.py`,

        x'' = f + share ω² d,  d'' = -(1 + share) ω² d - f,  f'' = 2 p² (u - f) - 2 p f',

    and s = (x, x', d, d', f, f'). The poles of the craft alone stay where they are, and those of
    the swing keep their frequency and get the damping ratio `DAMPING` (Ackermann's formula).

    Args:
        position: Gain kₚ of the position loop, 1/s: p = 5 kₚ.
        frequency: ω² = gravity over the cable's length, 1/s².
        share: Mass of the payload over that of the vehicle.
    """
    p = 5 * position
    swing = (1 + share) * frequency
    plant = np.zeros((6, 6))
    plant[(0, 1, 2, 4), (1, 4, 3, 5)] = 1.0
    plant[1, 2] = share * frequency
    plant[3, 2] = -swing
    plant[3, 4] = -1.0
    plant[5, 4:] = -2 * p * p, -2 * p
    powers = [np.linalg.matrix_power(plant, n) for n in range(7)]
    craft = (1.0, p / 2, p * p / 10)
    thrust = (1.0, 2 * p, 2 * p * p)
    damped = (1.0, 2 * DAMPING * math.sqrt(swing), swing)
    polynomial = np.polymul(np.polymul(craft, thrust), damped)
    reached = 2 * p * p * np.column_stack([power[:, 5] for power in powers[:6]])
    wanted = sum(c * power for c, power in zip(polynomial, reversed(powers), strict=True))
    gains: Array = np.linalg.solve(reached.T, np.eye(6)[5]) @ wanted
    return gains
