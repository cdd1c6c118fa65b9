"""The rigid body of a vehicle: no contact, in NumPy's arrays or compiled.

It flies as `mujoco` does until a part touches the ground or another drone, and reports the contact.
"""

import copy
from collections.abc import Mapping

import mujoco
import numpy as np

from ...models.errors import InputError
from ...models.vehicle import Vehicle, owners
from ..effects import NO_EFFECTS, EffectOptions
from ..randomize import FIXED, Randomization
from ..rotations import body_z
from ..scenery import Scenery
from ..snapshots import Arrays
from ..state import (
    Array,
    ByName,
    chosen,
    clip,
    found,
    length,
    parts_of,
    stack,
)
from ..world import Call, PhysicsError, World
from .body import RigidBody, Varying, motion
from .hull import Hull
from .kernel import Kernel, mapped

_NEAR = 1e-3  # m: nearer solids are measured
_ROUNDED = 1.001  # of a way: more than what rounding adds up to
_LEVEL = np.array((0.0, 0.0, 0.0, 1.0, *[0.0] * 9))  # motion of a craft at rest


class RigidWorld(World):
    """W worlds of A drones over level ground: `World`, without contact.

    A craft that reaches the ground is `touching`, and flies on through it: a task ends an episode
    there. Two crafts touch where their spheres overlap, of `Vehicle.radius` about their origins:
    earlier than their geoms would; so does a craft and what stands in a scene. That is looked for
    after each physics step, where a craft may have come near to it since it was last measured. A
    step makes new arrays for the state.

    Args:
        dtype: `float32` or `float64`.
        compiled: Fly by machine code (`sim/compile`).

    Attributes:
        motion: Position, quaternion, velocity and body rates, (W, A, 13).
        slack: Least way between a craft's sphere and what stands in its scene, m, (W, A); None:
            nothing does.
    """

    of_state = ("command", "thrust", "touching", "colliding", "craft")
    arrays = (*World.arrays, "bad", "motion", "slack")

    def __init__(
        self,
        vehicle: Vehicle,
        num_worlds: int,
        *,
        drones: int = 1,
        effects: EffectOptions = NO_EFFECTS,
        randomize: Randomization = FIXED,
        scenery: Scenery,
        dtype: str = "float32",
        compiled: bool = True,
    ) -> None:
        if effects.payload:
            raise InputError(
                "effects.payload: expected none with the backend rigid, which has no cable: fly it "
                f"with mujoco, got {effects.payload:g} kg"
            )
        shape = (num_worlds, drones)
        super().__init__(vehicle, shape, effects, randomize, scenery, dtype)
        _check_forces(vehicle)
        several = np.count_nonzero(owners(vehicle.model) == 0) > 1
        for name in ("inertia", "load"):
            if several and name in self._drawn:
                raise InputError(
                    f"randomize: {name}: expected a craft of one body with the backend rigid, got "
                    f"{vehicle.name}"
                )
        self._body = RigidBody(vehicle)
        self._hull = Hull(vehicle)
        self._nobody = self.bad
        self.slack: Array = np.zeros(shape, self.dtype) if scenery else None
        if drones > 1:
            self.state.colliding = self.bad
        self._show(np.tile(_LEVEL.astype(self.dtype), (*shape, 1)))
        self._advance = Kernel(self._advanced, shape) if compiled else self._advanced

    def vary(self, inertia: Array, reaction: Array) -> None:
        """Set the numbers of every drone before the first reset.

        Inertia, kg·m², (W, A, 3, 3), and a factor of the rotors' reactions, (W, A).
        """
        self._vary({"reaction": reaction}, inertia)

    def place(self, mask: Array) -> None:
        """As `World.place`."""
        if self.slack is not None:
            self.slack = chosen(mask, np.zeros_like(self.slack), self.slack)
        self._look(mask)

    def fly(self, call: Call, mask: Array | None) -> None:
        """As `World.fly`."""
        varying = self._body.varying
        new = self._advance(call.steps, self.motion, self.acting, self.wrench, varying)
        if self.slack is not None:
            way = _ROUNDED * length(new[..., :3] - self.motion[..., :3])
            self.slack = chosen(mask, self._typed(self.slack - way), self.slack)
        self._show(chosen(mask, new, self.motion))
        self._look(mask, looks=call.looks, clears=call.clears, left=call.left)
        if not call.looks:
            return
        bad = ~(abs(self.motion) < mujoco.mjMAXVAL).all(axis=-1)
        self.bad = chosen(mask, bad, self.bad)
        if found(self.bad):
            self.refuse_bad(mask)

    def _move(self, begun: ByName, mask: Array) -> None:
        turn = begun["quaternion"]
        unit = turn / length(turn)[..., None]
        turn = np.where(mask[..., None], unit, turn)  # the others keep their bits
        parts = (begun["position"], turn, begun["velocity"], begun["body_rates"])
        self._show(self._typed(np.concat(parts, axis=-1)))

    def _limited(self, thrust: Array) -> Array:
        """As MuJoCo limits controls."""
        return clip(thrust, self.vehicle.thrust_low, self.vehicle.thrust_high)

    def _put(self, arrays: Arrays) -> None:
        self._show(self.motion)

    def acceleration(self) -> Array:
        """As `World.acceleration`."""
        push = self._body.push(parts_of(self.acting), _parts(self.wrench))
        linear, _ = self._body.acceleration(motion(parts_of(self.motion)), push)
        return stack(linear)

    def below(self) -> Array:
        """As `World.below`."""
        height = self.state.position[..., 2] - self._hull.ground
        cosine = self.state.tilt_cosine
        seen = (cosine > 0) & (height >= 0)
        ground = np.where(seen, height / np.where(seen, cosine, 1.0), np.inf)
        if not self.scenery:
            return ground
        down = -body_z(self.state.quaternion)
        return np.minimum(ground, self.scenery.along(self.state.position, down))

    def _vary(self, parameters: Mapping[str, Array], inertia: Array = None) -> None:
        """As `RigidBody.vary`, with numbers of this dtype."""
        body = self._body
        craft = self.state.craft
        if parameters or craft is not None:
            body.vary(parameters, inertia, craft)
            body.varying = mapped(body.varying, self._typed)

    def _advanced(
        self, steps: int, now: Array, thrust: Array, wrench: Array, varying: Varying
    ) -> Array:
        """The motion after physics steps, as of `RigidBody.fly`, of a body that varies so."""
        body = copy.copy(self._body)
        body.varying = varying
        later = body.fly(parts_of(now), parts_of(thrust), _parts(wrench), steps)
        return self._typed(stack(later))

    def _show(self, now: Array) -> None:
        """Take this motion, (W, A, 13), and set the state's arrays, views of it."""
        self.motion = now
        state = self.state
        state.position = now[..., :3]
        state.quaternion = now[..., 3:7]
        state.velocity = now[..., 7:10]
        state.body_rates = now[..., 10:]

    def _touches_solids(self, mask: Array | None, left: float) -> Array:
        """Which crafts of a mask touch what stands in their scene, bool, (W, A).

        The distance is computed where the last one, less the way since then, leaves no room: that
        of the craft, and those of solids while a share of them is left, which `Scenery.distance`
        subtracts.
        """
        due = self.slack < _NEAR
        due = due if mask is None else due & mask
        radius = self.vehicle.radius
        slack = self.scenery.distance(self.state.position, due, left, radius) - radius
        self.slack = np.where(due, self._typed(slack), self.slack)
        return due & (self.slack < 0)

    def _contacts(self) -> list[Array]:
        """Which crafts touch anything and, of several, which another, bool, (W, A)."""
        state = self.state
        touching = self._hull.touches(state.position[..., 2], parts_of(state.quaternion))
        if self.shape[1] == 1:
            return [touching]
        colliding = self._hull.collides(parts_of(state.position))
        return [touching | colliding, colliding]

    def _look(
        self, mask: Array | None, *, looks: bool = True, clears: bool = True, left: float = 0.0
    ) -> None:
        """Set which crafts touch, those of a mask: with what was before, unless it `clears`."""
        touched = self._contacts() if looks else [self._nobody, self._nobody]
        if self.slack is not None:
            if clears and self.scenery.moves:
                self.slack = chosen(mask, np.zeros_like(self.slack), self.slack)
            touched[0] = touched[0] | self._touches_solids(mask, left)
        for name, new in zip(("touching", "colliding"), touched, strict=False):
            old = getattr(self.state, name)
            if old is not None:
                setattr(self.state, name, chosen(mask, new if clears else new | old, old))

    def refuse_bad(self, mask: Array | None) -> None:
        """As `World.refuse_bad`."""
        bad = self.bad if mask is None else self.bad & mask
        ids = np.flatnonzero(bad.any(axis=1)).tolist()
        if ids:
            raise PhysicsError(f"the rigid body has bad states in envs {ids[:5]}: reset the env")


