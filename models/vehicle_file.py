"""A vehicle's TOML file, read and checked. docs/vehicles.md has every field.

Each table is a dataclass whose fields are the keys. Body frame: x forward, y left, z up; SI units.
"""

import json
import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from .cameras import FOVY, MAX_LETTERS, OUTPUTS, Camera, Optics, steps_of
from .coefficients import COEFFICIENTS, Battery, Drag, Rotors, Sensors
from .errors import InputError, shortened
from .fields import Limits, Text, check, check_names, limits_of, read_table

T = TypeVar("T")
_Vector = tuple[float, float, float]
_Numbers = tuple[float, ...]
_Place = Annotated[_Vector, Limits(-100.0, 100.0, "m", count=3)]
_Mass = Annotated[float, Limits(1e-6, 1e6, "kg")]
_Length = Annotated[float, Limits(1e-5, 100.0, "m")]

AHEAD: Final = (1.0, 0.0, 0.0)
UP: Final = (0.0, 0.0, 1.0)
_MAX_BYTES: Final = 1_000_000  # it is read within a few seconds
_LEAST_MOMENT: Final = 1e-15  # kg m²: MuJoCo's mjMINVAL


@dataclass(frozen=True)
class _Direction(Limits):
    """Three numbers that are not all 0."""

    @property
    def expected(self) -> str:
        return f"{super().expected}, not all 0"

    def read(self, value: object) -> Any:
        numbers: Any = super().read(value)
        if math.hypot(*numbers) <= 1e-6:
            raise ValueError
        return numbers


_Axis = Annotated[_Vector, _Direction(-1e3, 1e3, "1", count=3)]


@dataclass(frozen=True, kw_only=True)
class Box:
    """A part of a body, at its center."""

    shape: str
    mass: _Mass
    position: _Place = (0.0, 0.0, 0.0)
    size: Annotated[_Vector, Limits(1e-5, 100.0, "m", count=3)]
    """Sides along x, y and z."""
    yaw: Annotated[float, Limits(-2 * math.pi, 2 * math.pi, "rad")] = 0.0


@dataclass(frozen=True, kw_only=True)
class Cylinder:
    """A part of a body, at its center."""

    shape: str
    mass: _Mass
    position: _Place = (0.0, 0.0, 0.0)
    radius: _Length
    length: _Length
    axis: _Axis = UP


@dataclass(frozen=True, kw_only=True)
class Body:
    """Mass and inertia, or parts that have them; and the hub."""

    mass: Annotated[float | None, Limits(1e-6, 1e6, "kg")] = None
    inertia: Annotated[_Numbers | None, Limits(-1e9, 1e9, "kg m²", count=None)] = None
    center_of_mass: _Place = (0.0, 0.0, 0.0)
    size: Annotated[_Vector | None, Limits(1e-4, 100.0, "m", count=3)] = None
    ground_clearance: Annotated[float | None, Limits(1e-4, 100.0, "m")] = None
    parts: tuple[Box | Cylinder, ...] = ()


@dataclass(frozen=True, kw_only=True)
class PlacedRotor:
    """Where a rotor is and how it turns."""

    name: Annotated[str, Text(100)]
    turn: Literal["cw", "ccw"]
    """Seen from where its thrust points to."""
    position: _Place | None = None
    """In the body frame, or in that of the link or body."""
    axis: _Axis = UP
    """Direction of its thrust, of any length, in the same frame."""
    link: str | None = None
    """Of the model's file; so are body and site."""
    body: str | None = None
    site: str | None = None

    @property
    def places(self) -> list[str]:
        """Which of link, body and site the table has."""
        return [name for name in ("link", "body", "site") if getattr(self, name) is not None]


