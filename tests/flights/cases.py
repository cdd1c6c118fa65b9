"""Cases of the tests beside it, from `tests/data/flights.toml`."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

CASES: dict[str, dict[str, Any]] = tomllib.loads(
    (Path(__file__).parents[1] / "data" / "flights.toml").read_text("utf-8")
)


def each(names: str, table: str) -> pytest.MarkDecorator:
    """Parametrizes a test by the rows of a table."""
    rows = CASES[table]
    return pytest.mark.parametrize(names, list(rows.values()), ids=list(rows))
