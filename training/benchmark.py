"""The baselines board: agents on tasks with vehicles, every row over the same seeds.

A folder holds these files, all of them whole at any moment:

| file | one row per |
|---|---|
| `config.json` | (the rows with hyperparameters, spec and bounds; versions and machine) |
| `seeds.csv` | run (row and seed) that is done: `SEED_COLUMNS` |
| `checkpoints/` | a file for each row that is trained: the policy alone of its first seed |

`board.write_page` makes the page of them.
"""

import json
import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from ..agents import CONTROLLERS
from ..agents.checkpoints import Checkpoint, store
from ..envs.registry import env_spec
from ..envs.spec import EnvSpec
from ..flights.executors import OnProgress, Tell, open_executor, run_jobs
from ..flights.folders import locked
from ..models.errors import InputError, expect
from . import results
from .bounds import known_bounds
from .evaluations import Stage, evaluate_stages, stages_of
from .metrics import Headline, final_per_run, first_lasting_snapshot
from .pairs import shared_pair
from .results import CONFIG_FILE, ResultsError
from .rows import adding_rows, read_rows
from .settings import BenchmarkConfig, BoardRow
from .training import train_run

SEEDS_FILE: Final = "seeds.csv"
CHECKPOINTS: Final = "checkpoints"
BOARD: Final = Path(__file__).parent / "assets" / "baselines.toml"
"""The rows of our own board."""

SEED_COLUMNS: Final[Mapping[str, str]] = {
    "row": "str",  # `BoardRow.name`
    "seed": "int64",
    "env_steps": "int64",  # of training; 0 of a controller
    "steady": "float64",  # mean size of the headline metric in the last quarter, over episodes
    "return": "float64",  # mean over episodes
    "episodes": "int64",  # of the evaluation
    "settled": "int64",  # episodes
    "crashed": "int64",  # episodes
    "held": "int64",  # 1 if the goal is held: see `final_per_run`
    "env_steps_to_hold": "float64",  # of the first snapshot from which on all hold; empty: never
    "seconds_to_hold": "float64",  # of training, wall time, to that snapshot
    "seconds": "float64",  # of training, wall time
    "steps_per_second": "float64",
}

Job = tuple[BoardRow, int]
"""A row and a seed."""


class _Done(NamedTuple):
    row: dict[str, Any]
    checkpoint: Checkpoint | None


def benchmark(config: BenchmarkConfig, folder: Path, command: str, on_progress: OnProgress) -> None:
    """Train and evaluate every row with every seed; each run is a row of `seeds.csv` when done.

    A board that was interrupted, or of which a run failed, goes on where it was: call it again with
    the same folder (and the config of `read_benchmark_config`).

    Arguments and errors are those of `compare.compare`.
    """
    runs = len(config.runs())
    with open_executor(config, runs, on_progress) as executor, locked(folder):
        if not (folder / CONFIG_FILE).exists():  # a resumed board keeps its settings
            results.write_settings(folder, command, _content(config))
        done = read_seeds(folder, config)
        add = adding_rows(folder / SEEDS_FILE, done)

        def keep(job: Job, given: _Done) -> None:
            row, seed = job
            if given.checkpoint and seed == config.first_seed:  # none is chosen: the first
                store(given.checkpoint.policy_alone(), checkpoint_file(folder, row))
            add(given.row)

        fly, jobs = partial(_fly, config), missing_seeds(config, done)
        run_jobs(executor, fly, jobs, keep, on_progress)


def missing_seeds(config: BenchmarkConfig, rows: pd.DataFrame) -> dict[str, Job]:
    """The runs by name that are not among the rows of `read_seeds`."""
    done = set(zip(rows["row"], rows["seed"], strict=True))
    return {name: job for name, job in config.runs().items() if (job[0].name, job[1]) not in done}


def checkpoint_file(folder: Path, row: BoardRow) -> Path:
    """The checkpoint of a row: the policy of its first seed."""
    name = re.sub(r"[^A-Za-z0-9.=]+", "-", row.name).strip("-").lower()
    return folder / CHECKPOINTS / f"{name}.safetensors"


def _fly(config: BenchmarkConfig, job: Job, tell: Tell) -> _Done:
    """Train and evaluate (in a worker process)."""
    row, seed = job
    times: dict[str, Any] = {"env_steps": 0, "seconds": 0.0, "steps_per_second": np.nan}
    stages, checkpoint = [Stage(CONTROLLERS[row.agent])] if row.controller else [], None
    if not row.controller:
        with shared_pair(**row.training_env, num_envs=row.num_envs) as env:
            training, times = train_run(row.run(seed), env, tell, config.snapshots)
        stages, checkpoint = stages_of(training.taken), training.checkpoint()
    rows, flown = evaluate_stages(row, stages, config.episodes, config.curve_episodes)
    headline = Headline.of(flown[-1].spec)
    frame = pd.DataFrame(rows).assign(agent=row.agent, seed=seed)
    (measured,) = final_per_run(frame, headline).to_dict("records")
    steps, seconds = np.nan, np.nan
    if checkpoint and headline.held is not None:
        steps, seconds = first_lasting_snapshot(frame, headline)
    whole = {**measured, **times, "row": row.name, "env_steps_to_hold": steps,
             "seconds_to_hold": seconds, "held": int(measured["held"])}  # fmt: skip
    return _Done({column: whole[column] for column in SEED_COLUMNS}, checkpoint)


