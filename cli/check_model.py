"""`rotorgram check-model`: examine a quadcopter model, print a table of the checks."""

from typing import TYPE_CHECKING

import mujoco
from rich.console import Console
from rich.table import Table

from ..models import load_model
from ..models.checks import examine

if TYPE_CHECKING:
    from .measuring import CheckModel

__all__ = ["check_model"]


def check_model(command: "CheckModel") -> int:
    """Print every check; exit status 1 if one fails."""
    xml = command.xml
    if xml is not None and not xml.is_file():
        raise ValueError(f"xml: no file {xml}")
    checks = examine(load_model() if xml is None else mujoco.MjModel.from_xml_path(str(xml)))
    table = Table("", "check", "expected", "measured - expected", "tolerance", "source")
    for check in checks:
        table.add_row(
            "[green]ok" if check.passed else "[red]FAILED",
            check.name,
            f"{check.expected:.7g} {check.unit}",
            f"{check.measured - check.expected:.1e}",
            f"{check.tolerance:.0e}",
            check.source,
        )
    Console().print(table)
    failed = sum(not check.passed for check in checks)
    print(f"{len(checks) - failed} of {len(checks)} checks passed")
    return 1 if failed else 0
