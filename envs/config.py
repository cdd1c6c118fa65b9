"""Options of the elevation task and the spaces that follow from them. Imports no simulator.

An agent on another machine builds its spaces from here, without MuJoCo.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any, Final, Literal, Self, get_args

import numpy as np
from gymnasium import spaces

from ..models.constants import (
    GRAVITY,
    HOVER_THRUST,
    MAX_CLIMB_ACCELERATION,
    MAX_THRUST,
    PHYSICS_TIMESTEP,
)

__all__ = ["ENV_ID", "TELEMETRY_NAMES", "ElevationConfig", "action_space", "observation_space"]

ENV_ID: Final = "rotorgram/Elevation-v0"

TELEMETRY_NAMES: Final = ("X", "Y", "Z", "phi", "theta", "psi", "F1", "F2", "F3", "F4")
"""Telemetry in the paper's frame: position in m, attitude in degrees, rotor thrusts in N."""

LOWEST_START: Final = 1.0
"""Lowest allowed start elevation, m: 0.6 m of air under the skids."""

FURTHEST: Final = 1e6
"""Highest target and widest flight band, m: far inside what MuJoCo and float32 can hold."""

LONGEST_CONTROL_PERIOD: Final = 1.0
"""Longest time between two actions, s."""

LARGEST_DRAG: Final = 100.0
"""Largest linear drag, 1/s. RK4 at 5 ms is within 0.1 % there, and unstable above 557 /s."""

Target = float | tuple[float, float]
ActionMode = Literal["increment", "offset"]
ActionType = Literal["continuous", "discrete"]
Observation = Literal["full", "error"]


