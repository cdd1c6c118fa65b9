"""The simulator's side of the exchange (UDP client), free of sockets and clocks.

A caller hands in datagrams with the time of their arrival (seconds of any monotonic clock), sends
what `outgoing` has, and calls `handle_timer` when `next_timer` says. Exactly one State is
outstanding at any time, so a sequence number suffices to step the physics once for each Command:
the simulator repeats the same bytes until the Command of the same number comes.
"""

import secrets
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from math import inf
from random import Random
from typing import Annotated

from ...models.errors import InputError
from ...models.fields import Limits, check_fields, immutable
from . import binary, text
from .auth import Key, is_sealed, message_of, sealed
from .errors import DecodeError, Forged
from .fragments import FAR, NEAR, Assembler, Transfer, is_fragment
from .layout import Array, Layout
from .messages import (
    Alive,
    Close,
    Command,
    Extension,
    Hello,
    Message,
    Missing,
    State,
    Unknown,
    Wait,
    Welcome,
    one_line,
)
from .statistics import Statistics, warn
from .transitions import SIMULATOR, SimulatorState

Address = tuple[str, int]  # IPv4 host and port


def address_text(address: Address) -> str:
    """An address as it is written: host:port."""
    return f"{address[0]}:{address[1]}"


Seconds = Annotated[float, Limits(0, unit="s", above=True)]

Tap = Callable[[int, Message, bytes], None]
"""Sees every message once, when it is first sent or taken: the number of its slot (0 at the
simulator), the message, and its bytes in the binary codec, whole and not sealed."""

CLOSE_INTERVAL = 0.025
"""Period of a repeated Close, s, until the other side has answered it with its own."""
CLOSE_LINGER = 0.25  # longest wait for that answer, s: the other side may be gone

_FIRST_RESEND = 0.2  # wait before a resend while no round trip has been measured, s
_GRANULARITY = 0.005  # least that is added to a round trip, s: a process may wait so long
_LONGEST_RESEND = 1.0  # longest wait before a resend, s
_PATIENCE = 8  # resends before the waits double: most that was lost was lost by chance
_LATER = 1.25  # factor of the wait before the next resend, for each Alive for a State
_LATEST = 10.0
"""Longest such wait, s; a quarter of the timeout, if that is less. A Command that was lost is asked
for again before an agent takes the simulator for lost (30 s)."""
_TOO_EARLY = 1.5  # factor of the estimated round trip when answers come twice
_SOON = 0.25  # an agent that has waited for a State for less needs no Alive, s


def random_number() -> int:
    """A random 64-bit number, not 0: of a session, or a nonce."""
    return secrets.randbits(64) or 1


def mismatch(hello: Hello, version: int, extensions: tuple[Extension, ...]) -> str:
    """Why the two sides cannot speak with each other, in a sentence; "" if they can."""
    low, high = hello.versions
    if not low <= version <= high:
        return f"the simulator speaks protocol versions {low} to {high}, the agent {version}"
    for each in extensions:
        if each.critical:  # we know none
            return f"expected no critical extension, got type {each.number}"
    return ""


def largest_datagram(peer: Address) -> int:
    """Bytes of the largest datagram to a peer, a seal not counted: fewer off this machine."""
    return NEAR if peer[0].startswith("127.") else FAR


@immutable
class LinkConfig:
    """Settings of a simulator's exchange."""

    timeout: Seconds = 120.0
    """It gives up when nothing has answered for this long, s: longer than an agent waits for one
    to replace another that it has lost."""
    drop: Annotated[float, Limits(0, 1)] = 0.0
    """Probability that a datagram is lost on purpose, sent or received, to try an agent: 0 to 1.
    Each run loses the same datagrams, by their order."""

    def __post_init__(self) -> None:
        check_fields(self)


