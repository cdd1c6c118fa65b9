"""MuJoCo on the threads of this machine, float64.

`mujoco.batch.Batch` gives each world the same bits as a loop over single worlds, with any number
of threads.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from ...models.errors import InputError
from ...models.vehicle import Vehicle
from ..random import Draw, Noise, NumpyDraw, NumpyNoise, Streams
from ..state import Array, Pose, WorldState
from ..world import PhysicsError, contact_check

_FEW: Final = 8
_ONLY: Final = np.zeros(1, int)


class MujocoWorld:
    """W worlds of one drone over ground of its own: `World`.

    MuJoCo answers a bad state with a reset and a line in MUJOCO_LOG.TXT. Here it raises
    `PhysicsError`, because an agent would learn from a silent reset, and switches that file off for
    the whole process; a log file of another name stays on.

    A single world has no leading axes: NumPy's scalars are ten times faster than its arrays of one.
    So many threads step the worlds; 0 takes one for each processor.
    """

    xp: Any = np

    def __init__(self, vehicle: Vehicle, num_worlds: int, *, num_threads: int = 0) -> None:
        if type(num_threads) is not int or num_threads < 0:
            raise InputError(f"num_threads: expected 0 or more, got {num_threads!r}")
        self.vehicle = vehicle
        self.shape: tuple[int, ...] = (num_worlds, 1) if num_worlds > 1 else ()
        self._streams = Streams(num_worlds)
        self._noises: list[Noise] = []
        self._check = contact_check(vehicle.timestep)
        threads = 1 if num_worlds == 1 else num_threads
        self._batch = batch = Batch(vehicle.model, num_worlds, threads)
        self._owner = None if threads == 1 else os.getpid()
        self._initial = batch.state[0].copy()
        # Live views of simulator memory, made once.
        qpos: np.ndarray = batch.bind("qpos")
        qvel: np.ndarray = batch.bind("qvel")
        self._ctrl: np.ndarray = batch.bind("ctrl")
        self._contacts: np.ndarray = batch.bind("ncon")
        self._warnings = batch.warning  # of each kind the last info, and how many
        self._no_warnings, self._no_contacts = self._warnings.tobytes(), self._contacts.tobytes()
        newtons = np.array([rotor.newtons for rotor in vehicle.rotors])
        self._newtons = None if (newtons == 1.0).all() else newtons
        # Where controls are newtons, they are the thrusts.
        self._thrust = self._ctrl if self._newtons is None else np.zeros_like(self._ctrl)
        self._touching = np.zeros(num_worlds, bool)
        lead = self.shape
        self.state = WorldState(
            position=qpos[:, :3].reshape((*lead, 3)),
            quaternion=qpos[:, 3:].reshape((*lead, 4)),
            velocity=qvel[:, :3].reshape((*lead, 3)),
            body_rates=qvel[:, 3:].reshape((*lead, 3)),
            thrust=self._thrust.reshape((*lead, -1)),
            touching=self._touching.reshape(lead),
        )
        assert np.shares_memory(self.state.position, qpos)

    def reset(self, mask: Array, pose: Pose) -> None:
        """As `World.reset`."""
        self._check_process()
        ids = self._ids(mask)
        self._batch.state[ids] = self._initial
        self._warnings[ids] = 0
        state, here = self.state, () if self.shape == () else ids
        state.position[here] = pose.position[here]
        for name, plain in (
            ("quaternion", (1, 0, 0, 0)),
            ("velocity", 0),
            ("body_rates", 0),
            ("thrust", self.vehicle.hover_thrust),
        ):
            given = getattr(pose, name)
            getattr(state, name)[here] = plain if given is None else given[here]
        self._apply_thrust()
        # To wake the threads takes longer than a few worlds.
        for some in (ids,) if len(ids) > _FEW else ids[:, None]:
            self._batch.forward(some if self.shape else None)
        self._touching[ids] = self._contacts[ids] > 0

    def step(self, thrust: Array, substeps: int, mask: Array | None = None) -> None:
        """As `World.step`."""
        self._check_process()
        ids = None if mask is None else self._ids(mask)
        some = ... if ids is None else ids
        here = some if self.shape else ...
        self.state.thrust[here] = thrust if here is ... else thrust[here]
        self._apply_thrust()
        touching = self._touching
        touching[some] = False
        while substeps > 0:
            try:
                self._batch.step(ids, nstep=min(substeps, self._check))
            except SimulationError as error:
                self._warnings.fill(0)  # of the other worlds: a reset is due all the same
                raise PhysicsError(f"{error}: reset the env") from None
            if self._contacts.tobytes() != self._no_contacts:  # faster than to count
                touching[some] |= self._contacts[some] > 0
            substeps -= self._check
        if self._warnings.tobytes() != self._no_warnings:
            raise PhysicsError(self._describe_warnings())

    def seed(self, mask: Array, seeds: Sequence[int | None] | Array) -> None:
        """As `World.seed`."""
        ids = self._ids(mask).tolist()
        given = [seeds[i] for i in ids]
        self._streams.seed(ids, given)
        for noise in self._noises:
            noise.seed(ids, given)

    def draw(self, mask: Array, chosen: Mapping[str, Any] | None = None) -> Draw:
        """As `World.draw`."""
        return NumpyDraw(self._streams, self._ids(mask).tolist(), self.shape, chosen)

    def noise(self, size: int, use: int | tuple[int, ...]) -> Noise:
        """As `World.noise`."""
        self._noises.append(NumpyNoise(self.shape, size, use))
        return self._noises[-1]

    def close(self) -> None:
        """As `World.close`."""
        if self._owner not in (None, os.getpid()):
            return  # a fork has none of the threads
        state = {name: getattr(self.state, name).copy() for name in WorldState.__slots__}
        self.state = WorldState(**state)
        for view in ("_batch", "_ctrl", "_contacts", "_warnings", "_thrust"):
            vars(self).pop(view, None)

    def _ids(self, mask: Array) -> np.ndarray:
        """The worlds of a mask; of a single one it is always true."""
        return np.flatnonzero(mask) if self.shape else _ONLY

    def _check_process(self) -> None:
        if self._owner is not None and os.getpid() != self._owner:  # it would wait for ever
            raise RuntimeError("the threads of an env do not follow into a fork: make another env")

    def _apply_thrust(self) -> None:
        if self._newtons is not None:
            np.divide(self._thrust, self._newtons, out=self._ctrl)

    def _describe_warnings(self) -> str:
        counts = self._warnings[:, :, 1]
        ids = np.flatnonzero(counts.any(axis=1)).tolist()
        kinds = np.flatnonzero(counts.any(axis=0)).tolist()
        names = ", ".join(mujoco.mjtWarning(kind).name for kind in kinds)
        self._warnings.fill(0)  # so that a reset gives usable worlds again
        return f"MuJoCo warned of {names} in envs {ids[:5]}: reset the env"
