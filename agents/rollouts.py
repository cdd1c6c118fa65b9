"""Collecting experience: a policy flies, and every transition is kept."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import gymnasium as gym
import numpy as np

from ..udp import LOST
from .policies import NetworkPolicy
from .vector_episodes import VectorEpisodeLog

__all__ = ["AnyCollector", "Collector", "Rollout", "VectorCollector"]


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """T transitions in the order in which they were flown; of many drones, one after the other."""

    observations: np.ndarray
    """float32, shape (T, n)."""
    actions: np.ndarray
    """As drawn, not clipped: float32, shape (T, k); (T, 1) if discrete."""
    rewards: np.ndarray
    """float64, shape (T,)."""
    next_observations: np.ndarray
    """What each step led to, before any reset: float32, shape (T, n)."""
    terminated: np.ndarray
    """bool, shape (T,)."""
    truncated: np.ndarray
    """bool, shape (T,)."""

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def ends(self) -> np.ndarray:
        """Whether an episode ended with the step: bool, shape (T,)."""
        ends: np.ndarray = self.terminated | self.truncated
        return ends

    def without_steps(self, lost: np.ndarray) -> "Rollout":
        """Without the steps whose simulator was lost: their rewards and observations are made up.

        The episode stops one step earlier: a value is carried over that, as over a truncation.

        Args:
            lost: bool, shape (T,).
        """
        if not lost.any():
            return self
        last = np.append(lost[1:], False) & ~self.ends
        return replace(self, truncated=self.truncated | last)._only(~lost)

    def without_episodes(self, lost: np.ndarray) -> "Rollout":
        """Without the episodes that end with such a step: the return of what was flown is unknown.

        Args:
            lost: bool, shape (T,).
        """
        if not lost.any():
            return self
        number = np.cumsum(self.ends) - self.ends
        return self._only(~np.isin(number, number[lost]))

    def _only(self, kept: np.ndarray) -> "Rollout":
        return Rollout(**{name: column[kept] for name, column in vars(self).items()})


class Collector:
    """Flies a policy on an env, episode after episode, across calls.

    Args:
        env: The env.
        rng: Draws the actions.
        observation: What the policy sees next, where the env stands in an episode already.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        rng: np.random.Generator,
        observation: np.ndarray | None = None,
    ) -> None:
        self._env = env
        self._rng = rng
        self.observation = observation

    def steps(self, policy: NetworkPolicy, count: int) -> Rollout:
        """So many transitions; the last episode goes on in the next call.

        Steps whose simulator was lost are flown, and left out.
        """
        rollout, lost = self._collect(policy, count, lambda steps, _: steps == count)
        return rollout.without_steps(lost)

    def episodes(self, policy: NetworkPolicy, count: int, most_steps: int) -> Rollout:
        """So many whole episodes; the last is broken off where `most_steps` are flown before.

        Those whose simulator was lost are left out, and not counted.
        """
        rollout, lost = self._collect(
            policy, 256, lambda steps, ended: ended == count or steps == most_steps
        )
        return rollout.without_episodes(lost)

    def _collect(
        self, policy: NetworkPolicy, block: int, enough: Callable[[int, int], bool]
    ) -> tuple[Rollout, np.ndarray]:
        """What is flown until it is enough, and with which steps a simulator was lost."""
        env, rows, ended = self._env, _Rows(), 0
        observation = self.observation
        if observation is None:
            observation, _ = env.reset()
        while True:
            for noise in policy.draw_noise(self._rng, block):
                action = policy.sample(observation, noise)
                after, reward, terminated, truncated, info = env.step(policy.to_env(action))
                lost = LOST in info
                row = observation, action, float(reward), after, terminated, truncated, lost
                rows.append(row)
                observation = after
                if terminated or truncated:
                    ended += not lost
                    observation, _ = env.reset()
                if enough(len(rows), ended):
                    self.observation = observation
                    return rows.rollout()


class _Rows(list[tuple[np.ndarray, np.ndarray, float, np.ndarray, bool, bool, bool]]):
    def rollout(self) -> tuple[Rollout, np.ndarray]:
        observations, actions, rewards, after, terminated, truncated, lost = zip(*self, strict=True)
        rollout = Rollout(
            observations=np.array(observations),
            actions=np.array(actions),
            rewards=np.array(rewards, np.float64),
            next_observations=np.array(after),
            terminated=np.array(terminated, bool),
            truncated=np.array(truncated, bool),
        )
        return rollout, np.array(lost, bool)


_COLUMNS = tuple(field.name for field in fields(Rollout))


