"""The comparison: every agent, over the same seeds and env steps, each through a socket pair."""

import json
import logging
import platform
import shutil
import signal
import socket
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from importlib import import_module
from itertools import islice
from multiprocessing import current_process
from pathlib import Path
from typing import Any, Final, Literal

from joblib import Parallel, cpu_count, delayed
from joblib.externals.loky import get_reusable_executor

from ..agents import preset
from ..agents.checkpoints import Checkpoint, software_versions, store, write_whole
from ..agents.episodes import EpisodeLog
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

__all__ = ["PARTS", "Backend", "CompareConfig", "compare", "read_compare_config"]

Backend = Literal["loky", "ray"]
"""What flies the runs: the cores of this machine, or a Ray cluster."""

AGENTS: Final = ("vpg", "a2c", "sb3-a2c")
PARTS: Final = "parts"
"""Folder of what the runs of an unfinished comparison left behind."""
_KNOCK_TIMEOUT: Final = 5.0  # s


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
    """Runs at a time; None: one for each core of the machine or of the cluster."""
    backend: Backend = "loky"
    """`loky`: processes of this machine. `ray`: a Ray cluster."""
    address: str | None = None
    """The cluster's: `ray://HOST:PORT` of its client server from anywhere, `HOST:PORT` or None on
    one of its machines."""

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
        if self.backend not in ("loky", "ray"):
            raise ValueError(f"backend: expected loky or ray, got {self.backend}")
        if self.address is not None and self.backend != "ray":
            raise ValueError(f"address: expected it with backend ray, got it with {self.backend}")
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


@dataclass(frozen=True, kw_only=True)
class _Job:
    """One run, for whatever worker is free, on this machine or another."""

    run: Run | None
    """What to train; None: the PID, which needs no training and has no seeds."""
    config: CompareConfig
    home: tuple[str, int]
    """Of the `ProgressListener`."""
    versions: dict[str, str]
    """Software of the main process."""

    @property
    def name(self) -> str:
        """What the run is called."""
        return f"{self.run.algorithm} seed {self.run.seed}" if self.run else "pid"

    @property
    def part(self) -> str:
        """What its part is called."""
        return f"{self.run.algorithm}-seed{self.run.seed}" if self.run else "pid-seed0"


@dataclass(frozen=True, kw_only=True)
class _Result:
    """What a run brings home, for its worker may share no folder with the main process."""

    job: _Job
    failure: str = ""
    """A sentence; empty if the run is done."""
    record: RunRecord | None = None
    checkpoint: Checkpoint | None = None

    def write(self, folder: Path) -> None:
        """Write checkpoint and part; the part last, for with it the run is done."""
        if self.checkpoint:
            store(self.checkpoint, folder / "checkpoints" / f"{self.job.part}.safetensors")
        if self.record:
            self.record.write(folder / PARTS)


_Workers = Callable[[list[_Job]], Generator[_Result, None, None]]
"""Fly jobs, as many at a time as there are workers, and give results as they come. To be closed:
what still flies then is ended, with its simulators."""


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
    with _workers(config) as fly, ProgressListener(on_progress) as listener:
        parts.mkdir(parents=True, exist_ok=True)
        if not (folder / CONFIG_FILE).exists():
            _write_config(config, folder, command)
        for unfinished in parts.glob(".*"):
            shutil.rmtree(unfinished)
        jobs = [
            _Job(run=run, config=config, home=listener.home, versions=software_versions())
            for run in (*config.runs(), *([None] if _pid_flies(config.env) else []))
        ]
        jobs = [job for job in jobs if not (parts / job.part).exists()]
        with closing(fly(jobs)) as results:
            failures = list(_write_results(results, folder, len(jobs), listener))
    if failures:
        raise RunsFailed(f"{len(failures)} of {len(jobs)} runs failed: {'; '.join(failures)}")
    join_parts(parts, folder)


def _write_results(
    results: Iterator[_Result], folder: Path, count: int, listener: ProgressListener
) -> Iterator[str]:
    """Write each as it comes; the failures. Of runs elsewhere this is all the progress told."""
    listener.tell("all runs", 0, count, "")
    for done, result in enumerate(results, 1):
        if result.failure:
            listener.tell(result.job.name, 0, 1, "failed")
            yield result.failure
        else:
            result.write(folder)
            listener.tell(result.job.name, 1, 1, "done")
        listener.tell("all runs", done, count, "")


