"""A vehicle's TOML file: read, checked, and built as a MuJoCo model. docs/vehicles.md has it all.

Body frame: x forward, y left, z up; SI units.
"""

import json
import math
import os
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import mujoco

from .cameras import (
    FOVY,
    MAX_LETTERS,
    OUTPUTS,
    Camera,
    Optics,
    axes_of,
    is_name,
    place_camera,
    steps_of,
    texts_of,
)
from .coefficients import COEFFICIENTS, PREFIX
from .errors import InputError, expect
from .fields import Limits, check, limits_of, rules_of

_Vector = tuple[float, float, float]


ENTRIES: Final[Mapping[str, Limits]] = {
    "timestep": Limits(1e-5, 1.0, "s"),
    "gravity": Limits(1e-3, 1e3, "m/s²"),
    "body.mass": Limits(1e-6, 1e6, "kg"),
    "body.inertia": Limits(-1e9, 1e9, "kg m²", count=None),
    "body.center_of_mass": Limits(-100.0, 100.0, "m", count=3),
    "body.size": Limits(1e-4, 100.0, "m", count=3),
    "body.ground_clearance": Limits(1e-4, 100.0, "m"),
    "body.parts.mass": Limits(1e-6, 1e6, "kg"),
    "body.parts.position": Limits(-100.0, 100.0, "m", count=3),
    "body.parts.size": Limits(1e-5, 100.0, "m", count=3),
    "body.parts.yaw": Limits(-2 * math.pi, 2 * math.pi, "rad"),
    "body.parts.radius": Limits(1e-5, 100.0, "m"),
    "body.parts.length": Limits(1e-5, 100.0, "m"),
    "body.parts.axis": Limits(-1e3, 1e3, "1", count=3),
    "rotors.arm": Limits(1e-3, 100.0, "m"),
    "rotors.height": Limits(-100.0, 100.0, "m"),
    "rotors.thrust": Limits(-1e6, 1e6, "N", count=2),
    "rotors.speed": Limits(0.0, 1e6, "rad/s", count=2),
    "rotors.reaction": Limits(0.0, 10.0, "N m/N"),
    "rotors.torque_coefficient": Limits(0.0, 1.0, "N m s²/rad²"),
    "rotors.list.position": Limits(-100.0, 100.0, "m", count=3),
    "rotors.list.axis": Limits(-1e3, 1e3, "1", count=3),
    **COEFFICIENTS,
    "cameras.position": Limits(-100.0, 100.0, "m", count=3),
    "cameras.look": Limits(-1e3, 1e3, "1", count=3),
    "cameras.up": Limits(-1e3, 1e3, "1", count=3),
    "cameras.fovy": Limits(*FOVY, "rad"),
    "cameras.resolution": Limits(1, 4096, "pixel", count=2),
    "cameras.rate": Limits(1e-3, 1.0, "1"),
    **limits_of(Optics, "cameras."),
    "real_flights.position": Limits(0.0, 1e4, "m"),
    "real_flights.velocity": Limits(0.0, 1e4, "m/s"),
    "real_flights.attitude": Limits(0.0, 3.15, "rad"),
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

_WORDS: Final[Mapping[str, tuple[str, ...]]] = {
    "vehicle": (
        "name",
        "model",
        "body",
        "rotors",
        "drag",
        "battery",
        "sensors",
        "cameras",
        "real_flights",
    ),
    "model": ("file",),
    "body": ("parts",),
    "body.parts": ("shape",),
    "rotors": ("frame", "list"),
    "rotors.list": ("name", "turn", "link", "body", "site"),
    "cameras": ("name", "kinds", "stands"),
}
"""Keys of each table besides its numbers."""
_SHAPES: Final[Mapping[str, tuple[str, ...]]] = {"box": ("size",), "cylinder": ("radius", "length")}
_AHEAD: Final = (1.0, 0.0, 0.0)
_UP: Final = (0.0, 0.0, 1.0)
_MAX_BYTES: Final = 1_000_000  # it is read within a few seconds
_LEAST_MOMENT: Final = 1e-15  # kg m²: MuJoCo's mjMINVAL
DEFAULT_TIMESTEP: Final = 0.01
"""Physics step of a file that tells none, s."""
DEFAULT_GRAVITY: Final = 9.81
"""Downward acceleration of a file that tells none, m/s²."""


@dataclass(frozen=True, kw_only=True)
class Number:
    """A number of a vehicle's file, and where it comes from."""

    name: str
    """Dotted, as in "body.mass" or "rotors.list[1].position": the first rotor."""
    value: float | tuple[float, ...]
    unit: str
    source: str = ""
    why: str = ""
    """Why this value, if there are others."""
    others: tuple[tuple[float | tuple[float, ...], str], ...] = ()
    """Values of other sources, each with its source."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A box or a cylinder of a body."""

    mass: float
    position: _Vector
    """Of its center, m."""
    size: tuple[float, ...]
    """Sides of a box along its x, y and z; radius and length of a cylinder, m."""
    turn: float | _Vector
    """Angle of a box about z, rad; direction of a cylinder."""


@dataclass(frozen=True, kw_only=True)
class PlacedRotor:
    """Where a rotor is and how it turns."""

    name: str
    position: _Vector
    """In the body frame, or in that of what `on` names, m."""
    axis: _Vector
    """Direction of its thrust, of any length, in the same frame."""
    clockwise: bool
    """Seen from where its thrust points to."""
    on: tuple[str, str] | None = None
    """A "body" or a "site" of the model's file, and its name."""


@dataclass(frozen=True, kw_only=True)
class VehicleFile:
    """A vehicle's TOML file, read and checked by `read_vehicle_file`."""

    name: str
    numbers: tuple[Number, ...]
    """In the order of the tables on the page."""
    content: str
    """All that the file says of the vehicle, with all digits and without sources, to be hashed."""
    model: Path | None
    """File of the model, URDF or MJCF; None: it is built from the tables."""
    rotors: tuple[PlacedRotor, ...]
    parts: tuple[Part, ...]
    cameras: tuple[Camera, ...]

    def value(self, name: str, default: Any = None) -> Any:
        """A number by its name: a float or a tuple of floats; `default` if the file has none."""
        return next((one.value for one in self.numbers if one.name == name), default)

    @property
    def real_flights(self) -> str:
        """Mean error of its simulation after half a second of recorded flights; empty: unknown."""
        names = ("real_flights.position", "real_flights.velocity", "real_flights.attitude")
        told = [one for one in self.numbers if one.name in names]
        return ", ".join(f"{one.value:.3g} {one.unit}" for one in told)

    @property
    def thrust(self) -> tuple[float, float]:
        """Least and largest thrust of a rotor, N."""
        low, high = self.value("rotors.thrust") or (
            self.value("rotors.thrust_coefficient") * speed**2
            for speed in self.value("rotors.speed")
        )
        return low, high

    @property
    def reaction(self) -> float:
        """Torque about its axis per thrust of a rotor, N·m/N."""
        given: float | None = self.value("rotors.reaction")
        if given is not None:
            return given
        torque: float = self.value("rotors.torque_coefficient")
        return torque / float(self.value("rotors.thrust_coefficient"))

    @property
    def coefficients(self) -> dict[str, tuple[float, ...]]:
        """Those of effects and sensors, by "group.name"."""
        return {one.name: _floats(one.value) for one in self.numbers if one.name in COEFFICIENTS}

    def build(self, base: mujoco.MjSpec | None = None) -> mujoco.MjSpec:
        """The vehicle alone, without ground; `base` is the spec of `model`, changed in place."""
        spec = mujoco.MjSpec.from_string(self.mjcf()) if base is None else base
        if base is not None:
            _complete(base, self)
        free = mujoco.mjtJoint.mjJNT_FREE
        crafts = [body for body in spec.bodies if any(j.type == free for j in body.joints)]
        for camera in self.cameras if crafts and base is not None else ():
            place_camera(spec, crafts[0] if camera.carried else spec.worldbody, camera)
        return spec

    def mjcf(self) -> str:
        """MJCF of a vehicle without a model's file. Every number has all its digits."""
        root = _Mjcf(self).root
        ElementTree.indent(root)
        return ElementTree.tostring(root, encoding="unicode") + "\n"


# ---- reading


def read_vehicle_file(path: Path) -> VehicleFile:
    """Read a TOML file. Raises `InputError` with the name and the range of the first wrong field,
    `OSError` if the file cannot be read.
    """
    size = path.stat().st_size
    if not size <= _MAX_BYTES:
        raise InputError(f"vehicle: expected a TOML file of at most {_MAX_BYTES} bytes, got {size}")
    try:
        return _Reader(path, tomllib.loads(path.read_text(encoding="utf-8"))).result
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"vehicle: expected a TOML file, got {path.name}: {error}") from None
    except RecursionError:
        wanted = "a TOML file with tables as in docs/vehicles.md"
        raise InputError(f"vehicle: expected {wanted}, got too many in each other") from None


