"""The vehicle's file with identified numbers: docs/vehicles.md has the format."""

import json
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from fit import LAG
from numpy.typing import ArrayLike
from prediction import Numbers, entry_of, inertia_of
from rotorgram.models.vehicle import Vehicle
from rotorgram.models.vehicle_file import read_vehicle_file

_OF_FILE = ("body.size", "body.ground_clearance")
"""Entries of a file that the vehicle itself no longer has."""


class Origin(NamedTuple):
    """Where a number of the file comes from."""

    source: str
    """Empty: the source in the vehicle's file."""
    why: str = ""


def vehicle_toml(vehicle: Vehicle, numbers: Numbers, origins: Mapping[str, Origin]) -> str:
    """A TOML file of a vehicle with other numbers; origins by their dotted names.

    The time constant is the vehicle's own unless it is among the numbers.
    """
    given = {}
    if vehicle.path.suffix.lower() == ".toml":
        given = {number.name: number for number in read_vehicle_file(vehicle.path).numbers}
    own = vehicle.path.parent.name if vehicle.path.stem == "vehicle" else vehicle.path.stem
    values = _values(vehicle, numbers)
    values |= {name: given[name].value for name in _OF_FILE if name in given}
    lines = [
        f"name = {_written(vehicle.name)}",
        f"timestep = {vehicle.timestep!r}",
        f"gravity = {vehicle.gravity!r}",
    ]
    tables: dict[str, list[str]] = {}
    for name, value in values.items():
        origin = origins.get(name, Origin(""))
        known = given[name].source if name in given else f"as in {own}"
        text = f"value = {_written(value)}, source = {_written(origin.source or known)}"
        if origin.why:
            text += f", why = {_written(origin.why)}"
        group, _, key = name.partition(".")
        tables.setdefault(group, []).append(f"{key} = {{ {text} }}")
    for group, rows in tables.items():
        lines += ["", f"[{group}]", *rows]
        if group == "rotors":
            lines += _rotors(vehicle)
    return "\n".join([*lines, ""])


def _values(vehicle: Vehicle, numbers: Numbers) -> dict[str, ArrayLike]:
    """Values of the file's entries, but for those that a model lacks."""
    inertia = inertia_of(vehicle, numbers)
    products = [inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    values: dict[str, ArrayLike] = {
        "body.mass": vehicle.mass,
        "body.inertia": [*np.diag(inertia), *(products if np.any(products) else ())],
        "rotors.thrust": [vehicle.thrust_low.min(), vehicle.thrust_high.max()],
    }
    if vehicle.center_of_mass.any():
        values["body.center_of_mass"] = vehicle.center_of_mass
    given = vehicle.coefficients.numbers()
    changed: dict[str, list[float]] = {}
    for name, number in numbers.items():
        changed.setdefault(entry_of(name)[0], []).append(number)
    del changed["body.inertia"]
    for entry, own in {**given, **changed}.items():
        if entry in given or any(own):
            values[entry] = own[0] if len(own) == 1 and entry != "rotors.curve" else own
    if LAG in numbers:
        values.pop("rotors.time_constant_down", None)
    return values


def _rotors(vehicle: Vehicle) -> Iterator[str]:
    for rotor in vehicle.rotors:
        clockwise = np.dot(rotor.reaction, rotor.axis) > 0
        yield from (
            "",
            "[[rotors.list]]",
            f"name = {_written(rotor.name)}",
            f"position = {_written(rotor.position)}",
            f"axis = {_written(rotor.axis)}",
            f'turn = "{"cw" if clockwise else "ccw"}"',
        )


def _written(value: ArrayLike) -> str:
    """A text, a number or a list of numbers in TOML, with all digits."""
    plain = value if isinstance(value, str) else np.asarray(value, np.float64).tolist()
    return json.dumps(plain, ensure_ascii=False)
