"""`rotorgram/Elevation-v0`: hold a quadcopter at a target elevation."""

from functools import cached_property
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from ..models import model_hash
from ..models.constants import HOVER_THRUST
from .config import TELEMETRY_NAMES, ElevationConfig, action_space, observation_space
from .physics import Physics
from .rendering import RENDER_MODES, checked_render_mode, moment_of, painter
from .task import ElevationTask

if TYPE_CHECKING:
    from ..rendering.painter import Painter

__all__ = ["ElevationEnv"]


class ElevationEnv(gym.Env[np.ndarray, Any]):
    """Hold a 20 kg quadcopter at a target elevation by changing the thrust of all four rotors.

    The task of "Drone Elevation Control Based on Python-Unity Integrated Framework for
    Reinforcement Learning Applications" (Drones 2023, 7, 225), section 2.2 and figure 5. Where the
    paper gives no number, the number here is ours; `docs/task.md` lists which.

    ## Observation, `float32`

    | index | quantity | unit | bounds |
    |---|---|---|---|
    | 0 | elevation error E = Y - Y', desired minus measured (world, up) | m | ±3.225 |
    | 1 | rate of E: minus the climb rate | m/s | ±11.268 |
    | 2 | thrust of each rotor relative to hover: F / 49 N - 1 | 1 | -1 ... 1.041 |

    `observation="error"` keeps index 0 alone, as in the paper. The bounds follow from the options
    (`ElevationConfig.error_bound`, `rate_bound`) and cannot be left.

    ## Action

    | `action_type` | space | meaning |
    |---|---|---|
    | `continuous` | `Box(-1, 1, (1,), float32)` | a |
    | `discrete` | `Discrete(3)` | 0: a = -1, 1: a = 0, 2: a = +1 |

    | `action_mode` | thrust F of every rotor, N, clipped to 0 ... 100 |
    |---|---|
    | `increment` | F <- F + 5 a (`thrust_scale` changes the 5) |
    | `offset` | F <- 49 + 20 a (`thrust_scale` changes the 20) |

    An action is rounded to float32. One beyond [-1, 1] counts as the nearer bound. One that is not
    finite, or not of the space's shape, raises `ValueError`, and the env is as before.

    ## Reward

    (s - |E|) / (s + |E|) with s = 0.5 m: 1 at the target, 0 at half a metre, negative beyond; and
    -20 on the step that terminates.

    ## Start, termination, truncation

    The craft starts level, at rest and at hover thrust, its elevation uniform in target ± 1 m
    (`start_band`); with `target=(low, high)` the target is drawn first, uniformly.

    *Terminated*: |E| above 3 m (`flight_band`) or a tilt above 60° at the end of a step, or contact
    with the floor during it (looked for every 0.02 s).
    *Truncated*: after 250 steps (`episode_length`) of 0.02 s (`control_period`), unless the same
    step terminated.

    ## Info

    `X`, `Y`, `Z` (m) and `phi`, `theta`, `psi` (degrees, about X, Y and Z) in the paper's frame
    (X right, Y up, Z forward, left-handed), `F1` ... `F4` (N), `reward_elevation`,
    `reward_termination`, and `thrust_clipped`: whether the action asked for less than 0 N or more
    than 100 N.

    ## Render modes

    `rgb_array`: `render()` gives a picture, uint8, shape (360, 480, 3). `human`: a window shows the
    flight in real time. The physics is the same with either. Needs OpenGL; nothing else does.

    Args:
        render_mode: None, `rgb_array` or `human`.
        options: Every field of `ElevationConfig`, by name.

    Raises:
        ValueError: An option or action is not what it should be.
        PhysicsError: MuJoCo warned of a bad state; `reset` makes the env usable again.
        gymnasium.error.ResetNeeded: A step before a reset, or after an episode's end.
        rotorgram.rendering.NoOpenGL: There is nothing to draw with, or no display.
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 50}  # noqa: RUF012
    telemetry_names = TELEMETRY_NAMES

    def __init__(self, render_mode: str | None = None, **options: Any) -> None:
        self.render_mode = checked_render_mode(render_mode)
        self.config = ElevationConfig.from_options(options)
        fps = round(1 / self.config.control_period)
        self.metadata = {"render_modes": RENDER_MODES, "render_fps": fps}
        self.observation_space: spaces.Box = observation_space(self.config)
        self.action_space: spaces.Space[Any] = action_space(self.config)
        self.control_period = self.config.control_period
        self._task = ElevationTask(self.config)
        self._physics = Physics(self.config.linear_drag)
        self._substeps = self.config.substeps
        self._discrete = self.config.action_type == "discrete"
        self._full = self.config.observation == "full"
        self._target = self._thrust = 0.0
        self._steps = -1  # control steps flown in this episode; -1: not to be stepped
        self._painter: Painter | None = None
        self._shown = self._episode = 0  # steps and episodes, for pictures
        self._reward = 0.0

    @cached_property
    def model_hash(self) -> str:
        """Name of the vehicle's model with its drag: 32 hexadecimal characters."""
        return model_hash(self.config.linear_drag)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode. `seed` makes its target and start elevation reproducible.

        `options` has no keys: options are given when the env is made.
        """
        if options:
            raise ValueError(f"reset: expected no options, got {options!r}")
        super().reset(seed=seed)
        self._target, start = self._task.draw(self.np_random)
        self._thrust = HOVER_THRUST
        self._physics.reset(start, self._thrust)
        self._steps = 0
        error = self._target - self._physics.elevation
        if self.render_mode is not None:
            self._take_down(0, 0.0)
        return self._observation(error), self._info(error, False, False)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Fly for one control period. See the class for shapes, units and errors."""
        if self._steps < 0:
            raise gym.error.ResetNeeded("step: expected a call of reset() first")
        physics = self._physics
        value = self._action_value(action)
        self._thrust, clipped = self._task.thrust(value, self._thrust)
        steps, self._steps = self._steps, -1  # a physics error leaves the env to be reset
        physics.step(self._thrust, self._substeps)
        steps += 1
        error = self._target - physics.elevation
        terminated = self._task.terminated(error, physics.tilt_cosine, physics.touching)
        truncated = steps >= self.config.episode_length and not terminated
        info = self._info(error, terminated, clipped)
        if not (terminated or truncated):
            self._steps = steps
        reward = info["reward_elevation"] + info["reward_termination"]
        if self.render_mode is not None:
            self._take_down(steps, reward)
        return self._observation(error), reward, terminated, truncated, info

    def render(self) -> Any:
        """A picture of now, uint8, shape (360, 480, 3), with `rgb_array`; None otherwise."""
        if self.render_mode is None:
            gym.logger.warn("render: expected render_mode='rgb_array' or 'human', got None")
            return None
        if self._episode == 0:
            raise gym.error.ResetNeeded("render: expected a call of reset() first")
        if self._painter is None:
            self._painter = painter(self.render_mode, 1, self.control_period)
        moment = moment_of(
            self._physics.telemetry(),
            self._target - self._physics.elevation,
            reward=self._reward,
            step=self._shown,
            episode=self._episode - 1,
        )
        pictures = self._painter.pictures([moment])
        return pictures[0] if pictures else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None

    def _take_down(self, steps: int, reward: float) -> None:
        """What a picture says besides what the craft does; a window shows it at once."""
        self._shown, self._reward = steps, reward
        self._episode += steps == 0
        if self.render_mode == "human":
            self.render()

    def _action_value(self, action: Any) -> float:
        if self._discrete:
            if not self.action_space.contains(action):
                raise ValueError(f"action: expected 0, 1 or 2, got {action!r}")
            return float(action) - 1.0
        array = action
        if not (isinstance(action, np.ndarray) and action.dtype == np.float32):
            array = _as_float32(action)
        if array.shape != (1,):
            raise ValueError(f"action: expected an array of shape (1,), got shape {array.shape}")
        value: float = array.item()
        if value - value != 0.0:  # NaN and infinity
            raise ValueError(f"action: expected a finite number, got {value}")
        return value

    def _observation(self, error: float) -> np.ndarray:
        if not self._full:
            return np.array((error,), dtype=np.float32)
        rate = 0.0 - self._physics.climb_rate
        return np.array((error, rate, self._thrust / HOVER_THRUST - 1.0), dtype=np.float32)

    def _info(self, error: float, terminated: bool, clipped: Any) -> dict[str, Any]:
        info: dict[str, Any] = dict(zip(TELEMETRY_NAMES, self._physics.telemetry(), strict=True))
        elevation, termination = self._task.reward_terms(error, terminated)
        info["reward_elevation"] = elevation
        info["reward_termination"] = termination
        info["thrust_clipped"] = clipped
        return info


def _as_float32(action: Any) -> np.ndarray:
    try:
        with np.errstate(over="ignore"):  # what overflows is infinite, and refused as such
            return np.asarray(action).astype(np.float32, casting="same_kind", copy=False)
    except (TypeError, ValueError):
        raise ValueError(
            f"action: expected an array of shape (1,) of real numbers, got {action!r}"
        ) from None
