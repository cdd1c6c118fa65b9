"""A vehicle's TOML file, read and checked. docs/vehicles.md has every field.

Each table is a dataclass whose fields are the keys. Body frame: x forward, y left, z up; SI units.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from .cameras import AHEAD, ORIGIN, OUTPUTS, UP, Axis, Camera, Place
from .coefficients import COEFFICIENTS, RANGE_MODELS, of_group, table_of
from .errors import InputError, shortened
from .fields import (
    Choice,
    Limits,
    T,
    Text,
    check,
    check_names,
    immutable,
    limits_of,
    mapping,
    printable,
    read_table,
)
from .files import read_toml

_Numbers = tuple[float, ...]
_Mass = Annotated[float, Limits(1e-6, 1e6, "kg")]
_Length = Annotated[float, Limits(1e-5, 100.0, "m")]


@immutable
class Box:
    """A part of a body, at its center."""

    shape: str
    mass: _Mass
    position: Place = ORIGIN
    size: Annotated[tuple[float, float, float], Limits(1e-5, 100.0, "m", count=3)]
    """Sides along x, y and z."""
    yaw: Annotated[float, Limits(-2 * math.pi, 2 * math.pi, "rad")] = 0.0


@immutable
class Cylinder:
    """A part of a body, at its center."""

    shape: str
    mass: _Mass
    position: Place = ORIGIN
    radius: _Length
    length: _Length
    axis: Axis = UP


_SHAPES: Mapping[str, type[Box | Cylinder]] = {"box": Box, "cylinder": Cylinder}


@immutable
class Body(table_of("body")):  # type: ignore[misc]
    """Mass and inertia, or parts that have them; and the hub."""

    parts: tuple[Box | Cylinder, ...] = ()


@immutable
class PlacedRotor:
    """Where a rotor is and how it turns."""

    name: Annotated[str, printable(100)]
    turn: Literal["cw", "ccw"]
    """Seen from where its thrust points to."""
    position: Place | None = None
    """In the body frame, or in that of the link or body."""
    axis: Axis = UP
    """Direction of its thrust, of any length, in the same frame."""
    link: str | None = None
    """Of the model's file; so are body and site."""
    body: str | None = None
    site: str | None = None


@immutable
class RotorTable(table_of("rotors")):  # type: ignore[misc]
    """Rotors, all alike, in a frame or in a list."""

    frame: Literal["plus", "cross", "hexa", "octo"] | None = None
    list: tuple[PlacedRotor, ...] = ()


@immutable
class SensorTable(table_of("sensors")):  # type: ignore[misc]
    """Coefficients of sensors, and tables of those with rays, which are not read yet."""

    depth: object = None
    lidar: object = None
    tof: object = None


@immutable
class _Model:
    file: Annotated[str, Text(r"(?is).*\.(urdf|xml)", "a URDF file (.urdf) or an MJCF file (.xml)")]


@immutable
class _Sourced:
    """A number with its provenance."""

    value: object = None
    source: str = ""
    why: str = ""
    others: object = ()


@immutable
class Tables(table_of("vehicle")):  # type: ignore[misc]
    """A whole file, its tables not read yet."""

    name: Annotated[str, printable(100)]
    model: object = None
    body: object = None
    rotors: object = None
    drag: object = None
    battery: object = None
    sensors: object = None
    cameras: object = ()
    real_flights: object = None


FRAMES = {
    "plus": (4, 0.0),
    "cross": (4, math.pi / 4),
    "hexa": (6, math.pi / 6),
    "octo": (8, math.pi / 8),
}
"""Number of rotors, and angle of the first one to the left of forward, rad. The others follow
clockwise seen from above. The first turns clockwise, the next counterclockwise, and so on."""


@immutable
class Number:
    """A number of a vehicle's file, and where it comes from."""

    name: str
    """Dotted, as in "body.mass" or "rotors.list[1].position": the first rotor."""
    value: float | _Numbers
    unit: str
    source: str = ""
    why: str = ""
    """Why this value, if there are others."""
    others: tuple["Number", ...] = ()
    """Values of other sources."""


@immutable
class VehicleFile:
    """A vehicle's TOML file, read and checked by `read_vehicle_file`."""

    name: str
    numbers: tuple[Number, ...]
    content: str
    """All that the file says of the vehicle, with all digits and without sources, to be hashed."""
    model: Path | None
    """File of the model, URDF or MJCF; None: it is built from the tables."""
    timestep: float | None
    """s."""
    gravity: float | None
    """Downward acceleration, m/s²."""
    body: Body
    rotors: RotorTable
    """With the list filled; an MJCF file's own rotors are not in it."""
    cameras: tuple[Camera, ...]

    @property
    def real_flights(self) -> str:
        """Mean error of its simulation after half a second of recorded flights; empty: unknown."""
        errors = [one for one in self.numbers if one.name.startswith("real_flights.")]
        return ", ".join(f"{one.value:.3g} {one.unit}" for one in errors)


