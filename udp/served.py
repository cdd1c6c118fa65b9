"""What the envs over UDP have in common, be it one drone or many: the `Server` behind them."""

from typing import Any

from gymnasium import spaces

from .interface import same_space
from .link import Address
from .messages import Hello
from .server import Server
from .statistics import Statistics

__all__ = ["ServedEnv", "keep_space"]


class ServedEnv:
    """An env whose drones are in simulators elsewhere. For a class that is a Gymnasium env too."""

    _server: Server

    @property
    def address(self) -> Address:
        """Address that this side listens on."""
        return self._server.address

    @property
    def hello(self) -> Hello | None:
        """What the last simulator that came said of itself; None before one came, or by text."""
        return self._server.hello

    @property
    def statistics(self) -> Statistics:
        """Counts and round trips of the wire, over all simulators."""
        return self._server.link.statistics


def keep_space(env: Any, name: str, space: spaces.Space[Any]) -> None:
    """Give an env a space, unless it has that one already: its generator may have been seeded."""
    if name not in vars(env) or not same_space(vars(env)[name], space):
        setattr(env, name, space)
