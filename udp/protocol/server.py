"""The agent's side of the exchange (UDP server), free of sockets and clocks.

It has slots, one for each simulator that it flies. A Hello that fits is welcomed, and takes a slot
only when its State 1 has come with the nonce of the Welcome: a recorded Hello that is sent
again takes none, and neither does a sender that does not read. A repeated State is answered with
the bytes of the first answer. Memory for simulators without a slot is bounded.
"""

import secrets
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from ...models.errors import InputError
from . import binary, text
from . import messages as m
from .auth import OVERHEAD, Key, is_sealed, key_id, message_of
from .client import CLOSE_INTERVAL, CLOSE_LINGER, Address, Tap, largest_datagram
from .errors import DecodeError, Forged, VersionMismatch
from .fragments import Assembler, Transfer, Window, asks, check_size, is_fragment
from .layout import Layout
from .messages import Command, Message, State, one_line
from .statistics import Statistics
from .transitions import AGENT, AgentState, Way

_MOST: Final = 1024  # simulators remembered between Hello and State 1, in the queue, and after
_LEAST_ASSEMBLING: Final = 16
"""Simulators without a slot of which fragments are kept; more, if there are more slots: so many
may come at the same moment."""
_TEXT_REMEMBERED: Final = 2.0  # for so long the last line of a closed text simulator is known, s
_AFTER_STATE: Final = AGENT[AgentState.EXPECTING, Way.RECEIVED, State]
_REASON_AT: Final = binary.HEADER_SIZE + 2  # bytes of a Refuse or a Close before its reason


class _KeyMismatch(Forged):
    """One side has a key, the other has none."""


class _NoSuchSession(DecodeError):
    """A sealed message of a session whose key is not here."""


class Event(NamedTuple):
    """The effect of a datagram."""

    slot: int
    message: State | m.Close
    joined: bool = False
    """The State is the first of a new session, which may have taken the slot of another."""


@dataclass(eq=False)
class Session:
    """An exchange with one simulator, pinned to its address and codec."""

    peer: Address
    number: int  # session number; 0 with the text codec
    layout: Layout
    hello: m.Hello | None  # none if it speaks text
    state: AgentState = AgentState.NEW
    sequence: int = 0  # number of the State that came last
    key: Key | None = None
    welcome: m.Welcome | None = None
    reply: Transfer | None = None  # the answer to the last State, or the Welcome
    assembler: Assembler | None = None  # of the State that is coming in fragments
    window: Window = field(default_factory=Window)
    largest: int = 0
    """Bytes of the largest datagram to it, a seal not counted; 0 before the first message."""
    is_plain: bool = False
    """Whether it has a slot, and its messages are neither sealed nor text."""
    asked_at: float = 0.0  # when the Command was sent whose State is expected
    heard_at: float = 0.0  # when it last said that it lives, or brought a fragment that was missing
    room: int = 0  # bytes that a Refuse may have, while it waits for a slot
    last: bytes = b""  # line, by text

    @property
    def is_text(self) -> bool:
        """Whether it speaks the text codec."""
        return self.hello is None

    def move(self, way: Way, kind: type[Message]) -> None:
        """Be in the state that such a message leads to. Raises `KeyError` if it may not."""
        self.state = AGENT[self.state, way, kind]


class _Arrival(NamedTuple):
    datagram: bytes
    address: Address
    now: float


