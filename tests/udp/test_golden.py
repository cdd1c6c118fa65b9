"""docs/golden.json, against the page's byte tables by hand and against our codec."""

import json
import struct
import zlib
from hashlib import blake2b
from typing import Any

import golden
import numpy as np
import pytest
import state_tables
from rotorgram.envs.spec import EnvSpec
from rotorgram.udp.protocol import binary, text
from rotorgram.udp.protocol.auth import Key
from rotorgram.udp.protocol.errors import DecodeError, Forged
from rotorgram.udp.protocol.fragments import Assembler
from rotorgram.udp.protocol.messages import Close, State

GOLDEN: dict[str, Any] = json.loads(golden.FILE.read_text("utf-8"))
MESSAGES = {case["name"]: case for case in GOLDEN["messages"]}
SECRET = bytes(range(32))


def bytes_of(name: str) -> bytes:
    return bytes.fromhex(MESSAGES[name]["bytes"])


def by_hand(kind: int, sequence: int, body: bytes) -> bytes:
    head = bytes([0xA7, 0x52, 2, kind])
    rest = struct.pack("<QQ", 0x0123456789ABCDEF, sequence)
    return head + struct.pack("<I", zlib.crc32(head + rest + body)) + rest + body


def test_the_file_is_what_the_code_writes() -> None:
    assert golden.FILE.read_text("utf-8") == golden.written(), "run python tests/golden.py"


def test_the_bytes_are_those_of_the_page() -> None:
    one, two, swarm = (
        json.dumps(GOLDEN["envs"][name]["spec"], separators=(",", ":")).encode()
        for name in ("one", "two", "swarm")
    )
    nonce = 0xFEDCBA9876543210
    expected = {
        "hello": by_hand(1, 0, struct.pack("<BBHIII", 2, 2, 0, 1, len(one), 0) + one),
        "hello of two worlds, with an extension": by_hand(
            1, 0, struct.pack("<BBHIII", 2, 3, 0, 2, len(two), 0) + two + b"\x07\0\x03\0abc"
        ),
        "hello of two worlds of three drones": by_hand(
            1, 0, struct.pack("<BBHIII", 2, 2, 0, 2, len(swarm), 0) + swarm
        ),
        "welcome": by_hand(2, 0, struct.pack("<QQBB6x", nonce, 0, 0, 2)),
        "welcome with a seed": by_hand(2, 0, struct.pack("<QQBB6x", nonce, 7, 1, 2)),
        "welcome with a critical extension": by_hand(
            2, 0, struct.pack("<QQBB6x", nonce, 0, 0, 2) + b"\x01\x80\0\0" + b"\x07\0\x03\0abc"
        ),
        "welcome with the policy land": by_hand(
            2, 0, struct.pack("<QQBB6x", nonce, 0, 0, 2) + b"\x01\0\x04\0land"
        ),
        "refuse": by_hand(3, 0, b"\x04\0busy"),
        "wait": by_hand(7, 0, b""),
        "unknown": by_hand(8, 1, b""),
        "alive": by_hand(9, 1, b""),
        "missing: 0, 2 and 9 of 10": by_hand(10, 2, struct.pack("<BBHH2B", 4, 0, 10, 0, 5, 2)),
        "state 1 echoes the nonce": by_hand(
            4, 1, struct.pack("<dQ3f4xd2B6x4d", 0, nonce, 0.25, -0.0, 1.5, 0, 0, 0, -2, -1, 5, 0.25)
        ),
        "state, truncated": by_hand(
            4,
            2,
            struct.pack("<dQ3f4xd2B6x4d", 0.02, 0, 0.25, -0.0, 1.5, 0.5, 0, 1, -2, -1, 5, 0.25),
        ),
        "state of two drones with a picture": by_hand(
            4,
            3,
            struct.pack("<dQ", 0.2, 0)
            + bytes(range(12))
            + bytes(4)  # the next array begins at a multiple of 8
            + struct.pack("<fI2d", 0.5, 1, -0.0, 0.1)  # 1e-45 is the smallest float32
            + b"\0\1\1\0",
        ),
        "state of two worlds of three drones: 1 crashes, 3 is out": by_hand(
            4,
            3,
            struct.pack("<dQ6f", 0.04, 0, 0, 1, 2, 3, 4, 5)
            + struct.pack("<6d", 0.5, -20, 0.5, 0, 0.5, 0.5)
            + b"\0\1\0\0\0\0"
            + bytes(6)
            + bytes(4)
            + struct.pack("<6d", 0, 0.125, 0.25, 0.375, 0.5, 0.625),
        ),
        "command to fly choice 2": by_hand(5, 1, struct.pack("<I4xqB", 0, 2, 0)),
        "command to reset, with a seed": by_hand(
            5, 1, struct.pack("<I4xqB7xQ", 1, 0, 1, 2**64 - 1)
        ),
        "command: fly, freeze": by_hand(5, 3, struct.pack("<I4x2f2B", 0, 0.5, -1, 0, 2)),
        "command: reset, fly; with seeds": by_hand(
            5, 3, struct.pack("<I4x2f2B6x2Q", 2, 0.5, -1, 1, 0, 2**64 - 1, 5)
        ),
        "command: fly the first world, reset the second": by_hand(
            5,
            3,
            struct.pack("<I4x6f6B2x6Q", 6, 0.5, 0, -1, 0, 0, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 7, 8, 9),
        ),
        "close": by_hand(6, 1, b"\x04\0done"),
        "close, the answer": by_hand(6, 1, b"\0\0"),
    }
    assert {name: bytes.fromhex(case["bytes"]) for name, case in MESSAGES.items()} == expected


