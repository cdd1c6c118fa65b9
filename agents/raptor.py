"""RAPTOR: a recurrent policy by others, which infers the quadcopter that it flies."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..envs.spec import EnvSpec
from ..models.errors import InputError, require
from .geometric import leveled, triad
from .layers import Floats
from .policies import Array, Observation, flat, lead_of

CORNERS = 1j ** np.array((-0.5, -1.5, 1.5, 0.5))
"""Directions, x + iy, of its motors: front right, rear right, rear left, front left."""
TURNS = (-1, 1, -1, 1)
"""Signs of the torques of its motors about body z, at a thrust."""
LEAST_TURN = 1 - 1e-6j  # of two that are as large, that to the left
PERIOD = 0.01  # s, between its actions
LIMITS = np.array(((1.0,), (2.0,)))
"""Largest position, m, and velocity, m/s, from those of the goal: it was trained on such."""
BEYOND = 0.15  # m, that it aims past a gate and below a pad: it stops some centimetres short
_VECTORS = ("goal - position", "velocity", "body rate")
_PAD = "velocity of the pad"
_GATE = "direction of the gate"
_FURTHER = ("nose", "thrust axis", "up", "reference velocity", _PAD, _GATE)


class Raptor:
    """Flies a quadcopter to the goal of a task by its rotors, at 100 Hz.

    J. Eschmann, D. Albani, G. Loianno, "RAPTOR: A Foundation Policy for Quadrotor Control", 2025.
    The package `foundation-policy` (MIT) has the weights and their forward pass. The policy takes
    position from the goal and velocity from that of the goal, both cut, attitude, body rates and
    its last action; it gives throttles, from -1 to 1.

    It knows one order of rotors, in which the front right one turns counterclockwise. So world and
    body are turned about z until the craft's rotors are in that order. Where the observation is in
    the body frame, with `up` in place of nose and thrust axis, the nose always has the heading 0.

    Raises `InputError` for an env that lacks what it needs, `MissingPackage` without its package.
    """

    options: ClassVar[Mapping[str, object]] = {"action": "rotors", "control_period": PERIOD}
    """Options of the env that it flies."""
    many = True

    def __init__(self, spec: EnvSpec) -> None:
        self._at = spec.vectors("raptor", _VECTORS, _FURTHER)
        numbers = {name: np.array(value) for name, value in spec.constants.items()}
        if spec.control_period != PERIOD or "throttle_curve" not in numbers:
            raise InputError(
                "raptor: expected one vehicle, --action rotors and --control-period 0.01, got "
                f"{spec.vehicle}, {', '.join(spec.action.components)} and {spec.control_period}"
            )
        levels = [numbers[f"thrust_{level}"] for level in ("low", "hover", "high")]
        self._thrusts = np.stack(levels, axis=1)
        self._curve = numbers["throttle_curve"][::-1]
        order, turn = layout(*(numbers[f"torque_{axis}"] for axis in "xyz"))
        self._motors = np.argsort(order)
        ahead = np.array((turn.real, turn.imag, 0.0))
        self._frame = triad(ahead, np.eye(3)[2]).T
        self._spec = spec
        self._policy = require("foundation_policy", "raptor", "raptor").Raptor()
        self.reset()

    def reset(self) -> None:
        """Forget the last episode, and the craft."""
        self._policy.reset()
        self._last = np.zeros(4)

    def act(self, observation: Observation) -> Floats:
        """Action of the level `rotors`, float32, shape (4,)."""
        lead = lead_of(observation, self._spec)
        numbers = flat(observation, self._spec, *(lead or (1,))).astype(np.float64)
        now = {name: numbers[:, at] for name, at in self._at.items()}
        rates = now.pop("body rate")
        now = leveled(now)
        goal = now["goal - position"]
        velocity = now["velocity"] - now.get("reference velocity", 0.0)
        if _GATE in now:
            ahead = now[_GATE]
            goal[:, : ahead.shape[1]] += BEYOND * ahead
        if _PAD in now:
            goal[:, 2] -= BEYOND
            velocity[:, :2] -= now[_PAD]
        vectors = np.stack((-goal, velocity), axis=1)
        axes = triad(now["nose"], now["thrust axis"]).swapaxes(1, 2)
        frame = self._frame
        vectors /= np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True) / LIMITS, 1.0)
        position, velocity = (vectors @ frame).swapaxes(0, 1)
        attitude = (frame.T @ axes @ frame).reshape(-1, 9)
        last = np.broadcast_to(self._last, (len(numbers), 4))
        inputs = (position, attitude, velocity, rates @ frame, last)
        motors = self._policy.evaluate_step(np.concatenate(inputs, axis=1))
        self._last = np.clip(motors, -1.0, 1.0)
        throttles = 0.5 + 0.5 * self._last[:, self._motors]
        thrusts = self._thrusts[:, 2] * np.polyval(self._curve, throttles)
        pairs = zip(thrusts.T, self._thrusts, strict=True)
        actions = [np.interp(thrust, levels, (-1.0, 0.0, 1.0)) for thrust, levels in pairs]
        return np.array(actions, np.float32).T.reshape(*lead, 4)


def layout(roll: Array, pitch: Array, yaw: Array) -> tuple[Any, Any]:
    """Which rotor each motor is, ints, (4,), and by how much the frame is turned about z in which
    they are in its corners, as e^(iθ).

    Torques about the center of mass are per newton of each rotor, m, shape (R,). Raises
    `InputError` unless there are four rotors, one in each corner, and neighbours turn against each
    other.
    """
    place = 1j * roll - pitch
    clockwise = np.argsort(-np.angle(place))
    orders = [np.roll(clockwise, -first) for first in range(len(place))]
    fits = [
        (np.vdot(CORNERS, place[order]), order)
        for order in orders
        if np.array_equal(np.sign(yaw[order]), TURNS)
    ]
    if not fits:
        raise InputError(
            "raptor: expected four rotors, one in each corner, neighbours of which turn against "
            f"each other, got {len(place)} with the torques {np.round(yaw, 4).tolist()} about z"
        )
    fit, order = max(fits, key=lambda one: float((one[0] * LEAST_TURN).real))
    return order, fit / abs(fit)
