"""Worlds of vehicles, stepped together: state, draws, controllers, and the backends behind them.

Knows nothing of tasks, rewards or Gymnasium.
"""

from .control import LEVELS, CollectiveThrust, Controller, Gains, make_controller
from .effects import EffectOptions
from .random import Draw
from .randomize import PARAMETERS, Randomization
from .rotations import body_x, body_z, to_body, world_z
from .state import (
    Array,
    InitialState,
    WorldState,
    clip,
    component,
    each,
    plain,
    square_root,
    stack,
)  # fmt: skip
from .world import PhysicsError, World, make_world

__all__ = [
    "LEVELS",
    "PARAMETERS",
    "Array",
    "CollectiveThrust",
    "Controller",
    "Draw",
    "EffectOptions",
    "Gains",
    "InitialState",
    "PhysicsError",
    "Randomization",
    "World",
    "WorldState",
    "body_x",
    "body_z",
    "clip",
    "component",
    "each",
    "make_controller",
    "make_world",
    "plain",
    "square_root",
    "stack",
    "to_body",
    "world_z",
]  # fmt: skip
