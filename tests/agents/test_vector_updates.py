"""What many drones learn from: the rows that they flew, and returns and advantages by hand.

Scripted drones keep what they flew: the numbers come from there. Nothing of the rollouts or the
returns is used.
"""

from collections.abc import Callable
from itertools import zip_longest
from typing import Any

import numpy as np
import pytest
from nets import arrays_of
from rotorgram.agents import A2CConfig, VPGConfig, make_agent
from rotorgram.agents.a2c import A2C
from rotorgram.agents.rollouts import Collector, Rollout
from rotorgram.agents.vpg import VPG
from scripted import CALM, LOSSES, Row, Script, Scripted, log_of

GAMMA = 0.9
SCRIPTS = [CALM, CALM[:1], LOSSES, LOSSES[:1]]


def a2c_rows(
    flown: list[list[Row]], value: Callable[[np.ndarray], float], gae_lambda: float
) -> Any:
    """Rows to learn from and their advantages. A lost step is none; the one before bootstraps."""
    kept = []
    advantages = []
    for rows in flown:
        sums: list[float] = []
        for row, following in reversed(list(zip_longest(rows, rows[1:]))):
            if row.lost:
                continue
            goes_on = following is not None and not row.ends and not following.lost
            ahead = 0.0 if row.terminated else GAMMA * value(row.after)
            error = row.reward + ahead - value(row.observation)
            sums.append(error + (GAMMA * gae_lambda * sums[-1] if goes_on else 0.0))
        kept += [row for row in rows if not row.lost]
        advantages += sums[::-1]
    return kept, np.array(advantages)


def vpg_rows(flown: list[list[Row]]) -> tuple[list[Row], np.ndarray]:
    """Rows to learn from, and their returns.

    With many drones only rounds count that every drone has flown to an end, and of them only
    episodes without a loss; with one drone all that are without a loss.
    """
    parts = [
        [[row for row in rows if row.episode == number]
         for number in sorted({row.episode for row in rows})]
        for rows in flown
    ]  # fmt: skip
    kept: list[list[Row]] = [[] for _ in flown]
    returns: list[list[float]] = [[] for _ in flown]
    for round_ in zip_longest(*parts, fillvalue=[]):
        if len(flown) > 1 and not all(rows and rows[-1].ends for rows in round_):
            continue
        for drone, rows in enumerate(round_):
            if not rows[-1].lost:
                kept[drone] += rows
                for t in range(len(rows)):
                    discounted = [GAMMA**k * row.reward for k, row in enumerate(rows[t:])]
                    returns[drone].append(sum(discounted))
    return [row for own in kept for row in own], np.concatenate(returns)


# ---- updates


def by_drone(rollout: Rollout, array: np.ndarray) -> np.ndarray:
    """The kept rows of an array (T, N, ...), one drone after the other."""
    return array.swapaxes(0, 1)[rollout.kept.T]


class Followed:
    """An agent in training; after each update `check` gets the rows flown for it and a rollout."""

    def __init__(
        self, agent: Any, env: Scripted, log: Any, weights: Callable[[Rollout], np.ndarray]
    ) -> None:
        self.agent = agent
        self.env = env
        self.log = log
        self.updates = 0
        self._weights = weights
        self._learn = agent.update
        self._taken: list[tuple[Rollout, np.ndarray]] = []
        self._known = [0] * env.num_envs
        agent.update = self._update

    def train(self, total: int, expected: Callable[[list[list[Row]]], Any]) -> None:
        def check() -> bool:
            flown = [rows[n:] for rows, n in zip(self.env.flown, self._known, strict=True)]
            self._known = [len(rows) for rows in self.env.flown]
            assert self.log.env_steps == sum(self._known)
            kept, wanted = expected(flown)
            if self._taken:
                ((rollout, weights),) = self._taken
                self._check(rollout, weights, kept, wanted)
                self._taken.clear()
                self.updates += 1
            else:
                assert kept == []
            return True

        self.agent.train(self.log, total, check)

    def _update(self, rollout: Rollout) -> None:
        self._taken.append((rollout, self._weights(rollout)))
        self._learn(rollout)

    def _check(
        self, rollout: Rollout, weights: np.ndarray, kept: list[Row], wanted: np.ndarray
    ) -> None:
        found = by_drone(rollout, rollout.observations)
        seen = np.array([row.observation for row in kept])
        assert found.tobytes() == seen.tobytes()
        actions = by_drone(rollout, rollout.actions)
        low, high = (0, 2) if self.log.actions.discrete else (-1, 1)
        clipped = np.clip(actions, low, high)
        done = np.array([row.action for row in kept])
        np.testing.assert_array_equal(clipped, done.reshape(actions.shape))
        ours = by_drone(rollout, weights)
        np.testing.assert_allclose(ours, wanted, atol=1e-5)


