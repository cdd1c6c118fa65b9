"""Drones that fly a script, which says when each episode ends and how; all else is random."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from rotorgram.agents.episodes import EpisodeRecorder
from rotorgram.envs.autoreset import AdvancingVectorEnv
from rotorgram.envs.spec import ArraySpec, Discrete, EnvSpec, Metric

Script = Sequence[Sequence[tuple[int, str]]]
"""Of each drone, length and end of its episodes, over and over."""

CALM: Script = [
    [(3, "end"), (5, "limit"), (1, "end"), (2, "both")],
    [(4, "limit"), (1, "limit"), (6, "end")],
    [(7, "end"), (2, "limit")],
]
LOSSES: Script = [
    [(3, "end"), (5, "lost"), (1, "end"), (2, "both"), (1, "lost")],
    [(4, "lost"), (1, "limit"), (6, "end")],
    [(7, "end"), (2, "limit"), (6, "lost"), (3, "lost")],
]


def spec_of(
    action: ArraySpec | Discrete | None = None,
    observation: Sequence[ArraySpec] = (ArraySpec(name="observation", shape=(3,)),),
) -> EnvSpec:
    """Of an env with the metric `distance`."""
    return EnvSpec(
        env_id="test/Scripted-v0",
        control_period=0.02,
        observation=tuple(observation),
        action=action or ArraySpec(name="action", shape=(2,), low=-1.0, high=1.0),
        telemetry=(ArraySpec(name="metrics", shape=(1,), components=("distance",)),),
        metrics=(Metric(name="distance", unit="m"),),
    )


@dataclass(frozen=True, kw_only=True)
class Row:
    """A step as it was flown."""

    episode: int
    observation: np.ndarray
    action: np.ndarray
    reward: float
    after: np.ndarray
    terminated: bool
    truncated: bool
    lost: bool

    @property
    def ends(self) -> bool:
        return self.terminated or self.truncated


class Scripted(AdvancingVectorEnv):
    """Flies a script; a lost simulator as `RemoteVectorEnv` reports it."""

    def __init__(self, script: Script, *, discrete: bool = False, reward: float | None = None):
        self.closed = False
        self.num_envs = 0
        self._script = script
        self._reward = reward
        self._take_spec(
            spec_of(Discrete(choices=3) if discrete else None), len(script), AutoresetMode.DISABLED
        )
        self.flown: list[list[Row]] = [[] for _ in script]
        self._episodes = [-1] * len(script)
        self._steps = [0] * len(script)
        self._dice = np.random.default_rng(42)
        self.observations = np.zeros((len(script), 3), np.float32)
        self._clear()

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.advance(None, np.ones(self.num_envs, bool))
        return self.observations.copy(), {}

    def advance(
        self, actions: Any, resets: Any = None, seeds: Any = None, frozen: Any = None
    ) -> None:
        self.observations = self.observations.copy()
        self._clear()
        for drone in range(self.num_envs):
            if resets is not None and resets[drone]:
                self._episodes[drone] += 1
                self._steps[drone] = 0
                self.observations[drone] = self._dice.normal(size=3)
            elif frozen is None or not frozen[drone]:
                self._fly(drone, actions[drone])
        self.telemetry = {"metrics": self.observations[:, :1].astype(float)}

    def _clear(self) -> None:
        self.rewards = np.zeros(self.num_envs)
        self.terminated, self.truncated, self.lost = np.zeros((3, self.num_envs), bool)

    def _fly(self, drone: int, action: np.ndarray) -> None:
        episodes = self._script[drone]
        self._steps[drone] = self._steps[drone] + 1
        length, end = episodes[self._episodes[drone] % len(episodes)]
        assert self._steps[drone] <= length, "flown after its end"
        if self._steps[drone] < length:
            end = "none"
        before = self.observations[drone].copy()
        self.terminated[drone] = end in ("end", "both")
        self.truncated[drone] = end in ("limit", "both", "lost")
        self.lost[drone] = end == "lost"
        if end != "lost":
            self.observations[drone] = self._dice.normal(size=3)
            # Other rewards for each drone: they are not to be mistaken for each other.
            random = self._dice.normal() + 5 * drone
            self.rewards[drone] = random if self._reward is None else self._reward
        row = Row(
            episode=self._episodes[drone],
            observation=before,
            action=np.array(action),
            reward=self.rewards[drone],
            after=self.observations[drone].copy(),
            terminated=bool(self.terminated[drone]),
            truncated=bool(self.truncated[drone]),
            lost=bool(self.lost[drone]),
        )
        self.flown[drone].append(row)


def log_of(env: Scripted) -> EpisodeRecorder:
    return EpisodeRecorder(env, 7)
