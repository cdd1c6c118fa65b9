"""The agent's side of the exchange (UDP server), free of sockets and clocks: see `link`.

It has places, one for each simulator that it flies. A Hello that fits is welcomed, and takes a
place only when its first State has come: a Hello that was recorded and sent again takes none.
"""

import secrets
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from . import binary, text
from .errors import DecodeError, Forged, VersionMismatch
from .keys import OVERHEAD, Key, is_sealed, message_of
from .link import CLOSE_INTERVAL, CLOSE_LINGER, Address, Tap, encode, packed
from .messages import (
    Close,
    Command,
    Hello,
    Message,
    Refuse,
    State,
    Unknown,
    Wait,
    Welcome,
    one_line,
)
from .parts import Assembler, is_first, is_part, turned
from .statistics import Statistics

__all__ = ["AgentLink", "Event", "Session"]

_MOST: Final = 1024
"""Simulators that are remembered between Hello and first State, while they wait, and after."""
_MOST_ASSEMBLING: Final = 16
"""Sessions without a place for which parts of a first State are kept."""
_REASON_AT: Final = binary.HEADER_SIZE + 2
"""Bytes of a Refuse or a Close before its reason."""

_NEXT: Final = {
    ("expecting", State): "deciding",
    ("expecting", Close): "closed",
    ("deciding", Close): "closed",
    ("closing", Close): "closed",
}
"""What a message of the welcome simulator does to its session; any other pair is dropped."""


@dataclass(eq=False)
class Session:
    """An open exchange with one simulator, pinned to its address and codec.

    `state` is one of `expecting` (a State), `deciding` (a State waits for its Command), `closing`
    (for the answer to a Close) and `closed`.
    """

    peer: Address
    hello: Hello | None
    """None if it speaks text."""
    number: int
    """Session number; 0 with the text codec."""
    key: Key | None = None
    welcome: Welcome | None = None
    reply: list[bytes] = field(default_factory=list)
    """The answer to the last State, or the Welcome: one datagram or its parts."""
    repeats: int = 0
    """How often an answer was sent again."""
    parts: Assembler | None = None
    """Of the State that is coming in parts."""
    state: str = "expecting"
    sequence: int = 0
    """Number of the State that came last."""
    asked_at: float | None = None
    """When the Command was sent whose State is expected."""

    @property
    def is_text(self) -> bool:
        """Whether it speaks the text codec."""
        return self.hello is None


class Event(NamedTuple):
    """What a datagram brought."""

    place: int
    message: State | Close
    joined: bool = False
    """The State is the first of a new session, which may have taken the place of another."""


