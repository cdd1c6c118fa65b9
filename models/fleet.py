"""Vehicles that are not one for all: of the drones of one world, and of its episodes."""

import copy
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from hashlib import blake2b
from pathlib import Path
from typing import Any, Self

import numpy as np

from .drawn import SLOTS, columns, drawn_craft, middle_file, range_of, table_of
from .errors import InputError
from .library import is_pool, words_of
from .vehicle import Vehicle

_OF_DRONES = (
    "mass", "center_of_mass", "inertia", "thrust_low", "thrust_high", "allocation", "hover_thrust",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Fleet(Vehicle):
    """A vehicle for each of A drones, in the place of one for all.

    What belongs to a drone is an array with the first axis A: `mass` (A,), `center_of_mass` (A, 3),
    `inertia` (A, 3, 3), `allocation` (A, 4, R), `thrust_low`, `thrust_high` and `hover_thrust`
    (A, R). Radius and height at rest are the largest of all, accelerations the least. The model,
    its path and the coefficients are those of the first.
    """

    members: tuple[Vehicle, ...]
    """Of each drone, under the physics step and the gravity that all share."""

    @classmethod
    def of(cls, members: Sequence[Vehicle]) -> Self:
        """Of one vehicle for each drone. Raises `InputError` where they have not the same number of
        rotors.
        """
        first = members[0]
        for one in members:
            if one.num_rotors != first.num_rotors:
                raise InputError(
                    f"vehicle: expected {first.num_rotors} rotors as of {first.name}, "
                    f"got {one.num_rotors} of {one.name}"
                )
        values: dict[str, Any] = {one.name: getattr(first, one.name) for one in fields(Vehicle)}
        for name in _OF_DRONES:
            values[name] = np.array([getattr(one, name) for one in members])
        values["name"] = ", ".join(dict.fromkeys(one.name for one in members))
        together = " ".join(one.hash for one in members)
        values["hash"] = blake2b(together.encode(), digest_size=16).hexdigest()
        for name in ("radius", "rest_height"):
            values[name] = max(getattr(one, name) for one in members)
        return cls(**values, members=tuple(members))

    @property
    def max_acceleration(self) -> float:
        """Of the least able, m/s²."""
        return min(one.max_acceleration for one in self.members)

    def turning(self, axis: Sequence[float] | np.ndarray) -> float:
        """Of the least able, rad/s²."""
        return min(one.turning(axis) for one in self.members)

    def __reduce__(self) -> tuple[object, ...]:
        """Loaded again from its files."""
        paths = [str(one.path) for one in self.members]
        return partial(load_vehicles, linear_drag=self.linear_drag), (paths, len(self.members))


@dataclass(frozen=True, kw_only=True, eq=False)
class Pool(Vehicle):
    """Craft of which each episode draws one, in the place of a vehicle for all.

    Without air a craft flies as one of another mass does whose thrusts and inertia are as many
    times as large: here each has 1 kg, and a thrust is that per kilogram. The model, the radius
    and the height at rest are those of a craft of 1 kg in the middle of all ranges.
    """

    numbers: range
    """Of the craft."""
    table: np.ndarray
    """A row for each, as of `drawn.columns`, (N, k)."""

    def __reduce__(self) -> tuple[object, ...]:
        """Drawn again."""
        return load_pool, (self.name, self.linear_drag)


@lru_cache(maxsize=8)
def load_pool(word: str, linear_drag: float = 0.0) -> Pool:
    """The pool of a word. Raises `InputError`."""
    numbers = range_of(word)
    base = Vehicle.load(middle_file(), linear_drag=linear_drag)
    table = table_of(drawn_craft(numbers))
    digest = blake2b(table.tobytes() + base.hash.encode(), digest_size=16)
    values: dict[str, Any] = {one.name: getattr(base, one.name) for one in fields(Vehicle)}
    shares = columns(table)
    values["thrust_high"] = np.full(SLOTS, (shares["highest"] * shares["share"]).max())
    values |= {"name": f"drawn:{numbers[0]}-{numbers[-1]}", "hash": digest.hexdigest()}
    return Pool(**values, numbers=numbers, table=table)


def load_vehicles(
    vehicle: Path | str | Sequence[str] | None,
    drones: int,
    *,
    linear_drag: float = 0.0,
    longest_step: float = math.inf,
) -> Vehicle:
    """The vehicle of all drones of a world, or a `Fleet` if several are named.

    Names or files go to the drones in their order, and repeat from the first if there are more
    drones. The physics step is the shortest of all, at most `longest_step`, s, and gravity that of
    the first. Raises `InputError`.
    """
    names = words_of("vehicle", vehicle) or (None,)
    if len(names) > drones:
        got = ",".join(map(str, names))
        raise InputError(
            f"vehicle: expected at most one vehicle for each of {drones} drones, "
            f"got {len(names)}: {got}"
        )
    loaded = [_loaded(name, linear_drag) for name in names]
    step = min(longest_step, *(one.timestep for one in loaded))
    kinds = {one: _under(one, step, loaded[0].gravity) for one in loaded}
    members = [kinds[one] for one in loaded]
    if len(kinds) == 1:
        return members[0]
    if any(isinstance(one, Pool) for one in members):
        raise InputError(f"vehicle: expected no others besides drawn craft, got {names}")
    return Fleet.of([members[i % len(members)] for i in range(drones)])


def _loaded(name: str | None, linear_drag: float) -> Vehicle:
    """One vehicle, or a `Pool` of drawn craft."""
    if name and is_pool(name) and not os.path.isfile(name):
        return load_pool(name, linear_drag)
    return Vehicle.load(name, linear_drag=linear_drag)


def members_of(vehicle: Vehicle, drones: int) -> tuple[Vehicle, ...]:
    """The vehicle of each drone."""
    return vehicle.members if isinstance(vehicle, Fleet) else (vehicle,) * drones


def _under(vehicle: Vehicle, timestep: float, gravity: float) -> Vehicle:
    """The vehicle with another physics step, s, and gravity, m/s²."""
    if (timestep, gravity) == (vehicle.timestep, vehicle.gravity):
        return vehicle
    model = copy.copy(vehicle.model)
    model.opt.timestep = timestep
    model.opt.gravity[2] = -gravity
    hover = vehicle.hover_thrust * (gravity / vehicle.gravity)
    return replace(vehicle, model=model, gravity=gravity, hover_thrust=hover)
