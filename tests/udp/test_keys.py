"""Sealed datagrams, and the files that hold a key."""

import os
import stat
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from links import ONE, command, hello, state
from rotorgram.udp import DecodeError
from rotorgram.udp.protocol import binary
from rotorgram.udp.protocol.auth import (
    OVERHEAD,
    Key,
    is_sealed,
    message_of,
    read_key,
    write_key,
)
from rotorgram.udp.protocol.messages import Unknown

SECRET = bytes(range(32))
SESSION = 0x0123456789ABCDEF
NONCE = 0xFEDCBA9876543210
SIMULATOR = Key(SECRET, "simulator")
AGENT = Key(SECRET, "agent")

GOLDEN = {
    "Hello": binary.encode(hello(SESSION)),
    "State": binary.encode(state(1, SESSION), ONE),
    "Command": binary.encode(command(1, SESSION), ONE),
    "Unknown": binary.encode(Unknown(session=SESSION, sequence=1)),
}


# ---- the bytes


def test_an_unknown_is_sealed_together_with_the_state_that_it_answers() -> None:
    state = SIMULATOR.for_session(SESSION, NONCE).seal(GOLDEN["State"])
    datagram = AGENT.seal(GOLDEN["Unknown"], state)
    assert SIMULATOR.open(datagram, state) == GOLDEN["Unknown"]
    for other in (b"", state[:-1], state[:8] + bytes(16) + state[24:]):
        with pytest.raises(DecodeError):
            SIMULATOR.open(datagram, other)


# ---- what is not opened


def test_every_flipped_bit_of_a_sealed_datagram_is_seen() -> None:
    datagram = SIMULATOR.seal(GOLDEN["Hello"])
    for bit in range(8 * len(datagram)):
        flipped = bytearray(datagram)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(DecodeError):
            AGENT.open(bytes(flipped))


def test_a_sealed_datagram_that_was_cut_or_made_longer() -> None:
    datagram = SIMULATOR.seal(GOLDEN["Hello"])
    for size in range(len(datagram)):
        with pytest.raises(DecodeError):
            AGENT.open(datagram[:size])
    with pytest.raises(DecodeError):
        AGENT.open(datagram + b"\0")


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=100), st.binary(min_size=32, max_size=32))
@example(b"", SECRET)
def test_any_bytes_are_sealed_and_opened(message: bytes, secret: bytes) -> None:
    datagram = Key(secret, "agent").seal(message)
    assert is_sealed(datagram)
    assert len(datagram) == len(message) + OVERHEAD
    assert message_of(datagram) == message
    assert Key(secret, "simulator").open(datagram) == message


@settings(deadline=None, max_examples=300)
@given(st.binary(max_size=100))
@example(b"\xa7S")
@example(b"\xa7S" + bytes(16))
def test_bytes_that_nobody_sealed_are_not_opened(junk: bytes) -> None:
    for datagram in (junk, b"\xa7S" + junk):
        with pytest.raises(DecodeError):
            SIMULATOR.open(datagram)


def test_a_sealed_datagram_is_neither_text_nor_a_message() -> None:
    datagram = SIMULATOR.seal(GOLDEN["Hello"])
    assert not is_sealed(GOLDEN["Hello"])
    assert binary.peek(datagram) == (0, 0, 0)
    with pytest.raises(DecodeError, match="magic: expected a752, got a753"):
        binary.decode(datagram)


def test_keys_of_a_session_are_no_two_alike() -> None:
    tags = {
        Key(SECRET, side).for_session(session, nonce).seal(b"")
        for side in ("simulator", "agent")
        for session in range(8)
        for nonce in range(8)
    }
    assert len(tags) == 128


@pytest.mark.parametrize("size", [0, 16, 31, 33, 64])
def test_a_key_has_32_bytes(size: int) -> None:
    with pytest.raises(ValueError, match=f"key: expected 32 bytes, got {size}"):
        Key(bytes(size), "agent")


# ---- files


def test_a_key_is_written_and_read(tmp_path: Path) -> None:
    first = tmp_path / "first"
    second = tmp_path / "second"
    write_key(first)
    write_key(second)
    secret = read_key(first)
    assert len(secret) == 32
    assert first.read_text() == secret.hex() + "\n"
    assert secret != read_key(second)


def test_only_its_owner_may_read_a_key(tmp_path: Path) -> None:
    path = tmp_path / "key"
    before = os.umask(0)
    try:
        write_key(path)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    for mode in (0o640, 0o604, 0o620, 0o601, 0o666):
        path.chmod(mode)
        with pytest.raises(ValueError, match=rf"\(chmod 600\), got mode {mode:o}"):
            read_key(path)
    path.chmod(0o400)
    assert len(read_key(path)) == 32


def test_a_key_is_never_replaced(tmp_path: Path) -> None:
    path = tmp_path / "key"
    write_key(path)
    secret = path.read_text()
    with pytest.raises(FileExistsError):
        write_key(path)
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileExistsError):
        write_key(link)
    assert path.read_text() == secret
    assert not (tmp_path / "elsewhere").exists()


def test_a_key_that_cannot_be_read_or_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"key file: cannot read .*nowhere: No such file"):
        read_key(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="key file"):
        read_key(tmp_path)
    with pytest.raises(OSError):
        write_key(tmp_path / "no folder" / "key")


@pytest.mark.parametrize(
    "text",
    [b"", b"\n", b"00" * 31, b"00" * 33, b"0" * 63, b"zz" * 32, b"\xff" * 64, b"00" * 500,
     b"00" * 16 + b"\n" + b"00" * 16, b"00 " * 32,
     "٠".encode() * 64],
)  # fmt: skip
def test_a_file_that_holds_no_key(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "key"
    path.touch(0o600)
    path.write_bytes(text)
    with pytest.raises(ValueError, match="key file: expected 64 hexadecimal digits in"):
        read_key(path)


@pytest.mark.parametrize("end", [b"", b"\n", b"\r\n"])
def test_a_key_that_somebody_else_wrote(tmp_path: Path, end: bytes) -> None:
    path = tmp_path / "key"
    path.touch(0o600)
    path.write_bytes(SECRET.hex().upper().encode() + end)
    assert read_key(path) == SECRET


def test_a_fifo_as_key_file_does_not_hang(tmp_path: Path) -> None:  # fault 37
    path = tmp_path / "fifo"
    os.mkfifo(path, 0o600)
    with pytest.raises(ValueError, match="expected 64 hexadecimal digits"):
        read_key(path)


def test_a_full_disk_leaves_no_empty_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fault 37
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    path = tmp_path / "key"
    with monkeypatch.context() as patch:
        patch.setattr("secrets.token_hex", full)
        with pytest.raises(OSError, match=str(path)):
            write_key(path)
    assert not path.exists()
    write_key(path)
