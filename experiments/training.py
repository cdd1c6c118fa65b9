"""One training run: an agent, an env, a seed; with snapshots, checkpoints and a way to stop."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from ..agents import A2CConfig, VPGConfig, make_agent, preset
from ..agents.checkpoints import Checkpoint, CheckpointError, store
from ..agents.episodes import Episode, EpisodeLog, ResumeError
from ..agents.learner import AnyLog
from ..agents.vector_episodes import VectorEpisodeLog
from ..envs import ElevationConfig
from ..envs.autoreset import AdvancingVectorEnv
from .progress import Progress

__all__ = ["AnyEnv", "Run", "Snapshot", "Training", "is_finished"]

AnyEnv = gym.Env[np.ndarray, Any] | AdvancingVectorEnv

# Episodes to average over, or as many as there are drones, if that is more: of those that began
# together the shortest end first, so that the last few to end are those that flew longest.
_RECENT = 20  # in a progress report: it tells how it goes now
_WINDOW = 100  # in a point of a curve: SB3's `stats_window_size`


@dataclass(frozen=True, kw_only=True)
class Run:
    """What is trained: everything that the numbers follow from, but for the software."""

    algorithm: str
    config: VPGConfig | A2CConfig
    env: ElevationConfig
    seed: int
    env_steps: int
    """Of all drones together."""
    num_envs: int = 1
    """Drones that train it at the same time."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {self.seed}")
        if self.num_envs < 1:
            raise ValueError(f"num_envs: expected 1 or more, got {self.num_envs}")
        least = 1
        if isinstance(self.config, A2CConfig):
            least = self.config.rollout_size(self.num_envs)
        elif self.num_envs > 1:  # a whole episode of each
            least = self.num_envs * self.env.episode_length
        if self.env_steps < least:
            raise ValueError(f"env_steps: expected at least {least}, got {self.env_steps}")


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """The policy after part of the training."""

    env_steps: int
    seconds: float
    actor: dict[str, np.ndarray]


def is_finished(kept: Checkpoint) -> bool:
    """Whether a training has flown all that it was to. SB3 flies whole rollouts only."""
    least = 1
    if kept.algorithm == "sb3-a2c":
        least = A2CConfig(**kept.config).rollout_size(kept.num_envs)
    return kept.env_steps - kept.position.env_steps < least


