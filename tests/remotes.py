"""A RemoteEnv for the tests, and the simulator that flies for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import rotorgram.envs  # noqa: F401
from gymnasium import spaces
from peers import ANY, ENV_ID, simulate
from rotorgram.envs.spec import component_names
from rotorgram.udp import (
    RemoteEnv,
)


@contextmanager
def flying(env: Any = ENV_ID, codec: Any = "binary", **options: Any) -> Iterator[SimpleNamespace]:
    """A RemoteEnv, and a simulator for it in a thread."""
    known = {"env_id": ENV_ID, "options": options} if codec == "text" else {}
    remote = RemoteEnv(ANY, connect=False, timeout=5, connect_timeout=5, **known)
    running = simulate(remote, env=env, codec=codec, **options)
    try:
        yield SimpleNamespace(remote=remote, simulator=running.simulator, running=running)
    finally:
        remote.close()
        running.join()


def assert_parity(
    remote: gym.Env, steps: int, seeds: tuple[int, ...] = (1,), **options: Any
) -> int:
    """The same seeds and actions give the same bits as in process; how many States it took."""
    local = gym.make(ENV_ID, **options)
    dice = np.random.default_rng(5)
    spec = local.unwrapped.env_spec
    names = [name for array in spec.telemetry for name in component_names(array)]
    left = list(seeds)

    def same(here: tuple, there: tuple) -> None:
        assert here[0].tobytes() == there[0].tobytes()
        assert here[0].dtype == there[0].dtype
        assert here[1:-1] == there[1:-1]
        assert [type(v) for v in here[1:-1]] == [type(v) for v in there[1:-1]]
        assert {name: there[-1][name] for name in names} == here[-1]

    def begin() -> None:
        seed = left.pop(0) if left else None
        same(remote.reset(seed=seed), local.reset(seed=seed))

    begin()
    states = 2  # its own reset, and ours
    for _ in range(steps):
        action: Any = dice.uniform(-1.2, 1.2, 1).astype(np.float32)
        if isinstance(local.action_space, spaces.Discrete):
            action = int(dice.integers(3))
        here = remote.step(action)
        same(here, local.step(action))
        states += 1
        if here[2] or here[3]:
            begin()
            states += 1
    assert not left
    return states


class Broken(gym.Env[np.ndarray, np.ndarray]):
    """Raises, or goes bad, at the third step."""

    observation_space = spaces.Box(-1, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)
    spec = SimpleNamespace(id=ENV_ID, kwargs={})  # type: ignore[assignment]

    def __init__(self, value: float | None) -> None:
        self.value = value
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        self.steps += 1
        if self.steps == 3 and self.value is None:
            raise RuntimeError("bad state\n" + "x" * 600)
        value = self.value if self.steps == 3 else 0.0
        return np.array([value], np.float32), 0.0, False, False, {}
