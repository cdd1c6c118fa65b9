"""Vector envs that the agents' tests train in."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from rotorgram.agents import EpisodeRecorder
from rotorgram.agents.rollouts import Rollout
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.autoreset import AdvancingVectorEnv
from rotorgram.envs.spec import ArraySpec, EnvSpec
from scripted import spec_of

ENV = "rotorgram/Elevation-v0"
OPTIONS: dict[str, Any] = {"episode_length": 30, "start_band": 0.3, "flight_band": 0.4}
"""Short episodes, some of which crash."""
ONE = ArraySpec(name="action", shape=(1,), low=-1.0, high=1.0)
LINE = spec_of(ONE, [ArraySpec(name="observation", shape=(1,), low=-1.0, high=1.0)])


_CASES = Path(__file__).parents[1] / "data" / "agents.json"


def cases(name: str) -> Any:
    """A table of inputs and of what is expected of them."""
    return json.loads(_CASES.read_text(encoding="utf-8"))[name]


def rollout(name: str = "three steps", **changes: np.ndarray) -> Rollout:
    """Steps of one drone, of a table of such a name, with other columns by name.

    Unless they are given, outputs are the actions, as of a policy without noise.
    """
    table = {key: np.array(column, np.float32) for key, column in cases("rollouts")[name].items()}
    never = np.zeros(len(table["rewards"]), bool)
    flags = {"truncated": never, "kept": ~never, "terminated": table.pop("terminated") == 1}
    rewards = table.pop("rewards").astype(float)
    state = np.zeros(0, np.float32)
    columns = {"state": state, **table, **flags, "rewards": rewards, **changes}
    columns.setdefault("outputs", columns["actions"])
    return Rollout(**{key: column[:, np.newaxis] for key, column in columns.items()})


def vector(drones: int = 1, mode: str = "Disabled", **options: Any) -> LocalVectorEnv:
    return LocalVectorEnv(ENV, drones, autoreset_mode=mode, **options)


class Constant(AdvancingVectorEnv):
    """One drone with reward 1 at every step, whatever is done; its episodes have 8 steps."""

    def __init__(self, ending: str = "end", spec: EnvSpec = LINE) -> None:
        self.closed = False
        self._take_spec(spec, 1, AutoresetMode.DISABLED)
        self._ending = ending
        self._steps = 0
        self.flown: list[float] = []
        self.observations = np.zeros((1, 1), np.float32)
        self.telemetry = {"metrics": np.full((1, 1), 0.5)}
        self.lost = np.zeros(1, bool)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.advance(None, np.ones(1, bool))
        return self.observations, {}

    def advance(
        self, actions: Any, resets: Any = None, seeds: Any = None, frozen: Any = None
    ) -> None:
        begins = resets is not None and resets[0]
        if begins:
            self._steps = 0
        else:
            self._steps += 1
            self.flown.append(float(actions[0, 0]))
        over = self._steps == 8
        self.rewards = np.array([0.0 if begins else 1.0])
        self.terminated = np.array([over and self._ending == "end"])
        self.truncated = np.array([over and self._ending == "limit"])


class Kept(LocalVectorEnv):
    """One drone that keeps what every step returned."""

    def __init__(self, **options: Any) -> None:
        super().__init__(ENV, autoreset_mode="Disabled", **options)
        self.results: list[Any] = []

    def advance(self, actions: Any, resets: Any = None, *rest: Any) -> None:
        super().advance(actions, resets, *rest)
        if resets is None:
            numbers = self.rewards[0], self.terminated[0], self.truncated[0]
            self.results.append((self.observations[0], *numbers))


def infos_of(env: Any, policy: Any, seed: int = 0) -> list[dict[str, Any]]:
    """The info of each step of an episode, which no event ends."""
    policy.reset()
    observation, _ = env.reset(seed=seed)
    infos = []
    truncated = False
    while not truncated:
        observation, _, terminated, truncated, info = env.step(policy.act(observation))
        infos.append(info)
        assert not terminated
    return infos


def log_of(ending: str = "end") -> EpisodeRecorder:
    return EpisodeRecorder(Constant(ending), seed=0)
