"""`rotorgram/Elevation-v0` for many drones at once, stepped by `mujoco.batch`."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode

from ..models.constants import HOVER_THRUST
from .autoreset import AdvancingVectorEnv, Seeds, checked_seeds
from .batch import BatchPhysics
from .config import TELEMETRY_NAMES
from .many import ManyDrones
from .rendering import RENDER_MODES, checked_render_mode, moment_of, painter
from .task import ElevationTask

if TYPE_CHECKING:
    from ..rendering.painter import Painter

__all__ = ["ElevationVectorEnv"]


class ElevationVectorEnv(ManyDrones, AdvancingVectorEnv):
    """N drones with a target each: the task of `ElevationEnv`, bit for bit that of N single ones.

    Spaces, reward, start, termination and truncation are those of `ElevationEnv`, with the drone as
    the first axis: observations float32 of shape (N, 3) or (N, 1), actions float32 of shape (N, 1)
    or int64 of shape (N,), rewards float64 of shape (N,). `info` holds an array of shape (N,) for
    each of its names.

    Autoreset is Gymnasium's NEXT_STEP (the default), SAME_STEP or DISABLED, and `metadata` says
    which. With NEXT_STEP the step after an episode's end resets that drone, ignores its action and
    gives reward 0. With SAME_STEP the observation is that of the next episode, and `info` has
    `final_obs` and `final_info` where one ended. With DISABLED a reset with a mask begins the next.

    With the render mode `rgb_array`, `render()` gives N pictures; with `human` a window shows the
    first sixteen drones side by side, in real time.

    Args:
        num_envs: N.
        render_mode: None, `rgb_array` or `human`.
        autoreset_mode: `AutoresetMode`, or its value.
        num_threads: Threads that step the physics; 0 takes one for each processor.
        options: Every field of `ElevationConfig`, by name.

    Attributes:
        observations, rewards, terminated, truncated: As `step` gives them; written anew each time.
        telemetry: float64, shape (N, 10): what `info` has under `telemetry_names`.

    Raises:
        ValueError: An option, seed or action is not what it should be; the envs are as before.
        PhysicsError: MuJoCo warned of a bad state; `reset` makes the envs usable again.
        gymnasium.error.ResetNeeded: A step before a reset, or (DISABLED) after an episode's end.
    """

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        num_threads: int = 0,
        **options: Any,
    ) -> None:
        self.closed = True  # nothing is open yet
        if num_threads < 0:
            raise ValueError(f"num_threads: expected 0 or more, got {num_threads}")
        self.render_mode = checked_render_mode(render_mode)
        self._take_options(num_envs, autoreset_mode, options)
        self.metadata["render_modes"] = RENDER_MODES
        self._task = ElevationTask(self.config)
        self._physics = BatchPhysics(num_envs, self.config.linear_drag, num_threads)
        self._generators: list[np.random.Generator | None] = [None] * num_envs
        self._target, self._thrust = np.zeros(num_envs), np.zeros(num_envs)
        self._steps = np.full(num_envs, -1)  # flown in this episode; -1: not to be stepped
        (size,) = self.single_observation_space.shape or ()
        self.observations = np.zeros((num_envs, size), np.float32)
        self.telemetry = np.zeros((num_envs, len(TELEMETRY_NAMES)))
        self.rewards = np.zeros(num_envs)
        self.terminated, self.truncated = np.zeros(num_envs, bool), np.zeros(num_envs, bool)
        self.over, self.lost = np.zeros(num_envs, bool), np.zeros(num_envs, bool)
        self._clipped = np.zeros(num_envs, bool)
        self._painter: Painter | None = None
        self._shown, self._episodes = np.zeros(num_envs, int), np.zeros(num_envs, int)
        self.closed = False

    def reset(
        self,
        *,
        seed: int | Seeds | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode, for all drones or some.

        Args:
            seed: Drone i gets seed + i, or the i-th of N seeds; None leaves its generator as it is.
            options: `reset_mask`: bool, shape (N,): which drones; the others stay where they are.
                `target`, `start`: target and start elevations, m, a number or shape (N,), in place
                of those that the seed gives. Without `start` it gives how far from the target.
        """
        mask, chosen = self._asked(options or {})
        self._begin(np.flatnonzero(mask), checked_seeds(seed, self.num_envs), chosen)
        self._observe()
        if self.render_mode == "human":
            self.render()
        return self.observations.copy(), self._info(mask)

    def advance(
        self,
        actions: np.ndarray,
        resets: np.ndarray,
        seeds: np.ndarray | None = None,
        holds: np.ndarray | None = None,
    ) -> None:
        """Reset some drones, hold some, and fly the others: see `AdvancingVectorEnv`."""
        flown = ~resets if holds is None else ~(resets | holds)
        if (waiting := flown & (self._steps < 0)).any():
            first = int(waiting.argmax())
            raise gym.error.ResetNeeded(f"step: expected a call of reset() for env {first} first")
        values = self._action_values(actions, flown)
        thrust, clipped = self._task.thrust(values, self._thrust)
        self._thrust = np.where(flown, thrust, self._thrust)
        self._clipped = np.where(flown, clipped, self._clipped & ~resets)
        steps, ids = self._steps + 1, np.flatnonzero(flown)
        self._steps[ids] = -1  # a physics error leaves them to be reset
        if ids.size:
            every = ids.size == self.num_envs
            self._physics.step(None if every else ids, self._thrust, self.config.substeps)
        if resets.any():
            self._begin(np.flatnonzero(resets), seeds)
        error = self._observe()
        physics, length = self._physics, self.config.episode_length
        ending = self._task.terminated(error, physics.tilt_cosine, physics.touching)
        self.terminated = ending & flown
        self.truncated = (steps >= length) & ~self.terminated & flown
        self.rewards = np.where(flown, sum(self._task.reward_terms(error, self.terminated)), 0.0)
        self.over = self.terminated | self.truncated | (self.over & ~resets)
        going_on = flown & ~(self.terminated | self.truncated)
        self._steps[going_on] = steps[going_on]
        if self.render_mode is not None:
            self._shown = np.where(flown, steps, self._shown)
            if self.render_mode == "human":
                self.render()

    def render(self) -> tuple[np.ndarray, ...] | None:
        """With `rgb_array` a picture of each drone, uint8, shape (180, 240, 3); otherwise None."""
        if self.render_mode is None:
            gym.logger.warn("render: expected render_mode='rgb_array' or 'human', got None")
            return None
        if not self._episodes.all():
            raise gym.error.ResetNeeded("render: expected a call of reset() first")
        if self._painter is None:
            self._painter = painter(self.render_mode, self.num_envs, self.control_period)
        error = self._target - self._physics.elevation
        return self._painter.pictures(
            [
                moment_of(
                    self.telemetry[i].tolist(),
                    error[i],
                    reward=float(self.rewards[i]),
                    step=int(self._shown[i]),
                    episode=int(self._episodes[i]) - 1,
                )
                for i in range(self.num_envs)
            ]
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        if self._painter is not None:
            self._painter.close()
            self._painter = None

    def _begin(
        self,
        ids: np.ndarray,
        seeds: Seeds | None,
        chosen: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Start the episodes of these drones."""
        targets, starts = self._target.copy(), np.zeros(self.num_envs)
        for i in ids.tolist():
            seed = None if seeds is None else seeds[i]
            generator = self._generators[i]
            if seed is not None or generator is None:
                generator, _ = np_random(None if seed is None else int(seed))
                self._generators[i] = generator
            targets[i], starts[i] = self._task.draw(generator)
        if chosen:
            self._target[ids] = chosen.get("target", targets)[ids]
            starts = chosen.get("start", starts - targets + self._target)
        else:
            self._target[ids] = targets[ids]
        self._thrust[ids] = HOVER_THRUST
        self._physics.reset(ids, starts[ids], HOVER_THRUST)
        self._steps[ids] = self._shown[ids] = 0
        self._episodes[ids] += 1
        self._clipped[ids] = False
        # Not in place: what `step` gave away stays as it was.
        kept = np.ones(self.num_envs, bool)
        kept[ids] = False
        self.terminated, self.truncated = self.terminated & kept, self.truncated & kept
        self.over = self.over & kept

    def _observe(self) -> np.ndarray:
        """Take down what every drone sees; the elevation errors, m."""
        physics = self._physics
        error: np.ndarray = self._target - physics.elevation
        self.observations[:, 0] = error
        if self.observations.shape[1] > 1:
            self.observations[:, 1] = 0.0 - physics.climb_rate
            self.observations[:, 2] = self._thrust / HOVER_THRUST - 1.0
        physics.telemetry(self.telemetry)
        return error

    def _info(self, mask: np.ndarray) -> dict[str, Any]:
        error = self._target - self._physics.elevation
        elevation, termination = self._task.reward_terms(error, self.terminated)
        info: dict[str, Any] = dict(zip(TELEMETRY_NAMES, self.telemetry.T.copy(), strict=True))
        info |= {"reward_elevation": elevation, "reward_termination": termination}
        info["thrust_clipped"] = self._clipped.copy()
        return info | {f"_{name}": mask for name in info}

    def _action_values(self, actions: np.ndarray, flown: np.ndarray) -> np.ndarray:
        """Actions as ElevationTask takes them: float64, shape (N,)."""
        try:
            with np.errstate(over="ignore"):  # what overflows is infinite, and refused as such
                kind = np.float64 if self._discrete else np.float32
                values: np.ndarray = actions[:, 0].astype(kind, casting="same_kind", copy=False)
        except TypeError:
            raise ValueError(f"actions: expected real numbers, got {actions.dtype}") from None
        right = np.isin(values, (0, 1, 2)) if self._discrete else np.isfinite(values)
        if not (right | ~flown).all():
            first = int((~right & flown).argmax())
            expected = "0, 1 or 2" if self._discrete else "finite numbers"
            raise ValueError(f"actions: expected {expected}, got {values[first]} for env {first}")
        values = np.where(flown, values, 0.0).astype(np.float64)
        if self._discrete:
            values -= 1.0
        return values
