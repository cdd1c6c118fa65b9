"""Base of local and remote vector envs: Gymnasium's autoreset over a single method."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from ..models.errors import InputError
from ..models.fields import Limits, OrNone, Rule
from ..sim.state import some
from .actions import Asking
from .info import Info, LazyInfo
from .spaces import action_space, info_columns, observation_space
from .spec import EnvSpec

LOST = "simulator_lost"
"""Key in the `info` of a step that a lost simulator truncated: why it was lost."""

Array = np.ndarray
Observation = Any
"""An array, or a dict of arrays."""
Step = tuple[Observation, Array, Array, Array, Info]
Content = tuple[Mapping[str, Array], Mapping[str, Array]]
"""Telemetry and terms of the reward by name, float64, shape (N, n) and (N,)."""


class Told(NamedTuple):
    """What a step told, for whoever asks later."""

    read: Callable[[Sequence[Any]], Content]
    """Reads moments of several steps: arrays with an axis of steps before the others."""
    moment: Any

    def __call__(self) -> Content:
        content = self.read((self.moment,))
        telemetry, terms = ({name: x[0] for name, x in part.items()} for part in content)
        return telemetry, terms


def stacked(moments: Sequence[Content]) -> Content:
    """Reads moments that are contents."""
    telemetry, terms = (
        {name: np.array([row[name] for row in rows]) for name in rows[0]}
        for rows in zip(*moments, strict=True)
    )
    return telemetry, terms


Observer = Callable[["AdvancingVectorEnv", Array | None], None]
Seeds = Sequence[int | None] | Array
"""A seed for each drone; None leaves its stream of random numbers as it is."""
Seed = int | Seeds | None
"""As of a reset: drone i gets seed + i, or the i-th of N seeds; None leaves their streams."""


class AdvancingVectorEnv(Asking, VectorEnv[Observation, ArrayLike, Array]):
    """A vector env that is stepped by `advance`, the step of the wire.

    `advance` sets the arrays below to new ones; those of earlier steps do not change.

    Attributes:
        control_period: Time of a step, s.
        observations: float32, shape (N, n), where the spec has one array; else a dict of arrays.
        rewards: float64, shape (N,).
        terminated: bool, shape (N,).
        truncated: bool, shape (N,).
        done: bool, shape (N,): the episode of the drone's world has ended and the next has not
            begun.
        out: bool, shape (N,): the drone's own has ended.
        lost: bool, shape (N,): the episode was truncated because its simulator was lost.
        telemetry: By name, float64, shape (N, *shape).
    """

    env_spec: EnvSpec
    control_period: float
    observations: Observation
    rewards: Array
    terminated: Array
    truncated: Array
    done: Array
    out: Array
    lost: Array
    telemetry: Mapping[str, Array]
    observer: Observer | None = None
    """Called after every `advance`, with the env and the drones that were reset."""
    _nothing: Array = np.zeros(1)  # actions, where nobody flies

    @property
    def headline(self) -> Array:
        """The metric that decides, float64, shape (N,); NaN where the env tells none."""
        unknown = np.full((self.num_envs, 1), np.nan)
        return self.telemetry.get("metrics", unknown)[:, 0]

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """What follows the end of an episode."""
        mode: AutoresetMode = self.metadata["autoreset_mode"]
        return mode

    @abstractmethod
    def reset(self, *, seed: Seed = None, options: Info | None = None) -> tuple[Observation, Info]:
        """Begin an episode, for all drones or some."""

    @abstractmethod
    def advance(
        self,
        actions: ArrayLike,
        resets: Array | None = None,
        seeds: Seed = None,
        frozen: Array | None = None,
    ) -> None:
        """Reset some drones, freeze some, and fly the others for one control period.

        Rewards and flags of a drone that is reset or frozen are 0, and its action is ignored. One
        that is frozen is afterwards as it was before. Drones of one world are reset and frozen
        together; one that is out gets no reward while the others fly on. Actions have shape (N, k),
        discrete ones (N,) or (N, 1); masks are bool, shape (N,), or None; a drone of both masks is
        reset. Seeds, as of `reset`, are of those that are reset.
        """

    def step(self, actions: ArrayLike) -> Step:
        """Fly every drone for one control period; after an episode the autoreset mode decides."""
        mode = self.autoreset_mode
        resets = self.done if mode == AutoresetMode.NEXT_STEP and some(self.done) else None
        self.advance(actions, resets)
        rewards = self.rewards
        terminated = self.terminated
        truncated = self.truncated
        info = self._info(self._everybody)
        if mode == AutoresetMode.SAME_STEP and some(self.done):
            truncated, info = self._begin_next(truncated, info)
        return self.observations, rewards, terminated, truncated, info

    def _take_spec(self, spec: EnvSpec, num_envs: int, mode: AutoresetMode | str) -> None:
        """Set spaces and other attributes from a spec. Raises `InputError`.

        Spaces that have not changed are kept: their generators may have been seeded.
        """
        mode = checked_mode(mode)
        if getattr(self, "env_spec", None) != spec or self.num_envs != num_envs:
            self.single_observation_space = observation_space(spec)
            self.single_action_space = action_space(spec)
            self.observation_space = batch_space(self.single_observation_space, num_envs)
            self.action_space = batch_space(self.single_action_space, num_envs)
        self.env_spec = spec
        self.num_envs = num_envs
        self._nobody = np.zeros(num_envs, bool)
        self._everybody = np.ones(num_envs, bool)
        self.control_period = spec.control_period
        self.metadata = {"render_modes": [], "render_fps": spec.fps, "autoreset_mode": mode}

    def _begin_next(self, truncated: Array, last: Info) -> tuple[Array, Info]:
        """SAME_STEP: reset those whose episode ended; the info gets that of their last step.

        A simulator that is lost meanwhile truncates the episodes of its frozen drones: they begin
        their next as well.
        """
        observations = self.observations
        ended = self._nobody
        while some(self.done):
            truncated = truncated | self.lost
            ended = ended | self.done
            self.advance(self._nothing, self.done, None, ~self.done)
        masks = {name: mask & ended for name, mask in last.items() if name.startswith("_")}
        info = self._info(self._everybody)
        info |= {"final_obs": observations, "_final_obs": ended}
        info |= {"final_info": last | masks | self._losses(), "_final_info": ended.copy()}
        return truncated, info

    def _losses(self) -> Info:
        """What the info of this step says of simulators that were lost, in any round trip."""
        return {}

    def _info(self, mask: Array) -> Info:
        """The telemetry of the drones by its components, each name with its mask."""
        told = self.told()
        spec = self.env_spec
        losses = self._losses()

        def made() -> Info:
            telemetry, terms = told()
            columns = info_columns(spec, telemetry)
            info: Info = {name: column.copy() for name, column in columns.items()}
            info |= {f"reward_{name}": term for name, term in terms.items()}
            return info | {f"_{name}": mask.copy() for name in info} | losses

        return LazyInfo(made)

    def told(self) -> Told:
        """Telemetry and terms of the reward as they are now, for later."""
        return Told(stacked, (self.telemetry, {}))


def worlds_done(out: Array, drones: int) -> Array:
    """Drones whose whole world is out; `out` is bool, shape (N,)."""
    if drones == 1 or not out.any():
        return out
    return np.repeat(out.reshape(-1, drones).all(-1), drones)


def checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """A mode from its value too. Raises `InputError`."""
    try:
        return AutoresetMode(mode)
    except ValueError:
        expected = " or ".join(repr(m.value) for m in AutoresetMode)
        raise InputError(f"autoreset_mode: expected {expected}, got {mode!r}") from None


def checked_mask(mask: Any, num_envs: int) -> Array:
    """The `reset_mask` of a reset's options, bool, shape (N,); None is all. Raises `InputError`."""
    if mask is None:
        return np.ones(num_envs, bool)
    right = isinstance(mask, Array) and (mask.dtype, mask.shape) == (bool, (num_envs,))
    if not (right and mask.any()):
        raise InputError(
            f"reset_mask: expected an array of {num_envs} bool, one of them True, got {mask!r}"
        )
    return np.array(mask)


def checked_seeds(seed: Any, num_envs: int, most: int | None = None) -> Seeds | None:
    """One seed for each env, from one number, N of them, or None. Raises `InputError`.

    Where there is a largest seed, `most`, every env needs one.
    """
    rule: Rule = OrNone(Limits(0, whole=True)) if most is None else Limits(0, most, whole=True)
    if seed is None:
        return None
    if isinstance(seed, Array) and (seed.dtype, seed.shape) == (np.uint64, (num_envs,)):
        return seed
    numbers = seed
    if isinstance(seed, int | np.integer):
        numbers = range(int(seed), int(seed) + num_envs)
    try:
        seeds = [rule.read(number) for number in numbers]
    except (TypeError, ValueError, OverflowError):
        seeds = []
    if len(seeds) != num_envs:
        expected = rule.expected
        if most is not None:
            expected = f"a whole number from 0 to 2^{most.bit_length()} - 1"
        raise InputError(f"seed: expected {expected}, or {num_envs} of them, got {seed!r}")
    return seeds
