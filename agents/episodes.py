"""Episodes with seeds of their own: recorded as they are flown, and flown again to resume.

An episode is determined by its seed and its actions. So a training that stops in the middle of one
keeps no simulator's state: it resets to the same seed and repeats the same actions, over any wire.
"""

import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import starmap
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..envs.autoreset import AdvancingVectorEnv, worlds_done
from ..envs.spec import EnvSpec
from ..models.errors import InputError
from ..models.fields import Limits, immutable
from .layers import Floats
from .policies import ActionMap, Array, flat

_BLOCK = 256  # Episodes

Mask = NDArray[np.bool_]
Counts = NDArray[np.int64]
Long = Annotated[int, Limits(0, 2**62, whole=True)]
"""A whole number that 64 bits hold."""


class ResumeError(InputError):
    """The env does not repeat the episodes that were interrupted."""


def episode_seed(run_seed: int, episode: int) -> int:
    """Seed of an episode, 64 bits: independent across runs and episodes."""
    block, place = divmod(episode, _BLOCK)
    return int(_seeds(run_seed, block)[place])


@lru_cache
def _seeds(run_seed: int, block: int) -> Array:
    """Seeds of `_BLOCK` episodes: to begin a sequence takes as long as all of them."""
    sequence = np.random.SeedSequence(run_seed, spawn_key=(2, block))
    return sequence.generate_state(_BLOCK, np.uint64)


@dataclass(frozen=True)
class Episode:
    """One finished training episode."""

    episode: int
    first_step: int
    """Env steps of the run before it."""
    length: int
    """Control steps."""
    total_reward: float
    """Return, not discounted."""
    mean_size: float
    """Mean of |headline metric| over its steps, in the metric's unit; of a `final` one its size at
    the end; NaN if there is none."""
    terminated: bool
    truncated: bool
    seconds: float
    """Wall time since training began, s."""
    simulator_lost: bool = False
    """Whether it was truncated because its simulator was lost, not by its time limit."""


class Flown(NamedTuple):
    """What N drones have flown of their running episodes."""

    actions: Array
    """Actions of the env: float32, shape (t, N, k), or int64, shape (t, N), for the t steps of the
    longest episode."""
    observations: Floats
    """Observations after the last of them, flat: float32, shape (N, n)."""
    numbers: Counts
    """Of the episodes: int64, shape (N,), as their steps in `lengths`, and the env steps of the run
    before each in `first_steps`."""
    lengths: Counts
    first_steps: Counts


@immutable
class Position:
    """Position of a run."""

    env_steps: Long
    seconds: Annotated[float, Limits(0.0)]
    """Wall time since training began, s."""
    flown: Flown | None = None
    """None of a policy alone."""
    episodes: tuple[Episode, ...] = ()
    """Ended episodes, in the order of their ends."""


