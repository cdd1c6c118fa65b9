"""The files of a comparison: their names, their columns, writing and reading them.

`rotorgram compare` writes one folder. Everything that is drawn, tabulated or judged is read back
from it, so these column tables are the contract between the side that trains and the side that
reports.

| file | one row per |
|---|---|
| `config.json` | (the comparison's configuration, the env's spec, versions and machine) |
| `episodes.csv` | training episode |
| `steps.parquet` | environment step of training and of the final evaluation |
| `evaluations.csv` | deterministic evaluation episode of a policy snapshot |
| `runs.csv` | training run (agent and seed) |
| `positions.parquet` | drone and control step of the final evaluation, where a world has several |

The column of the headline metric has the metric's own name, such as `elevation_error`; its unit
stands in `config.json`. In data frames its name says what it is: `steady`
(mean size in the last quarter of an evaluation episode), `mean_size` (over a training episode) or
`value` (after a step).
"""

import json
import os
import platform
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset as pads
import pyarrow.parquet as pq

from ..agents.checkpoints import software_versions, write_whole
from ..agents.episodes import Episode
from ..envs.spec import EnvSpec, SpecError
from ..flights.trajectories import Trajectory
from ..models.errors import InputError
from .metrics import Headline, overshoot, settling_time, steady_state
from .swarms import GOAL, POSITION

CONFIG_FILE: Final = "config.json"
EPISODES_FILE: Final = "episodes.csv"
STEPS_FILE: Final = "steps.parquet"
EVALUATIONS_FILE: Final = "evaluations.csv"
RUNS_FILE: Final = "runs.csv"
POSITIONS_FILE: Final = "positions.parquet"

CONFIG_KEYS: Final = ("created", "command", "preset", "seeds", "env_steps", "spec", "vehicle",
                      "agents", "versions", "machine")  # fmt: skip

EPISODE_COLUMNS: Final[Mapping[str, str]] = {
    "agent": "str",
    "seed": "int64",
    "episode": "int64",
    "first_step": "int64",  # env steps of the run, of all drones, before the episode began
    "last_step": "int64",  # and when it ended
    "length": "int64",  # control steps
    "return": "float64",
    "mean_size": "float64",  # in the file under the metric's name: mean size, metric's unit
    "terminated": "bool",
    "truncated": "bool",
    "seconds": "float64",  # training wall time when the episode ended
}

EVALUATION_COLUMNS: Final[Mapping[str, str]] = {
    "agent": "str",
    "seed": "int64",
    "env_steps": "int64",  # training behind the snapshot
    "seconds": "float64",  # training wall time behind the snapshot
    "episode": "int64",
    "length": "int64",  # control steps
    "return": "float64",
    "start": "float64",  # the metric before the first step
    "steady": "float64",  # in the file under the metric's name: mean size in the last quarter
    "settling_time": "float64",  # s; empty if the error never settled
    "overshoot": "float64",  # metric's unit; empty if the metric has no sign
    "terminated": "bool",
}

RUN_COLUMNS: Final[Mapping[str, str]] = {
    "agent": "str",
    "seed": "int64",
    "env_steps": "int64",
    "seconds": "float64",
    "steps_per_second": "float64",
}

POSITION_SCHEMA: Final = pa.schema(
    {
        "agent": pa.dictionary(pa.int32(), pa.string()),
        "seed": pa.int32(),
        "episode": pa.int32(),
        "drone": pa.int32(),  # its place in the spec's `agents`
        "step": pa.int32(),  # 0 is the start
        **dict.fromkeys((*POSITION, *GOAL), pa.float32()),  # paper's frame, m
    }
)
"""Columns of `positions.parquet`."""

_TABLES: Final = {
    EPISODES_FILE: EPISODE_COLUMNS,
    EVALUATIONS_FILE: EVALUATION_COLUMNS,
    RUNS_FILE: RUN_COLUMNS,
}


class ResultsError(InputError):
    """A file of results is missing or is not what it should be."""


def _in_file(column: str, metric: str) -> str:
    return metric if column in ("mean_size", "steady", "value") else column


def step_schema(metric: str) -> pa.Schema:
    """Columns of `steps.parquet`, the headline metric by its name."""
    columns = {
        "agent": pa.dictionary(pa.int32(), pa.string()),
        "seed": pa.int32(),
        "phase": pa.dictionary(pa.int32(), pa.string()),  # "train" or "evaluation"
        "episode": pa.int32(),  # within the run; -1: one that the end of training cut
        "step": pa.int32(),  # of the run for train, of the episode for evaluation; from 1
        metric: pa.float32(),
        "reward": pa.float32(),
        "thrust": pa.float32(),  # mean over the rotors, N
    }
    return pa.schema(columns)


# ---- config.json


def write_config(
    folder: Path, command: str, spec: EnvSpec, vehicle: str | None, content: Mapping[str, Any]
) -> None:
    """Write `config.json`: the user's command, the env's spec, the path of its vehicle, and
    the settings of the comparison or the sweep, with which all of `CONFIG_KEYS` are there.
    """
    about = {"spec": json.loads(spec.to_json()), "vehicle": vehicle}
    write_settings(folder, command, {**content, **about})


