"""Datagrams of flight stacks, mutated: codecs refuse or read them, and no flight changes.

    python studies/hostile_programs.py [--datagrams 1000000] [--out FILE.json]

What programs sent in the sessions of `tests/data/sessions` is mutated: bytes changed, cut off,
added, repeated. Each codec reads a datagram as numbers from 0 to 1, or refuses it by `InputError`;
anything else ends this script. Then a session is flown again while strangers send such datagrams to
the port of its simulator, as fast as they can: the flight has the bits of the recorded one.

It takes two minutes on two cores.
"""

import json
import random
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event, Thread
from unittest.mock import patch

from measuring import RESULTS, options, write
from rotorgram.autopilots.programs import HOST, Program
from rotorgram.autopilots.protocol import ardupilot, betaflight, crazyflie
from rotorgram.models import InputError

TESTS = Path(__file__).parents[1] / "tests"
sys.path.append(str(TESTS))
from player import read_session  # noqa: E402
from sessions import HASHES, SESSIONS, flown, hash_of  # noqa: E402

MOTORS = 4
PORTS = {"betaflight": betaflight.MOTORS_PORT, "crazyflie": crazyflie.PORT}
SERVOS = bytes.fromhex("1a48900100000000") + 16 * bytes.fromhex("dc05")
Read = Callable[[bytes], object]


def mutated(datagram: bytes, dice: random.Random) -> bytes:
    """One to four changes of a datagram."""
    content = bytearray(datagram)
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(len(content) + 1)
        match dice.randrange(5):
            case 0 if content:
                content[at % len(content)] = dice.randrange(256)
            case 1:
                del content[at:]
            case 2:
                content[at:at] = dice.randbytes(dice.randint(1, 8))
            case 3:
                content += content[:at]
            case _:
                content[at : at + 4] = b"\xff\xff\xff\x7f"
    return bytes(content[:2048])


def count(read: Read, seeds: Sequence[bytes], datagrams: int) -> dict[str, int]:
    """How many mutated datagrams a codec reads, leaves to others, and refuses."""
    dice = random.Random(0)
    counts = {"read": 0, "of others": 0, "refused": 0}
    for _ in range(datagrams):
        datagram = mutated(dice.choice(seeds), dice)
        try:
            throttles = read(datagram)
        except InputError:
            counts["refused"] += 1
            continue
        counts["read" if throttles is not None else "of others"] += 1
        if throttles is not None and not ((throttles >= 0.0) & (throttles <= 1.0)).all():  # type: ignore[operator, attr-defined]
            raise AssertionError(f"{datagram.hex()} was read as {throttles}")
    return counts


def flood(port: int, seeds: Sequence[bytes], begin: Event, stop: Event, sent: list[int]) -> None:
    """Send mutated datagrams to a port from the program's first one on until it is time to stop."""
    begin.wait()
    dice = random.Random(1)
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    while not stop.is_set():
        stranger.sendto(mutated(dice.choice(seeds), dice), (HOST, port))
        sent[0] += 1
        time.sleep(0.0)


def flown_in_flood(name: str, seeds: Sequence[bytes]) -> dict[str, object]:
    """A session flown again while a stranger sends."""
    begin, stop = Event(), Event()
    sent = [0]
    thread = Thread(target=flood, args=(PORTS[name], seeds, begin, stop, sent))
    meet = Program.meet

    def met(self: Program, read: Read) -> bytes:
        datagram = meet(self, read)
        begin.set()
        return datagram

    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / name
        words = f'"{sys.executable}" "{TESTS / "player.py"}" "{SESSIONS / name}.xz" "$@"'
        program.write_text(f"#!/bin/sh\nunset LD_PRELOAD; exec {words}\n")
        program.chmod(0o755)
        thread.start()
        try:
            with patch.object(Program, "meet", met):
                flight, tally = flown(name, program)
        finally:
            begin.set()
            stop.set()
            thread.join()
    recorded = json.loads(HASHES.read_text())[name]
    if hash_of(flight) != recorded or tally.faults:
        raise AssertionError(f"{name}: the flight changed: {tally.faults}")
    return {"datagrams": sent[0], "hash": recorded}


def main() -> None:
    parser = options(__doc__, datagrams=1_000_000, out=RESULTS / "reliability/programs.json")
    args = parser.parse_args()
    sessions = {
        name: [content for port, content in read_session(SESSIONS / f"{name}.xz") if port is None]
        for name in PORTS
    }
    codecs: dict[str, tuple[Read, list[bytes]]] = {
        "betaflight": (lambda one: betaflight.throttles(one, MOTORS), sessions["betaflight"]),
        "crazyflie": (crazyflie.throttles, sessions["crazyflie"]),
        "ardupilot": (lambda one: ardupilot.servos(one).throttles, [SERVOS]),
    }
    mutants = {name: count(*codec, args.datagrams) for name, codec in codecs.items()}
    print(mutants)
    flights = {name: flown_in_flood(name, seeds) for name, seeds in sessions.items()}
    print(flights)
    write(args.out, {"mutated": mutants, "flights": flights})


if __name__ == "__main__":
    main()
