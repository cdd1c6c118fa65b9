"""Updates with many drones, worked out again in plain NumPy: own gradients, own Adam.

Scripted drones keep what they flew: the numbers come from there, and the first weights from the
agent. Nothing of the rollouts, the returns or the networks is used.
"""

from collections.abc import Callable
from itertools import zip_longest
from typing import Any

import numpy as np
import pytest
from rotorgram.agents import A2CConfig, VPGConfig, make_agent
from rotorgram.agents.a2c import A2C
from rotorgram.agents.rollouts import Collector, Rollout
from rotorgram.agents.vpg import VPG
from scripted import CALM, LOSSES, Row, Script, Scripted, log_of

GAMMA = 0.9
RATE = 0.01
VF_COEF = 0.7


# ---- arithmetic


class Net:
    """One hidden layer of ReLU units in float64, with its gradient and its Adam."""

    def __init__(self, weights: dict[str, np.ndarray]) -> None:
        self.weights = {name: array.astype(np.float64) for name, array in weights.items()}
        self._first = {name: np.zeros_like(array) for name, array in self.weights.items()}
        self._second = {name: np.zeros_like(array) for name, array in self.weights.items()}
        self._updates = 0

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        output: np.ndarray = self._hidden(inputs) @ self.weights["layers.1.weight"].T
        return output + self.weights["layers.1.bias"]

    def gradient(self, inputs: np.ndarray, slope: np.ndarray) -> dict[str, np.ndarray]:
        """Of a loss whose derivative by the outputs is `slope`, shape (T, k)."""
        hidden = self._hidden(inputs)
        inner = slope @ self.weights["layers.1.weight"] * (hidden > 0)
        return {
            "layers.1.weight": slope.T @ hidden,
            "layers.1.bias": slope.sum(0),
            "layers.0.weight": inner.T @ inputs,
            "layers.0.bias": inner.sum(0),
        }

    def adam(self, gradient: dict[str, np.ndarray], rate: float) -> None:
        self._updates += 1
        for name, slope in gradient.items():
            first = self._first[name]
            second = self._second[name]
            first += 0.1 * (slope - first)
            second += 0.001 * (slope**2 - second)
            scale = np.sqrt(second / (1 - 0.999**self._updates)) + 1e-8
            self.weights[name] -= rate * first / (1 - 0.9**self._updates) / scale

    def _hidden(self, inputs: np.ndarray) -> np.ndarray:
        weights = self.weights
        hidden: np.ndarray = inputs @ weights["layers.0.weight"].T + weights["layers.0.bias"]
        return np.maximum(hidden, 0)


def policy_gradient(
    actor: Net, seen: np.ndarray, actions: np.ndarray, weights: np.ndarray, entropy: float
) -> dict[str, np.ndarray]:
    """Of minus the mean of weight · log P, and of minus the weighted mean entropy."""
    output = actor(seen)
    column = weights[:, np.newaxis]
    if "log_std" not in actor.weights:
        shares = np.exp(output) / np.exp(output).sum(1, keepdims=True)
        chosen = np.eye(3)[actions[:, 0].astype(int)]
        surprise = -(shares * np.log(shares)).sum(1, keepdims=True)
        slope = column * (chosen - shares) - entropy * shares * (np.log(shares) + surprise)
        return actor.gradient(seen, -slope / len(seen))
    std = np.exp(actor.weights["log_std"])
    noise = (actions - output) / std
    gradient = actor.gradient(seen, -column * noise / std / len(seen))
    gradient["log_std"] = -(column * (noise**2 - 1)).mean(0) - entropy
    return gradient


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


def vpg_rows(flown: list[list[Row]]) -> tuple[list[Row], np.ndarray, np.ndarray]:
    """Rows to learn from, their returns, and the number of each within its episode.

    With many drones only rounds count that every drone has flown to an end, and of them only
    episodes without a loss; with one drone all that are without a loss.
    """
    parts = [
        [[row for row in rows if row.episode == number]
         for number in sorted({row.episode for row in rows})]
        for rows in flown
    ]  # fmt: skip
    found: list[list[tuple[Row, float, int]]] = [[] for _ in flown]
    for round_ in zip_longest(*parts, fillvalue=[]):
        if len(flown) > 1 and not all(rows and rows[-1].ends for rows in round_):
            continue
        for drone, rows in enumerate(round_):
            if not rows[-1].lost:
                found[drone] += [
                    (rows[t], sum(GAMMA**k * row.reward for k, row in enumerate(rows[t:])), t)
                    for t in range(len(rows))
                ]
    kept = [entry for entries in found for entry in entries]
    return (
        [r for r, _, _ in kept],
        np.array([x for _, x, _ in kept]),
        np.array([t for *_, t in kept]),
    )


