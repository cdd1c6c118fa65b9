"""A vehicle's TOML file with identified numbers: docs/vehicles.md has the format."""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from ..models.coefficients import COEFFICIENTS
from ..models.vehicle import Vehicle
from ..models.vehicle_file import read_vehicle_file
from .identify import LAG, Estimate, Identified
from .prediction import Airframe

_VECTORS = {"body.inertia": "xyz", "drag.linear": "xyz", "drag.angular": "xyz", "drag.moment": "xy"}


def identified_toml(vehicle: Vehicle, found: Identified) -> str:
    """The vehicle with what was identified, and the 95 % interval of each number.

    All else is the vehicle's own, with the sources of its file where that is TOML.
    """
    source = f"identified from {', '.join(found.logs)}"
    told: dict[str, list[Estimate]] = {}
    for one in found.estimates:
        kind = one.name.rpartition(".")[0]
        told.setdefault(kind if kind in _VECTORS else one.name, []).append(one)
    provenance = {}
    for name, estimates in told.items():
        fitted = [one for one in estimates if not one.kept]
        why = "; ".join(_sentence(one) for one in estimates)
        provenance[name] = (source if fitted else "", why)
    return vehicle_toml(vehicle, found.airframe, found.time_constant, provenance)


def vehicle_toml(
    vehicle: Vehicle,
    airframe: Airframe,
    time_constant: float | None = None,
    provenance: Mapping[str, tuple[str, str]] | None = None,
) -> str:
    """A TOML file of a vehicle that moves as `airframe`.

    `provenance` has source and reason of numbers by their dotted name; an empty source stands for
    that of the vehicle's own file.
    """
    told = dict(provenance or {})
    file = read_vehicle_file(vehicle.path) if vehicle.path.suffix.lower() == ".toml" else None
    given = {} if file is None else {one.name: one for one in file.numbers}
    own = vehicle.path.parent.name if vehicle.path.stem == "vehicle" else vehicle.path.stem

    def line(name: str, value: Any) -> str:
        source, why = told.get(name, ("", ""))
        if not source:
            source = given[name].source if name in given else f"as in {own}"
        parts = [f"value = {_plain(value)}", f"source = {_quoted(source)}"]
        if why:
            parts.append(f"why = {_quoted(why)}")
        return f"{name.rpartition('.')[2]} = {{ {', '.join(parts)} }}"

    matrix = airframe.inertia
    inertia = [*np.diag(matrix), matrix[0, 1], matrix[0, 2], matrix[1, 2]]
    body = {
        "body.mass": airframe.mass,
        "body.inertia": inertia if np.any(inertia[3:]) else inertia[:3],
    }
    if airframe.center.any():
        body["body.center_of_mass"] = airframe.center
    for name in ("body.size", "body.ground_clearance"):
        if name in given:
            body[name] = given[name].value
    rotors: dict[str, Any] = {}
    if "rotors.speed" in given:
        rotors["rotors.speed"] = given["rotors.speed"].value
    else:
        rotors["rotors.thrust"] = [vehicle.thrust_low.min(), vehicle.thrust_high.max()]
    rotors["rotors.reaction"] = airframe.reaction
    numbers: dict[str, Any] = {}
    for name, value in vehicle.coefficients.numbers().items():
        numbers[name] = value[0] if COEFFICIENTS[name].count == 1 else list(value)
    numbers["rotors.thrust_coefficient"] = airframe.thrust_coefficient
    moved: dict[str, Any] = {
        "rotors.drag": airframe.drag, "rotors.inflow": airframe.inflow,
        "rotors.lift": airframe.lift, "drag.linear": airframe.linear,
        "drag.angular": airframe.angular, "drag.moment": airframe.moment,
    }  # fmt: skip
    for name, value in moved.items():
        if np.any(value) or name in numbers:
            numbers[name] = value
    if time_constant is not None:
        numbers[LAG] = time_constant
        numbers.pop("rotors.time_constant_down", None)
    groups: dict[str, dict[str, Any]] = {"body": body, "rotors": rotors}
    for name, value in numbers.items():
        groups.setdefault(name.partition(".")[0], {})[name] = value
    lines = [f"name = {_quoted(vehicle.name)}"]
    lines += [f"timestep = {vehicle.timestep!r}", f"gravity = {airframe.gravity!r}"]
    for group, values in groups.items():
        lines += ["", f"[{group}]", *(line(name, value) for name, value in values.items())]
        if group == "rotors":
            lines += _listed(vehicle, airframe)
    return "\n".join([*lines, ""])


def _listed(vehicle: Vehicle, airframe: Airframe) -> Iterable[str]:
    for i, rotor in enumerate(vehicle.rotors):
        yield from (
            "",
            "[[rotors.list]]",
            f"name = {_quoted(rotor.name)}",
            f"position = {_plain(rotor.position)}",
            f"axis = {_plain(rotor.axis)}",
            f'turn = "{"cw" if airframe.turn[i] > 0 else "ccw"}"',
        )


def _sentence(one: Estimate) -> str:
    axis = one.name.rpartition(".")[2] if one.name.rpartition(".")[0] in _VECTORS else ""
    start = f"{axis}: " if axis else ""
    if one.kept:
        return f"{start}the vehicle's own value, {one.kept}"
    return f"{start}95 % interval {one.low:.4g} to {one.high:.4g}"


def _plain(value: Any) -> str:
    if isinstance(value, Sequence | np.ndarray):
        return "[" + ", ".join(_plain(one) for one in value) + "]"
    return repr(float(value))


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
