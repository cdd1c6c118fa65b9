"""After `restore(snapshot())` no later bit differs, and copies of an env fly as it does."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from contracts import CASES, HOVER, bits
from rotorgram.models.errors import InputError

COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
    "cloudpickle": lambda env: pickle.loads(cloudpickle.dumps(env)),
}


def flight(env: Any, steps: int) -> list[Any]:
    """All that the steps return. A single env is reset after an episode, a vector env by itself."""
    rng = np.random.default_rng(7)
    shape = env.action_space.shape
    seen = []
    for _ in range(steps):
        result = env.step((0.3 * rng.normal(size=shape)).clip(-1.0, 1.0).astype(np.float32))
        seen.append(bits(result))
        if not isinstance(env, gym.vector.VectorEnv) and (result[2] or result[3]):
            seen.append(bits(env.reset()))
    return seen


def vector_of(name: str) -> Any:
    case = CASES[name]
    options = {**case.options, "drones": case.drones}
    return gym.make_vec(case.env_id, num_envs=2 * case.drones, **options)


def single_of(name: str) -> Any:
    return gym.make(CASES[name].env_id, **CASES[name].options)


@pytest.mark.parametrize("make", [single_of, vector_of])
def test_envs_are_restored(make: Callable[[str], Any]) -> None:
    env = make("rich").unwrapped
    env.reset(seed=3)
    flight(env, 6)
    snapshot = env.snapshot()
    first = flight(env, 12)
    env.restore(snapshot)
    assert flight(env, 12) == first


@pytest.mark.parametrize("copied", COPIES)
@pytest.mark.parametrize("case", ["Hover, rotors", "rich", "rich, rigid", "pictures"])
def test_single_envs_are_copied(case: str, copied: str) -> None:
    env = single_of(case)
    env.reset(seed=3)
    flight(env, 6)
    twin = COPIES[copied](env)
    assert flight(twin, 12) == flight(env, 12)


@pytest.mark.parametrize("copied", COPIES)
@pytest.mark.parametrize("case", ["Hover, rotors", "rich", "lossy radio"])
def test_vector_envs_are_copied(case: str, copied: str) -> None:
    env = vector_of(case)
    fresh = COPIES[copied](env)
    assert bits(fresh.reset(seed=3)) == bits(env.reset(seed=3))
    flight(env, 6)
    twin = COPIES[copied](env)
    assert flight(twin, 12) == flight(env, 12)


@pytest.mark.parametrize("backend", ["mujoco", "rigid"])
def test_the_first_reset_of_a_copy_may_be_of_some(backend: str) -> None:
    env = gym.make_vec(HOVER, num_envs=2, backend=backend)
    mask = np.array([True, False])
    ours, theirs = (
        one.reset(seed=1, options={"reset_mask": mask})[0] for one in (copy.deepcopy(env), env)
    )
    assert bits(ours[0]) == bits(theirs[0])


def test_results_of_the_snapshot_are_back() -> None:
    env: Any = gym.make_vec(HOVER, num_envs=3).unwrapped
    env.reset(seed=1)
    results = env.step(env.action_space.sample())
    telemetry = bits(dict(env.telemetry))
    snapshot = env.snapshot()
    flight(env, 3)
    env.restore(snapshot)
    assert bits((env.observations, env.rewards)) == bits(results[:2])
    assert bits(dict(env.telemetry)) == telemetry


def test_another_number_of_drones_is_refused() -> None:
    two: Any = gym.make_vec(HOVER, num_envs=2).unwrapped
    three: Any = gym.make_vec(HOVER, num_envs=3).unwrapped
    with pytest.raises(InputError, match=r"expected one of drones \(3, 1\), got \(2, 1\)"):
        three.restore(two.snapshot())


def test_a_snapshot_of_another_config_is_refused() -> None:
    near: Any = gym.make(HOVER).unwrapped
    far: Any = gym.make(HOVER, start_tilt=60).unwrapped
    near.reset(seed=1)
    far.reset(seed=2)
    before = bits(near.snapshot())
    with pytest.raises(
        InputError, match=r"^snapshot: expected one of config \w{32}, got one of \w"
    ):
        near.restore(far.snapshot())
    partial = near.snapshot()
    del partial["record/kept/done"]
    with pytest.raises(InputError, match=r"^snapshot: expected all of its arrays, got none of rec"):
        near.restore(partial)
    assert bits(near.snapshot()) == before


def test_a_closed_env_has_no_snapshot() -> None:
    env: Any = gym.make(HOVER)
    env.close()
    with pytest.raises(gym.error.ClosedEnvironmentError):
        env.unwrapped.snapshot()


def test_a_single_env_flies_on_rigid() -> None:
    env = gym.make(HOVER, backend="rigid")
    _, info = env.reset(seed=1)
    assert isinstance(info["x"], float)
    assert isinstance(info["reward_position"], float)
    alone = gym.make(HOVER)
    _, exact = alone.reset(seed=1)
    assert list(info) == list(exact)
    assert [info[name] for name in "xyz"] == pytest.approx([exact[name] for name in "xyz"])


def test_parallel_envs_are_copied() -> None:
    from rotorgram.envs.parallel import LocalParallelEnv

    env = LocalParallelEnv("rotorgram/Formation-v0", drones=3)
    env.reset(seed=1)
    twin = pickle.loads(pickle.dumps(env))
    actions = {agent: env.action_space(agent).sample() for agent in env.agents}
    assert bits(twin.step(actions)) == bits(env.step(actions))
