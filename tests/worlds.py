"""Worlds of drones, for tests."""

from typing import Any

import numpy as np
from rotorgram.sim import InitialState, World


def begin(world: World, mask: Any = None, **pose: Any) -> World:
    """Reset the worlds of a mask, None for all, to a pose; its arrays may count for all drones."""
    if mask is None:
        mask = np.ones(world.shape, bool)[()]
    shaped = {}
    for name, values in pose.items():
        size = np.shape(values)[-1]
        shaped[name] = np.broadcast_to(np.array(values, float), (*world.shape, size)).copy()
    world.reset(mask, InitialState(**shaped))
    return world
