"""The agent's side of the exchange (UDP server), free of sockets and clocks: see `link`.

It has places, one for each simulator that it flies. A Hello that fits is welcomed, and takes a
place only when its first State has come: a Hello that was recorded and sent again takes none.

`session` knows what one simulator may send next, `admission` who has a place or wants one,
`unsealing` which key a datagram is under, and `outbox` what is sent. Here they are joined.
"""

import secrets
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from . import binary, text
from .admission import Admission
from .errors import DecodeError, Forged, VersionMismatch
from .keys import Key, is_sealed, message_of
from .link import CLOSE_INTERVAL, CLOSE_LINGER, Address, Tap, encode
from .messages import Close, Command, Hello, Message, State, Unknown, Wait, Welcome
from .outbox import Outbox
from .parts import is_first, is_part
from .session import Session
from .statistics import Statistics
from .unsealing import KeyMismatch, NoSuchSession, unseal

__all__ = ["AgentLink", "Event", "Session"]


class Event(NamedTuple):
    """What a datagram brought."""

    place: int
    message: State | Close
    joined: bool = False
    """The State is the first of a new session, which may have taken the place of another."""


class _Arrival(NamedTuple):
    datagram: bytes
    address: Address
    now: float


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
        self._admission = Admission(places)
        self.places = self._admission.places
        """Session of each place, None where it is free."""
        self.closed = False
        self.takes_text = True
        """Whether a text simulator may take a free place."""
        self.statistics = Statistics()
        self._accept = accept
        self._text_sizes = text_sizes
        self._key = key
        self._draw_nonce = draw_nonce
        self._outbox = Outbox(self.statistics, tap)
        self._resend_at = self._deadline = 0.0

    def receive(self, datagram: bytes, address: Address, now: float) -> Event | None:
        """Take a datagram; what it brought, if it moves an exchange on."""
        self.statistics.counters["received"] += 1
        arrival = _Arrival(datagram, address, now)
        place, session = self._admission.seat_of(address)
        try:
            is_text = self._key is None and text.is_text(datagram)
            read = self._read(arrival, session, is_text)
        except DecodeError as error:
            self._refuse_undecoded(error, arrival)
            return None
        if read is None:  # it was dropped, or is a part and others are to come
            return None
        plain, message = read
        if session and (message.session, is_text) == (session.number, session.is_text):
            return self._receive_known(place, session, message, plain, arrival)
        if isinstance(message, Hello):
            self._receive_hello(message, arrival)
        elif isinstance(message, State) and is_text:
            return self._join_by_text(message, session, arrival)
        elif isinstance(message, State):
            return self._join(message, plain, arrival)
        elif isinstance(message, Close):  # the answer to one of ours, mostly: not worth a word
            self.statistics.counters["foreign"] += 1
        else:
            self._drop("foreign", type(message).__name__, arrival)
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
        self._outbox.answer(place, session, command)
        session.state, session.asked_at = "expecting", now

    def free(self, place: int) -> None:
        """Give the place of a simulator that has fallen silent to the next that comes."""
        self._admission.free(place)

    def close(self, reason: str, now: float) -> None:
        """End every exchange and tell the simulators, until they answer."""
        if self.closed:
            return
        self.closed = True
        for place, session in enumerate(self.places):
            if session:
                self._outbox.answer(place, session, session.goodbye(reason))
                session.state = "closing"
        for address, (number, room) in self._admission.waiting.items():
            self._outbox.refuse(number, reason, address, room, self._key)
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
                self._outbox.repeat(session)
        self._resend_at = now + CLOSE_INTERVAL

    def take_outgoing(self) -> list[tuple[bytes, Address]]:
        """Datagrams to send and where to, each once."""
        return self._outbox.take()

    # ---- a simulator that comes

    def _receive_hello(self, hello: Hello, arrival: _Arrival) -> None:
        admission, address, size = self._admission, arrival.address, len(arrival.datagram)
        opening = admission.openings.get((address, hello.session))
        if hello.session in admission.ended:
            self._drop("stale", "", arrival)
        elif opening and not self.closed:
            self._outbox.repeat(opening)
            self._drop("duplicate", "", arrival)
        elif reason := self._reason_to_refuse(hello):
            self._outbox.refuse(hello.session, reason, address, size, self._key)
            self._drop("refused", reason, arrival)
        elif admission.has_room(address):
            self._welcome(hello, address)
        else:
            wait = self._outbox.send(Wait(session=hello.session), address, self._key)
            admission.wait(address, hello.session, size - len(wait))

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
        reply = [self._outbox.send(welcome, address, self._key)]
        opening = Session(
            peer=address, hello=hello, number=hello.session, key=key, welcome=welcome, reply=reply
        )
        self._admission.open(opening)

    def _join(self, state: State, plain: bytes, arrival: _Arrival) -> Event | None:
        """A State from an address that has no such session: the first of one, or of none here."""
        address = arrival.address
        opening = self._admission.openings.get((address, state.session))
        if opening and state.sequence != 1:  # its Hello was an old one: another agent knew it
            self._admission.forget(address, state.session)
            opening = None
        if opening is None:
            self._disown(arrival)
            return None
        if reason := opening.misfit(state):
            self._drop("malformed", reason, arrival)
            return None
        self._admission.forget_until(opening)
        assert opening.hello is not None
        # Another one may have come since its Hello.
        if reason := "the agent has closed" if self.closed else self._accept(opening.hello):
            self._outbox.turn_away(opening, reason, len(plain))
            self._drop("refused", reason, arrival)
            return None
        if not self._admission.has_room(address):  # another one was quicker
            self._disown(arrival)
            return None
        return self._seat(opening, state, plain)

    def _join_by_text(
        self, state: State, session: Session | None, arrival: _Arrival
    ) -> Event | None:
        """A line from an address that has no text session: the first of one, if there is room."""
        if self.takes_text and session is None and None in self.places and not self.closed:
            return self._seat(Session(peer=arrival.address, hello=None, number=0), state, b"")
        self._outbox.close_text(state.sequence, arrival.address)
        if self.closed:
            reason = "the agent has closed"
        else:
            reason = "every place is taken" if self.takes_text else "text is not flown here"
        self._drop("refused", reason, arrival)
        return None

    def _seat(self, session: Session, state: State, plain: bytes) -> Event:
        """Give a session its place."""
        place, record = self._admission.seat(session), self._outbox.record
        session.sequence, session.state = state.sequence, "deciding"
        self.statistics.counters["sessions"] += 1
        if session.hello and session.welcome:
            record(place, session.hello, encode(session.hello))
            record(place, session.welcome, encode(session.welcome))
        record(place, state, plain, is_text=session.is_text)
        return Event(place, state, joined=True)

    def _disown(self, arrival: _Arrival) -> None:
        """A State of a session that is none here: its simulator is to begin another."""
        datagram, address, _ = arrival
        plain = message_of(datagram) if self._key else datagram
        _, number, sequence = binary.peek(plain)
        if not is_first(plain):
            return  # one answer will do
        # With a key an Unknown is of use to him alone who has sent this State.
        sealed = self._key is not None
        if self.closed or self._admission.is_elsewhere(number, address, seated=sealed):
            # Somebody else holds it, elsewhere: no word of ours shall end it.
            self._drop("foreign", f"session {number:016x}", arrival)
            return
        self.statistics.counters["foreign"] += 1  # after a restart of ours, mostly: no word of it
        reply = encode(Unknown(session=number, sequence=sequence))
        if self._key:
            reply = self._key.seal(reply, datagram)
        self._outbox.put(reply, address)

    # ---- a simulator that has its place

    def _receive_known(
        self, place: int, session: Session, message: Message, plain: bytes, arrival: _Arrival
    ) -> Event | None:
        if isinstance(message, State) and message.sequence == session.sequence:
            if session.state != "deciding":  # else the answer is still being thought of
                self._outbox.repeat(session)
            self._drop("duplicate", "", arrival)
            return None
        if isinstance(message, State) and session.hello and message.sequence > session.sequence + 1:
            # It went on with another agent: what opened it here came late, from before a restart.
            self._disown(arrival)
            return None
        state = session.next_state(message)
        if state is None or not isinstance(message, State | Close):
            self._drop("stale", "", arrival)
            return None
        if isinstance(message, State) and (reason := session.misfit(message)):
            self._drop("malformed", reason, arrival)
            return None
        before, session.state = session.state, state
        self._outbox.record(place, message, plain, is_text=session.is_text)
        if isinstance(message, Close):
            if before != "closing":
                self._outbox.answer(place, session, session.goodbye(""))
            self.free(place)
        else:
            session.sequence = message.sequence
            if session.asked_at is not None:
                self.statistics.round_trips.add(arrival.now - session.asked_at)
        return Event(place, message)

    # ---- from a datagram to a message

    def _read(
        self, arrival: _Arrival, seated: Session | None, is_text: bool
    ) -> tuple[bytes, Message] | None:
        """The bytes of a whole message, without its seal, and the message. Raises `DecodeError`."""
        if is_text:
            return arrival.datagram, text.decode_state(arrival.datagram, *self._text_sizes)
        plain = unseal(arrival.datagram, arrival.address, self._key, self._admission)
        if is_part(plain):
            whole = self._assemble(plain, seated, arrival)
            return (whole, binary.decode(whole)) if whole is not None else None
        return plain, binary.decode(plain)

    def _assemble(self, part: bytes, seated: Session | None, arrival: _Arrival) -> bytes | None:
        """The State, once all its parts are there, of a session that may send it now."""
        kind, number, sequence = binary.check(part)
        session = seated
        if session is None or session.number != number:
            session = self._admission.openings.get((arrival.address, number))
        if kind & ~binary.PART != binary.STATE:
            self._drop("foreign", f"a part of type {kind}", arrival)
        elif session is None or session.hello is None or sequence > session.sequence + 1:
            self._disown(arrival)
        elif sequence < session.sequence:
            self._drop("stale", "", arrival)
        else:
            if session is not seated:
                self._admission.keep_parts(session)
            return session.take_part(sequence, part)
        return None

    def _refuse_undecoded(self, error: DecodeError, arrival: _Arrival) -> None:
        """Count it, and answer an opening that whoever sent it can only mend when told."""
        datagram, address, _ = arrival
        under_seal, size = is_sealed(datagram), len(datagram)
        kind, number, _ = binary.peek(message_of(datagram) if under_seal else datagram)
        if isinstance(error, NoSuchSession):
            if kind == binary.STATE:
                self._disown(arrival)
            else:
                self._drop("foreign", str(error), arrival)
            return
        if isinstance(error, KeyMismatch | VersionMismatch) and kind == binary.HELLO:
            trusted = under_seal and not isinstance(error, KeyMismatch)
            key = self._key if trusted else None
            self._outbox.refuse(number, str(error), address, size, key)
        elif isinstance(error, KeyMismatch) and text.is_text(datagram):
            with suppress(DecodeError):
                line = text.decode_state(datagram, *self._text_sizes)
                if isinstance(line, State):  # two agents would answer each other's Closes for ever
                    self._outbox.close_text(line.sequence, address)
        cause = "forged" if isinstance(error, Forged) else "malformed"
        self._drop(cause, str(error), arrival)

    def _drop(self, cause: str, reason: str, arrival: _Arrival) -> None:
        host, port = arrival.address
        self.statistics.drop(cause, f"from {host}:{port}: {reason}", arrival.now)
