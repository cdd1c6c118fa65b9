"""The controllers of the level `position`, flown to the goal of any task that tells where it is."""

import math
import re
from typing import Any, ClassVar, Final

import numpy as np

from ..envs.spec import ArraySpec, EnvSpec
from ..models.errors import expect
from .policies import flat

GRAVITY: Final = 9.81  # m/s²
FILTER: Final = 20.0  # Filters forget so many times faster than the position loop answers
OVER: Final = 2.5  # Gain of the velocity loop over the position loop's: `sim/control/gains.py`
JUMP: Final = 4.0  # A goal that moves so many times as fast as the craft may was put elsewhere
_ACTION: Final = ("offset x", "offset y", "offset z", "offset of the heading")
_VECTORS: Final = ("goal - position", "velocity", "thrust axis")


class Geometric:
    """Asks for the goal, ahead of it where it moves, and against what pushes the craft away.

    The simulator flies: the env's action is that of the level `position`. The observation has to
    have components named goal - position, velocity, nose and thrust axis x, y and z, and thrust 1,
    2... over hover, world frame turned by the wanted heading. Goal and velocity give the velocity
    and acceleration of the goal; thrust and velocity give the acceleration that wind or a payload
    causes. Each is filtered, and stands for the offset at which the loops ask for it.

    Raises `InputError` for an env that lacks what it needs.
    """

    options: ClassVar[dict[str, Any]] = {"action": "position"}
    """Options of the env that it flies."""

    def __init__(self, spec: EnvSpec) -> None:
        action = spec.action
        names = action.components
        level = "actions of the level position (--env.action position)"
        expect(names == _ACTION, "geometric", level, f"{', '.join(names) or 'others'}")
        assert isinstance(action, ArraySpec)
        found = re.search(r"approached at (\S+) /s", action.frame)
        self._gain = float(found[1]) if found else 1.0
        self._units = np.array([float(unit.split()[0]) for unit in action.unit])
        seen = [name for array in spec.observation for name in _names(array)]
        wanted = [f"{vector} {axis}" for vector in (*_VECTORS, "nose") for axis in "xyz"]
        missing = [name for name in wanted if name not in seen]
        expected = f"the observation {missing[0]!r}" if missing else ""
        expect(not missing, "geometric", expected, f"{spec.env_id} without it")
        self._at = {v: [seen.index(f"{v} {axis}") for axis in "xyz"] for v in (*_VECTORS, "nose")}
        rotors = [i for i, name in enumerate(seen) if re.fullmatch(r"thrust \d+ over hover", name)]
        self._rotors = rotors
        self._spec, self._period = spec, spec.control_period
        self._share = -math.expm1(-FILTER * self._gain * self._period)
        self.reset()

    def reset(self) -> None:
        """Forget the last episode."""
        self._before: dict[str, np.ndarray] | None = None
        self._moving, self._pushed = np.zeros(3), np.zeros(3)

    def act(self, observation: Any) -> Any:
        """Offset and heading as the env's action, float32, shape (4,)."""
        numbers = flat(observation, self._spec).astype(np.float64)
        now = {name: numbers[at] for name, at in self._at.items()}
        lift = GRAVITY * (1.0 + (numbers[self._rotors].mean() if self._rotors else 0.0))
        now["force"] = lift * now["thrust axis"] - (0.0, 0.0, GRAVITY)
        goes = self._follow(now)
        self._before = now
        k = self._gain
        offset = now["goal - position"] + self._moving / k + (goes - self._pushed) / (OVER * k * k)
        c, s = (now["nose"] / max(math.hypot(*now["nose"][:2]), 1e-6))[:2]
        x, y, z = offset
        turn = -math.atan2(s, c)
        action = np.array((c * x + s * y, c * y - s * x, z, turn)) / self._units
        action[:2] /= max(1.0, math.hypot(*action[:2]))
        return np.clip(action, -1.0, 1.0).astype(np.float32)

    def _follow(self, now: dict[str, np.ndarray]) -> Any:
        """Filter the goal's velocity and what pushes; return the goal's acceleration, m/s²."""
        before, period = self._before, self._period
        if before is None:
            return np.zeros(3)
        moved, faster = (now[name] - before[name] for name in ("goal - position", "velocity"))
        moving = moved / period + (now["velocity"] + before["velocity"]) / 2
        pushed = faster / period - (now["force"] + before["force"]) / 2
        self._pushed = self._pushed + self._share * (pushed - self._pushed)
        if np.abs(moving).max() > JUMP * self._units[0] * self._gain:
            self._moving = np.zeros(3)
            return np.zeros(3)
        change = self._share * (moving - self._moving)
        self._moving = self._moving + change
        return change / period


def _names(array: ArraySpec) -> tuple[str, ...]:
    return array.components or ("",) * array.size
