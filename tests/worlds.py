"""Worlds of drones, for tests."""

from typing import Any

import numpy as np
from rotorgram.sim import InitialState, World
from rotorgram.sim.state import WorldState

EVERY: Any = np.ones((1, 1), bool)
"""The mask of a single drone."""


def begin(world: World, mask: Any = None, **pose: Any) -> World:
    """Reset the worlds of a mask, None for all, to a pose; its arrays may count for all drones."""
    if mask is None:
        mask = np.ones(world.shape, bool)
    shaped = {}
    for name, values in pose.items():
        size = np.shape(values)[-1]
        shaped[name] = np.broadcast_to(np.array(values, float), (*world.shape, size)).copy()
    world.reset(mask, InitialState(**shaped))
    return world


def alone(world: World) -> WorldState:
    """Copies of the state of the first drone, without axes of worlds and drones."""
    arrays = {name: getattr(world.state, name) for name in WorldState.__slots__}
    return WorldState(**{name: None if x is None else x[0, 0].copy() for name, x in arrays.items()})