class RoundTrips:
    """Measures round trips, and derives the time of a resend (RFC 6298).

    A round trip counts at most as twice the wait of then: a side that paused once, to learn for
    example, does not make every resend of the next second late. An agent of several simulators
    answers one that asks again with Alive, while it waits for the others. Then a long wait for its
    Command tells how the others fare, and counts no more: their losses would make the waits of this
    simulator longer, and those theirs.
    """

    def __init__(self) -> None:
        self._smoothed: float | None = None
        self._variation = 0.0
        self._sent_at = 0.0
        self._is_repeat = self._was_repeated = self._came_twice = self._says_alive = False
        self._in_a_row = 0  # messages in a row that were repeated, and then answered twice
        self.interval = _FIRST_RESEND
        """Wait for an answer before the first resend, s."""

    def sent(self, now: float, *, first: bool = False) -> None:
        """Something was sent that wants an answer, for the first time or again."""
        if first:
            self._was_repeated = self._is_repeat
            if not self._came_twice:
                self._in_a_row = 0
            self._came_twice = False
        self._sent_at = now
        self._is_repeat = not first

    def answered(self, now: float, *, alive: bool = False) -> None:
        """The answer came, or only Alive.

        It is one to the last sending, but to which one is unclear if it came too soon.
        """
        seconds = now - self._sent_at
        self._says_alive |= alive
        smoothed = self._smoothed
        if smoothed is None:
            self._smoothed = seconds
            self._variation = seconds / 2
        else:
            waited = self._says_alive and not alive and seconds > smoothed
            too_soon = self._is_repeat and seconds < smoothed / 2
            if waited or too_soon:
                return
            seconds = min(seconds, 2 * self.interval)
            self._variation += (abs(smoothed - seconds) - self._variation) / 4
            self._smoothed = smoothed + (seconds - smoothed) / 8
        self._set_interval(self._smoothed)

    def answered_again(self) -> None:
        """The answer to the last message came a second time.

        If that was asked for twice, it may have been too early; a network that doubles datagrams
        does the same, but seldom to two messages in a row.
        """
        if self._smoothed is None or not self._was_repeated or self._came_twice:
            return
        self._came_twice = True
        self._in_a_row += 1
        if self._in_a_row > 1:
            self._smoothed = min(_TOO_EARLY * self._smoothed, _LONGEST_RESEND)
            self._set_interval(self._smoothed)

    def _set_interval(self, smoothed: float) -> None:
        margin = max(_GRANULARITY, 4 * self._variation)
        self.interval = min(smoothed + margin, _LONGEST_RESEND)

    def wait(self, tries: int) -> float:
        """Wait for an answer before the next resend, s, after so many tries without any."""
        if tries <= _PATIENCE:
            return self.interval
        return min(self.interval * 2.0 ** min(tries - _PATIENCE, 16), _LONGEST_RESEND)


