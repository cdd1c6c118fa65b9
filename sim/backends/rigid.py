"""The rigid body of a vehicle: no contact, in NumPy's arrays or compiled.

It flies as `mujoco` does until a part touches the ground or another drone, and reports the contact.
"""

import logging
from collections.abc import Mapping
from functools import cache

import mujoco
import numpy as np

from ...models.errors import InputError
from ...models.vehicle import Vehicle, craft_bodies, craft_geoms
from ..compile import TracedArray
from ..compile.llvm import trouble
from ..effects import EffectOptions
from ..randomize import Randomization
from ..snapshots import Arrays
from ..state import Array, ByName, InitialState, WorldState, chosen, clip, each, length
from ..world import PhysicsError, World
from . import kernel
from .body import RigidBody, mapped, motion
from .hull import Hull, can_touch

_OF_STATE = ("command", "thrust", "touching", "colliding")
_LEVEL = np.array((0.0, 0.0, 0.0, 1.0, *[0.0] * 9))  # rows of a craft at rest


class RigidWorld(World):
    """W worlds of A drones over level ground: `World`, without contact.

    A craft that reaches the ground is `touching`, and flies on through it: a task ends an episode
    there. Two crafts touch where their spheres overlap, of `Vehicle.radius` about their origins:
    earlier than their geoms would. A step makes new arrays for the state.

    Args:
        dtype: `float32` or `float64`.
        compiled: Fly by machine code (`sim/compile`). None: where llvmlite can make it.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        num_worlds: int,
        *,
        drones: int = 1,
        effects: EffectOptions | None = None,
        randomize: Randomization | None = None,
        dtype: str = "float32",
        compiled: bool | None = None,
    ) -> None:
        reason = "" if compiled is False else trouble()
        if compiled and reason:
            raise InputError(
                f"compiled: expected false where nothing compiles ({reason}), got true"
            )
        if reason:
            _tell_once(reason)
        payload = 0.0 if effects is None else effects.payload
        if payload:
            expected = "none with the backend rigid, which has no cable: fly it with mujoco"
            raise InputError(f"effects.payload: expected {expected}, got {payload:g} kg")
        shape = (num_worlds, drones)
        super().__init__(vehicle, shape, effects, randomize)
        _check_obstacles(vehicle)
        _check_forces(vehicle)
        if "inertia" in self._drawn and len(craft_bodies(vehicle.model)) > 1:
            raise InputError(
                "randomize: inertia: expected a craft of one body with the backend rigid, got "
                f"{vehicle.name}"
            )
        self.dtype = np.dtype(dtype)
        self._body = RigidBody(vehicle)
        self._hull = Hull(vehicle)
        thrust = np.zeros((*shape, vehicle.num_rotors), self.dtype)
        self._nothing = self._acting = thrust  # mean over the last physics step
        # Mean force and torque of the air over it.
        pushed = self.effects is not None and self.effects.on_body
        self._wrench: Array = np.zeros((*shape, 6), self.dtype) if pushed else None
        self.bad = nobody = thrust[..., 0] > 0
        moved = dict.fromkeys(("position", "quaternion", "velocity", "body_rates"))
        self.state = WorldState(**moved, command=thrust, thrust=thrust, touching=nobody)
        if drones > 1:
            self.state.colliding = nobody
        self._show(np.repeat(_LEVEL.astype(self.dtype)[:, None], num_worlds * drones, axis=1))
        self._varying: np.ndarray | None = None
        self._function: kernel.Fly | None = None
        self._compiled = compiled is not False and not reason
        self._vary(dict.fromkeys(self._drawn, np.ones(num_worlds * drones)))
        self._compile()

    def _compile(self) -> None:
        """Compile the body as it varies now, unless NumPy flies it."""
        if self._compiled:
            worlds, drones = self.shape
            rotors = self.vehicle.num_rotors
            self._function = kernel.flight(self._body, worlds * drones, self.dtype, rotors)

    def vary(self, inertia: Array, reaction: Array, air: Mapping[str, Array]) -> None:
        """Set the numbers of every drone before the first reset; needs the effect `body_drag`.

        Inertia, kg·m², (W A, 3, 3); a factor of the rotors' reactions, (W A,); and coefficients of
        the air by their names in a vehicle's file, (W, A) each.
        """
        self._vary({"reaction": reaction}, inertia)
        assert self.effects is not None
        self.effects.air.vary(air)
        self._compile()

    def reset(self, mask: Array, pose: InitialState) -> None:
        """As `World.reset`."""
        state = self.state
        rows = mask[..., None]
        self.random.begin(mask)
        begun = self._begun(mask, pose)
        turn = begun["quaternion"]
        unit = turn / each(length(turn))
        turn = np.where(rows, unit, turn)  # the others keep their bits
        parts = (begun["position"], turn, begun["velocity"], begun["body_rates"])
        self._show(self._as_rows(np.concat(parts, axis=-1)))
        state.thrust = self._typed(begun["thrust"])
        state.command = np.where(rows, state.thrust, state.command)
        self._draw_parameters(mask)
        self._vary_drawn()
        if self.effects is not None:
            thrust = self.effects.begin(mask, state, self.parameters)
            state.thrust = self._typed(np.where(rows, thrust, state.thrust))
        self._acting = np.where(rows, state.thrust, self._acting)
        self._wrench = None if self._wrench is None else np.where(rows, 0.0, self._wrench)
        self._tell(mask, self._contacts())

    def step(
        self, thrust: Array, substeps: int, mask: Array | None = None, *, again: bool = False
    ) -> None:
        """As `World.step`."""
        state = self.state
        # One number for all rotors counts for each.
        state.command = chosen(mask, self._typed(thrust + self._nothing), state.command)
        if not self._on_rotors:
            state.thrust = state.command
        found = [state.touching, state.colliding] if again else [False, False]
        while substeps > 0:
            self._fly(min(substeps, self._check), mask)
            found = [now | old for now, old in zip(self._contacts(), found, strict=False)]
            substeps -= self._check
        self._tell(mask, found)
        bad = ~(abs(self._rows) < mujoco.mjMAXVAL).all(axis=0)
        self.bad = chosen(mask, bad.reshape(self.shape), self.bad)
        if not isinstance(self.bad, TracedArray):
            self.refuse_bad(mask)

    def _fly(self, steps: int, mask: Array | None) -> None:
        """Fly physics steps without a contact check in between."""
        state = self.state
        effects = self.effects
        acting = state.command
        wrench = None
        at_once = steps if effects is None else 1  # physics steps of a call
        some = None if mask is None else mask.reshape(1, -1)  # of rows
        for _ in range(steps // at_once):
            if effects is not None:
                acting, end, push = effects.step(state, mask)
                if self._on_rotors:
                    state.thrust = chosen(mask, self._typed(end), state.thrust)
                wrench = None if push is None else self._typed(push)
            if not self._on_rotors:  # as MuJoCo clamps controls
                acting = clip(acting, self.vehicle.thrust_low, self.vehicle.thrust_high)
            push = None if wrench is None else self._as_rows(wrench)
            new = self._flown(self._as_rows(acting), push, at_once)
            self._show(chosen(some, new, self._rows))
        self._acting = chosen(mask, self._typed(acting), self._acting)
        if wrench is not None:
            self._wrench = chosen(mask, wrench, self._wrench)

    def _kept(self) -> ByName:
        arrays = {name: getattr(self.state, name) for name in _OF_STATE}
        arrays |= {"motion": self._as_vectors(self._rows), "acting": self._acting}
        arrays |= {"wrench": self._wrench, "bad": self.bad}
        return {name: array for name, array in arrays.items() if array is not None}

    def _restore(self, arrays: Arrays) -> None:
        copies = {name: array.copy() for name, array in arrays.items()}
        for name in _OF_STATE:
            setattr(self.state, name, copies.get(name))
        self._acting = copies["acting"]
        self._wrench = copies.get("wrench")
        self.bad = copies["bad"]
        self._show(self._as_rows(copies["motion"]))
        self._vary_drawn()

    def acceleration(self) -> Array:
        """As `World.acceleration`."""
        wrench = None if self._wrench is None else self._as_rows(self._wrench)
        push = self._body.push(self._as_rows(self._acting), wrench)
        linear, _ = self._body.acceleration(motion(self._rows), push)
        return np.stack(linear, axis=-1).reshape(*self.shape, 3)

    def below(self) -> Array:
        """As `World.below`: the ground is the only surface."""
        height = self.state.position[..., 2] - self._hull.ground
        cosine = self.state.tilt_cosine
        seen = (cosine > 0) & (height >= 0)
        return np.where(seen, height / np.where(seen, cosine, 1.0), np.inf)

    def close(self) -> None:
        """Nothing is to be released."""

    def _vary_drawn(self) -> None:
        """Give the bodies what was drawn for them."""
        self._vary({name: values.reshape(-1) for name, values in self.parameters.items()})

    def _vary(self, parameters: Mapping[str, Array], inertia: Array = None) -> None:
        """As `RigidBody.vary`, with the same numbers for NumPy and compiled code."""
        body = self._body
        if parameters:
            body.vary(parameters, inertia)
            body.varying = mapped(body.varying, lambda numbers: numbers.astype(self.dtype))
            self._varying = kernel.packed(body, self.dtype)

    def _flown(self, thrust: Array, wrench: Array, steps: int) -> np.ndarray:
        """New rows after physics steps: see `RigidBody.fly`."""
        if self._function is None:
            flown: np.ndarray = self._typed(
                np.stack(self._body.fly(self._rows, thrust, wrench, steps))
            )
            return flown
        return self._function(self._rows, thrust, wrench, self._varying, steps)

    def _show(self, rows: np.ndarray) -> None:
        """Take these rows, and set the state's arrays, views of them."""
        self._rows = rows
        state = self.state
        columns = self._as_vectors(rows)
        state.position = columns[..., :3]
        state.quaternion = columns[..., 3:7]
        state.velocity = columns[..., 7:10]
        state.body_rates = columns[..., 10:]

    def _typed(self, values: Array) -> Array:
        return values.astype(self.dtype, copy=False)

    def _as_rows(self, values: Array) -> Array:
        """Vectors (W, A, k) as rows (k, W A) of this dtype."""
        return self._typed(values).reshape(-1, values.shape[-1]).T

    def _as_vectors(self, rows: Array) -> Array:
        """Rows (k, W A) as vectors (W, A, k)."""
        return rows.T.reshape(*self.shape, -1)

    def _contacts(self) -> list[Array]:
        """Which crafts touch anything and, of several, which another, bool, (W, A)."""
        rows = self._rows
        shape = self.shape
        touching = self._hull.touches(rows[2], rows[3:7]).reshape(shape)
        if shape[1] == 1:
            return [touching]
        colliding = self._hull.collides(rows[:3].reshape(3, *shape))
        return [touching | colliding, colliding]

    def _tell(self, mask: Array | None, found: list[Array]) -> None:
        """Set what `_contacts` found, for the worlds of a mask."""
        for name, new in zip(("touching", "colliding"), found, strict=False):
            old = getattr(self.state, name)
            setattr(self.state, name, chosen(mask, new, old))

    def refuse_bad(self, mask: Array | None) -> None:
        """Raise `PhysicsError` if the state of a drone that flew is bad."""
        bad = self.bad if mask is None else self.bad & mask
        ids = np.flatnonzero(bad.any(axis=1)).tolist()
        if ids:
            raise PhysicsError(f"the rigid body has bad states in envs {ids[:5]}: reset the env")


@cache
def _tell_once(reason: str) -> None:
    logging.getLogger(__name__).warning("rigid flies by NumPy, which is slower: %s", reason)


def _check_obstacles(vehicle: Vehicle) -> None:
    """Refuse obstacles of the vehicle's file, through which drones would fly."""
    model = vehicle.model
    ours = craft_geoms(model)
    for i in np.flatnonzero(~ours & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)).tolist():
        if can_touch(model, i, ours):
            name = model.geom(i).name or f"geom {i}"
            raise InputError(
                f"vehicle: expected no obstacles with the backend rigid, which has none (the "
                f"backend mujoco has), got {name} in {vehicle.name}"
            )


def _check_forces(vehicle: Vehicle) -> None:
    """Refuse a vehicle that MuJoCo would move differently, by its joint or its integrator."""
    model = vehicle.model
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
        expected = "RK4, and no forces but gravity, rotors and linear_drag"
        raise InputError(
            f"vehicle: expected {expected} (the backend rigid), got others in {vehicle.name}"
        )
