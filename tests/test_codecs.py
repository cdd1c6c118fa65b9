"""Both codecs: round trips, golden datagrams, and any other bytes."""

import contextlib
import dataclasses
import re
import struct
import tracemalloc
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rotorgram.udp import DecodeError, binary, text
from rotorgram.udp.errors import VersionMismatch
from rotorgram.udp.messages import (
    MAX_TEXT,
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

PAGE = Path(__file__).parent.parent / "docs" / "protocol.md"

uint64 = st.integers(0, 2**64 - 1)
texts = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=MAX_TEXT // 4)
names = st.lists(
    st.text(st.characters(exclude_categories=["Cs", "Cc"], exclude_characters=","), min_size=1,
            max_size=8), max_size=8, unique=True
).map(tuple)  # fmt: skip
float32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
float64 = st.floats(allow_nan=False, allow_infinity=False)


def rows(drones: int, size: int, dtype: type, elements: st.SearchStrategy) -> st.SearchStrategy:
    return arrays(dtype, (drones, size), elements=elements)


@st.composite
def states(draw: st.DrawFn, most: int = 5, session: int | None = None) -> State:
    drones = draw(st.integers(1, most))
    flags = arrays(bool, drones)
    return State(
        session=draw(uint64) if session is None else session,
        sequence=draw(uint64),
        observations=draw(rows(drones, draw(st.integers(1, 6)), np.float32, float32)),
        rewards=draw(arrays(np.float64, drones, elements=float64)),
        terminated=draw(flags),
        truncated=draw(flags),
        telemetry=draw(rows(drones, draw(st.integers(0, 12)), np.float64, float64)),
    )


@st.composite
def commands(draw: st.DrawFn, most: int = 5) -> Command:
    drones = draw(st.integers(1, most))
    resets = draw(arrays(bool, drones))
    holds = draw(arrays(bool, drones)) & ~resets if most > 1 else resets & False
    return Command(
        session=draw(uint64),
        sequence=draw(uint64),
        actions=draw(rows(drones, draw(st.integers(1, 4)), np.float32, float32)),
        resets=resets,
        holds=holds if holds.any() else None,
        seeds=draw(st.none() | arrays(np.uint64, drones, elements=uint64)),
    )


@st.composite
def hellos(draw: st.DrawFn) -> Hello:
    def bounds(size: int) -> np.ndarray:
        pair = np.sort(draw(arrays(np.float32, (2, size), elements=float32)), axis=0)
        return np.where(draw(arrays(bool, (2, size))), pair, np.float32([[-np.inf], [np.inf]]))

    observation, action = bounds(draw(st.integers(1, 6))), bounds(draw(st.integers(1, 3)))
    return Hello(
        session=draw(uint64),
        env_id=draw(texts),
        num_drones=draw(st.integers(1, 65536)),
        observation_low=observation[0],
        observation_high=observation[1],
        action_low=action[0],
        action_high=action[1],
        discrete_actions=draw(st.integers(0, 65535 if action.shape[1] == 1 else 0)),
        control_period=draw(st.floats(1e-6, 1e6)),
        model_hash=draw(st.binary(min_size=16, max_size=16)).hex(),
        telemetry_names=draw(names),
        options=draw(texts),
    )


messages = st.one_of(
    hellos(),
    st.builds(Welcome, session=uint64, nonce=uint64, seed=st.none() | uint64),
    st.builds(Refuse, session=uint64, reason=texts),
    st.builds(Wait, session=uint64),
    st.builds(Unknown, session=uint64, sequence=uint64),
    states(),
    commands(),
    st.builds(Close, session=uint64, sequence=uint64, reason=texts),
)


def content(message: Message) -> list[object]:
    """Every field, arrays as shape, kind and bits."""
    values = [getattr(message, field.name) for field in dataclasses.fields(message)]
    return [type(message)] + [
        (v.shape, v.dtype.str, v.tobytes()) if isinstance(v, np.ndarray) else v for v in values
    ]


def one_state(**changes: object) -> State:
    fields: dict[str, object] = {
        "session": 0x0123456789ABCDEF,
        "sequence": 1,
        "observations": np.array([[0.25, -0.0, 1.5]], np.float32),
        "rewards": np.array([0.5]),
        "terminated": np.array([False]),
        "truncated": np.array([True]),
        "telemetry": np.array([[1.0, -2.0]]),
    }
    return State(**{**fields, **changes})  # type: ignore[arg-type]


def one_command(**changes: object) -> Command:
    fields: dict[str, object] = {
        "session": 0x0123456789ABCDEF,
        "sequence": 1,
        "actions": np.array([[0.5], [-1.0]], np.float32),
        "resets": np.array([True, False]),
        "seeds": np.array([2**64 - 1, 5], np.uint64),
    }
    return Command(**{**fields, **changes})  # type: ignore[arg-type]


def one_hello(**changes: object) -> Hello:
    fields: dict[str, object] = {
        "session": 0x0123456789ABCDEF,
        "env_id": "a/B-v0",
        "num_drones": 1,
        "observation_low": np.array([-1], np.float32),
        "observation_high": np.array([1], np.float32),
        "action_low": np.array([0], np.float32),
        "action_high": np.array([2], np.float32),
        "discrete_actions": 3,
        "control_period": 0.02,
        "model_hash": "00112233445566778899aabbccddeeff",
        "telemetry_names": ("X", "F1"),
        "options": '{"a":1}',
    }
    return Hello(**{**fields, **changes})  # type: ignore[arg-type]


# Written by hand from the byte tables of docs/protocol.md, which shows the same lines.
GOLDEN = {
    "Hello": """
        a752 02 01 739d76c6 efcdab8967452301 0000000000000000
        01000000 0100 0100 0300 0000 7b14ae47e17a943f 00112233445566778899aabbccddeeff
        000080bf 0000803f 00000000 00000040 0600 612f422d7630 0400 582c4631 0700 7b2261223a317d""",
    "Welcome": """
        a752 02 02 6e55e9fe efcdab8967452301 0000000000000000
        1032547698badcfe 01 00000000000000 0700000000000000""",
    "Refuse": """
        a752 02 03 a1c1fb93 efcdab8967452301 0000000000000000
        0400 62757379""",
    "State": """
        a752 02 04 171bb215 efcdab8967452301 0100000000000000
        01000000 0300 0200 000000000000e03f 000000000000f03f 00000000000000c0
        0000803e 00000080 0000c03f 00 01""",
    "Command": """
        a752 02 05 02d64849 efcdab8967452301 0100000000000000
        02000000 0100 000000000000 02000000 ffffffffffffffff 0500000000000000
        0000003f 000080bf 01 00""",
    "Close": """
        a752 02 06 b9226c4a efcdab8967452301 0100000000000000
        0400 646f6e65""",
    "Wait": """
        a752 02 07 330a146d efcdab8967452301 0000000000000000""",
    "Unknown": """
        a752 02 08 78393c67 efcdab8967452301 0100000000000000""",
}
GOLDEN_MESSAGES = {
    "Hello": one_hello(),
    "Welcome": Welcome(session=0x0123456789ABCDEF, nonce=0xFEDCBA9876543210, seed=7),
    "Refuse": Refuse(session=0x0123456789ABCDEF, reason="busy"),
    "State": one_state(),
    "Command": one_command(),
    "Close": Close(session=0x0123456789ABCDEF, sequence=1, reason="done"),
    "Wait": Wait(session=0x0123456789ABCDEF),
    "Unknown": Unknown(session=0x0123456789ABCDEF, sequence=1),
}
GOLDEN_LINES = {
    "1,0.5,0,1,0.25,-0.0,1.5,1.0,-2.0": one_state(session=0),
    "1,0.5": one_command(session=5, actions=np.array([[0.5]], np.float32), seeds=None,
                         resets=np.array([False])),
    "1,reset": one_command(session=5, actions=np.zeros((1, 1), np.float32), seeds=None,
                           resets=np.array([True])),
    "1,reset,18446744073709551615": one_command(
        session=5, actions=np.zeros((1, 1), np.float32), resets=np.array([True]),
        seeds=np.array([2**64 - 1], np.uint64)),
    "1,close": Close(session=5, sequence=1, reason="the agent closed"),
}  # fmt: skip


def golden(name: str) -> bytes:
    return bytes.fromhex("".join(GOLDEN[name].split()))


def sealed(datagram: bytes) -> bytes:
    """A datagram with its checksum made right, as a hostile peer would send it."""
    crc = zlib.crc32(datagram[8:], zlib.crc32(datagram[:4]))
    return datagram[:4] + crc.to_bytes(4, "little") + datagram[8:]


# ---- binary


@settings(deadline=None)
@given(messages)
def test_binary_round_trip_keeps_every_bit(message: Message) -> None:
    datagram = binary.encode(message)
    assert content(binary.decode(datagram)) == content(message)
    assert binary.encode(binary.decode(datagram)) == datagram


def test_binary_keeps_the_awkward_floats() -> None:
    wide = np.array([[5e-324, -5e-324, -0.0, 1.7976931348623157e308, 2.2250738585072014e-308]])
    narrow = np.array([[1e-45, -1e-45, -0.0, 3.4028235e38, 1.1754944e-38]], np.float32)
    message = one_state(observations=narrow, rewards=wide[:, 3], telemetry=wide)
    for back in (
        binary.decode(binary.encode(message)),
        text.decode_state(text.encode(message), 5, 5),
    ):
        assert isinstance(back, State)
        assert back.observations.tobytes() == narrow.tobytes()
        assert back.telemetry.tobytes() == wide.tobytes()


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_datagram(name: str) -> None:
    assert binary.encode(GOLDEN_MESSAGES[name]).hex() == golden(name).hex()
    assert content(binary.decode(golden(name))) == content(GOLDEN_MESSAGES[name])


@pytest.mark.parametrize("name", GOLDEN)
def test_the_page_shows_the_golden_datagrams(name: str) -> None:
    page = PAGE.read_text(encoding="utf-8")
    for line in GOLDEN[name].split("\n"):
        assert line.strip() in page


@pytest.mark.parametrize("name", GOLDEN)
def test_truncated_and_extended(name: str) -> None:
    datagram = golden(name)
    for size in range(len(datagram)):
        for cut in (datagram[:size], sealed(datagram[:size]) if size >= 8 else b""):
            with pytest.raises(DecodeError):
                binary.decode(cut)
    with pytest.raises(DecodeError):
        binary.decode(sealed(datagram + b"\0"))


@pytest.mark.parametrize("name", GOLDEN)
def test_every_flipped_bit_is_seen(name: str) -> None:
    datagram = golden(name)
    for bit in range(8 * len(datagram)):
        flipped = bytearray(datagram)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(DecodeError):
            binary.decode(bytes(flipped))


@settings(deadline=None, max_examples=300)
@given(st.sampled_from(sorted(GOLDEN)), st.integers(0, 200), st.binary(min_size=1, max_size=40))
def test_hostile_bytes_give_a_message_or_a_decode_error(name: str, at: int, junk: bytes) -> None:
    datagram = golden(name)
    assume(at < len(datagram))
    hostile = sealed(datagram[:at] + junk + datagram[at + len(junk) :])
    try:
        message = binary.decode(hostile)
    except DecodeError:
        return
    # What was accepted is a message in every respect.
    assert len(binary.encode(message)) == len(hostile)


@settings(deadline=None)
@given(st.binary(max_size=200))
@example(b"")
@example(b"\xa7R")
def test_random_bytes(junk: bytes) -> None:
    for body in (junk, *(sealed(b"\xa7R\x02" + bytes([t]) + b"\0" * 20 + junk) for t in range(10))):
        with contextlib.suppress(DecodeError):
            assert isinstance(binary.decode(body), Message)


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        (4, struct.pack("<IHH", 2**32 - 1, 65535, 65535)),
        (4, struct.pack("<IHH", 0, 3, 2)),
        (4, struct.pack("<IHH", 65537, 0, 0) + b"\0" * 65537 * 10),
        (2, struct.pack("<QB7xQ", 0, 2, 0)),
        (5, struct.pack("<IH6xI", 2**32 - 1, 65535, 0)),
        (5, struct.pack("<IH6xI", 2**32 - 1, 65535, 2**32 - 1)),
        (5, struct.pack("<IH6xI", 0, 1, 0)),
        (5, struct.pack("<IH6xIQfB", 1, 1, 2, 0, 0.0, 0)),
        (5, struct.pack("<IH6xIQffBB", 2, 1, 1, 0, 0.0, 0.0, 0, 0)),
        (5, struct.pack("<IH6xIfB", 1, 1, 0, 0.0, 3)),
        (1, struct.pack("<IHHHxxd16s", 1, 65535, 65535, 0, 0.02, b"")),
        (6, struct.pack("<H", 65535)),
        (6, struct.pack("<H", 2) + b"\xff\xff"),
        (6, struct.pack("<H", 4) + b"\x1b[2J"),
        (6, struct.pack("<H", 513) + b"a" * 513),
        (0, b""),
        (7, b"\0"),
        (8, b"\0"),
        (9, b""),
        (255, b""),
    ],
)
def test_declared_sizes_and_values_are_checked(kind: int, body: bytes) -> None:
    header = struct.pack("<2sBBIQQ", b"\xa7R", 2, kind, 0, 1, 1)
    with pytest.raises(DecodeError):
        binary.decode(sealed(header + body))


