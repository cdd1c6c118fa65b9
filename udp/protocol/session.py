"""The agent's exchange with one simulator: what it receives and sends in which state.

Every change of state goes through the table `AGENT`. `server` opens sessions and finds the session
of a datagram; `Outbox` takes what they send.
"""

from dataclasses import dataclass
from typing import NamedTuple

from . import binary, text
from .auth import Key, sealed
from .client import Address, Tap, largest_datagram
from .errors import DecodeError
from .fragments import Assembler, Transfer, asks
from .layout import Array, Layout
from .messages import Alive, Close, Command, Hello, Message, Missing, State, Welcome, one_line
from .statistics import Statistics
from .transitions import AGENT, AgentState, Way


class NoSuchSession(DecodeError):
    """A message of a session that is not here, or went on with another agent."""


class Event(NamedTuple):
    """The effect of a datagram."""

    slot: int
    message: State | Close
    joined: bool = False
    """The State is the first of a new session, which may have taken the slot of another."""


class Outbox:
    """What the sessions of an agent share: datagrams to send, counts, and the tap."""

    def __init__(self) -> None:
        self.datagrams: list[tuple[bytes, Address]] = []
        self.statistics = Statistics()
        self.tap: Tap | None = None

    def put(
        self, datagrams: list[bytes], address: Address, key: Key | None, count: str = "sent"
    ) -> None:
        """Take the datagrams of a message, sealed where there is a key."""
        self.datagrams += [(datagram, address) for datagram in sealed(datagrams, key)]
        self.statistics.counters[count] += 1