@pytest.mark.parametrize("name", MESSAGES)
def test_a_right_message_is_read(name: str) -> None:
    case = MESSAGES[name]
    layout = golden.LAYOUTS[MESSAGES[name]["env"]]
    message = binary.decode(bytes_of(name), layout)
    assert type(message).__name__ == case["type"]
    assert json.loads(json.dumps(golden.described(message))) == case["fields"]
    assert binary.encode(message, layout) == bytes_of(name)


def test_specs_come_back() -> None:
    for name, spec in golden.SPECS.items():
        told = GOLDEN["envs"][name]["spec"]
        assert EnvSpec.from_json(json.dumps(told)) == spec


@pytest.mark.parametrize("case", GOLDEN["malformed"], ids=lambda case: case["name"])
def test_a_wrong_message_is_not_read(case: dict[str, str]) -> None:
    with pytest.raises(DecodeError):
        binary.decode(bytes.fromhex(case["bytes"]), golden.LAYOUTS[case["env"]])


@pytest.mark.parametrize("case", GOLDEN["fragments"], ids=lambda case: case["of"])
@pytest.mark.parametrize("order", [1, -1])
def test_fragments_are_the_message(case: dict[str, Any], order: int) -> None:
    message = bytes_of(case["of"])
    datagrams = list(map(bytes.fromhex, case["datagrams"]))
    assert max(map(len, datagrams)) <= 60
    # By hand: header with 128 added to the type, number, count, asks, slice.
    slices = [datagram[32:] for datagram in datagrams]
    assert b"".join(slices) == message
    assert len({len(piece) for piece in slices[:-1]}) <= 1
    for number, datagram in enumerate(datagrams):
        kind = message[3]
        (session, sequence) = struct.unpack_from("<QQ", message, 8)
        assert datagram[3] == kind + 128
        assert struct.unpack_from("<QQ", datagram, 8) == (session, sequence)
        asks = number == len(datagrams) - 1
        assert struct.unpack_from("<HHB", datagram, 24) == (number, len(datagrams), asks)
        assert zlib.crc32(datagram[:4] + datagram[8:]) == struct.unpack_from("<I", datagram, 4)[0]
    assembler = Assembler(len(message))
    whole = [assembler.take(datagram) for datagram in datagrams[::order]]
    assert whole == [None] * (len(datagrams) - 1) + [message]


