"""What the fuzzer gives its inputs to: codecs, seals, fragments and both state machines.

The first byte of an input chooses the target. For the state machines the rest is a little
program: flights between two simulators and an agent, into which an attacker sends datagrams of its
own, and changes of what was sent, with checksum and seal made right if it likes. A finding is any
exception but `DecodeError` from a codec, any from a link, and any promise of docs/protocol.md that
`Flight` checks and that was broken.
"""

import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields
from itertools import count, product
from typing import Any, Final

import numpy as np
from golden import LAYOUTS, LINES, SECRET, SESSION, SPECS, fixed, messages
from links import outgoing
from rotorgram.envs.spec import EnvSpec, SpecError
from rotorgram.udp.protocol import binary, text
from rotorgram.udp.protocol.auth import OVERHEAD, Key, is_sealed
from rotorgram.udp.protocol.client import Address, Client, LinkConfig
from rotorgram.udp.protocol.errors import DecodeError
from rotorgram.udp.protocol.fragments import Assembler, is_fragment
from rotorgram.udp.protocol.layout import Layout
from rotorgram.udp.protocol.messages import (
    Close,
    Command,
    Hello,
    Message,
    State,
    Welcome,
)
from rotorgram.udp.protocol.server import Server

ADDRESSES: Final = [("10.0.0.1", 0), ("10.0.0.1", 1), ("10.6.6.6", 666)]
"""Of two simulators, and of an attacker."""


class Finding(Exception):
    """Something that must not be."""


def expect(promise: bool, *got: object) -> None:
    if not promise:
        raise Finding(*got)


# ---- codecs


SPEC: Final = SPECS["one"]
LAYOUT: Final = LAYOUTS["one"]


def content(message: Message) -> list[object]:
    """Every field, arrays as shape, kind and bits."""
    return [type(message)] + [_content(getattr(message, one.name)) for one in fields(message)]


def _content(value: Any) -> object:
    if isinstance(value, np.ndarray):
        return value.shape, value.dtype.str, value.tobytes()
    if isinstance(value, tuple):
        return [_content(one) for one in value]
    return value


def check_numbers(message: Message) -> None:
    arrays: list[np.ndarray] = []
    if isinstance(message, Command):
        arrays = [message.actions]
        expect(bool((message.orders <= 2).all()), "no order", message)
    if isinstance(message, State):
        arrays = [*message.observations, message.rewards, *message.telemetry]
        expect(bool(np.isfinite(message.time)), "no time", message)
    for array in arrays:
        expect(bool(np.isfinite(array).all()), "not finite", message)


def righted(datagram: bytes) -> bytes:
    """With its checksum made right, behind whatever seal it has."""
    at = OVERHEAD if is_sealed(datagram) else 0
    if len(datagram) < at + 24:
        return datagram
    return datagram[:at] + fixed(datagram[at:])


def fuzz_binary(data: bytes) -> None:
    for datagram in (data, righted(data), righted(b"\xa7R\x02" + data)):
        for layout in (*LAYOUTS.values(), None):
            with suppress(DecodeError):
                message = binary.decode(datagram, layout)
                check_numbers(message)
                again = binary.encode(message, layout)
                expect(len(again) == len(datagram), "another length", message)
                expect(
                    content(binary.decode(again, layout)) == content(message), "changed", message
                )


def fuzz_text(data: bytes) -> None:
    decoders: list[Callable[[bytes], Message]] = [
        lambda line: text.decode_state(line, LAYOUT),
        lambda line: text.decode_command(line, LAYOUT, 0),
    ]
    for decode in decoders:
        with suppress(DecodeError):
            message = decode(data)
            check_numbers(message)
            assert isinstance(message, State | Command | Close)
            try:
                again = text.encode(message, LAYOUT)
            except ValueError:  # 17 digits each do not fit where fewer did
                expect(len(data) > 200, "not to be encoded", message)
                continue
            expect(content(decode(again)) == content(message), "changed", message)