@dataclass(frozen=True, kw_only=True)
class RotorTable(Rotors):
    """Rotors, all alike, in a frame or in a list."""

    frame: Literal["plus", "cross", "hexa", "octo"] | None = None
    arm: Annotated[float | None, Limits(1e-3, 100.0, "m")] = None
    height: Annotated[float | None, Limits(-100.0, 100.0, "m")] = None
    thrust: Annotated[_Numbers | None, Limits(-1e6, 1e6, "N", count=2)] = None
    speed: Annotated[_Numbers | None, Limits(0.0, 1e6, "rad/s", count=2)] = None
    reaction: Annotated[float | None, Limits(0.0, 10.0, "N m/N")] = None
    torque_coefficient: Annotated[float | None, Limits(0.0, 1.0, "N m s²/rad²")] = None
    list: tuple[PlacedRotor, ...] = ()

    @property
    def limits(self) -> tuple[float, float]:
        """Least and largest thrust of a rotor, N."""
        numbers = self.thrust
        if numbers is None:
            assert self.speed is not None
            assert self.thrust_coefficient is not None
            numbers = tuple(self.thrust_coefficient * speed**2 for speed in self.speed)
        low, high = numbers
        return low, high

    @property
    def torque(self) -> float:
        """Torque about its axis per thrust of a rotor, N·m/N."""
        if self.reaction is not None:
            return self.reaction
        assert self.torque_coefficient is not None
        assert self.thrust_coefficient is not None
        return self.torque_coefficient / self.thrust_coefficient


@dataclass(frozen=True, kw_only=True)
class _CameraTable(Optics):
    name: Annotated[str, Text(MAX_LETTERS, identifier=True)]
    position: _Place = (0.0, 0.0, 0.0)
    look: _Axis = AHEAD
    up: _Axis | None = None
    fovy: Annotated[float, Limits(*FOVY, "rad")] = math.pi / 2
    resolution: Annotated[tuple[int, int], Limits(1, 4096, "pixel", whole=True, count=2)] = (64, 64)
    rate: Annotated[float, Limits(1e-3, 1.0, "1")] = 1.0
    kinds: Sequence[str] = ("rgb",)
    stands: bool = False


@dataclass(frozen=True, kw_only=True)
class _RealFlights:
    """Mean errors of its simulation after half a second of recorded flights."""

    position: Annotated[float | None, Limits(0.0, 1e4, "m")] = None
    velocity: Annotated[float | None, Limits(0.0, 1e4, "m/s")] = None
    attitude: Annotated[float | None, Limits(0.0, 3.15, "rad")] = None


@dataclass(frozen=True, kw_only=True)
class _Model:
    file: str


@dataclass(frozen=True, kw_only=True)
class _File:
    """A whole file, its tables not read yet."""

    name: Annotated[str, Text(100)]
    timestep: Annotated[float | None, Limits(1e-5, 1.0, "s")] = None
    gravity: Annotated[float | None, Limits(1e-3, 1e3, "m/s²")] = None
    model: object = None
    body: object = None
    rotors: object = None
    drag: object = None
    battery: object = None
    sensors: object = None
    cameras: object = ()
    real_flights: object = None


ENTRIES: Final[Mapping[str, Limits]] = {
    **limits_of(_File),
    **limits_of(Body, "body."),
    **limits_of(Box, "body.parts."),
    **limits_of(Cylinder, "body.parts."),
    **limits_of(RotorTable, "rotors."),
    **limits_of(PlacedRotor, "rotors.list."),
    **COEFFICIENTS,
    **limits_of(_CameraTable, "cameras."),
    **limits_of(_RealFlights, "real_flights."),
}
"""Every number of a file by its dotted name."""

FRAMES: Final[Mapping[str, tuple[int, float]]] = {
    "plus": (4, 0.0),
    "cross": (4, math.pi / 4),
    "hexa": (6, math.pi / 6),
    "octo": (8, math.pi / 8),
}
"""Number of rotors, and angle of the first one to the left of forward, rad. The others follow
clockwise seen from above. The first turns clockwise, the next counterclockwise, and so on."""


@dataclass(frozen=True, kw_only=True)
class Number:
    """A number of a vehicle's file, and where it comes from."""

    name: str
    """Dotted, as in "body.mass" or "rotors.list[1].position": the first rotor."""
    value: float | _Numbers
    unit: str
    source: str = ""
    why: str = ""
    """Why this value, if there are others."""
    others: tuple[tuple[float | _Numbers, str], ...] = ()
    """Values of other sources, each with its source."""