class EpisodeRecorder:
    """Gives every episode of every drone its seed, and keeps its actions and results.

    Episodes are numbered as they begin, of several that begin with the same step in the order of
    the drones. `fly` and `begin` leave the results in the attributes of `env`, whatever its
    autoreset.

    Drones of one world begin together. One whose episode ends before those of the others is out:
    it flies no env steps until the world begins anew.

    `seed` is that of the run. With `keep_steps` every step is kept, for `steps`.

    Attributes:
        actions: Map from a network's outputs to actions of the env. A learner sets its policy's.
        env_steps: Control steps of all drones together.
        out: Drones that wait for their next episode: bool, shape (N,).
        done: Drones whose whole world is out: these are to begin.
        episodes: Ended episodes, in the order of their ends.
    """

    def __init__(self, env: AdvancingVectorEnv, seed: int, *, keep_steps: bool = False) -> None:
        self.env = env
        self.spec: EnvSpec = env.env_spec
        self.num_envs = count = env.num_envs
        self.actions = ActionMap(self.spec.action)
        self.run_seed = seed
        self.env_steps = 0
        self.episodes: list[Episode] = []
        self.out: Mask = np.zeros(count, bool)
        self.done: Mask = self.out
        self._together = len(self.spec.agents)
        self._began: float | None = None
        self._numbers = np.arange(-count, 0)  # of the running episodes
        self._lengths = np.zeros(count, int)
        self._first_steps = np.zeros(count, int)
        self._rewards = np.zeros(count)
        self._sizes = np.zeros(count)
        self._seeds = np.zeros(count, np.uint64)
        self._flown: list[Array] = []  # actions; at least those of the running episodes
        self._keep_steps = keep_steps
        self._steps: list[Array] = []
        self._still = self.actions.to_envs(np.zeros((count, self.actions.size), np.float32))

    @property
    def seconds(self) -> float:
        """Wall time since training began, s."""
        return 0.0 if self._began is None else time.perf_counter() - self._began

    @property
    def observations(self) -> Floats:
        """Current observations, flat: float32, shape (N, n)."""
        return flat(self.env.observations, self.spec, self.num_envs)

    def start(self) -> None:
        """Begin the first episode of every drone, and the training, unless that was done before."""
        if self._numbers[0] >= 0:
            return
        self._began = time.perf_counter()
        self._number(np.ones(self.num_envs, bool))
        self.env.reset(seed=self._seeds.tolist())

    def fly(self, actions: Floats, begins: Mask | None = None, frozen: Mask | None = None) -> None:
        """Fly one step with actions as a network draws them, shape (N, k), or (N, 1) if discrete.

        Drones may begin their next episode instead, or stay as they are: bool, shape (N,). One
        whose episode has ended has to do either.
        """
        env = self.env
        sent = self.actions.to_envs(actions)
        idle = self._idle(frozen)
        seeds = None
        if begins is not None:
            self._number(begins)
            seeds = self._seeds
        env.advance(sent, begins, seeds, frozen)
        self._flown.append(sent)
        self._keep_step(idle)
        self.env_steps += self.num_envs - int(np.count_nonzero(idle))
        ended = env.terminated | env.truncated
        if np.count_nonzero(ended):  # of few drones faster than `any`
            self._keep_episodes(ended)

    def begin(self, drones: Mask) -> Mask:
        """Begin the next episodes of whole worlds, bool, shape (N,), while the others are frozen.

        If a simulator is lost meanwhile, the episodes of its frozen drones are truncated: these
        begin their next as well, and are returned, bool, shape (N,).
        """
        broken = np.zeros(self.num_envs, bool)
        while drones.any():
            self._number(drones)
            self.env.advance(self._still, drones, self._seeds, ~drones)
            drones = self.env.lost.copy()
            broken |= drones
            if drones.any():
                self._keep_episodes(drones)
        return broken

    def position(self) -> Position:
        """The current position of the run."""
        longest = int(self._lengths.max())
        recent = self._flown[len(self._flown) - longest :]
        flown = Flown(
            actions=np.array(recent or [self._still])[: len(recent)],
            observations=self.observations,
            numbers=self._numbers.copy(),
            lengths=self._lengths.copy(),
            first_steps=self._first_steps.copy(),
        )
        return Position(
            env_steps=self.env_steps,
            seconds=self.seconds,
            flown=flown,
            episodes=tuple(self.episodes),
        )

    def resume(self, position: Position) -> None:
        """Bring the env to the position of another run, and continue there.

        Every drone flies the actions of its running episode again; one whose episode is shorter
        than the longest is frozen until its turn. `steps` begins with these steps. Raises
        `ResumeError` if the env does not repeat what it did then.
        """
        flown = position.flown
        drones = len(flown.numbers) if flown else 0
        if flown is None or drones != self.num_envs:
            raise ResumeError(
                f"resume: expected a training with {self.num_envs} drones, got one with {drones}"
            )
        if flown.numbers[0] < 0:  # it had not begun
            return
        self.episodes = list(position.episodes)
        self._numbers[:] = flown.numbers
        self._first_steps[:] = flown.first_steps
        self._draw_seeds(range(self.num_envs))
        while self._repeat(flown):  # a simulator was lost: once more, with the next
            pass
        expected = flown.observations
        got = self.observations
        if (self._lengths != flown.lengths).any() or got.tobytes() != expected.tobytes():
            raise ResumeError(
                "resume: the env does not repeat the episodes that were interrupted: "
                f"expected the observations {expected.tolist()[:3]}, got {got.tolist()[:3]}"
            )
        self.env_steps = position.env_steps
        self._began = time.perf_counter() - position.seconds

    def steps(self) -> dict[str, Array]:
        """Every step that was flown, in the order of flight, those of one moment drone by drone.

        `episode` and `value` of the headline metric, NaN where there is none: shape (T,).
        """
        episode, value = np.concatenate([np.zeros((0, 2)), *self._steps]).T
        return {"episode": episode.astype(np.int64), "value": value}

    def _repeat(self, flown: Flown) -> bool:
        """Fly the actions of a position; whether a simulator was lost."""
        env = self.env
        self._forget(np.arange(self.num_envs))
        self._flown = []
        self._steps = []
        env.reset(seed=self._seeds.tolist())
        lengths = flown.lengths.reshape(-1, self._together).max(1).repeat(self._together)
        for step, actions in enumerate(flown.actions):
            frozen = lengths < len(flown.actions) - step
            idle = self._idle(frozen)
            env.advance(actions, None, None, frozen)
            if env.lost.any():
                return True
            self._flown.append(actions)
            self._keep_step(idle)
            self._take_out(env.terminated | env.truncated)
            if self.done.any():
                break  # too early: the lengths differ
        return False

    def _idle(self, frozen: Mask | None) -> Mask:
        """Who flies no env step now: frozen drones, and those that are out, which begin or wait."""
        return self.out if frozen is None else frozen | self.out

    def _number(self, drones: Mask) -> None:
        """Give these drones their next episodes."""
        chosen = np.flatnonzero(drones)
        first = self._numbers.max() + 1
        self._numbers[chosen] = np.arange(first, first + len(chosen))
        self._first_steps[chosen] = self.env_steps
        self._draw_seeds(chosen.tolist())
        self._forget(chosen)

    def _forget(self, drones: Counts) -> None:
        for numbers in (self._lengths, self._rewards, self._sizes):
            numbers[drones] = 0
        self.out = self.out.copy()
        self.out[drones] = False
        self.done = worlds_done(self.out, self._together)

    def _take_out(self, ended: Mask) -> None:
        self.out = self.out | ended
        self.done = worlds_done(self.out, self._together)

    def _draw_seeds(self, drones: Iterable[int]) -> None:
        for drone in drones:
            self._seeds[drone] = episode_seed(self.run_seed, int(self._numbers[drone]))

    def _keep_step(self, idle: Mask) -> None:
        values = self.env.headline
        sizes = np.abs(values)
        self._lengths += ~idle
        self._rewards += self.env.rewards  # 0 of those that did not fly
        metric = self.spec.headline
        if metric is None or not metric.final:
            self._sizes += np.where(idle, 0.0, sizes)
        else:  # it is divided by the length
            self._sizes = np.where(idle, self._sizes, sizes * self._lengths)
        if self._keep_steps:
            self._steps.append(np.stack((self._numbers, values), axis=1)[~idle])

    def _keep_episodes(self, ended: Mask) -> None:
        self._take_out(ended)
        flown = ended & (self._lengths > 0)  # others were lost before their first step
        env = self.env
        columns = (
            self._numbers, self._first_steps, self._lengths, self._rewards,
            self._sizes / np.maximum(self._lengths, 1), env.terminated, env.truncated,
            np.full(self.num_envs, self.seconds), env.lost,
        )  # fmt: skip
        rows = zip(*(column[flown].tolist() for column in columns), strict=True)
        self.episodes += starmap(Episode, rows)
        keep = int(np.max(self._lengths, where=~ended, initial=0))
        self._flown = self._flown[len(self._flown) - keep :]