@dataclass(eq=False)
class Client:
    """Says Hello, then exchanges States for Commands.

    Args:
        hello: Hello to send, and the layout of its spec.
        largest: Bytes of the largest datagram, a seal not counted.
        by_text: Speak text instead of binary.
        key: Shared with the agent. Then nothing unsealed is taken.
        draw_session: Gives the number of the next session.

    Raises:
        InputError: The layout is not of text, or there is a key with text.

    Attributes:
        sequence: Number of the State sent last: they count from 1.
        sends: How often the outstanding message was sent.
        asked_at: When it was sent first.
        resend_at: When it is sent again; infinite if nothing is outstanding, as `deadline`.
        deadline: When the agent is given up.
        tap: None at first.
        outgoing: Datagrams to send to the agent: the caller takes them.
    """

    hello: Hello
    layout: Layout
    config: LinkConfig
    _: KW_ONLY
    largest: int = NEAR
    by_text: bool = False
    key: Key | None = None
    draw_session: Callable[[], int] = random_number

    def __post_init__(self) -> None:
        if self.by_text:
            if self.key:
                raise InputError("text codec: expected no key, got one: only binary can be sealed")
            text.check_layout(self.layout)
        self.state: SimulatorState = "ready" if self.by_text else "idle"
        self.sequence = 0
        self.sends = self._tries = 0
        self._stretch = 1.0  # of the next wait, by the Alives for this State
        self.statistics = Statistics()
        self._is_plain = not self.by_text and self.key is None
        self._sealing = self.key  # from the Welcome on the key of the session
        self._nonce = 0
        self.tap: Tap | None = None
        self._dice = Random(self.hello.spec) if self.config.drop else None  # others for each agent
        self.is_queued = False
        self._assembler = Assembler(self.layout.commands[True, True].size)
        self._transfer = Transfer(b"", self.largest)  # of the message that was sent last
        self._asking = b""  # the datagram that was sent last and wants an answer
        self.outgoing: list[bytes] = []
        self._round_trips = RoundTrips()
        self.asked_at = self._answered_at = 0.0
        self.resend_at = self.deadline = inf

    def connect(self, now: float) -> None:
        """Say Hello, until a Welcome or a Refuse comes. With the text codec there is none."""
        if self.state == "idle":
            self._send(self.hello, now)

    def send_state(
        self,
        time: float,
        observations: tuple[Array, ...],
        rewards: Array,
        terminated: Array,
        truncated: Array,
        telemetry: tuple[Array, ...],
        now: float,
    ) -> State:
        """Send the next State, and return it: see `messages.State`.

        Raises `InputError` for an array that is not of the layout, or not finite, and `KeyError`
        where no State is due; nothing was sent.
        """
        state = State(
            session=self.hello.session,
            sequence=self.sequence + 1,
            time=time,
            nonce=0 if self.sequence else self._nonce,
            observations=observations,
            rewards=rewards,
            terminated=terminated,
            truncated=truncated,
            telemetry=telemetry,
        )
        self._send(state, now)
        return state

    def alive(self, now: float) -> list[bytes]:
        """Datagrams of an Alive, if the agent has waited for a State for a while; else none.

        May be called from another thread than the others.
        """
        waits = self.state == "ready" and now > self._answered_at + _SOON
        if self.by_text or not waits or not self.sequence:
            return []
        alive = binary.encode(Alive(session=self.hello.session, sequence=self.sequence))
        return sealed([alive], self._sealing)

    def close(self, reason: str, now: float) -> None:
        """End the exchange. An agent that has welcomed this simulator is told, until it answers."""
        if ("sent", Close) in SIMULATOR[self.state]:
            session = self.hello.session
            close = Close(session=session, sequence=self.sequence, reason=one_line(reason))
            self._send(close, now)
        elif self.state != "closing":
            self._give_up()  # a Hello that was not answered is not repeated

    def receive(self, datagram: bytes, now: float) -> Message | None:
        """Take a datagram from the agent; the message, if it moves the exchange on."""
        if self._dice and self._is_lost():
            return None
        self.statistics.counters["received"] += 1
        if self.state == "waiting" and self._is_plain:
            session = self.hello.session
            sequence = self.sequence
            message = binary.decode_due(binary.COMMAND, datagram, session, sequence, self.layout)
            if isinstance(message, Command):
                self._take_command(message, datagram, now)
                return message
        return self._receive_any(datagram, now)

    def _receive_any(self, datagram: bytes, now: float) -> Message | None:
        """Whatever comes: `receive` knows only the Command that is waited for."""
        try:
            if self.key is None and is_sealed(datagram):
                raise Forged("key: the agent has one, this simulator has none (--key-file)")
            plain = self._open(datagram, self.key) if self.key else datagram
            if self.by_text:
                message: Message = text.decode_command(plain, self.layout, self.hello.session)
            else:
                _, session, _ = binary.check(plain)
                if session != self.hello.session:
                    self._drop("foreign", f"session {session:016x}", now)
                    return None
                if is_fragment(plain):
                    whole = self._assemble(plain, now)
                    if whole is None:
                        return None
                    plain = whole
                message = binary.decode(plain, self.layout)
        except DecodeError as error:
            self._drop(error.cause, str(error), now)
            return None
        then = SIMULATOR[self.state].get(("received", type(message)))
        number = getattr(message, "sequence", self.sequence)
        # There is one Close in a session, so its number does not matter.
        if then is None or (number != self.sequence and not isinstance(message, Close)):
            if isinstance(message, Command) and self.sequence - message.sequence <= 1:
                self._round_trips.answered_again()
            self.statistics.counters["stale"] += 1
            return None
        return self._take(message, then, plain, now)

    def next_timer(self) -> float:
        """When `handle_timer` wants to be called; infinite if never."""
        return min(self.resend_at, self.deadline)

    def handle_timer(self, now: float) -> bool:
        """Resend what is due. False once the agent has been silent for the whole timeout."""
        if now < self.next_timer():
            return True
        if now >= self.deadline:
            if self.state == "closing":
                self._give_up()
                return True
            self._stop_asking()
            self.close(f"no answer from the agent for {self.config.timeout:g} s", now)
            return False
        self.statistics.counters["resent"] += 1
        self.sends += 1
        self._tries += 1
        self._round_trips.sent(now)
        closing = self.state == "closing"
        missing = None if closing else self._assembler.missing()  # of the answer
        datagrams = [binary.encode(missing)] if missing else self._transfer.probe()
        self._put(datagrams)
        wait = CLOSE_INTERVAL if closing else self._round_trips.wait(self._tries)
        self.resend_at = now + wait
        return True

    # ---- what came

    def _take(
        self, message: Message, then: SimulatorState, plain: bytes, now: float
    ) -> Message | None:
        """A message that may come now, and leads to that state."""
        if isinstance(message, Command):
            self._take_command(message, plain, now)
            return message
        if isinstance(message, Missing | Wait | Alive):
            self._wait_on(message, now)
            return None
        if isinstance(message, Welcome):
            reason = mismatch(self.hello, message.version, message.extensions)
            if reason:
                self._drop("malformed", reason, now)
                return None
        was_closing = self.state == "closing"
        self.state = then
        self._record(message, plain)
        if isinstance(message, Unknown):
            warn("the agent does not know this session (any more); beginning a new one")
            self.begin_again(now)
            return None
        self._stop_asking()
        if isinstance(message, Welcome):
            self.is_queued = False
            self.statistics.counters["sessions"] += 1
            self._nonce = message.nonce
            if self.key:
                self._sealing = self.key.for_session(message.session, message.nonce)
        elif isinstance(message, Close) and not was_closing:
            close = Close(session=message.session, sequence=self.sequence, reason="")
            data = self._encode(close)
            self._put([data])
            self.statistics.counters["sent"] += 1
            self._record(close, data)
        return message

    def _wait_on(self, message: Missing | Wait | Alive, now: float) -> None:
        """The agent is there, and has no answer yet."""
        if isinstance(message, Missing):
            is_ours = message.kind == binary.peek(self._transfer.message)[0]
            fragments = self._transfer.resend(message) if is_ours else []
            if not fragments:
                self.statistics.counters["stale"] += 1
                return
            self.statistics.counters["resent"] += 1
            self._round_trips.sent(now)
            self._put(fragments)
            self._progress(now)
        elif isinstance(message, Alive):  # others are late
            self._round_trips.answered(now, alive=True)
            self._tries = 1
            self._stretch *= _LATER
            wait = self._round_trips.wait(1) * self._stretch
            self.resend_at = now + min(wait, _LATEST, self.config.timeout / 4)
        elif not self.is_queued:
            self.is_queued = True
            warn("every slot of the agent is taken; waiting for a free one")
        self.deadline = now + self.config.timeout  # the agent is there: this is no silence

    def _take_command(self, command: Command, plain: bytes, now: float) -> None:
        self.state = SIMULATOR["waiting"]["received", Command]
        self.resend_at = self.deadline = inf
        self._answered_at = now
        if self.tap:
            self._record(command, plain)
        self.statistics.round_trips.append(now - self.asked_at)
        self._round_trips.answered(now)

    def _open(self, datagram: bytes, key: Key) -> bytes:
        """A datagram without its seal: the session's key, or the shared one for what opens it."""
        if not is_sealed(datagram):
            raise Forged("key: the agent has none (--key-file), this simulator has one")
        kind, _, sequence = binary.peek(message_of(datagram))
        if kind == binary.UNKNOWN:  # answers this very State, not a forged one
            return key.open(datagram, self._asking)
        if binary.is_of_session(kind, sequence):
            key = self._sealing or key
        return key.open(datagram)

    def _assemble(self, fragment: bytes, now: float) -> bytes | None:
        """The Command that is waited for, once all its fragments are there."""
        kind, _, sequence = binary.peek(fragment)
        is_due = self.state == "waiting" and sequence == self.sequence
        if not is_due or kind != binary.COMMAND:
            self.statistics.counters["stale"] += 1
            return None
        whole = self._assembler.take(fragment)
        self._progress(now)
        if answer := self._assembler.ask(fragment):
            self._round_trips.sent(now)
            self._put(answer)
        return whole

    def _progress(self, now: float) -> None:
        """The agent is there and works on the outstanding message."""
        self._tries = 1
        self.resend_at = now + self._round_trips.wait(1)

    def begin_again(self, now: float) -> None:
        """Say Hello in a new session to an agent that knows nothing of this one, or is silent."""
        self.hello = replace(self.hello, session=self.draw_session())
        self._sealing = self.key
        self._assembler = Assembler(self.layout.commands[True, True].size)
        self._send(self.hello, now)

    # ---- what is sent

    def _send(self, message: Hello | State | Close, now: float) -> None:
        """Send a message and repeat it until it is answered."""
        kind = type(message)
        after = SIMULATOR[self.state]["sent", kind]
        if isinstance(message, State) and not self.by_text:
            data = binary.encode_step(message, self.layout)
        else:
            data = self._encode(message)
        if self.tap:
            self._record(message, data)
        self._transfer = transfer = Transfer(data, self.largest)
        self.state = after
        self.sequence = 0 if isinstance(message, Hello) else message.sequence
        self.sends = self._tries = 1
        self._stretch = 1.0
        self._round_trips.sent(now, first=True)
        if transfer.count == 1 and self._is_plain and not self._dice:
            self.outgoing.append(data)
        else:
            self._put(transfer.start())
        self.asked_at = now
        if kind is Close:
            self.resend_at = now + CLOSE_INTERVAL
            self.deadline = now + CLOSE_LINGER
        else:
            self.resend_at = now + self._round_trips.interval
            self.deadline = now + self.config.timeout
        self.statistics.counters["sent"] += 1

    def _put(self, datagrams: list[bytes]) -> None:
        for datagram in sealed(datagrams, self._sealing):
            self._asking = datagram
            if not self._is_lost():
                self.outgoing.append(datagram)

    def _is_lost(self) -> bool:
        """Whether the next datagram is lost on purpose."""
        lost = self._dice is not None and self._dice.random() < self.config.drop
        if lost:
            self.statistics.counters["dropped"] += 1
        return lost

    def _encode(self, message: Hello | State | Close) -> bytes:
        if self.by_text and isinstance(message, State | Close):
            return text.encode(message, self.layout)
        return binary.encode(message, self.layout)

    def _record(self, message: Message, data: bytes) -> None:
        if self.tap:
            self.tap(0, message, binary.encode(message, self.layout) if self.by_text else data)

    def _give_up(self) -> None:
        self.state = SIMULATOR[self.state]["unsaid", Close]
        self._stop_asking()

    def _stop_asking(self) -> None:
        self.resend_at = self.deadline = inf

    def _drop(self, cause: str, reason: str, now: float) -> None:
        self.statistics.drop(cause, f"from the agent: {reason}", now)
