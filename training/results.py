"""The files of a study: their names and columns, writing and reading them.

A study writes one folder. Everything that is drawn, tabulated or judged is read back from it.

| file | one row per |
|---|---|
| `config.json` | (the study, the spec of each row's env, versions and machine) |
| `runs.csv` | run, that is row and seed: `metrics.measure_run` and the times of its training |
| `evaluations.parquet` | deterministic evaluation episode of a policy snapshot |
| `episodes.parquet` | training episode |
| `steps.parquet` | env step of training and of the final evaluation, if the study keeps steps |

An unfinished study has a folder `parts` with a folder for each run that is done. All tables begin
with the columns `row` and `seed`. A size or value is that of the row's headline metric.
"""

import json
import os
import platform
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from ..agents.checkpoints import software_versions, write_whole
from ..envs.spec import EnvSpec, SpecError
from ..models.errors import InputError
from .metrics import Headline
from .settings import Row, Study

CONFIG_FILE = "config.json"
PARTS = "parts"
CHECKPOINTS = "checkpoints"

COLUMNS: Final[Mapping[str, tuple[str, ...]]] = {
    "runs": (
        "row", "seed", "env_steps", "seconds", "steps_per_second",
        "steady", "settling_time", "overshoot", "return", "episodes", "settled", "crashed", "held",
        "env_steps_to_hold", "seconds_to_hold",
    ),
    "evaluations": (
        "row", "seed",
        "env_steps", "seconds",  # of training behind the snapshot; s of wall time
        "episode", "length", "return",
        "start",  # the metric before the first step
        "steady",  # mean size in the last quarter
        "settling_time",  # s; missing if the error never settled
        "overshoot",  # missing if the metric has no sign
        "terminated",
    ),
    "episodes": (
        "row", "seed", "episode",
        "first_step", "last_step",  # env steps of the run, of all drones, at start and end
        "length", "return",
        "mean_size",  # mean size of the metric
        "terminated", "truncated",
        "seconds",  # training wall time when the episode ended
    ),
    "steps": (
        "row", "seed",
        "phase",  # "train" or "evaluation"
        "episode",  # within the run; -1: one that the end of training cut
        "step",  # of the run for train, of the episode for evaluation; from 1
        "value", "reward",
        "thrust",  # mean over the rotors, N
    ),
}  # fmt: skip
"""Columns of each table.

`evaluations` may have more, of what was drawn, and `runs` has `least_distance`, m,
where a world has several drones.
"""

_COUNTS = ("seed", "env_steps", "episodes", "settled", "crashed", "held")

Tables = Mapping[str, pd.DataFrame]
"""Tables by name."""


class ResultsError(InputError):
    """A file of results is missing or is not what it should be."""


# ---- writing


def write_config(folder: Path, command: str, study: Study, specs: Mapping[str, EnvSpec]) -> None:
    """Write `config.json`: the user's command, the study, the spec of each row's env."""
    content = {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "study": study.to_dict(),
        "specs": {name: json.loads(spec.to_json()) for name, spec in specs.items()},
        "versions": software_versions(),
        "machine": machine(),
    }
    write_whole(folder / CONFIG_FILE, (json.dumps(content, indent=2) + "\n").encode())


def machine() -> dict[str, object]:
    """Machine on which times depend."""
    return {
        "platform": platform.platform(),
        "processor": platform.machine(),
        "cores": os.cpu_count(),
    }


def part_name(row: Row, seed: int) -> str:
    """Name of the files of a run."""
    return f"{file_words(row.name)}-seed{seed}"


def file_words(text: str) -> str:
    """A text as part of a file's name."""
    letters = (letter if letter.isalnum() or letter in ".=+_" else "-" for letter in text)
    return "".join(letters).strip("-").lower()


def checkpoint_file(folder: Path, row: Row, seed: int) -> Path:
    """The checkpoint of a run."""
    return folder / CHECKPOINTS / f"{part_name(row, seed)}.safetensors"


def write_part(folder: Path, row: Row, seed: int, tables: Tables) -> None:
    """Write what one run gave: a folder that is there whole or not at all."""
    part = folder / PARTS / part_name(row, seed)
    unfinished = part.with_name(f".{part.name}")
    unfinished.mkdir(parents=True)
    for name, table in tables.items():
        named = table.drop(columns=["row", "seed"], errors="ignore")
        named.insert(0, "row", row.name)
        named.insert(1, "seed", seed)
        named.to_parquet(unfinished / f"{name}.parquet", index=False, compression="zstd")
    unfinished.rename(part)


