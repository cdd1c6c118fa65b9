"""Render modes of the envs. What draws is imported when something is to be drawn, not before."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from ..models.errors import InputError

if TYPE_CHECKING:
    from ..rendering import Moment
    from ..rendering.painter import Painter
    from .loop import Loop

__all__ = ["RENDER_MODES", "checked_render_mode", "moments", "painter"]

RENDER_MODES: Final = ["human", "rgb_array"]


def checked_render_mode(mode: str | None) -> str | None:
    """The mode itself. Raises `InputError` for one that there is not."""
    if mode is not None and mode not in RENDER_MODES:
        raise InputError(f"render_mode: expected None, 'human' or 'rgb_array', got {mode!r}")
    return mode


def painter(mode: str, loop: "Loop") -> "Painter":
    """Draws what a loop is to show."""
    from ..rendering.painter import Painter

    return Painter(mode, loop.num_envs, loop.spec.control_period)


def moments(loop: "Loop", episodes: Sequence[int]) -> "list[Moment]":
    """What there is to see of every drone now; `episodes` are numbers of their episodes."""
    from ..rendering import Moment

    told: Any = loop.telemetry
    del told, Moment, episodes
    raise NotImplementedError
