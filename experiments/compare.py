"""The comparison: every agent, over the same seeds and env steps, each through a socket pair."""

import shutil
from contextlib import AbstractContextManager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..agents import preset
from ..agents.checkpoints import Checkpoint, store
from ..agents.pid import PID
from ..agents.policies import NetworkPolicy, Policy
from ..envs.loop import Loop
from ..envs.registry import env_spec, options_type
from ..envs.spec import EnvSpec, canonical_id
from ..models.errors import InputError
from ..models.vehicle import Vehicle
from .bounds import elevation_bounds
from .errors import ResultsError
from .folders import locked
from .metrics import Headline
from .pairs import shared_pair
from .progress import OnProgress, ProgressSender
from .results import (
    CONFIG_FILE,
    RunResults,
    episode_row,
    evaluation_row,
    evaluation_steps,
    join_parts,
    read_config,
    step_table,
    write_config,
)
from .settings import CompareConfig, EnvConfig, Run
from .training import Training, train_run
from .trajectories import Trajectory, evaluation_seed, fly_episodes
from .workers import open_workers

__all__ = ["PARTS", "CompareConfig", "compare", "evaluation_pair", "read_compare_config"]

PARTS: Final = "parts"
"""Folder with the parts of an unfinished comparison, one for each run."""
MAX_BATCH: Final = 64
"""Most evaluation episodes that are flown at a time."""


def compare(config: CompareConfig, folder: Path, command: str, on_progress: OnProgress) -> None:
    """Train and evaluate everything, and write the results into `folder`.

    Each run leaves a part behind when it is done, so that a comparison that was interrupted, or of
    which a run failed, goes on where it was: call it again with the same folder (and the config of
    `read_compare_config`). Figures, table and verdicts are drawn from the joined parts: see
    `report.write_report`.

    Args:
        config: Settings of the comparison.
        folder: One that exists, and no other process writes to: see `folders.new_folder`.
        command: The user's command, for `config.json`.
        on_progress: Told how far it is.

    Raises:
        RunsFailed: Some runs failed; the others are done, and their parts kept.
        InputError: The env names no metric, another process writes to the folder, or there is no
            such Ray cluster; nothing is written.
    """
    spec = env_spec(**config.env)
    headline = Headline.of(spec)
    parts = folder / PARTS
    with open_workers(config, on_progress) as workers, locked(folder):
        parts.mkdir(exist_ok=True)
        _write_config(config, spec, folder, command)
        for unfinished in parts.glob(".*"):
            shutil.rmtree(unfinished)
        runs: list[Run | None] = [*config.runs(), *([None] if _pid(spec) else [])]
        jobs = {_name(run): run for run in runs if not (parts / _part(run)).exists()}
        workers.fly_all(partial(_fly, config), jobs, partial(_keep, folder), config)
        join_parts(parts, folder, headline.name)


def _name(run: Run | None) -> str:
    """Name of a run; None: the PID, which needs no training and has no seeds."""
    return f"{run.algorithm} seed {run.seed}" if run else "pid"


def _part(run: Run | None) -> str:
    """Name of its part."""
    return f"{run.algorithm}-seed{run.seed}" if run else "pid-seed0"


def _keep(folder: Path, run: Run | None, done: tuple[RunResults, Checkpoint | None]) -> None:
    """Write checkpoint and part; the part last, for with it the run is done."""
    results, checkpoint = done
    if checkpoint:
        store(checkpoint, folder / "checkpoints" / f"{_part(run)}.safetensors")
    results.write(folder / PARTS)


def _fly(
    config: CompareConfig, run: Run | None, progress: ProgressSender
) -> tuple[RunResults, Checkpoint | None]:
    """Train and evaluate (in a worker process)."""
    if run is None:
        return _evaluate_pid(config), None
    return _train(run, config, progress)


def _train(
    run: Run, config: CompareConfig, progress: ProgressSender
) -> tuple[RunResults, Checkpoint]:
    with shared_pair(**run.env, num_envs=run.num_envs) as env:
        training, row = train_run(run, env, progress, config.snapshots, keep_steps=True)
        checkpoint = training.checkpoint()
    log = training.log
    headline = Headline.of(log.spec)
    rows, trajectories = _evaluate(training, config, headline)
    steps = log.steps()
    steps["step"] = np.arange(1, len(steps["episode"]) + 1)
    training_steps = step_table(
        headline.name, agent=run.algorithm, seed=run.seed, phase="train", **steps
    )
    results = RunResults(
        agent=run.algorithm,
        seed=run.seed,
        metric=headline.name,
        episodes=[episode_row(one, run.num_envs, log.env_steps) for one in log.episodes],
        evaluations=rows,
        runs=[row],
        steps=[
            training_steps,
            *evaluation_steps(run.algorithm, run.seed, headline, trajectories),
        ],
    )
    return results, checkpoint