def join_parts(folder: Path) -> None:
    """Make the tables of a study out of the parts of its runs, and remove these."""
    parts = folder / PARTS
    for name in COLUMNS:
        files = _parts_of(folder, name)
        if not files:
            continue
        if name == "runs":
            write_whole(folder / "runs.csv", _concatenated(files).to_csv(index=False).encode())
            continue
        schema = pa.unify_schemas([pq.read_schema(file).remove_metadata() for file in files])
        with pq.ParquetWriter(folder / f"{name}.parquet", schema, compression="zstd") as writer:
            for file in files:
                parted = [schema.empty_table(), pq.read_table(file)]  # it may lack columns
                writer.write_table(pa.concat_tables(parted, promote_options="permissive"))
    # Whole or not at all: a half-removed part would look like one to resume from.
    shutil.rmtree(parts.rename(parts.with_name(f".{PARTS}")))


def _parts_of(folder: Path, name: str) -> list[Path]:
    return sorted((folder / PARTS).glob(f"[!.]*/{name}.parquet"))


def _concatenated(files: list[Path]) -> pd.DataFrame:
    return pd.concat([pd.read_parquet(file) for file in files], ignore_index=True)


# ---- reading


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """The folder of a study; its tables are read when they are asked for.

    Raises `ResultsError` for a file that is missing or not what it should be.
    """

    folder: Path
    config: Mapping[str, Any]
    """`config.json`."""
    study: Study
    specs: Mapping[str, EnvSpec]
    """Of each row's env, by the row's name."""

    @classmethod
    def read(cls, folder: Path | str) -> "Results":
        """Raises `ResultsError`."""
        path = Path(folder) / CONFIG_FILE
        if not path.is_file():
            raise ResultsError(
                f"{folder}: expected the folder of a study, got one without {CONFIG_FILE}"
            )
        try:
            config = json.loads(path.read_text(encoding="utf-8"))
            study = Study.from_dict(f"{path}: study", config["study"])
            specs = {
                name: EnvSpec.from_json(json.dumps(spec)) for name, spec in config["specs"].items()
            }
        except (AttributeError, KeyError, TypeError, ValueError, SpecError) as error:
            text = str(error) if isinstance(error, InputError) else repr(error)
            raise ResultsError(f"{path}: expected the settings of a study, got: {text}") from None
        return cls(folder=Path(folder), config=config, study=study, specs=specs)

    def headline(self, row: Row) -> Headline:
        """The metric that decides in the row's env."""
        return Headline.of(self.specs[row.name])

    @property
    def finished(self) -> bool:
        """Whether all runs are done."""
        return not (self.folder / PARTS).exists() and (self.folder / "runs.csv").exists()

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Of the runs that are done, in the order of the rows and seeds."""
        path = self.folder / "runs.csv"
        runs = _read_csv(path) if path.exists() else self._table("runs")
        order = {row.name: place for place, row in enumerate(self.study.rows)}
        return runs.sort_values(
            ["row", "seed"], key=lambda values: values.map(order).fillna(values), ignore_index=True
        )

    @cached_property
    def evaluations(self) -> pd.DataFrame:
        """Evaluation episodes."""
        return self._table("evaluations")

    @cached_property
    def episodes(self) -> pd.DataFrame:
        """Training episodes; one that the end of training cut is not there."""
        return self._table("episodes")

    def steps(self, phase: str, max_rows: int | None = None) -> pd.DataFrame:
        """Steps of one phase, "train" or "evaluation".

        Of more rows than `max_rows` about `max_rows` are kept, at random but always the same: a
        stride that divides the episode length would show the same moments of every episode.
        """
        files = self._files("steps")
        if not files:
            return pd.DataFrame(columns=list(COLUMNS["steps"]))
        table = pa.concat_tables(
            pq.read_table(file, filters=[("phase", "==", phase)]) for file in files
        )
        if max_rows is not None and max_rows < len(table):
            kept = np.random.default_rng(0).random(len(table)) < max_rows / len(table)
            table = table.filter(kept)
        frame: pd.DataFrame = table.to_pandas()
        return frame

    def _files(self, name: str) -> list[Path]:
        path = self.folder / f"{name}.parquet"
        return [path] if path.exists() else _parts_of(self.folder, name)

    def _table(self, name: str) -> pd.DataFrame:
        files = self._files(name)
        if not files:
            return pd.DataFrame(columns=list(COLUMNS[name]))
        try:
            table = _concatenated(files)
        except pa.ArrowInvalid as error:
            raise ResultsError(f"{files[0]}: expected a Parquet file: {error}") from None
        _check_columns(files[0], name, list(table.columns))
        return table


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        text = pd.read_csv(path, dtype=str)
        # By way of texts, so that every number keeps its bits.
        types = {name: int if name in _COUNTS else float for name in text.columns[1:]}
        runs = text.astype(types)
    except ValueError as error:  # an empty file, or a value that is not of the column's type
        raise ResultsError(f"{path}: expected the runs of a study: {error}") from None
    _check_columns(path, "runs", list(runs.columns))
    return runs


def _check_columns(path: Path, name: str, present: list[str]) -> None:
    missing = [column for column in COLUMNS[name] if column not in present]
    if missing:
        raise ResultsError(
            f"{path}: expected the columns {', '.join(COLUMNS[name])}, got one without "
            f"{', '.join(missing)}"
        )
