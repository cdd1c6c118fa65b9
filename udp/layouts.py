"""The layout of the messages of an env, from its spec."""

from ..envs.spec import ArraySpec, EnvSpec
from .protocol.layout import ArrayLayout, Layout


def layout_of(spec: EnvSpec, worlds: int = 1) -> Layout:
    """The layout of so many worlds, each with every drone of the spec. Raises as `Layout`."""
    action = spec.action
    return Layout(
        drones=worlds * len(spec.agents),
        observation=tuple(map(_array, spec.observation)),
        action=_array(action) if isinstance(action, ArraySpec) else None,
        choices=0 if isinstance(action, ArraySpec) else action.n,
        telemetry=tuple(array.shape for array in spec.telemetry),
    )


def _array(spec: ArraySpec) -> ArrayLayout:
    return ArrayLayout(shape=spec.shape, dtype=spec.dtype)