@dataclass(frozen=True, kw_only=True)
class ElevationConfig:
    """Options of `rotorgram/Elevation-v0`. A wrong one raises `ValueError` with one sentence.

    Numbers may be of any real type, NumPy's among them; they are kept as Python's float and int.
    """

    target: Target = 5.0
    """Target elevation Y, m: a number, or (low, high) to draw one uniformly for each episode."""
    start_band: float = 1.0
    """An episode starts at rest, hovering, up to this far above or below the target, m."""
    flight_band: float = 3.0
    """An episode terminates when the craft is further than this from the target, m."""
    episode_length: int = 250
    """Control steps after which an episode is truncated."""
    control_period: float = 0.02
    """Time between two actions, s: a multiple of the physics step of 0.005 s, at most 1 s. The
    default is that of Unity's `FixedUpdate`."""
    action_mode: ActionMode = "increment"
    """`increment`: thrust += scale · action (paper, section 2.2).
    `offset`: thrust = hover + scale · action."""
    action_type: ActionType = "continuous"
    """`continuous`: one number in [-1, 1]. `discrete`: 0 decrease, 1 hold, 2 increase."""
    observation: Observation = "full"
    """`full`: E, its rate and the thrust. `error`: E alone, as the paper feeds its network."""
    thrust_scale: float | None = None
    """Thrust per unit of action for each rotor, N. None: 5 N (increment) or 20 N (offset)."""
    linear_drag: float = 0.0
    """Acceleration of -linear_drag · velocity, 1/s, as Unity's `Rigidbody.drag`; at most 100."""

    def __post_init__(self) -> None:
        limits = {
            "start_band": (FURTHEST, "m"),
            "flight_band": (FURTHEST, "m"),
            "control_period": (LONGEST_CONTROL_PERIOD, "s"),
            "linear_drag": (LARGEST_DRAG, "/s"),
        }
        for name, (most, unit) in limits.items():
            self._keep_number(name, 0.0, most, f"a number from 0 to {most:g} {unit}")
        if self.thrust_scale is not None:
            expected = f"a number above 0 and at most {MAX_THRUST:g} N, or None"
            self._keep_number("thrust_scale", math.ulp(0.0), MAX_THRUST, expected)
        for name, kind in (
            ("action_mode", ActionMode),
            ("action_type", ActionType),
            ("observation", Observation),
        ):
            value, allowed = getattr(self, name), get_args(kind)
            known = isinstance(value, str) and value in allowed
            self._keep(name, value, known, " or ".join(map(repr, allowed)))
        length = _finite(self.episode_length)
        whole = length is not None and length >= 1 and length == int(length)
        expected = "a whole number of control steps, 1 or more"
        self._keep("episode_length", int(length or 0), whole, expected)
        ratio = self.control_period / PHYSICS_TIMESTEP
        self._keep("control_period", self.control_period,
                   ratio > 0.5 and abs(ratio - round(ratio)) < 1e-9,
                   f"a positive multiple of the physics step of {PHYSICS_TIMESTEP} s")  # fmt: skip
        self._keep("flight_band", self.flight_band, self.flight_band > self.start_band,
                   f"more than start_band = {self.start_band:g} m")  # fmt: skip
        self._keep_target()

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> Self:
        """Options by name. An unknown name raises `ValueError` too, which names those there are."""
        known = [field.name for field in fields(cls)]
        for name in options:
            if name not in known:
                raise ValueError(f"options: expected some of {', '.join(known)}, got {name!r}")
        return cls(**options)

    def _keep(self, name: str, value: Any, ok: bool, expected: str) -> None:
        """Store the checked `value`, or say what was expected in place of the option given."""
        if not ok:
            raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)!r}")
        object.__setattr__(self, name, value)

    def _keep_number(self, name: str, least: float, most: float, expected: str) -> None:
        value = _finite(getattr(self, name))
        self._keep(name, value, value is not None and least <= value <= most, expected)

    def _keep_target(self) -> None:
        target: Any = self.target
        pair = target if isinstance(target, tuple | list) else (target, target)
        values = [value for value in map(_finite, pair) if value is not None]
        kept = tuple(values) if pair is target else values[0] if values else None
        self._keep("target", kept, len(values) == len(pair) == 2 and values[0] <= values[1],
                   "an elevation in m, or a pair (low, high) with low <= high")  # fmt: skip
        least = LOWEST_START + self.start_band
        self._keep("target", kept, least <= values[0] and values[1] <= FURTHEST,
                   f"{least:g} m (start_band = {self.start_band:g} m, and {LOWEST_START:g} m of "
                   f"room) to {FURTHEST:g} m")  # fmt: skip

    @property
    def target_range(self) -> tuple[float, float]:
        """Lowest and highest target elevation, m."""
        if isinstance(self.target, tuple):
            return self.target
        return self.target, self.target

    @property
    def substeps(self) -> int:
        """Physics steps per control step."""
        return round(self.control_period / PHYSICS_TIMESTEP)

    @property
    def newtons_per_action(self) -> float:
        """Thrust per unit of action for each rotor, N."""
        if self.thrust_scale is not None:
            return self.thrust_scale
        return 5.0 if self.action_mode == "increment" else 20.0

    @property
    def rate_bound(self) -> float:
        """Speed that no flight can exceed before its episode ends, m/s.

        Thrust and gravity accelerate by a = 10.2 m/s² or less; drag only brakes. The band is
        checked at the end of a control period T. So the craft may turn back outside the band,
        within one period (out and back at no more than a T / 2), fly through the band (twice
        `flight_band`), and then for one period more:
        sqrt((a T / 2)² + 2 a · 2 flight_band) + a T.
        """
        a = max(MAX_CLIMB_ACCELERATION, GRAVITY)
        gain = a * self.control_period
        return math.hypot(gain / 2, math.sqrt(2 * a * 2 * self.flight_band)) + gain

    @property
    def error_bound(self) -> float:
        """Largest |E| of an observation, m: the band and one control period of flight."""
        return self.flight_band + self.rate_bound * self.control_period


def _finite(value: Any) -> float | None:
    """A finite real number as a float; None for everything else, truth values among them."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def observation_space(config: ElevationConfig) -> spaces.Box:
    """Bounds of the observation, float32, shape (3,) for `full` and (1,) for `error`."""
    low = [-config.error_bound, -config.rate_bound, -1.0]
    high = [config.error_bound, config.rate_bound, MAX_THRUST / HOVER_THRUST - 1]
    size = 3 if config.observation == "full" else 1
    # Rounding to float32 may move a bound inwards by half a unit: step outwards once.
    return spaces.Box(
        np.nextafter(np.array(low[:size], np.float32), np.float32(-np.inf)),
        np.nextafter(np.array(high[:size], np.float32), np.float32(np.inf)),
        dtype=np.float32,
    )


def action_space(config: ElevationConfig) -> spaces.Space[np.ndarray] | spaces.Discrete:
    """One number in [-1, 1] (float32, shape (1,)), or three discrete actions."""
    if config.action_type == "discrete":
        return spaces.Discrete(3)
    return spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)