class Server:
    """Welcomes simulators and answers each of their States once.

    Args:
        accept: Looks at a Hello and gives the layout of its messages, or the reason to refuse it.
        text_layout: A text simulator says no Hello: its first line opens the session, and this
            gives the layout to read it by. None, or a result of None: text is not flown.
        slots: Simulators to fly at the same time. Others wait until a slot is free.
        keys: Shared with the simulators, any of them. Then nothing unsealed is taken.
        extensions: Of each Welcome.
        draw_nonce: Gives a random 64-bit number for each Welcome.

    Attributes:
        slots: Session of each slot, None where it is free.
        takes_text: Whether a text simulator may take a free slot.
        tap: None at first.
    """

    def __init__(
        self,
        accept: Callable[[m.Hello], Layout | str],
        text_layout: Callable[[], Layout | None] | None = None,
        *,
        slots: int = 1,
        keys: Sequence[Key] = (),
        max_datagram: int | None = None,
        extensions: tuple[m.Extension, ...] = (),
        draw_nonce: Callable[[], int] = lambda: secrets.randbits(64),
    ) -> None:
        self.slots: list[Session | None] = [None] * slots
        self.closed = False
        self.takes_text = text_layout is not None
        self.statistics = Statistics()
        self._accept = accept
        self._text_layout = text_layout or (lambda: None)
        self._keys = {key.id: key for key in keys}
        self._max_datagram = max_datagram
        self._extensions = extensions
        self.tap: Tap | None = None
        self._draw_nonce = draw_nonce
        self._slot_of: dict[Address, int] = {}
        self._openings: OrderedDict[tuple[Address, int], Session] = OrderedDict()  # WELCOMED
        self._queue: OrderedDict[Address, Session] = OrderedDict()  # QUEUED
        self._ended: OrderedDict[int, None] = OrderedDict()  # numbers of sessions that had a slot
        self._ended_text: OrderedDict[Address, tuple[bytes, int, float]] = OrderedDict()
        self._assembling: OrderedDict[tuple[Address, int], Assembler] = OrderedDict()
        self._outgoing: list[tuple[bytes, Address]] = []
        self._resend_at = self._deadline = 0.0

    # ---- what the caller does

    def receive(self, datagram: bytes, address: Address, now: float) -> Event | None:
        """Take a datagram; its effect, if it moves an exchange on."""
        self.statistics.counters["received"] += 1
        slot = self._slot_of.get(address, -1)
        session = self.slots[slot] if slot >= 0 else None
        if session and session.state is AgentState.EXPECTING and session.is_plain:
            number, sequence = session.number, session.sequence + 1
            state = binary.decode_due(binary.STATE, datagram, number, sequence, session.layout)
            if isinstance(state, State):
                return self._take_state(slot, session, state, datagram, now)
        return self._receive_any(slot, session, _Arrival(datagram, address, now))

    def _receive_any(self, slot: int, session: Session | None, arrival: _Arrival) -> Event | None:
        """Whatever comes: `receive` knows only the State that a slot waits for."""
        datagram, address, _ = arrival
        try:
            if text.is_text(datagram):
                return self._receive_text(slot, session, arrival)
            plain, key = self._open(arrival, session)
            kind, number, _ = binary.peek(plain)
            holder = session
            if session is None or session.number != number or session.is_text:
                holder = self._openings.get((address, number))
            if is_fragment(plain):
                whole = self._assemble(plain, holder, arrival, key)
                if whole is None:
                    return None
                plain = whole
            if holder is None and kind != binary.HELLO:
                binary.check(plain)
                self._receive_stranger(kind, plain, arrival)
                return None
            message = binary.decode(plain, holder.layout if holder else None)
        except DecodeError as error:
            self._refuse_undecoded(error, arrival)
            return None
        if isinstance(message, m.Hello):
            self._receive_hello(message, arrival, key)
            return None
        assert holder is not None
        if holder is session:
            return self._receive_known(slot, session, message, plain, arrival)
        if isinstance(message, State):
            return self._join(holder, message, plain, arrival)
        if isinstance(message, m.Close):  # before its first State
            self._forget(holder)
            holder.move(Way.RECEIVED, m.Close)
            self._put([binary.encode(_goodbye(holder, ""))], address, self._session_key(holder))
            return None
        self._drop("foreign", type(message).__name__, arrival)
        return None

    def send_command(
        self,
        slot: int,
        actions: np.ndarray,
        orders: np.ndarray,
        seeds: np.ndarray | None,
        now: float,
    ) -> None:
        """Answer the last State of a slot: see `messages.Command`.

        Raises `InputError` for an array that is not of the layout, or not finite; nothing was sent.
        """
        session = self.slots[slot]
        if session is None or session.state is not AgentState.DECIDING:
            got = session.state.value if session else "a free slot"
            raise ValueError(f"send_command: expected a session that is deciding, got {got}")
        command = Command(
            session=session.number,
            sequence=session.sequence,
            actions=actions,
            orders=orders,
            seeds=seeds,
        )
        self._answer(slot, session, command)
        session.asked_at = session.heard_at = now

    def free(self, slot: int) -> None:
        """Give the slot of a simulator that has fallen silent to the next that comes."""
        session, self.slots[slot] = self.slots[slot], None
        if session:
            session.state = AgentState.CLOSED
            del self._slot_of[session.peer]
            if not session.is_text:
                _keep(self._ended, session.number, None)

    def close(self, reason: str, now: float) -> None:
        """End every exchange and tell the simulators, until they answer."""
        if self.closed:
            return
        self.closed = True
        for slot, session in enumerate(self.slots):
            if session:
                self._answer(slot, session, _goodbye(session, reason))
        for queued in self._queue.values():
            self._refuse(queued.number, reason, queued.peer, queued.room, queued.key)
            queued.move(Way.SENT, m.Refuse)
        self._resend_at, self._deadline = now + CLOSE_INTERVAL, now + CLOSE_LINGER

    def next_timer(self) -> float | None:
        """When `handle_timer` wants to be called; None if never."""
        return min(self._resend_at, self._deadline) if self.closed and any(self.slots) else None

    def handle_timer(self, now: float) -> None:
        """Repeat what is due: a Close that nobody has answered, until nobody will."""
        if (timer := self.next_timer()) is None or now < timer:
            return
        for slot, session in enumerate(self.slots):
            if session and now >= self._deadline:
                self.free(slot)
            elif session:
                self._repeat(session)
        self._resend_at = now + CLOSE_INTERVAL

    def take_outgoing(self) -> list[tuple[bytes, Address]]:
        """Datagrams to send and where to, each once."""
        taken, self._outgoing = self._outgoing, []
        return taken

    # ---- a simulator that has a slot

    def _receive_known(
        self, slot: int, session: Session, message: Message, plain: bytes, arrival: _Arrival
    ) -> Event | None:
        is_state = isinstance(message, State)
        number = getattr(message, "sequence", 0)
        if is_state and number == session.sequence:
            self._answer_again(session)
            self._drop("duplicate", "", arrival)
            return None
        if is_state and number > session.sequence + 1 and not session.is_text:
            # It went on with another agent: what opened it here came late, from before a restart.
            self._disown(plain, arrival)
            return None
        is_due = number == session.sequence + is_state or isinstance(message, m.Close)
        state = AGENT.get((session.state, Way.RECEIVED, type(message))) if is_due else None
        if state is None:
            self._drop("stale", "", arrival)
            return None
        match message:
            case State():
                return self._take_state(slot, session, message, plain, arrival.now)
            case m.Alive():
                session.heard_at = arrival.now
            case m.Missing() if session.reply and message.kind == binary.COMMAND:
                self._put(session.reply.resend(message), session.peer, session.key, "resent")
            case m.Missing():
                self._drop("stale", "", arrival)
            case m.Close():
                self._record(slot, message, plain, session)
                if session.state is not AgentState.CLOSING:
                    self._answer(slot, session, _goodbye(session, ""))
                if session.is_text:
                    last = (session.last, message.sequence, arrival.now + _TEXT_REMEMBERED)
                    _keep(self._ended_text, session.peer, last)
                self.free(slot)
                return Event(slot, message)
        return None

    # ---- a simulator that comes

    def _receive_hello(self, hello: m.Hello, arrival: _Arrival, key: Key | None) -> None:
        address, size = arrival.address, len(arrival.datagram)
        opening = self._openings.get((address, hello.session))
        if hello.session in self._ended or self._seated(hello.session):
            self._drop("stale", "", arrival)
        elif opening and not self.closed:
            self._repeat(opening)
            self._drop("duplicate", "", arrival)
        elif isinstance(layout := self._fit(hello, address), str):
            self._refuse(hello.session, layout, address, size, key)
            self._drop("refused", layout, arrival)
        elif None in self.slots or address in self._slot_of:
            self._welcome(hello, layout, address, key)
        else:
            self._let_wait(Session(address, hello.session, layout, hello, key=key), size)

    def _fit(self, hello: m.Hello, address: Address) -> Layout | str:
        """The layout of a simulator that is accepted, or the reason to refuse it."""
        if self.closed:
            return "the agent has closed"
        low, high = hello.versions
        if not low <= binary.VERSION <= high:
            return f"expected protocol version {binary.VERSION}, got {low} to {high}"
        if unknown := [e.number for e in hello.extensions if e.critical]:
            return f"expected no critical extension of type {unknown[0]}"
        layout = self._accept(hello)
        try:
            if isinstance(layout, Layout):
                check_size(layout.command_size, largest_datagram(address, self._max_datagram))
        except InputError as error:
            return str(error)
        return layout

    def _welcome(self, hello: m.Hello, layout: Layout, address: Address, key: Key | None) -> None:
        self._queue.pop(address, None)
        nonce = self._draw_nonce()
        welcome = m.Welcome(session=hello.session, nonce=nonce, extensions=self._extensions)
        opening = Session(address, hello.session, layout, hello, key=key, welcome=welcome)
        opening.move(Way.SENT, m.Welcome)
        opening.reply = self._transfer(binary.encode(welcome), opening)
        self._put(opening.reply.start(), address, key)
        _keep(self._openings, (address, hello.session), opening)

    def _let_wait(self, session: Session, size: int) -> None:
        wait = binary.encode(m.Wait(session=session.number))
        self._put([wait], session.peer, session.key)
        session.move(Way.SENT, m.Wait)
        session.room = size - len(wait)
        _keep(self._queue, session.peer, session)

    def _take_state(
        self, slot: int, session: Session, state: State, plain: bytes, now: float
    ) -> Event:
        """The next State of a slot."""
        session.sequence, session.state = state.sequence, _AFTER_STATE
        self.statistics.round_trips.add(now - session.asked_at)
        self._record(slot, state, plain, session)
        return Event(slot, state)

    def _join(
        self, opening: Session, state: State, plain: bytes, arrival: _Arrival
    ) -> Event | None:
        """The first State of a session that was welcomed."""
        assert opening.welcome is not None
        assert opening.hello is not None
        if state.sequence != 1 or state.nonce != opening.welcome.nonce:
            # Its Hello was an old one: this simulator goes on with another agent, or a copy of
            # its Hello came late.
            self._forget(opening)
            self._disown(plain, arrival)
            return None
        for key, other in list(self._openings.items()):
            # It, and what the same address began before it. Later ones stay: if this State came
            # late, their Hello may still be repeated.
            if key[0] == opening.peer:
                self._forget(other)
            if other is opening:
                break
        layout = self._fit(opening.hello, opening.peer)  # another one may have come since its Hello
        if isinstance(layout, str):
            words = _cut(layout, len(plain) - _REASON_AT)
            close = m.Close(session=opening.number, sequence=1, reason=words)
            self._put([binary.encode(close)], opening.peer, self._session_key(opening))
            opening.move(Way.SENT, m.Close)
            self._drop("refused", layout, arrival)
            return None
        full = None not in self.slots and opening.peer not in self._slot_of
        if full or self._seated(opening.number, elsewhere=opening.peer):  # another was quicker
            self._disown(plain, arrival)
            return None
        opening.key = self._session_key(opening)
        return self._seat(opening, state, plain)

    def _seat(self, session: Session, state: State, plain: bytes) -> Event:
        """Give a session its slot: that of an earlier one of its address, or a free one."""
        slot = self._slot_of.get(session.peer, -1)
        if slot >= 0:
            self.free(slot)
        else:
            slot = self.slots.index(None)
        self.slots[slot] = session
        self._slot_of[session.peer] = slot
        session.move(Way.RECEIVED, State)
        session.sequence = state.sequence
        session.is_plain = session.key is None and not session.is_text
        self.statistics.counters["sessions"] += 1
        for message in (session.hello, session.welcome):
            if message:
                self._record(slot, message, binary.encode(message), session)
        self._record(slot, state, plain, session)
        return Event(slot, state, joined=True)

    def _receive_stranger(self, kind: int, plain: bytes, arrival: _Arrival) -> None:
        """A message of a session that is none here."""
        if kind in (binary.STATE, binary.MISSING):
            self._disown(plain, arrival)
        else:  # the answer to a Close of ours, mostly: not counted
            self.statistics.counters["foreign"] += 1

    def _disown(self, plain: bytes, arrival: _Arrival) -> None:
        """A State of a session that is none here: its simulator is to begin another.

        If it took a slot that was taken meanwhile, it will be told to wait.
        """
        datagram, address, _ = arrival
        _, number, sequence = binary.peek(plain)
        if is_fragment(plain) and not asks(plain):
            return  # one answer will do
        if not sequence:
            self._drop("malformed", "expected a State from 1 on, got 0", arrival)
            return
        if self.closed or self._seated(number, elsewhere=address):
            # Another address has it: no answer of ours may end it.
            self._drop("foreign", f"session {number:016x}", arrival)
            return
        self.statistics.counters["foreign"] += 1  # after a restart of ours, mostly: no word of it
        reply = binary.encode(m.Unknown(session=number, sequence=sequence))
        if self._keys:  # of use only to the one that has sent this State
            key = self._keys.get(key_id(datagram))
            if key is None:
                return
            reply = key.seal(reply, datagram)
        self._put([reply], address, None)

    def _seated(self, number: int, elsewhere: Address | None = None) -> bool:
        """Whether a session of that number has a slot (not of this address)."""
        return any(s and s.number == number and s.peer != elsewhere for s in self.slots)

    def _forget(self, opening: Session) -> None:
        del self._openings[opening.peer, opening.number]
        self._assembling.pop((opening.peer, opening.number), None)

    # ---- text

    def _receive_text(self, slot: int, session: Session | None, arrival: _Arrival) -> Event | None:
        datagram, address, now = arrival
        layout = None if self._keys else self._text_layout()
        if layout is None:
            sequence, fields = text.split(datagram)
            cause, reason = "refused", "text is not flown here"
            if self._keys:
                cause, reason = "forged", "key: this agent has one (--key-file), text has none"
            if fields == ["close"]:  # two agents would answer each other's Closes for ever
                self._drop(cause, reason, arrival)
            else:
                self._turn_text_away(sequence, cause, reason, arrival)
            return None
        message = text.decode_state(datagram, layout)
        if session and session.is_text:
            event = self._receive_known(slot, session, message, b"", arrival)
            if event and isinstance(message, State):
                session.last = datagram
            return event
        if isinstance(message, m.Close):
            self.statistics.counters["foreign"] += 1
            return None
        last, number, until = self._ended_text.get(address, (b"", 0, 0.0))
        is_late = last == datagram or 1 < number == message.sequence
        if is_late and now < until:
            reason = "a copy of the last line of a simulator that has closed"
        elif self.closed:
            reason = "the agent has closed"
        elif not self.takes_text or session:
            reason = "text is not flown here"
        elif None not in self.slots:
            reason = "every slot is taken"
        else:
            joining = Session(address, 0, layout, None, last=datagram)
            return self._seat(joining, message, b"")
        self._turn_text_away(message.sequence, "refused", reason, arrival)
        return None

    def _turn_text_away(self, sequence: int, cause: str, reason: str, arrival: _Arrival) -> None:
        """Answer a line that is not flown, with no more bytes than it has."""
        line = text.encode(m.Close(session=0, sequence=sequence, reason=""))
        if len(line) <= len(arrival.datagram):
            self._put([line], arrival.address, None)
        self._drop(cause, reason, arrival)

    # ---- from a datagram to a message

    def _open(self, arrival: _Arrival, session: Session | None) -> tuple[bytes, Key | None]:
        """A binary datagram without its seal, and the shared key that it was sealed with.

        Raises `_KeyMismatch`, `Forged`, or `_NoSuchSession` where it has no key here.
        """
        datagram, address, _ = arrival
        if not (self._keys or is_sealed(datagram)):
            return datagram, None
        if not self._keys:
            raise _KeyMismatch("key: this agent has none (--key-file), and the simulator has")
        if not is_sealed(datagram):
            raise _KeyMismatch("key: this agent has one (--key-file), and the simulator has none")
        shared = self._keys.get(key_id(datagram))
        if shared is None:
            raise Forged("key: the simulator has another one")
        plain = message_of(datagram)
        kind, number, sequence = binary.peek(plain)
        if kind not in binary.OF_SESSION and not (kind == binary.MISSING and sequence):
            return shared.open(datagram), shared
        if session and session.number == number and session.key:
            return session.key.open(datagram), shared
        opening = self._openings.get((address, number))
        if opening and (key := self._session_key(opening)):
            # If the Welcome was for an old copy of its Hello, it is as good as none.
            with suppress(Forged):
                return key.open(datagram), shared
        raise _NoSuchSession(f"session {number:016x}")

    def _session_key(self, opening: Session) -> Key | None:
        assert opening.welcome is not None
        key = opening.key
        return key.for_session(opening.number, opening.welcome.nonce) if key else None

    def _assemble(
        self, fragment: bytes, holder: Session | None, arrival: _Arrival, key: Key | None
    ) -> bytes | None:
        """The message of an accepted sender, once all its fragments are there."""
        kind, number, sequence = binary.check(fragment)
        kind &= ~binary.FRAGMENT
        if kind == binary.HELLO and holder is None:
            assembler = self._assembler((arrival.address, number), binary.LONGEST_HELLO)
        elif kind == binary.HELLO and holder and holder.state is AgentState.WELCOMED:
            if asks(fragment):
                self._repeat(holder)
            self._drop("duplicate", "", arrival)
            return None
        elif kind != binary.STATE:
            self._drop("foreign", f"a fragment of type {kind}", arrival)
            return None
        elif holder is None or sequence > holder.sequence + 1:
            self._disown(fragment, arrival)
            return None
        elif sequence <= holder.sequence:
            is_repeat = sequence == holder.sequence
            if is_repeat and asks(fragment):
                self._answer_again(holder)
            self._drop("duplicate" if is_repeat else "stale", "", arrival)
            return None
        elif holder.state is AgentState.WELCOMED:
            assembler = self._assembler((holder.peer, number), holder.layout.state_size)
            key = self._session_key(holder)
        else:
            holder.assembler = holder.assembler or Assembler(holder.layout.state_size)
            assembler, key = holder.assembler, holder.key
            holder.heard_at = arrival.now
        whole = assembler.take(fragment)
        if whole is not None:
            self._assembling.pop((arrival.address, number), None)
        elif asks(fragment) and (missing := assembler.missing()):
            reply = binary.encode(missing)
            if holder is None or holder.state is AgentState.WELCOMED:  # no more bytes than came
                body = reply[binary.HEADER_SIZE : len(fragment)]
                reply = binary.frame(binary.MISSING, number, sequence, body)
            self._put([reply], arrival.address, key)
        return whole

    def _assembler(self, key: tuple[Address, int], largest: int) -> Assembler:
        """Of one without a slot: kept for the last few that have sent any fragments."""
        assembler = self._assembling.get(key) or Assembler(largest)
        _keep(self._assembling, key, assembler, max(_LEAST_ASSEMBLING, len(self.slots)))
        return assembler

    def _refuse_undecoded(self, error: DecodeError, arrival: _Arrival) -> None:
        """Count it, and answer an opening if its sender can only mend it when told."""
        datagram, address, _ = arrival
        under_seal, size = is_sealed(datagram), len(datagram)
        plain = message_of(datagram) if under_seal else datagram
        kind, number, _ = binary.peek(plain)
        if isinstance(error, _NoSuchSession):
            self._receive_stranger(kind, plain, arrival)
            return
        if isinstance(error, _KeyMismatch | VersionMismatch) and kind == binary.HELLO:
            trusted = under_seal and not isinstance(error, _KeyMismatch)
            key = self._keys.get(key_id(datagram)) if trusted else None
            self._refuse(number, str(error), address, size, key)
        self._drop("forged" if isinstance(error, Forged) else "malformed", str(error), arrival)

    # ---- what is sent

    def _answer(self, slot: int, session: Session, message: Command | m.Close) -> None:
        """Send a message to a simulator that has a slot. Its bytes are kept for a repeated State.

        Raises `InputError` if it cannot be encoded; then nothing has changed.
        """
        data = text.encode(message) if session.is_text else binary.encode(message, session.layout)
        session.move(Way.SENT, type(message))
        self._record(slot, message, data, session)
        session.reply = reply = self._transfer(data, session)
        self._put(reply.start(), session.peer, session.key)

    def _repeat(self, session: Session) -> None:
        """Send the last answer again, the same bytes."""
        assert session.reply is not None
        self._put(session.reply.start(), session.peer, session.key, "resent")

    def _answer_again(self, session: Session) -> None:
        """Answer a State that came again: with Alive, while its Command is not there yet."""
        if session.state is not AgentState.DECIDING:
            self._repeat(session)
        elif not session.is_text:
            alive = m.Alive(session=session.number, sequence=session.sequence)
            self._put([binary.encode(alive)], session.peer, session.key)
            self.statistics.counters["sent"] += 1

    def _refuse(
        self, number: int, reason: str, address: Address, size: int, key: Key | None
    ) -> None:
        """Refuse a Hello that came in so many bytes, with no more than those."""
        room = size - _REASON_AT - (OVERHEAD if key else 0)
        if room >= 0:
            refuse = m.Refuse(session=number, reason=_cut(reason, room))
            self._put([binary.encode(refuse)], address, key)

    def _transfer(self, data: bytes, session: Session) -> Transfer:
        if not session.largest:
            session.largest = largest_datagram(session.peer, self._max_datagram)
        return Transfer(data, session.largest, session.window)

    def _put(
        self, datagrams: list[bytes], address: Address, key: Key | None, count: str = "sent"
    ) -> None:
        for datagram in datagrams:
            self._outgoing.append((key.seal(datagram) if key else datagram, address))
        self.statistics.counters[count] += 1

    def _record(self, slot: int, message: Message, data: bytes, session: Session) -> None:
        if self.tap:
            whole = binary.encode(message, session.layout) if session.is_text else data
            self.tap(slot, message, whole)

    def _drop(self, cause: str, reason: str, arrival: _Arrival) -> None:
        host, port = arrival.address
        self.statistics.drop(cause, f"from {host}:{port}: {reason}", arrival.now)


def _goodbye(session: Session, reason: str) -> m.Close:
    return m.Close(session=session.number, sequence=session.sequence, reason=one_line(reason))


def _cut(reason: str, room: int) -> str:
    """A reason that takes at most so many bytes."""
    return one_line(reason).encode()[:room].decode(errors="ignore")


def _keep(table: "OrderedDict[Any, Any]", key: Any, value: Any, most: int = _MOST) -> None:
    """Put into a table that forgets its oldest entries."""
    table[key] = value
    table.move_to_end(key)
    if len(table) > most:
        table.popitem(last=False)
