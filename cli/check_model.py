"""`rotorgram check-model`: examine a vehicle's model, print a table of the checks."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from ._flags import Command


@dataclass(frozen=True, kw_only=True)
class CheckModel(Command):
    """Examine the model of a vehicle: mass, inertia, hover, free fall, torques, momentum, contact.

    Exit status 1 if a check fails.
    """

    xml: Positional[Path | None] = None
    """MJCF or TOML file, or the name of a vehicle. Default: the paper's quadcopter."""

    def run(self) -> int:
        """Print every check."""
        from rich.console import Console
        from rich.table import Table

        from ..models.checks import examine
        from ..models.vehicle import Vehicle

        checks = examine(Vehicle.load(self.xml))
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
