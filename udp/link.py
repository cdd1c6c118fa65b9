"""What both sides of the exchange share: times, addresses, and how a message becomes a datagram.

`SimulatorLink` and `AgentLink` are state machines without a socket, a clock or a sleep. A caller
hands in datagrams with the time of their arrival (seconds of any monotonic clock) and sends what
`take_outgoing` gives. Exactly one State is outstanding at any time, so a sequence number is all it
takes to step the physics once for each command:

* the simulator repeats the same bytes until the command of the same number comes;
* the agent answers a repeated State with the bytes that it answered before.

Whatever is not a legal transition is counted and dropped; it changes nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from math import isfinite
from typing import Final

from . import binary, text
from .keys import Key
from .messages import Close, Command, Message, State
from .parts import cut

__all__ = ["CLOSE_INTERVAL", "CLOSE_LINGER", "Address", "LinkConfig", "Tap", "encode", "packed"]

Address = tuple[str, int]

Tap = Callable[[int, Message, bytes], None]
"""Sees every message once, when it is first sent or taken: the number of its place (0 at the
simulator), the message, and its bytes in the binary codec, not cut and not sealed."""

CLOSE_INTERVAL: Final = 0.025
"""A Close is repeated after so long, s, until the other side has answered it with its own."""
CLOSE_LINGER: Final = 0.25
"""Longest wait for that answer, s: the other side may be gone."""


@dataclass(frozen=True, kw_only=True)
class LinkConfig:
    """Times of the exchange, s."""

    timeout: float = 120.0
    """The simulator gives up when nothing has answered for this long: longer than an agent waits
    for one to replace another that it has lost."""
    first_resend: float = 0.2
    """Wait before the first resend, while no round trip has been measured."""
    min_resend: float = 0.005
    """Shortest wait before a resend."""
    max_resend: float = 1.0
    """Longest wait before a resend: the waits double up to it."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and value > 0):
                raise ValueError(f"{field.name}: expected seconds > 0, got {value}")
        if self.min_resend > self.max_resend:
            raise ValueError(
                f"min_resend: expected at most max_resend = {self.max_resend}, "
                f"got {self.min_resend}"
            )


def encode(message: Message, *, as_text: bool = False) -> bytes:
    """The bytes of a message, not cut and not sealed. Raises `ValueError` if they are too many."""
    if as_text and isinstance(message, State | Command | Close):
        return text.encode(message)
    return binary.encode(message)


def packed(message: bytes, key: Key | None) -> list[bytes]:
    """The datagrams of a message as they travel: it or its parts, each sealed if there is a key."""
    return [key.seal(datagram) if key else datagram for datagram in cut(message)]
