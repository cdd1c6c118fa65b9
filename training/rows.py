"""A CSV file with a row for each run that is done: whole at any moment, and read to go on."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from ..agents.checkpoints import write_whole
from .results import ResultsError


def adding_rows(
    path: Path,
    done: pd.DataFrame,
    shown: Callable[[pd.DataFrame], pd.DataFrame] = lambda rows: rows,
) -> Callable[[Mapping[str, Any]], None]:
    """A function that adds a row, by column, to those that are done, and writes the file. Of a row
    the columns are kept that those have; `shown` adds others for readers.
    """
    rows, columns = done.to_dict("records"), list(done.columns)

    def add(row: Mapping[str, Any]) -> None:
        rows.append(dict(row))
        table = shown(pd.DataFrame(rows, columns=columns))
        write_whole(path, table.to_csv(index=False).encode())

    return add


def read_rows(
    path: Path, columns: Mapping[str, str], key: Sequence[str], wanted: set[Any], what: str
) -> pd.DataFrame:
    """The rows of a file, none if there is no file: columns by name with their type.

    The columns of the key tell the runs apart; `wanted` has the keys that may be there. Raises
    `ResultsError` if others are there, saying of what the runs should be.
    """
    if not path.exists():
        return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in columns.items()})
    try:
        # By way of strings: they are written again with every run, and have to keep their bits.
        text = pd.read_csv(path, usecols=list(columns), dtype=str)
        rows = text[list(columns)].astype(dict(columns))
    except ValueError as error:  # an empty file, a missing column, or a value of another type
        raise ResultsError(f"{path}: expected the runs of a {what}: {error}") from None
    got = list(rows[list(key)].itertuples(index=False, name=None))
    if len(set(got)) < len(got) or not wanted.issuperset(got):
        raise ResultsError(f"{path}: expected each run of the {what} once, got others")
    return rows
