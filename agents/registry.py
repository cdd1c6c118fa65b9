"""Every algorithm: one row each, of `algorithms.toml`.

To add one, write its config and its class in a module of its own, and add a row there. Its presets,
if it has any, are in `presets.toml`.
"""

from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from ..models.errors import InputError
from ..models.files import read_own_toml

if TYPE_CHECKING:
    from .learner import Learner
    from .sb3 import SB3Agent


Agent: TypeAlias = "Learner | SB3Agent"
"""What learns, made of `(log, config, seed)`."""


@dataclass(frozen=True)
class Algorithm:
    """A row of the registry. Its classes are imported when they are used.

    They are named as "module:Class".
    """

    label: str
    """Name in tables and figures."""
    config_name: str
    agent_name: str
    color: str = ""
    """Of its curves in figures; empty: one of the palette."""
    resumes: bool = True
    """Whether a stopped training goes on, and another begins with its networks."""

    @property
    def config(self) -> Any:
        """Class of its hyperparameters."""
        return resolve_name(self.config_name)

    @property
    def agent(self) -> Any:
        """Class of what learns. Raises `MissingPackage` where SB3 is not installed."""
        return resolve_name(self.agent_name)


ALGORITHMS = {name: Algorithm(**row) for name, row in read_own_toml(__file__, "algorithms").items()}

if TYPE_CHECKING:
    AlgorithmName = str
else:
    AlgorithmName = Literal[tuple(ALGORITHMS)]


def find_algorithm(name: str) -> Algorithm:
    """The row of an algorithm. Raises `InputError` if there is none."""
    if name not in ALGORITHMS:
        raise InputError(f"algorithm: expected one of {', '.join(ALGORITHMS)}, got {name!r}")
    return ALGORITHMS[name]
