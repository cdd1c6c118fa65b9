"""Which simulators an agent takes, and at which slot.

A Hello that fits is welcomed, and takes a slot only when its State 1 has come with the nonce of the
Welcome: a recorded Hello that is sent again takes none, and neither does a sender that does not
read. Memory for simulators without a slot is bounded.
"""

import secrets
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, TypeVar

from ...models.errors import InputError
from . import binary, text
from . import messages as m
from .auth import OVERHEAD, Key, key_id
from .client import Address, largest_datagram
from .fragments import Assembler, asks, check_size, is_fragment
from .layout import Layout
from .messages import State, one_line
from .session import Event, Outbox, Session
from .transitions import Way

_MOST: Final = 1024  # simulators remembered between Hello and State 1, in the queue, and after
_LEAST_ASSEMBLING: Final = 16
"""Simulators without a slot of which fragments are kept; more, if there are more slots: so many
may come at the same moment."""
_TEXT_REMEMBERED: Final = 2.0  # memory of the last line of a closed text simulator, s
_REASON_AT: Final = binary.HEADER_SIZE + 2  # bytes of a Refuse or a Close before its reason

K = TypeVar("K")
V = TypeVar("V")


class Arrival(NamedTuple):
    """A datagram that came."""

    datagram: bytes
    address: Address
    now: float


