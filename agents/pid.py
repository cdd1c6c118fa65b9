"""A hand-tuned PID controller on the same socket: the classical yardstick."""

from typing import Any, Final

import numpy as np

from ..envs import ElevationConfig
from ..models.constants import HOVER_THRUST, MASS, NUM_ROTORS

__all__ = ["PID"]

PROPORTIONAL: Final = 9.0
"""1/s²: closed-loop natural frequency of 3 rad/s."""
DERIVATIVE: Final = 5.4
"""1/s: damping ratio 0.9."""
INTEGRAL: Final = 1.0
"""1/s³: there is no steady load to remove here; an unknown mass would be one."""
INTEGRAL_BAND: Final = 0.02
"""m: the integral grows only this near the target, so that the way there does not wind it up."""


class PID:
    """Wanted acceleration from E, its rate and its integral; then the thrust that gives it.

    Needs the full observation and continuous actions.

    Args:
        config: Options of the env that it flies.

    Raises:
        ValueError: The options lack what it needs.
    """

    def __init__(self, config: ElevationConfig) -> None:
        if config.observation != "full" or config.action_type != "continuous":
            raise ValueError(
                "pid: expected observation='full' and action_type='continuous', "
                f"got {config.observation!r} and {config.action_type!r}"
            )
        self._config = config
        self._integral = 0.0

    def reset(self) -> None:
        """Forget the integral."""
        self._integral = 0.0

    def act(self, observation: np.ndarray) -> Any:
        """Change of thrust, or thrust over hover, as the env's action, float32, shape (1,)."""
        error, rate, thrust = observation.tolist()
        if abs(error) < INTEGRAL_BAND:
            self._integral += error * self._config.control_period
        acceleration = PROPORTIONAL * error + DERIVATIVE * rate + INTEGRAL * self._integral
        wanted = acceleration * MASS / NUM_ROTORS
        if self._config.action_mode == "increment":
            wanted -= thrust * HOVER_THRUST
        action = wanted / self._config.newtons_per_action
        return np.array((min(max(action, -1.0), 1.0),), np.float32)