def _workers(config: CompareConfig) -> AbstractContextManager[_Workers]:
    if config.backend == "ray":
        return _ray(config)
    return nullcontext(partial(_fly_by_loky, workers=config.jobs or cpu_count()))


def _fly_by_loky(jobs: list[_Job], workers: int) -> Generator[_Result, None, None]:
    parallel = Parallel(n_jobs=workers, return_as="generator_unordered")
    results = parallel(delayed(_fly)(job) for job in jobs)
    try:
        # `yield from` would close it without the care below.
        for result in results:  # noqa: UP028
            yield result
    except BaseException:
        # Their simulators end with the workers.
        get_reusable_executor().shutdown(wait=False, kill_workers=True)
        with warnings.catch_warnings(action="ignore"):  # that runs are cut short is what we want
            results.close()
        raise


@contextmanager
def _ray(config: CompareConfig) -> Iterator[_Workers]:
    """Connect to the cluster. Raises `ValueError`."""
    try:
        ray: Any = import_module("ray")
    except ImportError:
        raise ValueError(
            "backend: expected Ray to be installed (pip install 'rotorgram[ray]'), got none"
        ) from None
    address = config.address or "auto"
    try:
        _knock(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        words = str(getattr(error, "strerror", None) or error).rpartition("Error: ")[2]
        reason = " ".join(words.split())  # without the traceback of the client server
        raise ValueError(f"address: expected a Ray cluster at {address}, got: {reason}") from None
    try:
        cores = int(ray.cluster_resources().get("CPU", 0))  # 0: it starts machines when asked to
        yield partial(_fly_by_ray, ray=ray, workers=config.jobs or max(cores, 1))
    finally:
        ray.shutdown()


def _knock(address: str) -> None:
    """Whether anybody listens: Ray itself takes minutes to find out that nobody does."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host, int(port)), _KNOCK_TIMEOUT).close()


def _fly_by_ray(jobs: list[_Job], workers: int, ray: Any) -> Generator[_Result, None, None]:
    # Ray's own backend for joblib gives results when all are there, so that an interrupted
    # comparison would lose every run; and it deals runs out in turn, to workers that are busy.
    task = ray.remote(num_cpus=1)(_fly)
    waiting = iter(jobs)
    flying: dict[Any, _Job] = {}
    try:
        while True:
            flying |= {task.remote(job): job for job in islice(waiting, workers - len(flying))}
            if not flying:
                return
            (landed,), _ = ray.wait(list(flying))
            job = flying.pop(landed)
            try:
                result = ray.get(landed)
            except ray.exceptions.RayError as error:  # its machine is lost, or has no rotorgram
                reason = str(error).strip().splitlines()[-1]
                result = _Result(job=job, failure=f"{job.name}: {reason}")
            yield result
    finally:
        for reference in flying:  # their simulators end with them
            ray.cancel(reference, force=True)


def _fly(job: _Job) -> _Result:
    """Train and evaluate (in a worker process)."""
    if current_process().name != "MainProcess":  # but one of loky's, with our terminal
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the main process's affair
    try:
        _check_software(job.versions)
        if job.run is None:
            return _Result(job=job, record=_evaluate_pid(job.config))
        with ProgressSender(job.name, job.home) as progress:
            record, checkpoint = _train(job.run, job.config, progress)
        return _Result(job=job, record=record, checkpoint=checkpoint)
    except Exception as error:
        return _Result(job=job, failure=f"{job.name}: {type(error).__name__}: {error}")


def _check_software(expected: dict[str, str]) -> None:
    """The comparison's config tells one version of each."""
    for name, here in software_versions().items():
        if here != expected[name]:
            raise ValueError(
                f"{name}: expected version {expected[name]} as on the machine of the comparison, "
                f"got {here} on {socket.gethostname()}"
            )


def _train(
    run: Run, config: CompareConfig, progress: ProgressSender
) -> tuple[RunRecord, Checkpoint]:
    with socket_pair(run.env) as env:
        training = Training(run, env, snapshots=config.snapshots)

        def on_update() -> bool:
            progress.rarely(training.progress)
            return True

        training.train(on_update)
        checkpoint = training.checkpoint()
        seconds = training.log.seconds
        progress(run.env_steps, run.env_steps, "evaluating")
        rows, flights = _evaluate(training, config, env)
    log = training.log
    assert isinstance(log, EpisodeLog)  # of one drone
    record = RunRecord(
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