def write_settings(folder: Path, command: str, content: Mapping[str, Any]) -> None:
    """Write `config.json`: the user's command, settings, versions and machine."""
    whole = {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        **content,
        "versions": software_versions(),
        "machine": machine(),
    }
    write_whole(folder / CONFIG_FILE, (json.dumps(whole, indent=2) + "\n").encode())


def machine() -> dict[str, Any]:
    """Machine and software on which times depend."""
    cores = os.cpu_count()
    return {"platform": platform.platform(), "processor": platform.machine(), "cores": cores}


def read_config(folder: Path | str) -> dict[str, Any]:
    """Read `config.json` and check that the keys of `CONFIG_KEYS` are there."""
    config = content_of(folder)
    _check_names(Path(folder) / CONFIG_FILE, "key", CONFIG_KEYS, config)
    return config


def content_of(folder: Path | str) -> dict[str, Any]:
    """Content of any `config.json`. Raises `ResultsError` if there is none."""
    path = _existing(folder, CONFIG_FILE)
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (TypeError, ValueError) as error:
        raise ResultsError(f"{path} is not JSON, or no object: {error}") from error


def read_spec(folder: Path | str) -> EnvSpec:
    """The env's spec from `config.json`. Raises `ResultsError`."""
    try:
        return EnvSpec.from_json(json.dumps(read_config(folder)["spec"]))
    except SpecError as error:
        raise ResultsError(f"{Path(folder) / CONFIG_FILE}: {error}") from None


# ---- writing


Rows = Mapping[str, list[dict[str, Any]]]
"""Rows by the name of their file."""


def write_part(
    part: Path,
    metric: str,
    rows: Rows,
    steps: list[pa.Table],
    positions: pd.DataFrame | None = None,
) -> None:
    """Write what one run gave: a folder that is there whole or not at all."""
    unfinished = part.with_name(f".{part.name}")
    unfinished.mkdir(parents=True)
    for name, columns in _TABLES.items():
        given = rows.get(name, [])
        drawn = [key for key in (given[0] if given else ()) if key.startswith("drawn_")]
        table = pd.DataFrame(given, columns=[*columns, *drawn])
        table.columns = [*(_in_file(column, metric) for column in columns), *drawn]
        table.to_csv(unfinished / name, index=False)
    pq.write_table(pa.concat_tables(steps), unfinished / STEPS_FILE, compression="zstd")
    if positions is not None:
        table = pa.Table.from_pandas(positions, POSITION_SCHEMA, preserve_index=False)
        pq.write_table(table, unfinished / POSITIONS_FILE, compression="zstd")
    unfinished.rename(part)


def join_parts(parts: Path, folder: Path, metric: str) -> None:
    """Make the tables of a comparison out of the parts of its runs, and remove these."""
    names = sorted(p.name for p in parts.iterdir() if not p.name.startswith("."))
    for table in _TABLES:
        lines = [(parts / name / table).read_text().splitlines(keepends=True) for name in names]
        body = [line for part in lines for line in part[1:]]
        header = max((part[0] for part in lines), key=len)  # one without rows lacks what was drawn
        (folder / table).write_text("".join([header, *body]))
    for file, schema in ((STEPS_FILE, step_schema(metric)), (POSITIONS_FILE, POSITION_SCHEMA)):
        if not (parts / names[0] / file).exists():  # one drone has no positions
            continue
        with pq.ParquetWriter(folder / file, schema, compression="zstd") as writer:
            for name in names:
                writer.write_table(pq.read_table(parts / name / file, schema=schema))
    # Whole or not at all: a half-removed part would look like one to resume from.
    shutil.rmtree(parts.rename(parts.with_name(f".{parts.name}")))


def episode_row(episode: Episode, num_envs: int, env_steps: int) -> dict[str, Any]:
    """A training episode as a row of `episodes.csv`, without agent and seed."""
    # While one drone flies a step, each of the others does.
    last = min(episode.first_step + episode.length * num_envs, env_steps)
    return {**asdict(episode), "return": episode.total_reward, "last_step": last}


def evaluation_row(trajectory: Trajectory, headline: Headline) -> dict[str, Any]:
    """A trajectory as a row of `evaluations.csv`, but for the columns that name the run.

    What was drawn for the episode follows in columns of its own.
    """
    values = trajectory.headline
    steady = steady_state(headline.size(values[1:]), final=headline.final)
    settled = np.nan
    crashed = trajectory.terminated and not (headline.final and headline.holds([steady]))
    if headline.settles and not crashed:
        settled = settling_time(values, trajectory.spec.control_period, headline.settled or 0.0)
    specs = [array for array in trajectory.spec.telemetry if array.name == "drawn"]
    told = [trajectory.telemetry[array.name][0].tolist() for array in specs]
    drawn = dict(zip(specs[0].components, told[0], strict=True)) if specs else {}
    return {
        "episode": trajectory.episode,
        "length": len(trajectory),
        "return": float(trajectory.rewards.sum()),
        "start": float(values[0]),
        "steady": steady,
        "settling_time": settled,
        "overshoot": overshoot(values) if headline.signed else np.nan,
        "terminated": trajectory.terminated,
        **drawn,
    }


