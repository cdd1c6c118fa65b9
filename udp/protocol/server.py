"""The agent's side of the exchange (UDP server), free of sockets and clocks.

It has slots, one for each simulator that it flies; `session` is the exchange with one of them. A
Hello that fits is welcomed, and takes a slot only when its State 1 has come with the nonce of the
Welcome: a recorded Hello that is sent again takes none, and neither does a sender that does not
read. Memory for simulators without a slot is bounded.
"""

from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from math import inf
from typing import NamedTuple, TypeVar

from . import binary, text
from .auth import OVERHEAD, Key, is_sealed, key_id, message_of
from .client import CLOSE_INTERVAL, CLOSE_LINGER, Address, address_text, mismatch, random_number
from .errors import DecodeError, Forged, VersionMismatch
from .fragments import Assembler, asks, is_fragment
from .layout import Layout
from .messages import Close, Hello, Message, Refuse, State, Unknown, Wait, Welcome, one_line
from .session import Event, NoSuchSession, Outbox, Session

_MOST = 1024  # simulators remembered between Hello and State 1, and by text after their Close
_LEAST_ASSEMBLING = 16
"""Simulators without a slot of which fragments are kept; more, if there are more slots: so many
may come at the same moment."""
_TEXT_REMEMBERED = 2.0  # memory of the last line of a closed text simulator, s
_REASON_AT = binary.HEADER_SIZE + 2  # bytes of a Refuse or a Close before its reason

K = TypeVar("K")
V = TypeVar("V")


class _KeyMismatch(Forged):
    """One side has a key, the other has none."""


class _Arrival(NamedTuple):
    """A datagram that came."""

    datagram: bytes
    address: Address
    now: float


