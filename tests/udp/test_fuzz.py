"""The targets of the fuzzer, with their first inputs and random changes of them."""

import sys
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from golden import LAYOUTS, messages

sys.path.insert(0, str(Path(__file__).parents[1] / "fuzz"))

from rotorgram.envs.spec import EnvSpec
from rotorgram.udp.protocol import binary, text
from rotorgram.udp.protocol.auth import OVERHEAD, Key
from rotorgram.udp.protocol.client import Client
from rotorgram.udp.protocol.fragments import Assembler
from rotorgram.udp.protocol.messages import Command
from rotorgram.udp.protocol.server import Server
from targets import SESSION, TARGETS, Finding, Flight, content, fragment_of, fuzz_one, seeds

INPUTS = list(seeds())


def changed(data: bytes, dice: Random) -> bytes:
    """A few bytes changed, cut out, doubled or taken from another input."""
    buffer = bytearray(data)
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(len(buffer) + 1)
        size = dice.randrange(1, 9)
        match dice.randrange(5):
            case 0 if at < len(buffer):
                buffer[at] ^= 1 << dice.randrange(8)
            case 1:
                buffer[at : at + size] = dice.randbytes(size)
            case 2:
                del buffer[at : at + size]
            case 3:
                buffer[at:at] = buffer[at : at + size]
            case 4:
                other = dice.choice(INPUTS)
                buffer[at:] = other[dice.randrange(len(other)) :]
    return bytes(buffer)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(4))
def test_changed_inputs_find_nothing(seed: int) -> None:
    dice = Random(seed)
    with np.errstate(all="raise"):
        if seed == 0:
            for data in INPUTS:
                fuzz_one(data)
        for _ in range(1500):
            data = changed(dice.choice(INPUTS), dice)
            try:
                fuzz_one(data)
            except Exception as error:
                raise AssertionError(f"fuzz_one(bytes.fromhex({data.hex()!r}))") from error


def test_every_target_is_reached() -> None:
    reached = {TARGETS[data[0] % len(TARGETS)].__name__ for data in INPUTS}
    assert reached == {f"fuzz_{name}" for name in ("binary", "text", "keys", "spec", "links",
                                                   "fragments")}  # fmt: skip


def test_what_is_honest_is_taken() -> None:
    """Else the targets would find nothing in peers that refuse everything."""
    for _, env, message in messages():
        again = binary.decode(binary.encode(message, LAYOUTS[env]), LAYOUTS[env])
        assert content(again) == content(message)
    whole = binary.frame(binary.STATE, SESSION, 1, b"ab")
    assembler = Assembler(100)
    parts = [(1, whole[20:]), (0, whole[:20])]
    pieces = [fragment_of(binary.STATE, SESSION, 1, number, 2, part) for number, part in parts]
    assert [assembler.take(piece) for piece in pieces] == [None, whole]
    for sealed, by_text in ((False, False), (True, False), (False, True)):
        flight = Flight(sealed=sealed, by_text=by_text)
        for _ in range(5):
            flight.flow()
            flight.decide()
        assert [link.sequence for link in flight.simulators.values()] == [3, 3]


def repeated(receive: Any) -> Any:
    """Of a Client: gives the first Command again and again."""
    kept: dict[Client, Any] = {}

    def wrong(self: Client, datagram: bytes, now: float) -> Any:
        message = receive(self, datagram, now)
        if isinstance(message, Command):
            kept.setdefault(self, message)
        return kept.get(self, message)

    return wrong


def freed(receive: Any) -> Any:
    """Of a Server: frees a slot and says nothing."""

    def wrong(self: Server, *arguments: Any) -> Any:
        event = receive(self, *arguments)
        if event is None:
            self.slots[1] = None
        return event

    return wrong


@pytest.mark.parametrize(
    ("place", "name", "broken"),
    [
        (binary, "encode", lambda right: lambda *a: right(*a) + b"x"),
        (text, "encode", lambda right: lambda *a: right(*a) + b"1"),
        (Key, "open", lambda right: lambda self, datagram, *a: datagram[OVERHEAD:]),
        (EnvSpec, "to_json", lambda right: lambda self: right(replace(self, control_period=9.0))),
        (Assembler, "take", lambda right: lambda self, datagram: right(self, datagram) and b"x"),
        (Server, "receive", freed),
        (Client, "receive", repeated),
    ],
)
def test_a_broken_promise_is_found(
    place: Any, name: str, broken: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(place, name, broken(getattr(place, name)))
    with pytest.raises(Finding):
        any(fuzz_one(data) for data in INPUTS)  # type: ignore[func-returns-value]
