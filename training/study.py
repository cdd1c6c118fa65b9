"""A study: every row with every seed is trained and evaluated; what is done is kept."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from ..agents import Episode, find_controller
from ..agents.checkpoints import Checkpoint, store
from ..envs.autoreset import AdvancingVectorEnv
from ..envs.config import EnvConfig
from ..envs.registry import env_spec, load
from ..flights.executors import OnProgress, Tell, WorkersConfig, open_executor, run_jobs
from ..flights.folders import locked
from ..flights.trajectories import Trajectory, fly_episodes
from ..udp.spawn import cached_simulator
from . import results
from .metrics import Headline, Measures, measure_episode, measure_run
from .results import CONFIG_FILE
from .settings import Row, Study
from .training import Snapshot, Training

MAX_BATCH = 64
"""Most evaluation episodes that are flown at a time."""

Job = tuple[Row, int]
"""A row and a seed."""


Done = tuple[results.Tables, Checkpoint | None]
"""What a run gives: a controller has no checkpoint."""


def run_study(
    study: Study,
    folder: Path,
    workers: WorkersConfig,
    command: str = "",
    on_progress: OnProgress = lambda *_: None,
) -> None:
    """Train and evaluate everything, and write the results into `folder`.

    Each run is written when it is done, so that a study that was interrupted, or of which a run
    failed, goes on where it was: call it again with the same folder and study. `report` draws
    figures, table and verdicts.

    Args:
        study: Rows and seeds.
        folder: It exists: see `folders.new_folder`.
        command: The user's command, for `config.json`.
        on_progress: Called with the progress of each run.
        workers: Kind and number of workers; by default one for each core.

    Raises:
        RunsFailed: Some runs failed; the others are done and kept.
        InputError: Another process writes to the folder, there is no such Ray cluster, or a task,
            vehicle, scene or controller has changed since the study began; nothing is written.
    """
    jobs = {
        # A worker may not have the files of the vehicle.
        name: (replace(row, env=row.env.embedded()), seed)
        for name, (row, seed) in study.runs().items()
        if not results.run_file(folder, row, seed).exists()
    }
    with open_executor(workers, len(jobs), on_progress) as executor, locked(folder):
        specs = {row.name: env_spec(row.env) for row in study.rows}
        if (folder / CONFIG_FILE).exists():  # a resumed study keeps its settings
            results.check_unchanged(folder, study, specs)
        else:
            results.write_config(folder, command, study, specs)
        own_tasks = {row.env.own_task for row in study.rows if row.env.own_task}
        fly = partial(_fly, study, own_tasks)
        run_jobs(executor, fly, jobs, partial(_keep, study, folder), on_progress)


def _keep(study: Study, folder: Path, job: Job, done: Done) -> None:
    """Write checkpoint and tables; these last, for with them the run is done."""
    row, seed = job
    tables, checkpoint = done
    if study.kind == "benchmark" and checkpoint:  # none is chosen: the first seed's policy
        checkpoint = checkpoint.policy_alone() if seed == study.first_seed else None
    if checkpoint and study.kind != "sweep":
        store(checkpoint, results.checkpoint_file(folder, row, seed))
    results.write_run(folder, row, seed, tables)


# ---- in a worker


def _fly(study: Study, own_tasks: set[str], job: Job, tell: Tell) -> Done:
    row, seed = job
    for task in own_tasks:
        load(task)
    if row.controller:
        policy = find_controller(row.agent)(env_spec(row.env))
        untrained = [Snapshot(env_steps=0, seconds=0.0, policy=policy)]
        return _evaluate(study, row, seed, untrained), None
    run = row.run(seed)
    with open_env(study.wire, run.env, run.num_envs) as env:
        training = Training(run, env, snapshots=study.snapshots, keep_steps=study.keep_steps)
        training.train(tell=tell)
    tell(run.env_steps, run.env_steps, "evaluating")
    tables = _evaluate(study, row, seed, training.taken)
    tables["episodes"] = _episodes(training)
    if study.keep_steps:
        flown = _steps("train", **training.log.steps())
        tables["steps"] = pd.concat([flown, tables["steps"]], ignore_index=True)
    return tables, training.checkpoint()


def open_env(
    wire: bool, config: EnvConfig, num_envs: int
) -> AbstractContextManager[AdvancingVectorEnv]:
    """An env of `num_envs` drones without autoreset: over UDP with a simulator process, which the
    next run of this process uses again, or in process.
    """
    if wire:
        return cached_simulator(config, num_envs=num_envs)
    from ..envs.vector import LocalVectorEnv

    return closing(LocalVectorEnv(config, num_envs, autoreset_mode="Disabled"))


def _evaluate(
    study: Study, row: Row, seed: int, snapshots: Sequence[Snapshot]
) -> dict[str, pd.DataFrame]:
    """Tables of the evaluation of all snapshots: the last on `study.episodes` episodes of its own,
    each before it on `study.curve_episodes` of the set `curve`.
    """
    rows: list[Measures] = []
    flown: list[Trajectory] = []
    drones = row.env.drones
    final = snapshots[-1]
    most = max(study.episodes, study.curve_episodes)
    worlds = min(most, max(MAX_BATCH // drones, 1))
    with open_env(study.wire, row.env.unseen(), worlds * drones) as env:
        headline = Headline.of(env.env_spec)
        for one in snapshots:
            last = one is final
            count = study.episodes if last else study.curve_episodes
            episodes = study.evaluation if last else "curve"
            flown = fly_episodes(env, one.policy, count, episodes, training_seed=seed)
            label = {"env_steps": one.env_steps, "seconds": one.seconds}
            rows += [label | measure_episode(each, headline) for each in flown]
    evaluations = pd.DataFrame(rows)
    rate = final.env_steps / final.seconds if final.seconds else np.nan
    times = {"env_steps": final.env_steps, "seconds": final.seconds, "steps_per_second": rate}
    measures = {**times, **measure_run(evaluations, headline)}
    tables = {"runs": pd.DataFrame([measures]), "evaluations": evaluations}
    if study.keep_steps:
        parts = [_steps("evaluation", one.episode, one.headline[1:]) for one in flown]
        tables["steps"] = pd.concat(parts, ignore_index=True)
    return tables


def _episodes(training: Training) -> pd.DataFrame:
    log = training.log
    table = pd.DataFrame(log.episodes, columns=[field.name for field in fields(Episode)])
    # While one drone flies a step, each of the others does.
    last = table["first_step"] + table["length"] * log.num_envs
    table = table.assign(last_step=last.clip(upper=log.env_steps))
    table = table.rename(columns={"total_reward": "return"})
    return table[list(results.COLUMNS["episodes"])[2:]]


def _steps(phase: str, episode: ArrayLike, value: ArrayLike) -> pd.DataFrame:
    """Rows of the table `steps`, from the headline metric after each, shape (T,)."""
    values = np.asarray(value, np.float32)
    return pd.DataFrame({
        "phase": phase,
        "episode": np.asarray(episode, np.int32),
        "step": np.arange(1, len(values) + 1, dtype=np.int32),
        "value": values,
    })  # fmt: skip