class _Reader:
    """Numbers of a tree, table by table."""

    def __init__(self, path: Path, tree: dict[str, Any]) -> None:
        self.numbers: list[Number] = []
        self._read(tree, "vehicle")
        name = tree.get("name", path.parent.name if path.stem == "vehicle" else path.stem)
        _check_name("name", name)
        model = self._model(path, tree.get("model"))
        parts = self._body(tree.get("body"), model)
        rotors = self._rotors(tree.get("rotors"), model)
        tables = enumerate(_tables("cameras", tree.get("cameras", []), least=0), 1)
        cameras = tuple(self._camera(one, f"cameras[{i}]") for i, one in tables)
        twice = [one.name for one in cameras]
        twice = [name for name in twice if twice.count(name) > 1]
        if twice:
            raise InputError(
                f"cameras: expected a name of its own for each, got {''.join(twice[:1])!r} twice"
            )
        for group in ("drag", "battery", "sensors", "real_flights"):
            self._read(tree.get(group, {}), group)
        physical = {key: value for key, value in tree.items() if key != "real_flights"}
        self.result = VehicleFile(
            name=name,
            numbers=tuple(self.numbers),
            content=json.dumps(_plain(physical | {"name": name}), sort_keys=True),
            model=model,
            rotors=rotors,
            parts=parts,
            cameras=cameras,
        )

    def _read(self, table: Any, kind: str, name: str = "") -> dict[str, Any]:
        """Numbers of a table of some kind, by key; its other keys must be known, too."""
        name = name or kind
        start = "" if kind == "vehicle" else kind + "."
        entries = {
            key.removeprefix(start): one
            for key, one in ENTRIES.items()
            if key.startswith(start) and "." not in key.removeprefix(start)
        }
        _check_keys(name, table, [*_WORDS.get(kind, ()), *entries], "source")
        source = table.get("source", "")
        if not isinstance(source, str):
            raise InputError(f"{name}.source: expected a text, got {source!r:.300}")
        values = {}
        for key, one in entries.items():
            if key in table:
                full = key if kind == "vehicle" else f"{name}.{key}"
                self.numbers.append(_number(full, one, table[key], source))
                values[key] = self.numbers[-1].value
        return values

    def _model(self, path: Path, table: Any) -> Path | None:
        if table is None:
            return None
        self._read(table, "model")
        file = table.get("file")
        right = isinstance(file, str) and Path(file).suffix.lower() in (".urdf", ".xml")
        if not right:
            raise InputError(
                "model.file: expected a URDF file (.urdf) or an MJCF file (.xml), "
                f"got {file!r:.300}"
            )
        model = path.parent / str(file)
        if not model.is_file():
            raise InputError(f"model.file: expected a file that is there, got {file!r:.300}")
        return model

    def _body(self, table: Any, model: Path | None) -> tuple[Part, ...]:
        if model is not None:
            if table is not None:
                raise InputError(
                    "body: expected none beside a model's file, which has it, got a table"
                )
            return ()
        if table is None:
            raise InputError(
                "vehicle: expected a table [body], or [model] with a file, got neither"
            )
        given = self._read(table, "body")
        own = [key for key in ("mass", "inertia", "center_of_mass") if key in given]
        if "parts" in table:
            got = f"{', '.join(own)} too"
            if own:
                raise InputError(f"body: expected parts, or mass and inertia, got {got}")
            listed = _tables("body.parts", table["parts"])
            return tuple(self._part(one, f"body.parts[{i}]") for i, one in enumerate(listed, 1))
        for key in ("mass", "inertia"):
            if key not in given:
                raise InputError(f"body: expected mass and inertia, or parts, got no {key}")
        _check_inertia(given["inertia"])
        return ()

    def _part(self, table: Any, name: str) -> Part:
        given = self._read(table, "body.parts", name)
        shape = table.get("shape")
        if not (isinstance(shape, str) and shape in _SHAPES):
            raise InputError(f"{name}.shape: expected 'box' or 'cylinder', got {shape!r:.300}")
        turn, other = ("yaw", "axis") if shape == "box" else ("axis", "yaw")
        for key in ("mass", *_SHAPES[shape]):
            if key not in given:
                raise InputError(f"{name}: expected {key} of a {shape}, got none")
        foreign = ({"size", "radius", "length", other} - set(_SHAPES[shape])) & set(given)
        for key in sorted(foreign):
            raise InputError(
                f"{name}: expected no {key} for a {shape}, got {given[key]!r:.300}"
            ) from None
        if "axis" in given:
            _check_axis(f"{name}.axis", given["axis"])
        size = (value for key in _SHAPES[shape] for value in _floats(given[key]))
        return Part(
            mass=given["mass"],
            position=given.get("position", (0.0, 0.0, 0.0)),
            size=tuple(size),
            turn=given.get(turn, 0.0 if shape == "box" else _UP),
        )

    def _camera(self, table: Any, name: str) -> Camera:
        given = self._read(table, "cameras", name)
        own = table.get("name")
        kinds = table.get("kinds", ["rgb"])
        stands = table.get("stands")
        if not is_name(own):
            raise InputError(
                f"{name}.name: expected up to {MAX_LETTERS} letters, digits and _, got {own!r:.300}"
            )
        right = isinstance(kinds, list) and bool(kinds)
        right = right and all(isinstance(kind, str) and kind in OUTPUTS for kind in kinds)
        if not right:
            raise InputError(
                f"{name}.kinds: expected some of {', '.join(OUTPUTS)}, got {kinds!r:.300}"
            )
        if not (stands is None or isinstance(stands, bool)):
            raise InputError(
                f"{name}.stands: expected true, for one that no drone carries, got {stands!r:.300}"
            )
        look = given.get("look", _AHEAD)
        _check_axis(f"{name}.look", look)
        upright = math.hypot(*look[:2]) > 1e-6 * math.hypot(*look)
        up = given.get("up", _UP if upright else _AHEAD)
        across = math.hypot(*_crossed(look, up))
        if not across > 1e-6 * math.hypot(*look) * math.hypot(*up):
            raise InputError(f"{name}.up: expected another direction than look, got {list(up)}")
        width, height = (round(side) for side in given.get("resolution", (64.0, 64.0)))
        if (width, height) != given.get("resolution", (width, height)):
            raise InputError(
                f"{name}.resolution: expected whole numbers, got {given.get('resolution')}"
            )
        if (width, height) == (1, 1):
            raise InputError(
                f"{name}.resolution: expected more than one pixel, got {width} by {height}"
            )
        return Camera(
            name=str(own),
            width=width,
            height=height,
            fovy=given.get("fovy", math.pi / 2),
            kinds=tuple(kind for kind in OUTPUTS if kind in kinds),
            every=steps_of(name, given.get("rate", 1.0)),
            carried=not stands,
            position=given.get("position", (0.0, 0.0, 0.0)),
            look=look,
            up=up,
            optics=Optics(**{key: given[key] for key in rules_of(Optics) if key in given}),
        )

    def _rotors(self, table: Any, model: Path | None) -> tuple[PlacedRotor, ...]:
        if table is None and model is not None and model.suffix.lower() == ".xml":
            return ()  # those of the file
        if table is None:
            raise InputError("vehicle: expected a table [rotors], got none")
        given = self._read(table, "rotors")
        frame = table.get("frame")
        listed = table.get("list")
        mjcf = model is not None and model.suffix.lower() == ".xml"
        if listed is None and frame is None and mjcf:
            self._only_coefficients(given)
            return ()
        both = "a frame or a list" if model is None else "a list"
        right = (frame is None) != (listed is None) and (frame is None or model is None)
        got = "both" if frame is not None and listed is not None else "neither"
        expect(right, "rotors", both, got if model is None else f"frame = {frame!r}")
        self._check_thrust(given)
        if frame is None:
            for key in ("arm", "height"):
                if key in given:
                    raise InputError(
                        f"rotors: expected no {key} with a list, got {given.get(key)!r:.300}"
                    )
            tables = enumerate(_tables("rotors.list", listed), 1)
            rotors = [self._rotor(one, i, model) for i, one in tables]
            names = [rotor.name for rotor in rotors]
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise InputError(
                    f"rotors.list: expected a name of its own for each, got {twice!r} twice"
                )
            return tuple(rotors)
        right = isinstance(frame, str) and frame in FRAMES
        expect(right, "rotors.frame", " or ".join(map(repr, FRAMES)), repr(frame))
        if "arm" not in given:
            raise InputError(f"rotors: expected arm of the frame {frame!r}, got none")
        return frame_rotors(frame, given["arm"], given.get("height", 0.0))

    def _only_coefficients(self, given: Mapping[str, Any]) -> None:
        for key in given:
            wanted = f"no {key} for rotors of the model's file"
            if f"rotors.{key}" not in COEFFICIENTS:
                raise InputError(f"rotors: expected {wanted}, got {given[key]!r:.300}")

    def _check_thrust(self, given: Mapping[str, Any]) -> None:
        """Thrust and reaction are told once each."""
        two = [key for key in ("thrust", "speed") if key in given]
        got = " and ".join(two) or "neither"
        if len(two) != 1:
            raise InputError(
                f"rotors: expected thrust, or speed with thrust_coefficient, got {got}"
            )
        low, high = given[two[0]]
        if not low < high:
            raise InputError(
                f"rotors.{two[0]}: expected a lower and a higher number, got {low:g}, {high:g}"
            )
        two = [key for key in ("reaction", "torque_coefficient") if key in given]
        wanted = "reaction, or torque_coefficient with thrust_coefficient"
        expect(len(two) == 1, "rotors", wanted, " and ".join(two) or "neither")
        for key in ("speed", "torque_coefficient"):
            if not (key not in given or "thrust_coefficient" in given):
                raise InputError(f"rotors: expected thrust_coefficient with {key}, got none")

    def _rotor(self, table: Any, number: int, model: Path | None) -> PlacedRotor:
        name = f"rotors.list[{number}]"
        _check_alike(name, table)
        given = self._read(table, "rotors.list", name)
        axis = given.get("axis", _UP)
        turn = table.get("turn")
        _check_axis(f"{name}.axis", axis)
        if turn not in ("cw", "ccw"):
            raise InputError(f"{name}.turn: expected 'cw' or 'ccw', got {turn!r:.300}")
        own = table.get("name", f"rotor{number}")
        _check_name(f"{name}.name", own)
        places = [key for key in ("link", "body", "site") if key in table]
        if model is None:
            expect(not places, name, "a position", "".join(places[:1]))
            if "position" not in given:
                raise InputError(f"{name}: expected a position, got none")
            on = None
        else:
            got = " and ".join(places) or "none"
            if len(places) != 1:
                raise InputError(
                    f"{name}: expected one of link, body and site of the model's file, got {got}"
                )
            place = table[places[0]]
            if not isinstance(place, str):
                raise InputError(f"{name}.{places[0]}: expected a name, got {place!r:.300}")
            at_site = places == ["site"]
            if at_site and "position" in given:
                raise InputError(
                    f"{name}: expected no position besides a site, which has it, got both"
                )
            on = ("site" if at_site else "body", place)
        return PlacedRotor(
            name=own,
            position=given.get("position", (0.0, 0.0, 0.0)),
            axis=axis,
            clockwise=turn == "cw",
            on=on,
        )


