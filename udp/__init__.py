"""The wire: simulators (UDP clients) and an agent (UDP server) in lock-step.

`protocol` is free of sockets and clocks; `transport` puts it on sockets; `remote` makes Gymnasium
envs of it, and `journal` files. The protocol needs no Gymnasium.
"""

from typing import TYPE_CHECKING

from .. import import_when_used

if TYPE_CHECKING:
    from ..envs.autoreset import LOST
    from .protocol.client import LinkConfig
    from .protocol.errors import DecodeError, LinkError, PeerClosed, PeerSilent, Refused
    from .remote import RemoteEnv, RemoteVectorEnv
    from .transport.simulator import Simulator

__all__ = [
    "LOST",
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

__getattr__ = import_when_used(__name__)
