"""`rotorgram vehicle`: a vehicle's file, from a first one to MJCF for others."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from ..models import InputError
from ..models.files import check_new_file, write_whole
from ._flags import Command

if TYPE_CHECKING:
    from ..models import Vehicle as Craft
    from ..models.checks import Check
    from ..models.vehicle_file import VehicleFile

_NEW = """\
# A vehicle for rotorgram. It flies as it is; replace the numbers by those of your craft.
# SI units; body axes x forward, y left, z up. docs/vehicles.md has every field.
# For any number you may write where it is from: {{ value = 1.5, source = "scales" }}.

[body]
mass = 1.5                        # kg, with battery
inertia = [0.02, 0.02, 0.035]     # kg m²: Ixx, Iyy, Izz about the centre of mass
center_of_mass = [0.0, 0.0, 0.0]  # m

[rotors]
frame = {frame:26}# docs/vehicles.md has pictures of the frames
arm = 0.25                        # m, from the body's origin to each rotor
thrust = {thrust:25}# N, least and largest of each rotor
reaction = 0.016                  # N m of torque per N of thrust
# What effects and sensors need begins with #: take it away where you know the number.
# radius = 0.11                   # m
# time_constant = 0.05            # s, of the speed's first-order answer

# [drag]
# linear = [0.1, 0.1, 0.2]        # N s/m
# quadratic = [0.02, 0.02, 0.04]  # N s²/m²

