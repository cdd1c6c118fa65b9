"""`rotorgram check-model`: examine a vehicle's file, print a table of the checks."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from ..models.errors import InputError
from ._flags import Command

if TYPE_CHECKING:
    from ..models.checks import Check


@dataclass(frozen=True, kw_only=True)
class CheckModel(Command):
    """Examine anyone's multirotor: mass, units, rotors, hover, integrator, flights, floor.

    Exit status 1 if a check fails, 2 if the file is no free body with actuators.
    """

    file: Positional[Path | None] = None
    """MJCF or TOML file, or the name of a vehicle. Default: the paper's quadcopter."""
    json: bool = False
    """Print JSON in place of the table."""

    def run(self) -> int:
        """Print every check."""
        from ..models.checks import examine

        try:
            checks = examine(self.file)
        except InputError as error:
            error.exit_status = 2  # type: ignore[attr-defined]
            raise
        print_checks(checks, as_json=self.json)
        return 0 if all(check.passed for check in checks) else 1


def print_checks(checks: Sequence["Check"], *, as_json: bool = False) -> None:
    """Print an examination: a table and a sentence for each failed check, or JSON."""
    failed = [check for check in checks if not check.passed]
    if as_json:
        report = {"passed": not failed, "checks": [check.report() for check in checks]}
        print(json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False))
        return
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    wide = console.width >= 120
    columns = ["", "check", "measured", "expected"] + ["source"] * wide
    table = Table(*columns, box=SIMPLE_HEAD, pad_edge=False)
    for check in checks:
        note = f" ({check.note})" if check.note else ""
        cells = (
            "[green]ok" if check.passed else "[red]FAILED",
            escape(check.name),
            escape(f"{check.measured:.4g} {check.unit}".strip() + note),
            escape(expectation(check)),
            escape(check.source),
        )
        table.add_row(*cells[: len(columns)])
    console.print(table)
    for check in failed:
        print(f"{check.name}: {check.meaning}")
    print(f"{len(checks) - len(failed)} of {len(checks)} checks passed")


def expectation(check: "Check") -> str:
    """Expected value and tolerance of a check, or its range, without the unit."""
    if check.expected is not None:
        within = f" ± {check.tolerance:.2g}" if check.tolerance else ""
        return f"{check.expected:.4g}{within}"
    if check.high == float("inf"):
        return f"at least {check.low:.4g}"
    return f"{check.low:.4g} to {check.high:.4g}"