# ---- config.json and the file of rows


_SETTINGS: Final = ("seeds", "first_seed", "snapshots", "curve_episodes", "episodes")
_ROW: Final = tuple(field.name for field in fields(BoardRow))
_ROW_KINDS: Final = dict.fromkeys(_ROW, str) | {
    "env_steps": int, "num_envs": int, "drones": int, "options": dict
}  # fmt: skip
_KIND_WORDS: Final = {int: "a whole number", str: "a text", dict: "a table", list: "[[row]] tables"}


def _content(config: BenchmarkConfig) -> dict[str, Any]:
    rows = []
    for row in config.rows:
        spec = env_spec(row.flown)
        rows.append({name: getattr(row, name) for name in _ROW} | {
            "hyperparameters": {} if row.controller else asdict(row.run(0).config),
            "bounds": known_bounds(row, config.episodes),
            "spec": json.loads(spec.to_json()),
        })  # fmt: skip
    return {"board": {name: getattr(config, name) for name in _SETTINGS}, "rows": rows}


def read_rows_file(path: Path, **changes: Any) -> BenchmarkConfig:
    """Settings of a board from its TOML file, with some of them changed. Raises `InputError`."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: expected a TOML file of rows: {error.strerror}") from None
    except ValueError as error:
        raise InputError(f"{path}: expected a TOML file of rows, got: {error}") from None
    _check_table(f"{path}", content, dict.fromkeys(_SETTINGS, int) | {"row": list})
    tables = content.pop("row", [])
    for place, table in enumerate(tables, start=1):
        _check_table(f"{path}: row {place}", table, _ROW_KINDS)
        expect("agent" in table, f"{path}: row {place}", "an agent", "none")
    try:
        rows = tuple(BoardRow(**table) for table in tables)
        return BenchmarkConfig(**content | {"rows": rows} | changes)
    except TypeError as error:
        raise InputError(f"{path}: expected the settings of a board, got: {error}") from None


def _check_table(where: str, table: Any, kinds: Mapping[str, type]) -> None:
    """Raises `InputError` unless every name of a table is known and has a value of its type."""
    expect(type(table) is dict, where, "a table", f"{table!r:.80}")
    for name, value in table.items():
        expect(name in kinds, where, f"some of {', '.join(kinds)}", repr(name))
        kind = kinds[name]
        expect(type(value) is kind, f"{where}: {name}", _KIND_WORDS[kind], f"{value!r:.80}")


class Board(NamedTuple):
    """A folder of `benchmark`."""

    content: dict[str, Any]
    """`config.json`."""
    config: BenchmarkConfig
    specs: dict[str, EnvSpec]
    """Of the env of each row, by the row's name."""
    bounds: dict[str, dict[str, float]]
    """Of its returns, by the row's name: `known_bounds`."""
    seeds: pd.DataFrame
    """`seeds.csv`, `SEED_COLUMNS`."""


def read_board(folder: Path) -> Board:
    """Read a board. Raises `ResultsError`."""
    path = folder / CONFIG_FILE
    content = results.content_of(folder)
    try:
        rows = [BoardRow(**{name: row[name] for name in _ROW}) for row in content["rows"]]
        config = BenchmarkConfig(rows=tuple(rows), **content["board"])
        specs = [EnvSpec.from_json(json.dumps(row["spec"])) for row in content["rows"]]
        bounds = [row["bounds"] for row in content["rows"]]
    except (KeyError, TypeError, InputError) as error:
        raise ResultsError(f"{path}: expected a board's settings, got: {error!r}") from None
    names = [row.name for row in rows]
    named, of_returns = (dict(zip(names, values, strict=True)) for values in (specs, bounds))
    return Board(content, config, named, of_returns, read_seeds(folder, config))


def read_seeds(folder: Path, config: BenchmarkConfig) -> pd.DataFrame:
    """The runs that are done, `SEED_COLUMNS`. Raises `ResultsError` if others are there."""
    wanted = {(row.name, seed) for row, seed in config.runs().values()}
    return read_rows(folder / SEEDS_FILE, SEED_COLUMNS, ("row", "seed"), wanted, "board")
