"""Several crafts in one world: its compiled model, and which parts belong to which craft."""

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from mujoco import MjModel

from .errors import InputError
from .mjcf import add_ground, swarm_spec
from .vehicle import Vehicle, hang_payload, owners

SHARED = ("timestep", "gravity", "integrator", "density", "viscosity", "wind", "magnetic")
"""Options that a world has once, so that its vehicles have to agree."""
CONTACTS = "rotorgram/contacts"
GROUNDED = "rotorgram/grounded"
"""Sensors of a craft: how many contacts it has, and how many of them with the world."""


def drone_names(count: int) -> tuple[str, ...]:
    """Names of the drones of a world."""
    return tuple(f"drone_{i}" for i in range(count))


def swarm_model(
    vehicles: Sequence[Vehicle],
    *,
    movable: bool = False,
    payload: float = 0.0,
    cable: float = 0.0,
    surround: Callable[[mujoco.MjSpec], None] = add_ground,
) -> MjModel:
    """A world with a craft of each vehicle, without visual elements.

    Free joints and rotors come craft by craft, and two sensors of each count its contacts. With
    `movable`, centers of mass may be moved. A payload, kg, is a ball on a cable, m, from each
    craft: its free joint comes last, and centers of mass may be moved too. `surround` adds what
    stands around the crafts. Raises `InputError` where vehicles do not agree in `SHARED`.
    """
    first = vehicles[0]
    names = drone_names(len(vehicles))
    for vehicle in vehicles:
        for name in SHARED:
            ours = getattr(first.model.opt, name)
            its = getattr(vehicle.model.opt, name)
            if not np.array_equal(ours, its):
                got = f"{its} of {vehicle.name}"
                raise InputError(
                    f"vehicle: expected a {name} of {ours} as of {first.name}, got {got}"
                )
    spec, crafts = swarm_spec([vehicle.path for vehicle in vehicles], names)
    surround(spec)
    spec.compiler.discardvisual = True
    for name, craft in zip(names, crafts, strict=True):
        if movable or payload:
            craft.simple = False
        _count_contacts(spec, f"{name}/{CONTACTS}", craft.name)
        _count_contacts(spec, f"{name}/{GROUNDED}", craft.name, spec.worldbody.name)
    if payload:
        hang_payload(spec, crafts, payload, cable)
    model = spec.compile()
    for name in SHARED:  # they may be others than those of the first file
        setattr(model.opt, name, getattr(first.model.opt, name))
    model.geom_group[:] = owners(model)[model.geom_bodyid] >= 0
    for drone, vehicle in enumerate(vehicles):
        model.dof_damping[6 * drone : 6 * drone + 3] = vehicle.model.dof_damping[:3]
    return model


def _count_contacts(spec: mujoco.MjSpec, name: str, craft: str, other: str = "") -> None:
    """A sensor of how many contacts a craft has, with anything or with one other body."""
    kinds = mujoco.mjtObj
    count = 1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value
    spec.add_sensor(
        name=name, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=kinds.mjOBJ_XBODY, objname=craft,
        reftype=kinds.mjOBJ_BODY if other else kinds.mjOBJ_UNKNOWN, refname=other,
        intprm=[count, 0, 1],
    )  # fmt: skip


def contact_columns(model: MjModel, sensor: str) -> np.ndarray:
    """Where `sensordata` has a sensor of each craft, shape (A,)."""
    names = drone_names(int(owners(model).max()) + 1)
    return np.array([model.sensor(f"{name}/{sensor}").adr[0] for name in names])
