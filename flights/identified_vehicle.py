"""A vehicle's TOML file with identified numbers: docs/vehicles.md has the format."""

import json
from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..models.vehicle import Vehicle
from ..models.vehicle_file import read_vehicle_file
from .identify import LAG, Estimate, Identified
from .prediction import Numbers, inertia_of

_VECTORS: Final = {
    "body.inertia": "xyz", "drag.linear": "xyz", "drag.angular": "xyz", "drag.moment": "xy",
}  # fmt: skip
_SINGLE: Final = (
    "rotors.thrust_coefficient", "rotors.reaction", "rotors.drag", "rotors.inflow", "rotors.lift",
    LAG,
)  # fmt: skip


class Origin(NamedTuple):
    """Source of a number and a reason; an empty source stands for that of the vehicle's file."""

    source: str
    why: str = ""


def identified_toml(vehicle: Vehicle, found: Identified) -> str:
    """The vehicle with the identified numbers, and the 95 % interval of each.

    All else is the vehicle's own, with the sources of its file where that is TOML.
    """
    source = f"identified from {', '.join(found.logs)}"
    groups: dict[str, list[Estimate]] = {}
    for one in found.estimates:
        group = one.name.rpartition(".")[0]
        groups.setdefault(group if group in _VECTORS else one.name, []).append(one)
    origins = {}
    for name, estimates in groups.items():
        fitted = any(not one.kept for one in estimates)
        why = "; ".join(map(_sentence, estimates))
        origins[name] = Origin(source if fitted else "", why)
    return vehicle_toml(vehicle, found.numbers, origins)


def vehicle_toml(
    vehicle: Vehicle, numbers: Numbers, origins: Mapping[str, Origin] | None = None
) -> str:
    """A TOML file of a vehicle with other numbers; sources by their dotted names.

    The time constant is the vehicle's own unless it is among the numbers.
    """
    origins = origins or {}
    given = {}
    if vehicle.path.suffix.lower() == ".toml":
        given = {one.name: one for one in read_vehicle_file(vehicle.path).numbers}
    own = vehicle.path.parent.name if vehicle.path.stem == "vehicle" else vehicle.path.stem
    groups: dict[str, dict[str, ArrayLike]] = {"body": {}, "rotors": {}}
    for name in ("body.size", "body.ground_clearance"):
        if name in given:
            groups["body"][name] = given[name].value
    if "rotors.speed" in given:
        groups["rotors"]["rotors.speed"] = given["rotors.speed"].value
    for name, value in _values(vehicle, numbers, "rotors.speed" not in given):
        groups.setdefault(name.partition(".")[0], {})[name] = value
    lines = [
        f"name = {_quoted(vehicle.name)}",
        f"timestep = {vehicle.timestep!r}",
        f"gravity = {vehicle.gravity!r}",
    ]
    for group, values in groups.items():
        lines += ["", f"[{group}]"]
        for name, value in values.items():
            origin = origins.get(name, Origin(""))
            known = given[name].source if name in given else f"as in {own}"
            text = f"value = {_plain(value)}, source = {_quoted(origin.source or known)}"
            if origin.why:
                text += f", why = {_quoted(origin.why)}"
            lines.append(f"{name.rpartition('.')[2]} = {{ {text} }}")
        if group == "rotors":
            lines += _rotors(vehicle)
    return "\n".join([*lines, ""])


def _values(vehicle: Vehicle, numbers: Numbers, limits: bool) -> Iterator[tuple[str, ArrayLike]]:
    """Names and values of the file, but for those that a model lacks."""
    inertia = inertia_of(vehicle, numbers)
    products = [inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    yield "body.mass", vehicle.mass
    yield "body.inertia", [*np.diag(inertia), *(products if np.any(products) else ())]
    if vehicle.center_of_mass.any():
        yield "body.center_of_mass", vehicle.center_of_mass
    if limits:
        yield "rotors.thrust", [vehicle.thrust_low.min(), vehicle.thrust_high.max()]
    values: dict[str, ArrayLike] = {}
    for name, own in vehicle.coefficients.numbers().items():
        values[name] = own[0] if len(own) == 1 and name != "rotors.curve" else own
    for name in _SINGLE:
        if name in numbers and (numbers[name] or name in values):
            values[name] = numbers[name]
    for name, axes in _VECTORS.items():
        vector = [numbers[f"{name}.{axis}"] for axis in axes]
        if name != "body.inertia" and (any(vector) or name in values):
            values[name] = vector
    if LAG in numbers:
        values.pop("rotors.time_constant_down", None)
    yield from values.items()


def _rotors(vehicle: Vehicle) -> Iterator[str]:
    for rotor in vehicle.rotors:
        clockwise = np.dot(rotor.reaction, rotor.axis) > 0
        yield from (
            "",
            "[[rotors.list]]",
            f"name = {_quoted(rotor.name)}",
            f"position = {_plain(rotor.position)}",
            f"axis = {_plain(rotor.axis)}",
            f'turn = "{"cw" if clockwise else "ccw"}"',
        )


def _sentence(one: Estimate) -> str:
    group, _, axis = one.name.rpartition(".")
    start = f"{axis}: " if group in _VECTORS else ""
    if one.kept:
        return f"{start}the vehicle's own value, {one.kept}"
    return f"{start}95 % interval {one.low:.4g} to {one.high:.4g}"


def _plain(value: ArrayLike) -> str:
    """A number or a list of numbers in TOML, with all digits."""
    return str(np.asarray(value, np.float64).tolist())


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
