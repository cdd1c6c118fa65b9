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
from ...models.swarm import CONTACTS, GROUNDED, contact_columns, swarm_model
from ...models.vehicle import (
    SURROUNDINGS,
    Vehicle,
    body_axes,
    owners,
    payload_body,
    payload_radius,
)
from ..effects import NO_EFFECTS, EffectOptions, Effects
from ..randomize import CENTER, FIXED, Randomization
from ..rotations import body_z
from ..snapshots import Arrays
from ..state import Array, ByName, InitialState, WorldState, stack, total
from ..world import PhysicsError, World

_FEW = 8
_SEEN = np.array(SURROUNDINGS, np.uint8)
_VIEWS = (
    "_batch _ctrl _command _thrust _applied _contacts _counts _warnings _varied _qacc _warmstart"
)
"""Attributes that hold the simulator's memory."""


class MujocoWorld(World):
    """W worlds of A drones over ground of their own: `World`. Drones of a world may collide.

    MuJoCo answers a bad state with a reset and a line in MUJOCO_LOG.TXT. Here it raises
    `PhysicsError`, because an agent would learn from a silent reset, and switches that file off for
    the whole process; a log file of another name stays on.

    A single world has no leading axes: NumPy's scalars are ten times faster than its arrays of one.
    `num_threads` threads step the worlds; 0: one for each processor.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        num_worlds: int,
        *,
        drones: int = 1,
        effects: EffectOptions = NO_EFFECTS,
        randomize: Randomization = FIXED,
        num_threads: int = 0,
    ) -> None:
        lead = (num_worlds, drones) if num_worlds * drones > 1 else ()
        super().__init__(vehicle, lead, effects, randomize)
        threads = 1 if num_worlds == 1 else num_threads
        model = self._flown_model(drones)
        if self._on_rotors:  # commands are within their limits; thrusts need not be
            model = copy.copy(model)
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
        self._batch = batch = Batch(model, num_worlds, threads)
        self._cable = self._options.cable if self._options.payload else None
        self._varied = WorldParameters(batch.model, self._drawn)
        self._owner = None if threads == 1 else os.getpid()
        self._initial = batch.state[0].copy()
        # Live views of simulator memory, made once.
        qpos, ball = _views(batch.bind("qpos"), drones, 7, lead)
        qvel, moves = _views(batch.bind("qvel"), drones, 6, lead)
        self._applied = batch.bind("qfrc_applied")[:, : 6 * drones]
        self._ctrl: np.ndarray = batch.bind("ctrl")
        self._contacts: np.ndarray = batch.bind("ncon")
        self._warnings = batch.warning  # of each kind the last info, and how many
        self._no_warnings = self._warnings.tobytes()
        self._no_contacts = self._contacts.tobytes()
        rotors = [rotor for craft in members_of(vehicle, drones) for rotor in craft.rotors]
        self._newtons = np.array([rotor.newtons for rotor in rotors])  # of a control of 1
        self._command = np.zeros_like(self._ctrl)
        self._thrust = np.zeros_like(self._ctrl) if self._on_rotors else self._command
        self._touching = np.zeros((num_worlds, drones), bool)
        self._colliding: np.ndarray | None = None
        if drones > 1:
            self._colliding = self._touching.copy()
            self._counts = batch.bind("sensordata")
            self._columns = [contact_columns(model, name) for name in (CONTACTS, GROUNDED)]
        self._qacc: np.ndarray | None = None  # bound by what first asks for it
        self.state = WorldState(
            position=qpos[..., :3],
            quaternion=qpos[..., 3:7],
            velocity=qvel[..., :3],
            body_rates=qvel[..., 3:6],
            command=self._command.reshape(*lead, -1),
            thrust=self._thrust.reshape(*lead, -1),
            touching=self._touching.reshape(lead),
            colliding=self._colliding,
            payload=None if self._cable is None else ball,
            payload_velocity=None if self._cable is None else moves,
        )
        assert np.shares_memory(self.state.position, batch.state)

    def _flown_model(self, drones: int) -> mujoco.MjModel:
        """The vehicle's, or one with more crafts, with a payload or for a drawn center of mass."""
        vehicle = self.vehicle
        payload = self._options.payload
        cable = self._options.cable
        movable = bool(set(self._drawn) & set(CENTER))
        if drones > 1:
            crafts = members_of(vehicle, drones)
            return swarm_model(crafts, movable=movable, payload=payload * drones, cable=cable)
        if movable or payload:
            return vehicle.movable(payload, cable)
        return vehicle.model

    def reset(self, mask: Array, pose: InitialState) -> None:
        """As `World.reset`. Raises `InputError` for a payload that would hang in the ground."""
        self._check_process()
        ids = self.random.ids(mask)
        hung = self._hung(pose, ids)
        self.random.begin(mask)
        self._batch.state[ids] = self._initial
        self._warnings[ids] = 0
        for name, begun in self._begun(mask, pose).items():
            getattr(self.state, name)[...] = begun
        self._command[ids] = self._thrust[ids]
        self._draw_parameters(mask)
        self._vary(ids)
        if self.effects is not None:
            thrust = self.effects.begin(mask, self.state, self.parameters)
            self._thrust[ids] = np.reshape(thrust, self._ctrl.shape)[ids]
        if hung is not None:
            self._place_payload(ids, hung)
        self._ctrl[ids] = self._thrust[ids] / self._newtons
        # To wake the threads takes longer than a few worlds.
        groups = ids[None] if len(ids) > _FEW else ids[:, None]
        for some in groups:
            self._batch.forward(some if self.shape else None)
        self._clear_contacts(ids)
        self._add_contacts(ids)

    def step(
        self, thrust: Array, substeps: int, mask: Array | None = None, *, again: bool = False
    ) -> None:
        """As `World.step`."""
        self._check_process()
        ids = None if mask is None else self.random.ids(mask)
        some = ... if ids is None else ids
        if some is ... or not self.shape:
            self.state.command[...] = thrust
        else:
            self.state.command[some] = thrust[some]
        if self.effects is None:
            self._ctrl[...] = self._command / self._newtons
        if not again:
            self._clear_contacts(some)
        while substeps > 0:
            steps = min(substeps, self._check)
            try:
                if self.effects is None:
                    self._batch.step(ids, nstep=steps)
                else:
                    for _ in range(steps):
                        self._act(self.effects, mask, some)
                        self._batch.step(ids)
            except SimulationError as error:
                self._warnings.fill(0)  # of the other worlds: a reset is due all the same
                raise PhysicsError(f"{error}: reset the env") from None
            if self._contacts.tobytes() != self._no_contacts:  # faster than to count
                self._add_contacts(some)
            substeps -= self._check
        if self._warnings.tobytes() != self._no_warnings:
            raise PhysicsError(self._describe_warnings())

    def _vary(self, ids: np.ndarray) -> None:
        """Give the models of some worlds their drawn parameters."""
        if not self._varied.base or not self.parameters:
            return
        shape = self._touching.shape
        values = {name: np.reshape(x, shape)[ids] for name, x in self.parameters.items()}
        for field, rows in self._varied.values(values).items():
            self._batch.expand(field)[ids] = rows
        self._batch.set_const(ids)

    def _kept(self) -> ByName:
        """All that a later step depends on; `mjSTATE_INTEGRATION` has the warm start too."""
        arrays = {
            "integration": self._batch.state,
            "command": self._command,
            "thrust": self._thrust,
            "touching": self._touching,
        }
        if self._colliding is not None:
            arrays["colliding"] = self._colliding
        return arrays

    def _restore(self, arrays: Arrays) -> None:
        self._check_process()
        self._vary(np.arange(len(self._touching)))
        for name, array in self._kept().items():
            array[...] = arrays[name]
        self._warnings.fill(0)

    def _act(self, effects: Effects, mask: Array | None, some: Array) -> None:
        """Let the effects act on some worlds before a physics step."""
        mean, end, wrench = effects.step(self.state, mask)
        if self._on_rotors:
            self._thrust[some] = np.reshape(end, self._ctrl.shape)[some]
        self._ctrl[some] = np.reshape(mean, self._ctrl.shape)[some] / self._newtons
        if wrench is not None:
            self._applied[some] = np.reshape(wrench, self._applied.shape)[some]

    def _clear_contacts(self, some: Array) -> None:
        """No contact of some worlds yet."""
        self._touching[some] = False
        if self._colliding is not None:
            self._colliding[some] = False

    def _add_contacts(self, some: Array) -> None:
        """Add the contacts of some worlds to those that they had."""
        if self._colliding is None:
            self._touching[some] |= self._contacts[some, None] > 0
        else:
            of_all, of_ground = (self._counts[some][..., columns] for columns in self._columns)
            self._touching[some] |= of_all > 0
            self._colliding[some] |= of_all > of_ground

    def acceleration(self) -> Array:
        """As `World.acceleration`: of a `mj_forward` that leaves the state as it was."""
        if self._qacc is None:
            self._qacc = self._batch.bind("qacc")
            self._warmstart = self._batch.bind("qacc_warmstart")
        before = self._warmstart.copy()
        self._batch.forward()
        self._warmstart[:] = before
        own, _ = _views(self._qacc, self._touching.shape[1], 6, self.shape)
        return own[..., :3].copy()

    def below(self) -> Array:
        """As `World.below`, by `mj_ray`."""
        shape = (*self._touching.shape, 3)
        origin = self.state.position.reshape(shape)
        down = -body_z(self.state.quaternion).reshape(shape)
        distance = self._batch.ray(origin, down, geomgroup=_SEEN)[0]
        return np.where(distance < 0, np.inf, distance).reshape(self.shape)[()]

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

    def _hung(self, pose: InitialState, ids: np.ndarray) -> np.ndarray | None:
        """Where the payload of each world begins, shape (W, 3).

        Raises `InputError` if the payload of one of the worlds `ids` would hang in the ground.
        """
        if self._cable is None:
            return None
        drones = self._touching.shape[1]
        hung = pose.payload
        if hung is None:
            if drones != 1:
                expected = "one drone in a world, or a task whose start places it"
                raise InputError(f"effects.payload: expected {expected}, got {drones} drones")
            hung = pose.position - (0.0, 0.0, self._cable)
        hung = np.reshape(hung, (-1, drones, 3))[:, 0]
        height = hung[ids, 2].min(initial=np.inf) + self._cable
        least = self._cable + payload_radius(self._options.payload)
        if not height > least:
            expected = f"a height over {least:.4g} m, for the payload on its cable"
            raise InputError(f"start: expected {expected}, got {height:.4g} m")
        return hung

    def _place_payload(self, ids: np.ndarray, hung: np.ndarray) -> None:
        """Put payloads there, moving along with the first craft."""
        qpos = self._batch.bind("qpos")
        qvel = self._batch.bind("qvel")
        qpos[ids, -7:-4] = hung[ids]
        qpos[ids, -4:] = (1.0, 0.0, 0.0, 0.0)
        qvel[ids, -6:-3] = qvel[ids, :3]
        qvel[ids, -3:] = 0.0

    def _describe_warnings(self) -> str:
        counts = self._warnings[:, :, 1]
        ids = np.flatnonzero(counts.any(axis=1)).tolist()
        kinds = np.flatnonzero(counts.any(axis=0)).tolist()
        names = ", ".join(mujoco.mjtWarning(kind).name for kind in kinds)
        self._warnings.fill(0)  # so that a reset gives usable worlds again
        return f"MuJoCo warned of {names} in envs {ids[:5]}: reset the env"


def _views(
    rows: np.ndarray, drones: int, size: int, lead: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Views of rows (W, n): `size` numbers of each craft, and the payload's position or velocity.

    The latter comes after the crafts, and is the same for all crafts of a world.
    """
    crafts = drones * size
    load = rows[:, None, crafts : crafts + 3]
    shared = np.broadcast_to(load, (len(rows), drones, load.shape[-1]))
    return rows[:, :crafts].reshape(*lead, size), shared.reshape(*lead, -1)


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
            hung[payload_body(model)] = True
        # Of each craft the first of six degrees of freedom are those of its translation.
        linear = craft[model.dof_bodyid] & (np.arange(model.nv) % 6 < 3)
        torque = np.arange(6)[None] >= 3  # of a gear
        self._scaled = {
            # Unity's drag goes with the mass.
            "mass": {"body_mass": craft, "body_inertia": craft[:, None], "dof_damping": linear},
            "inertia": {"body_inertia": craft[:, None]},
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