@pytest.mark.parametrize("case", GOLDEN["malformed fragments"], ids=lambda case: case["name"])
def test_a_wrong_fragment_is_not_taken(case: dict[str, str]) -> None:
    fragment = bytes.fromhex(case["bytes"])
    assert binary.check(fragment)
    with pytest.raises(DecodeError):
        Assembler(1 << 20).take(fragment)


def test_the_key_of_a_session() -> None:
    told = GOLDEN["key"]
    assert bytes.fromhex(told["shared"]) == SECRET
    assert told["id"] == blake2b(b"", key=SECRET, digest_size=6, person=b"key id").hexdigest()
    numbers = bytes.fromhex(told["session"])[::-1] + bytes.fromhex(told["nonce"])[::-1]
    session = blake2b(numbers, key=SECRET, digest_size=32, person=b"session")
    assert told["of the session"] == session.hexdigest()


@pytest.mark.parametrize("case", GOLDEN["sealed"], ids=lambda c: f"{c['of']} by the {c['from']}")
def test_seals(case: dict[str, str]) -> None:
    told = GOLDEN["key"]
    message = bytes_of(case["of"])
    datagram = bytes.fromhex(case["datagram"])
    answers = bytes.fromhex(case.get("answers", ""))
    secret = bytes.fromhex(told["shared" if case["key"] == "shared" else "of the session"])
    person = case["from"].encode()
    tag = blake2b(message + answers, key=secret, digest_size=16, person=person).digest()
    assert datagram == b"\xa7\x53" + bytes.fromhex(told["id"]) + tag + message
    here = Key(SECRET, "agent" if case["from"] == "simulator" else "simulator")
    if case["key"] == "session":
        here = here.for_session(golden.SESSION, golden.NONCE)
    assert here.open(datagram, answers) == message


@pytest.mark.parametrize("case", GOLDEN["forged"], ids=lambda case: case["name"])
def test_forged_datagrams_are_not_opened(case: dict[str, str]) -> None:
    here = Key(SECRET, "agent" if case["from"] == "simulator" else "simulator")
    if case["of"] != "hello":
        here = here.for_session(golden.SESSION, golden.NONCE)
    with pytest.raises(Forged):
        here.open(bytes.fromhex(case["datagram"]))


def test_text_lines() -> None:
    lines = GOLDEN["text of env one"]
    layout = golden.LAYOUTS["one"]
    states = [text.decode_state(line.encode(), layout) for line in lines["states"]]
    commands = [text.decode_command(line.encode(), layout, 0) for line in lines["commands"]]
    first = states[0]
    assert isinstance(first, State)
    assert text.encode(first, layout).decode() == lines["states"][0]
    assert first.rewards.item() == 0.5
    assert first.truncated.item() is True
    assert first.observations[0].tobytes() == struct.pack("<3f", 0.25, -0.0, 1.5)
    assert [array.tolist() for array in first.telemetry] == [[[-2.0, -1.0, 5.0]], [[0.25]]]
    assert [state.sequence for state in states] == [1, 0, 7, 2**64 - 1, 3]
    for other in states[1:4]:
        assert isinstance(other, State)
        assert [a.tolist() for a in other.observations] == [[[0.25, -0.0, 1.5]]]
        assert [a.tolist() for a in other.telemetry] == [[[-2.0, -1.0, 5.0]], [[0.25]]]
    assert [isinstance(state, Close) for state in states] == [False] * 4 + [True]
    assert [text.encode(command).decode() for command in commands] == [
        "1,2",
        "1,0",
        "1,reset",
        "1,reset,18446744073709551615",
        "1,close",
    ]
    for line in lines["malformed states"]:
        with pytest.raises(DecodeError):
            text.decode_state(line.encode(), layout)
    for line in lines["malformed commands"]:
        with pytest.raises(DecodeError):
            text.decode_command(line.encode(), layout, 0)
    assert np.signbit(first.observations[0][0, 1])


def test_the_tables_of_states_are_those_of_the_code() -> None:
    page = state_tables.PAGE.read_text("utf-8")
    assert page == state_tables.page(), "run python tests/state_tables.py"
    assert "| waiting | received | Command | ready |" in page