def frame_rotors(frame: str, arm: float, height: float = 0.0) -> tuple[PlacedRotor, ...]:
    """Rotors of a frame of `FRAMES`, `arm` from the body's origin and `height` above it, m."""
    count, first = FRAMES[frame]
    angles = [first - 2 * math.pi * i / count for i in range(count)]
    return tuple(
        PlacedRotor(
            name=f"rotor{i + 1}",
            position=(_round(arm * math.cos(angle)), _round(arm * math.sin(angle)), height),
            axis=_UP,
            clockwise=i % 2 == 0,
        )
        for i, angle in enumerate(angles)
    )


def _round(length: float) -> float:
    """So that a rotor on an axis is exactly there: 15 digits after the point are enough."""
    return round(length, 15) + 0.0


def _number(name: str, limits: Limits, given: Any, source: str) -> Number:
    """A number that is given plainly or with its provenance. Raises `InputError`."""
    told = given if isinstance(given, dict) else {"value": given}
    _check_keys(name, told, ("value", "source", "why", "others"))
    if "value" not in told:
        raise InputError(f"{name}: expected a value, got none")
    texts = {key: told.get(key, "") for key in ("source", "why")}
    for key, text in texts.items():
        if not isinstance(text, str):
            raise InputError(f"{name}.{key}: expected a text, got {text!r:.300}")
    others = []
    for i, other in enumerate(_tables(f"{name}.others", told.get("others", []), least=0), 1):
        _check_keys(f"{name}.others[{i}]", other, ("value", "source"))
        if "value" not in other:
            raise InputError(f"{name}.others[{i}]: expected a value, got none")
        where = other.get("source", "")
        if not isinstance(where, str):
            raise InputError(f"{name}.others[{i}].source: expected a text, got {where!r:.300}")
        others.append((check(f"{name}.others[{i}]", limits, other["value"]), where))
    return Number(
        name=name,
        value=check(name, limits, told["value"]),
        unit=limits.unit,
        source=texts["source"] or source,
        why=texts["why"],
        others=tuple(others),
    )