class VectorCollector:
    """`Collector` for many drones. Its rollouts are drone by drone.

    The rows of a rollout are kept in buffers that the next rollout of the same size writes anew.

    Args:
        log: The vector env.
        rng: Draws the actions.
        observation: What the policy sees next, where the env stands in episodes already: shape
            (N, n).
    """

    def __init__(
        self,
        log: VectorEpisodeLog,
        rng: np.random.Generator,
        observation: np.ndarray | None = None,
    ) -> None:
        self._log = log
        self._rng = rng
        self.observation = observation
        self._buffers: _Buffers | None = None

    def steps(self, policy: NetworkPolicy, count: int) -> Rollout:
        """Whole steps of all drones, as many as so many transitions need.

        Whose episode has ended begins the next in place of a step, so that there are fewer
        transitions by as many. Where a drone's last episode goes on, its last transition counts as
        truncated: a value is carried over it, and nothing of the next drone. Steps whose simulator
        was lost are left out.
        """
        log, drones = self._log, self._log.num_envs
        length = -(-count // drones)
        rows = self._rows(policy, length)
        observation, over = self._start(), np.zeros(drones, bool)
        flown, lost = np.empty((drones, length), bool), np.empty((drones, length), bool)
        noise = policy.draw_noise(self._rng, length * drones).reshape(length, drones, -1)
        for step in range(length):
            flown[:, step] = ~over
            actions = policy.samples(observation, noise[step])
            after, *results, _ = log.fly(policy.to_envs(actions), begins=over)
            rewards, terminated, truncated = results
            lost[:, step] = log.env.lost
            rows.put(step, observation, actions, rewards, after, terminated, truncated)
            observation, over = after, terminated | truncated
        self.observation = log.begin(over)[0] if over.any() else observation
        rows.truncated[:, -1] |= ~rows.terminated[:, -1]
        return rows.rollout(flown).without_steps(lost[flown])

    def episodes(self, policy: NetworkPolicy, count: int, most_steps: int) -> Rollout:
        """Whole episodes, as many as there are drones or a multiple: at least so many.

        Whose episode ends first holds until all have ended. Where `most_steps` are flown before,
        that round is left out: all of its episodes but the shortest would be parts. Those whose
        simulator was lost are left out too. A single drone's last part is kept, as by `Collector`.
        """
        log, rounds = self._log, -(-count // self._log.num_envs)
        last = log.env_steps + most_steps
        flown: list[Rollout] = []
        while len(flown) < rounds and log.env_steps < last:
            flown.append(self._fly_round(policy, last - log.env_steps))
        return _joined(flown)

    def _fly_round(self, policy: NetworkPolicy, most_steps: int) -> Rollout:
        """An episode of each drone."""
        log = self._log
        observation = self._start()
        done, kept, steps = np.zeros(log.num_envs, bool), [], 0
        while not done.all() and steps < most_steps:
            noise = policy.draw_noise(self._rng, log.num_envs)
            actions = policy.samples(observation, noise)
            after, rewards, terminated, truncated, _ = log.fly(policy.to_envs(actions), done)
            lost = log.env.lost.copy()
            kept.append((observation, actions, rewards, after, terminated, truncated, ~done, lost))
            steps += int((~done).sum())
            done = done | terminated | truncated
            observation = after
        self.observation = log.begin(done)[0] if done.all() else observation
        columns = [np.stack(column, axis=1) for column in zip(*kept, strict=True)]
        losses, flown = columns.pop(), columns.pop()
        if not done.all() and log.num_envs > 1:
            flown[:] = False
        rollout = Rollout(**{n: c[flown] for n, c in zip(_COLUMNS, columns, strict=True)})
        return rollout.without_episodes(losses[flown])

    def _start(self) -> np.ndarray:
        if self.observation is None:
            self.observation, _ = self._log.reset()
        return self.observation

    def _rows(self, policy: NetworkPolicy, length: int) -> "_Buffers":
        if self._buffers is None or self._buffers.rewards.shape[1] != length:
            drones = self._log.num_envs
            self._buffers = _Buffers(drones, length, policy.observation_size, policy.action_size)
        return self._buffers


AnyCollector = Collector | VectorCollector


class _Buffers:
    """Transitions of N drones, (N, T, …): drone by drone without a copy."""

    def __init__(self, drones: int, length: int, observation_size: int, action_size: int) -> None:
        shape = drones, length
        self.observations = np.empty((*shape, observation_size), np.float32)
        self.actions = np.empty((*shape, action_size), np.float32)
        self.rewards = np.empty(shape)
        self.next_observations = np.empty((*shape, observation_size), np.float32)
        self.terminated, self.truncated = np.empty(shape, bool), np.empty(shape, bool)

    def put(self, step: int, *values: np.ndarray) -> None:
        for column, value in zip(vars(self).values(), values, strict=True):
            column[:, step] = value

    def rollout(self, flown: np.ndarray) -> Rollout:
        if flown.all():
            return Rollout(**{k: v.reshape(-1, *v.shape[2:]) for k, v in vars(self).items()})
        return Rollout(**{k: v[flown] for k, v in vars(self).items()})


def _joined(rollouts: list[Rollout]) -> Rollout:
    if len(rollouts) == 1:
        return rollouts[0]
    return Rollout(
        **{k: np.concatenate([getattr(r, k) for r in rollouts]) for k in vars(rollouts[0])}
    )
