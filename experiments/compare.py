"""The comparison: every agent, over the same seeds and env steps, each through a socket pair."""

import shutil
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from ..agents import preset
from ..agents.checkpoints import Checkpoint, store
from ..agents.episodes import EpisodeLog
from ..agents.pid import PID
from ..agents.policies import NetworkPolicy
from ..envs import ElevationConfig
from .evaluate import Flight, evaluation_row, fly_episodes
from .pairs import socket_pair
from .progress import OnProgress, ProgressSender
from .records import CONFIG_FILE, RecordsError, read_config
from .runs import config_env, train_run, write_config
from .training import Run, Training
from .workers import WorkersConfig, open_workers
from .writing import RunRecord, episode_row, flight_steps, join_parts, training_steps

__all__ = ["PARTS", "CompareConfig", "compare", "read_compare_config"]

AGENTS: Final = ("vpg", "a2c", "sb3-a2c")
PARTS: Final = "parts"
"""Folder of what the runs of an unfinished comparison left behind."""


@dataclass(frozen=True, kw_only=True)
class CompareConfig(WorkersConfig):
    """What is compared, and who flies it."""

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

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("seeds", "env_steps", "snapshots", "curve_episodes", "episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
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
        ValueError: There is no Ray, or no such cluster; nothing is written.
    """
    parts = folder / PARTS
    with open_workers(config, on_progress) as workers:
        parts.mkdir(parents=True, exist_ok=True)
        _write_config(config, folder, command)
        for unfinished in parts.glob(".*"):
            shutil.rmtree(unfinished)
        runs: list[Run | None] = [*config.runs(), *([None] if _pid_flies(config.env) else [])]
        jobs = {_name(run): run for run in runs if not (parts / _part(run)).exists()}
        workers.fly_all(partial(_fly, config), jobs, partial(_keep, folder))
    join_parts(parts, folder)


def _name(run: Run | None) -> str:
    """What a run is called; None: the PID, which needs no training and has no seeds."""
    return f"{run.algorithm} seed {run.seed}" if run else "pid"


def _part(run: Run | None) -> str:
    """What its part is called."""
    return f"{run.algorithm}-seed{run.seed}" if run else "pid-seed0"


def _keep(folder: Path, run: Run | None, flown: tuple[RunRecord, Checkpoint | None]) -> None:
    """Write checkpoint and part; the part last, for with it the run is done."""
    record, checkpoint = flown
    if checkpoint:
        store(checkpoint, folder / "checkpoints" / f"{_part(run)}.safetensors")
    record.write(folder / PARTS)


def _fly(
    config: CompareConfig, run: Run | None, progress: ProgressSender
) -> tuple[RunRecord, Checkpoint | None]:
    """Train and evaluate (in a worker process)."""
    if run is None:
        return _evaluate_pid(config), None
    return _train(run, config, progress)


def _train(
    run: Run, config: CompareConfig, progress: ProgressSender
) -> tuple[RunRecord, Checkpoint]:
    with socket_pair(run.env) as env:
        training, row = train_run(run, env, progress, config.snapshots)
        checkpoint = training.checkpoint()
        rows, flights = _evaluate(training, config, env)
    log = training.log
    assert isinstance(log, EpisodeLog)  # of one drone
    record = RunRecord(
        agent=run.algorithm,
        seed=run.seed,
        episodes=[episode_row(episode) for episode in log.episodes],
        evaluations=rows,
        runs=[row],
        steps=[training_steps(run.algorithm, log), *flight_steps(run.algorithm, run.seed, flights)],
    )
    return record, checkpoint


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
        return CompareConfig(
            agents=tuple(content["agents"]),
            seeds=len(content["seeds"]),
            env_steps=content["env_steps"],
            preset=content["preset"],
            env=config_env(content),
            **content["evaluation"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise RecordsError(f"{folder / CONFIG_FILE}: expected a comparison's: {error!r}") from None


def _write_config(config: CompareConfig, folder: Path, command: str) -> None:
    content = {
        "preset": config.preset,
        "seeds": list(range(config.seeds)),
        "env_steps": config.env_steps,
        "agents": {agent: asdict(preset(agent, config.preset)) for agent in config.agents},
        "evaluation": {
            "snapshots": config.snapshots,
            "curve_episodes": config.curve_episodes,
            "episodes": config.episodes,
        },
    }
    write_config(folder, command, config.env, content)
