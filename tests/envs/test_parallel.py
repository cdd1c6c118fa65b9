"""PettingZoo's parallel env over the loop."""

import warnings

import numpy as np
import pytest
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test
from pettingzoo.utils import parallel_to_aec
from rotorgram.envs.parallel import LocalParallelEnv
from rotorgram.models import InputError
from swarms import RISE


def test_it_is_a_parallel_env_of_pettingzoo() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(LocalParallelEnv(RISE, 3), num_cycles=200)
        parallel_seed_test(lambda: LocalParallelEnv(RISE, 3), num_cycles=50)


def test_it_is_an_aec_env_by_pettingzoos_wrapper() -> None:
    api_test(parallel_to_aec(LocalParallelEnv(RISE, 3)), num_cycles=200)


def test_an_agent_leaves_where_its_episode_ends() -> None:
    env = LocalParallelEnv(RISE, 2)
    env.reset(seed=1)
    actions = {"drone_0": np.ones(1, np.float32), "drone_1": np.zeros(1, np.float32)}
    while len(env.agents) == 2:
        _, rewards, terminated, truncated, infos = env.step(actions)
        assert set(rewards) == set(infos) == {"drone_0", "drone_1"}
    assert env.agents == ["drone_1"]
    assert terminated == {"drone_0": True, "drone_1": False}
    assert truncated == {"drone_0": False, "drone_1": False}
    assert abs(infos["drone_0"]["risen"]) > 0.5
    seen, *_ = env.step(actions)  # an action of one that left is ignored
    assert list(seen) == ["drone_1"]


def test_a_missing_or_wrong_action_is_one_sentence() -> None:
    env = LocalParallelEnv(RISE, 2)
    env.reset(seed=1)
    with pytest.raises(InputError, match="actions: expected a dict with drone_0, drone_1, got"):
        env.step({"drone_0": np.zeros(1, np.float32)})
    wrong = {"drone_0": np.zeros(1, np.float32), "drone_1": "up"}
    sentence = "action of drone_1: expected real numbers, got 'up'"
    with pytest.raises(InputError, match=sentence):
        env.step(wrong)
    with pytest.raises(InputError, match="action of drone_0: expected finite numbers, got"):
        env.step(dict.fromkeys(env.agents, np.full(1, 1e39)))
