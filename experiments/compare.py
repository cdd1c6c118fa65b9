"""The comparison: every agent, over the same seeds and env steps, each through a socket pair."""

import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ..agents.checkpoints import Checkpoint, store
from ..agents.pid import PID
from ..envs.loop import Loop
from ..envs.registry import env_spec, options_type
from ..envs.spec import canonical_id
from ..models.errors import InputError
from ..models.vehicle import Vehicle
from . import results
from .bounds import elevation_bounds
from .folders import locked
from .metrics import Headline
from .pairs import shared_pair
from .results import CONFIG_FILE, ResultsError
from .settings import CompareConfig, EnvConfig, Run
from .training import Snapshot, train_run
from .trajectories import Trajectory, evaluation_seed, fly_episodes
from .workers import OnProgress, Tell, open_workers

PARTS: Final = "parts"
"""Folder with the parts of an unfinished comparison, one for each run."""
MAX_BATCH: Final = 64
"""Most evaluation episodes that are flown at a time."""
_SETTINGS: Final = ("snapshots", "curve_episodes", "episodes")


def compare(config: CompareConfig, folder: Path, command: str, on_progress: OnProgress) -> None:
    """Train and evaluate everything, and write the results into `folder`.

    Each run leaves a part behind when it is done, so that a comparison that was interrupted, or of
    which a run failed, goes on where it was: call it again with the same folder (and the config of
    `read_compare_config`). `report.write_report` draws figures, table and verdicts.

    The folder exists: see `folders.new_folder`. The user's command is for `config.json`.

    Raises:
        RunsFailed: Some runs failed; the others are done, and their parts kept.
        InputError: The env names no metric, another process writes to the folder, or there is no
            such Ray cluster; nothing is written.
    """
    spec = env_spec(**config.env)
    metric = Headline.of(spec).name
    parts = folder / PARTS
    with open_workers(config, on_progress) as workers, locked(folder):
        parts.mkdir(exist_ok=True)
        if not (folder / CONFIG_FILE).exists():  # a resumed comparison keeps its settings
            content = config.content(*config.agents)
            content["evaluation"] = {name: getattr(config, name) for name in _SETTINGS}
            content["bounds"] = _bounds(config)
            results.write_config(folder, command, spec, config.vehicle, content)
        for unfinished in parts.glob(".*"):
            shutil.rmtree(unfinished)
        runs: list[Run | None] = [*config.runs()]
        with suppress(InputError):
            PID(spec)  # if it can fly this env; it needs no training and has no seeds
            runs.append(None)
        jobs = {
            f"{run.algorithm} seed {run.seed}" if run else "pid": run
            for run in runs
            if not (parts / _part(run)).exists()
        }
        workers.fly_all(partial(_fly, config), jobs, partial(_keep, folder, metric), config)
        results.join_parts(parts, folder, metric)


def _part(run: Run | None) -> str:
    return f"{run.algorithm}-seed{run.seed}" if run else "pid-seed0"


class _Done(NamedTuple):
    """What a run gives."""

    rows: results.Rows
    steps: list[Any]  # tables of `steps.parquet`
    checkpoint: Checkpoint | None = None


def _keep(folder: Path, metric: str, run: Run | None, done: _Done) -> None:
    """Write checkpoint and part; the part last, for with it the run is done."""
    if done.checkpoint:
        store(done.checkpoint, folder / "checkpoints" / f"{_part(run)}.safetensors")
    results.write_part(folder / PARTS / _part(run), metric, done.rows, done.steps)


def _fly(config: CompareConfig, run: Run | None, tell: Tell) -> _Done:
    """Train and evaluate (in a worker process)."""
    if run is None:
        return _evaluate("pid", 0, config)
    with shared_pair(**run.training_env, num_envs=run.num_envs) as env:
        training, times = train_run(run, env, tell, config.snapshots, keep_steps=True)
        checkpoint, log = training.checkpoint(), training.log
    evaluated = _evaluate(run.algorithm, run.seed, config, training.taken)
    label = {"agent": run.algorithm, "seed": run.seed}
    episodes = [
        results.episode_row(one, run.num_envs, log.env_steps) | log.drawn.get(one.episode, {})
        for one in log.episodes
    ]
    rows = {
        **evaluated.rows,
        results.EPISODES_FILE: [label | episode for episode in episodes],
        results.RUNS_FILE: [label | times],
    }
    metric = Headline.of(log.spec).name
    trained = results.step_table(metric, **label, phase="train", **log.steps())
    return _Done(rows, [trained, *evaluated.steps], checkpoint)


def evaluation_pair(config: EnvConfig, episodes: int) -> AbstractContextManager[Any]:
    """A remote env that flies that many episodes at a time, or `MAX_BATCH`."""
    return shared_pair(**config.env, num_envs=min(episodes, MAX_BATCH))


def _evaluate(
    agent: str, seed: int, config: CompareConfig, taken: Sequence[Snapshot] = ()
) -> _Done:
    """Evaluate the snapshots of a training, or the PID."""
    rows: list[dict[str, Any]] = []
    flown: list[Trajectory] = []
    most = max(config.curve_episodes, config.episodes) if taken else config.episodes
    with evaluation_pair(config, most) as env:
        spec = env.env_spec
        headline = Headline.of(spec)
        snapshots: Sequence[Snapshot | None] = taken or [None]
        for snapshot in snapshots:
            policy = snapshot.policy if snapshot else PID(spec)
            if snapshot is snapshots[-1]:
                flown = fly_episodes(env, policy, config.episodes, "final")
            else:
                flown = fly_episodes(env, policy, config.curve_episodes, "curve")
            steps, seconds = (snapshot.env_steps, snapshot.seconds) if snapshot else (0, 0.0)
            label = {"agent": agent, "seed": seed, "env_steps": steps, "seconds": seconds}
            rows += [label | results.evaluation_row(one, headline) for one in flown]
    tables = [
        results.step_table(
            headline.name, agent=agent, seed=seed, phase="evaluation", episode=one.episode,
            value=one.headline[1:], reward=one.rewards, thrust=one.mean_thrust[1:],
        )
        for one in flown
    ]  # fmt: skip
    return _Done({results.EVALUATIONS_FILE: rows}, tables)


def _bounds(config: CompareConfig) -> dict[str, float]:
    """Mean returns over the final evaluation's episodes, of the flights of `bounds`."""
    if canonical_id(config.env_id) != "rotorgram/Elevation-v0":
        return {}
    options: Any = options_type(config.env_id).from_options(config.options)
    loop = Loop(config.env_id, config.episodes, vehicle=config.vehicle, options=config.options)
    seeds = [evaluation_seed(episode, "final") for episode in range(config.episodes)]
    loop.advance(np.zeros((config.episodes, 1), np.float32), np.ones(config.episodes, bool), seeds)
    starts = np.array(loop.telemetry["metrics"][:, 0])
    loop.close()
    vehicle = Vehicle.load(config.vehicle, linear_drag=options.linear_drag)
    return elevation_bounds(options, vehicle, starts)


def read_compare_config(folder: Path) -> CompareConfig:
    """Settings of a comparison, from its `config.json`. Raises `ResultsError`."""
    content = results.read_config(folder)
    try:
        common = CompareConfig.read_content(content)
        return CompareConfig(agents=tuple(content["agents"]), **common, **content["evaluation"])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ResultsError(f"{folder / CONFIG_FILE}: expected a comparison's: {error!r}") from None
