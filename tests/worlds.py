"""Worlds of drones, for tests."""

from pathlib import Path
from typing import Any

import numpy as np
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim import InitialState, World
from rotorgram.sim.state import WorldState

EVERY: Any = np.ones((1, 1), bool)
"""The mask of a single drone."""
BALL_RADIUS = 0.15
"""Of `ball_craft`, m."""


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


def ball_craft(folder: Path) -> Vehicle:
    """A racer whose only solid geom is a ball about its origin; its file is in a folder."""
    box = '<geom type="box" size="0.1 0.08 0.03"'
    text = (Path(__file__).parent / "data" / "racer.xml").read_text()
    file = folder / "ball.xml"
    file.write_text(text.replace(box, f'<geom type="sphere" size="{BALL_RADIUS}"', 1))
    return Vehicle.load(file)