def _check_alike(name: str, table: Any) -> None:
    """Raise `InputError` for a rotor with a number that all rotors share."""
    keys = table if isinstance(table, dict) else ()
    for key in keys:
        if f"rotors.{key}" in ENTRIES and f"rotors.list.{key}" not in ENTRIES:
            raise InputError(
                f"{name}: expected no {key}, which all rotors share in [rotors]; rotors of two "
                f"sizes need an MJCF file with a motor for each, which [model] names, got {key}"
            )


def _check_keys(name: str, table: Any, known: Sequence[str], *silent: str) -> None:
    if not isinstance(table, dict):
        raise InputError(f"{name}: expected a table, got {table!r:.80}")
    for key in table:
        if not (key in known or key in silent):
            raise InputError(f"{name}: expected some of {', '.join(known)}, got {key!r:.300}")


def _check_name(name: str, given: Any) -> None:
    if not (isinstance(given, str) and 0 < len(given) <= 100 and given.isprintable()):
        raise InputError(
            f"{name}: expected a text of 1 to 100 printable characters, got {given!r:.300}"
        )


def _tables(name: str, given: Any, least: int = 1) -> list[Any]:
    right = isinstance(given, list) and len(given) >= least
    wanted = "a list of tables" + ", at least one" * least
    if not right:
        raise InputError(f"{name}: expected {wanted}, got {given!r:.80}")
    return list(given)


