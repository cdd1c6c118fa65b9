"""Render modes of the envs. Code that draws is imported on first use."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from ..models.errors import InputError
from .spec import EnvSpec

if TYPE_CHECKING:
    from ..rendering import Moment
    from ..rendering.painter import Painter
    from .loop import Loop

__all__ = ["RENDER_MODES", "checked_render_mode", "moment", "moments", "painter"]

RENDER_MODES: Final = ["human", "rgb_array"]


def checked_render_mode(mode: str | None) -> str | None:
    """The mode itself. Raises `InputError` for one that there is not."""
    if mode is not None and mode not in RENDER_MODES:
        raise InputError(f"render_mode: expected None, 'human' or 'rgb_array', got {mode!r}")
    return mode


def painter(mode: str, loop: "Loop") -> "Painter":
    """A painter for the drones of a loop."""
    from ..rendering.painter import Painter

    return Painter(mode, loop.num_envs, loop.spec.control_period, loop.vehicle.path)


def moments(loop: "Loop", episodes: Sequence[int]) -> "list[Moment]":
    """The current `Moment` of every drone; `episodes` are the numbers of their episodes."""
    steps, rewards = loop.steps, loop.rewards
    return [
        moment(
            loop.spec,
            {name: values[i] for name, values in loop.telemetry.items()},
            reward=float(rewards[i]),
            step=int(steps[i]),
            episode=episode,
        )
        for i, episode in enumerate(episodes)
    ]


def moment(spec: EnvSpec, telemetry: Mapping[str, Any], **rest: Any) -> "Moment":
    """The `Moment` of one drone.

    Args:
        spec: Of its env.
        telemetry: Its arrays, by name.
        rest: `reward`, `step` and `episode`, as `rendering.Moment` has them.
    """
    from ..rendering import Moment

    metrics = [(metric.name, metric.unit, metric.symbol) for metric in spec.metrics]
    return Moment.of(telemetry, metrics, **rest)