# [sensors]
# gyro_noise = 1e-4               # rad/s/√Hz
"""


class Vehicle(Command):
    """Write, show, examine or export the file of a vehicle.

    new: write a commented file that flies. show: print derived values, and each number with its
    source. check: examine anyone's multirotor (mass, units, rotors, hover, integrator, flights,
    floor); exit status 1 if a check fails, 2 if flying refuses the file. export: write
    MJCF for MuJoCo alone.
    """

    action: Positional[Literal["new", "show", "check", "export"]]
    """What to do."""
    file: Annotated[Positional[str], arg(metavar="FILE")]
    """TOML or MJCF file, or the name of a vehicle of the library."""
    out: Annotated[Positional[Path | None], arg(metavar="OUT.xml")] = None
    """MJCF file that `export` writes, a new one."""
    frame: Literal["plus", "cross", "hexa", "octo"] = "cross"
    """Arrangement of the rotors of `new`."""

    def run(self) -> int | None:
        """Do it."""
        if (self.action == "export") != bool(self.out):
            raise InputError(
                "vehicle: expected OUT.xml with export and with nothing else, "
                f"got {self.action} with {self.out or 'none'}"
            )
        if "frame" in self.given and self.action != "new":
            raise InputError(f"frame: expected no --frame but with new, got {self.frame}")
        act: Callable[[], int | None] = getattr(self, f"_{self.action}")
        return act()

    def _check(self) -> int:
        from ..models.checks import examine

        try:
            checks = examine(self.file)
        except InputError as error:
            error.exit_status = 2  # type: ignore[attr-defined]
            raise
        print_checks(checks)
        return 0 if all(check.passed for check in checks) else 1

    def _new(self) -> None:
        path = Path(self.file)
        check_new_file(path, ".toml")
        count = {"hexa": 6, "octo": 8}.get(self.frame, 4)
        thrust = f"[0.0, {30.0 / count}]"  # twice the weight
        text = _NEW.format(frame=f'"{self.frame}"', thrust=thrust)
        write_whole(path, text)
        print(f"vehicle: {path} (rotorgram vehicle check {path} examines it)")

    def _show(self) -> None:
        from ..models.vehicle import Vehicle as Craft
        from ..models.vehicle_file import read_vehicle_file

        craft = Craft.load(self.file)
        toml = craft.path.suffix.lower() == ".toml"
        file = read_vehicle_file(craft.path) if toml else None
        print(f"{craft.name} ({craft.path})")
        error = file.real_flights if file else ""
        print(f"error after 0.5 s of real flights: {error or 'not measured'}\n")
        for name, value in _derived(craft):
            print(f"{name:17} {value}")
        print("\nrotors: position, direction, torque besides that of the position per thrust")
        for rotor in craft.rotors:
            place = f"{_listed(rotor.position)} m; {_listed(rotor.axis)}"
            torque = f"{_listed(rotor.reaction)} N m/N"
            print(f"{rotor.name:17} {place}; {torque}; {rotor.low:.6g} to {rotor.high:.6g} N")
        print("\ncameras: pictures, place")
        for camera in craft.cameras:
            size = "{} × {}".format(*camera.resolution)
            print(f"{camera.name:17} {', '.join(camera.kinds)} {size}, {camera.words}")
        if file:
            print(f"\nnumbers of {craft.path.name}")
            for line in _provenance(file):
                print(line)
            if file.model is None:
                return
            told = {one.name for one in file.numbers}
            print(f"\ncoefficients of {file.model.name}")
        else:
            told = set()
            print("\ncoefficients")
        for name, values in craft.coefficients.numbers().items():
            if name not in told:
                print(f"{name} = {_listed(values)}")

    def _export(self) -> None:
        from ..models.export import export_mjcf

        assert self.out is not None
        export_mjcf(self.file, self.out)
        print(f"vehicle: {self.out}")


def _derived(craft: "Craft") -> Iterator[tuple[str, str]]:
    """Names and values of what follows from the model."""
    weight = craft.mass * craft.gravity
    most = float(craft.allocation[0] @ craft.thrust_high)
    shares = craft.hover_thrust / craft.thrust_high
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = craft.inertia
    yield "mass", f"{craft.mass:.6g} kg"
    yield "centre of mass", f"{_listed(craft.center_of_mass)} m"
    yield "Ixx, Iyy, Izz", f"{_listed((xx, yy, zz))} kg m²"
    yield "Ixy, Ixz, Iyz", f"{_listed((xy, xz, yz))} kg m²"
    yield "gravity", f"{craft.gravity:.6g} m/s²"
    yield "rest height", f"{craft.rest_height:.6g} m"
    yield "physics step", f"{craft.timestep:.6g} s"
    yield "hover thrust", f"{_listed(craft.hover_thrust.round(9))} N"
    yield "hover throttle", f"{_listed((100 * shares).round(2))} %"
    yield "thrust to weight", f"{most / weight:.4g}"
    yield "hash", craft.hash


def _provenance(file: "VehicleFile") -> Iterator[str]:
    """Each number, and below it where it comes from."""
    for one in file.numbers:
        unit = "" if one.unit == "1" else f" {one.unit}"
        yield f"{one.name} = {_listed(one.value)}{unit}"
        for words in (one.source, one.why and f"why: {one.why}"):
            if words:
                yield f"    {words}"
        for other in one.others:
            yield f"    also {_listed(other.value)}{unit}: {other.source or 'no source'}"


def _listed(values: float | Iterable[float]) -> str:
    """Numbers with six digits; negative zeros and what rounding leaves are zeros."""
    numbers = list(values) if isinstance(values, Iterable) else [values]
    most = max(map(abs, numbers), default=0.0)
    return ", ".join(f"{0.0 if abs(one) <= 1e-12 * most else one:.6g}" for one in numbers)


def print_checks(checks: Sequence["Check"]) -> None:
    """Print an examination: a table, and a sentence for each failed check."""
    failed = [check for check in checks if not check.passed]
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table("", "check", "measured", "expected", box=SIMPLE_HEAD, pad_edge=False)
    for check in checks:
        table.add_row(
            "[green]ok" if check.passed else "[red]FAILED",
            escape(check.name),
            escape(f"{check.measured:.4g} {check.unit}".strip()),
            escape(expectation(check)),
        )
    Console().print(table)
    for check in failed:
        print(f"{check.name}: {check.meaning}")
    print(f"{len(checks) - len(failed)} of {len(checks)} checks passed")


def expectation(check: "Check") -> str:
    """Expected value and tolerance of a check, or its range, without the unit."""
    if check.expected is not None:
        within = f" ± {check.tolerance:.2g}" if check.tolerance else ""
        return f"{check.expected:.4g}{within}"
    if check.high == math.inf:
        return f"at least {check.low:.4g}"
    return f"{check.low:.4g} to {check.high:.4g}"
