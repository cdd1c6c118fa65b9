"""The simulator's side of the exchange (UDP client), free of sockets and clocks: see `link`."""

import secrets
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from . import binary, text
from .errors import DecodeError, Forged
from .keys import Key, is_sealed, message_of
from .link import CLOSE_INTERVAL, CLOSE_LINGER, LinkConfig, Tap, encode, packed
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
from .parts import Assembler, is_part, turned
from .statistics import Statistics

__all__ = ["SimulatorLink", "new_session"]

_NEXT: Final[dict[tuple[str, type], str]] = {
    ("hello", Welcome): "ready",
    ("hello", Wait): "hello",
    ("hello", Refuse): "closed",
    ("waiting", Command): "ready",
    ("waiting", Unknown): "hello",
    ("ready", Close): "closed",
    ("waiting", Close): "closed",
    ("closing", Close): "closed",
}
"""What a message of the agent does to the simulator; any other pair is dropped."""

_UNCLEAR: Final = 8
"""After so many round trips in a row that cannot be measured, resends become rarer."""


def new_session() -> int:
    """A random session number, not 0."""
    return secrets.randbits(64) or 1


class SimulatorLink:
    """Says Hello, then exchanges States for Commands.

    `state` is one of `hello` (waiting for Welcome), `ready` (a State may be sent), `waiting` (for
    the Command of the State sent last), `closing` (for the answer to its Close) and `closed`. A
    text link begins at `ready`. An agent that does not know the session, since it was started
    anew, brings it back to `hello` with another session.

    Args:
        hello: What is simulated.
        config: Times of the exchange.
        text_codec: Speak text instead of binary.
        key: Shared with the agent. Then nothing unsealed is taken.
        tap: Sees every message once.
        draw_session: Gives the number of the next session.
    """

    def __init__(
        self,
        hello: Hello,
        config: LinkConfig,
        *,
        text_codec: bool = False,
        key: Key | None = None,
        tap: Tap | None = None,
        draw_session: Callable[[], int] = new_session,
    ) -> None:
        if text_codec and key:
            raise ValueError("text codec: expected no key, got one: only binary can be sealed")
        self.hello = hello
        self.state = "ready" if text_codec else "hello"
        self.sequence = 0
        """Number of the State sent last: they count from 1."""
        self.statistics = Statistics()
        self.sends = 0
        """How often the outstanding message was sent."""
        self._config = config
        self._text = text_codec
        self._key = key
        self._session_key: Key | None = None
        self._tap = tap
        self._draw_session = draw_session
        self._waits = False
        self._parts = Assembler(binary.command_size(hello))
        self._outstanding: list[bytes] = []
        self._outgoing: list[bytes] = []
        self._sent_at = self._resend_at = self._deadline = 0.0
        self._smoothed: float | None = None
        self._variation = 0.0
        self._unclear = 0

    def connect(self, now: float) -> None:
        """Say Hello, until a Welcome or a Refuse comes. With the text codec there is none."""
        if self.state == "hello":
            self._send(self.hello, now, "hello", 0)

    def send_state(self, state: State, now: float) -> None:
        """Send the State whose sequence number is `sequence` + 1."""
        if self.state != "ready" or state.sequence != self.sequence + 1:
            raise ValueError(
                f"send_state: expected link state 'ready' and sequence {self.sequence + 1}, "
                f"got {self.state!r} and {state.sequence}"
            )
        self._send(state, now, "waiting", state.sequence)

    def close(self, reason: str, now: float) -> None:
        """End the exchange. An agent that has welcomed this simulator is told, until it answers."""
        if self.state in ("ready", "waiting"):
            message = Close(
                session=self.hello.session, sequence=self.sequence, reason=one_line(reason)
            )
            self._send(message, now, "closing", self.sequence)
        elif self.state == "hello":
            self.state = "closed"

    def receive(self, datagram: bytes, now: float) -> Welcome | Refuse | Command | Close | None:
        """Take a datagram from the agent; the message, if it moves the exchange on."""
        self.statistics.counters["received"] += 1
        try:
            plain = self._open(datagram)
            if not self._text and is_part(plain):
                whole = self._assemble(plain, now)
                if whole is None:
                    return None
                plain = whole
            message = self._decode(plain)
        except DecodeError as error:
            cause = "forged" if isinstance(error, Forged) else "malformed"
            self._drop(cause, str(error), now)
            return None
        if message.session != self.hello.session:
            self._drop("foreign", f"session {message.session:016x}", now)
            return None
        state = _NEXT.get((self.state, type(message)))
        if state is None or isinstance(message, Hello | State) or not self._is_current(message):
            self._drop("stale", "", now)
            return None
        if isinstance(message, Command) and (reason := self._misfit(message)):
            self._drop("malformed", reason, now)
            return None
        before, self.state = self.state, state
        if isinstance(message, Wait):
            self._wait_for_place(now)
            return None
        self._record(message, plain)
        if isinstance(message, Unknown):
            self._begin_again(now)
            return None
        if isinstance(message, Welcome):
            self.statistics.counters["sessions"] += 1
            if self._key:
                self._session_key = self._key.for_session(message.session, message.nonce)
        if isinstance(message, Close) and before != "closing":
            self._answer_close()
        if isinstance(message, Command):
            self._measure(now - self._sent_at)
        return message

    def next_timer(self) -> float | None:
        """When `handle_timer` wants to be called; None if never."""
        if self.state in ("hello", "waiting", "closing") and self._outstanding:
            return min(self._resend_at, self._deadline)
        return None

    def handle_timer(self, now: float) -> bool:
        """Resend what is due. False once the agent has been silent for the whole timeout."""
        timer = self.next_timer()
        if timer is None or now < timer:
            return True
        if now >= self._deadline:
            if self.state == "closing":
                self.state = "closed"
                return True
            self.close(f"no answer from the agent for {self._config.timeout:g} s", now)
            return False
        self._outgoing += turned(self._outstanding, self.sends)
        self.statistics.counters["resent"] += 1
        wait = min(self._resend_interval() * 2 ** min(self.sends, 16), self._config.max_resend)
        self._resend_at = now + (CLOSE_INTERVAL if self.state == "closing" else wait)
        self.sends += 1
        return True

    def take_outgoing(self) -> list[bytes]:
        """Datagrams to send to the agent, each once."""
        outgoing, self._outgoing = self._outgoing, []
        return outgoing

    def _decode(self, plain: bytes) -> Message:
        if self._text:
            return text.decode_command(plain, self.hello.action_low.size, self.hello.session)
        return binary.decode(plain)

    def _assemble(self, part: bytes, now: float) -> bytes | None:
        """The Command that is waited for, once all its parts are there."""
        kind, session, sequence = binary.check(part)
        if session != self.hello.session:
            self._drop("foreign", f"session {session:016x}", now)
            return None
        if (self.state, kind & ~binary.PART, sequence) != (
            "waiting",
            binary.COMMAND,
            self.sequence,
        ):
            self._drop("stale", "", now)
            return None
        return self._parts.take(sequence, part)

    def _open(self, datagram: bytes) -> bytes:
        """A datagram without its seal.

        Commands and Closes are sealed with the session's key, all else with the shared one.
        """
        key = self._key
        if self._text:
            return datagram
        if key is None:
            if is_sealed(datagram):
                raise Forged("key: the agent has one, this simulator has none (--key-file)")
            return datagram
        if not is_sealed(datagram):
            message = binary.decode(datagram)
            words = f" that says: {message.reason}" if isinstance(message, Refuse) else ""
            raise Forged(f"not sealed, a {type(message).__name__}{words}")
        kind, _, _ = binary.peek(message_of(datagram))
        if kind == binary.UNKNOWN:  # answers this very State, not one that somebody made up
            return self._open_answer(datagram, key)
        if kind in binary.OF_SESSION:
            if self._session_key is None:
                raise Forged("a message of a session, and there is none")
            key = self._session_key
        return key.open(datagram)

    def _open_answer(self, datagram: bytes, key: Key) -> bytes:
        """An answer to the State that was sent last: to its datagram, or its first part."""
        return key.open(datagram, self._outstanding[0] if self._outstanding else b"")

    def _is_current(self, message: Message) -> bool:
        number = getattr(message, "sequence", None)
        if number is None:
            return True
        behind = self.sequence - number
        # The State sent last may not have reached an agent that closes.
        return behind == 0 or (behind == 1 and isinstance(message, Close))

    def _misfit(self, command: Command) -> str:
        hello = self.hello
        shape = (hello.num_drones, hello.action_low.size)
        if command.actions.shape != shape:
            return f"Command: expected actions of shape {shape}, got {command.actions.shape}"
        if hello.discrete_actions:
            idle = command.resets if command.holds is None else command.resets | command.holds
            choices = command.actions[~idle]
            wrong = (choices < 0) | (choices >= hello.discrete_actions) | (choices % 1 != 0)
            if wrong.any():
                return (
                    f"Command: expected whole actions 0 to {hello.discrete_actions - 1}, "
                    f"got {choices[wrong][0]}"
                )
        return ""

    def _wait_for_place(self, now: float) -> None:
        """The agent is there: as long as it says so, this is no silence."""
        self._deadline = now + self._config.timeout
        if not self._waits:
            self._waits = True
            self.statistics.notice("every place at the agent is taken; waiting for a free one")

    def _begin_again(self, now: float) -> None:
        """Say Hello to an agent that knows nothing of the session."""
        self.statistics.notice(
            "the agent does not know this session (any more); beginning a new one"
        )
        self.hello = replace(self.hello, session=self._draw_session())
        self.sequence, self._session_key, self._waits = 0, None, False
        self._parts = Assembler(binary.command_size(self.hello))
        self._send(self.hello, now, "hello", 0)

    def _answer_close(self) -> None:
        close = Close(session=self.hello.session, sequence=self.sequence, reason="")
        datagram = encode(close, as_text=self._text)
        self._outgoing += packed(datagram, self._session_key)
        self.statistics.counters["sent"] += 1
        self._record(close, datagram)

    def _send(self, message: Hello | State | Close, now: float, state: str, sequence: int) -> None:
        """Send, and be in that state with that sequence number from then on."""
        key = self._key if isinstance(message, Hello) else self._session_key
        datagram = encode(message, as_text=self._text)
        self._record(message, datagram)
        outstanding, closing = packed(datagram, key), isinstance(message, Close)
        resend_at = now + (CLOSE_INTERVAL if closing else self._resend_interval())
        # Ctrl-C strikes where something is called. It must find all of this done or nothing, for
        # the Close that follows has to have the number of what was sent last.
        self.state, self.sequence = state, sequence
        self._outstanding = outstanding
        self._outgoing += outstanding
        self.sends = 1
        self._sent_at, self._resend_at = now, resend_at
        self._deadline = now + (CLOSE_LINGER if closing else self._config.timeout)
        self.statistics.counters["sent"] += 1

    def _record(self, message: Message, datagram: bytes) -> None:
        if self._tap:
            self._tap(0, message, binary.encode(message) if self._text else datagram)

    def _measure(self, round_trip: float) -> None:
        self.statistics.round_trips.add(round_trip)
        if self.sends > 1:  # after a resend nobody knows which of the two was answered
            self._unclear += 1
            if self._unclear % _UNCLEAR == 0 and self._smoothed is not None:
                # Maybe it is that much longer by now.
                self._smoothed = min(2 * self._smoothed, self._config.max_resend)
            return
        self._unclear = 0
        # Smoothed mean and variation as TCP keeps them (RFC 6298).
        if self._smoothed is None:
            self._smoothed, self._variation = round_trip, round_trip / 2
        else:
            self._variation += (abs(self._smoothed - round_trip) - self._variation) / 4
            self._smoothed += (round_trip - self._smoothed) / 8

    def _resend_interval(self) -> float:
        if self._smoothed is None:
            wait = self._config.first_resend
        else:
            wait = self._smoothed + 4 * self._variation
        return min(max(wait, self._config.min_resend), self._config.max_resend)

    def _drop(self, cause: str, reason: str, now: float) -> None:
        self.statistics.drop(cause, f"from the agent: {reason}", now)