def step_table(metric: str, **columns: Any) -> pa.Table:
    """Rows of `steps.parquet`: columns but `step`, the metric's as `value`; one value or (T,)."""
    columns["step"] = np.arange(1, len(columns["reward"]) + 1)
    frame = pd.DataFrame({_in_file(name, metric): column for name, column in columns.items()})
    table = pa.Table.from_pandas(frame, step_schema(metric), preserve_index=False)
    return table.replace_schema_metadata()


# ---- reading


@dataclass(frozen=True, kw_only=True)
class Results:
    """Contents of a comparison's folder, without the step rows (see `read_steps`)."""

    config: dict[str, Any]
    """`config.json`."""
    spec: EnvSpec
    headline: Headline
    episodes: pd.DataFrame
    """Training episodes, `EPISODE_COLUMNS`; one that the end of training cut is not there."""
    evaluations: pd.DataFrame
    """Evaluation episodes, `EVALUATION_COLUMNS`."""
    runs: pd.DataFrame
    """Training runs, `RUN_COLUMNS`."""
    positions: pd.DataFrame | None = None
    """Of several drones in the final evaluation, `POSITION_SCHEMA`."""


def read_results(folder: Path | str) -> Results:
    """Read all files of a comparison but the step rows. Raises `ResultsError`."""
    spec = read_spec(folder)
    headline = Headline.of(spec)
    tables = {name.removesuffix(".csv"): _read_csv(folder, name, headline.name) for name in _TABLES}
    positions = _read_positions(Path(folder) / POSITIONS_FILE)
    return Results(config=read_config(folder), spec=spec, headline=headline, positions=positions,
                   **tables)  # fmt: skip


def _read_positions(path: Path) -> pd.DataFrame | None:
    if not path.is_file():
        return None
    try:
        table = pq.read_table(path)
    except pa.ArrowInvalid as error:
        raise ResultsError(f"{path} is not a Parquet file: {error}") from error
    _check_names(path, "column", POSITION_SCHEMA.names, table.schema.names)
    frame: pd.DataFrame = table.unify_dictionaries().to_pandas()
    return frame


def read_steps(
    folder: Path | str,
    metric: str,
    phase: str,
    columns: Iterable[str] = ("agent", "seed", "episode", "step", "value"),
    max_rows: int | None = None,
) -> pd.DataFrame:
    """Read some columns of one phase of `steps.parquet`, "train" or "evaluation"; others are not
    read from the disk. The column of the headline metric, which is given by name, becomes `value`.

    Of more than `max_rows` rows about so many are kept, picked at random but always the same ones:
    a stride that divides the episode length would show the same moments of every episode.
    """
    path = _existing(folder, STEPS_FILE)
    try:
        dataset = pads.dataset(path, format="parquet")
    except pa.ArrowInvalid as error:
        raise ResultsError(f"{path} is not a Parquet file: {error}") from error
    whole = step_schema(metric)
    _check_names(path, "column", whole.names, dataset.schema.names)
    names = [_in_file(column, metric) for column in columns]
    table = dataset.to_table(columns=names, filter=pads.field("phase") == phase)
    if max_rows is not None and max_rows < (count := pq.read_metadata(path).num_rows):
        table = table.filter(np.random.default_rng(0).random(len(table)) < max_rows / count)
    table = table.cast(pa.schema([whole.field(name) for name in names]))
    frame: pd.DataFrame = table.unify_dictionaries().to_pandas()
    return frame.rename(columns={metric: "value"})


def _existing(folder: Path | str, name: str) -> Path:
    path = Path(folder) / name
    if not path.is_file():
        wanted = "the folder of a comparison, a sweep or a board"
        raise ResultsError(f"{folder}: expected {wanted}, got one without {name}")
    return path


def _check_names(path: Path, kind: str, wanted: Iterable[str], present: Iterable[str]) -> None:
    if missing := [name for name in wanted if name not in set(present)]:
        lacks = f"{kind}{'s' * (len(missing) > 1)} {', '.join(missing)}"
        has = ", ".join(present) or "none"
        raise ResultsError(f"{path} lacks the {lacks}; it has {has}. Is it of a comparison?")


def _read_csv(folder: Path | str, name: str, metric: str) -> pd.DataFrame:
    path, columns = _existing(folder, name), _TABLES[name]
    types = {_in_file(column, metric): kind for column, kind in columns.items()}
    try:
        frame = pd.read_csv(path, dtype=types)
    except ValueError as error:  # an empty file, or a value that is not of the column's type
        raise ResultsError(f"{path} cannot be read: {error}") from error
    _check_names(path, "column", types, list(frame.columns))
    return frame[list(types)].set_axis(list(columns), axis=1)
