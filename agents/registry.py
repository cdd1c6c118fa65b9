"""Every algorithm and every controller: one row each.

To add an algorithm, write its config and its class in a module of its own, and add a row here. Its
presets, if it has any, are in `presets.toml`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from ..models.errors import InputError
from .a2c import A2C, A2CConfig
from .config import Config, SACConfig
from .episodes import EpisodeRecorder
from .geometric import Geometric
from .mappo import MAPPO
from .orca import Orca
from .pid import PID
from .ppo import PPO, PPOConfig
from .vpg import VPG, VPGConfig

if TYPE_CHECKING:
    from .learner import Learner
    from .sb3 import SB3Agent


Agent: TypeAlias = "Learner | SB3Agent"
"""What learns, made of `(log, config, seed)`."""


@dataclass(frozen=True)
class Algorithm:
    """A row of the registry."""

    label: str
    """Name in tables and figures."""
    config: type[Config]
    agent: "Callable[[EpisodeRecorder, Any, int], Learner] | None" = None
    """Class; None: Stable-Baselines3's, which is imported when needed."""
    color: str = ""
    """Of its curves in figures; empty: one of the palette."""

    @property
    def resumes(self) -> bool:
        """Whether a stopped training goes on, and another begins with its networks."""
        return self.agent is not None


ALGORITHMS: Final[dict[str, Algorithm]] = {
    "vpg": Algorithm("VPG", VPGConfig, VPG, "#D55E00"),
    "a2c": Algorithm("A2C", A2CConfig, A2C, "#0072B2"),
    "ppo": Algorithm("PPO", PPOConfig, PPO),
    "ippo": Algorithm("IPPO", PPOConfig, PPO),
    "mappo": Algorithm("MAPPO", PPOConfig, MAPPO),
    "sb3-a2c": Algorithm("SB3 A2C", A2CConfig, color="#009E73"),
    "sb3-ppo": Algorithm("SB3 PPO", PPOConfig),
    "sb3-sac": Algorithm("SB3 SAC", SACConfig),
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
