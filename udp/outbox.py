"""What the agent says: every datagram that it sends, counted and shown to the tap."""

from typing import Final

from . import binary, text
from .keys import OVERHEAD, Key
from .link import Address, Tap, encode, packed
from .messages import Close, Command, Message, Refuse, one_line
from .parts import turned
from .session import Session
from .statistics import Statistics

__all__ = ["Outbox"]

_REASON_AT: Final = binary.HEADER_SIZE + 2
"""Bytes of a Refuse or a Close before its reason."""


class Outbox:
    """Makes datagrams of messages and keeps them until they are taken.

    Args:
        statistics: Where they are counted.
        tap: Sees every message of a session once.

    Attributes:
        datagrams: What is to be sent, and where to.
    """

    def __init__(self, statistics: Statistics, tap: Tap | None) -> None:
        self.datagrams: list[tuple[bytes, Address]] = []
        self._statistics = statistics
        self._tap = tap

    def take(self) -> list[tuple[bytes, Address]]:
        """The datagrams, each once."""
        taken, self.datagrams = self.datagrams, []
        return taken

    def put(self, datagram: bytes, address: Address) -> None:
        """Send a datagram as it is."""
        self.datagrams.append((datagram, address))
        self._statistics.counters["sent"] += 1

    def send(self, message: Message, address: Address, key: Key | None) -> bytes:
        """Send a message that fits into one datagram; that datagram."""
        (datagram,) = packed(encode(message), key)
        self.put(datagram, address)
        return datagram

    def answer(self, place: int, session: Session, message: Command | Close) -> None:
        """Send a message to who has that place. Its bytes are kept in the session's `reply`."""
        datagram = encode(message, as_text=session.is_text)
        self.record(place, message, datagram, is_text=session.is_text)
        session.reply = packed(datagram, session.key)
        self.datagrams += [(part, session.peer) for part in session.reply]
        self._statistics.counters["sent"] += 1

    def repeat(self, session: Session) -> None:
        """Send its last answer again, the same bytes."""
        session.repeats += 1
        parts = turned(session.reply, session.repeats)
        self.datagrams += [(part, session.peer) for part in parts]
        self._statistics.counters["resent"] += 1

    def refuse(
        self, number: int, reason: str, address: Address, size: int, key: Key | None
    ) -> None:
        """Refuse a Hello that came in so many bytes, with no more than those."""
        room = size - _REASON_AT - (OVERHEAD if key else 0)
        if room >= 0:
            self.send(Refuse(session=number, reason=_cut(reason, room)), address, key)

    def turn_away(self, opening: Session, reason: str, size: int) -> None:
        """Close a session at its first State of so many bytes, with no more than those."""
        words = _cut(reason, size - _REASON_AT)
        self.send(
            Close(session=opening.number, sequence=1, reason=words), opening.peer, opening.key
        )

    def close_text(self, sequence: int, address: Address) -> None:
        """Answer a line of the text codec by a Close."""
        self.put(text.encode(Close(session=0, sequence=sequence, reason="")), address)

    def record(
        self, place: int, message: Message, datagram: bytes, *, is_text: bool = False
    ) -> None:
        """Show the tap a message that was taken or sent, and its bytes, not cut and not sealed."""
        if self._tap:
            self._tap(place, message, binary.encode(message) if is_text else datagram)


def _cut(reason: str, room: int) -> str:
    """A reason that takes at most so many bytes."""
    return one_line(reason).encode()[:room].decode(errors="ignore")
