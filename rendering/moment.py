"""What there is to see of a craft after one control step."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from ..models.frames import pose_in_mujoco_frame

__all__ = ["Moment"]


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One craft, one control step. Everything is as the wire's telemetry has it."""

    position: tuple[float, float, float]
    """X, Y, Z in the paper's frame, m."""
    attitude: tuple[float, float, float]
    """phi, theta, psi, degrees."""
    thrusts: tuple[float, float, float, float]
    """F1 ... F4, N."""
    error: float
    """E, desired minus measured elevation, m."""
    reward: float = 0.0
    """Of the step that led here."""
    step: int = 0
    """Control steps since the episode began; 0 at its start."""
    episode: int = 0
    """Episodes before this one."""

    @classmethod
    def of(cls, telemetry: Mapping[str, Any], error: float, **rest: Any) -> Self:
        """From an env's `info`, or telemetry by its names."""
        values = [float(telemetry[name]) for name in _NAMES]
        x, y, z, phi, theta, psi, f1, f2, f3, f4 = values
        return cls(
            position=(x, y, z),
            attitude=(phi, theta, psi),
            thrusts=(f1, f2, f3, f4),
            error=float(error),
            **rest,
        )

    @property
    def target(self) -> float:
        """Desired elevation Y, m."""
        return self.position[1] + self.error

    @property
    def qpos(self) -> np.ndarray:
        """Pose of the free joint in MuJoCo's frame, float64, shape (7,)."""
        return pose_in_mujoco_frame(self.position, self.attitude)

    def lines(self) -> list[tuple[str, str]]:
        """What an overlay says: names and values."""
        thrusts = " ".join(f"{thrust:.0f}" for thrust in self.thrusts)
        return [
            ("target", f"{self.target:.2f} m"),
            ("elevation", f"{self.position[1]:.2f} m"),
            ("E", f"{self.error:+.3f} m"),
            ("F1 to F4", f"{thrusts} N"),
            ("reward", f"{self.reward:+.3f}"),
            ("step", str(self.step)),
            ("episode", str(self.episode)),
        ]


_NAMES = ("X", "Y", "Z", "phi", "theta", "psi", "F1", "F2", "F3", "F4")
