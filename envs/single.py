"""One drone behind Gymnasium's single signature: the loop with one world."""

from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike

from ..models.errors import InputError
from ..sim.snapshots import Arrays, Snapshot
from .actions import Asking
from .autoreset import Observation
from .compiled import make_loop
from .config import EnvConfig
from .info import Info, LazyInfo
from .rendering import RENDER_MODES, Renderer
from .spaces import action_space, joined, observation_space, telemetry_names


class SingleEnv(Asking, gym.Env[Observation, ArrayLike]):
    """A drone that flies a task, in process.

    `info` has every component of the telemetry by its name (see `telemetry.py`) and the terms of
    the reward as `reward_<term>`.

    Actions are rounded to float32; a number beyond a bound counts as the bound.

    Render modes: with `rgb_array`, `render()` gives a picture, uint8, shape (360, 480, 3); with
    `human` a window shows the flight in real time. The physics is the same with either.

    Keywords are those of `EnvConfig.from_keywords`. An env can be copied by `copy.deepcopy` and
    pickled; the copy opens a window of its own.

    Attributes:
        config: The env's `EnvConfig`.
        control_period: Time of a step, s.

    Raises:
        InputError: An option or action is not what it should be; the env is as before.
        PhysicsError: The physics reported a bad state; `reset` makes the env usable again.
        gymnasium.error.ResetNeeded: A step before a reset, or after an episode's end.
        gymnasium.error.ClosedEnvironmentError: A step or a reset after `close`.
        rotorgram.rendering.NoOpenGL: There is nothing to draw with, or no display.
    """

    metadata: Info = {"render_modes": RENDER_MODES, "render_fps": 50}  # noqa: RUF012

    def __init__(
        self, env_id: str | EnvConfig, render_mode: str | None = None, **keywords: Any
    ) -> None:
        self.config = config = EnvConfig.from_keywords(env_id, **keywords)
        if config.drones > 1:
            raise InputError(f"drones: expected 1 in a single env, got {config.drones}")
        self._loop = loop = make_loop(config)
        self.render_mode = render_mode
        self._renderer = Renderer(render_mode, loop)
        self.env_spec = loop.spec
        self.control_period = loop.spec.control_period
        self.metadata = self.metadata | {"render_fps": loop.spec.fps}
        self.observation_space = observation_space(loop.spec)
        self.action_space = action_space(loop.spec)
        self._names = telemetry_names(loop.spec)
        self._all = np.ones(1, bool)

    def reset(
        self, *, seed: int | None = None, options: Info | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode; a seed makes it reproducible. `options` has no keys."""
        if options:
            raise InputError(f"reset: expected no options, got {options!r}")
        super().reset(seed=seed)
        self._loop.advance(None, self._all, seed)
        if self.render_mode == "human":
            self.render()
        return self._observation(), self._info()

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, Info]:
        """Fly for one control period. See the task for shapes, units and ends."""
        loop = self._loop
        loop.advance(action, asks=self._taken_asks())
        if self.render_mode == "human":
            self.render()
        flags = loop.terminated.item(), loop.truncated.item()
        return self._observation(), loop.rewards.item(), *flags, self._info()

    def render(self) -> np.ndarray | None:
        """A picture of now, uint8, shape (360, 480, 3), with `rgb_array`; None otherwise."""
        pictures = self._renderer.render()
        return pictures[0] if pictures else None

    def snapshot(self) -> Snapshot:
        """Copies of all arrays that a later step depends on, by name."""
        return self._loop.snapshot()

    def restore(self, snapshot: Arrays) -> None:
        """Put back a snapshot of an env of the same config. No later bit differs."""
        self._loop.restore(snapshot)

    def close(self) -> None:
        """Close the window, if there is one; release memory."""
        self._renderer.close()
        self._loop.close()

    def _observation(self) -> Observation:
        # The loop makes new arrays with each step.
        seen = {name: values[0] for name, values in self._loop.observations.items()}
        return joined(self.env_spec, seen)

    def _info(self) -> Info:
        told = self._loop.told()

        def made() -> Info:
            telemetry, terms = told()
            numbers = np.concat([*telemetry.values()], axis=1)[0].tolist()
            info = dict(zip(self._names, numbers, strict=True))
            return info | {f"reward_{name}": term.item() for name, term in terms.items()}

        return LazyInfo(made)
