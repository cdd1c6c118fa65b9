"""The files of a study: their names and columns, writing and reading them.

A study writes one folder. Everything that is drawn, tabulated or judged is read back from it.
`config.json` has the study, the spec of each row's env, versions and machine. Each table is a
folder with a Parquet file for each run, that is row and seed. `Results` reads it whole; files of
different rows may have different columns.

| table | one row per |
|---|---|
| `runs` | run: `metrics.measure_run` and the times of its training |
| `evaluations` | deterministic evaluation episode of a policy snapshot |
| `episodes` | training episode |
| `steps` | env step of training and of the final evaluation, if the study keeps steps |

All tables begin with the columns `row` and `seed`. A size or value is that of the row's headline
metric.
"""

import json
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from ..envs.spec import EnvSpec
from ..models.errors import InputError
from ..models.files import read_own_toml, software_versions, write_json, write_whole
from .metrics import Headline
from .settings import Row, Study, file_words

CONFIG_FILE = "config.json"
CHECKPOINTS = "checkpoints"

COLUMNS = read_own_toml(__file__, "assets/tables")
"""Columns of each table: what each holds, by its name.

`evaluations` may have more, of what was drawn.
"""

Tables = Mapping[str, pd.DataFrame]
"""Tables by name."""


# ---- writing


def write_config(folder: Path, command: str, study: Study, specs: Mapping[str, EnvSpec]) -> None:
    """Write `config.json`: the user's command, the study, and by the names of the rows the specs of
    their envs and the hashes of their controllers.
    """
    content = {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "study": study.to_dict(),
        "specs": {name: json.loads(spec.to_json()) for name, spec in specs.items()},
        "sources": {row.name: row.source_hash for row in study.rows},
        "versions": software_versions(),
        "machine": machine(),
    }
    write_json(folder / CONFIG_FILE, content)


def check_unchanged(folder: Path, study: Study, specs: Mapping[str, EnvSpec]) -> None:
    """Raise `InputError` for a row that is no more what it was when the study began."""
    begun = Results.read(folder)
    sources = begun.config.get("sources", {})
    for row in study.rows:
        changed = ""
        if specs[row.name].config_digest != begun.specs[row.name].config_digest:
            changed = "task, vehicle or scene"
        elif row.source_hash != sources.get(row.name):
            changed = row.agent
        if changed:
            raise InputError(
                f"resume: {row.name}: expected the {changed} with which {folder} began, got another"
            )


def machine() -> dict[str, object]:
    """The machine, on which times depend."""
    return {
        "platform": platform.platform(),
        "processor": platform.machine(),
        "cores": os.cpu_count(),
    }


def run_name(row: Row, seed: int) -> str:
    """Name of the files of a run."""
    return f"{file_words(row.name)}-seed{seed}"


def checkpoint_file(folder: Path, row: Row, seed: int) -> Path:
    """The checkpoint of a run."""
    return folder / CHECKPOINTS / f"{run_name(row, seed)}.safetensors"


def run_file(folder: Path, row: Row, seed: int, table: str = "runs") -> Path:
    """File of a run in a table. A run is done when the table `runs` has it."""
    return folder / table / f"{run_name(row, seed)}.parquet"


def write_run(folder: Path, row: Row, seed: int, tables: Tables) -> None:
    """Write what one run gave; the table `runs` last."""
    for name in reversed(COLUMNS):
        if name in tables and len(tables[name]):  # columns of an empty table have no type
            table = tables[name].copy()
            table.insert(0, "row", row.name)
            table.insert(1, "seed", seed)
            data = table.to_parquet(index=False, compression="zstd")
            write_whole(run_file(folder, row, seed, name), data)


# ---- reading


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """The folder of a study; its tables are read when they are asked for.

    Raises `InputError` for a file that is missing or not what it should be.
    """

    folder: Path
    config: Mapping[str, Any]
    """`config.json`."""
    study: Study
    specs: Mapping[str, EnvSpec]
    """Of each row's env, by the row's name."""

    @classmethod
    def read(cls, folder: Path) -> "Results":
        """Raises `InputError`."""
        path = folder / CONFIG_FILE
        if not path.is_file():
            raise InputError(f"{folder}: expected the folder of a study, there is no {path}")
        try:
            config = json.loads(path.read_text(encoding="utf-8"))
            study = Study.from_dict(f"{path}: study", config["study"])
            specs = {
                name: EnvSpec.from_json(json.dumps(spec)) for name, spec in config["specs"].items()
            }
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            text = str(error) if isinstance(error, InputError) else repr(error)
            raise InputError(f"{path}: expected the settings of a study, got: {text}") from None
        return cls(folder=folder, config=config, study=study, specs=specs)

    def headline(self, row: Row) -> Headline:
        """The metric that decides in the row's env."""
        return Headline.of(self.specs[row.name])

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Of the runs that are done, in the order of the rows and seeds."""
        order = {row.name: place for place, row in enumerate(self.study.rows)}
        return self._table("runs").sort_values(
            ["row", "seed"],
            key=lambda column: column.map(order) if column.name == "row" else column,
            ignore_index=True,
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

        Keeps about `max_rows` rows, drawn with a fixed seed: a stride that divides the episode
        length would show the same moments of every episode.
        """
        table = pq.read_table(self.folder / "steps", filters=[("phase", "==", phase)])
        if max_rows is not None and max_rows < len(table):
            kept = np.random.default_rng(0).random(len(table)) < max_rows / len(table)
            table = table.filter(kept)
        frame: pd.DataFrame = table.to_pandas()
        return frame

    def _table(self, name: str) -> pd.DataFrame:
        files = sorted((self.folder / name).glob("*.parquet"))
        if not files:
            return pd.DataFrame(columns=list(COLUMNS[name]))
        try:
            table = pd.concat(map(pd.read_parquet, files), ignore_index=True)
        except pa.ArrowInvalid as error:
            raise InputError(f"{files[0].parent}: expected Parquet files, got: {error}") from None
        missing = [column for column in COLUMNS[name] if column not in table]
        if missing:
            raise InputError(
                f"{files[0].parent}: expected the columns {', '.join(COLUMNS[name])}, "
                f"got no {', '.join(missing)}"
            )
        return table
