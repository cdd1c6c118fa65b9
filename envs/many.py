"""What the vector envs of `rotorgram/Elevation-v0` have in common, whatever steps their physics."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ..models import model_hash
from .autoreset import autoreset_mode as checked_mode
from .autoreset import check_names, checked_mask
from .config import (
    FURTHEST,
    LOWEST_START,
    TELEMETRY_NAMES,
    ElevationConfig,
    action_space,
    observation_space,
)

__all__ = ["RESET_OPTIONS", "ManyDrones"]

RESET_OPTIONS: Final = ("reset_mask", "target", "start")
"""Options of a reset."""


class ManyDrones:
    """N drones that fly the elevation task: what they are, and what a reset asks of them.

    For a class that is a `gymnasium.vector.VectorEnv` as well.

    Attributes:
        num_envs: N.
        config: Options of the task.
        control_period: Time of a step, s.
    """

    telemetry_names = TELEMETRY_NAMES

    def _take_options(
        self, num_envs: int, autoreset_mode: AutoresetMode | str, options: dict[str, Any]
    ) -> None:
        """Set what follows from a constructor's arguments, spaces too. Raises `ValueError`."""
        if num_envs < 1:
            raise ValueError(f"num_envs: expected 1 or more, got {num_envs}")
        self.num_envs = num_envs
        self.config = config = ElevationConfig.from_options(options)
        self.control_period = config.control_period
        self.metadata: dict[str, Any] = {
            "render_modes": [],
            "render_fps": round(1 / config.control_period),
            "autoreset_mode": checked_mode(autoreset_mode),
        }
        self.single_observation_space: spaces.Space[Any] = observation_space(config)
        self.single_action_space: spaces.Space[Any] = action_space(config)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._discrete = config.action_type == "discrete"

    @cached_property
    def model_hash(self) -> str:
        """Name of the vehicle's model with its drag: 32 hexadecimal characters."""
        return model_hash(self.config.linear_drag)

    def _asked(self, options: Mapping[str, Any]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Of a reset's options: which drones, and the elevations that are chosen for them, m.

        The mask is bool, shape (N,); targets and starts are float64, shape (N,). Raises
        `ValueError`.
        """
        check_names(options, RESET_OPTIONS)
        mask = checked_mask(options.get("reset_mask"), self.num_envs)
        return mask, _checked_elevations(options, self.config, self.num_envs)


def _checked_elevations(
    options: Mapping[str, Any], config: ElevationConfig, num_envs: int
) -> dict[str, np.ndarray]:
    least = LOWEST_START + (0.0 if "start" in options else config.start_band)
    lowest = {"target": least, "start": LOWEST_START}
    chosen = {}
    for name in lowest:
        if name in options:
            values = np.asarray(options[name], np.float64)
            fits = (values >= lowest[name]) & (values <= FURTHEST)
            if values.shape not in ((), (num_envs,)) or not fits.all():
                raise ValueError(
                    f"{name}: expected elevations of {lowest[name]:g} to {FURTHEST:g} m, a "
                    f"number or shape ({num_envs},), got {options[name]!r}"
                )
            chosen[name] = np.broadcast_to(values, num_envs)
    if "start" in chosen:
        for target in (chosen["target"],) if "target" in chosen else config.target_range:
            if (abs(chosen["start"] - target) > config.flight_band).any():
                raise ValueError(
                    f"start: expected at most flight_band = {config.flight_band:g} m "
                    f"from the target, got {options['start']!r}"
                )
    return chosen
