"""MuJoCo on the threads of this machine, float64.

`mujoco.batch.Batch` gives each world the same bits as a loop over single worlds, with any number
of threads.
"""

import copy
import os
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from ...models.errors import InputError
from ...models.fleet import members_of
from ...models.mjcf import add_ground, delete_obstacles
from ...models.swarm import CONTACTS, GROUNDED, contact_columns, swarm_model
from ...models.vehicle import (
    PAYLOAD,
    Vehicle,
    body_axes,
    owners,
    payload_radius,
)
from ...scenes.geoms import NAME, add_solids, geoms_of
from ...scenes.kernels import HFIELD
from ...scenes.solids import Solids
from ..effects import EffectOptions
from ..randomize import CENTER, LEAST_MASS, Randomization
from ..rotations import body_z
from ..scenery import Scenery
from ..snapshots import Arrays
from ..state import Array, ByName, InitialState, found, stack, total
from ..world import Call, PhysicsError, World

_FEW = 8
_SEEN = np.array([1, 0, 0, 0, 0, 0], np.uint8)  # by rays: geoms of group 0, not the crafts'
_VIEWS = "_batch _live _ctrl _applied _contacts _counts _warnings _varied _qacc _warmstart"
"""Attributes that hold the simulator's memory."""


class MujocoWorld(World):
    """W worlds of A drones over ground of their own: `World`. Drones of a world may collide.

    MuJoCo answers a bad state with a reset and a line in MUJOCO_LOG.TXT. Here it raises
    `PhysicsError`, because an agent would learn from a silent reset, and switches that file off for
    the whole process; a log file of another name stays on.

    `num_threads` threads step the worlds; 0: one for each processor.
    """

    is_apart = True

    def __init__(
        self,
        vehicle: Vehicle,
        num_worlds: int,
        *,
        drones: int,
        effects: EffectOptions,
        randomize: Randomization,
        scenery: Scenery,
        num_threads: int = 0,
    ) -> None:
        shape = (num_worlds, drones)
        super().__init__(vehicle, shape, effects, randomize, scenery)
        threads = 1 if num_worlds == 1 else num_threads
        model = self._flown_model(drones)
        if scenery.moves:
            self._check = 1  # physics step: they move in each
        if scenery.varies:  # the compiled trees of bounding boxes do not follow the geoms
            model = copy.copy(model)
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        if self.effects.on_rotors:  # commands are within their limits; thrusts need not be
            model = copy.copy(model)
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        self._batch = batch = Batch(model, num_worlds, threads)
        self._loaded = np.zeros(shape)  # what the models have
        self._laid = np.full(num_worlds, -1)  # seeds of the layouts that the geoms have
        self._cable = self._options.cable if self._options.payload else None
        self._varied = WorldParameters(batch.model, self._drawn)
        self._owner = None if threads == 1 else os.getpid()
        self._initial = batch.state[0].copy()
        # Views of simulator memory, made once.
        qpos, ball = _views(batch.bind("qpos"), drones, 7)
        qvel, moves = _views(batch.bind("qvel"), drones, 6)
        self._live: ByName = {"qpos": qpos, "qvel": qvel, "touching": np.zeros(shape, bool)}
        if drones > 1:
            self._live["colliding"] = np.zeros(shape, bool)
            self._counts = batch.bind("sensordata")
            self._columns = [contact_columns(model, name) for name in (CONTACTS, GROUNDED)]
        if self._cable is not None:
            self._live |= {"payload": ball, "payload_velocity": moves}
        self._applied = batch.bind("qfrc_applied")[:, : 6 * drones]
        self._ctrl: np.ndarray = batch.bind("ctrl")
        self._contacts: np.ndarray = batch.bind("ncon")
        self._warnings = batch.warning  # of each kind the last info, and how many
        self._no_warnings = self._warnings.tobytes()
        self._no_contacts = self._contacts.tobytes()
        rotors = [rotor for craft in members_of(vehicle, drones) for rotor in craft.rotors]
        self._newtons = np.array([rotor.newtons for rotor in rotors])  # of a control of 1
        self._qacc: np.ndarray | None = None  # bound by what first asks for it
        self.take()
        assert np.shares_memory(self.state.position, batch.state)

    def _flown_model(self, drones: int) -> mujoco.MjModel:
        """The vehicle's, or one with more crafts, with a payload or for a drawn center of mass."""
        vehicle = self.vehicle
        payload = self._options.payload
        cable = self._options.cable
        movable = bool(set(self._drawn) & set(CENTER))
        is_own = not self.scenery.most and not self.scenery.scene.is_file
        plain = is_own and not (movable or payload)
        if drones == 1 and plain:
            return vehicle.model
        crafts = members_of(vehicle, drones)
        surround = add_ground if is_own else self._surround
        return swarm_model(
            crafts, movable=movable, payload=payload * drones, cable=cable, surround=surround
        )

    def _surround(self, spec: mujoco.MjSpec) -> None:
        """Add geoms to a spec for what stands in its scene. Raises `InputError`."""
        scenery = self.scenery
        if scenery.scene.is_file:
            delete_obstacles(spec)
        fixed = Solids.none() if scenery.varies else scenery.solids(int(scenery.seeds[0]))
        add_solids(spec, fixed, scenery.most, scenery.scene.embedded().content)
        laid = [scenery.solids(seed) for seed in scenery.given or (0,)]
        if scenery.varies and any((solids.kinds == HFIELD).any() for solids in laid):
            raise InputError(
                "scene: expected height fields on mujoco in one layout, as hills:0, where "
                f"nothing moves, got {scenery.scene}"
            )

    def _lay(self, ids: np.ndarray) -> None:
        """Give geoms the layouts of some worlds."""
        if not self.scenery.varies:
            return
        seeds = self.scenery.seeds
        most = self.scenery.most
        for world in ids[(self._laid[ids] != seeds[ids]) & (seeds[ids] >= 0)].tolist():
            solids = self.scenery.solids(int(seeds[world]))
            for field, rows in geoms_of(solids, most).items():
                self._batch.expand(field)[world, self._slots] = rows
            self._laid[world] = seeds[world]
        self._follow(ids)

    @property
    def _slots(self) -> slice:
        """Which geoms stand for solids of a layout, where there are some."""
        first = mujoco.mj_name2id(self._batch.model, mujoco.mjtObj.mjOBJ_GEOM, f"{NAME}0")
        return slice(first, first + self.scenery.most)

    def _follow(self, ids: Array, left: float = 0.0) -> None:
        """Move the geoms of some worlds to where their solids are, a share of their ways left.

        That is at the end of a physics step, of which MuJoCo finds the contacts where the craft is
        at its beginning. Contacts take the solids as at rest.
        """
        if self.scenery.moves:
            places = self._batch.expand("geom_pos")[:, self._slots]
            centers = self.scenery.centers - left * self.scenery.ways
            places[ids] = centers.transpose(0, 2, 1)[ids]

    def take(self) -> None:
        """Set the state's arrays that the physics changes."""
        seen = self.outer or self._live
        state = self.state
        state.position = seen["qpos"][..., :3]
        state.quaternion = seen["qpos"][..., 3:]
        state.velocity = seen["qvel"][..., :3]
        state.body_rates = seen["qvel"][..., 3:]
        for name in ("touching", "colliding", "payload", "payload_velocity"):
            setattr(state, name, seen.get(name))

    def told(self, *, asked: bool = True) -> ByName:
        """As `World.told`."""
        if not asked or not self.asked:
            return self._live
        return self._live | {name: getattr(self, name)() for name in self.asked}

    def hidden(self) -> ByName:
        """As `World.hidden`; `mjSTATE_INTEGRATION` has the warm start too."""
        return {} if self.outer else {"integration": self._batch.state.copy()}

    def begin(self, mask: Array, pose: InitialState) -> None:
        """As `World.begin`. Raises `InputError` for a payload that would hang in the ground."""
        hung = self._hung(pose)
        self._check_payload(mask, hung)
        super().begin(mask, pose)
        if self._cable is not None:
            state = self.state
            rows = mask[..., None]
            state.payload = np.where(rows, hung, state.payload)
            moves = state.velocity[:, :1]  # along with the first craft
            state.payload_velocity = np.where(rows, moves, state.payload_velocity)

    def place(self, mask: Array) -> None:
        """As `World.place`. Raises `InputError` as `begin`."""
        self._check_process()
        self._check_payload(mask, self.state.payload)
        ids = self.random.ids(mask)
        state = self.state
        live = self._live
        self._batch.state[ids] = self._initial
        self._warnings[ids] = 0
        live["qpos"][ids] = np.concat((state.position, state.quaternion), axis=-1)[ids]
        live["qvel"][ids] = np.concat((state.velocity, state.body_rates), axis=-1)[ids]
        if self._cable is not None:
            self._batch.bind("qpos")[ids, -7:-4] = state.payload[ids, 0]
            self._batch.bind("qvel")[ids, -6:-3] = state.payload_velocity[ids, 0]
        self._lay(ids)
        self._vary_models(ids)
        self._ctrl[ids] = np.reshape(self.acting, self._ctrl.shape)[ids] / self._newtons
        # To wake the threads takes longer than a few worlds.
        groups = ids[None] if len(ids) > _FEW else ids[:, None]
        for some in groups:
            self._batch.forward(some)
        self.take()
        self._clear_contacts(ids)
        self._add_contacts(ids)

    def fly(self, call: Call, mask: Array | None) -> None:
        """As `World.fly`."""
        self._check_process()
        ids = None if mask is None else self.random.ids(mask)
        some = ... if ids is None else ids
        if self.load is not None:
            self._take_load()
        if call.pushes:
            self._ctrl[some] = self.acting.reshape(self._ctrl.shape)[some] / self._newtons
            if self.wrench is not None:
                self._applied[some] = self.wrench.reshape(self._applied.shape)[some]
        self._follow(some, call.left)
        if call.clears:
            self._clear_contacts(some)
        try:
            self._batch.step(ids, nstep=call.steps)
        except SimulationError as error:
            self._warnings.fill(0)  # of the other worlds: a reset is due all the same
            raise PhysicsError(f"{error}: reset the env") from None
        if call.looks and self._contacts.tobytes() != self._no_contacts:  # faster than to count
            self._add_contacts(some)
        if self._warnings.tobytes() != self._no_warnings:
            raise PhysicsError(self._describe_warnings())

    def _move(self, begun: ByName, mask: Array) -> None:
        for name in ("position", "quaternion", "velocity", "body_rates"):
            setattr(self.state, name, begun[name])

    def _vary_models(self, ids: np.ndarray) -> None:
        """Give the models of some worlds their drawn parameters."""
        if not self._varied.base or not self.parameters:
            return
        values = {name: x[ids] for name, x in self.parameters.items()}
        if self.load is not None:
            self._loaded[ids] = values["load"] = self.load[ids]
            share = values["load"] / (self.vehicle.mass * values.get("mass", 1.0))
            values["load"] = np.maximum(1.0 + share, LEAST_MASS)
        for field, rows in self._varied.values(values).items():
            self._batch.expand(field)[ids] = rows
        self._batch.set_const(ids)

    def _vary(self, parameters: ByName) -> None:
        self.load = parameters.get("load")

    def _take_load(self) -> None:
        """Give models a load that has changed; their states stay."""
        ids = np.flatnonzero((self.load != self._loaded).any(axis=1))
        if len(ids):
            states = self._batch.state[ids]
            self._vary_models(ids)
            self._batch.state[ids] = states

    def _put(self, arrays: Arrays) -> None:
        if "integration" in arrays:
            self._check_process()
            everybody = np.arange(len(self._ctrl))
            self._lay(everybody)
            self._vary_models(everybody)
            self._batch.state[...] = arrays["integration"]
            self._warnings.fill(0)
            for name in ("touching", "colliding"):
                if name in arrays:
                    self._live[name][...] = arrays[name]
            self.take()

    def _clear_contacts(self, some: Array) -> None:
        """No contact of some worlds yet."""
        for name in ("touching", "colliding"):
            if name in self._live:
                self._live[name][some] = False

    def _add_contacts(self, some: Array) -> None:
        """Add the contacts of some worlds to those that they had."""
        live = self._live
        if "colliding" not in live:
            live["touching"][some] |= self._contacts[some, None] > 0
        else:
            of_all, of_ground = (self._counts[some][..., columns] for columns in self._columns)
            live["touching"][some] |= of_all > 0
            live["colliding"][some] |= of_all > of_ground

    def acceleration(self) -> Array:
        """As `World.acceleration`: of a `mj_forward` that leaves the state as it was."""
        self.asked.add("acceleration")
        if self.outer:
            return self.outer["acceleration"]
        self._check_process()
        if self._qacc is None:
            self._qacc = self._batch.bind("qacc")
            self._warmstart = self._batch.bind("qacc_warmstart")
        before = self._warmstart.copy()
        self._batch.forward()
        self._warmstart[:] = before
        own, _ = _views(self._qacc, self.shape[1], 6)
        return own[..., :3].copy()

    def below(self) -> Array:
        """As `World.below`, by `mj_ray`."""
        self.asked.add("below")
        if self.outer:
            return self.outer["below"]
        self._check_process()
        origin = self.state.position
        down = -body_z(self.state.quaternion)
        distance = self._batch.ray(origin, down, geomgroup=_SEEN)[0]
        return np.where(distance < 0, np.inf, distance).reshape(self.shape)

    def close(self) -> None:
        """As `World.close`."""
        if self._owner not in (None, os.getpid()):
            return  # a fork has none of the threads
        self.state = copy.deepcopy(self.state)
        for view in _VIEWS.split():
            vars(self).pop(view, None)

    def _check_process(self) -> None:
        if self._owner is not None and os.getpid() != self._owner:  # it would wait for ever
            raise RuntimeError("the threads of an env do not follow into a fork: make another env")

    def _hung(self, pose: InitialState) -> Array:
        """Where the payload of each world begins, shape (W, A, 3), or None without one."""
        if self._cable is None or pose.payload is not None:
            return pose.payload
        drones = self.shape[1]
        if drones != 1:
            raise InputError(
                "effects.payload: expected one drone in a world, or a task whose start places it, "
                f"got {drones} drones"
            )
        return pose.position - (0.0, 0.0, self._cable)

    def _check_payload(self, mask: Array, hung: Array) -> None:
        """Raise `InputError` if that of a world of the mask would hang in the ground."""
        if self._cable is None:
            return
        height = hung[..., 2] + self._cable
        least = self._cable + payload_radius(self._options.payload)
        low = mask & ~(height > least)
        if found(low):
            raise InputError(
                f"start: expected a height over {least:.4g} m, for the payload on its cable, "
                f"got {height[low].min():.4g} m"
            )

    def _describe_warnings(self) -> str:
        counts = self._warnings[:, :, 1]
        ids = np.flatnonzero(counts.any(axis=1)).tolist()
        kinds = np.flatnonzero(counts.any(axis=0)).tolist()
        names = ", ".join(mujoco.mjtWarning(kind).name for kind in kinds)
        self._warnings.fill(0)  # so that a reset gives usable worlds again
        return f"MuJoCo warned of {names} in envs {ids[:5]}: reset the env"