class Admission:
    """The slots of an agent, and the simulators between their Hello and their slot.

    Args:
        accept: Looks at a Hello and gives the layout of its messages, or the reason to refuse it.
        text_layout: A text simulator says no Hello: its first line opens the session, and this
            gives the layout to read it by. None, or a result of None: text is not flown.
        slots: Simulators to fly at the same time. Others wait until a slot is free.
        keys: Shared with the simulators, any of them. Then nothing unsealed is taken.
        draw_nonce: Gives a random 64-bit number for each Welcome.

    Attributes:
        slots: Session of each slot, None where it is free.
        takes_text: Whether a text simulator may take a free slot.
        outbox: Datagrams to send, and the tap.
        statistics: Counts and times, over all simulators.
        openings: Sessions that were welcomed, by address and number.
    """

    def __init__(
        self,
        accept: Callable[[m.Hello], Layout | str],
        text_layout: Callable[[], Layout | None] | None = None,
        *,
        slots: int = 1,
        keys: Sequence[Key] = (),
        max_datagram: int | None = None,
        draw_nonce: Callable[[], int] = lambda: secrets.randbits(64),
    ) -> None:
        self.outbox = Outbox(max_datagram)
        self.statistics = self.outbox.statistics
        self.slots: list[Session | None] = [None] * slots
        self.takes_text = text_layout is not None
        self.openings: OrderedDict[tuple[Address, int], Session] = OrderedDict()
        self._closed = False
        self._accept = accept
        self._text_layout = text_layout or (lambda: None)
        self._keys = {key.id: key for key in keys}
        self._draw_nonce = draw_nonce
        self._seated: dict[Address, Session] = {}
        self._ended: OrderedDict[int, None] = OrderedDict()  # numbers of sessions that had a slot
        self._queue: OrderedDict[Address, Session] = OrderedDict()  # QUEUED
        self._assembling: OrderedDict[tuple[Address, int], Assembler] = OrderedDict()
        self._ended_text: OrderedDict[Address, tuple[bytes, int, float]] = OrderedDict()

    # ---- slots

    def free(self, slot: int) -> None:
        """Give the slot of a simulator that has fallen silent to the next that comes."""
        session = self.slots[slot]
        self.slots[slot] = None
        if session:
            session.move(Way.UNSAID, m.Close)
            del self._seated[session.peer]
            if not session.is_text:
                keep(self._ended, session.number, None)

    def _seat(self, session: Session, state: State, plain: bytes) -> Event:
        """Give a session its slot: that of an earlier one of its address, or a free one."""
        earlier = self._seated.get(session.peer)
        slot = self.slots.index(None) if earlier is None else earlier.slot
        if earlier:
            self.free(slot)
        self.slots[slot] = session
        self._seated[session.peer] = session
        return session.join(slot, state, plain)

    def _has_slot_for(self, address: Address) -> bool:
        return None in self.slots or address in self._seated

    def _has(self, number: int, elsewhere: Address | None = None) -> bool:
        """Whether a session of that number has a slot (not of this address)."""
        return any(s and s.number == number and s.peer != elsewhere for s in self.slots)

    # ---- Hello

    def receive_hello(self, hello: m.Hello, arrival: Arrival, key: Key | None) -> None:
        """Welcome a simulator, refuse it, or let it wait."""
        address = arrival.address
        size = len(arrival.datagram)
        opening = self.openings.get((address, hello.session))
        if hello.session in self._ended or self._has(hello.session):
            self.drop("stale", "", arrival)
            return
        if opening and not self._closed:
            opening.repeat()
            self.drop("duplicate", "", arrival)
            return
        layout = self._fit(hello, address)
        if isinstance(layout, str):
            self.refuse(hello.session, layout, address, size, key)
            self.drop("refused", layout, arrival)
            return
        session = Session(self.outbox, address, hello.session, layout, hello, key=key)
        if self._has_slot_for(address):
            self._queue.pop(address, None)
            nonce = self._draw_nonce()
            welcome = m.Welcome(session=hello.session, nonce=nonce)
            session.send_welcome(welcome)
            keep(self.openings, (address, hello.session), session)
        else:
            wait = binary.encode(m.Wait(session=session.number))
            self.outbox.put([wait], address, key)
            session.move(Way.SENT, m.Wait)
            session.room = size - len(wait)
            keep(self._queue, address, session)

    def _fit(self, hello: m.Hello, address: Address) -> Layout | str:
        """The layout of a simulator that is accepted, or the reason to refuse it."""
        if self._closed:
            return "the agent has closed"
        low, high = hello.versions
        if not low <= binary.VERSION <= high:
            return f"expected protocol version {binary.VERSION}, got {low} to {high}"
        if unknown := [e.number for e in hello.extensions if e.critical]:
            return f"expected no critical extension of type {unknown[0]}"
        layout = self._accept(hello)
        if isinstance(layout, str):
            return layout
        try:
            largest = largest_datagram(address, self.outbox.max_datagram)
            check_size(layout.seeded_command.size, largest)
        except InputError as error:
            return str(error)
        return layout

    def refuse(
        self, number: int, reason: str, address: Address, size: int, key: Key | None
    ) -> None:
        """Refuse a Hello that came in so many bytes, with no more than those."""
        room = size - _REASON_AT - (OVERHEAD if key else 0)
        if room >= 0:
            refuse = m.Refuse(session=number, reason=_cut(reason, room))
            self.outbox.put([binary.encode(refuse)], address, key)

    def assemble(
        self, fragment: bytes, opening: Session | None, arrival: Arrival, key: Key | None
    ) -> bytes | None:
        """The Hello of a simulator without a slot, once all its fragments are there."""
        if opening:
            if asks(fragment):
                opening.repeat()
            self.drop("duplicate", "", arrival)
            return None
        place = arrival.address, binary.peek(fragment)[1]
        assembler = self._assembling.get(place) or Assembler(binary.LONGEST_HELLO)
        keep(self._assembling, place, assembler, max(_LEAST_ASSEMBLING, len(self.slots)))
        whole = assembler.take(fragment)
        if whole is not None:
            del self._assembling[place]
        elif answer := assembler.ask(fragment):
            self.outbox.put(answer, arrival.address, key)
        return whole

    def receive_opening(
        self, opening: Session, message: m.Message, plain: bytes, arrival: Arrival
    ) -> Event | None:
        """Take a message of a session that was welcomed."""
        if isinstance(message, State):
            return self._join(opening, message, plain, arrival)
        if isinstance(message, m.Close):
            del self.openings[opening.peer, opening.number]
            opening.move(Way.RECEIVED, m.Close)
            goodbye = binary.encode(opening.goodbye(""))
            self.outbox.put([goodbye], arrival.address, opening.session_key())
            return None
        self.drop("foreign", type(message).__name__, arrival)
        return None

    def _join(self, opening: Session, state: State, plain: bytes, arrival: Arrival) -> Event | None:
        """The first State of a session that was welcomed."""
        assert opening.welcome is not None
        assert opening.hello is not None
        peer = opening.peer
        if state.sequence != 1 or state.nonce != opening.welcome.nonce:
            # Its Hello was an old one: this simulator goes on with another agent, or a copy of
            # its Hello came late.
            del self.openings[opening.peer, opening.number]
            self.disown(plain, arrival)
            return None
        for address, number in list(self.openings):  # it, and what else the address began
            if address == peer:
                del self.openings[address, number]
        layout = self._fit(opening.hello, peer)  # another one may have come since its Hello
        if isinstance(layout, str):
            reason = _cut(layout, len(plain) - _REASON_AT)
            close = m.Close(session=opening.number, sequence=1, reason=reason)
            self.outbox.put([binary.encode(close)], peer, opening.session_key())
            opening.move(Way.SENT, m.Close)
            self.drop("refused", layout, arrival)
            return None
        if not self._has_slot_for(peer) or self._has(opening.number, elsewhere=peer):
            self.disown(plain, arrival)  # another was quicker
            return None
        return self._seat(opening, state, plain)

    def disown(self, plain: bytes, arrival: Arrival) -> None:
        """Tell the simulator of an unknown session to begin another one.

        If it took a slot that was taken meanwhile, it will be told to wait.
        """
        datagram, address, _ = arrival
        _, number, sequence = binary.peek(plain)
        if is_fragment(plain) and not asks(plain):
            return  # one answer will do
        if not sequence:
            self.drop("malformed", "expected a State from 1 on, got 0", arrival)
            return
        if self._closed or self._has(number, elsewhere=address):
            # Another address has it: no answer of ours may end it.
            self.drop("foreign", f"session {number:016x}", arrival)
            return
        self.statistics.counters["foreign"] += 1  # mostly after a restart: no notice
        reply = binary.encode(m.Unknown(session=number, sequence=sequence))
        if self._keys:  # of use only to the simulator that has sent this State
            key = self._keys.get(key_id(datagram))
            if key is None:
                return
            reply = key.seal(reply, datagram)
        self.outbox.put([reply], address, None)

    # ---- text: the first line opens the session

    def receive_first_line(
        self, message: State | m.Close, layout: Layout, arrival: Arrival
    ) -> Event | None:
        """A line of a text simulator that has no slot."""
        datagram, address, now = arrival
        if isinstance(message, m.Close):
            self.statistics.counters["foreign"] += 1
            return None
        last, number, until = self._ended_text.get(address, (b"", 0, 0.0))
        is_late = last == datagram or 1 < number == message.sequence
        if is_late and now < until:
            reason = "a copy of the last line of a simulator that has closed"
        elif self._closed:
            reason = "the agent has closed"
        elif not self.takes_text or address in self._seated:
            reason = "text is not flown here"
        elif None not in self.slots:
            reason = "every slot is taken"
        else:
            session = Session(self.outbox, address, 0, layout, None, line=datagram)
            return self._seat(session, message, b"")
        self.turn_text_away(message.sequence, "refused", reason, arrival)
        return None

    def turn_text_away(self, sequence: int, cause: str, reason: str, arrival: Arrival) -> None:
        """Answer a line that is not flown, with no more bytes than it has."""
        line = text.encode(m.Close(session=0, sequence=sequence, reason=""))
        if len(line) <= len(arrival.datagram):
            self.outbox.put([line], arrival.address, None)
        self.drop(cause, reason, arrival)

    def remember_text(self, session: Session, sequence: int, now: float) -> None:
        """Know the last line of a text simulator that has closed, for a while."""
        keep(self._ended_text, session.peer, (session.line, sequence, now + _TEXT_REMEMBERED))

    def drop(self, cause: str, reason: str, arrival: Arrival) -> None:
        """Count a datagram that changes nothing."""
        self.outbox.drop(cause, reason, arrival.address, arrival.now)


def keep(table: OrderedDict[K, V], key: K, value: V, most: int = _MOST) -> None:
    """Put into a table that forgets its oldest entries."""
    table[key] = value
    table.move_to_end(key)
    if len(table) > most:
        table.popitem(last=False)


def _cut(reason: str, room: int) -> str:
    """A reason that takes at most so many bytes."""
    return one_line(reason).encode()[:room].decode(errors="ignore")
