"""The sweep: one algorithm over a grid of hyperparameters, every point on the same seeds.

A folder holds three files, all of them whole at any moment:

| file | one row per |
|---|---|
| `config.json` | (the sweep's configuration, versions and machine) |
| `runs.csv` | training run (grid point and seed) that is done |
| `sweep.csv` | grid point, the best first: see `sweep_table` |
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import pandas as pd

from ..agents.checkpoints import write_whole
from ..envs.registry import env_spec
from ..flights.executors import OnProgress, Tell, open_executor, run_jobs
from ..flights.folders import locked
from . import results
from .evaluations import evaluate_stages, stages_of
from .metrics import Headline, final_per_run
from .pairs import shared_pair
from .results import CONFIG_FILE, ResultsError
from .rows import adding_rows, read_rows
from .settings import Run, SweepConfig
from .training import train_run

SWEEP_FILE: Final = "sweep.csv"

RUN_COLUMNS: Final[Mapping[str, str]] = {
    "point": "int64",  # of the grid, in the order of `SweepConfig.points`
    "seed": "int64",
    "env_steps": "int64",
    "steady": "float64",  # mean size of the headline metric in the last quarter, over episodes
    "return": "float64",  # mean over episodes
    "episodes": "int64",  # of the evaluation
    "settled": "int64",  # episodes
    "crashed": "int64",  # episodes
    "seconds": "float64",  # of training, wall time
    "steps_per_second": "float64",
}
"""Columns of `runs.csv`, besides the settings of the grid, which stand after `point`."""

Job = tuple[int, Run]
"""A training, with its point of the grid."""


def sweep(config: SweepConfig, folder: Path, command: str, on_progress: OnProgress) -> None:
    """Train and evaluate every point with every seed; each run is a row of `runs.csv` when done.

    A sweep that was interrupted, or of which a run failed, goes on where it was: call it again with
    the same folder (and the config of `read_sweep_config`).

    Arguments and errors are those of `compare.compare`.
    """
    spec = env_spec(config.flown)
    runs = len(config.runs())
    with open_executor(config, runs, on_progress) as executor, locked(folder):
        if not (folder / CONFIG_FILE).exists():  # a resumed sweep keeps its settings
            content = config.content(config.algorithm)
            content["sweep"] = {"grid": dict(config.grid), "episodes": config.episodes}
            results.write_config(folder, command, spec, config.vehicle, content)
        done = read_sweep_runs(folder, config)
        add = adding_rows(folder / results.RUNS_FILE, done, partial(_with_settings, config))
        keep = lambda _, row: add(row)  # noqa: E731
        fly, jobs = partial(_fly, config), missing_runs(config, done)
        run_jobs(executor, fly, jobs, keep, on_progress, task=config.own_task)


def missing_runs(config: SweepConfig, rows: pd.DataFrame) -> dict[str, Job]:
    """The runs by name that are not among the rows of `read_sweep_runs`."""
    done = set(zip(rows["point"], rows["seed"], strict=True))
    return {name: job for name, job in config.runs().items() if (job[0], job[1].seed) not in done}


def _fly(config: SweepConfig, job: Job, tell: Tell) -> dict[str, Any]:
    """Train and evaluate (in a worker process); the row of the run."""
    point, run = job
    with shared_pair(**run.training_env, num_envs=run.num_envs) as env:
        training, times = train_run(run, env, tell, snapshots=1)
    evaluated, _ = evaluate_stages(
        config, stages_of(training.taken)[-1:], config.episodes, of="tuning"
    )
    frame = pd.DataFrame(evaluated).assign(agent=run.algorithm, seed=run.seed)
    (row,) = final_per_run(frame, Headline.of(training.log.spec)).to_dict("records")
    whole = {"point": point, **row, **times}
    return {column: whole[column] for column in RUN_COLUMNS}


def sweep_table(config: SweepConfig, rows: pd.DataFrame, headline: Headline) -> pd.DataFrame:
    """One row for each point of which a run is done, the best first: measures over its seeds.

    A point is as good as its worst seed: first by the crashed episodes of the seed that crashed
    most, then by the worst steady state. Points that lack a seed stand last, for the worst of fewer
    seeds flatters.
    """
    table = rows.groupby("point").agg(
        seeds=("seed", "size"),
        worst=("steady", "min" if headline.high else "max"),
        median=("steady", "median"),
        **{name: (name, "median") for name in ("return", "seconds", "steps_per_second")},
        **{name: (name, "sum") for name in ("episodes", "settled", "crashed")},
        most_crashed=("crashed", "max"),
    ).reset_index()  # fmt: skip
    order = {"seeds": False, "most_crashed": True, "worst": not headline.high}
    table = table.sort_values(list(order), ascending=list(order.values()), kind="stable")
    return _with_settings(config, table).reset_index(drop=True)


def write_sweep_table(config: SweepConfig, folder: Path) -> pd.DataFrame:
    """Make `sweep.csv` of `runs.csv`, and return it: see `sweep_table`. Raises `ResultsError`."""
    headline = Headline.of(results.read_spec(folder))
    table = sweep_table(config, read_sweep_runs(folder, config), headline)
    write_whole(folder / SWEEP_FILE, table.to_csv(index=False).encode())
    return table


def read_sweep_runs(folder: Path, config: SweepConfig) -> pd.DataFrame:
    """The runs that are done, columns `RUN_COLUMNS`. Raises `ResultsError` if others are there."""
    wanted = {(point, run.seed) for point, run in config.runs().values()}
    return read_rows(folder / results.RUNS_FILE, RUN_COLUMNS, ("point", "seed"), wanted, "sweep")


def read_sweep_config(folder: Path) -> SweepConfig:
    """Settings of a sweep, from its `config.json`. Raises `ResultsError`."""
    content = results.read_config(folder)
    try:
        (algorithm,) = content["agents"]
        return SweepConfig(
            algorithm=algorithm,
            grid={name: tuple(values) for name, values in content["sweep"]["grid"].items()},
            episodes=content["sweep"]["episodes"],
            **SweepConfig.read_content(content),
        )
    except (AttributeError, KeyError, IndexError, TypeError, ValueError) as error:
        raise ResultsError(f"{folder / CONFIG_FILE}: expected a sweep's: {error!r}") from None


def _with_settings(config: SweepConfig, table: pd.DataFrame) -> pd.DataFrame:
    """A table by points, with the settings of each after its number."""
    settings = pd.DataFrame(config.points(), dtype=object).iloc[table["point"]]
    settings.index = table.index
    return pd.concat([table[["point"]], settings, table.drop(columns="point")], axis=1)
