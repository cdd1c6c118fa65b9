"""The layout of the messages of an env, from its spec."""

from ..envs.actions import asked_bits
from ..envs.spec import Discrete, EnvSpec
from .protocol.layout import ArrayLayout, Layout


def layout_of(spec: EnvSpec, worlds: int = 1) -> Layout:
    """The layout of W = `worlds` worlds, each with every drone of the spec. Raises as `Layout`."""
    action = spec.action
    return Layout(
        drones=worlds * len(spec.agents),
        observation=tuple(ArrayLayout(a.shape, a.dtype) for a in spec.observation),
        action=None if isinstance(action, Discrete) else ArrayLayout(action.shape, action.dtype),
        choices=action.choices if isinstance(action, Discrete) else 0,
        asked_bits=asked_bits(spec.asks),
        telemetry=tuple((a.shape, a.frame) for a in spec.telemetry),
    )