@dataclass(frozen=True, kw_only=True)
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
    """With its list filled; an MJCF file's own rotors are not in it."""
    cameras: tuple[Camera, ...]

    @property
    def coefficients(self) -> dict[str, _Numbers]:
        """Those of effects and sensors, by "group.name"."""
        found = {}
        for number in self.numbers:
            if number.name in COEFFICIENTS:
                value = number.value
                found[number.name] = value if isinstance(value, tuple) else (value,)
        return found

    @property
    def real_flights(self) -> str:
        """Mean error of its simulation after half a second of recorded flights; empty: unknown."""
        errors = [one for one in self.numbers if one.name.startswith("real_flights.")]
        return ", ".join(f"{one.value:.3g} {one.unit}" for one in errors)


def read_vehicle_file(path: Path) -> VehicleFile:
    """Read a TOML file. Raises `InputError` with the name and the range of the first wrong field,
    `OSError` if the file cannot be read.
    """
    size = path.stat().st_size
    if size > _MAX_BYTES:
        raise InputError(f"vehicle: expected a TOML file of at most {_MAX_BYTES} bytes, got {size}")
    try:
        return _read(path, tomllib.loads(path.read_text(encoding="utf-8")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"vehicle: expected a TOML file, got {path.name}: {error}") from None
    except RecursionError:
        raise InputError(
            "vehicle: expected a TOML file with tables as in docs/vehicles.md, "
            "got too many in each other"
        ) from None


def _read(path: Path, tree: dict[str, object]) -> VehicleFile:
    numbers: list[Number] = []
    name = path.parent.name if path.stem == "vehicle" else path.stem
    file = _table(numbers, _File, {"name": name, **tree}, "vehicle")
    model = None if file.model is None else _model(path, file.model)
    body = _body(numbers, file.body, model)
    rotors = _rotors(numbers, file.rotors, model)
    cameras = [
        _camera(numbers, one, f"cameras[{i}]") for i, one in _listed(file.cameras, "cameras")
    ]
    _check_distinct("cameras", [camera.name for camera in cameras])
    for group, kind in _GROUPS.items():
        _table(numbers, kind, tree.get(group, {}), group)
    physical = {key: value for key, value in tree.items() if key != "real_flights"}
    return VehicleFile(
        name=file.name,
        numbers=tuple(numbers),
        content=json.dumps(_plain(physical | {"name": file.name}), sort_keys=True),
        model=model,
        timestep=file.timestep,
        gravity=file.gravity,
        body=body,
        rotors=rotors,
        cameras=tuple(cameras),
    )


_GROUPS: Final[Mapping[str, type]] = {
    "drag": Drag,
    "battery": Battery,
    "sensors": Sensors,
    "real_flights": _RealFlights,
}


def _table(numbers: list[Number], kind: type[T], given: object, where: str) -> T:
    """A table as its dataclass; its numbers are added to those of the file."""
    table = dict(_mapping(given, where))
    source = _text(table, "source", where)
    table.pop("source", None)
    prefix = "" if where == "vehicle" else f"{where}."
    for name, limits in limits_of(kind).items():
        if name in table:
            number = _number(prefix + name, limits, table[name], source)
            numbers.append(number)
            table[name] = number.value
    return read_table(kind, table, where)


def _number(name: str, limits: Limits, given: object, source: str) -> Number:
    """A number that is given plainly or with its provenance."""
    if not isinstance(given, dict):
        return Number(name=name, value=check(name, limits, given), unit=limits.unit, source=source)
    check_names(given, ("value", "source", "why", "others"), name)
    others = []
    for i, one in _listed(given.get("others", []), f"{name}.others"):
        where = f"{name}.others[{i}]"
        other = _mapping(one, where)
        check_names(other, ("value", "source"), where)
        others.append((check(where, limits, other.get("value")), _text(other, "source", where)))
    return Number(
        name=name,
        value=check(name, limits, given.get("value")),
        unit=limits.unit,
        source=_text(given, "source", name) or source,
        why=_text(given, "why", name),
        others=tuple(others),
    )


def _mapping(given: object, where: str) -> Mapping[str, object]:
    if not isinstance(given, Mapping):
        raise InputError(f"{where}: expected a table, got {shortened(given)}")
    return given


def _text(table: Mapping[str, object], key: str, where: str) -> str:
    return str(check(f"{where}.{key}", Text(empty=True), table.get(key, "")))


def _listed(given: object, where: str) -> Iterable[tuple[int, object]]:
    """Tables of a list, and their numbers from 1."""
    if not isinstance(given, list | tuple):
        raise InputError(f"{where}: expected a list of tables, got {shortened(given)}")
    return enumerate(given, 1)


def _model(path: Path, given: object) -> Path:
    file = _table([], _Model, given, "model").file
    if Path(file).suffix.lower() not in (".urdf", ".xml"):
        raise InputError(
            "model.file: expected a URDF file (.urdf) or an MJCF file (.xml), "
            f"got {shortened(file)}"
        )
    model = path.parent / file
    if not model.is_file():
        raise InputError(f"model.file: expected a file that is there, got {shortened(file)}")
    return model


def _body(numbers: list[Number], given: object, model: Path | None) -> Body:
    if model is not None:
        if given is not None:
            raise InputError("body: expected none beside a model's file, which has it, got a table")
        return Body()
    if given is None:
        raise InputError("vehicle: expected a table [body], or [model] with a file, got neither")
    table = dict(_mapping(given, "body"))
    of_parts: list[Number] = []
    if "parts" in table:
        parts = _listed(table["parts"], "body.parts")
        table["parts"] = tuple(_part(of_parts, one, f"body.parts[{i}]") for i, one in parts)
    body = _table(numbers, Body, table, "body")
    numbers += of_parts
    own = [key for key in ("mass", "inertia") if key in table]
    if body.parts and own:
        raise InputError(f"body: expected parts, or mass and inertia, got {', '.join(own)} too")
    if not body.parts and len(own) < 2:
        raise InputError(
            f"body: expected mass and inertia, or parts, got {''.join(own) or 'neither'}"
        )
    if body.inertia is not None:
        _check_inertia(body.inertia)
    return body


def _part(numbers: list[Number], given: object, where: str) -> Box | Cylinder:
    shape = _mapping(given, where).get("shape")
    if shape == "box":
        return _table(numbers, Box, given, where)
    if shape != "cylinder":
        raise InputError(f"{where}.shape: expected 'box' or 'cylinder', got {shortened(shape)}")
    return _table(numbers, Cylinder, given, where)


def _rotors(numbers: list[Number], given: object, model: Path | None) -> RotorTable:
    mjcf = model is not None and model.suffix.lower() == ".xml"
    if given is None and not mjcf:
        raise InputError("vehicle: expected a table [rotors], got none")
    table = dict(_mapping({} if given is None else given, "rotors"))
    of_list: list[Number] = []
    if "list" in table:
        listed = _listed(table["list"], "rotors.list")
        table["list"] = tuple(_rotor(of_list, one, i, model) for i, one in listed)
    rotors = _table(numbers, RotorTable, table, "rotors")
    numbers += of_list
    if mjcf and not rotors.list and rotors.frame is None:  # those of the file
        for key in table:
            if f"rotors.{key}" not in COEFFICIENTS and key != "source":
                got = shortened(table[key])
                raise InputError(
                    f"rotors: expected no {key} for rotors of the model's file, got {got}"
                )
        return rotors
    _check_thrust(rotors)
    if rotors.frame is None or model is not None:
        return _check_list(rotors, model)
    if rotors.list:
        raise InputError("rotors: expected a frame or a list, got both")
    if rotors.arm is None:
        raise InputError(f"rotors: expected arm of the frame {rotors.frame!r}, got none")
    return replace(rotors, list=frame_rotors(rotors.frame, rotors.arm, rotors.height or 0.0))


def _check_list(rotors: RotorTable, model: Path | None) -> RotorTable:
    if rotors.frame is not None or not rotors.list:
        wanted = "a frame or a list" if model is None else "a list"
        got = "neither" if rotors.frame is None else f"frame = {rotors.frame!r}"
        raise InputError(f"rotors: expected {wanted}, got {got}")
    for key in ("arm", "height"):
        value = getattr(rotors, key)
        if value is not None:
            raise InputError(f"rotors: expected no {key} with a list, got {value:g}")
    _check_distinct("rotors.list", [rotor.name for rotor in rotors.list])
    return rotors


def _check_thrust(rotors: RotorTable) -> None:
    """Thrust and reaction are given once each."""
    for one, other in (("thrust", "speed"), ("reaction", "torque_coefficient")):
        given = [key for key in (one, other) if getattr(rotors, key) is not None]
        if len(given) != 1:
            raise InputError(
                f"rotors: expected {one}, or {other} with thrust_coefficient, "
                f"got {' and '.join(given) or 'neither'}"
            )
        if given == [other] and rotors.thrust_coefficient is None:
            raise InputError(f"rotors: expected thrust_coefficient with {other}, got none")
    low, high = rotors.limits
    if not low < high:
        raise InputError(
            f"rotors: expected a lower and a higher thrust, got {low:g} and {high:g} N"
        )


def _rotor(numbers: list[Number], given: object, number: int, model: Path | None) -> PlacedRotor:
    where = f"rotors.list[{number}]"
    table = {"name": f"rotor{number}", **_mapping(given, where)}
    rotor = _table(numbers, PlacedRotor, table, where)
    places = rotor.places
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


def frame_rotors(frame: str, arm: float, height: float = 0.0) -> tuple[PlacedRotor, ...]:
    """Rotors of a frame of `FRAMES`, `arm` from the body's origin and `height` above it, m."""
    count, first = FRAMES[frame]
    rotors = []
    for i in range(count):
        angle = first - 2 * math.pi * i / count
        # 15 digits after the point: a rotor on an axis is exactly there.
        x = round(arm * math.cos(angle), 15) + 0.0
        y = round(arm * math.sin(angle), 15) + 0.0
        turn: Literal["cw", "ccw"] = "ccw" if i % 2 else "cw"
        rotors.append(PlacedRotor(name=f"rotor{i + 1}", position=(x, y, height), turn=turn))
    return tuple(rotors)


def _camera(numbers: list[Number], given: object, where: str) -> Camera:
    table = _table(numbers, _CameraTable, given, where)
    _check_kinds(f"{where}.kinds", table.kinds)
    look = table.look
    up = table.up
    if up is None:
        upright = math.hypot(*look[:2]) > 1e-6 * math.hypot(*look)
        up = UP if upright else AHEAD
    across = math.hypot(*np.cross(look, up))
    if not across > 1e-6 * math.hypot(*look) * math.hypot(*up):
        raise InputError(f"{where}.up: expected another direction than look, got {list(up)}")
    width, height = table.resolution
    if (width, height) == (1, 1):
        raise InputError(f"{where}.resolution: expected more than one pixel, got one")
    return Camera(
        name=table.name,
        width=width,
        height=height,
        fovy=table.fovy,
        kinds=tuple(kind for kind in OUTPUTS if kind in table.kinds),
        every=steps_of(where, table.rate),
        carried=not table.stands,
        position=table.position,
        look=look,
        up=up,
        optics=Optics(**{one.name: getattr(table, one.name) for one in fields(Optics)}),
    )


def _check_kinds(name: str, kinds: object) -> None:
    right = (
        isinstance(kinds, Sequence) and bool(kinds) and all(kind in [*OUTPUTS] for kind in kinds)
    )
    if not right:
        raise InputError(f"{name}: expected some of {', '.join(OUTPUTS)}, got {shortened(kinds)}")


def _check_distinct(where: str, names: Sequence[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{where}: expected a name of its own for each, got {name!r} twice")


def _check_inertia(values: _Numbers) -> None:
    """Raise `InputError` unless a body of some masses can have it."""
    got = ", ".join(f"{one:g}" for one in values)
    if len(values) not in (3, 6):
        raise InputError(
            "body.inertia: expected 3 numbers: Ixx, Iyy, Izz, or 6: Ixx, Iyy, Izz, Ixy, Ixz, Iyz, "
            f"got {got}"
        )
    low, middle, high = np.linalg.eigvalsh(inertia_matrix((*values, 0.0, 0.0, 0.0)[:6])).tolist()
    if not low > _LEAST_MOMENT:
        raise InputError(
            f"body.inertia: expected principal moments above {_LEAST_MOMENT:g} kg m², got {got}"
        )
    if not high <= (low + middle) * (1 + 1e-9):
        raise InputError(
            "body.inertia: expected principal moments of which none is larger than the sum of the "
            f"others, got {low:.4g}, {middle:.4g} and {high:.4g} kg m²"
        )


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
