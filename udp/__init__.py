"""The wire: simulators (UDP clients) and an agent (UDP server) in lock-step.

`protocol` is free of sockets and clocks; `transport` puts it on sockets; `remote` makes Gymnasium
envs of it, and `journal` files. The protocol needs no Gymnasium.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from .protocol.client import Address, LinkConfig
from .protocol.errors import DecodeError, LinkError, PeerClosed, PeerSilent, Refused

if TYPE_CHECKING:
    from ..envs.autoreset import LOST
    from .remote import RemoteEnv, RemoteVectorEnv
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


def __getattr__(name: str) -> object:
    """Import what needs Gymnasium on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    is_remote = name == "LOST" or name.startswith("Remote")
    module = import_module(".remote" if is_remote else ".transport.simulator", __name__)
    return getattr(module, name)