@dataclass
class Training:
    """A run on an env, to be started, stopped, stored and resumed at update boundaries.

    Args:
        run: What to train.
        env: Local or remote, a vector env where the run has many drones; not closed here.
        snapshots: How many times, evenly spread, the policy is kept for later evaluation, besides
            the untrained one.
    """

    run: Run
    env: AnyEnv
    snapshots: int = 0
    taken: list[Snapshot] = field(default_factory=list)

    def __post_init__(self) -> None:
        # Networks of 16 units: a second thread costs more than it brings.
        torch.set_num_threads(1)
        drones = getattr(self.env, "num_envs", 1)
        if drones != self.run.num_envs:
            raise ValueError(f"env: expected one of {self.run.num_envs} drones, got {drones}")
        self.log: AnyLog
        if isinstance(self.env, AdvancingVectorEnv):
            self.log = VectorEpisodeLog(self.env, self.run.seed)
        else:
            self.log = EpisodeLog(self.env, self.run.seed)
        self.agent = make_agent(self.run.algorithm, self.log, self.run.config, self.run.seed)

    @classmethod
    def resume(cls, kept: Checkpoint, env: AnyEnv, episodes: list[Episode]) -> "Training":
        """Go on from a checkpoint. `episodes` are those that ended before it.

        Raises:
            CheckpointError: The checkpoint's parts do not fit together.
            ResumeError: The env does not repeat the episode that was interrupted.
        """
        try:
            run = Run(
                algorithm=kept.algorithm,
                config=preset(kept.algorithm, "paper", **kept.config),
                env=ElevationConfig.from_options(kept.env),
                seed=kept.seed,
                env_steps=kept.env_steps,
                num_envs=kept.num_envs,
            )
            training = cls(run, env)
            training.agent.set_state(kept.state)
        except (KeyError, TypeError, ValueError, RuntimeError, IndexError) as error:
            reason = " ".join(f"{error!r:.300}".split())
            raise CheckpointError(f"checkpoint: its parts do not fit together: {reason}") from None
        hello = getattr(env, "hello", None)
        if kept.model_hash and hello and hello.model_hash != kept.model_hash:
            raise ResumeError(
                f"resume: expected a simulator of the model {kept.model_hash}, "
                f"got one of {hello.model_hash}"
            )
        training.log.resume(kept.position, episodes)
        return training

    def train(self, on_update: Callable[[], bool] = lambda: True) -> bool:
        """Train to the end, or until `on_update` returns False. Whether the end was reached."""
        self.log.start_clock()
        if self.snapshots:
            self._take()

        def after_update() -> bool:
            if self.snapshots and self._due():
                self._take()
            return on_update()

        self.agent.train(self.log, self.run.env_steps, after_update)
        if self.snapshots and self.taken[-1].env_steps < self.log.env_steps:
            self._take()
        return self.log.env_steps >= self.agent.last_step(self.run.env_steps)

    def progress(self) -> Progress:
        """Where the training stands."""
        recent = self.log.episodes[-max(_RECENT, self.run.num_envs) :]
        return Progress(
            env_steps=self.log.env_steps,
            total=self.run.env_steps,
            seconds=self.log.seconds,
            mean_return=float(np.mean([e.total_reward for e in recent])) if recent else np.nan,
            mean_abs_error=float(np.mean([e.mean_abs_error for e in recent])) if recent else np.nan,
        )

    def scalars(self) -> dict[str, float]:
        """Where the training stands, in numbers for TensorBoard, by the names that SB3 gives them.

        To be asked for at an update. `docs/algorithms/README.md` has the table. What is not defined
        yet, or not finite, is left out.
        """
        log = self.log
        numbers = {
            "time/total_timesteps": float(log.env_steps),
            "time/fps": log.env_steps / log.seconds if log.seconds else np.nan,
            **self.agent.scalars(),
        }
        if recent := log.episodes[-max(_WINDOW, self.run.num_envs) :]:
            numbers["rollout/ep_rew_mean"] = float(np.mean([e.total_reward for e in recent]))
            numbers["rollout/ep_len_mean"] = float(np.mean([e.length for e in recent]))
            numbers["rollout/ep_error_mean"] = float(np.mean([e.mean_abs_error for e in recent]))
        if (statistics := getattr(self.env, "statistics", None)) is not None:
            numbers |= {f"wire/{name}": value for name, value in statistics.numbers().items()}
        return {name: value for name, value in numbers.items() if np.isfinite(value)}

    def checkpoint(self) -> Checkpoint:
        """Everything that resuming needs. To be taken at an update."""
        hello = getattr(self.env, "hello", None)
        return Checkpoint(
            algorithm=self.run.algorithm,
            config=asdict(self.run.config),
            env=asdict(self.run.env),
            seed=self.run.seed,
            env_steps=self.run.env_steps,
            num_envs=self.run.num_envs,
            model_hash=hello.model_hash if hello else "",
            actor=self.agent.actor(),
            state=self.agent.state(),
            position=self.log.position(),
        )

    def store(self, path: Path) -> None:
        """Write a checkpoint."""
        store(self.checkpoint(), path)

    def _due(self) -> bool:
        return self.log.env_steps * self.snapshots >= len(self.taken) * self.run.env_steps

    def _take(self) -> None:
        self.taken.append(
            Snapshot(
                env_steps=self.log.env_steps, seconds=self.log.seconds, actor=self.agent.actor()
            )
        )
