"""`rotorgram identify`: numbers of a vehicle from logs of its flights, as a vehicle file."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..models.fields import Limits
from ._flags import Command, Files, Words


class Identify(Command):
    """Identify thrust coefficient, rotor lag, inertia, drag and reaction from logs of flights.

    The lag needs logs without measured speeds. Another number that the logs do not tell keeps the
    value of the vehicle's file, and is named. Exit status 0 as well in that case.
    """

    logs: Positional[Files]
    """CSV, Parquet or ULog files of the same vehicle."""
    vehicle: Annotated[str, arg(metavar="FILE")]
    """File of the vehicle, TOML or MJCF, with a thrust coefficient, or a name of the library."""
    out: Annotated[Path, arg(metavar="NEW.toml")]
    """File to write: the vehicle with what was identified, and intervals."""
    fit: Words = ()
    """What to identify. Default: the five of above; besides them there are rotors.drag,
    rotors.inflow, rotors.lift, drag.angular.x, y, z and drag.moment.x, y."""
    period: Annotated[float, Limits(1e-4, 0.1, "s")] = 0.01
    """Logs are resampled to this period, s."""

    def run(self) -> None:
        """Print every estimate, write the file."""
        from rich.console import Console
        from rich.table import Table

        from ..flights.flight_logs import read_log
        from ..flights.identify import DEFAULT, LAG, SEGMENT, WINDOW, identified_toml, identify
        from ..models.errors import InputError, require
        from ..models.files import check_new_file, write_whole
        from ..models.vehicle import Vehicle

        require("scipy", "identify", "system identification")
        check_new_file(self.out, ".toml")
        vehicle = Vehicle.load(self.vehicle)
        logs = [read_log(path, vehicle, self.period) for path in self.logs]
        if LAG in self.fit and any(log.measured for log in logs):
            raise InputError(f"fit: expected logs without measured speeds for {LAG}, got measured")
        for log in logs:
            if log.left_out:
                print(
                    f"{log.name}: {log.left_out} samples left out, whose position or attitude "
                    "contradicts velocity and rates"
                )
        found = identify(vehicle, logs, self.fit or DEFAULT)
        table = Table("number", "value", "95 % interval", "")
        for one in found.estimates:
            note = f"[yellow]kept: {one.kept}" if one.kept else ""
            interval = "" if one.kept else f"{one.low:.4g} to {one.high:.4g}"
            table.add_row(one.name, f"{one.value:.5g}", interval, note)
        Console().print(table)
        names = ("position", "m"), ("attitude", "rad"), ("velocity", "m/s"), ("rates", "rad/s")
        errors = [
            f"{name} {before:.3g} -> {after:.3g} {unit}"
            for (name, unit), before, after in zip(names, found.before, found.after, strict=True)
        ]
        window = f"{found.windows} predictions over {WINDOW:g} s"
        print(f"mean error of {window}: {', '.join(errors)}")
        print(f"intervals: sandwich, clustered over {found.segments} segments of {SEGMENT:g} s")
        write_whole(self.out, identified_toml(vehicle, found))
        print(self.out)