@dataclass(eq=False)
class Session:
    """An exchange with one simulator, pinned to its address and codec."""

    outbox: Outbox
    peer: Address  # address of the simulator
    number: int  # session number; 0 with the text codec
    layout: Layout
    hello: Hello | None  # none with the text codec, and so is `welcome`
    # The shared key, and that of the session once it has a slot; None without keys.
    key: Key | None = None
    line: bytes = b""  # its last line, by text
    state: AgentState = "new"
    welcome: Welcome | None = None
    slot: int = -1  # its slot; -1 before it has one
    sequence: int = 0  # number of the State that came last
    asked_at: float = 0.0
    # When it last said that it computes, or sent a fragment that was missing.
    heard_at: float = 0.0
    is_plain: bool = False  # whether it has a slot, and its messages are neither sealed nor text

    def __post_init__(self) -> None:
        self.is_text = self.hello is None
        self._assembler = Assembler(self.layout.state.size)
        self._largest = largest_datagram(self.peer)
        self.reply = Transfer(b"", self._largest)  # the answer to the last State, or the Welcome

    def move(self, way: Way, kind: type[Message]) -> None:
        """Be in the state that such a message leads to. Raises `KeyError` if it may not."""
        self.state = AGENT[self.state][way, kind]

    def session_key(self) -> Key | None:
        """The key of its messages after the Welcome."""
        if self.slot >= 0 or self.key is None:
            return self.key
        assert self.welcome is not None
        return self.key.for_session(self.number, self.welcome.nonce)

    # ---- what is sent

    def send_welcome(self, welcome: Welcome) -> None:
        """Open the session for its State 1."""
        self.welcome = welcome
        self.move("sent", Welcome)
        self._send(binary.encode(welcome))

    def send_command(
        self,
        actions: Array,
        orders: Array,
        seeds: Array | None,
        now: float,
        asks: Array | None = None,
    ) -> None:
        """Answer the last State.

        Raises `InputError` if it cannot be encoded, and `KeyError` where no Command is due; nothing
        was sent.
        """
        after = AGENT[self.state]["sent", Command]
        command = Command(
            session=self.number,
            sequence=self.sequence,
            actions=actions,
            orders=orders,
            seeds=seeds,
            asks=asks,
        )
        data = text.encode(command) if self.is_text else binary.encode_step(command, self.layout)
        self.state = after
        self.asked_at = self.heard_at = now
        self.reply = reply = Transfer(data, self._largest)
        outbox = self.outbox
        if reply.count == 1 and self.key is None:  # as `_put`, faster
            outbox.datagrams.append((data, self.peer))
            outbox.statistics.counters["sent"] += 1
        else:
            self._put(reply.start())
        if outbox.tap:
            self._record(command, data)

    def send_close(self, reason: str) -> None:
        """End the exchange."""
        close = self.goodbye(reason)
        data = text.encode(close) if self.is_text else binary.encode(close)
        self.move("sent", Close)
        self._send(data)
        self._record(close, data)

    def goodbye(self, reason: str) -> Close:
        """A Close of this session."""
        return Close(session=self.number, sequence=self.sequence, reason=one_line(reason))

    def part(self, reason: str) -> None:
        """Send a Close to which no answer is awaited."""
        goodbye = binary.encode(self.goodbye(reason))
        self.outbox.put([goodbye], self.peer, self.session_key())

    def repeat(self) -> None:
        """Send the last answer again, the same bytes."""
        self._put(self.reply.start(), "resent")

    def _answer_again(self) -> None:
        """Answer a State that came again: with Alive, while its Command is not there yet."""
        if self.state != "deciding":
            self.repeat()
        elif not self.is_text:
            alive = Alive(session=self.number, sequence=self.sequence)
            self.move("sent", Alive)
            self._put([binary.encode(alive)])

    def _record(self, message: Message, data: bytes) -> None:
        """Show a message to the tap."""
        if self.outbox.tap:
            self.outbox.tap(self.slot, message, data)

    def _send(self, data: bytes) -> None:
        """Send a message, and keep its bytes for a repeated State."""
        self.reply = Transfer(data, self._largest)
        self._put(self.reply.start())

    def _put(self, datagrams: list[bytes], count: str = "sent") -> None:
        self.outbox.put(datagrams, self.peer, self.key, count)

    # ---- what is received

    def join(self, slot: int, state: State, plain: bytes) -> Event:
        """Take a slot with the first State."""
        self.key = self.session_key()
        self.slot = slot
        self.move("received", State)
        self.sequence = state.sequence
        self.is_plain = self.key is None and not self.is_text
        self.outbox.statistics.counters["sessions"] += 1
        for message in (self.hello, self.welcome):
            if message:
                self._record(message, binary.encode(message))
        self._record(state, plain)
        return Event(slot, state, joined=True)

    def take_state(self, state: State, plain: bytes, now: float) -> Event:
        """The next State, which is expected."""
        self.sequence = state.sequence
        self.state = AGENT["expecting"]["received", State]
        self.outbox.statistics.round_trips.append(now - self.asked_at)
        if self.outbox.tap:
            self._record(state, plain)
        return Event(self.slot, state)

    def receive(self, message: Message, plain: bytes, now: float) -> Event | None:
        """Take a message of a session that has a slot; the event, if the exchange moves on.

        Raises `NoSuchSession` for a State beyond the next one: the simulator went on with another
        agent, and what opened the session here came late, from before a restart.
        """
        counters = self.outbox.statistics.counters
        is_state = isinstance(message, State)
        number = getattr(message, "sequence", 0)
        if is_state and number == self.sequence:
            self._answer_again()
            counters["duplicate"] += 1
            return None
        if is_state and number > self.sequence + 1 and not self.is_text:
            raise NoSuchSession
        is_due = number == self.sequence + is_state or isinstance(message, Close)
        if not is_due or ("received", type(message)) not in AGENT[self.state]:
            counters["stale"] += 1
            return None
        if isinstance(message, State):
            return self.take_state(message, plain, now)
        if isinstance(message, Close):
            self._record(message, plain)
            if self.state != "closing":
                self.send_close("")
            self.move("received", Close)
            return Event(self.slot, message)
        self.move("received", type(message))
        if isinstance(message, Alive):
            self.heard_at = now
        elif isinstance(message, Missing) and message.kind == binary.COMMAND:
            self._put(self.reply.resend(message), "resent")
        else:
            counters["stale"] += 1
        return None

    def assemble(self, fragment: bytes, now: float) -> bytes | None:
        """The State that is due, once all its fragments are there."""
        _, _, sequence = binary.peek(fragment)
        if sequence > self.sequence + 1:
            raise NoSuchSession
        if sequence <= self.sequence:
            is_repeat = sequence == self.sequence and self.slot >= 0
            if is_repeat and asks(fragment):
                self._answer_again()
            self.outbox.statistics.counters["duplicate" if is_repeat else "stale"] += 1
            return None
        self.heard_at = now
        whole = self._assembler.take(fragment)
        if answer := self._assembler.ask(fragment):
            self.outbox.put(answer, self.peer, self.session_key())
        return whole
