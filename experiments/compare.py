"""The comparison: every agent, over the same seeds and env steps, each through a socket pair."""

import json
import platform
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from multiprocessing import current_process
from pathlib import Path
from typing import Any, Final

from joblib import Parallel, cpu_count, delayed
from joblib.externals.loky import get_reusable_executor

from ..agents import preset
from ..agents.checkpoints import software_versions, write_whole
from ..agents.pid import PID
from ..agents.policies import NetworkPolicy
from ..envs import ElevationConfig
from ..models import model_hash
from ..models.constants import PHYSICS_TIMESTEP
from .errors import RunsFailed
from .evaluate import Flight, evaluation_row, fly_episodes
from .pairs import socket_pair
from .progress import OnProgress, ProgressListener, ProgressSender
from .records import CONFIG_FILE, RecordsError, read_config
from .training import Run, Training
from .writing import RunRecord, episode_row, flight_steps, join_parts, training_steps

__all__ = ["PARTS", "CompareConfig", "compare", "read_compare_config"]

AGENTS: Final = ("vpg", "a2c", "sb3-a2c")
PARTS: Final = "parts"
"""Folder of what the runs of an unfinished comparison left behind."""


@dataclass(frozen=True, kw_only=True)
class CompareConfig:
    """What is compared."""

    agents: tuple[str, ...] = AGENTS
    """Agents to train. The PID is always evaluated beside them, where the env allows it."""
    seeds: int = 5
    """Seeds 0 ... seeds - 1, the same for every agent."""
    env_steps: int = 200_000
    """Env steps of each training."""
    preset: str = "tuned"
    """`paper` or `tuned`."""
    env: ElevationConfig
    """The task."""
    snapshots: int = 10
    """Policies kept during each training, for the learning curves."""
    curve_episodes: int = 10
    """Evaluation episodes of each of them."""
    episodes: int = 20
    """Evaluation episodes of the final policies."""
    jobs: int | None = None
    """Runs at a time; None: one for each core."""

    def __post_init__(self) -> None:
        for name in ("seeds", "env_steps", "snapshots", "curve_episodes", "episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if self.jobs is not None and self.jobs < 1:
            raise ValueError(f"jobs: expected at least 1, got {self.jobs}")
        if not self.agents:
            raise ValueError("agents: expected at least one")
        if len(set(self.agents)) != len(self.agents):
            raise ValueError(f"agents: expected each once, got {', '.join(self.agents)}")
        self.runs()  # wrong names and numbers are told before anything is trained

    def runs(self) -> list[Run]:
        """Every training, in the order in which they start: SB3's first, which take longest."""
        return [
            Run(
                algorithm=agent,
                config=preset(agent, self.preset),
                env=self.env,
                seed=seed,
                env_steps=self.env_steps,
            )
            for agent in sorted(self.agents, key=lambda agent: agent != "sb3-a2c")
            for seed in range(self.seeds)
        ]


def compare(config: CompareConfig, folder: Path, command: str, on_progress: OnProgress) -> None:
    """Train and evaluate everything, and write the records into `folder`.

    Each run leaves a part behind when it is done, so that a comparison that was interrupted, or of
    which a run failed, goes on where it was: call it again with the same folder (and the config of
    `read_compare_config`). Figures, table and verdicts are drawn from the joined parts: see
    `report.write_report`.

    Raises:
        RunsFailed: Some runs failed; the others are done, and their parts kept.
    """
    parts = folder / PARTS
    parts.mkdir(parents=True, exist_ok=True)
    if not (folder / CONFIG_FILE).exists():
        _write_config(config, folder, command)
    for unfinished in parts.glob(".*"):
        shutil.rmtree(unfinished)
    with ProgressListener(on_progress) as listener:
        work = [
            delayed(_run)(run, config, folder, listener.port)
            for run in config.runs()
            if not (parts / f"{run.algorithm}-seed{run.seed}").exists()
        ]
        if _pid_flies(config.env) and not (parts / "pid-seed0").exists():
            work.append(delayed(_fly_pid)(config, folder, listener.port))
        failures = [sentence for sentence in _in_parallel(work, config.jobs) if sentence]
    if failures:
        raise RunsFailed(f"{len(failures)} of {len(work)} runs failed: {'; '.join(failures)}")
    join_parts(parts, folder)


def _in_parallel(work: list[Any], jobs: int | None) -> Iterator[str]:
    parallel = Parallel(n_jobs=jobs or cpu_count(), return_as="generator_unordered")
    try:
        yield from parallel(work)
    except BaseException:
        # Their simulators end with the workers.
        get_reusable_executor().shutdown(wait=False, kill_workers=True)
        raise


def _run(run: Run, config: CompareConfig, folder: Path, port: int) -> str:
    """Train and evaluate one agent on one seed; why it failed, or "" (in a worker process)."""
    with ProgressSender(f"{run.algorithm} seed {run.seed}", port) as progress:
        return _part(folder, progress, lambda: _train(run, config, folder, progress))


def _fly_pid(config: CompareConfig, folder: Path, port: int) -> str:
    """Evaluate the PID, which needs no training and has no seeds (in a worker process)."""
    with ProgressSender("pid", port) as progress:
        return _part(folder, progress, lambda: _evaluate_pid(config))


def _part(folder: Path, progress: ProgressSender, run: Callable[[], RunRecord]) -> str:
    if current_process().name != "MainProcess":  # one job at a time runs in this one
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's affair
    try:
        run().write(folder / PARTS)
    except Exception as error:
        progress(0, 1, "failed")
        return f"{progress.name}: {type(error).__name__}: {error}"
    progress(1, 1, "done")
    return ""


def _train(run: Run, config: CompareConfig, folder: Path, progress: ProgressSender) -> RunRecord:
    with socket_pair(run.env) as env:
        training = Training(run, env, snapshots=config.snapshots)

        def on_update() -> bool:
            progress.rarely(training.progress)
            return True

        training.train(on_update)
        training.store(folder / "checkpoints" / f"{run.algorithm}-seed{run.seed}.safetensors")
        seconds = training.log.seconds
        progress(run.env_steps, run.env_steps, "evaluating")
        rows, flights = _evaluate(training, config, env)
    log = training.log
    return RunRecord(
        agent=run.algorithm,
        seed=run.seed,
        episodes=[episode_row(episode) for episode in log.episodes],
        evaluations=rows,
        runs=[
            {
                "env_steps": log.env_steps,
                "seconds": seconds,
                "steps_per_second": log.env_steps / seconds,
            }
        ],
        steps=[training_steps(run.algorithm, log), *flight_steps(run.algorithm, run.seed, flights)],
    )


def _evaluate(
    training: Training, config: CompareConfig, env: Any
) -> tuple[list[dict[str, Any]], list[Flight]]:
    rows: list[dict[str, Any]] = []
    flights: list[Flight] = []
    for snapshot in training.taken:
        final = snapshot is training.taken[-1]
        count = config.episodes if final else config.curve_episodes
        flights = fly_episodes(env, NetworkPolicy(snapshot.actor), count)
        behind = {"env_steps": snapshot.env_steps, "seconds": snapshot.seconds}
        rows += [
            {**behind, **evaluation_row(flight, episode, config.env.control_period)}
            for episode, flight in enumerate(flights)
        ]
    return rows, flights


def _evaluate_pid(config: CompareConfig) -> RunRecord:
    with socket_pair(config.env) as env:
        flights = fly_episodes(env, PID(config.env), config.episodes)
    behind = {"env_steps": 0, "seconds": 0.0}
    return RunRecord(
        agent="pid",
        seed=0,
        episodes=[],
        evaluations=[
            {**behind, **evaluation_row(flight, episode, config.env.control_period)}
            for episode, flight in enumerate(flights)
        ],
        runs=[],
        steps=flight_steps("pid", 0, flights),
    )


def _pid_flies(env: ElevationConfig) -> bool:
    try:
        PID(env)
    except ValueError:
        return False
    return True


def read_compare_config(folder: Path) -> CompareConfig:
    """What a comparison was to compare, from its `config.json`. Raises `RecordsError`."""
    content = read_config(folder)
    try:
        options = {k: v for k, v in content["env"].items() if k != "physics_timestep"}
        return CompareConfig(
            agents=tuple(content["agents"]),
            seeds=len(content["seeds"]),
            env_steps=content["env_steps"],
            preset=content["preset"],
            env=ElevationConfig.from_options(options),
            **content["evaluation"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RecordsError(f"{folder / CONFIG_FILE}: expected a comparison's: {error!r}") from None


def _write_config(config: CompareConfig, folder: Path, command: str) -> None:
    content = {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "preset": config.preset,
        "seeds": list(range(config.seeds)),
        "env_steps": config.env_steps,
        "env": {**asdict(config.env), "physics_timestep": PHYSICS_TIMESTEP},
        "agents": {agent: asdict(preset(agent, config.preset)) for agent in config.agents},
        "evaluation": {
            "snapshots": config.snapshots,
            "curve_episodes": config.curve_episodes,
            "episodes": config.episodes,
        },
        "versions": software_versions(),
        "model_hash": model_hash(config.env.linear_drag),
        "machine": {
            "platform": platform.platform(),
            "processor": platform.machine(),
            "cores": cpu_count(),
        },
    }
    write_whole(folder / CONFIG_FILE, (json.dumps(content, indent=2) + "\n").encode())
