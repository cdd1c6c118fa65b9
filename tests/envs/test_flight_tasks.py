"""Tasks as array code: torch gives the numbers of NumPy, and drones that rest keep theirs."""

from typing import Any

import array_api_compat.torch as torch_api
import gymnasium as gym
import numpy as np
import pytest
import torch
from rotorgram.envs.loop import make_task
from rotorgram.sim import WorldState, stack

from flights import Shares

TASKS = ["Landing", "Recovery", "PayloadHover"]
SHAPE = (6, 1)
SIZES = {"position": 3, "quaternion": 4, "velocity": 3, "body_rates": 3, "thrust": 4}


def states(dice: np.random.Generator) -> WorldState:
    arrays = {name: dice.normal(size=(*SHAPE, size)) for name, size in SIZES.items()}
    arrays["quaternion"] /= np.linalg.norm(arrays["quaternion"], axis=-1, keepdims=True)
    arrays["position"] *= 3.0
    payload, moving = (arrays["position"] - (0, 0, 1.0), arrays["velocity"] + 0.1)
    return WorldState(
        **arrays,
        command=arrays["thrust"],
        touching=dice.uniform(size=SHAPE) < 0.3,
        payload=payload,
        payload_velocity=moving,
    )


def as_tensors(state: WorldState) -> WorldState:
    both = {name: getattr(state, name) for name in WorldState.__slots__}
    fields = {name: array for name, array in both.items() if array is not None}
    return WorldState(**{name: torch.from_numpy(array) for name, array in fields.items()})


class Given(Shares):
    """One share for each drone, which all axes of a draw get."""

    def uniform(self, low: Any, high: Any, size: Any = (), *, name: str = "") -> Any:
        value = super().uniform(low, high)
        return stack([value] * size[0]) if size else value


def told(task: Any, state: WorldState) -> dict[str, np.ndarray]:
    outcome = task.outcome(state)
    both = {**task.observe(state), **outcome.reward, **outcome.metrics}
    both |= {"terminated": outcome.terminated, "goal": task.goal(state)}
    return {name: np.asarray(value) for name, value in both.items()}


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("action", ["rotors", "offset"])
def test_torch_gives_what_numpy_gives(name: str, action: str) -> None:
    dice = np.random.default_rng(0)
    env_id, options = f"rotorgram/{name}-v0", {"action": action}
    ours = make_task(env_id, options, shape=SHAPE)
    theirs = make_task(env_id, options, shape=SHAPE, xp=torch_api)
    flying = np.ones(SHAPE, bool)
    for step in range(6):
        if step % 3 == 0:
            shares = [dice.uniform(size=SHAPE) for _ in range(12)]
            pose = ours.begin(flying, Given(*shares))
            other = theirs.begin(torch.from_numpy(flying), Given(*map(torch.from_numpy, shares)))
            for part in ("position", "quaternion", "velocity", "body_rates", "thrust"):
                one, two = getattr(pose, part), getattr(other, part)
                assert (one is None) == (two is None)
                if one is not None:
                    np.testing.assert_allclose(two.numpy()[flying], one[flying], atol=1e-12)
        state = states(dice)
        flying = dice.uniform(size=SHAPE) < 0.7
        ours.remember(state, flying)
        theirs.remember(as_tensors(state), torch.from_numpy(flying))
        one, two = told(ours, state), told(theirs, as_tensors(state))
        assert one.keys() == two.keys()
        for key, value in one.items():
            np.testing.assert_allclose(two[key], value, atol=1e-10, err_msg=key)


@pytest.mark.parametrize("name", TASKS)
def test_a_frozen_drone_keeps_its_numbers(name: str) -> None:
    """Of two drones with the same seed and actions one rests for ten steps in between."""
    env: Any = gym.make_vec(f"rotorgram/{name}-v0", num_envs=2, autoreset_mode="Disabled")
    env.reset(seed=[3, 3])
    actions, seen = np.full(env.action_space.shape, 0.05, np.float32), [[], []]
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
