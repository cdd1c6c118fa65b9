"""Episodes with seeds of their own: recorded as they are flown, and flown again to resume.

An episode is determined by its seed and its actions. So a training that stops in the middle of one
keeps no simulator's state: it resets to the same seed and repeats the same actions, over any wire.
"""

import time
from dataclasses import dataclass
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv

from ..envs.autoreset import AdvancingVectorEnv, worlds_done
from ..envs.spec import EnvSpec, component_names
from ..models.errors import InputError
from .policies import ActionMap, flat

LOST: Final = "simulator_lost"
"""Name in the `info` of a step whose simulator was lost, as `rotorgram.udp` has it."""


class ResumeError(InputError):
    """The simulator does not repeat the episodes that were interrupted."""


def episode_seed(run_seed: int, episode: int) -> int:
    """Seed of an episode, 64 bits: independent across runs and episodes."""
    sequence = np.random.SeedSequence(run_seed, spawn_key=(2, episode))
    return int(sequence.generate_state(1, np.uint64)[0])


@dataclass(frozen=True, kw_only=True)
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
    """Mean of |headline metric| over its steps, in the metric's unit; NaN if there is none."""
    terminated: bool
    truncated: bool
    seconds: float
    """Wall time since training began, s."""
    simulator_lost: bool = False
    """Whether it was truncated because its simulator was lost, not by its time limit."""


@dataclass(frozen=True, kw_only=True)
class Position:
    """Position of a run of N drones."""

    env_steps: int
    seconds: float
    """Wall time since training began, s."""
    actions: np.ndarray
    """Actions of the env: float32, shape (t, N, k), or int64, shape (t, N), for the t steps of the
    longest running episode."""
    observations: np.ndarray
    """Observations after the last of them, flat: float32, shape (N, n)."""
    numbers: np.ndarray
    """Of the running episodes: int64, shape (N,), as their steps in `lengths`, and the env steps of
    the run before each in `first_steps`."""
    lengths: np.ndarray
    first_steps: np.ndarray
    episodes: tuple[Episode, ...] = ()
    """Ended episodes, in the order of their ends."""