_Found = list[Number]
"""The numbers of a file, as far as it is read."""


def read_vehicle_file(path: Path) -> VehicleFile:
    """Read a TOML file. Raises `InputError` with the name and the range of the first wrong field,
    `OSError` if the file cannot be read.
    """
    numbers: _Found = []
    name = path.parent.name if path.stem == "vehicle" else path.stem
    tree = {"name": name, **read_toml(path, "vehicle")}
    file = _table(numbers, Tables, tree, "vehicle")
    model = None if file.model is None else _model(path, file.model)
    body = _body(numbers, file.body, model)
    rotors = _rotors(numbers, file.rotors, model)
    cameras = [_camera(numbers, one, where) for where, one in _listed(file.cameras, "cameras")]
    for group in ("drag", "battery", "real_flights"):
        _table(numbers, table_of(group), tree.get(group, {}), group)
    _sensors(numbers, tree.get("sensors", {}), path.name)
    physical = {key: value for key, value in tree.items() if key != "real_flights"}
    return VehicleFile(
        name=file.name,
        numbers=tuple(numbers),
        content=json.dumps(_plain(physical), sort_keys=True),
        model=model,
        timestep=file.timestep,
        gravity=file.gravity,
        body=body,
        rotors=rotors,
        cameras=tuple(cameras),
    )


def model_of(path: Path) -> Path:
    """The model's file that a vehicle's TOML file names; else the file itself."""
    if path.suffix.lower() != ".toml":
        return path
    return read_vehicle_file(path).model or path


def _table(numbers: _Found, kind: type[T], given: object, where: str) -> T:
    """A table as its dataclass; its numbers are added to those of the file."""
    table = mapping(given, where)
    source = check(f"{where}.source", Text(), table.pop("source", ""))
    prefix = "" if where == "vehicle" else f"{where}."
    for key, limits in limits_of(kind).items():
        if key in table:
            number = _number(prefix + key, limits, table[key], source)
            numbers.append(number)
            table[key] = number.value
    return read_table(kind, table, where)


def _number(name: str, limits: Limits, given: object, source: str) -> Number:
    """A number that is given plainly or with its provenance."""
    table = given if isinstance(given, dict) else {"value": given}
    sourced = read_table(_Sourced, table, name)
    others = []
    for where, other in _listed(sourced.others, f"{name}.others"):
        others.append(_number(where, limits, mapping(other, where), ""))
    return Number(
        name=name,
        value=check(name, limits, sourced.value),
        unit=limits.unit,
        source=sourced.source or source,
        why=sourced.why,
        others=tuple(others),
    )


def _listed(given: object, where: str) -> list[tuple[str, Any]]:
    """Tables of a list, each with its name for errors."""
    if not isinstance(given, list | tuple):
        raise InputError(f"{where}: expected a list of tables, got {shortened(given)}")
    return [(f"{where}[{i}]", one) for i, one in enumerate(given, 1)]


def _model(path: Path, given: object) -> Path:
    file = _table([], _Model, given, "model").file
    model = path.parent / file
    if not model.is_file():
        raise InputError(f"model.file: expected a file that is there, got {shortened(file)}")
    return model


def _body(numbers: _Found, given: object, model: Path | None) -> Body:
    if model is not None:
        if given is not None:
            raise InputError("body: expected none beside a model's file, which has it, got a table")
        return Body()
    if given is None:
        raise InputError("vehicle: expected a table [body], or [model] with a file, got neither")
    table = mapping(given, "body")
    listed = _listed(table.pop("parts", ()), "body.parts")
    body = _table(numbers, Body, table, "body")
    parts = tuple(_part(numbers, one, where) for where, one in listed)
    own = [key for key in ("mass", "inertia") if key in table]
    if parts and own:
        raise InputError(f"body: expected parts, or mass and inertia, got {', '.join(own)} too")
    if not parts and len(own) < 2:
        raise InputError(
            f"body: expected mass and inertia, or parts, got {''.join(own) or 'neither'}"
        )
    if body.inertia is not None and len(body.inertia) not in (3, 6):
        raise InputError(
            "body.inertia: expected 3 numbers: Ixx, Iyy, Izz, or 6: Ixx, Iyy, Izz, Ixy, Ixz, Iyz, "
            f"got {len(body.inertia)}"
        )
    return replace(body, parts=parts)


def _part(numbers: _Found, given: object, where: str) -> Box | Cylinder:
    shape = mapping(given, where).get("shape")
    kind = check(f"{where}.shape", Choice(tuple(_SHAPES)), shape)
    return _table(numbers, _SHAPES[kind], given, where)