@pytest.mark.parametrize(
    ("name", "reserved"),
    [("Hello", range(34, 36)), ("Welcome", range(33, 40)), ("Command", range(30, 36))],
)
def test_reserved_bytes_are_ignored(name: str, reserved: range) -> None:
    datagram = bytearray(golden(name))
    datagram[reserved.start : reserved.stop] = b"\xff" * len(reserved)
    assert content(binary.decode(sealed(bytes(datagram)))) == content(GOLDEN_MESSAGES[name])


@pytest.mark.parametrize("bad", [0x7FC00000, 0x7FA00000, 0x7F800000, 0xFF800000, 0xFFFFFFFF])
def test_not_a_number_is_refused_in_every_float_of_the_wire(bad: int) -> None:
    narrow = struct.pack("<I", bad)
    wide = struct.pack("<d", struct.unpack("<f", narrow)[0])
    for name, offset, raw in [
        ("State", 32, wide),
        ("State", 40, wide),
        ("State", 48, wide),
        ("State", 56, narrow),
        ("State", 64, narrow),
        ("Command", 56, narrow),
        ("Command", 60, narrow),
        ("Hello", 36, wide),
    ]:
        datagram = golden(name)
        hostile = sealed(datagram[:offset] + raw + datagram[offset + len(raw) :])
        with pytest.raises(DecodeError):
            binary.decode(hostile)


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        (4, struct.pack("<IHH", 2**32 - 1, 65535, 65535)),
        (5, struct.pack("<IH6xI", 2**32 - 1, 65535, 2**32 - 1)),
        (1, struct.pack("<IHHHxxd16s", 2**32 - 1, 65535, 65535, 0, 0.02, b"")),
        (6, struct.pack("<H", 65535)),
    ],
)
def test_nothing_is_allocated_for_a_length_that_is_only_claimed(kind: int, body: bytes) -> None:
    header = struct.pack("<2sBBIQQ", b"\xa7R", 2, kind, 0, 1, 1)
    hostile = sealed(header + body + bytes(65489 - 24 - len(body)))
    with pytest.raises(DecodeError):  # once before: what Python keeps for itself
        binary.decode(hostile)
    tracemalloc.start()
    try:
        with pytest.raises(DecodeError):
            binary.decode(hostile)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2 * len(hostile)  # 2^32 drones would be 2^50 bytes


