"""Coverage-guided fuzzing of all that reads datagrams: codecs, seals and both state machines.

    python tests/fuzz/fuzz_wire.py -runs=1000000
    python tests/fuzz/fuzz_wire.py -max_total_time=600 --json docs/results/reliability/fuzz.json
    python tests/fuzz/fuzz_wire.py runs/fuzz/crash-...        (one input again)

Needs Atheris (`pip install atheris`: libFuzzer for Python; Linux and macOS). All options but
`--json` are libFuzzer's. What it finds is written to `runs/fuzz`, where the corpus grows too.

The first byte of an input chooses what it is given to. For the state machines the rest is a little
program: flights between two simulators and an agent, into which somebody sends datagrams of his
own, his changes of what was sent, with checksum and seal made right if he likes. A finding is any
exception but `DecodeError` from a codec, any from a link, and any promise of docs/protocol.md that
`Flight` checks and that was broken. NumPy raises here where it would only warn.
"""

import argparse
import json
import platform
import re
import struct
import subprocess
import sys
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import metadata
from itertools import count, product
from pathlib import Path
from typing import Any, Final

import atheris
import numpy as np

with atheris.instrument_imports(include=["rotorgram.udp"]):
    from rotorgram.udp import binary, interface, parts, text
    from rotorgram.udp.agent_link import AgentLink
    from rotorgram.udp.errors import DecodeError
    from rotorgram.udp.keys import OVERHEAD, Key, is_sealed
    from rotorgram.udp.link import Address, LinkConfig
    from rotorgram.udp.messages import (
        Close,
        Command,
        Hello,
        Message,
        Refuse,
        State,
        Unknown,
        Wait,
        Welcome,
    )
    from rotorgram.udp.simulator_link import SimulatorLink

ROOT: Final = Path(__file__).parent.parent.parent
FOUND: Final = ROOT / "runs" / "fuzz"
SECRET: Final = bytes(range(32))
SESSION: Final = 0x0123456789ABCDEF
ADDRESSES: Final = [("10.0.0.1", 0), ("10.0.0.1", 1), ("10.6.6.6", 666)]
"""Of two simulators, and of somebody else."""


class Finding(Exception):
    """Something that must not be."""


def expect(promise: bool, *got: object) -> None:
    if not promise:
        raise Finding(*got)


# ---- codecs


def content(message: Message) -> list[object]:
    """Every field, arrays as shape, kind and bits."""
    values = [getattr(message, name) for name in type(message).__slots__]
    return [type(message)] + [
        (v.shape, v.dtype.str, v.tobytes()) if isinstance(v, np.ndarray) else v for v in values
    ]


def check_numbers(message: Message) -> None:
    if isinstance(message, Command):
        expect(bool(np.isfinite(message.actions).all()), "not finite", message)
    if isinstance(message, State):
        for numbers in (message.observations, message.rewards, message.telemetry):
            expect(bool(np.isfinite(numbers).all()), "not finite", message)


def fixed(datagram: bytes) -> bytes:
    """With its checksum made right, behind whatever seal it has."""
    at = OVERHEAD if is_sealed(datagram) else 0
    if len(datagram) < at + 24:
        return datagram
    crc = zlib.crc32(datagram[at + 8 :], zlib.crc32(datagram[at : at + 4]))
    return datagram[: at + 4] + crc.to_bytes(4, "little") + datagram[at + 8 :]


def fuzz_binary(data: bytes) -> None:
    for datagram in (data, fixed(data), fixed(b"\xa7R\x02" + data)):
        with suppress(DecodeError):
            message = binary.decode(datagram)
            check_numbers(message)
            again = binary.encode(message)
            expect(len(again) == len(datagram), "another length", message)
            expect(content(binary.decode(again)) == content(message), "changed", message)


def fuzz_text(data: bytes) -> None:
    decoders: list[Callable[[bytes], Message]] = [
        lambda line: text.decode_state(line, 1, 0),
        lambda line: text.decode_state(line, 3, 2),
        lambda line: text.decode_command(line, 1, 0),
        lambda line: text.decode_command(line, 3, 0),
    ]
    for decode in decoders:
        with suppress(DecodeError):
            message = decode(data)
            check_numbers(message)
            try:
                again = text.encode(message)
            except ValueError:  # 17 digits each do not fit where fewer did
                expect(len(data) > 200, "not to be encoded", message)
                continue
            expect(content(decode(again)) == content(message), "changed", message)


