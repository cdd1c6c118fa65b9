"""The craft in MuJoCo, read and driven through named quantities. Knows nothing of the task."""

from collections.abc import Iterable, Sequence
from typing import Final

import mujoco

from ..models import load_model
from ..models.frames import attitude_in_paper_frame, position_in_paper_frame

__all__ = ["CONTACT_CHECK", "Physics", "PhysicsError", "switch_off_log_file", "warning_names"]

CONTACT_CHECK: Final = 4
"""Contact is looked for after at most this many physics steps (0.02 s). A bounce at full thrust
lasts longer, unless the skids dip less than half a millimetre."""


class PhysicsError(RuntimeError):
    """MuJoCo reported a bad state; the numbers after it would mean nothing."""


class Physics:
    """One quadcopter over a floor.

    MuJoCo answers a bad state with a reset and a line in MUJOCO_LOG.TXT. Here it raises
    `PhysicsError`, because a silent reset would be learnt from, and that file is switched off for
    the whole process; a log file of another name stays on.

    Attributes:
        touching: Whether any part was in contact with the floor since the last `step` or `reset`.
    """

    def __init__(self, linear_drag: float = 0.0) -> None:
        switch_off_log_file()
        self.model = load_model(linear_drag, visual=False)
        self.data = mujoco.MjData(self.model)
        # Live views of simulator memory, made once; nothing hands them on.
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._warnings = self.data.warning.number
        self._no_warnings = self._warnings.tobytes()
        self.touching = False

    def reset(self, elevation: float, thrust: float) -> None:
        """Put the craft at rest and level above the origin.

        Args:
            elevation: Height of the centre of mass above the floor, m.
            thrust: Thrust of each rotor, N.
        """
        mujoco.mj_resetData(self.model, self.data)
        self._qpos[2] = elevation
        self._ctrl.fill(thrust)
        mujoco.mj_forward(self.model, self.data)
        self.touching = self.data.ncon > 0

    def step(self, thrust: float, substeps: int) -> None:
        """Fly for `substeps` physics steps with the same thrust at each rotor, N."""
        self._ctrl.fill(thrust)
        self.touching = False
        while substeps > 0:
            mujoco.mj_step(self.model, self.data, min(substeps, CONTACT_CHECK))
            self.touching |= self.data.ncon > 0
            substeps -= CONTACT_CHECK
        if self._warnings.tobytes() != self._no_warnings:
            raise PhysicsError(self._describe_warnings())

    def _describe_warnings(self) -> str:
        # Take the warnings off, so that a reset gives a usable craft again.
        seen = ", ".join(warning_names(self._warnings))
        self._warnings.fill(0)
        return f"MuJoCo warned of {seen} at t = {self.data.time:.3f} s: reset the env"

    @property
    def elevation(self) -> float:
        """Height of the centre of mass above the floor, m."""
        elevation: float = self._qpos.item(2)
        return elevation

    @property
    def climb_rate(self) -> float:
        """Upward speed, m/s."""
        rate: float = self._qvel.item(2)
        return rate

    @property
    def tilt_cosine(self) -> float:
        """Cosine of the angle between the body's z axis and the vertical."""
        x: float = self._qpos.item(4)
        y: float = self._qpos.item(5)
        return 1 - 2 * (x * x + y * y)

    def telemetry(self) -> Sequence[float]:
        """The ten numbers of `TELEMETRY_NAMES`, in the paper's frame."""
        q = self._qpos.tolist()
        return (
            *position_in_paper_frame(q[:3]),
            *attitude_in_paper_frame(q[3:]),
            *self._ctrl.tolist(),
        )


def warning_names(counts: Iterable[int]) -> list[str]:
    """MuJoCo's names of the warnings whose counts are not 0."""
    return [mujoco.mjtWarning(i).name for i, count in enumerate(counts) if count]


def switch_off_log_file() -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT; a log file of another name stays on."""
    config = mujoco.MjLogConfig.get()
    if config.logto_file and config.logfile == "MUJOCO_LOG.TXT":
        config.logto_file = False
        config.set()
