"""The wire: simulators (UDP clients) and an agent (UDP server) in lock-step.

`messages`, `binary`, `text`, `keys` and the links are the protocol, free of sockets, clocks and
simulators.
"""

from .errors import DecodeError, LinkError, PeerClosed, PeerSilent, Refused
from .link import Address, LinkConfig
from .remote import LOST, RemoteEnv
from .remote_vector import RemoteVectorEnv
from .simulator import DEFAULT_AGENT, DEFAULT_SIMULATOR, Simulator

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