def _check_axis(name: str, axis: Sequence[float]) -> None:
    got = ", ".join(f"{one:g}" for one in axis)
    if not math.hypot(*axis) > 1e-6:
        raise InputError(f"{name}: expected a direction: three numbers, not all 0, got {got}")


def _check_inertia(values: tuple[float, ...]) -> None:
    """Raise `InputError` unless a body of some masses can have it."""
    import numpy as np

    got = ", ".join(f"{one:g}" for one in values)
    counts = "3 numbers: Ixx, Iyy, Izz, or 6: Ixx, Iyy, Izz, Ixy, Ixz, Iyz"
    if len(values) not in (3, 6):
        raise InputError(f"body.inertia: expected {counts}, got {got}")
    xx, yy, zz, xy, xz, yz = (*values, 0.0, 0.0, 0.0)[:6]
    low, middle, high = np.linalg.eigvalsh(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))).tolist()
    wanted = f"principal moments above {_LEAST_MOMENT:g} kg m²"
    if not low > _LEAST_MOMENT:
        raise InputError(f"body.inertia: expected {wanted}, got {got}")
    wanted = "principal moments of which none is larger than the sum of the others"
    if not high <= (low + middle) * (1 + 1e-9):
        raise InputError(
            f"body.inertia: expected {wanted}, got {low:.4g}, {middle:.4g} and {high:.4g} kg m²"
        )


