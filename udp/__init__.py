"""The wire: a simulator (UDP client) and an agent (UDP server) in lock-step.

`messages`, `binary`, `text` and `link` are the protocol, free of sockets, clocks and simulators.
"""

from .errors import DecodeError, LinkError, PeerClosed, PeerSilent, Refused
from .link import Address, LinkConfig
from .remote import RemoteEnv
from .simulator import DEFAULT_AGENT, DEFAULT_SIMULATOR, Simulator

__all__ = [
    "DEFAULT_AGENT",
    "DEFAULT_SIMULATOR",
    "Address",
    "DecodeError",
    "LinkConfig",
    "LinkError",
    "PeerClosed",
    "PeerSilent",
    "Refused",
    "RemoteEnv",
    "Simulator",
]
