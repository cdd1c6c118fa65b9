"""The agent's side of the exchange (UDP server), free of sockets and clocks.

It has slots, one for each simulator that it flies. `admission` gives them, `session` is the
exchange with a simulator that has one. A repeated State is answered with the bytes of the first
answer.
"""

from contextlib import suppress

from . import binary, text
from . import messages as m
from .admission import Admission, Arrival
from .auth import Key, is_sealed, key_id, message_of
from .client import CLOSE_INTERVAL, CLOSE_LINGER, Address
from .errors import DecodeError, Forged, VersionMismatch
from .fragments import is_fragment
from .messages import State
from .session import Event, NoSuchSession, Session
from .transitions import AgentState, Way

__all__ = ["Event", "Server", "Session"]


class _KeyMismatch(Forged):
    """One side has a key, the other has none."""


class Server(Admission):
    """Welcomes simulators and answers each of their States once. Arguments: see `Admission`."""

    _resend_at = _deadline = 0.0

    # ---- what the caller does

    def receive(self, datagram: bytes, address: Address, now: float) -> Event | None:
        """Take a datagram; its effect, if it moves an exchange on."""
        self.statistics.counters["received"] += 1
        session = self._seated.get(address)
        if session and session.is_plain and session.state is AgentState.EXPECTING:
            number = session.number
            sequence = session.sequence + 1
            state = binary.decode_due(binary.STATE, datagram, number, sequence, session.layout)
            if isinstance(state, State):
                return session.take_state(state, datagram, now)
        return self._receive_any(session, Arrival(datagram, address, now))

    def close(self, reason: str, now: float) -> None:
        """End every exchange and tell the simulators, until they answer."""
        if self._closed:
            return
        for session in self.slots:
            if session:
                session.send_close(reason)
        self._closed = True
        for queued in self._queue.values():
            self.refuse(queued.number, reason, queued.peer, queued.room, queued.key)
            queued.move(Way.SENT, m.Refuse)
        self._resend_at = now + CLOSE_INTERVAL
        self._deadline = now + CLOSE_LINGER

    def next_timer(self) -> float | None:
        """When `handle_timer` wants to be called; None if never."""
        is_closing = self._closed and any(self.slots)
        return min(self._resend_at, self._deadline) if is_closing else None

    def handle_timer(self, now: float) -> None:
        """Repeat what is due: a Close that nobody has answered, until nobody will."""
        if (timer := self.next_timer()) is None or now < timer:
            return
        for slot, session in enumerate(self.slots):
            if session and now >= self._deadline:
                self.free(slot)
            elif session:
                session.repeat()
        self._resend_at = now + CLOSE_INTERVAL

    # ---- from a datagram to its session

    def _receive_any(self, session: Session | None, arrival: Arrival) -> Event | None:
        """Any datagram: `receive` knows only the State that a slot waits for."""
        try:
            if text.is_text(arrival.datagram):
                return self._receive_text(session, arrival)
            return self._receive_binary(session, arrival)
        except DecodeError as error:
            self._refuse_undecoded(error, arrival)
            return None

    def _receive_binary(self, session: Session | None, arrival: Arrival) -> Event | None:
        address = arrival.address
        plain, key = self._open(arrival, session)
        kind, number, _ = binary.peek(plain)
        seated = session if session and session.number == number and not session.is_text else None
        opening = None if seated else self.openings.get((address, number))
        holder = seated or opening
        if is_fragment(plain):
            kind = binary.check(plain)[0] & ~binary.FRAGMENT
            if kind == binary.HELLO and not seated:
                whole = self.assemble(plain, opening, arrival, key)
            elif kind == binary.STATE and holder:
                whole = holder.assemble(plain, arrival.now)
            elif kind == binary.STATE:
                raise NoSuchSession(f"session {number:016x}")
            else:
                whole = None
                self.drop("foreign", f"a fragment of type {kind}", arrival)
            if whole is None:
                return None
            plain = whole
        if holder is None and kind != binary.HELLO:
            binary.check(plain)
            raise NoSuchSession(f"session {number:016x}")
        message = binary.decode(plain, holder.layout if holder else None)
        if isinstance(message, m.Hello):
            self.receive_hello(message, arrival, key)
            return None
        if seated:
            return self._receive_seated(seated, message, plain, arrival)
        assert opening is not None
        return self.receive_opening(opening, message, plain, arrival)

    def _receive_seated(
        self, session: Session, message: m.Message, plain: bytes, arrival: Arrival
    ) -> Event | None:
        event = session.receive(message, plain, arrival.now)
        if event and isinstance(message, m.Close):
            if session.is_text:
                self.remember_text(session, message.sequence, arrival.now)
            self.free(session.slot)
        return event

    def _receive_text(self, session: Session | None, arrival: Arrival) -> Event | None:
        datagram = arrival.datagram
        layout = None if self._keys else self._text_layout()
        if layout is None:
            sequence, fields = text.split(datagram)
            cause = "refused"
            reason = "text is not flown here"
            if self._keys:
                cause = "forged"
                reason = "key: this agent has one (--key-file), text has none"
            if fields == ["close"]:  # two agents would answer each other's Closes for ever
                self.drop(cause, reason, arrival)
            else:
                self.turn_text_away(sequence, cause, reason, arrival)
            return None
        message = text.decode_state(datagram, layout)
        if session and session.is_text:
            event = self._receive_seated(session, message, b"", arrival)
            if event and isinstance(message, State):
                session.line = datagram
            return event
        return self.receive_first_line(message, layout, arrival)

    def _open(self, arrival: Arrival, session: Session | None) -> tuple[bytes, Key | None]:
        """A binary datagram without its seal, and the shared key that it was sealed with.

        Raises `_KeyMismatch`, `Forged`, or `NoSuchSession` where it has no key here.
        """
        datagram, address, _ = arrival
        if not self._keys and not is_sealed(datagram):
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
        opening = self.openings.get((address, number))
        if opening and (key := opening.session_key()):
            # If the Welcome was for an old copy of its Hello, it is as good as none.
            with suppress(Forged):
                return key.open(datagram), shared
        raise NoSuchSession(f"session {number:016x}")

    def _refuse_undecoded(self, error: DecodeError, arrival: Arrival) -> None:
        """Count it, and answer a Hello if its sender must change its configuration."""
        datagram, address, _ = arrival
        under_seal = is_sealed(datagram)
        plain = message_of(datagram) if under_seal else datagram
        kind, number, _ = binary.peek(plain)
        if isinstance(error, NoSuchSession):
            if kind in (binary.STATE, binary.MISSING):
                self.disown(plain, arrival)
            else:  # the answer to a Close of ours, mostly: not counted
                self.statistics.counters["foreign"] += 1
            return
        if isinstance(error, _KeyMismatch | VersionMismatch) and kind == binary.HELLO:
            trusted = under_seal and not isinstance(error, _KeyMismatch)
            key = self._keys.get(key_id(datagram)) if trusted else None
            self.refuse(number, str(error), address, len(datagram), key)
        cause = "forged" if isinstance(error, Forged) else "malformed"
        self.drop(cause, str(error), arrival)