def _rotors(numbers: _Found, given: object, model: Path | None) -> RotorTable:
    mjcf = model is not None and model.suffix.lower() == ".xml"
    if given is None and not mjcf:
        raise InputError("vehicle: expected a table [rotors], got none")
    table = mapping({} if given is None else given, "rotors")
    listed = enumerate(_listed(table.pop("list", ()), "rotors.list"), 1)
    rotors = _table(numbers, RotorTable, table, "rotors")
    placed = tuple(_rotor(numbers, one, where, i, model) for i, (where, one) in listed)
    rotors = replace(rotors, list=placed)
    if mjcf and not placed and rotors.frame is None:  # those of the file
        known = (*of_group("rotors", COEFFICIENTS), "source")
        check_names(table, known, "rotors of the model's file")
        return rotors
    _check_thrust(rotors)
    if rotors.frame is not None and model is None:
        return _framed(rotors, rotors.frame)
    if rotors.frame is not None or not placed:
        wanted = "a frame or a list" if model is None else "a list"
        got = "neither" if rotors.frame is None else f"frame = {rotors.frame!r}"
        raise InputError(f"rotors: expected {wanted}, got {got}")
    for key in ("arm", "height"):
        if key in table:
            raise InputError(f"rotors: expected no {key} with a list, got {shortened(table[key])}")
    return rotors


def _check_thrust(rotors: RotorTable) -> None:
    for name in ("thrust", "reaction"):
        if getattr(rotors, name) is None:
            raise InputError(f"rotors: expected {name}, got none")
    low, high = rotors.thrust
    if not low < high:
        raise InputError(
            f"rotors: expected a lower and a higher thrust, got {low:g} and {high:g} N"
        )


def _rotor(
    numbers: _Found, given: object, where: str, number: int, model: Path | None
) -> PlacedRotor:
    table = {"name": f"rotor{number}", **mapping(given, where)}
    rotor = _table(numbers, PlacedRotor, table, where)
    places = [name for name in ("link", "body", "site") if getattr(rotor, name) is not None]
    if model is None:
        if places:
            raise InputError(f"{where}: expected a position, got {places[0]}")
        if rotor.position is None:
            raise InputError(f"{where}: expected a position, got none")
        return rotor
    if len(places) != 1:
        raise InputError(
            f"{where}: expected one of link, body and site of the model's file, "
            f"got {' and '.join(places) or 'none'}"
        )
    if rotor.site is not None and rotor.position is not None:
        raise InputError(f"{where}: expected no position besides a site, which has it, got both")
    return rotor


def _framed(rotors: RotorTable, frame: str) -> RotorTable:
    """Rotors of a frame of `FRAMES`."""
    if rotors.list:
        raise InputError("rotors: expected a frame or a list, got both")
    if rotors.arm is None:
        raise InputError(f"rotors: expected arm of the frame {frame!r}, got none")
    count, first = FRAMES[frame]
    placed = []
    for i in range(count):
        angle = first - 2 * math.pi * i / count
        # 15 digits after the point: a rotor on an axis is exactly there.
        x = round(rotors.arm * math.cos(angle), 15) + 0.0
        y = round(rotors.arm * math.sin(angle), 15) + 0.0
        turn: Literal["cw", "ccw"] = "ccw" if i % 2 else "cw"
        position = (x, y, rotors.height or 0.0)
        placed.append(PlacedRotor(name=f"rotor{i + 1}", position=position, turn=turn))
    return replace(rotors, list=tuple(placed))


def _camera(numbers: _Found, given: object, where: str) -> Camera:
    has_up = "up" in mapping(given, where)
    camera = _table(numbers, Camera, given, where)
    look = camera.look
    up = camera.up
    upright = math.hypot(*look[:2]) > 1e-6 * math.hypot(*look)
    if not has_up and not upright:
        up = AHEAD
    if camera.resolution == (1, 1):
        raise InputError(f"{where}.resolution: expected more than one pixel, got one")
    ordered = tuple(kind for kind in OUTPUTS if kind in camera.kinds)
    return replace(camera, kinds=ordered, up=up)


def _sensors(numbers: _Found, given: object, file: str) -> None:
    """The table of sensors. Raises `InputError`, which names the file."""
    try:
        sensors = _table(numbers, SensorTable, given, "sensors")
        for kind, models in RANGE_MODELS.items():
            given = getattr(sensors, kind)
            if given is None:
                continue
            where = f"sensors.{kind}"
            table = {"position": ORIGIN, **mapping(given, where)}
            model = table.pop("model", next(iter(models)))
            check(f"{where}.model", Choice(tuple(models)), model)
            group = f"{where}.{model}"
            _table(numbers, table_of(group), table, group)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def inertia_matrix(values: Sequence[float]) -> NDArray[np.float64]:
    """Of Ixx, Iyy, Izz, Ixy, Ixz and Iyz, shape (3, 3)."""
    xx, yy, zz, xy, xz, yz = values
    return np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))


def _plain(tree: object) -> object:
    """What a tree says without provenance, with every number as a float."""
    if isinstance(tree, dict):
        if "value" in tree:
            return _plain(tree["value"])
        return {key: _plain(one) for key, one in tree.items() if key != "source"}
    if isinstance(tree, list):
        return [_plain(one) for one in tree]
    return float(tree) if isinstance(tree, int) else tree
