"""The wire: simulators (UDP clients) and an agent (UDP server) in lock-step.

`protocol` is free of sockets and clocks; `transport` puts it on sockets; `remote` makes Gymnasium
envs of it, and `journal` files. Protocol and relay need no Gymnasium.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from .protocol.client import Address, LinkConfig
from .protocol.errors import DecodeError, LinkError, PeerClosed, PeerSilent, Refused

if TYPE_CHECKING:
    from .remote import LOST, RemoteEnv, RemoteVectorEnv
    from .transport.simulator import DEFAULT_AGENT, DEFAULT_SIMULATOR, Simulator

__all__ = [
    "DEFAULT_AGENT",
    "DEFAULT_SIMULATOR",
    "LOST",
    "Address",
    "DecodeError",
    "LinkConfig",
    "LinkError",
    "PeerClosed",
    "PeerSilent",
    "Refused",
    "RemoteEnv",
    "RemoteVectorEnv",
    "Simulator",
]

_HOMES: Final = {
    "DEFAULT_AGENT": "transport.simulator",
    "DEFAULT_SIMULATOR": "transport.simulator",
    "LOST": "remote",
    "RemoteEnv": "remote",
    "RemoteVectorEnv": "remote",
    "Simulator": "transport.simulator",
}


def __getattr__(name: str) -> Any:
    """Import what needs Gymnasium on first use (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