# ---- updates


def by_drone(rollout: Rollout) -> tuple[np.ndarray, np.ndarray]:
    """What is kept of a rollout: observations and actions, one drone after the other."""
    kept = rollout.kept.T
    seen, done = (array.swapaxes(0, 1)[kept] for array in (rollout.observations, rollout.actions))
    return seen, done


class Followed:
    """An agent in training, and beside it the same by hand."""

    def __init__(self, algorithm: str, config: Any, env: Scripted, total: int) -> None:
        self.env = env
        self.log = log_of(env)
        self.total = total
        self.config = config
        self.agent: Any = make_agent(algorithm, self.log, config, 3)
        self.actor = Net(self.agent.actor())
        self.critic = Net(self._critic())
        self.updates = self.left_out = 0
        self.noise: list[np.ndarray] = []
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []
        self._known = [0] * env.num_envs
        self._catch()

    def train(self) -> None:
        self.agent.train(self.log, self.total, self._follow)

    def _critic(self) -> dict[str, np.ndarray]:
        if isinstance(self.agent, VPG):
            return {}
        if isinstance(self.agent, A2C):
            return self.agent.weights.part("critic.").arrays
        weights = self.agent.state()
        names = {"layers.0": "mlp_extractor.value_net.0", "layers.1": "value_net"}
        return {f"{ours}.{kind}": weights[f"policy.{theirs}.{kind}"]
                for ours, theirs in names.items() for kind in ("weight", "bias")}  # fmt: skip

    def _catch(self) -> None:
        """Keep what the agent learns from, drone by drone: what was seen, and done unclipped."""
        if isinstance(self.agent, VPG | A2C):
            update = self.agent.update
            self.agent.update = lambda rollout: (  # type: ignore[method-assign]
                self._seen.append(by_drone(rollout)),
                update(rollout),
            )[1]
            return
        buffer = self.agent.model.rollout_buffer
        prepare = buffer.compute_returns_and_advantage

        def prepare_and_keep(*args: Any, **kwargs: Any) -> None:
            columns = (np.swapaxes(c, 0, 1) for c in (buffer.observations, buffer.actions))
            seen, done = (c.reshape(-1, c.shape[-1]).copy() for c in columns)
            self._seen.append((seen, done))
            prepare(*args, **kwargs)

        buffer.compute_returns_and_advantage = prepare_and_keep

    def _follow(self) -> bool:
        before = sum(self._known)
        flown = [rows[known:] for rows, known in zip(self.env.flown, self._known, strict=True)]
        self._known = [len(rows) for rows in self.env.flown]
        assert self.log.env_steps == sum(self._known)
        whole = self.total
        if not isinstance(self.agent, VPG | A2C):  # SB3 flies whole rollouts only
            whole -= whole % (self.agent.model.n_steps * self.agent.model.n_envs)
        update = self._vpg if isinstance(self.agent, VPG) else self._a2c
        update(flown, RATE * (1 - before / whole))
        pairs = [(self.actor, self.agent.actor()), (self.critic, self._critic())]
        # Where a gradient cancels to 1e-9, it is rounding, and Adam divides it by its own size.
        for net, weights in pairs:
            for name, array in weights.items():
                np.testing.assert_allclose(array, net.weights[name], atol=5e-5, err_msg=name)
        return True

    def _a2c(self, flown: list[list[Row]], rate: float) -> None:
        config = self.config
        value = lambda seen: float(self.critic(seen[np.newaxis].astype(float))[0, 0])  # noqa: E731
        kept, advantages = a2c_rows(flown, value, config.gae_lambda)
        self.left_out += sum(map(len, flown)) - len(kept)
        if not kept:
            assert not self._seen
            return
        seen, actions = self._taken(kept)
        targets = advantages + self.critic(seen)[:, 0]
        if config.normalize and len(kept) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std(ddof=1) + 1e-8)
        gradient = policy_gradient(self.actor, seen, actions, advantages, config.ent_coef)
        self.actor.adam(gradient, rate)
        errors = self.critic(seen) - targets[:, np.newaxis]
        slope = 2 * VF_COEF * errors / len(seen)
        self.critic.adam(self.critic.gradient(seen, slope), rate)

    def _vpg(self, flown: list[list[Row]], rate: float) -> None:
        kept, weights, steps = vpg_rows(flown)
        self.left_out += sum(map(len, flown)) - len(kept)
        if not kept:
            assert not self._seen
            return
        if self.config.baseline == "time":
            means = [weights[steps == step].mean() for step in range(steps.max() + 1)]
            weights -= np.take(means, steps)
        if self.config.normalize:
            weights /= weights.std() + 1e-8
        seen, actions = self._taken(kept)
        self.actor.adam(policy_gradient(self.actor, seen, actions, weights, 0.0), rate)

    def _taken(self, kept: list[Row]) -> tuple[np.ndarray, np.ndarray]:
        """What the agent has learnt from, which has to be these rows."""
        ((seen, actions),) = self._seen
        self._seen.clear()
        self.updates += 1
        assert seen.tobytes() == np.array([row.observation for row in kept]).tobytes()
        done = np.array([row.action for row in kept])
        seen = seen.astype(float)
        if "log_std" in self.actor.weights:
            self.noise.append((actions - self.actor(seen)) / np.exp(self.actor.weights["log_std"]))
        low, high = (-1, 1) if "log_std" in self.actor.weights else (0, 2)
        np.testing.assert_array_equal(np.clip(actions, low, high), done.reshape(actions.shape))
        return seen, actions.astype(float)


