"""Every algorithm: one row each.

To add one, write its config and its class in a module of its own, and add a row here. Its presets,
if it has any, are in `presets.toml`.
"""

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias

from ..models.errors import InputError
from .config import Config

if TYPE_CHECKING:
    from .learner import Learner
    from .sb3 import SB3Agent


Agent: TypeAlias = "Learner | SB3Agent"
"""What learns, made of `(log, config, seed)`."""


@dataclass(frozen=True)
class Algorithm:
    """A row of the registry. Its classes are imported when they are used.

    They are named as "module:Class"; a module that begins with a dot is of this package.
    """

    label: str
    """Name in tables and figures."""
    config_name: str
    agent_name: str
    color: str = ""
    """Of its curves in figures; empty: one of the palette."""

    @property
    def config(self) -> type[Config]:
        """Class of its hyperparameters."""
        config: type[Config] = _find(self.config_name)
        return config

    @property
    def agent(self) -> Any:
        """Class of what learns. Raises `MissingPackage` where SB3 is not installed."""
        return _find(self.agent_name)

    @property
    def resumes(self) -> bool:
        """Whether a stopped training goes on, and another begins with its networks."""
        return self.agent_name != _SB3


def _find(name: str) -> Any:
    module, _, one = name.partition(":")
    return getattr(import_module(module, __package__), one)


_SB3 = ".sb3:SB3Agent"
ALGORITHMS: Final[dict[str, Algorithm]] = {
    "vpg": Algorithm("VPG", ".vpg:VPGConfig", ".vpg:VPG", "#D55E00"),
    "a2c": Algorithm("A2C", ".a2c:A2CConfig", ".a2c:A2C", "#0072B2"),
    "ppo": Algorithm("PPO", ".ppo:PPOConfig", ".ppo:PPO"),
    "ippo": Algorithm("IPPO", ".ppo:PPOConfig", ".ppo:PPO"),
    "mappo": Algorithm("MAPPO", ".ppo:PPOConfig", ".mappo:MAPPO"),
    "apg": Algorithm("APG", ".apg:APGConfig", ".apg:APG"),
    "sb3-a2c": Algorithm("SB3 A2C", ".a2c:A2CConfig", _SB3, "#009E73"),
    "sb3-ppo": Algorithm("SB3 PPO", ".ppo:PPOConfig", _SB3),
    "sb3-sac": Algorithm("SB3 SAC", ".config:SACConfig", _SB3),
}

if TYPE_CHECKING:
    AlgorithmName = str
else:
    AlgorithmName = Literal[tuple(ALGORITHMS)]


def find_algorithm(name: str) -> Algorithm:
    """The row of an algorithm. Raises `InputError` if there is none."""
    if name not in ALGORITHMS:
        raise InputError(f"algorithm: expected one of {', '.join(ALGORITHMS)}, got {name!r}")
    return ALGORITHMS[name]
