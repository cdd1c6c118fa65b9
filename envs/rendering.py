"""Render modes of the envs. What draws is imported when something is to be drawn, not before."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from .config import TELEMETRY_NAMES

if TYPE_CHECKING:
    from ..rendering import Moment
    from ..rendering.painter import Painter

__all__ = ["RENDER_MODES", "checked_render_mode", "moment_of", "painter"]

RENDER_MODES: Final = ["human", "rgb_array"]


def checked_render_mode(mode: str | None) -> str | None:
    """The mode itself. Raises `ValueError` for one that there is not."""
    if mode is not None and mode not in RENDER_MODES:
        raise ValueError(f"render_mode: expected None, 'human' or 'rgb_array', got {mode!r}")
    return mode


def painter(mode: str, drones: int, control_period: float) -> "Painter":
    """Draws what an env of so many drones is to show; `control_period` in s."""
    from ..rendering.painter import Painter

    return Painter(mode, drones, control_period)


def moment_of(telemetry: Sequence[float], error: float, **rest: Any) -> "Moment":
    """What there is to see of one drone: the numbers of `TELEMETRY_NAMES`, E in m, and the rest."""
    from ..rendering import Moment

    return Moment.of(dict(zip(TELEMETRY_NAMES, telemetry, strict=True)), error, **rest)