def _views(rows: np.ndarray, drones: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Views of rows (W, n): `size` numbers of each craft, and the payload's position or velocity.

    The latter comes after the crafts, and is the same for all crafts of a world.
    """
    crafts = drones * size
    load = rows[:, None, crafts : crafts + 3]
    shared = np.broadcast_to(load, (len(rows), drones, load.shape[-1]))
    return rows[:, :crafts].reshape(-1, drones, size), shared


class WorldParameters:
    """Fields of a model that differ between worlds, for drawn parameters.

    Attributes:
        base: Their values in the model by name; empty if nothing that is drawn is of the model.
    """

    def __init__(self, model: mujoco.MjModel, drawn: Sequence[str]) -> None:
        owner = owners(model)
        craft = owner >= 0
        hung = np.zeros(model.nbody, bool)
        if "payload" in drawn:
            hung[model.body(PAYLOAD).id] = True
        # Of each craft the first of six degrees of freedom are those of its translation.
        linear = craft[model.dof_bodyid] & (np.arange(model.nv) % 6 < 3)
        torque = np.arange(6)[None] >= 3  # of a gear
        self._scaled = {
            # Unity's drag goes with the mass.
            "mass": {"body_mass": craft, "body_inertia": craft[:, None], "dof_damping": linear},
            "inertia": {"body_inertia": craft[:, None]},
            "load": {"body_mass": craft, "dof_damping": linear},
            "payload": {"body_mass": hung, "body_inertia": hung[:, None]},
            "reaction": {"actuator_gear": torque},
        }
        """Of each factor, the fields that it scales, and where."""
        bodies = np.maximum(owner, 0)
        rotors = bodies[model.site_bodyid[model.actuator_trnid[:, 0]]]
        self._drones = {
            "body_mass": bodies,
            "body_inertia": bodies,
            "dof_damping": bodies[model.dof_bodyid],
            "actuator_gear": rotors,
        }
        """Of each field, the drone that has a row."""
        self._axes = body_axes(model) * craft[:, None, None]
        fields = [field for name in drawn for field in self._scaled.get(name, ())]
        if set(drawn) & set(CENTER):
            fields.append("body_ipos")
        self.base = {field: getattr(model, field).copy() for field in fields}

    def values(self, parameters: Mapping[str, Array]) -> ByName:
        """The fields by name, each (N, ...), of N worlds with these parameters, each (N, A)."""
        factors: ByName = {}
        for name, drawn in parameters.items():
            for field, scaled in self._scaled.get(name, {}).items():
                factor = drawn[:, self._drones[field]]
                if scaled.ndim > 1:
                    factor = factor[..., None]
                factors[field] = factors.get(field, 1.0) * np.where(scaled, factor, 1.0)
        values = {field: factor * self.base[field] for field, factor in factors.items()}
        if "body_ipos" in self.base:
            shift = stack([parameters.get(name, 0.0) for name in CENTER])
            moved = total(self._axes.swapaxes(1, 2) * shift[:, self._drones["body_mass"], None])
            values["body_ipos"] = self.base["body_ipos"] + moved
        return values
