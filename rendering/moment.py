"""One craft after one control step, as pictures show it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from ..models.frames import pose_in_mujoco_frame

__all__ = ["MetricValue", "Moment"]

Vector = tuple[float, float, float]


class MetricValue(NamedTuple):
    """A metric of a task, and its value."""

    name: str
    value: float
    unit: str = ""
    symbol: str = ""
    """Short symbol; empty: the name."""

    @property
    def label(self) -> str:
        """Its symbol, or its name."""
        return self.symbol or self.name.replace("_", " ")

    @property
    def text(self) -> str:
        """Value with four digits, and unit."""
        whole = len(f"{abs(self.value):.0f}")
        number = f"{self.value:.{max(4 - whole, 0)}f}" if self.unit else f"{self.value:.4g}"
        return f"{number} {self.unit}".strip()


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One craft after one control step. Positions are in the paper's frame."""

    position: Vector
    """X, Y, Z, m."""
    attitude: Vector
    """phi, theta, psi, degrees."""
    thrusts: tuple[float, ...]
    """F1 to FR, N."""
    goal: Vector | None = None
    """Position to reach or hold, X, Y, Z, m; None if the task has no goal."""
    metrics: tuple[MetricValue, ...] = ()
    """The headline first."""
    reward: float = 0.0
    """Of the step that led here."""
    step: int = 0
    """Control steps since the episode began; 0 at its start."""
    episode: int = 0
    """Episodes before this one."""

    @classmethod
    def of(
        cls, telemetry: Mapping[str, Any], metrics: Sequence[tuple[str, str, str]], **rest: Any
    ) -> Self:
        """From a drone's telemetry, and `reward`, `step` and `episode`, which it does not have.

        Telemetry is arrays by name: `position` (3,), `attitude` (3,), `thrust` (R,), `metrics` (M,)
        and, if the task has one, `goal` (3,). The M metrics are told by name, unit and symbol.
        """

        def told(name: str) -> tuple[Any, ...]:
            return tuple(np.asarray(telemetry[name], float).tolist())

        values = told("metrics") if metrics else ()
        return cls(
            position=told("position"),
            attitude=told("attitude"),
            thrusts=told("thrust"),
            goal=told("goal") if "goal" in telemetry else None,
            metrics=tuple(
                MetricValue(name, value, unit, symbol)
                for (name, unit, symbol), value in zip(metrics, values, strict=True)
            ),
            **rest,
        )

    @property
    def qpos(self) -> np.ndarray:
        """Pose of the free joint in MuJoCo's frame, float64, shape (7,)."""
        return pose_in_mujoco_frame(self.position, self.attitude)

    @property
    def goal_point(self) -> np.ndarray | None:
        """The goal in MuJoCo's frame, float64, shape (3,), m."""
        return None if self.goal is None else pose_in_mujoco_frame(self.goal, (0, 0, 0))[:3]

    def lines(self, thrust_high: float) -> list[tuple[str, str]]:
        """Names and values for an overlay; a rotor's largest thrust, N, sets the digits."""
        lines = [(metric.label, metric.text) for metric in self.metrics[:_MOST_METRICS]]
        lines.append(("elevation", f"{self.position[1]:.2f} m"))
        if self.goal is not None:
            lines.append(("goal", f"{self.goal[1]:.2f} m"))
        unit, scale = ("N", 1.0) if thrust_high >= 1 else ("mN", 1e3)
        decimals = max(0, 2 - math.floor(math.log10(thrust_high * scale)))
        rotors = len(self.thrusts)
        name = f"F1 to F{rotors}" if rotors > 1 else "F1"
        shown = self.thrusts
        if rotors > _MOST_THRUSTS:
            name, shown = f"{name}, mean", (float(np.mean(shown)),)
        thrusts = " ".join(f"{scale * thrust:.{decimals}f}" for thrust in shown)
        lines += [(name, f"{thrusts} {unit}"), ("reward", f"{self.reward:+.3f}")]
        return [*lines, ("step", str(self.step)), ("episode", str(self.episode))]


_MOST_METRICS = 4  # with a line of their own
_MOST_THRUSTS = 4  # rotors with a number of their own