class AgentLink:
    """Welcomes simulators and answers each of their States once.

    Args:
        accept: Looks at a Hello and gives the reason to refuse it, or "".
        text_sizes: Numbers of observation and of telemetry. A text simulator says no Hello: its
            first line opens the session, and these say how to read it.
        places: Simulators to fly at the same time. Others wait until a place is free.
        key: Shared with the simulators. Then nothing unsealed is taken.
        tap: Sees every message once.
        draw_nonce: Gives a random 64-bit number for each Welcome.
    """

    def __init__(
        self,
        accept: Callable[[Hello], str],
        text_sizes: tuple[int, int],
        *,
        places: int = 1,
        key: Key | None = None,
        tap: Tap | None = None,
        draw_nonce: Callable[[], int] = lambda: secrets.randbits(64),
    ) -> None:
        self.places: list[Session | None] = [None] * places
        self.closed = False
        self.takes_text = True
        """Whether a text simulator may take a free place."""
        self.statistics = Statistics()
        self._accept = accept
        self._text_sizes = text_sizes
        self._key = key
        self._tap = tap
        self._draw_nonce = draw_nonce
        self._seats: dict[Address, int] = {}
        self._openings: OrderedDict[tuple[Address, int], Session] = OrderedDict()
        self._waiting: OrderedDict[Address, tuple[int, int]] = OrderedDict()  # session, room
        self._ended: OrderedDict[int, None] = OrderedDict()
        self._assembling: list[Session] = []
        self._outgoing: list[tuple[bytes, Address]] = []
        self._resend_at = self._deadline = 0.0

    def receive(self, datagram: bytes, address: Address, now: float) -> Event | None:
        """Take a datagram; what it brought, if it moves an exchange on."""
        self.statistics.counters["received"] += 1
        place = self._seats.get(address, -1)
        session = self.places[place] if place >= 0 else None
        try:
            is_text = self._key is None and text.is_text(datagram)
            plain = datagram if is_text else self._open(datagram, address, session)
            if not is_text and is_part(plain):
                whole = self._assemble(plain, datagram, address, session, now)
                if whole is None:
                    return None
                plain = whole
            message = self._decode(plain, is_text)
        except DecodeError as error:
            self._refuse_undecoded(datagram, address, error, now)
            return None
        if session and (message.session, is_text) == (session.number, session.is_text):
            return self._receive_known(place, session, message, plain, datagram, now)
        if isinstance(message, Hello):
            self._receive_hello(message, address, len(datagram), now)
        elif isinstance(message, State) and is_text:
            return self._join_by_text(message, address, session, now)
        elif isinstance(message, State):
            return self._join(message, address, plain, datagram, now)
        elif isinstance(message, Close):  # the answer to one of ours, mostly: not worth a word
            self.statistics.counters["foreign"] += 1
        else:
            self._drop("foreign", type(message).__name__, address, now)
        return None

    def send_command(self, place: int, command: Command, now: float) -> None:
        """Answer the State of the same number. Its bytes are kept for a repeated State."""
        session = self.places[place]
        if session is None or (session.state, session.sequence) != ("deciding", command.sequence):
            got = (session.state, session.sequence) if session else "a free place"
            raise ValueError(
                f"send_command: expected a session that is 'deciding' on State "
                f"{command.sequence}, got {got}"
            )
        self._answer(place, session, command)
        session.state, session.asked_at = "expecting", now

    def free(self, place: int) -> None:
        """Give the place of a simulator that has fallen silent to the next that comes."""
        session, self.places[place] = self.places[place], None
        if session:
            del self._seats[session.peer]
            if session.hello:
                _keep(self._ended, session.number, None)

    def close(self, reason: str, now: float) -> None:
        """End every exchange and tell the simulators, until they answer."""
        if self.closed:
            return
        self.closed = True
        for place, session in enumerate(self.places):
            if session:
                close = Close(
                    session=session.number, sequence=session.sequence, reason=one_line(reason)
                )
                self._answer(place, session, close)
                session.state = "closing"
        for address, (number, room) in self._waiting.items():
            self._refuse(number, reason, address, room, key=self._key)
        self._resend_at, self._deadline = now + CLOSE_INTERVAL, now + CLOSE_LINGER

    def next_timer(self) -> float | None:
        """When `handle_timer` wants to be called; None if never."""
        if self.closed and any(self.places):
            return min(self._resend_at, self._deadline)
        return None

    def handle_timer(self, now: float) -> None:
        """Repeat what is due: a Close that nobody has answered, until nobody will."""
        timer = self.next_timer()
        if timer is None or now < timer:
            return
        for place, session in enumerate(self.places):
            if session and now >= self._deadline:
                self.free(place)
            elif session:
                self._repeat(session)
        self._resend_at = now + CLOSE_INTERVAL

    def take_outgoing(self) -> list[tuple[bytes, Address]]:
        """Datagrams to send and where to, each once."""
        outgoing, self._outgoing = self._outgoing, []
        return outgoing

    # ---- a simulator that comes

    def _receive_hello(self, hello: Hello, address: Address, size: int, now: float) -> None:
        opening = self._openings.get((address, hello.session))
        if hello.session in self._ended:
            self._drop("stale", "", address, now)
        elif opening and not self.closed:
            self._repeat(opening)
            self._drop("duplicate", "", address, now)
        elif reason := self._reason_to_refuse(hello):
            self._refuse(hello.session, reason, address, size, key=self._key)
            self._drop("refused", reason, address, now)
        elif None in self.places or address in self._seats:
            self._welcome(hello, address)
        else:
            wait = self._send(Wait(session=hello.session), address, self._key)
            _keep(self._waiting, address, (hello.session, size - len(wait)))

    def _reason_to_refuse(self, hello: Hello) -> str:
        if self.closed:
            return "the agent has closed"
        size = max(binary.state_size(hello), binary.command_size(hello))
        if size > binary.MAX_WHOLE:
            return f"expected States and Commands of at most {binary.MAX_WHOLE} bytes, got {size}"
        return self._accept(hello)

    def _welcome(self, hello: Hello, address: Address) -> None:
        welcome = Welcome(session=hello.session, nonce=self._draw_nonce())
        key = self._key.for_session(hello.session, welcome.nonce) if self._key else None
        reply = [self._send(welcome, address, self._key)]
        opening = Session(
            peer=address, hello=hello, number=hello.session, key=key, welcome=welcome, reply=reply
        )
        _keep(self._openings, (address, hello.session), opening)
        self._waiting.pop(address, None)

    def _join(
        self, state: State, address: Address, plain: bytes, datagram: bytes, now: float
    ) -> Event | None:
        """A State from an address that has no such session: the first of one, or of none here."""
        opening = self._openings.get((address, state.session))
        if opening and state.sequence != 1:  # its Hello was an old one: another agent knew it
            del self._openings[address, state.session]
            opening = None
        if opening is None:
            self._disown(datagram, address, now)
            return None
        if reason := _misfit(opening, state):
            self._drop("malformed", reason, address, now)
            return None
        self._forget(opening)
        assert opening.hello is not None
        # Another one may have come since its Hello.
        if reason := "the agent has closed" if self.closed else self._accept(opening.hello):
            words = _cut(reason, len(datagram) - _REASON_AT - (OVERHEAD if self._key else 0))
            close = Close(session=state.session, sequence=1, reason=words)
            self._send(close, address, opening.key)
            self._drop("refused", reason, address, now)
            return None
        place = self._seats.get(address, -1)
        if place < 0 and None not in self.places:  # another one was quicker
            self._disown(datagram, address, now)
            return None
        return self._seat(place, opening, state, plain)

    def _forget(self, opening: Session) -> None:
        """The opening of a State 1, and what the same address began before it.

        That has not ended: if this State came late, a simulator may still say that Hello.
        """
        for address, number in list(self._openings):
            if address == opening.peer:
                del self._openings[address, number]
                if number == opening.number:
                    return

    def _join_by_text(
        self, state: State, address: Address, session: Session | None, now: float
    ) -> Event | None:
        """A line from an address that has no text session: the first of one, if there is room."""
        if self.takes_text and session is None and None in self.places and not self.closed:
            newcomer = Session(peer=address, hello=None, number=0)
            return self._seat(-1, newcomer, state, b"")
        self._close_text(state.sequence, address)
        if self.closed:
            reason = "the agent has closed"
        else:
            reason = "every place is taken" if self.takes_text else "text is not flown here"
        self._drop("refused", reason, address, now)
        return None

    def _seat(self, place: int, session: Session, state: State, plain: bytes) -> Event:
        """Give a session its place: the first free one, or that of an earlier session."""
        if place < 0:
            place = self.places.index(None)
        else:
            self.free(place)
        self.places[place] = session
        self._seats[session.peer] = place
        if session in self._assembling:
            self._assembling.remove(session)
        session.sequence, session.state = state.sequence, "deciding"
        self.statistics.counters["sessions"] += 1
        if session.hello and session.welcome:
            self._record(place, session.hello, encode(session.hello))
            self._record(place, session.welcome, encode(session.welcome))
        self._record(place, state, plain, is_text=session.is_text)
        return Event(place, state, joined=True)

    def _disown(self, datagram: bytes, address: Address, now: float) -> None:
        """A State of a session that is none here: its simulator is to begin another."""
        plain = message_of(datagram) if self._key else datagram
        _, number, sequence = binary.peek(plain)
        if not is_first(plain):
            return  # one answer will do
        held = {(s.peer, s.number) for s in self.places if s}
        if self._key is None:  # else an Unknown is of use to him alone who has sent this State
            held.update(self._openings)
            held.update((there, waits) for there, (waits, _) in self._waiting.items())
        if self.closed or any(n == number and there != address for there, n in held):
            # Somebody else holds it, elsewhere: no word of ours shall end it.
            self._drop("foreign", f"session {number:016x}", address, now)
            return
        self.statistics.counters["foreign"] += 1  # after a restart of ours, mostly: no word of it
        reply = encode(Unknown(session=number, sequence=sequence))
        if self._key:
            reply = self._key.seal(reply, datagram)
        self._put(reply, address)

    # ---- a simulator that has its place

    def _receive_known(
        self,
        place: int,
        session: Session,
        message: Message,
        plain: bytes,
        datagram: bytes,
        now: float,
    ) -> Event | None:
        address = session.peer
        if isinstance(message, State) and message.sequence == session.sequence:
            if session.state != "deciding":  # else the answer is still being thought of
                self._repeat(session)
            self._drop("duplicate", "", address, now)
            return None
        if isinstance(message, State) and session.hello and message.sequence > session.sequence + 1:
            # It went on with another agent: what opened it here came late, from before a restart.
            self._disown(datagram, address, now)
            return None
        state = _NEXT.get((session.state, type(message)))
        if (
            state is None
            or not isinstance(message, State | Close)
            or not _is_next(session, message)
        ):
            self._drop("stale", "", address, now)
            return None
        if isinstance(message, State) and (reason := _misfit(session, message)):
            self._drop("malformed", reason, address, now)
            return None
        before, session.state = session.state, state
        self._record(place, message, plain, is_text=session.is_text)
        if isinstance(message, Close):
            if before != "closing":
                close = Close(session=session.number, sequence=session.sequence, reason="")
                self._answer(place, session, close)
            self.free(place)
        else:
            session.sequence = message.sequence
            if session.asked_at is not None:
                self.statistics.round_trips.add(now - session.asked_at)
        return Event(place, message)

    def _answer(self, place: int, session: Session, message: Command | Close) -> None:
        datagram = encode(message, as_text=session.is_text)
        self._record(place, message, datagram, is_text=session.is_text)
        session.reply = packed(datagram, session.key)
        self._outgoing += [(part, session.peer) for part in session.reply]
        self.statistics.counters["sent"] += 1

    def _repeat(self, session: Session) -> None:
        """Send its last answer again, the same bytes."""
        session.repeats += 1
        parts = turned(session.reply, session.repeats)
        self._outgoing += [(part, session.peer) for part in parts]
        self.statistics.counters["resent"] += 1

    # ---- a State in parts

    def _assemble(
        self, part: bytes, datagram: bytes, address: Address, session: Session | None, now: float
    ) -> bytes | None:
        """The State, once all its parts are there, of a session that may send it now."""
        kind, number, sequence = binary.check(part)
        if session is None or session.number != number:
            session = self._openings.get((address, number))
        if kind & ~binary.PART != binary.STATE:
            self._drop("foreign", f"a part of type {kind}", address, now)
        elif session is None or session.hello is None or sequence > session.sequence + 1:
            self._disown(datagram, address, now)
        elif sequence < session.sequence:
            self._drop("stale", "", address, now)
        else:
            if session.parts is None:
                session.parts = Assembler(binary.state_size(session.hello))
                if (address, number) in self._openings:
                    self._limit_assembling(session)
            return session.parts.take(sequence, part)
        return None

    def _limit_assembling(self, opening: Session) -> None:
        """Keep parts for the last few that want a place: anybody may say Hello and send parts."""
        self._assembling.append(opening)
        if len(self._assembling) > _MOST_ASSEMBLING:
            self._assembling.pop(0).parts = None

    # ---- strangers

    def _open(self, datagram: bytes, address: Address, session: Session | None) -> bytes:
        """A binary datagram without its seal. Raises `DecodeError`."""
        if self._key is None:
            if is_sealed(datagram):
                raise _KeyMismatch("key: this agent has none (--key-file), and the simulator has")
            return datagram
        if not is_sealed(datagram):
            raise _KeyMismatch("key: this agent has one (--key-file), and the simulator has none")
        kind, number, _ = binary.peek(message_of(datagram))
        if kind not in binary.OF_SESSION:
            return self._key.open(datagram)
        if session and session.key and session.number == number:
            return session.key.open(datagram)
        # If the Welcome was not for this one, but for an old copy of its Hello, it is as good as
        # none.
        opening = self._openings.get((address, number))
        if opening and opening.key:
            with suppress(DecodeError):
                return opening.key.open(datagram)
        raise _NoSuchSession(f"session {number:016x}")

    def _decode(self, datagram: bytes, is_text: bool) -> Message:
        if is_text:
            return text.decode_state(datagram, *self._text_sizes)
        return binary.decode(datagram)

    def _refuse_undecoded(
        self, datagram: bytes, address: Address, error: DecodeError, now: float
    ) -> None:
        """Count it, and answer an opening that whoever sent it can only mend when told."""
        under_seal, size = is_sealed(datagram), len(datagram)
        kind, number, _ = binary.peek(message_of(datagram) if under_seal else datagram)
        if isinstance(error, _NoSuchSession):
            if kind == binary.STATE:
                self._disown(datagram, address, now)
            else:
                self._drop("foreign", str(error), address, now)
            return
        if isinstance(error, _KeyMismatch | VersionMismatch) and kind == binary.HELLO:
            trusted = under_seal and not isinstance(error, _KeyMismatch)
            self._refuse(number, str(error), address, size, key=self._key if trusted else None)
        elif isinstance(error, _KeyMismatch) and text.is_text(datagram):
            with suppress(DecodeError):
                line = text.decode_state(datagram, *self._text_sizes)
                if isinstance(line, State):  # two agents would answer each other's Closes for ever
                    self._close_text(line.sequence, address)
        cause = "forged" if isinstance(error, Forged) else "malformed"
        self._drop(cause, str(error), address, now)

    def _refuse(
        self, number: int, reason: str, address: Address, size: int, *, key: Key | None
    ) -> None:
        """Refuse a Hello of so many bytes, with no more than it had."""
        room = size - _REASON_AT - (OVERHEAD if key else 0)
        if room >= 0:
            self._send(Refuse(session=number, reason=_cut(reason, room)), address, key)

    def _close_text(self, sequence: int, address: Address) -> None:
        close = Close(session=0, sequence=sequence, reason="")
        self._put(text.encode(close), address)

    def _send(self, message: Message, address: Address, key: Key | None) -> bytes:
        (datagram,) = packed(encode(message), key)
        self._put(datagram, address)
        return datagram

    def _put(self, datagram: bytes, address: Address) -> None:
        self._outgoing.append((datagram, address))
        self.statistics.counters["sent"] += 1

    def _record(
        self, place: int, message: Message, datagram: bytes, *, is_text: bool = False
    ) -> None:
        if self._tap:
            self._tap(place, message, binary.encode(message) if is_text else datagram)

    def _drop(self, cause: str, reason: str, address: Address, now: float) -> None:
        self.statistics.drop(cause, f"from {address[0]}:{address[1]}: {reason}", now)