def evaluation_pair(config: EnvConfig, episodes: int) -> AbstractContextManager[Any]:
    """A remote env that flies that many episodes at a time, or `MAX_BATCH`."""
    return shared_pair(
        config.env_id, config.options, vehicle=config.vehicle, num_envs=min(episodes, MAX_BATCH)
    )


def _evaluate(
    training: Training, config: CompareConfig, headline: Headline
) -> tuple[list[dict[str, Any]], list[Trajectory]]:
    rows: list[dict[str, Any]] = []
    trajectories: list[Trajectory] = []
    *earlier, last = training.taken
    with evaluation_pair(config, max(config.curve_episodes, config.episodes)) as env:
        for snapshot in [*earlier, last]:
            policy = NetworkPolicy(snapshot.actor, training.log.spec)
            if snapshot is last:
                trajectories = flown = fly_episodes(env, policy, config.episodes, "final")
            else:
                flown = fly_episodes(env, policy, config.curve_episodes, "curve")
            behind = {"env_steps": snapshot.env_steps, "seconds": snapshot.seconds}
            rows += [{**behind, **evaluation_row(one, headline)} for one in flown]
    return rows, trajectories


def _evaluate_pid(config: CompareConfig) -> RunResults:
    with evaluation_pair(config, config.episodes) as env:
        policy = _pid(env.env_spec)
        assert policy is not None
        trajectories = fly_episodes(env, policy, config.episodes, "final")
        headline = Headline.of(env.env_spec)
    behind = {"env_steps": 0, "seconds": 0.0}
    return RunResults(
        agent="pid",
        seed=0,
        metric=headline.name,
        episodes=[],
        evaluations=[{**behind, **evaluation_row(one, headline)} for one in trajectories],
        runs=[],
        steps=evaluation_steps("pid", 0, headline, trajectories),
    )


def _pid(spec: EnvSpec) -> Policy | None:
    """The PID, where it can fly the env."""
    try:
        return PID(spec)
    except InputError:
        return None


def _bounds(config: CompareConfig) -> dict[str, float]:
    """Mean returns over the final evaluation's episodes, of the flights of `bounds`."""
    if canonical_id(config.env_id) != "rotorgram/Elevation-v0":
        return {}
    options: Any = options_type(config.env_id).from_options(config.options)
    loop = Loop(config.env_id, config.episodes, vehicle=config.vehicle, options=config.options)
    everyone = np.ones(config.episodes, bool)
    actions = np.zeros((config.episodes, 1), np.float32)
    seeds = [evaluation_seed(episode, "final") for episode in range(config.episodes)]
    loop.advance(actions, everyone, seeds)
    starts = np.array(loop.telemetry["metrics"][:, 0])
    loop.close()
    vehicle = Vehicle.load(config.vehicle, linear_drag=options.linear_drag)
    return elevation_bounds(options, vehicle, starts)


def read_compare_config(folder: Path) -> CompareConfig:
    """Settings of a comparison, from its `config.json`. Raises `ResultsError`."""
    content = read_config(folder)
    try:
        return CompareConfig(
            agents=tuple(content["agents"]),
            seeds=len(content["seeds"]),
            first_seed=content["seeds"][0],
            env_steps=content["env_steps"],
            num_envs=content["num_envs"],
            preset=content["preset"],
            env_id=content["spec"]["env_id"],
            options=content["spec"]["options"],
            vehicle=content["vehicle"],
            **content["evaluation"],
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ResultsError(f"{folder / CONFIG_FILE}: expected a comparison's: {error!r}") from None


def _write_config(config: CompareConfig, spec: EnvSpec, folder: Path, command: str) -> None:
    if (folder / CONFIG_FILE).exists():
        return
    content = {
        "preset": config.preset,
        "seeds": list(config.all_seeds),
        "env_steps": config.env_steps,
        "num_envs": config.num_envs,
        "agents": {agent: asdict(preset(agent, config.preset)) for agent in config.agents},
        "evaluation": {
            "snapshots": config.snapshots,
            "curve_episodes": config.curve_episodes,
            "episodes": config.episodes,
        },
        "bounds": _bounds(config),
    }
    write_config(folder, command, spec, config.vehicle, content)
