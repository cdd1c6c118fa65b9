"""Flight stacks of others as agents: their bytes, their programs, and the seat that they take."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Final, NamedTuple

from ..models.errors import InputError

if TYPE_CHECKING:
    from .seat import Stack, Start
    from .sticks import Pilot


class StackInfo(NamedTuple):
    """An autopilot that may take the seat."""

    name: str
    kind: str
    """Name of its class, in the module of its name."""
    rate: float
    """Of its steps, Hz."""
    modes: tuple[str, ...]
    """Ways to fly; the first one unless told otherwise."""

    def checked_mode(self, mode: str | None) -> str:
        """One of its modes, its first for None. Raises `InputError`."""
        if mode not in (None, *self.modes):
            expected = " or ".join(self.modes)
            raise InputError(f"mode: expected {expected} with {self.name}, got {mode}")
        return mode or self.modes[0]

    def make(self, start: "Start", **pilot: "Pilot") -> "Stack":
        """Begin one, flown by a pilot of ours if it takes one. Raises `InputError` where that
        fails.
        """
        kind: Callable[..., Stack] = getattr(import_module(f".{self.name}", __name__), self.kind)
        return kind(start, **pilot)


STACKS: Final[Mapping[str, StackInfo]] = {
    one.name: one
    for one in (
        StackInfo("ardupilot", "ArduPilot", 400.0, ("guided", "auto")),
        StackInfo("betaflight", "Betaflight", 1000.0, ("angle", "acro")),
        StackInfo(
            "crazyflie",
            "Crazyflie",
            1000.0,
            ("auto", "pid", "mellinger", "indi", "brescianini", "policy"),
        ),
        StackInfo("px4", "Px4", 250.0, ("offboard",)),
    )
}


def find_stack(name: str) -> StackInfo:
    """Of a name. Raises `InputError`."""
    if name not in STACKS:
        raise InputError(f"autopilot: expected {' or '.join(STACKS)}, got {name!r}")
    return STACKS[name]
