"""Episodes with seeds of their own: recorded as they are flown, and flown again to resume.

An episode is determined by its seed and its actions. So a training that stops in the middle of one
needs no copy of the simulator's state: it resets to the same seed and repeats the same actions,
over any wire and in any simulator of the same model.
"""

import time
from array import array
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from ..udp import LOST

__all__ = ["Clock", "Episode", "EpisodeLog", "Position", "ResumeError", "episode_seed"]


class ResumeError(RuntimeError):
    """The simulator does not repeat the episode that was interrupted."""


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
    mean_abs_error: float
    """Mean of |E| over its steps, m."""
    terminated: bool
    truncated: bool
    seconds: float
    """Wall time since training began, s."""
    simulator_lost: bool = False
    """Whether it was truncated since its simulator was lost, not since its time was over."""


@dataclass(frozen=True, kw_only=True)
class Position:
    """Where a run stands: after so many actions of an episode."""

    episode: int
    """Episodes that have ended; so, with one drone, the number of the running one."""
    env_steps: int
    seconds: float
    actions: np.ndarray
    """Actions of the running episode: float32, shape (t, k), or int64, shape (t,). Of N drones:
    float32, shape (t, N, k), where t steps are those of the longest running episode."""
    observation: np.ndarray
    """What the last of them led to: float32, shape (n,) or (N, n)."""
    numbers: np.ndarray | None = None
    """Of N drones, the number of the running episode of each: int64, shape (N,)."""
    lengths: np.ndarray | None = None
    """Of N drones, the steps of the running episode of each: int64, shape (N,)."""
    first_steps: np.ndarray | None = None
    """Of N drones, env steps of the run before the running episode of each: int64, shape (N,)."""


class Clock:
    """Wall time of a training: what both logs have in common."""

    _began: float | None = None

    def start_clock(self) -> None:
        """Training begins now; after `resume` it has begun before."""
        if self._began is None:
            self._began = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Wall time since training began, s."""
        return 0.0 if self._began is None else time.perf_counter() - self._began


class EpisodeLog(Clock, gym.Wrapper[np.ndarray, Any, np.ndarray, Any]):
    """Gives every episode its seed, and keeps what was flown.

    Args:
        env: A local or remote env whose observation begins with the elevation error.
        seed: Seed of the run.
    """

    def __init__(self, env: gym.Env[np.ndarray, Any], seed: int) -> None:
        super().__init__(env)
        self.run_seed = seed
        self.env_steps = 0
        self.episodes: list[Episode] = []
        self.errors = array("f")
        """Elevation error after each step, m."""
        self.rewards = array("f")
        self.thrusts = array("f")
        """Thrust of rotor 1 during each step, N; NaN where the env tells none."""
        self._episode = -1
        self._actions: list[Any] = []
        self._observation = np.empty(0, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin the next episode, with its own seed; `seed` and `options` are not used."""
        self._episode += 1
        self._actions = []
        observation, info = self.env.reset(seed=episode_seed(self.run_seed, self._episode))
        self._observation = observation
        return observation, info

    def step(self, action: Any) -> tuple[np.ndarray, Any, bool, bool, dict[str, Any]]:
        """Fly one step and keep it."""
        result = self.env.step(action)
        observation, reward, terminated, truncated, info = result
        self._keep_step(action, observation, reward, info)
        self.env_steps += 1
        if terminated or truncated:
            self._keep_episode(terminated, truncated, lost=LOST in info)
        return result

    def position(self) -> Position:
        """Where the run stands now."""
        return Position(
            episode=self._episode,
            env_steps=self.env_steps,
            seconds=self.seconds,
            actions=np.array(self._actions),
            observation=self._observation.copy(),
        )

    def resume(self, position: Position, episodes: list[Episode]) -> None:
        """Bring the env to where another run stood, and go on from there.

        `errors`, `rewards` and `thrusts` begin with the episode that was running.

        Raises:
            ResumeError: The env does not repeat what it did then: another model, another version
                of MuJoCo, or other options.
        """
        self.episodes = list(episodes)
        self._episode = position.episode
        observation, ended, lost = self._repeat(position)
        while lost:  # by a simulator that another one has replaced: once more, with that one
            observation, ended, lost = self._repeat(position)
        if ended or observation.tobytes() != position.observation.tobytes():
            raise ResumeError(
                f"the simulator does not repeat episode {position.episode}: after "
                f"{len(position.actions)} steps expected the observation {position.observation}, "
                f"got {observation}"
            )
        self.env_steps = position.env_steps
        self._began = time.perf_counter() - position.seconds

    def _repeat(self, position: Position) -> tuple[np.ndarray, bool, bool]:
        """Fly the actions of a position; the last observation, and whether all ended before."""
        del self.errors[:], self.rewards[:], self.thrusts[:]
        observation, _ = self.env.reset(seed=episode_seed(self.run_seed, position.episode))
        self._actions, self._observation = [], observation
        ended = False
        info: dict[str, Any] = {}
        for action in position.actions:
            if ended:
                break
            observation, reward, terminated, truncated, info = self.env.step(action)
            self._keep_step(action, observation, reward, info)
            ended = terminated or truncated
        return observation, ended, LOST in info

    def _keep_step(
        self, action: Any, observation: np.ndarray, reward: Any, info: dict[str, Any]
    ) -> None:
        self._actions.append(action)
        self._observation = observation
        self.errors.append(observation[0])
        self.rewards.append(reward)
        self.thrusts.append(info.get("F1", np.nan))

    def _keep_episode(self, terminated: bool, truncated: bool, *, lost: bool) -> None:
        length = len(self._actions)
        self.episodes.append(
            Episode(
                episode=self._episode,
                first_step=self.env_steps - length,
                length=length,
                total_reward=float(sum(self.rewards[-length:])),
                mean_abs_error=float(np.abs(self.errors[-length:]).mean()),
                terminated=terminated,
                truncated=truncated,
                seconds=self.seconds,
                simulator_lost=lost,
            )
        )
