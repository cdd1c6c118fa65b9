"""One training run: an agent, an env, a seed; with snapshots, checkpoints and a way to stop."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .. import agents
from ..agents import Checkpoint
from ..envs.autoreset import AdvancingVectorEnv
from ..envs.config import BackendConfig, EnvConfig
from ..envs.registry import is_known
from ..envs.spec import EnvSpec
from ..models import BACKENDS, Backend
from ..models.errors import InputError
from ..models.fields import immutable
from .settings import Run

if TYPE_CHECKING:
    from ..flights.executors import Tell

_TELL_EVERY = 0.2  # s


def config_of(spec: EnvSpec, backend: Backend | None, vehicle: str | None = None) -> EnvConfig:
    """The config of a simulator's env, as far as its spec has it. Raises `InputError`."""
    options = spec.options if is_known(spec.env_id) else {"task": spec.options}
    return EnvConfig.from_keywords(
        spec.env_id, drones=len(spec.agents), backend=backend, vehicle=vehicle, **options
    )


@immutable
class Snapshot:
    """The policy after part of the training."""

    env_steps: int
    seconds: float
    policy: agents.Policy


def is_finished(kept: Checkpoint) -> bool:
    """Whether a training has flown all its env steps. Raises `ResumeError` for a policy alone."""
    kept.check_resumable()
    left = kept.env_steps - kept.position.env_steps
    return left < _least_flown(kept.algorithm, kept.hyperparameters, kept.num_envs)


def _least_flown(algorithm: str, config: agents.Config, num_envs: int) -> int:
    """Env steps that a training flies at least: SB3 flies whole rollouts only."""
    if agents.find_algorithm(algorithm).resumes:
        return 1
    return config.least_steps(num_envs, 1)


@dataclass
class Training:
    """A run on an env, to be started, stopped and resumed at update boundaries.

    The env is a local or remote vector env, and not closed here.
    Besides the untrained policy, `snapshots` policies are kept in `taken` for later evaluation,
    evenly spread. With `keep_steps` every step is kept, for `log.steps()`. A run that goes on does
    so from the checkpoint `kept`.
    """

    run: Run
    env: AdvancingVectorEnv
    snapshots: int = 0
    keep_steps: bool = False
    kept: Checkpoint | None = None

    def __post_init__(self) -> None:
        run = self.run
        if self.env.num_envs != run.num_envs:
            raise InputError(f"env: expected one of {run.num_envs} drones, got {self.env.num_envs}")
        self.taken: list[Snapshot] = []
        self.log = agents.EpisodeRecorder(self.env, run.seed, keep_steps=self.keep_steps)
        if self.kept:
            self.agent = agents.resume_agent(self.kept, self.log)
        else:
            self.agent = agents.make_agent(run.algorithm, self.log, run.config, run.seed)

    @classmethod
    def resume(cls, kept: Checkpoint, env: AdvancingVectorEnv) -> "Training":
        """Go on from a checkpoint. Raises what `agents.resume_agent` raises."""
        kept.check_resumable()
        run = Run(
            env=kept.env or config_of(kept.spec, kept.backend),
            algorithm=kept.algorithm,
            config=kept.hyperparameters,
            seed=kept.seed,
            env_steps=kept.env_steps,
            num_envs=kept.num_envs,
        )
        return cls(run, env, kept=kept)

    @cached_property
    def env_config(self) -> EnvConfig | None:
        """The resolved config of the env: `run.env`, on the backend of the simulator that came.

        None where the simulator has another config, or none of ours.
        """
        config = self.run.env
        digest = self.log.spec.config_digest
        if not (digest and is_known(config.env_id)):
            return None
        others = [replace(config, backend=BackendConfig(name=name)) for name in BACKENDS]
        for tried in (config, *others):
            with suppress(InputError):  # the vehicle's file may be the simulator's alone
                resolved = tried.resolve()
                if resolved.digest == digest:
                    return resolved
        return None

    def train(
        self, on_update: Callable[[], bool] = lambda: True, tell: "Tell" = lambda *_: None
    ) -> bool:
        """Train to the end, or until `on_update` returns False. Whether the end was reached.

        Progress is told at updates, five times a second at most, and at the end.
        """
        log = self.log
        total = self.run.env_steps
        told = 0.0

        def after_update() -> bool:
            nonlocal told
            if log.env_steps * self.snapshots >= len(self.taken) * total:
                self._take()
            if time.monotonic() >= told + _TELL_EVERY:
                told = time.monotonic()
                tell(log.env_steps, total, self.words())
            return on_update()

        self._take()
        self.agent.train(log, total, after_update)
        if self.taken and self.taken[-1].env_steps < log.env_steps:
            self._take()
        tell(log.env_steps, total, self.words())
        run = self.run
        return total - log.env_steps < _least_flown(run.algorithm, run.config, run.num_envs)

    def words(self) -> str:
        """Recent return and size of the headline metric, for a progress bar."""
        if not (recent := self._recent_means(20)):
            return ""
        text = f"return {recent['rew']:.0f}"
        headline = self.log.spec.headline
        if headline is None:
            return text
        text += f", |{headline.symbol or headline.name}| {recent['error']:.2f} {headline.unit}"
        return text.rstrip()

    def scalars(self) -> dict[str, float]:
        """Progress of the training, in numbers for TensorBoard, under SB3's names.

        Call it at an update. `docs/algorithms/README.md` has the table. Numbers that are not
        defined yet, or not finite, are left out.
        """
        log = self.log
        numbers = {
            "time/total_timesteps": log.env_steps,
            "time/fps": log.env_steps / log.seconds if log.seconds else np.nan,
            **self.agent.scalars(),
        }
        recent = self._recent_means(100)  # SB3's `stats_window_size`
        numbers |= {f"rollout/ep_{name}_mean": value for name, value in recent.items()}
        if (statistics := getattr(self.env, "statistics", None)) is not None:
            numbers |= {f"wire/{name}": value for name, value in statistics.numbers().items()}
        return {name: value for name, value in numbers.items() if np.isfinite(value)}

    def checkpoint(self) -> Checkpoint:
        """Everything that resuming needs. To be taken at an update."""
        run = self.run
        return Checkpoint(
            algorithm=run.algorithm,
            config=asdict(run.config),
            spec=self.log.spec,
            env=self.env_config,
            backend=(self.env_config or run.env).backend.name,
            seed=run.seed,
            env_steps=run.env_steps,
            actor=self.agent.policy().weights.arrays,
            state=self.agent.state(),
            position=self.log.position(),
        )

    def _recent_means(self, count: int) -> dict[str, float]:
        """Over the last `count` episodes, or one for each drone if that is more: of episodes that
        began together the shortest end first.
        """
        recent = self.log.episodes[-max(count, self.run.num_envs) :]
        if not recent:
            return {}
        rows = [(episode.total_reward, episode.length, episode.mean_size) for episode in recent]
        return dict(zip(("rew", "len", "error"), np.mean(rows, axis=0).tolist(), strict=True))

    def _take(self) -> None:
        log = self.log
        if self.snapshots:
            policy = self.agent.policy()
            taken = Snapshot(env_steps=log.env_steps, seconds=log.seconds, policy=policy)
            self.taken.append(taken)
