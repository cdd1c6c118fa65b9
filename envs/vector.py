"""Many drones behind Gymnasium's vector signature: the loop with a world for each."""

from typing import Any

from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import ArrayLike

from ..models.errors import InputError
from ..models.fields import check_names
from ..sim.snapshots import Arrays, Snapshot
from .autoreset import AdvancingVectorEnv, Array, Observation, Seed, Told, checked_mask
from .compiled import make_loop
from .config import EnvConfig
from .info import Info
from .rendering import RENDER_MODES, Renderer
from .spaces import joined


class LocalVectorEnv(AdvancingVectorEnv, VectorEnv[Observation, ArrayLike, Array]):
    """N drones that fly a task in process, bit for bit as N single ones do.

    With several `drones` to a world, N is a multiple of them. One whose episode ends is `out`, with
    reward 0, until those of its world have all ended; then they begin together.

    Spaces, reward, start and ends are those of the task, with the drone as the first axis. `info`
    holds an array of shape (N,) for each component of the telemetry and each `reward_<term>`.

    Autoreset is Gymnasium's NEXT_STEP (the default), SAME_STEP or DISABLED, and `metadata` says
    which. With NEXT_STEP the step after an episode's end resets that drone, ignores its action and
    gives reward 0. With SAME_STEP the observation is that of the next episode, and `info` has
    `final_obs` and `final_info` where one ended. With DISABLED a reset with a mask begins the next.

    Args:
        env_id: Of a registered task, or the config of an env.
        num_envs: N.
        render_mode: None, `rgb_array` (N pictures) or `human` (a window shows the first world).
        autoreset_mode: `AutoresetMode`, or its value.
        keywords: As of `EnvConfig.from_keywords`: `drones` of each world, `vehicle`, `backend` …

    Attributes:
        loop: What it steps, with its world and its task.

    Raises:
        InputError: An option, seed or action is not what it should be; the drones are as before.
            A start that is refused has used their streams of random numbers: seed them again.
        PhysicsError: The physics reported a bad state; `reset` makes the envs usable again.
        gymnasium.error.ResetNeeded: A step before a reset, or (DISABLED) after an episode's end.
        gymnasium.error.ClosedEnvironmentError: A step or a reset after `close`.
    """

    def __init__(
        self,
        env_id: str | EnvConfig,
        num_envs: int = 1,
        render_mode: str | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **keywords: Any,
    ) -> None:
        self.closed = True  # nothing is open yet
        self.config = config = EnvConfig.from_keywords(env_id, **keywords)
        if type(num_envs) is not int or num_envs % config.drones != 0:
            raise InputError(
                f"num_envs: expected a multiple of drones = {config.drones}, got {num_envs!r}"
            )
        self.loop = loop = make_loop(config, num_envs // config.drones)
        self.render_mode = render_mode
        self._renderer = Renderer(render_mode, loop)
        self._take_spec(loop.spec, num_envs, autoreset_mode)
        self.metadata["render_modes"] = RENDER_MODES
        self.lost = self.done = self.out = loop.done
        self.closed = False

    def reset(self, *, seed: Seed = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Begin an episode, for all drones or some.

        Args:
            seed: Drone i gets seed + i, or the i-th of N seeds; None leaves its stream as it is.
            options: `reset_mask`: bool, shape (N,): which drones; the others stay where they are.
        """
        given = options or {}
        check_names(given, ("reset_mask",), "options")
        mask = checked_mask(given.get("reset_mask"), self.num_envs)
        self.advance(self._nothing, mask, seed, ~mask)
        return self.observations, self._info(mask)

    def render(self) -> tuple[Array, ...] | None:
        """With `rgb_array` a picture of each drone, uint8, shape (180, 240, 3); otherwise None."""
        return self._renderer.render()

    def close_extras(self, **kwargs: object) -> None:
        """Close the window, if there is one; release threads and memory."""
        self._renderer.close()
        self.loop.close()

    def advance(
        self,
        actions: ArrayLike,
        resets: Array | None = None,
        seeds: Seed = None,
        frozen: Array | None = None,
    ) -> None:
        """See the base."""
        loop = self.loop
        loop.advance(actions, resets, seeds, frozen, self._taken_asks())
        self._take_results()
        if self.render_mode == "human":
            self.render()
        if self.observer is not None:
            self.observer(self, resets)

    def snapshot(self) -> Snapshot:
        """Copies of all arrays that a later step depends on, by name."""
        return self.loop.snapshot()

    def restore(self, snapshot: Arrays) -> None:
        """Put back a snapshot of an env of the same config and size. No later bit differs."""
        self.loop.restore(snapshot)
        self._take_results()

    @property
    def headline(self) -> Array:
        """The metric that decides, float64, shape (N,); NaN where the task has none."""
        return self.loop.headline

    @property
    def telemetry(self) -> Arrays:  # type: ignore[override]  # made when it is asked for
        """By name, float64, shape (N, *shape). Raises `ResetNeeded` before the first reset."""
        return self.loop.telemetry

    def told(self) -> Told:
        """See the base."""
        return self.loop.told()

    def _take_results(self) -> None:
        loop = self.loop
        self.observations = joined(loop.spec, loop.observations)
        for name in ("rewards", "terminated", "truncated", "done", "out"):
            setattr(self, name, getattr(loop, name))
