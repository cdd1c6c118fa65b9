"""A RemoteVectorEnv for the tests, its simulators, and local envs to compare it with."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from peers import ANY, ENV_ID, Running, simulate
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.spec import component_names
from rotorgram.udp import (
    RemoteVectorEnv,
)

SPEC = env_spec(EnvConfig(env_id=ENV_ID))
NAMES = [name for array in SPEC.telemetry for name in component_names(array)]


@contextmanager
def flying(
    simulators: int,
    drones: int,
    env: str | Callable[[], gym.Env[Any, Any]] = ENV_ID,
    autoreset: str = "NextStep",
    **options: Any,
) -> Iterator[tuple[RemoteVectorEnv, list[Running]]]:
    """A RemoteVectorEnv, and simulators for it in threads."""
    remote = RemoteVectorEnv(
        ANY,
        num_simulators=simulators,
        num_envs=simulators * drones,
        autoreset_mode=autoreset,
        connect=False,
    )
    running = []
    for _ in range(simulators):
        made = env() if callable(env) else env
        running.append(simulate(remote, num_envs=drones, env=made, **options))
    try:
        yield remote, running
    finally:
        remote.close()
        for one in running:
            one.join()


@contextmanager
def sync(num_envs: int, **options: Any) -> Iterator[VectorEnv]:
    with closing(gym.make_vec(ENV_ID, num_envs=num_envs, **options)) as env:
        yield env


def assert_same(here: tuple, there: tuple, drones: slice = slice(None)) -> None:
    """What reset or step gave, without the info, bit for bit."""
    for ours, theirs in zip(here[:-1], there[:-1], strict=True):
        assert ours.dtype == theirs.dtype
        assert ours[drones].tobytes() == theirs[drones].tobytes()
    for name in (name for name in there[-1] if name.lstrip("_") in NAMES):
        ours = here[-1][name]
        theirs = there[-1][name]
        assert ours.dtype == theirs.dtype
        assert ours[drones].tobytes() == theirs[drones].tobytes()


def random_actions(env: VectorEnv, dice: np.random.Generator) -> np.ndarray:
    shape = env.action_space.shape
    if isinstance(env.single_action_space, spaces.Discrete):
        return dice.integers(3, size=shape)
    return dice.uniform(-1.2, 1.2, shape).astype(np.float32)


def assert_parity(remote: VectorEnv, local: VectorEnv, steps: int) -> int:
    """How many episodes ended on the way."""
    dice = np.random.default_rng(5)
    ends = 0
    for _ in range(steps):
        actions = random_actions(local, dice)
        here = remote.step(actions)
        there = local.step(actions)
        assert_same(here, there)
        assert set(here[-1]) == {*NAMES, *(f"_{name}" for name in NAMES)}
        ends += int((here[2] | here[3]).sum())
    return ends


class Failing(gym.Wrapper):
    """Raises when it is told to."""

    fails = False

    def step(self, action: Any) -> Any:
        if self.fails:
            raise RuntimeError("out of fuel")
        return super().step(action)