A2C_SETTINGS = [
    {"steps_per_update": 15},
    {"steps_per_update": 14, "gae_lambda": 0.95, "normalize": True, "ent_coef": 0.01},
    {"steps_per_update": 1, "gae_lambda": 1.0, "ent_coef": 0.1},
]
VPG_SETTINGS = [
    {"episodes_per_update": 1},
    {"episodes_per_update": 4, "baseline": "time", "normalize": True},
    {"episodes_per_update": 7, "baseline": "time"},
]


# SB3 learns from lost steps too; tests/agents/test_learning.py compares it with ours for one drone.
CASES = [
    *(("a2c", changes, script)
      for changes in A2C_SETTINGS for script in (CALM, CALM[:1], LOSSES, LOSSES[:1])),
    *(("vpg", changes, script)
      for changes in VPG_SETTINGS for script in (CALM, CALM[:1], LOSSES, LOSSES[:1])),
    *(("sb3-a2c", changes, CALM) for changes in A2C_SETTINGS),
]  # fmt: skip


@pytest.mark.parametrize("discrete", [False, True], ids=["continuous", "discrete"])
@pytest.mark.parametrize(("algorithm", "changes", "script"), CASES)
def test_updates_are_those_by_hand(
    algorithm: str, changes: dict[str, Any], script: Script, discrete: bool
) -> None:
    losses = script[0] is LOSSES[0]
    many = len(script) > 1
    settings = {**changes, "gamma": GAMMA, "learning_rate": RATE, "anneal": True, "log_std": 0.0}
    config: Any = (
        VPGConfig(**settings) if algorithm == "vpg" else A2CConfig(vf_coef=VF_COEF, **settings)
    )
    total = 130 if many else 60
    followed = Followed(algorithm, config, Scripted(script, discrete=discrete), total)
    followed.train()
    assert total - 15 < followed.log.env_steps < total + len(script)
    assert followed.updates >= 3
    cut = algorithm == "vpg" and many
    assert (followed.left_out > 0) == (losses or cut)
    if not discrete:
        noise = np.concatenate(followed.noise)
        assert len(np.unique(noise.round(4))) > 0.98 * noise.size, "each drone has its own"
        assert abs(noise).max() > 2


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
    np.testing.assert_allclose(VPG.create(log, config, 0).returns(rollout), 0, atol=1e-6)

    log, collector = collector_of(script)
    agent: Any = A2C.create(log, A2CConfig(gamma=0.98, gae_lambda=0.98), 0)
    agent.weights.arrays["critic.layers.1.weight"][:] = 0
    agent.weights.arrays["critic.layers.1.bias"][:] = 50
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
    np.testing.assert_allclose(VPG.create(log, config, 0).returns(rollout), 0, atol=1e-6)
    log, collector = collector_of([[(20, "limit")]] * 2)
    assert len(collector.episodes(2, 38)) == 0
    assert log.env_steps == 38
