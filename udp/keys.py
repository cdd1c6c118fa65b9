"""A shared key: datagrams that only those who hold it can make.

A sealed datagram is an envelope of 18 bytes, magic and tag, before the message. The tag is a keyed
BLAKE2b of the message. What opens a session is tagged with a key made from the shared one; all
that follows with a key that both sides' random numbers enter, so that nothing of another session
is ever taken. Nothing is hidden: sealing authenticates, it does not encrypt.
"""

import os
import secrets
from hashlib import blake2b
from hmac import compare_digest
from pathlib import Path
from typing import Final, Literal

from .errors import Forged

__all__ = ["KEY_SIZE", "OVERHEAD", "Key", "is_sealed", "message_of", "read_key", "write_key"]

KEY_SIZE: Final = 32
"""Bytes of a shared key."""
OVERHEAD: Final = 18
"""Bytes that sealing adds to a datagram."""

_MAGIC: Final = b"\xa7S"
_TAG_SIZE: Final = 16

Side = Literal["simulator", "agent"]


class Key:
    """Seals and opens datagrams. Each side's tags are its own: none can be sent back to it.

    Args:
        secret: `KEY_SIZE` bytes that both sides hold.
        side: The side that is here.
    """

    def __init__(self, secret: bytes, side: Side) -> None:
        if len(secret) != KEY_SIZE:
            raise ValueError(f"key: expected {KEY_SIZE} bytes, got {len(secret)}")
        self._secret = secret
        self._side = side
        there = "agent" if side == "simulator" else "simulator"
        # A keyed state is copied for each datagram: half the price of making one anew.
        self._ours = blake2b(key=secret, digest_size=_TAG_SIZE, person=side.encode())
        self._theirs = blake2b(key=secret, digest_size=_TAG_SIZE, person=there.encode())

    def for_session(self, session: int, nonce: int) -> "Key":
        """The key of one session, from the random numbers of both sides, 64 bits each."""
        numbers = session.to_bytes(8, "little") + nonce.to_bytes(8, "little")
        secret = blake2b(numbers, key=self._secret, digest_size=KEY_SIZE, person=b"session")
        return Key(secret.digest(), self._side)

    def seal(self, message: bytes, asked: bytes = b"") -> bytes:
        """The datagram that carries a message. Only who has sent `asked` takes it for an answer."""
        tag = self._ours.copy()
        tag.update(message + asked)
        return _MAGIC + tag.digest() + message

    def open(self, datagram: bytes, asked: bytes = b"") -> bytes:
        """The message in a sealed datagram. Raises `Forged` if the key is another one."""
        message = message_of(datagram)
        tag = self._theirs.copy()
        tag.update(message + asked)
        if not (is_sealed(datagram) and compare_digest(tag.digest(), datagram[2:OVERHEAD])):
            raise Forged("key: the tag is not of this key and session")
        return message


def is_sealed(datagram: bytes) -> bool:
    """Whether a datagram says of itself that it is sealed."""
    return datagram[:2] == _MAGIC


def message_of(datagram: bytes) -> bytes:
    """The message that a sealed datagram claims to carry, not verified."""
    return datagram[OVERHEAD:]


def read_key(path: Path) -> bytes:
    """The shared key of a file that `write_key` wrote: 64 hexadecimal digits.

    Raises:
        ValueError: The file cannot be read, holds something else, or is readable by others.
    """
    try:
        with open(path, "rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            text = file.read(4 * KEY_SIZE)
    except OSError as error:
        raise ValueError(f"key file: cannot read {path}: {error.strerror}") from None
    if os.name == "posix" and mode & 0o077:
        raise ValueError(
            f"key file: expected {path} to be readable by its owner alone (chmod 600), "
            f"got mode {mode & 0o777:o}"
        )
    try:
        secret = bytes.fromhex(text.decode("ascii"))
    except ValueError:
        secret = b""
    if len(secret) != KEY_SIZE:
        raise ValueError(f"key file: expected {2 * KEY_SIZE} hexadecimal digits in {path}")
    return secret


def write_key(path: Path) -> None:
    """Write a new random key to a new file, readable by its owner alone.

    Raises:
        FileExistsError: There is such a file; a key is never replaced.
        OSError: It cannot be written.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    try:
        descriptor = os.open(path, flags, 0o600)
    except FileExistsError as error:
        sentence = "expected a new file, got one that is there; a key is never replaced"
        raise FileExistsError(error.errno, sentence, str(path)) from None
    with open(descriptor, "w", encoding="ascii") as file:
        file.write(secrets.token_hex(KEY_SIZE) + "\n")