def _floats(value: float | Iterable[float]) -> tuple[float, ...]:
    return tuple(value) if isinstance(value, Iterable) else (value,)


def _plain(tree: Any) -> Any:
    """What a tree says without provenance, with every number as a float."""
    if isinstance(tree, dict):
        if "value" in tree:
            return _plain(tree["value"])
        return {key: _plain(one) for key, one in tree.items() if key != "source"}
    if isinstance(tree, list):
        return [_plain(one) for one in tree]
    return float(tree) if isinstance(tree, int) else tree


# ---- building: a model from the tables


def _text(*values: float) -> str:
    """Numbers as MJCF has them, with all digits."""
    return " ".join(repr(float(value)) for value in values)


_MATERIALS: Final = {
    "carbon": "0.13 0.14 0.16 1",
    "shell": "0.93 0.94 0.95 1",
    "silver": "0.62 0.65 0.69 1",
    "front": "0.96 0.42 0.08 1",
    "front disc": "0.98 0.50 0.12 0.42",
    "rear disc": "0.20 0.46 0.78 0.42",
}


class _Mjcf:
    """The MJCF of a vehicle: what weighs, what touches, what is drawn, and the rotors.

    Lengths that the file does not tell are those of quad.xml, in the proportion of the spans.
    """

    def __init__(self, file: VehicleFile) -> None:
        self.file = file
        self.rotors = file.rotors
        reach = max(math.hypot(*rotor.position) for rotor in self.rotors)
        self.reach = max(reach, file.value("rotors.radius", 0.0), 1e-2)
        self.unit = self.reach / math.sqrt(2)  # 1 m of quad.xml
        self.half = _scaled(file.value("body.size") or self._sides(), 0.5)
        self.root = ElementTree.Element("mujoco", model=file.name)
        ElementTree.SubElement(self.root, "compiler", angle="radian")
        self._options()
        assets = ElementTree.SubElement(self.root, "asset")
        for name, color in _MATERIALS.items():
            ElementTree.SubElement(assets, "material", name=name, rgba=color)
        world = ElementTree.SubElement(self.root, "worldbody")
        clearance = self._clearance()
        self.body = ElementTree.SubElement(world, "body", name="craft", pos=_text(0, 0, clearance))
        ElementTree.SubElement(self.body, "freejoint", name="free")
        self._mass()
        self._hull(clearance)
        self._looks()
        self._actuators()
        for camera in file.cameras:
            self._camera(self.body if camera.carried else world, camera)

    def _camera(self, body: ElementTree.Element, camera: Camera) -> None:
        ElementTree.SubElement(
            body,
            "camera",
            name=camera.name,
            pos=_text(*camera.position),
            xyaxes=_text(*axes_of(camera)),
            fovy=_text(math.degrees(camera.fovy)),
            resolution=f"{camera.width} {camera.height}",
            output=" ".join(camera.kinds),
        )
        for name, data in texts_of(camera).items():
            custom = self.root.find("custom")
            if custom is None:
                custom = ElementTree.SubElement(self.root, "custom")
            ElementTree.SubElement(custom, "text", name=name, data=data)

    def _sides(self) -> tuple[float, ...]:
        """Of the hub if the file does not tell: of the heaviest box, if there are any."""
        boxes = [part for part in self.file.parts if not isinstance(part.turn, tuple)]
        heaviest = max(boxes, key=lambda part: part.mass, default=None)
        return heaviest.size if heaviest else _scaled((0.44, 0.44, 0.14), self.unit)

    def _options(self) -> None:
        value = self.file.value
        ElementTree.SubElement(
            self.root,
            "option",
            timestep=_text(value("timestep", DEFAULT_TIMESTEP)),
            integrator="RK4",
            gravity=_text(0, 0, -value("gravity", DEFAULT_GRAVITY)),
        )
        told = self.file.coefficients
        numbers = ElementTree.SubElement(self.root, "custom") if told else self.root
        for name, values in told.items():
            ElementTree.SubElement(numbers, "numeric", name=PREFIX + name, data=_text(*values))

    def _clearance(self) -> float:
        """Of the body's origin above the ground, m. Raises `InputError` if its parts need more."""
        motor = 0.06 * self.unit
        lowest = max(self.half[2], *(motor - rotor.position[2] for rotor in self.rotors))
        given: float = self.file.value("body.ground_clearance", lowest + 0.33 * self.unit)
        wanted = f"more than {lowest:.4g} m, which hub and rotors need"
        if not given > lowest:
            raise InputError(f"body.ground_clearance: expected {wanted}, got {given:g}")
        return given

    def _geom(self, name: str, kind: str, material: str, **more: str) -> None:
        """A massless geom that is drawn and collides, unless `more` tells otherwise."""
        told = {"mass": "0", "group": "1", **more}
        kinds = {"name": name, "type": kind, "material": material}
        ElementTree.SubElement(
            self.body, "geom", {key: v for key, v in (kinds | told).items() if v}
        )

    def _mass(self) -> None:
        """Mass and inertia as given, or parts that have them."""
        file = self.file
        for number, part in enumerate(file.parts, 1):
            ghost = {"contype": "0", "conaffinity": "0", "mass": _text(part.mass)}
            ghost["pos"] = _text(*part.position)
            if isinstance(part.turn, tuple):
                radius, length = part.size
                turn = {} if part.turn == _UP else {"zaxis": _text(*part.turn)}
                ghost |= {"size": _text(radius, length / 2), **turn}
            else:
                turn = {"euler": _text(0, 0, part.turn)} if part.turn else {}
                ghost |= {"size": _text(*_scaled(part.size, 0.5)), **turn}
            kind = "cylinder" if isinstance(part.turn, tuple) else "box"
            self._geom(f"part{number}", kind, "carbon", **ghost)
        if file.parts:
            return
        inertia = file.value("body.inertia")
        ElementTree.SubElement(
            self.body,
            "inertial",
            {"diaginertia" if len(inertia) == 3 else "fullinertia": _text(*inertia)},
            pos=_text(*file.value("body.center_of_mass", (0.0, 0.0, 0.0))),
            mass=_text(file.value("body.mass")),
        )

    def _hull(self, clearance: float) -> None:
        """What touches: hub, motors and two skids. If parts are drawn, hub and motors are not."""
        seen = {"group": "3"} if self.file.parts else {}
        self._geom("hub", "box", "carbon", size=_text(*self.half), **seen)
        motor = _text(0.09 * self.unit, 0.06 * self.unit)
        for rotor in self.rotors:
            where = {"pos": _text(*rotor.position), "size": motor} | _turned(rotor)
            self._geom(f"motor {rotor.name}", "cylinder", "silver", **where, **seen)
        thick = min(0.03 * self.unit, (clearance - self.half[2]) / 2)
        long = 0.5 * self.unit
        wide = 0.45 * self.unit
        for side, y in (("left", wide), ("right", -wide)):
            ends = _text(-long, y, thick - clearance, long, y, thick - clearance)
            self._geom(f"skid {side}", "capsule", "silver", size=_text(thick), fromto=ends)
            for x in (-0.6 * long, 0.6 * long):
                top = (math.copysign(0.7 * self.half[0], x), math.copysign(0.8 * self.half[1], y))
                ends = _text(*top, -self.half[2] / 2, x, y, thick - clearance)
                self._ghost("", "capsule", "silver", size=_text(0.7 * thick), fromto=ends)

    def _ghost(self, name: str, kind: str, material: str, **more: str) -> None:
        """A geom that is only drawn."""
        self._geom(name, kind, material, contype="0", conaffinity="0", group="2", **more)

    def _looks(self) -> None:
        x, y, z = self.half
        shell = _text(1.2 * x, 0.9 * y, 1.7 * z)
        mark = _text(0.6 * x, 0.55 * y, 1.1 * z)
        self._ghost("canopy", "ellipsoid", "shell", pos=_text(0, 0, 0.7 * z), size=shell)
        self._ghost("front mark", "ellipsoid", "front", pos=_text(0.9 * x, 0, 0.6 * z), size=mark)
        radius = self.file.value("rotors.radius") or 0.4 * _nearest(self.rotors, self.reach)
        for number, rotor in enumerate(self.rotors, 1):
            if not self.file.parts and math.hypot(*rotor.position[:2]) > x:
                ends = _text(0, 0, 0, *rotor.position)
                thick = _text(0.035 * self.unit)
                self._ghost(f"arm{number}", "cylinder", "carbon", fromto=ends, size=thick)
            size = math.hypot(*rotor.axis)
            above = _scaled(rotor.axis, 0.09 * self.unit / size)
            pos = {"pos": _text(*(p + a for p, a in zip(rotor.position, above, strict=True)))}
            front = rotor.position[0] > 1e-6 * self.reach
            disc = _text(radius, 0.01 * radius)
            material = "front disc" if front else "rear disc"
            turned = _turned(rotor)
            self._ghost(f"disc{number}", "cylinder", material, size=disc, **pos, **turned)
            blade = _scaled((0.97, 0.09, 0.018), radius)
            turned = turned or {"euler": _text(0, 0, 0.4 + 1.5 * number)}
            self._ghost("", "ellipsoid", "carbon", size=_text(*blade), **pos, **turned)

    def _actuators(self) -> None:
        motors = ElementTree.SubElement(self.root, "actuator")
        reaction = self.file.reaction
        for rotor in self.rotors:
            place = {"name": rotor.name, "pos": _text(*rotor.position)} | _turned(rotor)
            looks = {"group": "4", "size": _text(0.02 * self.unit)}
            ElementTree.SubElement(self.body, "site", place | looks)
            ElementTree.SubElement(
                motors,
                "motor",
                name=rotor.name,
                site=rotor.name,
                gear=_text(0, 0, 1, 0, 0, reaction if rotor.clockwise else -reaction),
                ctrllimited="true",
                ctrlrange=_text(*self.file.thrust),
            )