def fuzz_keys(data: bytes) -> None:
    ours, theirs = Key(SECRET, "simulator"), Key(SECRET, "agent")
    expect(theirs.open(ours.seal(data)) == data, "not opened")
    expect(theirs.open(ours.seal(data, data), data) == data, "not opened")
    for hostile in (data, b"\xa7S" + data, ours.seal(data)[:-1] + b"x" + data, theirs.seal(data)):
        with suppress(DecodeError):
            theirs.open(hostile)
            raise Finding("opened", hostile)


def fuzz_parts(data: bytes) -> None:
    """Parts in any order, of messages that are a few bytes long."""
    program, largest = Program(data), 100
    assembler, came = parts.Assembler(largest), {}
    while program:
        sequence, number, count = program.byte() % 3, program.byte() % 5, program.byte() % 5
        piece = program.piece()
        part = part_of(binary.STATE, SESSION, sequence, number, count, piece)
        expect(parts.is_part(part), "no part")
        with suppress(DecodeError):
            whole = assembler.take(sequence, part)
            came.setdefault((sequence, count, number), set()).add(piece)
            if whole is not None:
                expect(len(whole) <= largest, "too much", whole)
                texts = [came[sequence, count, n] for n in range(count)]
                known = {b"".join(choice) for choice in product(*texts)}
                expect(whole in known, "made up", whole)
        kept = sum(map(len, assembler._slices.values()))
        expect(kept == assembler._size <= largest, "kept", kept)


def part_of(kind: int, session: int, sequence: int, number: int, count: int, piece: bytes) -> bytes:
    body = struct.pack("<HH4x", number, count) + piece
    return binary.frame(kind | binary.PART, session, sequence, body)


def fuzz_accept(data: bytes) -> None:
    """What an agent makes of a Hello that is correct, and fits or not."""
    with suppress(DecodeError):
        hello = binary.decode(fixed(b"\xa7R\x02\x01" + data[3:]))
        if isinstance(hello, Hello):
            expected = interface.announced(greeting())
            for there in (None, expected):
                expect(isinstance(interface.refusal("a/B-v0", there, None, hello), str), "?")


# ---- state machines


