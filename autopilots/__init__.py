"""Flight stacks of others as agents: their bytes, their programs, and the seat that they take."""

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from ..models.errors import InputError
from ..models.files import read_own_toml

if TYPE_CHECKING:
    from .seat import Stack, Start


class StackInfo(NamedTuple):
    """An autopilot that may take the seat."""

    name: str
    kind: str
    """Name of its class, in the module of its name."""
    rate: float
    """Of its steps, Hz."""
    modes: Sequence[str]
    """Ways to fly; the first one unless told otherwise."""
    takes: Sequence[str] = ()
    """Fields of `Start` that other stacks do not take."""

    def check(self, start: "Start") -> None:
        """Raise `InputError` for what it does not take."""
        if start.mode not in self.modes:
            expected = " or ".join(self.modes)
            raise InputError(f"mode: expected {expected} with {self.name}, got {start.mode}")
        for name in ("real_time", "policy"):
            if getattr(start, name) and name not in self.takes:
                takers = [one.name for one in STACKS.values() if name in one.takes]
                raise InputError(f"{name}: expected {' or '.join(takers)}, got {self.name}")

    def make(self, start: "Start") -> "Stack":
        """Begin one. Raises `InputError` where that fails."""
        self.check(start)
        module = import_module(f".{self.name}", __name__)
        kind: Callable[[Start], Stack] = getattr(module, self.kind)
        return kind(start)


STACKS = {name: StackInfo(name, **row) for name, row in read_own_toml(__file__, "stacks").items()}


def find_stack(name: str) -> StackInfo:
    """Of a name. Raises `InputError`."""
    if name not in STACKS:
        raise InputError(f"autopilot: expected {' or '.join(STACKS)}, got {name!r}")
    return STACKS[name]
