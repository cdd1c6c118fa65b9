"""The files of a comparison: their names, their columns and how to read them.

`rotorgram compare` writes one folder. Everything that is drawn, tabulated or judged is read back
from it, so these column tables are the contract between the side that trains and the side that
reports.

| file | one row per |
|---|---|
| `config.json` | (the comparison's configuration, versions and machine) |
| `episodes.csv` | training episode |
| `steps.parquet` | environment step of training and of the final evaluation |
| `evaluations.csv` | deterministic evaluation episode of a policy snapshot |
| `runs.csv` | training run (agent and seed) |
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset as pads
import pyarrow.parquet as pq

__all__ = [
    "CONFIG_FILE",
    "CONFIG_KEYS",
    "EPISODES_FILE",
    "EPISODE_COLUMNS",
    "EVALUATIONS_FILE",
    "EVALUATION_COLUMNS",
    "RUNS_FILE",
    "RUN_COLUMNS",
    "STEPS_FILE",
    "STEP_SCHEMA",
    "Records",
    "RecordsError",
    "read_config",
    "read_episodes",
    "read_evaluations",
    "read_records",
    "read_runs",
    "read_steps",
    "sort_agents",
]

CONFIG_FILE: Final = "config.json"
EPISODES_FILE: Final = "episodes.csv"
STEPS_FILE: Final = "steps.parquet"
EVALUATIONS_FILE: Final = "evaluations.csv"
RUNS_FILE: Final = "runs.csv"

CONFIG_KEYS: Final = (
    "created",
    "command",
    "preset",
    "seeds",
    "env_steps",
    "env",
    "agents",
    "versions",
    "model_hash",
    "machine",
)

EPISODE_COLUMNS: Final[Mapping[str, str]] = {
    "agent": "str",
    "seed": "int64",
    "episode": "int64",
    "first_step": "int64",  # env step of the run at which the episode began
    "length": "int64",  # control steps
    "return": "float64",
    "mean_abs_error": "float64",  # m
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
    "steady_error": "float64",  # mean |E| in the last quarter of the episode, m
    "settling_time": "float64",  # s; empty if the error never settled
    "overshoot": "float64",  # m
    "terminated": "bool",
}

RUN_COLUMNS: Final[Mapping[str, str]] = {
    "agent": "str",
    "seed": "int64",
    "env_steps": "int64",
    "seconds": "float64",
    "steps_per_second": "float64",
}

STEP_SCHEMA: Final = pa.schema(
    [
        ("agent", pa.dictionary(pa.int32(), pa.string())),
        ("seed", pa.int32()),
        ("phase", pa.dictionary(pa.int32(), pa.string())),  # "train" or "evaluation"
        ("episode", pa.int32()),
        ("step", pa.int32()),  # within the run for train, within the episode for evaluation
        ("error", pa.float32()),  # E, m
        ("reward", pa.float32()),
        ("thrust", pa.float32()),  # F1, N
    ]
)

_AGENT_ORDER: Final = ("vpg", "a2c", "sb3-a2c", "pid")


class RecordsError(ValueError):
    """A file of the comparison is missing or is not what it should be."""


@dataclass(frozen=True, kw_only=True)
class Records:
    """What a comparison's folder holds, less the step rows (see `read_steps`)."""

    config: dict[str, Any]
    """`config.json`."""
    episodes: pd.DataFrame
    """Training episodes, `EPISODE_COLUMNS`; one that the end of training cut is not recorded."""
    evaluations: pd.DataFrame
    """Evaluation episodes, `EVALUATION_COLUMNS`."""
    runs: pd.DataFrame
    """Training runs, `RUN_COLUMNS`."""


def sort_agents(names: Iterable[str]) -> list[str]:
    """Put agents in the order in which they are shown: the paper's, the reference, others."""
    known = {name: place for place, name in enumerate(_AGENT_ORDER)}
    return sorted(set(names), key=lambda name: (known.get(name, len(known)), name))


