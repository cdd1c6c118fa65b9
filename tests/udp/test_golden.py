"""docs/golden.json, against the page's byte tables by hand and against our codec."""

import json
import struct
import zlib
from dataclasses import fields
from hashlib import blake2b
from pathlib import Path
from typing import Any

import golden
import numpy as np
import pytest
import state_tables
from golden import GOLDEN, KEY, LAYOUTS, LINES, SECRET
from rotorgram.udp.protocol import binary, text
from rotorgram.udp.protocol.auth import Key
from rotorgram.udp.protocol.errors import DecodeError, Forged
from rotorgram.udp.protocol.fragments import Assembler, Transfer
from rotorgram.udp.protocol.messages import Close, Extension, State

DATA = Path(__file__).parents[1] / "data"
MESSAGES = {case["name"]: case for case in GOLDEN["messages"]}
BODIES = json.loads((DATA / "golden_bodies.json").read_text("utf-8"))
HELLOS = {
    # env, newest version, worlds, extensions
    "hello": ("one", 3, 1, b""),
    "hello of two worlds, with an extension": ("two", 4, 2, b"\x07\0\x03\0abc"),
    "hello of two worlds of three drones": ("swarm", 3, 2, b""),
}
WRONG_CHECKSUMS = {"nothing", "a header cut short", "a wrong checksum"}


def bytes_of(name: str) -> bytes:
    return bytes.fromhex(MESSAGES[name]["bytes"])


def by_hand(kind: int, sequence: int, body: bytes) -> bytes:
    head = bytes([0xA7, 0x52, 3, kind])
    rest = struct.pack("<QQ", 0x0123456789ABCDEF, sequence)
    checksum = struct.pack("<I", zlib.crc32(head + rest + body))
    return head + checksum + rest + body


@pytest.mark.parametrize("case", BODIES, ids=lambda case: case["name"])
def test_the_bytes_are_those_of_the_page(case: dict[str, Any]) -> None:
    body = struct.pack(case["format"], *case["values"])
    body += bytes.fromhex(case.get("then", ""))
    assert bytes_of(case["name"]) == by_hand(case["type"], case["sequence"], body)


@pytest.mark.parametrize("name", HELLOS)
def test_the_bytes_of_hello_are_those_of_the_page(name: str) -> None:
    env, newest, worlds, extensions = HELLOS[name]
    spec = json.dumps(GOLDEN["envs"][env]["spec"], separators=(",", ":")).encode()
    body = struct.pack("<BBHIII", 3, newest, 0, worlds, len(spec), 0)
    assert bytes_of(name) == by_hand(1, 0, body + spec + extensions)


def test_every_message_has_bytes_by_hand() -> None:
    assert set(MESSAGES) == {case["name"] for case in BODIES} | set(HELLOS)


@pytest.mark.parametrize("name", MESSAGES)
def test_a_right_message_is_read(name: str) -> None:
    case = MESSAGES[name]
    layout = LAYOUTS[case["env"]]
    message = binary.decode(bytes_of(name), layout)
    assert type(message).__name__ == case["type"]
    assert plain(message) == case["fields"]
    assert binary.encode(message, layout) == bytes_of(name)


def plain(value: Any) -> Any:
    """A field as JSON: whole numbers of 64 bits as decimal text, bytes in hexadecimal."""
    if isinstance(value, np.ndarray):
        numbers = value.tolist()
        return list(map(str, numbers)) if value.dtype == np.uint64 else numbers
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, Extension):
        return {name: plain(one) for name, one in value._asdict().items()}
    if isinstance(value, tuple):
        return [plain(one) for one in value]
    if isinstance(value, binary.Message):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, int) and value > 2**32:
        return str(value)
    return value


def test_specs_come_back() -> None:
    for name, spec in golden.SPECS.items():
        case = GOLDEN["envs"][name]
        layout = LAYOUTS[name]
        assert json.loads(spec.to_json()) == case["spec"]
        assert layout.state.size == case["state bytes"]
        sizes = [layout.commands[seeded, False].size for seeded in (False, True)]
        assert sizes == case["command bytes without and with seeds"]


