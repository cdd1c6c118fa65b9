"""Numbers of a vehicle from logs of its flights, as a vehicle file: `docs/real-flights.md`.

    python examples/identification/identify.py flight1.csv flight2.csv \\
        --vehicle my_drone.toml --out identified.toml [--help]

`flight_logs` reads logs, `prediction` flies them, `fit` fits numbers, `estimates` decides which of
them the logs determine, `vehicle_text` writes the file.
"""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from estimates import DEFAULT, SEGMENT, WINDOW, Identified, identify
from fit import LAG
from flight_logs import FlightLog, read_log
from prediction import entry_of
from rich.console import Console
from rich.table import Table
from rotorgram.models import InputError
from rotorgram.models.fields import Limits, check_fields, immutable
from rotorgram.models.files import check_new_file, write_whole
from rotorgram.models.vehicle import Vehicle
from tyro.conf import Positional, arg
from vehicle_text import Origin, vehicle_toml


@immutable
class Command:
    """Identify thrust coefficient, rotor lag, inertia, drag and reaction from logs of flights.

    The lag needs logs without measured speeds. Another number that the logs do not tell keeps the
    value of the vehicle's file, and is named. Exit status 0 as well in that case.
    """

    logs: Positional[tuple[Path, ...]]
    """CSV, Parquet or ULog files of the same vehicle."""
    vehicle: Annotated[str, arg(metavar="FILE")]
    """File of the vehicle, TOML or MJCF, with a thrust coefficient, or a name of the library."""
    out: Annotated[Path, arg(metavar="NEW.toml")]
    """File to write: the vehicle with what was identified, and intervals."""
    fit: tuple[str, ...] = ()
    """What to identify. Default: the five of above; besides them there are rotors.drag,
    rotors.inflow, rotors.lift, drag.angular.x, y, z and drag.moment.x, y."""
    period: Annotated[float, Limits(1e-4, 0.1, "s")] = 0.01
    """Logs are resampled to this period, s."""

    def __post_init__(self) -> None:
        check_fields(self)

    def run(self) -> None:
        """Print every estimate, write the file."""
        check_new_file(self.out, ".toml")
        if not self.logs:
            raise InputError("logs: expected one or more, got none")
        vehicle = Vehicle.load(self.vehicle)
        logs = [read_log(path, vehicle, self.period) for path in self.logs]
        if LAG in self.fit and any(log.measured for log in logs):
            raise InputError(f"fit: expected logs without measured speeds for {LAG}, got measured")
        show_left_out(logs)
        found = identify(vehicle, logs, self.fit or DEFAULT)
        show(found)
        write_whole(self.out, identified_toml(vehicle, found))
        print(self.out)


def show_left_out(logs: list[FlightLog]) -> None:
    for log in logs:
        if log.left_out:
            print(
                f"{log.name}: {log.left_out} samples left out, whose position or attitude "
                "contradicts velocity and rates"
            )


def show(found: Identified) -> None:
    """Print the table of estimates, and the errors of predictions before and after."""
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


def identified_toml(vehicle: Vehicle, found: Identified) -> str:
    """The vehicle with the identified numbers, and the 95 % interval of each.

    All else is the vehicle's own, with the sources of its file where that is TOML.
    """
    source = f"identified from {', '.join(found.logs)}"
    origins: dict[str, Origin] = {}
    for estimate in found.estimates:
        entry, axis = entry_of(estimate.name)
        sentence = f"95 % interval {estimate.low:.4g} to {estimate.high:.4g}"
        if estimate.kept:
            sentence = f"the vehicle's own value, {estimate.kept}"
        if axis:
            sentence = f"{axis}: {sentence}"
        before = origins.get(entry, Origin(""))
        why = f"{before.why}; {sentence}" if before.why else sentence
        origins[entry] = Origin(before.source if estimate.kept else source, why)
    return vehicle_toml(vehicle, found.numbers, origins)


if __name__ == "__main__":
    try:
        tyro.cli(Command).run()
    except (InputError, ImportError, OSError) as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