def read_records(folder: Path | str) -> Records:
    """Read all files of a comparison but the step rows."""
    return Records(
        config=read_config(folder),
        episodes=read_episodes(folder),
        evaluations=read_evaluations(folder),
        runs=read_runs(folder),
    )


def read_config(folder: Path | str) -> dict[str, Any]:
    """Read `config.json` and check that the keys of `CONFIG_KEYS` are there."""
    path = _existing(folder, CONFIG_FILE)
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise RecordsError(f"{path} is not JSON: {error}") from error
    if not isinstance(config, dict):
        raise RecordsError(f"{path} should hold an object, not a {type(config).__name__}")
    _check_names(path, "key", CONFIG_KEYS, config)
    return config


def read_episodes(folder: Path | str) -> pd.DataFrame:
    """Read `episodes.csv`, one row per training episode."""
    return _read_csv(folder, EPISODES_FILE, EPISODE_COLUMNS)


def read_evaluations(folder: Path | str) -> pd.DataFrame:
    """Read `evaluations.csv`, one row per evaluation episode."""
    return _read_csv(folder, EVALUATIONS_FILE, EVALUATION_COLUMNS)


def read_runs(folder: Path | str) -> pd.DataFrame:
    """Read `runs.csv`, one row per training run."""
    return _read_csv(folder, RUNS_FILE, RUN_COLUMNS)


def read_steps(
    folder: Path | str,
    phase: str,
    columns: Iterable[str] = ("agent", "seed", "episode", "step", "error"),
    max_rows: int | None = None,
) -> pd.DataFrame:
    """Read some columns of one phase of `steps.parquet`.

    Args:
        folder: The comparison's folder.
        phase: "train" or "evaluation".
        columns: Names from `STEP_SCHEMA`; others are not read from the disk.
        max_rows: Keep about this many rows. The rows are picked at random (always the same ones),
            not by a stride: a stride that divides the episode length would show the same moments
            of every episode.

    Returns:
        The rows, in the order of the file; `agent` is a category.
    """
    path = _existing(folder, STEPS_FILE)
    try:
        dataset = pads.dataset(path, format="parquet")
    except pa.ArrowInvalid as error:
        raise RecordsError(f"{path} is not a Parquet file: {error}") from error
    _check_names(path, "column", STEP_SCHEMA.names, dataset.schema.names)
    keep = 1.0
    if max_rows is not None:
        keep = min(1.0, max_rows / max(1, pq.read_metadata(path).num_rows))
    names = list(columns)
    schema = pa.schema([STEP_SCHEMA.field(name) for name in names])
    rng = np.random.default_rng(0)
    kept = []
    for batch in dataset.to_batches(columns=names, filter=pads.field("phase") == phase):
        if keep < 1.0:
            batch = batch.filter(pa.array(rng.random(batch.num_rows) < keep))
        kept.append(pa.Table.from_batches([batch]).cast(schema))
    table = pa.concat_tables(kept) if kept else schema.empty_table()
    return table.unify_dictionaries().to_pandas()


def _existing(folder: Path | str, name: str) -> Path:
    path = Path(folder) / name
    if not path.is_file():
        raise RecordsError(f"{path} is missing: is {folder} the folder of a comparison or a sweep?")
    return path


def _check_names(path: Path, kind: str, wanted: Iterable[str], present: Iterable[str]) -> None:
    missing = [name for name in wanted if name not in set(present)]
    if missing:
        raise RecordsError(
            f"{path} lacks the {kind}{'s' if len(missing) > 1 else ''} {', '.join(missing)}; "
            f"it has {', '.join(present) or 'none'}"
        )


def _read_csv(folder: Path | str, name: str, columns: Mapping[str, str]) -> pd.DataFrame:
    path = _existing(folder, name)
    try:
        present = list(pd.read_csv(path, nrows=0).columns)
        _check_names(path, "column", columns, present)
        return pd.read_csv(path, usecols=list(columns), dtype=dict(columns))[list(columns)]
    except RecordsError:
        raise
    except ValueError as error:  # an empty file, or a value that is not of the column's type
        raise RecordsError(f"{path} cannot be read: {error}") from error