@pytest.mark.parametrize("case", GOLDEN["malformed"], ids=lambda case: case["name"])
def test_a_wrong_message_is_not_read(case: dict[str, str]) -> None:
    datagram = bytes.fromhex(case["bytes"])
    has_checksum = golden.fixed(datagram) == datagram
    assert has_checksum == (case["name"] not in WRONG_CHECKSUMS)
    with pytest.raises(DecodeError):
        binary.decode(datagram, LAYOUTS[case["env"]])


@pytest.mark.parametrize("case", GOLDEN["fragments"], ids=lambda case: case["of"])
@pytest.mark.parametrize("order", [1, -1])
def test_fragments_are_the_message(case: dict[str, Any], order: int) -> None:
    message = bytes_of(case["of"])
    datagrams = list(map(bytes.fromhex, case["datagrams"]))
    assert Transfer(message, 60).start() == datagrams
    assert max(map(len, datagrams)) <= 60
    # By hand: header with 128 added to the type, number, count, asks, slice.
    slices = [datagram[32:] for datagram in datagrams]
    assert b"".join(slices) == message
    assert len({len(piece) for piece in slices[:-1]}) <= 1
    count = len(datagrams)
    for number, datagram in enumerate(datagrams):
        asks = number == count - 1
        assert datagram[3] == message[3] + 128
        assert datagram[8:24] == message[8:24]
        assert struct.unpack_from("<HHB", datagram, 24) == (number, count, asks)
        assert golden.fixed(datagram) == datagram
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
    assert bytes(range(32)) == SECRET
    assert KEY["id"] == blake2b(b"", key=SECRET, digest_size=6, person=b"key id").hexdigest()
    numbers = bytes.fromhex(KEY["session"])[::-1] + bytes.fromhex(KEY["nonce"])[::-1]
    session = blake2b(numbers, key=SECRET, digest_size=32, person=b"session")
    assert KEY["of the session"] == session.hexdigest()


def key_of(side: Any, kind: str) -> Key:
    """The key of a side, the shared one or that of the session."""
    key = Key(SECRET, side)
    return key if kind == "shared" else key.for_session(golden.SESSION, golden.NONCE)


OTHER = {"agent": "simulator", "simulator": "agent"}


@pytest.mark.parametrize("case", GOLDEN["sealed"], ids=lambda c: f"{c['of']} by the {c['from']}")
def test_seals(case: dict[str, str]) -> None:
    message = bytes_of(case["of"])
    datagram = bytes.fromhex(case["datagram"])
    answers = bytes.fromhex(case.get("answers", ""))
    side = case["from"]
    secret = bytes.fromhex(KEY["shared" if case["key"] == "shared" else "of the session"])
    tag = blake2b(message + answers, key=secret, digest_size=16, person=side.encode()).digest()
    assert datagram == b"\xa7\x53" + bytes.fromhex(KEY["id"]) + tag + message
    assert key_of(side, case["key"]).seal(message, answers) == datagram
    assert key_of(OTHER[side], case["key"]).open(datagram, answers) == message


@pytest.mark.parametrize("case", GOLDEN["forged"], ids=lambda case: case["name"])
def test_forged_datagrams_are_not_opened(case: dict[str, str]) -> None:
    here = key_of(OTHER[case["from"]], "shared" if case["of"] == "hello" else "session")
    with pytest.raises(Forged):
        here.open(bytes.fromhex(case["datagram"]))


def test_text_lines() -> None:
    layout = LAYOUTS["one"]
    states = [text.decode_state(line.encode(), layout) for line in LINES["states"]]
    commands = [text.decode_command(line.encode(), layout, 0) for line in LINES["commands"]]
    first = states[0]
    assert isinstance(first, State)
    assert text.encode(first, layout).decode() == LINES["states"][0]
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
    for line in LINES["malformed states"]:
        with pytest.raises(DecodeError):
            text.decode_state(line.encode(), layout)
    for line in LINES["malformed commands"]:
        with pytest.raises(DecodeError):
            text.decode_command(line.encode(), layout, 0)
    assert np.signbit(first.observations[0][0, 1])


def test_the_tables_of_states_are_those_of_the_code() -> None:
    page = state_tables.PAGE.read_text("utf-8")
    assert page == state_tables.page(), "run python tests/state_tables.py"
    assert "| waiting | received | Command | ready |" in page