class Program:
    """Bytes as numbers and pieces; zeros behind the end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

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
    return Hello(
        session=session,
        env_id="a/B-v0",
        num_drones=1,
        observation_low=np.array([-1], np.float32),
        observation_high=np.array([1], np.float32),
        action_low=np.array([0], np.float32),
        action_high=np.array([2], np.float32),
        discrete_actions=3,
        control_period=0.02,
        model_hash="00112233445566778899aabbccddeeff",
        telemetry_names=("X", "F1"),
        options='{"a":1}',
    )


def some_state(session: int, sequence: int) -> State:
    return State(
        session=session,
        sequence=sequence,
        observations=np.array([[sequence - 1]], np.float32),
        rewards=np.zeros(1),
        terminated=np.zeros(1, bool),
        truncated=np.zeros(1, bool),
        telemetry=np.zeros((1, 2)),
    )


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
        self.simulators: dict[Address, SimulatorLink] = {}
        self.start_agent()
        for address in ADDRESSES[:2]:
            self.start_simulator(address)

    def start_agent(self) -> None:
        self.agent = AgentLink(
            lambda _: "",
            (1, 2),
            places=2,
            key=Key(SECRET, "agent") if self.sealed else None,
            draw_nonce=lambda: next(self.nonces),
        )

    def start_simulator(self, address: Address) -> None:
        link = SimulatorLink(
            greeting(next(self.numbers)),
            LinkConfig(),
            text_codec=self.by_text,
            key=Key(SECRET, "simulator") if self.sealed else None,
            draw_session=lambda: next(self.numbers),
        )
        self.simulators[address] = link
        link.connect(self.now)
        if self.by_text:
            link.send_state(some_state(link.hello.session, 1), self.now)

    # ---- honest

    def flow(self) -> None:
        """All that is on its way arrives."""
        for address, link in self.simulators.items():
            for datagram in link.take_outgoing():
                self.note(datagram)
                self.give_agent(datagram, address)
        for datagram, address in self.agent.take_outgoing():
            self.note(datagram)
            if address in self.simulators:
                self.give_simulator(datagram, address)
            else:
                self.balance -= len(datagram)
        expect(self.balance >= 0 or self.opened, "a stranger was sent more than he sent")

    def note(self, datagram: bytes) -> None:
        if len(self.seen) < 64:
            self.seen.append(datagram)

    def decide(self) -> None:
        for place, session in enumerate(self.agent.places):
            if session and session.state == "deciding":
                command = Command(
                    session=session.number,
                    sequence=session.sequence,
                    actions=np.ones((1, 1), np.float32),
                    resets=np.zeros(1, bool),
                )
                self.agent.send_command(place, command, self.now)

    def give_agent(self, datagram: bytes, address: Address) -> None:
        agent = self.agent
        before = [(s, s.sequence) if s else (None, 0) for s in agent.places]
        seats = {s.peer: place for place, s in enumerate(agent.places) if s}
        kept = agent._admission.seats
        expect(kept == seats, "seats", kept, seats)
        sent = len(agent._outbox.datagrams)
        event = agent.receive(datagram, address, self.now)
        expect(len(agent._outbox.datagrams) <= sent + 1, "more answers than one")
        self.opened = self.opened or ADDRESSES[2] in kept
        if event is None:
            expect([s for s, _ in before] == agent.places, "a place changed without a word")
            return
        check_numbers(event.message)
        session, sequence = before[event.place]
        after = agent.places[event.place]
        if isinstance(event.message, Close):
            expect(after is None, "closed, and not free")
        elif event.joined:
            expect(after is not session, "joined what was there")
        else:
            expect(after is session, "another session")
            expect(event.message.sequence == sequence + 1, "out of turn", sequence, event)

    def give_simulator(self, datagram: bytes, address: Address) -> None:
        link = self.simulators[address]
        sequence, session = link.sequence, link.hello.session
        message = link.receive(datagram, self.now)
        if isinstance(message, Command):
            check_numbers(message)
            expect(message.sequence == sequence, "out of turn", sequence, message)
            expect(self.by_text or message.session == session, "of another session")
            value = message.actions.item()
            expect(value in (0, 1, 2) or bool(message.resets.any()), "no action", value)
        if isinstance(message, Command | Welcome):
            link.send_state(some_state(link.hello.session, link.sequence + 1), self.now)

    # ---- somebody

    def attack(self, datagram: bytes, address: Address) -> None:
        datagram = datagram[: binary.MAX_DATAGRAM]
        before = self.snapshot()
        if address == ADDRESSES[2]:
            self.balance += len(datagram)
        self.give_agent(datagram, address)
        for there in self.simulators:
            self.give_simulator(datagram, there)
        if self.sealed and datagram not in self.seen and len(self.seen) < 64:
            expect(self.snapshot() == before, "moved by", datagram)

    def snapshot(self) -> list[object]:
        places = [s and (s.number, s.peer, s.state, s.sequence) for s in self.agent.places]
        links = [(s.state, s.sequence, s.hello.session) for s in self.simulators.values()]
        return [places, links]

    def make(self, program: Program) -> bytes:
        """A datagram of his own, or of what he has seen; changed, made right, sealed."""
        source, flags = program.byte(), program.byte()
        datagram = self.seen[source % len(self.seen)] if source and self.seen else program.piece()
        if flags & 1:
            at, new = program.byte(), program.piece()
            datagram = datagram[:at] + new + datagram[at + len(new) :]
        if flags & 2:
            datagram = datagram[: program.byte()]
        if flags & 64:  # a part of it
            numbers = program.byte() % 4, 1 + program.byte() % 4
            piece = datagram[numbers[0] * len(datagram) // numbers[1] :]
            datagram = part_of(*binary.peek(datagram), *numbers, piece[: program.byte()])
        if flags & 4:
            datagram = fixed(datagram)
        if flags & 8 and is_sealed(datagram):
            datagram = datagram[OVERHEAD:]
        if flags & 16:  # with a key of his own
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


# ---- the program

TARGETS: Final = [fuzz_binary, fuzz_text, fuzz_keys, fuzz_accept, *[fuzz_links] * 4, fuzz_parts]


def fuzz_one(data: bytes) -> None:
    if data:
        TARGETS[data[0] % len(TARGETS)](data[1:])


def messages() -> list[Message]:
    return [
        greeting(),
        Welcome(session=SESSION, nonce=5, seed=7),
        Refuse(session=SESSION, reason="busy"),
        some_state(SESSION, 1),
        Command(
            session=SESSION,
            sequence=1,
            actions=np.array([[0.5], [-1.0]], np.float32),
            resets=np.array([True, False]),
            seeds=np.array([2**64 - 1, 5], np.uint64),
        ),
        Close(session=SESSION, sequence=1, reason="done"),
        Wait(session=SESSION),
        Unknown(session=SESSION, sequence=1),
    ]


def seeds() -> Iterator[bytes]:
    """The first inputs: every message, every line, and some flights."""
    for message in messages():
        datagram = binary.encode(message)
        yield b"\0" + datagram
        yield b"\2" + datagram
        for at in range(24, min(len(datagram), 80), 4):  # sizes that lie, and what is not a number
            for word in (b"\1\0\0\0", b"\xff\xff\xff\xff"):
                yield b"\0" + datagram[:at] + word + datagram[at + 4 :]
        for mode in (0x20, 0x21, 0x22):
            piece = bytes([0, len(datagram)]) + datagram
            yield bytes([4, mode]) + b"\x07" + b"\0" + piece[:1] + b"\4" + piece[1:] + b"\x07\x07"
        for number in range(2):
            halves = bytes([0, 1]) + bytes([number, 1, 255])
            yield bytes([4, 0x20, 0]) + halves[:1] + b"\x44" + piece[1:] + halves[2:] + b"\x07\x07"
    for order in ((0, 1, 2), (2, 0, 0, 1), (1, 2, 0, 1, 2, 0)):
        yield b"\x08" + b"".join(bytes([1, number, 3, 2, number, 7]) for number in order)
    yield b"\3" + binary.encode(greeting())[1:]
    for line in (b"1,0.5,0,1,0.25,-0.0,1.5,1.0,-2.0", b"1,0,0,0,.5,1,2", b"1,0.5", b"1,reset",
                 b"1,reset,7\r\n", b"1,close", b"3,-1e-300,+2.,3E4"):  # fmt: skip
        yield b"\1" + line
        yield bytes([4, 0x22, 0, 0, 0, len(line)]) + line + b"\x07"
    for mode in range(0x30, 0x33):
        for events in (b"\x0b\x07\x07\x07", b"\x0c\x4a\x07\x07\x07\x07", b"\x0e\x07\x1a\x1a\x07",
                       b"\x0f\x1a\x07\x1a", b"\x0d\x4a\x07\x07\x07"):  # fmt: skip
            yield bytes([4, mode]) + events
            for source in (1, 3, 7):
                yield bytes([4, mode, 0, source, 0]) + events + bytes([0x10, source, 5, 40, 1, 255])
    yield b"\0" + struct.pack("<2sBBIQQIH6xI", b"\xa7R", 2, 5, 0, 1, 1, 2**32 - 1, 65535, 2**32 - 1)


def fuzz(arguments: list[str]) -> None:
    """In a process of its own, which libFuzzer ends."""
    warnings.simplefilter("error")
    np.seterr(all="raise")
    atheris.Setup([sys.argv[0], *arguments], fuzz_one)
    atheris.Fuzz()


def main() -> int:
    parser = argparse.ArgumentParser(usage="fuzz_wire.py [--json FILE] [libFuzzer's arguments]")
    parser.add_argument("--json", type=Path, help="write the executions and findings here")
    options, arguments = parser.parse_known_args()
    corpus = FOUND / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds()):
        (corpus / f"seed-{number:03d}").write_bytes(seed)
    if all(argument.startswith("-") for argument in arguments):
        arguments.append(str(corpus))
    command = [sys.executable, __file__, "--here", f"-artifact_prefix={FOUND}/", "-max_len=1024",
               "-rss_limit_mb=0",  # Atheris 3.0.0 leaks what comparisons of arrays give
               "-print_final_stats=1", *arguments]  # fmt: skip
    begun = time.monotonic()
    done = ""
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            print(line, end="", file=sys.stderr)
            if found := re.match(r"stat::number_of_executed_units: *(\d+)", line):
                done = found[1]
    result = {
        "executions": int(done or 0),
        "seconds": round(time.monotonic() - begun),
        "findings": int(process.returncode != 0),
        "python": platform.python_version(),
        "atheris": metadata.version("atheris"),
    }
    print(f"{result['executions']:,} executions, {result['findings']} findings")
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return process.returncode


if __name__ == "__main__":
    if sys.argv[1:2] == ["--here"]:
        fuzz(sys.argv[2:])
    else:
        sys.exit(main())
