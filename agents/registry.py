"""Every algorithm and every controller: one row each.

To add an algorithm, write its config and its class in a module of its own, and add a row here. Its
presets, if it has any, are in `presets.toml`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

import numpy as np

from ..models.errors import InputError
from .a2c import A2C, A2CConfig
from .config import Config
from .episodes import EpisodeRecorder
from .geometric import Geometric
from .learner import OnUpdate
from .mappo import MAPPO
from .orca import Orca
from .pid import PID
from .ppo import PPO, PPOConfig
from .sac import SAC, SACConfig
from .vpg import VPG, VPGConfig

if TYPE_CHECKING:
    from .checkpoints import Checkpoint
    from .policies import NetworkPolicy


class Agent(Protocol):
    """What learns, made of `(log, config, seed)`; SB3's has no `set_state`."""

    def train(self, log: EpisodeRecorder, env_steps: int, on_update: OnUpdate) -> None:
        """Train until the log counts `env_steps`, from the current state on. Raises `Diverged`."""

    def actor(self) -> dict[str, np.ndarray]:
        """Weights of the policy, as a checkpoint has them: copies."""

    def policy(self) -> "NetworkPolicy":
        """The current policy, without exploration: a copy."""

    def state(self) -> dict[str, np.ndarray]:
        """All that the next update depends on, if it resumes; at least all weights."""

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over a state. Raises `ValueError` or `KeyError` unless it is whole."""

    def start_from(self, kept: "Checkpoint") -> None:
        """Take over networks. Raises `ValueError` or `KeyError` unless they fit."""

    def scalars(self) -> dict[str, float]:
        """Numbers of the last update by SB3's names; none before the first."""


Colors = tuple[str, str]
"""Of an agent in figures, on a light and on a dark ground."""


@dataclass(frozen=True)
class Algorithm:
    """A row of the registry."""

    label: str
    """Name in tables and figures."""
    config: type[Config]
    agent: Any
    """Class; or its module and name, which are imported when needed."""
    presets: str = ""
    """Algorithm with the same presets; empty: its own."""
    family: str = ""
    """Algorithms of one family begin with each other's networks; empty: with their own alone."""
    resumes: bool = True
    """Whether a stopped training goes on; otherwise it starts anew."""
    colors: Colors | None = None

    def agent_class(self) -> Any:
        """The class. Raises `MissingPackage`."""
        if not isinstance(self.agent, str):
            return self.agent
        module, _, name = self.agent.partition(":")
        return getattr(import_module(module, __package__), name)


_SB3: Final = ".sb3:SB3Agent"

# The references have the presets of ours: only the implementation differs.
ALGORITHMS: Final[dict[str, Algorithm]] = {
    "vpg": Algorithm("VPG", VPGConfig, VPG, family="own", colors=("#D55E00", "#F58A3C")),
    "a2c": Algorithm("A2C", A2CConfig, A2C, family="own", colors=("#0072B2", "#55B0F0")),
    "ppo": Algorithm("PPO", PPOConfig, PPO, family="own"),
    "ippo": Algorithm("IPPO", PPOConfig, PPO, family="own"),
    "mappo": Algorithm("MAPPO", PPOConfig, MAPPO, family="own"),
    "sac": Algorithm("SAC", SACConfig, SAC),
    "sb3-a2c": Algorithm(
        "SB3 A2C", A2CConfig, _SB3, "a2c", resumes=False, colors=("#009E73", "#2CC998")
    ),
    "sb3-ppo": Algorithm("SB3 PPO", PPOConfig, _SB3, "ppo", resumes=False),
    "sb3-sac": Algorithm("SB3 SAC", SACConfig, _SB3, "sac", resumes=False),
}

Controller = PID | Geometric | Orca
CONTROLLERS: Final[Mapping[str, type[Controller]]] = {
    "pid": PID,
    "geometric": Geometric,
    "orca": Orca,
}
"""Agents that need no training, made of an env's spec."""

if TYPE_CHECKING:
    AlgorithmName = str
else:
    AlgorithmName = Literal[tuple(ALGORITHMS)]


def find_algorithm(name: str) -> Algorithm:
    """The row of an algorithm. Raises `InputError` if there is none."""
    if name not in ALGORITHMS:
        raise InputError(f"algorithm: expected one of {', '.join(ALGORITHMS)}, got {name!r}")
    return ALGORITHMS[name]