class Server:
    """Welcomes simulators and answers each of their States once.

    Args:
        accept: Looks at a Hello and gives the layout of its messages, or the reason to refuse it.
        text_layout: A text simulator says no Hello: its first line opens the session, and this
            gives the layout to read it by. A result of None: text is not flown.
        slots: Simulators to fly at the same time. Others wait until a slot is free.
        key: Shared with the simulators. Then nothing unsealed is taken.
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
        accept: Callable[[Hello], Layout | str],
        text_layout: Callable[[], Layout | None] = lambda: None,
        *,
        slots: int = 1,
        key: Key | None = None,
        draw_nonce: Callable[[], int] = random_number,
    ) -> None:
        self.outbox = Outbox()
        self.statistics = self.outbox.statistics
        self.slots: list[Session | None] = [None] * slots
        self.takes_text = True
        self.openings: OrderedDict[tuple[Address, int], Session] = OrderedDict()
        self._closed = False
        self._resend_at = self._deadline = 0.0
        self._accept = accept
        self._text_layout = text_layout
        self._key = key
        self._draw_nonce = draw_nonce
        self._seated: dict[Address, Session] = {}
        self._assembling: OrderedDict[tuple[Address, int], Assembler] = OrderedDict()
        self._ended_text: OrderedDict[Address, tuple[bytes, int, float]] = OrderedDict()

    # ---- what the caller does

    def receive(self, datagram: bytes, address: Address, now: float) -> Event | None:
        """Take a datagram; its effect, if it moves an exchange on."""
        self.statistics.counters["received"] += 1
        session = self._seated.get(address)
        if session and session.is_plain and session.state == "expecting":
            number = session.number
            sequence = session.sequence + 1
            state = binary.decode_due(binary.STATE, datagram, number, sequence, session.layout)
            if isinstance(state, State):
                return session.take_state(state, datagram, now)
        return self._receive_any(session, _Arrival(datagram, address, now))

    def free(self, slot: int) -> None:
        """Give the slot of a simulator that has fallen silent to the next that comes."""
        session = self.slots[slot]
        self.slots[slot] = None
        if session:
            session.move("unsaid", Close)
            del self._seated[session.peer]

    def close(self, reason: str, now: float) -> None:
        """End every exchange and tell the simulators, until they answer."""
        if self._closed:
            return
        for session in self.slots:
            if session:
                session.send_close(reason)
        self._closed = True
        self._resend_at = now + CLOSE_INTERVAL
        self._deadline = now + CLOSE_LINGER

    def next_timer(self) -> float:
        """When `handle_timer` wants to be called; infinite if never."""
        is_closing = self._closed and any(self.slots)
        return min(self._resend_at, self._deadline) if is_closing else inf

    def handle_timer(self, now: float) -> None:
        """Repeat what is due: a Close that nobody has answered, until nobody will."""
        if now < self.next_timer():
            return
        for slot, session in enumerate(self.slots):
            if session and now >= self._deadline:
                self.free(slot)
            elif session:
                session.repeat()
        self._resend_at = now + CLOSE_INTERVAL

    # ---- from a datagram to its session

    def _receive_any(self, session: Session | None, arrival: _Arrival) -> Event | None:
        """Any datagram: `receive` knows only the State that a slot waits for."""
        try:
            if text.is_text(arrival.datagram):
                return self._receive_text(session, arrival)
            return self._receive_binary(session, arrival)
        except DecodeError as error:
            self._refuse_undecoded(error, arrival)
            return None

    def _receive_binary(self, session: Session | None, arrival: _Arrival) -> Event | None:
        plain = self._open(arrival, session)
        kind, number, _ = binary.check(plain)
        kind &= ~binary.FRAGMENT
        seated = session if session and session.number == number and not session.is_text else None
        opening = None if seated else self.openings.get((arrival.address, number))
        holder = seated or opening
        if holder is None and kind != binary.HELLO:
            raise NoSuchSession
        if is_fragment(plain):
            if kind == binary.HELLO and not seated:
                whole = self._assemble(plain, opening, arrival)
            elif kind == binary.STATE and holder:
                whole = holder.assemble(plain, arrival.now)
            else:
                whole = None
                self._drop("foreign", f"a fragment of type {kind}", arrival)
            if whole is None:
                return None
            plain = whole
        message = binary.decode(plain, holder.layout if holder else None)
        if isinstance(message, Hello):
            self._receive_hello(message, arrival)
            return None
        if seated:
            return self._receive_seated(seated, message, plain, arrival)
        assert opening is not None
        return self._receive_opening(opening, message, plain, arrival)

    def _receive_seated(
        self, session: Session, message: Message, plain: bytes, arrival: _Arrival
    ) -> Event | None:
        event = session.receive(message, plain, arrival.now)
        if event and isinstance(message, Close):
            if session.is_text:
                last = session.line, message.sequence, arrival.now + _TEXT_REMEMBERED
                _keep(self._ended_text, session.peer, last)
            self.free(session.slot)
        return event

    def _open(self, arrival: _Arrival, session: Session | None) -> bytes:
        """A binary datagram without its seal.

        Raises `_KeyMismatch`, `Forged`, or `NoSuchSession` where it has no key here.
        """
        datagram = arrival.datagram
        shared = self._key
        if not is_sealed(datagram):
            if shared:
                raise _KeyMismatch(
                    "key: this agent has one (--key-file), and the simulator has none"
                )
            return datagram
        if shared is None:
            raise _KeyMismatch("key: this agent has none (--key-file), and the simulator has")
        if key_id(datagram) != shared.id:
            raise Forged("key: the simulator has another one")
        kind, number, sequence = binary.peek(message_of(datagram))
        if not binary.is_of_session(kind, sequence):
            return shared.open(datagram)
        if session and session.number == number and session.key:
            return session.key.open(datagram)
        opening = self.openings.get((arrival.address, number))
        if opening and (key := opening.session_key()):
            # If the Welcome was for an old copy of its Hello, it is as good as none.
            with suppress(Forged):
                return key.open(datagram)
        raise NoSuchSession

    def _refuse_undecoded(self, error: DecodeError, arrival: _Arrival) -> None:
        """Count it, and answer a Hello if its sender must change its configuration."""
        datagram = arrival.datagram
        plain = message_of(datagram) if is_sealed(datagram) else datagram
        kind, number, _ = binary.peek(plain)
        if isinstance(error, NoSuchSession):
            if kind in (binary.STATE, binary.MISSING):
                self._disown(plain, arrival)
            else:  # the answer to a Close of ours, mostly: not counted
                self.statistics.counters["foreign"] += 1
            return
        if isinstance(error, _KeyMismatch | VersionMismatch) and kind == binary.HELLO:
            key = None if isinstance(error, _KeyMismatch) else self._key
            self._refuse(number, str(error), arrival, key)
        self._drop(error.cause, str(error), arrival)

    # ---- Hello

    def _receive_hello(self, hello: Hello, arrival: _Arrival) -> None:
        """Welcome a simulator, refuse it, or let it wait."""
        address = arrival.address
        place = address, hello.session
        if self._has(hello.session):
            self.statistics.counters["stale"] += 1
            return
        if place in self.openings and not self._closed:
            self.openings[place].repeat()
            self.statistics.counters["duplicate"] += 1
            return
        layout = self._fit(hello)
        if isinstance(layout, str):
            self._refuse(hello.session, layout, arrival, self._key)
            self._drop("refused", layout, arrival)
            return
        if not self._has_slot_for(address):
            wait = binary.encode(Wait(session=hello.session))
            self.outbox.put([wait], address, self._key)
            return
        session = Session(self.outbox, address, hello.session, layout, hello, key=self._key)
        session.send_welcome(Welcome(session=hello.session, nonce=self._draw_nonce()))
        _keep(self.openings, place, session)

    def _fit(self, hello: Hello) -> Layout | str:
        """The layout of a simulator that is accepted, or the reason to refuse it."""
        if self._closed:
            return "the agent has closed"
        return mismatch(hello, binary.VERSION, hello.extensions) or self._accept(hello)

    def _refuse(self, number: int, reason: str, arrival: _Arrival, key: Key | None) -> None:
        """Refuse a Hello, with no more bytes than those that came."""
        room = len(arrival.datagram) - _REASON_AT - (OVERHEAD if key else 0)
        if room >= 0:
            refuse = Refuse(session=number, reason=one_line(reason, room))
            self.outbox.put([binary.encode(refuse)], arrival.address, key)

    def _assemble(
        self, fragment: bytes, opening: Session | None, arrival: _Arrival
    ) -> bytes | None:
        """The Hello of a simulator without a slot, once all its fragments are there."""
        if opening:
            if asks(fragment):
                opening.repeat()
            self.statistics.counters["duplicate"] += 1
            return None
        place = arrival.address, binary.peek(fragment)[1]
        assembler = self._assembling.get(place) or Assembler(binary.LONGEST_HELLO)
        _keep(self._assembling, place, assembler, max(_LEAST_ASSEMBLING, len(self.slots)))
        whole = assembler.take(fragment)
        if whole is not None:
            del self._assembling[place]
        elif answer := assembler.ask(fragment):
            self.outbox.put(answer, arrival.address, self._key)
        return whole

    # ---- sessions that were welcomed, and slots

    def _receive_opening(
        self, opening: Session, message: Message, plain: bytes, arrival: _Arrival
    ) -> Event | None:
        """Take a message of a session that was welcomed."""
        if isinstance(message, State):
            return self._join(opening, message, plain, arrival)
        if isinstance(message, Close):
            del self.openings[opening.peer, opening.number]
            opening.move("received", Close)
            opening.part("")
            self._drop("refused", message.reason, arrival)
        else:
            self._drop("foreign", type(message).__name__, arrival)
        return None

    def _join(
        self, opening: Session, state: State, plain: bytes, arrival: _Arrival
    ) -> Event | None:
        """The first State of a session that was welcomed."""
        assert opening.welcome is not None
        assert opening.hello is not None
        peer = opening.peer
        if state.sequence != 1 or state.nonce != opening.welcome.nonce:
            # Its Hello was an old one: this simulator goes on with another agent, or a copy of
            # its Hello came late.
            del self.openings[peer, opening.number]
            self._disown(plain, arrival)
            return None
        for address, number in list(self.openings):  # it, and what else the address began
            if address == peer:
                del self.openings[address, number]
        layout = self._fit(opening.hello)  # another one may have come since its Hello
        if isinstance(layout, str):
            opening.sequence = state.sequence
            opening.part(one_line(layout, len(plain) - _REASON_AT))
            opening.move("sent", Close)
            self._drop("refused", layout, arrival)
            return None
        if not self._has_slot_for(peer) or self._has(opening.number, elsewhere=peer):
            self._disown(plain, arrival)  # another was quicker
            return None
        return self._seat(opening, state, plain)

    def _seat(self, session: Session, state: State, plain: bytes) -> Event:
        """Give a session its slot: that of an earlier one of its address, or a free one."""
        earlier = self._seated.get(session.peer)
        if earlier:
            self.free(earlier.slot)
        slot = earlier.slot if earlier else self.slots.index(None)
        self.slots[slot] = session
        self._seated[session.peer] = session
        return session.join(slot, state, plain)

    def _has_slot_for(self, address: Address) -> bool:
        return None in self.slots or address in self._seated

    def _has(self, number: int, elsewhere: Address | None = None) -> bool:
        """Whether a session of that number has a slot (not of this address)."""
        return any(s and s.number == number and s.peer != elsewhere for s in self.slots)

    def _disown(self, plain: bytes, arrival: _Arrival) -> None:
        """Tell the simulator of an unknown session to begin another one.

        If it took a slot that was taken meanwhile, it will be told to wait.
        """
        _, number, sequence = binary.peek(plain)
        if is_fragment(plain) and not asks(plain):
            return  # one answer will do
        if not sequence:
            self._drop("malformed", "expected a State from 1 on, got 0", arrival)
            return
        if self._closed or self._has(number, elsewhere=arrival.address):
            # Another address has it: no answer of ours may end it.
            self._drop("foreign", f"session {number:016x}", arrival)
            return
        self.statistics.counters["foreign"] += 1  # mostly after a restart: no warning
        reply = binary.encode(Unknown(session=number, sequence=sequence))
        if self._key:  # of use only to the simulator that has sent this State
            reply = self._key.seal(reply, arrival.datagram)
        self.outbox.put([reply], arrival.address, None)

    # ---- text: the first line opens the session

    def _receive_text(self, session: Session | None, arrival: _Arrival) -> Event | None:
        datagram, address, now = arrival
        layout = None if self._key else self._text_layout()
        if layout is None:
            cause = "refused"
            reason = "text is not flown here"
            if self._key:
                cause = "forged"
                reason = "key: this agent has one (--key-file), text has none"
            sequence, fields = text.split(datagram)
            self._turn_away(sequence, cause, reason, arrival, is_close=fields == ["close"])
            return None
        message = text.decode_state(datagram, layout)
        if session and session.is_text:
            event = self._receive_seated(session, message, b"", arrival)
            if event and isinstance(message, State):
                session.line = datagram
            return event
        if isinstance(message, Close):
            self.statistics.counters["foreign"] += 1
            return None
        last, number, until = self._ended_text.get(address, (b"", 0, 0.0))
        is_late = last == datagram or 1 < number == message.sequence
        if is_late and now < until:
            reason = "a copy of the last line of a simulator that has closed"
        elif self._closed:
            reason = "the agent has closed"
        elif not self.takes_text or session:
            reason = "text is not flown here"
        elif None not in self.slots:
            reason = "every slot is taken"
        else:
            session = Session(self.outbox, address, 0, layout, None, line=datagram)
            return self._seat(session, message, b"")
        self._turn_away(message.sequence, "refused", reason, arrival)
        return None

    def _turn_away(
        self, sequence: int, cause: str, reason: str, arrival: _Arrival, is_close: bool = False
    ) -> None:
        """Answer a line that is not flown, with no more bytes than it has."""
        line = text.encode(Close(session=0, sequence=sequence, reason=""))
        # Two agents would answer each other's Closes for ever.
        if not is_close and len(line) <= len(arrival.datagram):
            self.outbox.put([line], arrival.address, None)
        self._drop(cause, reason, arrival)

    def _drop(self, cause: str, reason: str, arrival: _Arrival) -> None:
        """Count a datagram that changes nothing."""
        sentence = f"from {address_text(arrival.address)}: {reason}"
        self.statistics.drop(cause, sentence, arrival.now)


def _keep(table: OrderedDict[K, V], key: K, value: V, most: int = _MOST) -> None:
    """Put into a table that forgets its oldest entries."""
    table[key] = value
    table.move_to_end(key)
    if len(table) > most:
        table.popitem(last=False)
