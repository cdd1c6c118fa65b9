"""The wire: simulators (UDP clients) and an agent (UDP server) in lock-step.

`protocol` is free of sockets and clocks; `transport` puts it on sockets; `remote` makes Gymnasium
envs of it, and `journal` files.
"""

from .protocol.client import Address, LinkConfig
from .protocol.errors import DecodeError, LinkError, PeerClosed, PeerSilent, Refused
from .remote.env import RemoteEnv
from .remote.served import LOST
from .remote.vector import RemoteVectorEnv
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
