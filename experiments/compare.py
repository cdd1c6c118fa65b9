"""The comparison: every agent, over the same seeds and env steps, each through a socket pair."""

import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from multiprocessing import Manager
from pathlib import Path
from threading import Thread
from typing import Any, Final

from joblib import Parallel, delayed

from ..agents import preset
from ..agents.checkpoints import software_versions
from ..agents.pid import PID
from ..agents.policies import NetworkPolicy
from ..envs import ElevationConfig
from ..models.constants import PHYSICS_TIMESTEP
from .evaluate import Flight, evaluation_row, fly_episodes
from .pairs import socket_pair
from .records import CONFIG_FILE
from .training import Run, Training
from .writing import RecordWriter, RunRecord, episode_row, flight_steps, training_steps

__all__ = ["CompareConfig", "OnProgress", "compare"]

AGENTS: Final = ("vpg", "a2c", "sb3-a2c")


@dataclass(frozen=True, kw_only=True)
class CompareConfig:
    """What is compared."""

    agents: tuple[str, ...] = AGENTS
    """Agents to train. The PID is always evaluated beside them, where the env allows it."""
    seeds: int = 3
    """Seeds 0 ... seeds - 1, the same for every agent."""
    env_steps: int = 100_000
    """Env steps of each training."""
    preset: str = "tuned"
    """`paper` or `tuned`."""
    env: ElevationConfig
    """The task."""
    snapshots: int = 10
    """Policies kept during each training, for the learning curves."""
    curve_episodes: int = 5
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
        for agent in self.agents:
            preset(agent, self.preset)
        if len(set(self.agents)) != len(self.agents):
            raise ValueError(f"agents: expected each once, got {', '.join(self.agents)}")

    def runs(self) -> list[Run]:
        """Every training, in the order in which they start: all agents of a seed together."""
        return [
            Run(
                algorithm=agent,
                config=preset(agent, self.preset),
                env=self.env,
                seed=seed,
                env_steps=self.env_steps,
            )
            for seed in range(self.seeds)
            for agent in self.agents
        ]


OnProgress = Callable[[str, int, int, str], None]
"""Called with a run's name, what is done, what there is to do, and a word on how it goes."""


def compare(config: CompareConfig, folder: Path, command: str, on_progress: OnProgress) -> None:
    """Train and evaluate everything, and write the records into `folder`, which is made.

    Figures, table and verdicts are drawn from these files: see `report.write_report`.
    """
    folder.mkdir(parents=True)
    writer = RecordWriter(folder)
    jobs = config.jobs or os.cpu_count() or 1
    with Manager() as manager:
        queue = manager.Queue()
        work = [delayed(_run)(run, config, folder, queue) for run in config.runs()]
        if _pid_flies(config.env):
            work.append(delayed(_fly_pid)(config, queue))
        parallel = Parallel(n_jobs=jobs, return_as="generator_unordered", pre_dispatch="all")
        results = parallel(work)
        with _Listener(queue, on_progress):
            for result in results:
                writer.add(result)
    writer.finish()
    _write_config(config, folder, command, writer.model_hash)


def _run(run: Run, config: CompareConfig, folder: Path, queue: Any) -> RunRecord:
    """Train one agent on one seed, then evaluate its snapshots (in a worker process)."""
    name = f"{run.algorithm} seed {run.seed}"
    last = 0.0
    with socket_pair(run.env) as env:
        training = Training(run, env, snapshots=config.snapshots)

        def report() -> bool:
            nonlocal last
            now = time.monotonic()
            if now - last > 0.2:
                last = now
                state = training.progress()
                queue.put((name, state.env_steps, state.total, state.words()))
            return True

        training.train(report)
        training.store(folder / "checkpoints" / f"{run.algorithm}-seed{run.seed}.safetensors")
        seconds = training.log.seconds
        queue.put((name, run.env_steps, run.env_steps, "evaluating"))
        rows, flights = _evaluate(training, config, env)
        assert env.hello is not None
        model_hash = env.hello.model_hash
    queue.put((name, run.env_steps, run.env_steps, "done"))
    log = training.log
    return RunRecord(
        agent=run.algorithm,
        seed=run.seed,
        episodes=[episode_row(episode) for episode in log.episodes],
        evaluations=rows,
        run={
            "env_steps": log.env_steps,
            "seconds": seconds,
            "steps_per_second": log.env_steps / seconds,
        },
        steps=[training_steps(run.algorithm, log), *flight_steps(run.algorithm, run.seed, flights)],
        model_hash=model_hash,
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


def _fly_pid(config: CompareConfig, queue: Any) -> RunRecord:
    """Evaluate the PID, which needs no training and has no seeds."""
    with socket_pair(config.env) as env:
        flights = fly_episodes(env, PID(config.env), config.episodes)
        assert env.hello is not None
        model_hash = env.hello.model_hash
    queue.put(("pid", 1, 1, "done"))
    behind = {"env_steps": 0, "seconds": 0.0}
    return RunRecord(
        agent="pid",
        seed=0,
        episodes=[],
        evaluations=[
            {**behind, **evaluation_row(flight, episode, config.env.control_period)}
            for episode, flight in enumerate(flights)
        ],
        run=None,
        steps=flight_steps("pid", 0, flights),
        model_hash=model_hash,
    )


class _Listener:
    """Hands on what the workers put into the queue, while results are waited for."""

    def __init__(self, queue: Any, on_progress: OnProgress) -> None:
        self._queue = queue
        self._on_progress = on_progress
        self._thread = Thread(target=self._listen, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._queue.put(None)
        self._thread.join()

    def _listen(self) -> None:
        while (item := self._queue.get()) is not None:
            self._on_progress(*item)


def _pid_flies(env: ElevationConfig) -> bool:
    try:
        PID(env)
    except ValueError:
        return False
    return True


def _write_config(config: CompareConfig, folder: Path, command: str, model_hash: str) -> None:
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
        "model_hash": model_hash,
        "machine": {
            "platform": platform.platform(),
            "processor": platform.machine(),
            "cores": os.cpu_count(),
        },
    }
    (folder / CONFIG_FILE).write_text(json.dumps(content, indent=2) + "\n")