@pytest.mark.parametrize("discrete", [False, True], ids=["continuous", "discrete"])
@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize(("steps", "gae_lambda"), [(15, 0.0), (14, 0.95), (1, 1.0)])
def test_a2c_learns_from_what_each_drone_flew(
    steps: int, gae_lambda: float, script: Script, discrete: bool
) -> None:
    env = Scripted(script, discrete=discrete)
    log = log_of(env)
    config = A2CConfig(steps_per_update=steps, gae_lambda=gae_lambda, gamma=GAMMA)
    agent = A2C(log, config, 3)
    values: dict[bytes, float] = {}

    def estimates(rollout: Rollout) -> np.ndarray:
        for array in (rollout.observations, rollout.next_observations):
            for seen in array.reshape(-1, 3):
                value = agent._critic.forward(seen[:, np.newaxis])
                values[seen.tobytes()] = value.item()
        return agent.advantages(rollout)[0]

    def value_of(seen: np.ndarray) -> float:
        return values[seen.tobytes()]

    followed = Followed(agent, env, log, estimates)
    followed.train(130, lambda flown: a2c_rows(flown, value_of, gae_lambda))
    assert followed.updates >= 3


@pytest.mark.parametrize("script", SCRIPTS)
@pytest.mark.parametrize("episodes", [1, 4, 7])
def test_vpg_learns_from_the_episodes_that_each_drone_flew(episodes: int, script: Script) -> None:
    env = Scripted(script)
    log = log_of(env)
    config = VPGConfig(episodes_per_update=episodes, gamma=GAMMA)
    agent = VPG(log, config, 3)

    def returns(rollout: Rollout) -> np.ndarray:
        found = np.zeros(rollout.kept.shape)
        found[rollout.kept] = agent.returns(rollout)
        return found

    followed = Followed(agent, env, log, returns)
    followed.train(130, vpg_rows)
    assert followed.updates >= 3


def collector_of(script: Script) -> tuple[Any, Collector]:
    """Reward 1 with every step, whatever is done."""
    log = log_of(Scripted(script, reward=1.0))
    agent: Any = make_agent("a2c", log, A2CConfig(), 0)
    return log, Collector(log, np.random.default_rng(0), agent.policy())


LOST_THIRD: Script = [[(20, "limit")], [(20, "limit")], [(3, "lost"), (20, "limit")]]


@pytest.mark.parametrize("script", [LOST_THIRD, LOST_THIRD[2:]], ids=["many", "one"])
def test_a_lost_simulator_teaches_nothing(script: Script) -> None:
    """A reward of 1 for ever, gamma 0.98: V = 50, and no action is better than another."""
    log, collector = collector_of(script)
    config: Any = VPGConfig(gamma=0.98, baseline="time", normalize=True, episodes_per_update=3)
    rollout = collector.episodes(len(script), 1000)
    assert len(rollout) == 20 * max(1, len(script) - 1)
    assert log.env_steps == len(rollout) + 3
    np.testing.assert_allclose(VPG(log, config, 0).returns(rollout), 0, atol=1e-6)

    log, collector = collector_of(script)
    agent: Any = A2C(log, A2CConfig(gamma=0.98, gae_lambda=0.98), 0)
    arrays, _ = arrays_of(agent)
    arrays["critic.layers.1.weight"][:] = 0
    arrays["critic.layers.1.weight"][:, 0] = 50
    rollout = collector.steps(10 * len(script))
    left = rollout.rows(agent.advantages(rollout)[0])
    np.testing.assert_allclose(left, 0, atol=1e-4)
    assert log.env_steps == 10 * len(script) - (len(script) > 1)  # of many, one begins instead
    assert len(rollout) == log.env_steps - 1
    assert rollout.truncated[:4, -1].tolist() == [False, True, True, False]
    assert rollout.kept[:4, -1].tolist() == [True, True, False, len(script) == 1]


def test_an_end_before_a_loss_stays_what_it_was() -> None:
    _, collector = collector_of([[(2, "end"), (1, "lost"), (20, "limit")]])
    rollout = collector.steps(6)
    assert rollout.rows(rollout.terminated).tolist() == [False, True, False, False, False]
    assert not rollout.rows(rollout.truncated).any()


def test_lost_steps_count_as_flown() -> None:
    """A round of 20, 20 and 3 steps, and the second breaks off after 6 more."""
    log, collector = collector_of(LOST_THIRD)
    assert len(collector.episodes(6, 49)) == 40
    assert log.env_steps == 49


def test_parts_of_episodes_teach_nothing() -> None:
    """Two drones, two rounds of 20 steps, and 42 left to fly: the second round breaks off."""
    log, collector = collector_of([[(20, "limit")]] * 2)
    rollout = collector.episodes(4, 42)
    assert len(rollout) == 40
    assert log.env_steps == 42
    config: Any = VPGConfig(gamma=0.98, baseline="time", normalize=True, episodes_per_update=4)
    np.testing.assert_allclose(VPG(log, config, 0).returns(rollout), 0, atol=1e-6)
    log, collector = collector_of([[(20, "limit")]] * 2)
    assert len(collector.episodes(2, 38)) == 0
    assert log.env_steps == 38