class _KeyMismatch(Forged):
    """One side has a key, the other has none."""


class _NoSuchSession(DecodeError):
    """A sealed message of a session whose key is not here."""


def _keep(table: "OrderedDict[Any, Any]", key: Any, value: Any) -> None:
    """Put into a table that forgets its oldest entries."""
    table[key] = value
    table.move_to_end(key)
    if len(table) > _MOST:
        table.popitem(last=False)


def _cut(reason: str, room: int) -> str:
    """A reason that takes at most so many bytes."""
    return one_line(reason).encode()[:room].decode(errors="ignore")


def _is_next(session: Session, message: State | Close) -> bool:
    ahead = message.sequence - session.sequence
    # The State before a Close may have been lost, but not while it is answered.
    if isinstance(message, Close):
        return ahead == 0 or (ahead == 1 and session.state != "deciding")
    return ahead == 1


def _misfit(session: Session, state: State) -> str:
    if session.hello is None:
        return ""  # a text line was read by `text_sizes`
    hello = session.hello
    expected = (hello.num_drones, hello.observation_low.size, len(hello.telemetry_names))
    got = (*state.observations.shape, state.telemetry.shape[1])
    if got == expected:
        return ""
    return f"State: expected (drones, observations, telemetry) = {expected}, got {got}"
