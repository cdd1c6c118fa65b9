"""The crafts of one world and their payload: the compiled model, and which part is whose."""

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from mujoco import MjModel

from .errors import InputError
from .mjcf import add_ground, swarm_spec
from .vehicle import PAYLOAD, Vehicle, owners, payload_radius

SHARED = ("timestep", "gravity", "integrator", "density", "viscosity", "wind", "magnetic")
"""Options that a world has once, so that its vehicles have to agree."""
_HIGH = 1e4  # m: nothing stands there
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

    Free joints and rotors come craft by craft. Of several crafts two sensors count the contacts of
    each. With `movable`, centers of mass may be moved: MuJoCo spares work where one is the body's
    origin. `surround` adds what stands around the crafts.

    A payload, kg, is a ball on a cable of a length, m, from each craft's origin. The cable is a
    tendon that is slack below its length, and as stiff as MuJoCo's limits. The ball has the density
    of water, and a free joint, which comes last. Centers of mass may be moved too.

    Raises `InputError` where vehicles do not agree in `SHARED`, or if the ball touches a single
    craft when it hangs straight below.
    """
    first = vehicles[0]
    names = drone_names(len(vehicles))
    for vehicle in vehicles:
        for name in SHARED:
            ours = getattr(first.model.opt, name)
            its = getattr(vehicle.model.opt, name)
            if not np.array_equal(ours, its):
                raise InputError(
                    f"vehicle: expected a {name} of {ours} as of {first.name}, "
                    f"got {its} of {vehicle.name}"
                )
    spec, crafts = swarm_spec([vehicle.path for vehicle in vehicles], names)
    surround(spec)
    spec.compiler.discardvisual = True
    for name, craft in zip(names, crafts, strict=True):
        if movable or payload:
            craft.simple = False  # its inertia is no diagonal matrix once its center has moved
        if len(crafts) > 1:
            _count_contacts(spec, f"{name}/{CONTACTS}", craft.name)
            _count_contacts(spec, f"{name}/{GROUNDED}", craft.name, spec.worldbody.name)
    if payload:
        _hang_payload(spec, crafts, payload, cable)
    model = spec.compile()
    for name in SHARED:  # they may be others than those of the first file
        setattr(model.opt, name, getattr(first.model.opt, name))
    model.geom_group[:] = owners(model)[model.geom_bodyid] >= 0
    for drone, vehicle in enumerate(vehicles):
        model.dof_damping[6 * drone : 6 * drone + 3] = vehicle.model.dof_damping[:3]
    if payload and len(vehicles) == 1:
        _check_cable(model, cable, payload_radius(payload))
    return model


def _hang_payload(
    spec: mujoco.MjSpec, crafts: Sequence[mujoco.MjsBody], mass: float, cable: float
) -> None:
    """Add a ball of a mass, kg, and a cable of a length, m, to it from each craft's origin."""
    ball = spec.worldbody.add_body(name=PAYLOAD)
    ball.pos = crafts[0].pos - (0.0, 0.0, cable)
    ball.add_freejoint()
    radius = payload_radius(mass)
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], mass=mass)
    end = ball.add_site(name=PAYLOAD)
    for number, craft in enumerate(crafts):
        hook = craft.add_site(name=f"rotorgram/hook_{number}")
        name = f"rotorgram/cable_{number}"
        tendon = spec.add_tendon(name=name, limited=True, range=[0.0, cable])
        tendon.wrap_site(hook.name)
        tendon.wrap_site(end.name)


def _check_cable(model: MjModel, cable: float, radius: float) -> None:
    """Raise `InputError` if the payload touches its craft when it hangs straight below."""
    data = mujoco.MjData(model)
    data.qpos[:3] = (0.0, 0.0, _HIGH)
    data.qpos[7:10] = (0.0, 0.0, _HIGH - cable)
    mujoco.mj_fwdPosition(model, data)
    if data.ncon > 0:
        raise InputError(
            f"effects.cable: expected a length at which a payload with a radius of {radius:.3g} m "
            f"hangs clear, got {cable:g} m"
        )


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
