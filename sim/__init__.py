"""Worlds of vehicles, stepped together: state, draws, controllers, and the backends behind them.

Knows nothing of tasks, rewards or Gymnasium.
"""

from .control import LEVELS, CollectiveThrust, Controller, make_controller
from .control.wrench import SEEN, Wrench
from .effects import EffectOptions
from .elementary import atan2, cos, exp, log, power, sin, wrapped
from .random import Draw
from .randomize import PARAMETERS, Randomization
from .rotations import body_x, body_z, to_body, world_z
from .state import (
    Array,
    InitialState,
    WorldState,
    clip,
    length,
    looked_up,
    parts_of,
    remainder,
    square_root,
    stack,
    total,
)  # fmt: skip
from .world import PhysicsError, World, make_world

__all__ = [
    "LEVELS",
    "PARAMETERS",
    "SEEN",
    "Array",
    "CollectiveThrust",
    "Controller",
    "Draw",
    "EffectOptions",
    "InitialState",
    "PhysicsError",
    "Randomization",
    "World",
    "WorldState",
    "Wrench",
    "atan2",
    "body_x",
    "body_z",
    "clip",
    "cos",
    "exp",
    "length",
    "log",
    "looked_up",
    "make_controller",
    "make_world",
    "parts_of",
    "power",
    "remainder",
    "sin",
    "square_root",
    "stack",
    "to_body",
    "total",
    "world_z",
    "wrapped",
]  # fmt: skip
