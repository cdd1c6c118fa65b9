"""Both sides of the exchange as state machines, without a socket, a clock or a sleep.

A caller hands in datagrams with the time of their arrival (seconds of any monotonic clock) and
sends what `take_outgoing` gives. Exactly one State is outstanding at any time, so a sequence number
is all it takes to step the physics once for each command:

* the simulator repeats the same bytes until the command of the same number comes;
* the agent answers a repeated State with the bytes that it answered before.

Whatever is not a legal transition is counted in `counters` and dropped; it changes nothing else.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields
from math import isfinite
from typing import Final

from . import binary, text
from .errors import DecodeError, VersionMismatch
from .messages import Close, Command, Hello, Message, Refuse, State, Welcome, one_line

__all__ = ["CLOSE_COPIES", "Address", "AgentLink", "LinkConfig", "SimulatorLink"]

Address = tuple[str, int]

CLOSE_COPIES: Final = 3
"""Nothing answers a Close, so that it is sent this often at once."""


@dataclass(frozen=True, kw_only=True)
class LinkConfig:
    """Times of the exchange, s."""

    timeout: float = 60.0
    """The simulator gives up when nothing has answered for this long."""
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


_SIMULATOR: Final[dict[tuple[str, type], str]] = {
    ("hello", Welcome): "ready",
    ("hello", Refuse): "closed",
    ("waiting", Command): "ready",
    ("hello", Close): "closed",
    ("ready", Close): "closed",
    ("waiting", Close): "closed",
}
"""What a message of the agent does to the simulator; any other pair is dropped."""


class SimulatorLink:
    """The simulator's side (UDP client): says Hello, then exchanges States for Commands.

    `state` is one of `hello` (waiting for Welcome), `ready` (a State may be sent), `waiting` (for
    the Command of the State sent last) and `closed`. A text link begins at `ready`.
    """

    def __init__(self, hello: Hello, config: LinkConfig, *, text_codec: bool = False) -> None:
        self.hello = hello
        self.state = "ready" if text_codec else "hello"
        self.sequence = 0
        """Number of the State sent last: they count from 1."""
        self.counters: Counter[str] = Counter()
        self.last_error = ""
        """Why the last foreign or malformed datagram was dropped."""
        self.sends = 0
        """How often the outstanding message was sent."""
        self._config = config
        self._text = text_codec
        self._outstanding = b""
        self._outgoing: list[bytes] = []
        self._sent_at = self._resend_at = self._deadline = 0.0
        self._smoothed: float | None = None
        self._variation = 0.0

    def connect(self, now: float) -> None:
        """Say Hello, until a Welcome or a Refuse comes. With the text codec there is none."""
        if self.state == "hello":
            self._send(self.hello, now)

    def send_state(self, state: State, now: float) -> None:
        """Send the State whose sequence number is `sequence` + 1."""
        if self.state != "ready" or state.sequence != self.sequence + 1:
            raise ValueError(
                f"send_state: expected link state 'ready' and sequence {self.sequence + 1}, "
                f"got {self.state!r} and {state.sequence}"
            )
        self._send(state, now)
        self.sequence = state.sequence
        self.state = "waiting"

    def close(self, reason: str) -> None:
        """End the exchange and tell the agent, unless it has ended."""
        if self.state != "closed":
            message = Close(
                session=self.hello.session, sequence=self.sequence, reason=one_line(reason)
            )
            self._outgoing = [self._encode(message)] * CLOSE_COPIES
            self.counters["sent"] += 1
            self.state = "closed"

    def receive(self, datagram: bytes, now: float) -> Welcome | Refuse | Command | Close | None:
        """Take a datagram from the agent; the message, if it moves the exchange on."""
        self.counters["received"] += 1
        try:
            message = self._decode(datagram)
        except DecodeError as error:
            self._drop("malformed", str(error))
            return None
        if message.session != self.hello.session:
            self._drop("foreign", f"session {message.session:016x}")
            return None
        state = _SIMULATOR.get((self.state, type(message)))
        if state is None or isinstance(message, Hello | State) or not self._is_current(message):
            self._drop("stale")
            return None
        if isinstance(message, Command) and (reason := self._misfit(message)):
            self._drop("malformed", reason)
            return None
        if self.sends == 1:  # after a resend nobody knows which of the two was answered
            self._measure(now - self._sent_at)
        self.state = state
        return message

    def next_timer(self) -> float | None:
        """When `handle_timer` wants to be called; None if never."""
        if self.state in ("hello", "waiting") and self._outstanding:
            return min(self._resend_at, self._deadline)
        return None

    def handle_timer(self, now: float) -> bool:
        """Resend what is due. False once the agent has been silent for the whole timeout."""
        timer = self.next_timer()
        if timer is None or now < timer:
            return True
        if now >= self._deadline:
            self.close(f"no answer from the agent for {self._config.timeout:g} s")
            return False
        self._outgoing.append(self._outstanding)
        self.counters["resent"] += 1
        wait = self._resend_interval() * 2 ** min(self.sends, 16)
        self._resend_at = now + min(wait, self._config.max_resend)
        self.sends += 1
        return True

    def take_outgoing(self) -> list[bytes]:
        """Datagrams to send to the agent, each once."""
        outgoing, self._outgoing = self._outgoing, []
        return outgoing

    def _encode(self, message: Hello | State | Close) -> bytes:
        if self._text and not isinstance(message, Hello):
            return text.encode(message)
        return binary.encode(message)

    def _decode(self, datagram: bytes) -> Message:
        if self._text:
            return text.decode_command(datagram, self.hello.action_low.size, self.hello.session)
        return binary.decode(datagram)

    def _is_current(self, message: Welcome | Refuse | Command | Close) -> bool:
        if isinstance(message, Welcome | Refuse):
            return True
        behind = self.sequence - message.sequence
        # The State sent last may not have reached an agent that closes.
        return behind == 0 or (behind == 1 and isinstance(message, Close))

    def _misfit(self, command: Command) -> str:
        hello = self.hello
        shape = (hello.num_drones, hello.action_low.size)
        if command.actions.shape != shape:
            return f"Command: expected actions of shape {shape}, got {command.actions.shape}"
        if hello.discrete_actions:
            choices = command.actions[~command.resets]
            if ((choices < 0) | (choices >= hello.discrete_actions) | (choices % 1 != 0)).any():
                return (
                    f"Command: expected whole actions 0 to {hello.discrete_actions - 1}, "
                    f"got {choices}"
                )
        return ""

    def _send(self, message: Hello | State, now: float) -> None:
        self._outstanding = self._encode(message)
        self._outgoing.append(self._outstanding)
        self.counters["sent"] += 1
        self.sends = 1
        self._sent_at = now
        self._resend_at = now + self._resend_interval()
        self._deadline = now + self._config.timeout

    def _measure(self, round_trip: float) -> None:
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

    def _drop(self, cause: str, reason: str = "") -> None:
        self.counters[cause] += 1
        if reason:
            self.last_error = one_line(f"{cause}: {reason}")


_AGENT: Final = {
    ("expecting", State): "deciding",
    ("expecting", Close): "closed",
    ("deciding", Close): "closed",
}
"""What a message of the welcome simulator does to the agent; any other pair is dropped."""


class AgentLink:
    """The agent's side (UDP server): welcomes one simulator, answers each State once.

    `state` is one of `listening` (no simulator yet), `expecting` (a State), `deciding` (a State
    waits for `send_command`) and `closed`. The session is pinned to the address and the codec that
    opened it.

    Args:
        accept: Looks at a Hello and gives the reason to refuse it, or "".
        text_sizes: Numbers of observation and of telemetry. A text simulator says no Hello: its
            first line opens the session, and these say how to read it.
    """

    def __init__(self, accept: Callable[[Hello], str], text_sizes: tuple[int, int]) -> None:
        self.state = "listening"
        self.hello: Hello | None = None
        self.peer: Address | None = None
        self.session = 0
        """Session of the simulator that is welcome; 0 with the text codec."""
        self.sequence = 0
        """Number of the State that came last."""
        self.counters: Counter[str] = Counter()
        self.last_error = ""
        """Why the last foreign, malformed or refused datagram was dropped."""
        self._accept = accept
        self._text_sizes = text_sizes
        self._text = False
        self._reply = b""  # the answer to the last State, or the Welcome
        self._outgoing: list[tuple[bytes, Address]] = []

    def receive(self, datagram: bytes, address: Address) -> Hello | State | Close | None:
        """Take a datagram; the message, if it moves the exchange on."""
        self.counters["received"] += 1
        is_text = text.is_text(datagram)
        try:
            if is_text:
                message: Message = text.decode_state(datagram, *self._text_sizes)
            else:
                message = binary.decode(datagram)
        except DecodeError as error:
            if isinstance(error, VersionMismatch) and error.kind == binary.HELLO:
                self._refuse(error.session, str(error), address)
            self._drop("malformed", str(error), address)
            return None
        if (address, is_text, message.session) == (self.peer, self._text, self.session):
            return self._receive_known(message, address)
        if isinstance(message, Hello) or (is_text and isinstance(message, State)):
            return self._receive_first(message, address)
        self._drop("foreign", type(message).__name__, address)
        return None

    def send_command(self, command: Command) -> None:
        """Answer the State of the same number. Its bytes are kept for a repeated State."""
        if self.state != "deciding" or command.sequence != self.sequence:
            raise ValueError(
                f"send_command: expected link state 'deciding' and sequence {self.sequence}, "
                f"got {self.state!r} and {command.sequence}"
            )
        self._reply = text.encode(command) if self._text else binary.encode(command)
        self._send(self._reply)
        self.state = "expecting"

    def close(self, reason: str) -> None:
        """End the exchange and tell the simulator, if there is one, unless it has ended."""
        if self.state in ("expecting", "deciding"):
            message = Close(session=self.session, sequence=self.sequence, reason=one_line(reason))
            self._reply = text.encode(message) if self._text else binary.encode(message)
            self._send(self._reply, copies=CLOSE_COPIES)
        self.state = "closed"

    def take_outgoing(self) -> list[tuple[bytes, Address]]:
        """Datagrams to send and where to, each once."""
        outgoing, self._outgoing = self._outgoing, []
        return outgoing

    def _receive_first(self, message: Hello | State, address: Address) -> Hello | State | None:
        """Take the opening of a simulator that has no session here."""
        if self.peer is not None:
            reason = f"the agent already flies the simulator at {self.peer[0]}:{self.peer[1]}"
        elif self.state == "closed":
            reason = "the agent has closed"
        else:
            reason = self._accept(message) if isinstance(message, Hello) else ""
        if reason:
            self._refuse_opening(message, reason, address)
            self._drop("refused", reason, address)
            return None
        self.peer, self.state = address, "expecting"
        if isinstance(message, State):
            self._text, self.sequence, self.state = True, message.sequence, "deciding"
            return message
        self.hello, self.session = message, message.session
        self._reply = binary.encode(Welcome(session=message.session))
        self._send(self._reply)
        return message

    def _receive_known(self, message: Message, address: Address) -> State | Close | None:
        """Take a message of the welcome simulator."""
        if isinstance(message, Hello | State) and self._is_repeated(message):
            if self.state != "deciding":  # else the answer is still being thought of
                self._outgoing.append((self._reply, address))
                self.counters["resent"] += 1
            self._drop("duplicate", "", address)
            return None
        state = _AGENT.get((self.state, type(message)))
        if state is None or not isinstance(message, State | Close) or not self._is_next(message):
            self._drop("stale", "", address)
            return None
        if isinstance(message, State):
            if reason := self._misfit(message):
                self._drop("malformed", reason, address)
                return None
            self.sequence = message.sequence
        self.state = state
        return message

    def _is_repeated(self, message: Hello | State) -> bool:
        number = message.sequence if isinstance(message, State) else 0
        return number == self.sequence

    def _is_next(self, message: State | Close) -> bool:
        ahead = message.sequence - self.sequence
        # The State before a Close may have been lost.
        return ahead == 1 or (ahead == 0 and isinstance(message, Close))

    def _misfit(self, state: State) -> str:
        if self.hello is None:
            return ""  # a text line was read by `text_sizes`
        hello = self.hello
        expected = (hello.num_drones, hello.observation_low.size, len(hello.telemetry_names))
        got = (*state.observations.shape, state.telemetry.shape[1])
        if got == expected:
            return ""
        return f"State: expected (drones, observations, telemetry) = {expected}, got {got}"

    def _refuse_opening(self, message: Hello | State, reason: str, address: Address) -> None:
        if isinstance(message, Hello):
            self._refuse(message.session, reason, address)
        else:  # a text simulator knows no Refuse
            close = Close(session=0, sequence=message.sequence, reason=one_line(reason))
            self._outgoing.append((text.encode(close), address))

    def _refuse(self, session: int, reason: str, address: Address) -> None:
        refuse = Refuse(session=session, reason=one_line(reason))
        self._outgoing.append((binary.encode(refuse), address))

    def _send(self, datagram: bytes, copies: int = 1) -> None:
        assert self.peer is not None
        self._outgoing.extend([(datagram, self.peer)] * copies)
        self.counters["sent"] += 1

    def _drop(self, cause: str, reason: str, address: Address) -> None:
        self.counters[cause] += 1
        if reason:
            self.last_error = one_line(f"{cause} from {address[0]}:{address[1]}: {reason}")
