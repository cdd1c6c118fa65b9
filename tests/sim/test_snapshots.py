"""Worlds are copied: a copy flies on with the same bits."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from contracts import FEATURES, bits
from rotorgram.envs import Loop
from rotorgram.sim import InitialState


@pytest.mark.parametrize("case", ["swarm", "swarm, rigid"])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_worlds_are_copied(case: str, copied: Any) -> None:
    loop = Loop(FEATURES[case].config(), 2)
    loop.advance(np.zeros((4, 4)), np.ones(4, bool), range(4))
    world: Any = loop.world
    twin = copied(world)
    some = np.array([[True, True], [False, False]])
    for either in (world, twin):
        for _ in range(3):
            start = either.draw(some).uniform(2.0, 3.0, (3,))
            either.reset(some, InitialState(position=start))
            either.step(world.vehicle.hover_thrust + 0.0 * either.state.command, 4)
    assert bits(twin.snapshot()) == bits(world.snapshot())
