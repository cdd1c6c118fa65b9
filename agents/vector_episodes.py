"""Episodes of many drones, each with a seed of its own: `EpisodeLog` for a vector env."""

import time
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorWrapper

from ..envs.autoreset import AdvancingVectorEnv, Step
from .episodes import Clock, Episode, Position, ResumeError, episode_seed

__all__ = ["VectorEpisodeLog"]


class VectorEpisodeLog(Clock, VectorWrapper):
    """Gives every episode of every drone its seed, and keeps what was flown.

    It is a vector env of Gymnasium's SAME_STEP itself, whatever the autoreset of `env`. Episodes
    are numbered as they begin, of several that begin with the same step in the order of the drones.

    Args:
        env: Local or remote; its observation begins with the elevation error.
        seed: Seed of the run.

    Attributes:
        env_steps: Control steps of all drones together.
        episodes: Those that have ended, in that order.
    """

    env: AdvancingVectorEnv

    def __init__(self, env: AdvancingVectorEnv, seed: int) -> None:
        super().__init__(env)
        self.metadata = {**env.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.run_seed = seed
        self.env_steps = 0
        self.episodes: list[Episode] = []
        self._numbers = np.arange(-env.num_envs, 0)  # of the running episodes
        self._lengths = np.zeros(env.num_envs, int)
        self._first_steps = np.zeros(env.num_envs, int)
        self._rewards, self._errors = np.zeros(env.num_envs), np.zeros(env.num_envs)
        self._actions: list[np.ndarray] = []
        self._seeds = np.zeros(env.num_envs, np.uint64)
        self._nobody = np.zeros(env.num_envs, bool)
        size = (env.single_action_space.shape or (1,))[0]
        self._no_actions = np.zeros((env.num_envs, size), np.float32)

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin the next episode of every drone, with its own seed; arguments are not used."""
        self._begin(~self._nobody)
        return self.env.reset(seed=self._seeds.tolist())

    def step(self, actions: np.ndarray) -> Step:
        """Fly one step and keep it. `info` has `final_obs` where an episode ended."""
        last, rewards, terminated, truncated, info = self.fly(actions)
        if not (terminated | truncated).any():
            return last, rewards, terminated, truncated, info
        observations, broken = self.begin(terminated | truncated)
        truncated |= broken
        info = {"final_obs": last, "_final_obs": terminated | truncated}
        return observations, rewards, terminated, truncated, info

    def fly(
        self,
        actions: np.ndarray,
        holds: np.ndarray | None = None,
        begins: np.ndarray | None = None,
    ) -> Step:
        """Fly one step and keep it; whose episode ends has to hold or begin the next.

        Args:
            actions: Shape (N, k), or (N,) if discrete.
            holds: bool, shape (N,): drones that do not fly.
            begins: bool, shape (N,): drones that begin their next episode instead of flying.
        """
        env = self.env
        sent = np.array(actions, np.float32).reshape(self.num_envs, -1)
        idle = self._nobody if holds is None else holds
        if begins is None or not begins.any():
            env.advance(sent, self._nobody, None, holds)
        else:
            self._begin(begins)
            env.advance(sent, begins, self._seeds, holds)
            idle = idle | begins
        self._keep_step(sent, idle)
        self.env_steps += self.num_envs - int(idle.sum())
        if (env.terminated | env.truncated).any():
            self._keep_episodes()
        results = (env.observations, env.rewards, env.terminated, env.truncated)
        observations, rewards, terminated, truncated = (array.copy() for array in results)
        return observations, rewards, terminated, truncated, {}

    def begin(self, drones: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Begin the next episodes of some drones.

        A simulator that is lost meanwhile truncates the episodes of those that held: they begin
        their next as well.

        Args:
            drones: bool, shape (N,).

        Returns:
            What all see, float32, shape (N, n); and whose episode was truncated, bool, shape (N,).
        """
        env, broken = self.env, np.zeros(self.num_envs, bool)
        while drones.any():
            self._begin(drones)
            env.advance(self._no_actions, drones, self._seeds, ~drones)
            drones = env.lost.copy()
            broken |= drones
            if drones.any():
                self._keep_episodes()
        return env.observations.copy(), broken

    def position(self) -> Position:
        """Where the run stands now."""
        longest = int(self._lengths.max())
        recent = self._actions[len(self._actions) - longest :]
        return Position(
            episode=len(self.episodes),
            env_steps=self.env_steps,
            seconds=self.seconds,
            actions=np.array(recent or [self._no_actions])[: len(recent)],
            observation=self.env.observations.copy(),
            numbers=self._numbers.copy(),
            lengths=self._lengths.copy(),
            first_steps=self._first_steps.copy(),
        )

    def resume(self, position: Position, episodes: list[Episode]) -> None:
        """Bring the env to where another run stood, and go on from there.

        Every drone flies the actions of its running episode again; whose episode is shorter than
        the longest holds until it is its turn.

        Raises:
            ResumeError: The env does not repeat what it did then: another model, another version
                of MuJoCo, or other options.
        """
        numbers, lengths, first = position.numbers, position.lengths, position.first_steps
        if numbers is None or lengths is None or first is None or len(numbers) != self.num_envs:
            raise ResumeError(f"resume: expected a training with {self.num_envs} drones")
        self.episodes = list(episodes)
        self.env_steps = position.env_steps
        self._numbers, self._first_steps = numbers.copy(), first.copy()
        self._draw_seeds(~self._nobody)
        while self._repeat(position, lengths):  # a simulator was lost: once more, with the next
            pass
        if (
            self._lengths != lengths
        ).any() or self.env.observations.tobytes() != position.observation.tobytes():
            raise ResumeError(
                "the simulator does not repeat the episodes that were interrupted: expected the "
                f"observations {position.observation.tolist()[:3]}…, got "
                f"{self.env.observations.tolist()[:3]}…"
            )
        self._began = time.perf_counter() - position.seconds

    def _repeat(self, position: Position, lengths: np.ndarray) -> bool:
        """Fly the actions of a position; whether a simulator was lost."""
        self._forget(~self._nobody)
        self._actions = []
        self.env.reset(seed=self._seeds.tolist())
        longest = len(position.actions)
        for step, actions in enumerate(position.actions):
            held = lengths < longest - step
            self.env.advance(actions, self._nobody, None, held)
            if self.env.lost.any():
                return True
            if (self.env.terminated | self.env.truncated).any():
                return False  # it never came so far: lengths tell
            self._keep_step(actions, held)
        return False

    def _begin(self, drones: np.ndarray) -> None:
        """Number the next episodes of these."""
        self._numbers[drones] = self._numbers.max() + 1 + np.arange(drones.sum())
        self._first_steps[drones] = self.env_steps
        self._draw_seeds(drones)
        self._forget(drones)

    def _forget(self, drones: np.ndarray) -> None:
        self._lengths[drones] = 0
        self._rewards[drones] = self._errors[drones] = 0.0

    def _draw_seeds(self, drones: np.ndarray) -> None:
        for drone in np.flatnonzero(drones).tolist():
            self._seeds[drone] = episode_seed(self.run_seed, int(self._numbers[drone]))

    def _keep_step(self, actions: np.ndarray, held: np.ndarray) -> None:
        env = self.env
        self._actions.append(actions)
        self._lengths += ~held
        self._rewards += env.rewards
        self._errors += np.where(held, 0.0, abs(env.observations[:, 0]))

    def _keep_episodes(self) -> None:
        env = self.env
        ended = env.terminated | env.truncated
        for drone in np.flatnonzero(ended).tolist():
            length = int(self._lengths[drone])
            if length == 0:  # lost before its first step
                continue
            self.episodes.append(
                Episode(
                    episode=int(self._numbers[drone]),
                    first_step=int(self._first_steps[drone]),
                    length=length,
                    total_reward=float(self._rewards[drone]),
                    mean_abs_error=float(self._errors[drone]) / length,
                    terminated=bool(env.terminated[drone]),
                    truncated=bool(env.truncated[drone]),
                    seconds=self.seconds,
                    simulator_lost=bool(env.lost[drone]),
                )
            )
        running = self._lengths[~ended]
        keep = int(running.max()) if running.size else 0
        self._actions = self._actions[len(self._actions) - keep :]
