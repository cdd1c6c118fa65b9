"""Arithmetic of the elevation task, the same for one drone (float) and for many (arrays (N,)).

Only operators that round alike for Python floats and for NumPy's float64 are used, so that a
single env and a batch of them agree bit for bit.
"""

from typing import Any, Final, TypeVar, cast

import numpy as np

from ..models.constants import HOVER_THRUST, MAX_THRUST
from .config import ElevationConfig

__all__ = ["MAX_TILT_COSINE", "TERMINATION_REWARD", "ElevationTask"]

ERROR_SCALE: Final = 0.5
"""|E| at which the reward crosses zero, m."""

TERMINATION_REWARD: Final = -20.0
"""Added to the reward of the step that terminates an episode (crash, flip-over, out of band)."""

MAX_TILT_COSINE: Final = 0.5
"""Cosine of the tilt (60°) past which the craft counts as flipped over."""

Number = TypeVar("Number", float, np.ndarray)
Flag = TypeVar("Flag", bool, np.ndarray)


def _clip(x: Any, low: float, high: float) -> Any:
    if isinstance(x, float):
        return low if x < low else high if x > high else x
    return x.clip(low, high)  # NumPy's arrays and tensors


class ElevationTask:
    """Action to thrust, state to observation, reward and end of episode."""

    def __init__(self, config: ElevationConfig) -> None:
        self.config = config
        self._increment = config.action_mode == "increment"
        self._scale = config.newtons_per_action

    def draw(self, random: np.random.Generator) -> tuple[float, float]:
        """Target and start elevation of an episode, m."""
        low, high = self.config.target_range
        band = self.config.start_band
        target = float(random.uniform(low, high))
        return target, target + float(random.uniform(-band, band))

    def thrust(self, action: Number, thrust: Number) -> tuple[Number, bool | np.ndarray]:
        """Thrust of each rotor after an action in [-1, 1], N, and whether it had to be clipped.

        `thrust` is the present one. Actions outside [-1, 1] count as the nearer bound.
        """
        change = self._scale * _clip(action, -1.0, 1.0)
        wanted = (thrust if self._increment else HOVER_THRUST) + change
        applied = _clip(wanted, 0.0, MAX_THRUST)
        return applied, wanted != applied

    def terminated(self, error: Number, tilt_cosine: Number, touching: Flag) -> Flag:
        """Whether the craft left the band, turned over or touched the floor."""
        outside: Any = abs(error) > self.config.flight_band
        return cast(Flag, touching | outside | (tilt_cosine < MAX_TILT_COSINE))

    def reward_terms(self, error: Number, terminated: Flag) -> tuple[Number, Number]:
        """Terms of the reward: elevation and termination. Their sum is the reward.

        The elevation term is (s - |E|) / (s + |E|) with s = 0.5 m: 1 at E = 0, 0 at 0.5 m, and
        never below -1. Its slope is steepest at the target, where precision is won.
        """
        distance = abs(error)
        elevation = (ERROR_SCALE - distance) / (ERROR_SCALE + distance)
        termination: Any = terminated * TERMINATION_REWARD + 0.0  # + 0.0: no negative zeros
        return elevation, termination
