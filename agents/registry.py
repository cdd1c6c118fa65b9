"""Every algorithm and every controller: one row each.

To add an algorithm, write its config and its class in a module of its own, and add a row here. Its
presets, if it has any, are in `presets.toml`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from ..models.errors import InputError
from .a2c import A2C, A2CConfig
from .config import Config, SACConfig
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
    agent: Any
    """Class; or its module and name, which are imported when needed."""
    resumes: bool = True
    """Whether a stopped training goes on, and another begins with its networks."""
    color: str = ""
    """Of its curves in figures; empty: one of the palette."""

    def agent_class(self) -> Any:
        """The class. Raises `MissingPackage`."""
        if not isinstance(self.agent, str):
            return self.agent
        module, _, name = self.agent.partition(":")
        return getattr(import_module(module, __package__), name)


_SB3: Final = ".sb3:SB3Agent"

ALGORITHMS: Final[dict[str, Algorithm]] = {
    "vpg": Algorithm("VPG", VPGConfig, VPG, color="#D55E00"),
    "a2c": Algorithm("A2C", A2CConfig, A2C, color="#0072B2"),
    "ppo": Algorithm("PPO", PPOConfig, PPO),
    "ippo": Algorithm("IPPO", PPOConfig, PPO),
    "mappo": Algorithm("MAPPO", PPOConfig, MAPPO),
    "sb3-a2c": Algorithm("SB3 A2C", A2CConfig, _SB3, resumes=False, color="#009E73"),
    "sb3-ppo": Algorithm("SB3 PPO", PPOConfig, _SB3, resumes=False),
    "sb3-sac": Algorithm("SB3 SAC", SACConfig, _SB3, resumes=False),
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
