"""Many craft in MuJoCo, stepped on a thread pool: `Physics` for arrays. Knows nothing of the task.

`mujoco.batch.Batch` gives each simulation the bits that a loop over single ones gives it, with any
number of threads.
"""

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from ..models import load_model
from ..models.frames import attitudes_in_paper_frame, positions_in_paper_frame
from .physics import CONTACT_CHECK, PhysicsError, switch_off_log_file, warning_names

__all__ = ["BatchPhysics"]


class BatchPhysics:
    """N quadcopters, each over a floor of its own.

    Args:
        num_envs: N.
        linear_drag: As `load_model`.
        num_threads: Threads that step them; 0 takes one for each processor.

    Attributes:
        touching: bool, shape (N,): whether any part was in contact with the floor since the last
            `step` or `reset` of that craft.
    """

    def __init__(self, num_envs: int, linear_drag: float = 0.0, num_threads: int = 0) -> None:
        switch_off_log_file()
        self._batch = Batch(load_model(linear_drag, visual=False), num_envs, num_threads)
        # Live views of simulator memory, made once; nothing hands them on.
        self._qpos: np.ndarray = self._batch.bind("qpos")
        self._qvel: np.ndarray = self._batch.bind("qvel")
        self._ctrl: np.ndarray = self._batch.bind("ctrl")
        self._contacts: np.ndarray = self._batch.bind("ncon")
        self._warnings: np.ndarray = self._batch.warning[:, :, 1]  # counts, beside the last info
        self.touching = np.zeros(num_envs, bool)

    def reset(self, ids: np.ndarray, elevation: np.ndarray, thrust: float) -> None:
        """Put some craft at rest and level above the origin.

        Args:
            ids: Which, int, shape (n,).
            elevation: Heights of their centres of mass above the floor, m, shape (n,).
            thrust: Thrust of each rotor, N.
        """
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._qpos[ids, 2] = elevation
        self._ctrl[ids] = thrust
        self._batch.forward(ids)
        self.touching[ids] = self._contacts[ids] > 0

    def step(self, ids: np.ndarray | None, thrust: np.ndarray, substeps: int) -> None:
        """Fly for `substeps` physics steps with the same thrust at each rotor.

        Args:
            ids: Which, int, shape (n,); None for all.
            thrust: Of every craft, those that do not fly too, N, shape (N,).
            substeps: Physics steps.

        Raises:
            PhysicsError: MuJoCo warned of a bad state; reset the craft that it names.
        """
        self._ctrl[:] = thrust[:, np.newaxis]
        some = slice(None) if ids is None else ids
        self.touching[some] = False
        while substeps > 0:
            try:
                self._batch.step(ids, nstep=min(substeps, CONTACT_CHECK))
            except SimulationError as error:
                raise PhysicsError(f"{error}: reset the env") from None
            self.touching[some] |= self._contacts[some] > 0
            substeps -= CONTACT_CHECK
        if self._warnings.any():
            raise PhysicsError(self._describe_warnings())

    def _describe_warnings(self) -> str:
        # Take the warnings off, so that a reset gives usable craft again.
        ids = np.flatnonzero(self._warnings.any(axis=1)).tolist()
        names = ", ".join(warning_names(self._warnings.sum(axis=0).tolist()))
        self._warnings.fill(0)
        return f"MuJoCo warned of {names} in envs {ids[:5]}: reset the env"

    @property
    def elevation(self) -> np.ndarray:
        """Heights of the centres of mass above the floor, m, shape (N,)."""
        return self._qpos[:, 2].copy()

    @property
    def climb_rate(self) -> np.ndarray:
        """Upward speeds, m/s, shape (N,)."""
        return self._qvel[:, 2].copy()

    @property
    def tilt_cosine(self) -> np.ndarray:
        """Cosines of the angles between the bodies' z axes and the vertical, shape (N,)."""
        x, y = self._qpos[:, 4], self._qpos[:, 5]
        cosine: np.ndarray = 1 - 2 * (x * x + y * y)
        return cosine

    def telemetry(self, out: np.ndarray) -> None:
        """Write the ten numbers of `TELEMETRY_NAMES`, in the paper's frame.

        Args:
            out: float64, shape (N, 10).
        """
        positions_in_paper_frame(self._qpos[:, :3], out[:, :3])
        attitudes_in_paper_frame(self._qpos[:, 3:], out[:, 3:6])
        out[:, 6:] = self._ctrl
