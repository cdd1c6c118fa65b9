"""Controllers: agents that need no training, made of an env's spec. A user's own are classes in
files.
"""

from collections.abc import Mapping
from typing import ClassVar, Protocol

from ..envs.spec import EnvSpec
from ..models.errors import InputError
from ..models.user_code import load_class, names_class
from .geometric import Geometric
from .pid import PID
from .policies import Policy
from .raptor import Raptor


class Controller(Policy, Protocol):
    """What a class of controllers has. One object flies one drone."""

    options: ClassVar[Mapping[str, object]]
    """Options of the env that it needs, as {"action": "velocity"}: commands set them."""

    def __init__(self, spec: EnvSpec) -> None:
        """Raises `InputError` for an env that it cannot fly."""


CONTROLLERS: Mapping[str, type[Controller]] = {
    "pid": PID,
    "geometric": Geometric,
    "raptor": Raptor,
}
_NEEDED = ("options", "reset", "act")


def is_controller(name: str) -> bool:
    """Whether a name is one of `CONTROLLERS`, or `FILE.py:CLASS`."""
    return name in CONTROLLERS or names_class(name)


def find_controller(name: str) -> type[Controller]:
    """The class of a controller that a user names. Raises `InputError`."""
    if name in CONTROLLERS:
        return CONTROLLERS[name]
    kind: type[Controller] = load_class("controller", name)
    missing = [attribute for attribute in _NEEDED if not hasattr(kind, attribute)]
    if missing:
        raise InputError(
            f"controller: expected a class with {', '.join(_NEEDED)}, "
            f"got {name} without {missing[0]}"
        )
    if not isinstance(kind.options, Mapping):
        raise InputError(f"controller: expected a table as options of {name}, got {kind.options}")
    return kind