def fuzz_keys(data: bytes) -> None:
    ours = Key(SECRET, "simulator")
    theirs = Key(SECRET, "agent")
    expect(theirs.open(ours.seal(data)) == data, "not opened")
    expect(theirs.open(ours.seal(data, data), data) == data, "not opened")
    for hostile in (data, b"\xa7S" + data, ours.seal(data)[:-1] + b"x" + data, theirs.seal(data)):
        with suppress(DecodeError):
            theirs.open(hostile)
            raise Finding("opened", hostile)


def fuzz_fragments(data: bytes) -> None:
    """Fragments in any order, of messages that are a few bytes long."""
    program = Program(data)
    largest = 100
    assembler = Assembler(largest)
    came: dict[tuple[int, int, int], set[bytes]] = {}
    while program:
        sequence = program.byte() % 3
        number = program.byte() % 5
        count = program.byte() % 5
        head = b"" if number else binary.frame(binary.STATE, SESSION, sequence, b"")
        piece = head + program.piece()
        fragment = fragment_of(binary.STATE, SESSION, sequence, number, count, piece)
        expect(is_fragment(fragment), "no fragment")
        with suppress(DecodeError):
            came.setdefault((sequence, count, number), set()).add(piece)
            whole = assembler.take(fragment)
            if whole is not None:
                expect(len(whole) <= largest, "too much", whole)
                texts = [came[sequence, count, n] for n in range(count)]
                known = {b"".join(choice) for choice in product(*texts)}
                expect(whole in known, "made up", whole)
        if missing := assembler.missing():
            expect(0 < len(missing.numbers()) < missing.count, "missing", missing)


def fragment_of(
    kind: int, session: int, sequence: int, number: int, count: int, piece: bytes
) -> bytes:
    body = struct.pack("<HHB3x", number, count, 1) + piece
    return binary.frame(kind | binary.FRAGMENT, session, sequence, body)


def fuzz_spec(data: bytes) -> None:
    """What an agent makes of the spec in a Hello."""
    with suppress(SpecError):
        spec = EnvSpec.from_json(data.decode(errors="replace"))
        expect(EnvSpec.from_json(spec.to_json()) == spec, "changed", spec)


# ---- state machines