def test_another_version_is_told_apart_but_refuse_is_always_read() -> None:
    hello = bytearray(golden("Hello"))
    hello[2] = 3
    with pytest.raises(DecodeError, match="checksum"):
        binary.decode(bytes(hello))
    with pytest.raises(VersionMismatch, match="protocol version: expected 2, got 3"):
        binary.decode(sealed(bytes(hello)))
    refuse = bytearray(golden("Refuse"))
    refuse[2] = 9
    assert binary.decode(sealed(bytes(refuse))) == GOLDEN_MESSAGES["Refuse"]


def test_too_many_numbers_for_one_message() -> None:
    drones = 60_000
    with pytest.raises(ValueError, match=r"Command: expected at most 16777216 bytes, got \d+"):
        binary.encode(
            one_command(actions=np.zeros((drones, 80)), resets=np.zeros(drones, bool), seeds=None)
        )
    many = np.zeros(10_000, np.float32)
    large = replace(GOLDEN_MESSAGES["Hello"], observation_low=many, observation_high=many)
    with pytest.raises(ValueError, match=r"Hello: expected at most 65489 bytes, got \d+"):
        binary.encode(large)


def test_a_large_datagram() -> None:
    drones = 590  # 64,932 bytes
    message = one_state(
        observations=np.full((drones, 3), 0.1, np.float32),
        rewards=np.full(drones, 0.1),
        terminated=np.arange(drones) % 2 == 0,
        truncated=np.arange(drones) % 3 == 0,
        telemetry=np.full((drones, 11), -0.1),
    )
    assert content(binary.decode(binary.encode(message))) == content(message)


