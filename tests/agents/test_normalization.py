"""Running moments of observations, and where the policy and its checkpoint have them."""

from typing import Any

import numpy as np
from rotorgram.agents import A2CConfig, EpisodeRecorder, make_agent
from rotorgram.agents.normalization import Moments
from rotorgram.envs import LocalVectorEnv


def test_moments_of_parts_are_those_of_the_whole() -> None:
    rows = np.random.default_rng(0).normal([1e6, -2, 0], [3, 0.5, 1e-4], (1000, 3))
    moments = Moments(3)
    assert moments.mean.tolist() == [0, 0, 0]
    assert moments.scale.tolist() == [1, 1, 1]
    for part in np.split(rows, [1, 7, 500]):
        moments.add(part)
    np.testing.assert_allclose(moments.mean, rows.mean(0), rtol=1e-6)
    np.testing.assert_allclose(moments.scale[:2], 1 / rows[:, :2].std(0), rtol=1e-6)
    assert moments.scale[2] == 100, "no deviation counts as less than 0.01"


def test_the_policy_has_the_moments_of_all_rollouts_before_it() -> None:
    """Reward and weights apart, what is seen decides: mean and deviation of the rollouts."""
    env: Any = LocalVectorEnv("rotorgram/Elevation-v0", 4, autoreset_mode="Disabled")
    log = EpisodeRecorder(env, 0)
    config = A2CConfig(normalize_observations=True, steps_per_update=40)
    agent: Any = make_agent("a2c", log, config, 0)
    update = agent.update
    seen = []

    def keep_and_update(rollout: Any) -> None:
        seen.append(rollout.rows(rollout.observations))
        update(rollout)

    agent.update = keep_and_update

    def check() -> bool:
        rows = np.concatenate(seen).astype(float)
        arrays = agent.policy().arrays()
        np.testing.assert_allclose(arrays["observation.mean"], rows.mean(0), atol=1e-5)
        expected = 1 / np.maximum(rows.std(0), 0.01)
        np.testing.assert_allclose(arrays["observation.scale"], expected, rtol=1e-4)
        return True

    agent.train(log, 200, check)
    assert len(seen) == 5