class Program:
    """Bytes as numbers and pieces; zeros behind the end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def byte(self) -> int:
        self._at += 1
        return self._data[self._at - 1] if self._at <= len(self._data) else 0

    def piece(self) -> bytes:
        """As many bytes as the next one says."""
        size = self.byte()
        self._at += size
        return self._data[self._at - size : self._at]


def greeting(session: int = SESSION) -> Hello:
    return Hello(session=session, spec=SPEC.to_json())


def accept(hello: Hello) -> Layout | str:
    return LAYOUT if hello.spec == SPEC.to_json() and hello.worlds == 1 else "another env"


def send_state(link: Client, now: float) -> None:
    flag = np.zeros(1, bool)
    observations = (np.full((1, 3), link.sequence, np.float32),)
    telemetry = (np.zeros((1, 3)), np.zeros((1, 1)))
    link.send_state(0.0, observations, np.zeros(1), flag, flag, telemetry, now)


class Flight:
    """Two simulators and an agent, and what is promised of them whatever they are sent."""

    def __init__(self, *, sealed: bool, by_text: bool) -> None:
        self.sealed = sealed
        self.by_text = by_text
        self.now = 0.0
        self.numbers = count(1)
        self.nonces = count(1)
        self.seen: list[bytes] = []
        self.balance = 0
        self.opened = False
        self.simulators: dict[Address, Client] = {}
        self.start_agent()
        for address in ADDRESSES[:2]:
            self.start_simulator(address)

    def start_agent(self) -> None:
        self.agent = Server(
            accept,
            lambda: LAYOUT,
            slots=2,
            key=Key(SECRET, "agent") if self.sealed else None,
            draw_nonce=lambda: next(self.nonces),
        )

    def start_simulator(self, address: Address) -> None:
        link = Client(
            greeting(next(self.numbers)),
            LAYOUT,
            LinkConfig(),
            by_text=self.by_text,
            key=Key(SECRET, "simulator") if self.sealed else None,
            draw_session=lambda: next(self.numbers),
        )
        self.simulators[address] = link
        link.connect(self.now)
        if self.by_text:
            send_state(link, self.now)

    # ---- honest

    def flow(self) -> None:
        """All that is on its way arrives."""
        for address, link in self.simulators.items():
            for datagram in outgoing(link):
                self.note(datagram)
                self.give_agent(datagram, address)
        for datagram, address in outgoing(self.agent):
            self.note(datagram)
            if address in self.simulators:
                self.give_simulator(datagram, address)
            else:
                self.balance -= len(datagram)
        expect(self.balance >= 0 or self.opened, "a stranger was sent more than it sent")

    def note(self, datagram: bytes) -> None:
        if len(self.seen) < 64:
            self.seen.append(datagram)

    def decide(self) -> None:
        for session in self.agent.slots:
            if session and session.state == "deciding":
                orders = np.zeros(1, np.uint8)
                session.send_command(np.ones(1, np.int64), orders, None, self.now)

    def give_agent(self, datagram: bytes, address: Address) -> None:
        agent = self.agent
        before = [(s, s.sequence) if s else (None, 0) for s in agent.slots]
        event = agent.receive(datagram, address, self.now)
        holders = [s.peer for s in agent.slots if s]
        expect(len(holders) == len(set(holders)), "slots", holders)
        self.opened = self.opened or ADDRESSES[2] in holders
        if event is None:
            expect([s for s, _ in before] == agent.slots, "a slot changed without a word")
            return
        check_numbers(event.message)
        session, sequence = before[event.slot]
        after = agent.slots[event.slot]
        if isinstance(event.message, Close):
            expect(after is None, "closed, and not free")
        elif event.joined:
            expect(after is not session, "joined what was there")
        else:
            expect(after is session, "another session")
            expect(event.message.sequence == sequence + 1, "out of turn", sequence, event)

    def give_simulator(self, datagram: bytes, address: Address) -> None:
        link = self.simulators[address]
        sequence = link.sequence
        session = link.hello.session
        message = link.receive(datagram, self.now)
        if isinstance(message, Command):
            check_numbers(message)
            expect(message.sequence == sequence, "out of turn", sequence, message)
            expect(self.by_text or message.session == session, "of another session")
            value = message.actions.item()
            expect(value in (0, 1, 2), "no action", value)
        if isinstance(message, Command | Welcome):
            send_state(link, self.now)

    # ---- the attacker

    def attack(self, datagram: bytes, address: Address) -> None:
        datagram = datagram[:65_507]
        before = self.snapshot()
        if address == ADDRESSES[2]:
            self.balance += len(datagram)
        self.give_agent(datagram, address)
        for there in self.simulators:
            self.give_simulator(datagram, there)
        if self.sealed and datagram not in self.seen and len(self.seen) < 64:
            expect(self.snapshot() == before, "moved by", datagram)

    def snapshot(self) -> list[object]:
        slots = [s and (s.number, s.peer, s.state, s.sequence) for s in self.agent.slots]
        links = [(s.state, s.sequence, s.hello.session) for s in self.simulators.values()]
        return [slots, links]

    def make(self, program: Program) -> bytes:
        """A datagram of its own, or of what it has seen; changed, made right, sealed."""
        source = program.byte()
        flags = program.byte()
        datagram = self.seen[source % len(self.seen)] if source and self.seen else program.piece()
        if flags & 1:
            at = program.byte()
            new = program.piece()
            datagram = datagram[:at] + new + datagram[at + len(new) :]
        if flags & 2:
            datagram = datagram[: program.byte()]
        if flags & 64:  # a fragment of it
            numbers = program.byte() % 4, 1 + program.byte() % 4
            piece = datagram[numbers[0] * len(datagram) // numbers[1] :]
            datagram = fragment_of(*binary.peek(datagram), *numbers, piece[: program.byte()])
        if flags & 4:
            datagram = righted(datagram)
        if flags & 8 and is_sealed(datagram):
            datagram = datagram[OVERHEAD:]
        if flags & 16:  # with a key of its own
            side: Any = ("simulator", "agent")[flags >> 5 & 1]
            datagram = Key(bytes(32), side).seal(datagram)
        return datagram


def fuzz_links(data: bytes) -> None:
    program = Program(data)
    mode = program.byte()
    flight = Flight(sealed=mode % 3 == 1, by_text=mode % 3 == 2)
    for _ in range(mode >> 4 & 3):
        flight.flow()
        flight.decide()
    for _ in range(20):
        if not program:
            break
        operation = program.byte()
        number = operation >> 4
        match operation & 15:
            case 0 | 1 | 2 | 3 | 4 | 5 | 6:
                flight.attack(flight.make(program), ADDRESSES[number % 3])
            case 7 | 8 | 9:
                flight.flow()
                flight.decide()
            case 10:
                flight.now += (0.0, 0.03, 0.3, 2.0, 40.0)[number % 5]
                flight.agent.handle_timer(flight.now)
                for link in flight.simulators.values():
                    link.handle_timer(flight.now)
            case 11:
                flight.start_simulator(ADDRESSES[number % 2])
            case 12:
                flight.start_agent()
            case 13:
                flight.agent.free(number % 2)
            case 14:
                flight.simulators[ADDRESSES[number % 2]].close("bye", flight.now)
            case 15:
                flight.flow()
                if number == 0:
                    flight.agent.close("bye", flight.now)
    flight.flow()
    flight.flow()


# ---- inputs

TARGETS: Final = [fuzz_binary, fuzz_text, fuzz_keys, fuzz_spec, *[fuzz_links] * 4, fuzz_fragments]


def fuzz_one(data: bytes) -> None:
    if data:
        TARGETS[data[0] % len(TARGETS)](data[1:])


def seeds() -> Iterator[bytes]:
    """The first inputs: every message, every line, and some flights."""
    for message in [message for _, env, message in messages() if env == "one"]:
        datagram = binary.encode(message, LAYOUT)
        yield b"\0" + datagram
        yield b"\2" + datagram
        for at in range(24, min(len(datagram), 80), 4):  # sizes that lie, and what is not a number
            for word in (b"\1\0\0\0", b"\xff\xff\xff\xff"):
                yield b"\0" + datagram[:at] + word + datagram[at + 4 :]
        for mode in (0x20, 0x21, 0x22):
            piece = bytes([0, len(datagram) & 255]) + datagram
            yield bytes([4, mode]) + b"\x07" + b"\0" + piece[:1] + b"\4" + piece[1:] + b"\x07\x07"
        for number in range(2):
            halves = bytes([0, 1]) + bytes([number, 1, 255])
            yield bytes([4, 0x20, 0]) + halves[:1] + b"\x44" + piece[1:] + halves[2:] + b"\x07\x07"
    for order in ((0, 1, 2), (2, 0, 0, 1), (1, 2, 0, 1, 2, 0)):
        yield b"\x08" + b"".join(bytes([1, number, 3, 2, number, 7]) for number in order)
    yield b"\3" + SPEC.to_json().encode()
    for line in [line.encode() for line in (*LINES["states"], *LINES["commands"])]:
        yield b"\1" + line
        yield bytes([4, 0x22, 0, 0, 0, len(line)]) + line + b"\x07"
    for mode in range(0x30, 0x33):
        for events in (b"\x0b\x07\x07\x07", b"\x0c\x4a\x07\x07\x07\x07", b"\x0e\x07\x1a\x1a\x07",
                       b"\x0f\x1a\x07\x1a", b"\x0d\x4a\x07\x07\x07"):  # fmt: skip
            yield bytes([4, mode]) + events
            for source in (1, 3, 7):
                yield bytes([4, mode, 0, source, 0]) + events + bytes([0x10, source, 5, 40, 1, 255])
    yield b"\0" + struct.pack("<2sBBIQQI4x", b"\xa7R", 2, 5, 0, 1, 1, 2**32 - 1)