def _scaled(vector: Sequence[float], factor: float) -> tuple[float, ...]:
    return tuple(factor * one for one in vector)


def _crossed(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _turned(rotor: PlacedRotor) -> dict[str, str]:
    return {} if rotor.axis == _UP else {"zaxis": _text(*rotor.axis)}


def _nearest(rotors: Sequence[PlacedRotor], reach: float) -> float:
    """Shortest distance between two rotors that are not above each other, m."""
    places = [rotor.position[:2] for rotor in rotors]
    distances = [math.dist(a, b) for i, a in enumerate(places) for b in places[:i]]
    return min((one for one in distances if one > 0.1 * reach), default=reach)


# ---- building: a model from a file of its own


def _complete(spec: mujoco.MjSpec, file: VehicleFile) -> None:
    """Add to the spec of a model's file what the TOML file tells of it."""
    assert file.model is not None  # `build` has seen to it
    urdf = file.model.suffix.lower() == ".urdf"
    spec.modelname = file.name
    if urdf:
        _find_meshes(spec, file.model.parent)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        spec.compiler.fusestatic = False  # it would fuse the root with the world
        root = spec.worldbody.first_body()
        if root is None:
            raise InputError("model.file: expected a URDF file with links, got none")
        if not list(root.joints):
            root.add_freejoint()
    if urdf or file.value("timestep"):
        spec.option.timestep = file.value("timestep", DEFAULT_TIMESTEP)
    if urdf or file.value("gravity"):
        spec.option.gravity = (0.0, 0.0, -file.value("gravity", DEFAULT_GRAVITY))
    if not (not file.rotors or not list(spec.actuators)):
        raise InputError(
            "rotors.list: expected none for a model's file with actuators, which are its rotors, "
            f"got {len(file.rotors)} of them"
        )
    for number, rotor in enumerate(file.rotors, 1):
        _add_rotor(spec, file, rotor, number)
    for name, values in file.coefficients.items():
        numeric = spec.numeric(PREFIX + name) or spec.add_numeric(name=PREFIX + name)
        numeric.size = len(values)
        numeric.data = values


def _find_meshes(spec: mujoco.MjSpec, folder: Path) -> None:
    """Meshes of a package are looked for in the folder of a URDF file, and in those above it."""
    for mesh in spec.meshes:
        if not mesh.file.startswith("package:"):
            continue
        inside = Path(mesh.file.removeprefix("package:").lstrip("/"))
        ways = inside, Path(*inside.parts[1:])  # with the package's name, or without
        places = (up / way for up in (folder, *folder.parents) for way in ways)
        found = next((place for place in places if place.is_file()), None)
        got = f"no file for {mesh.file}"
        if not found:
            raise InputError(
                f"model.file: expected its meshes in its folder or one above, got {got}"
            )
        mesh.file = os.path.relpath(str(found), folder)


def _add_rotor(spec: mujoco.MjSpec, file: VehicleFile, rotor: PlacedRotor, number: int) -> None:
    assert rotor.on is not None  # the reader has seen to it
    kind, name = rotor.on
    known = [one.name for one in (spec.sites if kind == "site" else spec.bodies)]
    found = getattr(spec, kind)(name)
    wanted = f"a {kind} of the model's file: {', '.join(one for one in known if one != 'world')}"
    if not (found is not None and name != "world"):
        raise InputError(f"rotors.list[{number}]: expected {wanted}, got {name!r:.300}")
    if kind == "body":
        for joint in list(found.joints):  # a propeller that turns is welded on
            if joint.type != mujoco.mjtJoint.mjJNT_FREE:
                spec.delete(joint)
        _add_disc(found, file, rotor)
        found = found.add_site(name=f"rotor/{rotor.name}", pos=rotor.position, group=4)
    axis = _scaled(rotor.axis, 1 / math.hypot(*rotor.axis))
    reaction = file.reaction if rotor.clockwise else -file.reaction
    spec.add_actuator(
        name=rotor.name,
        target=found.name,
        trntype=mujoco.mjtTrn.mjTRN_SITE,
        gear=(*axis, *_scaled(axis, reaction)),
        ctrllimited=True,
        ctrlrange=file.thrust,
    )


def _add_disc(body: Any, file: VehicleFile, rotor: PlacedRotor) -> None:
    """Draw the disc of a rotor, if its radius is told."""
    if (radius := file.value("rotors.radius")) is None:
        return
    disc = body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=rotor.position, group=2)
    disc.size = (radius, 0.01 * radius, 0)
    disc.rgba = (0.20, 0.46, 0.78, 0.42)
    disc.mass = 0
    disc.contype = 0
    disc.conaffinity = 0
    if rotor.axis != _UP:
        disc.alt.type = mujoco.mjtOrientation.mjORIENTATION_ZAXIS
        disc.alt.zaxis = rotor.axis
