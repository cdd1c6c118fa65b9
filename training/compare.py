"""The comparison: every agent, over the same seeds and env steps, each through a socket pair."""

import shutil
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

from ..agents import CONTROLLERS
from ..agents.checkpoints import Checkpoint, store
from ..envs.registry import env_spec
from ..envs.spec import EnvSpec
from ..flights.executors import OnProgress, Tell, open_executor, run_jobs
from ..flights.folders import locked
from ..models.errors import InputError
from ..models.fleet import load_vehicles
from . import results, swarms
from .bounds import known_bounds
from .evaluations import Stage, evaluate_stages, stages_of
from .metrics import Headline
from .pairs import shared_pair
from .results import CONFIG_FILE, ResultsError
from .settings import CompareConfig, Run
from .training import train_run

PARTS: Final = "parts"
"""Folder with the parts of an unfinished comparison, one for each run."""
_SETTINGS: Final = ("snapshots", "curve_episodes", "episodes")
_CONTROLLERS: Final = ("pid", "orca")
"""Flown beside the agents where they can fly the env; they need no training and have no seeds."""


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
    spec = env_spec(config.flown)
    metric = Headline.of(spec).name
    parts = folder / PARTS
    runs: list[Run | str] = [*config.runs(), *filter(partial(_flies, spec), _CONTROLLERS)]
    with open_executor(config, len(runs), on_progress) as executor, locked(folder):
        parts.mkdir(exist_ok=True)
        if not (folder / CONFIG_FILE).exists():  # a resumed comparison keeps its settings
            content = config.content(*config.agents)
            content["evaluation"] = {name: getattr(config, name) for name in _SETTINGS}
            content["bounds"] = known_bounds(config, config.episodes)
            if config.drones > 1:  # distance at which the spheres of two drones touch, m
                content["diameter"] = 2 * load_vehicles(config.vehicle, config.drones).radius
            results.write_config(folder, command, spec, config.vehicle, content)
        for unfinished in parts.glob(".*"):
            shutil.rmtree(unfinished)
        jobs = {
            run if isinstance(run, str) else f"{run.algorithm} seed {run.seed}": run
            for run in runs
            if not (parts / _part(run)).exists()
        }
        fly, keep = partial(_fly, config), partial(_keep, folder, metric)
        run_jobs(executor, fly, jobs, keep, on_progress, task=config.own_task)
        results.join_parts(parts, folder, metric)


def _flies(spec: EnvSpec, controller: str) -> bool:
    with suppress(InputError):
        CONTROLLERS[controller](spec)
        return True
    return False


def _part(run: Run | str) -> str:
    return f"{run}-seed0" if isinstance(run, str) else f"{run.algorithm}-seed{run.seed}"


class _Done(NamedTuple):
    """What a run gives."""

    rows: results.Rows
    steps: list[Any]  # tables of `steps.parquet`
    positions: Any = None  # rows of `positions.parquet`
    checkpoint: Checkpoint | None = None


def _keep(folder: Path, metric: str, run: Run | str, done: _Done) -> None:
    """Write checkpoint and part; the part last, for with it the run is done."""
    if done.checkpoint:
        store(done.checkpoint, folder / "checkpoints" / f"{_part(run)}.safetensors")
    results.write_part(folder / PARTS / _part(run), metric, done.rows, done.steps, done.positions)


def _fly(config: CompareConfig, run: Run | str, tell: Tell) -> _Done:
    """Train and evaluate (in a worker process)."""
    if isinstance(run, str):
        return _evaluate(run, 0, config, [Stage(CONTROLLERS[run])])
    with shared_pair(**run.training_env, num_envs=run.num_envs) as env:
        training, times = train_run(run, env, tell, config.snapshots, keep_steps=True)
        checkpoint, log = training.checkpoint(), training.log
    evaluated = _evaluate(run.algorithm, run.seed, config, stages_of(training.taken))
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
    return _Done(rows, [trained, *evaluated.steps], evaluated.positions, checkpoint)


def _evaluate(agent: str, seed: int, config: CompareConfig, stages: Sequence[Stage]) -> _Done:
    """Evaluate the stages of a training, or a controller."""
    rows, flown = evaluate_stages(config, stages, config.episodes, config.curve_episodes)
    label = {"agent": agent, "seed": seed}
    headline = Headline.of(flown[-1].spec)
    tables = [
        results.step_table(
            headline.name, **label, phase="evaluation", episode=one.episode,
            value=one.headline[1:], reward=one.rewards, thrust=one.mean_thrust[1:],
        )
        for one in flown
    ]  # fmt: skip
    positions = swarms.rows_of(flown).assign(**label) if config.drones > 1 else None
    return _Done({results.EVALUATIONS_FILE: [label | row for row in rows]}, tables, positions)


def read_compare_config(folder: Path) -> CompareConfig:
    """Settings of a comparison, from its `config.json`. Raises `ResultsError`."""
    content = results.read_config(folder)
    try:
        common = CompareConfig.read_content(content)
        return CompareConfig(agents=tuple(content["agents"]), **common, **content["evaluation"])
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ResultsError(f"{folder / CONFIG_FILE}: expected a comparison's: {error!r}") from None