def test_numbers_that_do_not_fit() -> None:
    for message in (Welcome(session=2**64), Close(session=1, sequence=-1, reason="")):
        with pytest.raises(ValueError, match=type(message).__name__):
            binary.encode(message)


# ---- messages


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("drones", [1, 100])
def test_messages_hold_no_nan(bad: float, drones: int) -> None:
    flags = np.zeros(drones, bool)
    fields = {
        "observations": np.zeros((drones, 3), np.float32),
        "rewards": np.zeros(drones),
        "telemetry": np.zeros((drones, 2)),
        "terminated": flags,
        "truncated": flags,
    }
    one_state(**fields)
    for name in ("observations", "rewards", "telemetry"):
        wrong = fields[name].copy()
        wrong[(-1,) * wrong.ndim] = bad
        first = [size - 1 for size in wrong.shape]
        sentence = f"{name}: expected finite numbers, got {bad} at {first}"
        with pytest.raises(ValueError, match=re.escape(sentence)):
            one_state(**{**fields, name: wrong})
    with pytest.raises(ValueError, match="action: expected finite numbers"):
        one_command(actions=np.full((drones, 1), bad), resets=flags, seeds=None)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"num_drones": 0}, "num_drones: expected 1 to 65536, got 0"),
        ({"observation_high": np.zeros(2, np.float32)}, "observation_high: expected shape"),
        ({"observation_low": np.zeros(0, np.float32)}, "observation_low: expected 1 to 65535"),
        ({"action_low": np.array([3], np.float32)}, "action: expected low <= high"),
        ({"action_low": np.array([np.nan], np.float32)}, "action: expected low <= high"),
        ({"discrete_actions": 65536}, "discrete_actions: expected 0 to 65535, got 65536"),
        ({"discrete_actions": -1}, "discrete_actions: expected 0 to 65535, got -1"),
        (
            {
                "action_high": np.array([np.inf], np.float32),
                "action_low": np.array([np.inf], np.float32),
            },
            "action: expected low <= high",
        ),
        ({"control_period": float("nan")}, "control_period: expected 1e-6 to 1e6 s, got nan"),
        ({"control_period": 0.0}, "control_period: expected 1e-6 to 1e6 s, got 0"),
        ({"model_hash": "12"}, "model_hash: expected 32 hex digits, got '12'"),
        ({"telemetry_names": ("a,b",)}, "telemetry_names: expected names, each once, without"),
        ({"telemetry_names": ("",)}, "telemetry_names: expected names, each once, without commas"),
        ({"telemetry_names": ("a", "a")}, "telemetry_names: expected names, each once"),
        ({"env_id": "x" * 513}, "env_id: expected at most 512 bytes of UTF-8, got 513"),
        ({"env_id": "a\nb"}, "env_id: expected no control characters"),
    ],
)
def test_hello_checks_itself(changes: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        one_hello(**changes)


def test_shapes_must_fit_together() -> None:
    for changes in (
        {"rewards": np.zeros(2)},
        {"rewards": np.zeros((1, 1))},
        {"terminated": np.zeros(2, bool)},
        {"truncated": np.zeros((), bool)},
        {"telemetry": np.zeros(2)},
        {"telemetry": np.zeros((2, 2))},
        {"observations": np.zeros(3, np.float32)},
        {"observations": np.zeros((0, 3), np.float32)},
    ):
        with pytest.raises(ValueError, match="expected"):
            one_state(**changes)
    with pytest.raises(ValueError, match=r"resets: expected shape \(2,\), got \(1,\)"):
        one_command(resets=np.zeros(1, bool))
    with pytest.raises(ValueError, match=r"seeds: expected shape \(2,\), got \(1,\)"):
        one_command(seeds=np.zeros(1, np.uint64))
    for number in (-1, 2**64):
        for name in ("seed", "nonce"):
            with pytest.raises(ValueError, match=f"{name}: expected 0 to .* got {number}"):
                Welcome(session=1, **{name: number})


@given(st.text())
@example("ü" * 300)
@example("\ud800\n\x1b[2J")
def test_one_line_makes_any_text_fit(anything: str) -> None:
    line = one_line(anything)
    assert binary.decode(binary.encode(Refuse(session=1, reason=line))).reason == line  # type: ignore[union-attr]


# ---- text


@settings(deadline=None)
@given(states(most=1, session=0))
def test_text_state_round_trip_keeps_every_bit(message: State) -> None:
    line = text.encode(message)
    sizes = message.observations.shape[1], message.telemetry.shape[1]
    assert content(text.decode_state(line, *sizes)) == content(message)
    assert text.is_text(line)


@settings(deadline=None)
@given(commands(most=1))
def test_text_command_round_trip_keeps_every_bit(message: Command) -> None:
    size = message.actions.shape[1]
    back = text.decode_command(text.encode(message), size, message.session)
    assert isinstance(back, Command)
    assert (back.session, back.sequence) == (message.session, message.sequence)
    assert back.resets.tolist() == message.resets.tolist()
    if message.resets[0]:
        assert (back.seeds is None) == (message.seeds is None)
        assert message.seeds is None or back.seeds.tolist() == message.seeds.tolist()  # type: ignore[union-attr]
    else:
        assert back.actions.tobytes() == message.actions.tobytes()


@pytest.mark.parametrize("line", GOLDEN_LINES)
def test_golden_line(line: str) -> None:
    message = GOLDEN_LINES[line]
    assert text.encode(message) == line.encode()
    if isinstance(message, State):
        back: Message = text.decode_state(line.encode(), 3, 2)
    else:
        back = text.decode_command(line.encode(), 1, 5)
    assert content(back) == content(message)
    assert f"\n{line}\n" in PAGE.read_text(encoding="utf-8")


def test_an_underflow_is_zero_whatever_the_program_has_set() -> None:
    with np.errstate(all="raise"):
        command = text.decode_command(b"3,1e-300", 1, 0)
    assert isinstance(command, Command)
    assert command.actions.tolist() == [[0.0]]


def test_a_line_may_end_like_a_line() -> None:
    for end in (b"\n", b"\r\n"):
        command = text.decode_command(b"3,+.5e0" + end, 1, 0)
        assert isinstance(command, Command)
        assert command.actions.tolist() == [[0.5]]


@pytest.mark.parametrize(
    "line",
    [b"", b"1", b"1,", b",1", b"-1,0.5", b"1.0,0.5", b"1,nan", b"1,inf", b"1,-Infinity", b"1,1e39",
     b"1,1e999", b"1,1_0", b"1, 0.5", b"1,0x1p3", b"1,0.5,0.5", b"1,,", b"1,reset,", b"1,reset,-1",
     b"1,reset,18446744073709551616", b"18446744073709551616,0.5", b"1,reset,1,2", b"1,RESET",
     b"1,close,now", b"1,\xff", "1,\u0661".encode(), b"1," + b"0" * 1024],
)  # fmt: skip
def test_wrong_command_lines(line: bytes) -> None:
    with pytest.raises(DecodeError):
        text.decode_command(line, 1, 0)


@pytest.mark.parametrize(
    "line",
    [b"1,0.5,0,1,0.25,0,1.5,1.0", b"1,0.5,0,1,0.25,0,1.5,1.0,2,3", b"1,0.5,2,1,0.25,0,1.5,1.0,2",
     b"1,0.5,0,true,0.25,0,1.5,1.0,2", b"1,nan,0,1,0.25,0,1.5,1.0,2", b"1,0,0,1,inf,0,1.5,1.0,2",
     b"1,0,0,1,0.25,0,1e39,1.0,2", b"1,0,0,1,0.25,0,1,1.0,1e309", b"1,0,0,1,0.25,0,1,1.0,"],
)  # fmt: skip
def test_wrong_state_lines(line: bytes) -> None:
    with pytest.raises(DecodeError):
        text.decode_state(line, 3, 2)


@settings(deadline=None)
@given(st.binary(max_size=60) | st.text("0123456789,.+-einfarst\n", max_size=60).map(str.encode))
def test_any_line_gives_a_message_or_a_decode_error(line: bytes) -> None:
    for decode in (lambda: text.decode_command(line, 1, 0), lambda: text.decode_state(line, 1, 1)):
        with contextlib.suppress(DecodeError):
            assert isinstance(decode(), State | Command | Close)


def test_text_is_for_one_drone() -> None:
    with pytest.raises(ValueError, match="text codec: expected one drone, got 2"):
        text.encode(one_command())


@given(messages)
@settings(deadline=None, max_examples=30)
def test_codecs_are_told_apart_by_the_first_byte(message: Message) -> None:
    assert not text.is_text(binary.encode(message))


def test_a_drone_is_reset_or_held() -> None:
    datagram = binary.encode(one_command(holds=np.array([False, True])))
    assert datagram[-2:] == b"\1\2"
    command = binary.decode(datagram)
    assert isinstance(command, Command)
    assert command.holds is not None
    assert (command.resets.tolist(), command.holds.tolist()) == ([True, False], [False, True])
    with pytest.raises(ValueError, match="expected a reset or a hold, got both for drone 0"):
        one_command(holds=np.array([True, True]))
    with pytest.raises(ValueError, match=r"holds: expected shape \(2,\), got \(3,\)"):
        one_command(holds=np.zeros(3, bool))
