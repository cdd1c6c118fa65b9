"""Tasks as array code: drones that rest keep their numbers."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

TASKS = ["Landing", "Recovery", "PayloadHover"]


@pytest.mark.parametrize("name", TASKS)
def test_a_frozen_drone_keeps_its_numbers(name: str) -> None:
    """Of two drones with the same seed and actions one rests for ten steps in between."""
    env: Any = gym.make_vec(f"rotorgram/{name}-v0", num_envs=2, autoreset_mode="Disabled")
    env.reset(seed=[3, 3])
    actions = np.full(env.action_space.shape, 0.05, np.float32)
    seen = [[], []]
    for step in range(60):
        rests = np.array((False, 20 <= step < 30))
        env.advance(actions, None, None, rests)
        for drone in np.flatnonzero(~rests):
            row = [env.observations[drone], env.rewards[drone], env.telemetry["metrics"][drone]]
            seen[drone].append(np.concatenate([np.ravel(part) for part in row]))
        if env.done.any():
            break
    assert len(seen[1]) > 25
    np.testing.assert_array_equal(seen[0][: len(seen[1])], seen[1])