class EpisodeLog(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Gives every episode of every drone its seed, and keeps its actions.

    Episodes are numbered as they begin, of several that begin with the same step in the order of
    the drones. `fly` and `begin` leave the results in the attributes of `env`. `reset` and `step`
    make the log a vector env of Gymnasium's SAME_STEP, whatever the autoreset of `env`. Its
    observations are flat, and its continuous actions are in the units of `ActionMap`.

    Drones of one world begin together. One whose episode ends before those of the others is out:
    it flies no env steps until the world begins anew.

    `seed` is that of the run. With `keep_steps` every step is kept, for `steps`.

    Attributes:
        env_steps: Control steps of all drones together.
        out: Whose episode has ended and the next has not begun: bool, shape (N,).
        done: Those of them in whose world all are out: these are to begin.
        episodes: Ended episodes, in the order of their ends.
        drawn: For each that ended since the log was made, what was drawn for it, by name.
    """

    def __init__(
        self, env: gym.Env[Any, Any] | AdvancingVectorEnv, seed: int, *, keep_steps: bool = False
    ) -> None:
        self.env = env if isinstance(env, AdvancingVectorEnv) else _OneDrone(env)
        self.spec: EnvSpec = self.env.env_spec  # type: ignore[assignment]  # not Gymnasium's
        self.num_envs = count = self.env.num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.actions = actions = ActionMap(self.spec.action)
        self.drawn: dict[int, dict[str, float]] = {}
        told = [array.components for array in self.spec.telemetry if array.name == "drawn"]
        self._drawn = told[0] if told else ()
        low, high = (
            np.concatenate([a.bounds()[side].ravel() for a in self.spec.observation]).astype("f")
            for side in (0, 1)
        )
        self.single_observation_space = spaces.Box(low, high)
        box = spaces.Box(-1, 1, (actions.size,))
        self.single_action_space = spaces.Discrete(actions.outputs) if actions.discrete else box
        self.run_seed = seed
        self.env_steps = 0
        self.episodes: list[Episode] = []
        self._began: float | None = None
        self._numbers = np.arange(-count, 0)  # of the running episodes
        self._lengths = np.zeros(count, int)
        self._first_steps = np.zeros(count, int)
        self._rewards = np.zeros(count)
        self._sizes = np.zeros(count)
        self._seeds = np.zeros(count, np.uint64)
        self._all = np.ones(count, bool)
        self._nothing = np.full(count, np.nan)
        self._together = len(self.spec.agents)
        self.out = self.done = ~self._all
        self._flown: list[np.ndarray] = []  # actions; at least those of the running episodes
        self._steps: list[np.ndarray] | None = [] if keep_steps else None
        self._still = actions.to_envs(np.zeros((count, actions.size), np.float32))

    def start_clock(self) -> None:
        """Training begins now; after `resume` it has begun before."""
        if self._began is None:
            self._began = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Wall time since training began, s."""
        return 0.0 if self._began is None else time.perf_counter() - self._began

    @property
    def observations(self) -> np.ndarray:
        """Current observations, flat: float32, shape (N, n)."""
        return flat(self.env.observations, self.spec, self.num_envs)

    def start(self) -> None:
        """Begin the first episode of every drone, unless that was done before."""
        if self._numbers[0] < 0:
            self.reset()

    def fly(
        self,
        actions: np.ndarray,
        begins: np.ndarray | None = None,
        frozen: np.ndarray | None = None,
    ) -> None:
        """Fly one step with actions as a network draws them, shape (N, k), or (N, 1) if discrete.

        Drones may begin their next episode instead, or stay as they are: bool, shape (N,). One
        whose episode has ended has to do either.
        """
        self.advance(self.actions.to_envs(actions), begins, frozen)

    def advance(
        self, sent: Any, begins: np.ndarray | None = None, frozen: np.ndarray | None = None
    ) -> None:
        """The same with actions of the env, shape (N, k), or (N,) if discrete."""
        env = self.env
        seeds = None
        idle = self._idle(frozen)
        if begins is not None:
            self._number(begins)
            seeds = self._seeds
            idle = begins if idle is None else begins | idle
        env.advance(sent, begins, seeds, frozen)
        self._flown.append(sent)
        self._keep_step(idle)
        self.env_steps += self.num_envs - (0 if idle is None else int(np.count_nonzero(idle)))
        ended = env.terminated | env.truncated
        if np.count_nonzero(ended):  # of few drones faster than `any`
            self._keep_episodes(ended)

    def _idle(self, frozen: np.ndarray | None) -> np.ndarray | None:
        """Who flies no env step now: frozen drones, and those that are out while others fly on."""
        if self._together == 1:
            return frozen
        return self.out if frozen is None else frozen | self.out

    def begin(self, drones: np.ndarray) -> np.ndarray:
        """Begin the next episodes of whole worlds, bool, shape (N,), while the others are frozen.

        If a simulator is lost meanwhile, the episodes of its frozen drones are truncated: these
        begin their next as well, and are returned, bool, shape (N,).
        """
        env, broken = self.env, np.zeros(self.num_envs, bool)
        while drones.any():
            self._number(drones)
            env.advance(self._still, drones, self._seeds, ~drones)
            drones = env.lost.copy()
            broken |= drones
            if drones.any():
                self._keep_episodes(drones)
        return broken

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode of every drone, with its own seed; arguments are not used."""
        self._number(self._all)
        self.env.reset(seed=self._seeds.tolist())
        return self.observations, {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Fly one step. `info` has `final_obs` where an episode ended.

        One that is out observes zeros, with no reward, and terminates once more with its world.
        """
        env = self.env
        info = {}
        self.fly(np.asarray(actions, np.float32).reshape(self.num_envs, -1))
        last = self.observations
        rewards = env.rewards
        terminated = env.terminated
        truncated = env.truncated
        if self.done.any():
            begun = self.done
            truncated = truncated | self.begin(begun)
            terminated = terminated | (begun & ~truncated)  # for those out, a world ends once more
        if (terminated | truncated).any():
            info = {"final_obs": last, "_final_obs": terminated | truncated}
        observations = self.observations
        observations[self.out] = 0.0
        return observations, rewards, terminated, truncated, info

    def position(self) -> Position:
        """The current position of the run."""
        longest = int(self._lengths.max())
        recent = self._flown[len(self._flown) - longest :]
        return Position(
            env_steps=self.env_steps,
            seconds=self.seconds,
            actions=np.array(recent or [self._still])[: len(recent)],
            observations=self.observations,
            numbers=self._numbers.copy(),
            lengths=self._lengths.copy(),
            first_steps=self._first_steps.copy(),
            episodes=tuple(self.episodes),
        )

    def resume(self, position: Position) -> None:
        """Bring the env to the position of another run, and continue there.

        Every drone flies the actions of its running episode again; one whose episode is shorter
        than the longest is frozen until its turn. `steps` begins with these steps. Raises
        `ResumeError` if the env does not repeat what it did then.
        """
        if len(position.numbers) != self.num_envs:
            raise ResumeError(
                f"resume: expected a training with {self.num_envs} drones, "
                f"got one with {len(position.numbers)}"
            )
        if position.numbers[0] < 0:  # it had not begun
            return
        self.episodes = list(position.episodes)
        self._numbers[:] = position.numbers
        self._first_steps[:] = position.first_steps
        self._draw_seeds(self._all)
        while self._repeat(position):  # a simulator was lost: once more, with the next
            pass
        expected = position.observations
        got = self.observations
        if (self._lengths != position.lengths).any() or got.tobytes() != expected.tobytes():
            raise ResumeError(
                "resume: the simulator does not repeat the episodes that were interrupted: "
                f"expected the observations {expected.tolist()[:3]}, got {got.tolist()[:3]}"
            )
        self.env_steps = position.env_steps
        self._began = time.perf_counter() - position.seconds

    def _repeat(self, position: Position) -> bool:
        """Fly the actions of a position; whether a simulator was lost."""
        self._forget(self._all)
        self._flown = []
        self._steps = None if self._steps is None else []
        self.env.reset(seed=self._seeds.tolist())
        lengths = position.lengths.reshape(-1, self._together).max(1).repeat(self._together)
        for step, actions in enumerate(position.actions):
            frozen = lengths < len(position.actions) - step
            idle = self._idle(frozen)
            self.env.advance(actions, None, None, frozen)
            if self.env.lost.any():
                return True
            self._flown.append(actions)
            self._keep_step(idle)
            self._take_out(self.env.terminated | self.env.truncated)
            if self.done.any():
                break  # too early: the lengths differ
        return False

    def steps(self) -> dict[str, np.ndarray]:
        """Every step that was flown, in the order of flight, those of one moment drone by drone.

        `episode` (int64), and float32 of the shape (T,): `value` of the headline metric, `reward`,
        and `thrust`, the mean over the rotors in N. NaN where the env does not tell it.
        """
        if self._steps is None:
            raise ValueError("steps: expected a log with keep_steps")
        table = np.concatenate([np.zeros((0, 4)), *self._steps])
        names = ("value", "reward", "thrust")
        columns = {name: table[:, i].astype(np.float32) for i, name in enumerate(names, 1)}
        return {"episode": table[:, 0].astype(np.int64), **columns}

    def _number(self, drones: np.ndarray) -> None:
        """Give these drones their next episodes."""
        self._numbers[drones] = self._numbers.max() + 1 + np.arange(drones.sum())
        self._first_steps[drones] = self.env_steps
        self._draw_seeds(drones)
        self._forget(drones)

    def _forget(self, drones: np.ndarray) -> None:
        self._lengths[drones] = self._rewards[drones] = self._sizes[drones] = 0
        self.out = self.out & ~drones
        self.done = self.done & ~drones

    def _take_out(self, ended: np.ndarray) -> None:
        self.out = self.out | ended
        self.done = worlds_done(self.out, self._together)

    def _draw_seeds(self, drones: np.ndarray) -> None:
        for drone in np.flatnonzero(drones).tolist():
            self._seeds[drone] = episode_seed(self.run_seed, int(self._numbers[drone]))

    def _keep_step(self, idle: np.ndarray | None) -> None:
        telemetry = self.env.telemetry
        values = telemetry["metrics"][:, 0] if "metrics" in telemetry else self._nothing
        self._lengths += 1 if idle is None else ~idle
        self._rewards += self.env.rewards  # 0 of those that did not fly
        self._sizes += np.abs(values) if idle is None else np.where(idle, 0.0, np.abs(values))
        if self._steps is not None:
            thrust = telemetry["thrust"] if "thrust" in telemetry else self._nothing[:, np.newaxis]
            row = (self._numbers, values, self.env.rewards, thrust.mean(axis=1))
            table = np.stack(row, axis=1)
            self._steps.append(table if idle is None else table[~idle])

    def _keep_episodes(self, ended: np.ndarray) -> None:
        env = self.env
        self._take_out(ended)
        for drone in np.flatnonzero(ended).tolist():
            if not (length := int(self._lengths[drone])):  # lost before its first step
                continue
            self.episodes.append(
                Episode(
                    episode=int(self._numbers[drone]),
                    first_step=int(self._first_steps[drone]),
                    length=length,
                    total_reward=float(self._rewards[drone]),
                    mean_size=float(self._sizes[drone]) / length,
                    terminated=bool(env.terminated[drone]),
                    truncated=bool(env.truncated[drone]),
                    seconds=self.seconds,
                    simulator_lost=bool(env.lost[drone]),
                )
            )
            if self._drawn:
                values = env.telemetry["drawn"][drone].tolist()
                number = int(self._numbers[drone])
                self.drawn[number] = dict(zip(self._drawn, values, strict=True))
        running = self._lengths[~ended]
        keep = int(running.max()) if running.size else 0
        self._flown = self._flown[len(self._flown) - keep :]


# A truth value as an array of one, never written to: to make another takes a microsecond.
_FLAGS: Final = (np.array((False,)), np.array((True,)))


class _OneDrone:
    """An env of one drone as a batch of one: what the log needs of `AdvancingVectorEnv`."""

    num_envs = 1

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self._env = env
        self.env_spec: EnvSpec = env.get_wrapper_attr("env_spec")
        self._shape = getattr(self.env_spec.action, "shape", None)
        arrays = [a for a in self.env_spec.telemetry if a.name in ("metrics", "thrust", "drawn")]
        self._told = [(array.name, component_names(array)) for array in arrays]
        self.observations: Any = None
        self._rest()

    def reset(self, *, seed: list[int]) -> None:
        self._take(*self._env.reset(seed=seed[0]))
        self._rest()

    def advance(
        self,
        actions: np.ndarray,
        resets: np.ndarray | None = None,
        seeds: np.ndarray | None = None,
        frozen: np.ndarray | None = None,
    ) -> None:
        if resets is not None and resets[0] and seeds is not None:
            self.reset(seed=[int(seeds[0])])
        elif frozen is not None and frozen[0]:
            self._rest()
        else:
            action = int(actions[0]) if self._shape is None else actions[0].reshape(self._shape)
            observation, reward, terminated, truncated, info = self._env.step(action)
            self._take(observation, info)
            self.rewards = np.array((float(reward),))
            self.lost = _FLAGS[LOST in info]
            self.terminated = _FLAGS[terminated]
            self.truncated = _FLAGS[truncated]

    def _take(self, observation: Any, info: dict[str, Any]) -> None:
        if isinstance(observation, dict):
            self.observations = {k: np.asarray(v)[np.newaxis] for k, v in observation.items()}
        else:
            self.observations = np.asarray(observation)[np.newaxis]
        self.telemetry = {
            name: np.array([[info[component] for component in components]])
            for name, components in self._told
        }

    def _rest(self) -> None:
        self.rewards = np.zeros(1)
        self.terminated = self.truncated = self.lost = _FLAGS[False]
