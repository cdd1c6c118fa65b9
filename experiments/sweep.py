"""The sweep: one algorithm over a grid of hyperparameters, every point on the same seeds.

A folder holds three files, all of them whole at any moment:

| file | one row per |
|---|---|
| `config.json` | (the sweep's configuration, versions and machine) |
| `runs.csv` | training run (grid point and seed) that is done |
| `sweep.csv` | grid point, the best first: see `sweep_table` |
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from ..agents import preset
from ..agents.checkpoints import write_whole
from ..agents.policies import NetworkPolicy
from ..envs import ElevationConfig
from .evaluate import evaluation_row, fly_episodes
from .metrics import final_per_run
from .pairs import socket_pair
from .progress import OnProgress, ProgressSender
from .records import CONFIG_FILE, RUNS_FILE, RecordsError, read_config
from .runs import config_env, train_run, write_config
from .training import Run
from .workers import WorkersConfig, open_workers

__all__ = [
    "RUN_COLUMNS",
    "SWEEP_FILE",
    "SweepConfig",
    "SweepRun",
    "is_sweep",
    "missing_runs",
    "read_sweep_config",
    "read_sweep_runs",
    "sweep",
    "sweep_table",
    "write_sweep_table",
]

SWEEP_FILE: Final = "sweep.csv"

RUN_COLUMNS: Final[Mapping[str, str]] = {
    "point": "int64",  # of the grid, in the order of `SweepConfig.points`
    "seed": "int64",
    "env_steps": "int64",
    "steady_error": "float64",  # mean |E| in the last quarter of an episode, mean over episodes, m
    "return": "float64",  # mean over episodes
    "episodes": "int64",  # of the evaluation
    "settled": "int64",  # episodes
    "crashed": "int64",  # episodes
    "seconds": "float64",  # of training, wall time
    "steps_per_second": "float64",
}
"""Columns of `runs.csv`, besides the settings of the grid, which stand after `point`."""


@dataclass(frozen=True, kw_only=True)
class SweepRun:
    """A training of the sweep."""

    point: int
    """Of the grid."""
    settings: dict[str, Any]
    """What the point changes of the preset."""
    run: Run

    @property
    def name(self) -> str:
        """What the run is called."""
        return f"{_words(self.settings)} seed {self.run.seed}"


@dataclass(frozen=True, kw_only=True)
class SweepConfig(WorkersConfig):
    """What is tried, and who flies it."""

    algorithm: str
    """`vpg`, `a2c` or `sb3-a2c`."""
    grid: Mapping[str, tuple[Any, ...]]
    """Values of hyperparameters, by name: every combination is a point."""
    preset: str = "tuned"
    """`paper` or `tuned`: what the grid does not name."""
    seeds: int = 3
    """Seeds 0 ... seeds - 1, the same for every point."""
    env_steps: int = 200_000
    """Env steps of each training."""
    num_envs: int = 1
    """Drones of each training."""
    episodes: int = 20
    """Evaluation episodes of the final policies, flown by one drone."""
    env: ElevationConfig
    """The task."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("seeds", "env_steps", "episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if not self.grid:
            raise ValueError("grid: expected at least one hyperparameter, got none")
        for name, values in self.grid.items():
            if not values:
                raise ValueError(f"grid: expected at least one value of {name}, got none")
        self.runs()  # wrong names and numbers are told before anything is trained
        for name, values in self.grid.items():
            for place, value in enumerate(values):
                if value in values[:place]:
                    raise ValueError(f"grid: expected each {name} once, got {value!r} twice")

    def points(self) -> list[dict[str, Any]]:
        """Settings of every point; the value that is named last changes fastest."""
        return [
            dict(zip(self.grid, values, strict=True)) for values in product(*self.grid.values())
        ]

    def runs(self) -> list[SweepRun]:
        """Every training, in the order in which they start.

        All points with the first seed, then all with the second: a sweep that is stopped has seen
        every point.
        """
        return [
            SweepRun(
                point=point,
                settings=settings,
                run=Run(
                    algorithm=self.algorithm,
                    config=preset(self.algorithm, self.preset, **settings),
                    env=self.env,
                    seed=seed,
                    env_steps=self.env_steps,
                    num_envs=self.num_envs,
                ),
            )
            for seed in range(self.seeds)
            for point, settings in enumerate(self.points())
        ]


def sweep(config: SweepConfig, folder: Path, command: str, on_progress: OnProgress) -> None:
    """Train and evaluate every point with every seed; each run is a row of `runs.csv` when done.

    A sweep that was interrupted, or of which a run failed, goes on where it was: call it again with
    the same folder (and the config of `read_sweep_config`).

    Raises:
        RunsFailed: Some runs failed; the rows of the others are written.
        ValueError: There is no Ray, or no such cluster; nothing is written.
    """
    with open_workers(config, on_progress) as workers:
        folder.mkdir(parents=True, exist_ok=True)
        _write_config(config, folder, command)
        done = read_sweep_runs(folder, config)
        rows = done.to_dict("records")

        def keep(_: SweepRun, row: dict[str, Any]) -> None:
            rows.append(row)
            table = _with_settings(pd.DataFrame(rows, columns=list(RUN_COLUMNS)), config)
            write_whole(folder / RUNS_FILE, table.to_csv(index=False).encode())

        jobs = {job.name: job for job in missing_runs(config, done)}
        workers.fly_all(partial(_fly, config), jobs, keep)


def missing_runs(config: SweepConfig, rows: pd.DataFrame) -> list[SweepRun]:
    """The runs that are not done.

    Args:
        config: Of the sweep.
        rows: As of `read_sweep_runs`.
    """
    done = set(zip(rows["point"], rows["seed"], strict=True))
    return [job for job in config.runs() if (job.point, job.run.seed) not in done]