def _parts(wrench: Array) -> Array:
    return None if wrench is None else parts_of(wrench)


def _check_forces(vehicle: Vehicle) -> None:
    """Refuse a vehicle that MuJoCo would move differently, by its joint or its integrator."""
    model = copy.copy(vehicle.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    data.qpos[2:7] = (vehicle.rest_height + 1e3, 0.8, 0.36, -0.48, 0.0)
    data.qvel[:] = (1.0, -2.0, 0.5, 0.4, 0.7, -0.6)
    thrust = np.maximum(0.8 * vehicle.hover_thrust, vehicle.thrust_low)
    thrust[0] = vehicle.hover_thrust[0]
    data.ctrl[:] = thrust / [rotor.newtons for rotor in vehicle.rotors]
    rows = np.concatenate((data.qpos, data.qvel))
    ours = np.concatenate(RigidBody(vehicle).fly(rows[:, None], thrust[:, None])) - rows
    mujoco.mj_step(model, data)
    theirs = np.concatenate((data.qpos, data.qvel)) - rows
    right = np.abs(ours - theirs).max() <= 1e-9 * max(1.0, np.abs(theirs).max())
    if not right:
        raise InputError(
            "vehicle: expected RK4, and no forces but gravity, rotors and linear_drag (the backend "
            f"rigid), got others in {vehicle.name}"
        )