def _fly(config: SweepConfig, job: SweepRun, progress: ProgressSender) -> dict[str, Any]:
    """Train and evaluate (in a worker process); the row of the run."""
    run = job.run
    with socket_pair(run.env, num_envs=run.num_envs) as env:
        training, times = train_run(run, env, progress)
    with socket_pair(run.env) as env:
        flights = fly_episodes(env, NetworkPolicy(training.agent.actor()), config.episodes)
    name = {"agent": run.algorithm, "seed": run.seed, "env_steps": times["env_steps"]}
    episodes = [
        {**name, **evaluation_row(flight, episode, run.env.control_period)}
        for episode, flight in enumerate(flights)
    ]
    (row,) = final_per_run(pd.DataFrame(episodes)).to_dict("records")
    whole = {"point": job.point, **row, **times}
    return {column: whole[column] for column in RUN_COLUMNS}


def sweep_table(config: SweepConfig, rows: pd.DataFrame) -> pd.DataFrame:
    """One row for each point of which a run is done, the best first.

    A point is as good as its worst seed. A seed's `score` is its steady |E|, and for each crashed
    episode that episode's share of the flight band on top: whoever crashes once in twenty episodes
    of the default task stands behind all that stay within 0.15 m. Points that lack a seed stand
    last, for the worst of fewer seeds flatters.

    Args:
        config: Of the sweep.
        rows: As of `read_sweep_runs`.

    Returns:
        `point` and its settings; `seeds` that are done; `score` of the worst seed, m;
        `worst_error` and `median_error` over seeds, m; medians over seeds of `return`, `seconds`
        and `steps_per_second`; sums over seeds of `episodes`, `settled` and `crashed`.
    """
    crashes = rows["crashed"] / rows["episodes"] * config.env.flight_band
    groups = rows.assign(score=rows["steady_error"] + crashes).groupby("point")
    table = groups.agg(
        seeds=("seed", "size"),
        score=("score", "max"),
        worst_error=("steady_error", "max"),
        median_error=("steady_error", "median"),
        **{name: (name, "median") for name in ("return", "seconds", "steps_per_second")},
        **{name: (name, "sum") for name in ("episodes", "settled", "crashed")},
    ).reset_index()
    table = table.sort_values(["seeds", "score"], ascending=[False, True], kind="stable")
    return _with_settings(table, config).reset_index(drop=True)


def write_sweep_table(config: SweepConfig, folder: Path) -> pd.DataFrame:
    """Make `sweep.csv` of `runs.csv`, and return it: see `sweep_table`. Raises `RecordsError`."""
    table = sweep_table(config, read_sweep_runs(folder, config))
    write_whole(folder / SWEEP_FILE, table.to_csv(index=False).encode())
    return table


def read_sweep_runs(folder: Path, config: SweepConfig) -> pd.DataFrame:
    """The runs that are done, columns `RUN_COLUMNS`; none where there is no file.

    Raises:
        RecordsError: The file is not one of this sweep.
    """
    path = folder / RUNS_FILE
    if not path.exists():
        return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in RUN_COLUMNS.items()})
    try:
        # By way of strings: they are written again with every run, and have to keep their bits.
        text = pd.read_csv(path, usecols=list(RUN_COLUMNS), dtype=str)
        rows = text[list(RUN_COLUMNS)].astype(dict(RUN_COLUMNS))
    except ValueError as error:  # an empty file, a missing column, or a value of another type
        raise RecordsError(f"{path}: expected the runs of a sweep: {error}") from None
    wanted = {(job.point, job.run.seed) for job in config.runs()}
    got = list(zip(rows["point"], rows["seed"], strict=True))
    if len(set(got)) < len(got) or not wanted.issuperset(got):
        raise RecordsError(f"{path}: expected each run of the sweep once, got others")
    return rows


def is_sweep(folder: Path) -> bool:
    """Whether a folder is a sweep's, not a comparison's. Raises `RecordsError` if neither's."""
    return "sweep" in read_config(folder)


def read_sweep_config(folder: Path) -> SweepConfig:
    """What a sweep was to try, from its `config.json`. Raises `RecordsError`."""
    content = read_config(folder)
    try:
        settings = content["sweep"]
        (algorithm,) = content["agents"]
        return SweepConfig(
            algorithm=algorithm,
            grid={name: tuple(values) for name, values in settings["grid"].items()},
            preset=content["preset"],
            seeds=len(content["seeds"]),
            env_steps=content["env_steps"],
            num_envs=settings["num_envs"],
            episodes=settings["episodes"],
            env=config_env(content),
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RecordsError(f"{folder / CONFIG_FILE}: expected a sweep's: {error!r}") from None


def _write_config(config: SweepConfig, folder: Path, command: str) -> None:
    content = {
        "preset": config.preset,
        "seeds": list(range(config.seeds)),
        "env_steps": config.env_steps,
        "agents": {config.algorithm: asdict(preset(config.algorithm, config.preset))},
        "sweep": {
            "grid": dict(config.grid),
            "num_envs": config.num_envs,
            "episodes": config.episodes,
        },
    }
    write_config(folder, command, config.env, content)


def _with_settings(table: pd.DataFrame, config: SweepConfig) -> pd.DataFrame:
    """A table by points, with the settings of each after its number."""
    points = config.points()
    wide = table.copy()
    for place, name in enumerate(config.grid, 1):
        values = [points[point][name] for point in table["point"]]
        wide.insert(place, name, np.array(values, dtype=object))
    return wide


def _words(settings: Mapping[str, Any]) -> str:
    return " ".join(f"{name}={value}" for name, value in settings.items())
