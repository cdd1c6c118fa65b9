"""A shared key: only its holders can make a valid datagram.

A sealed datagram is an envelope of 24 bytes before the message: a magic number, the id of the key,
and the tag, a keyed BLAKE2b with the sender's side as `person` (docs/protocol.md has the offsets).

Messages that open a session are tagged with the shared key; later ones with a key derived from it
and both sides' random numbers, so that no message of another session is accepted. Sealing
authenticates; it does not encrypt.
"""

import os
import secrets
import stat
from hashlib import blake2b
from hmac import compare_digest
from pathlib import Path
from typing import Literal

from ...models.errors import InputError
from ...models.files import removed_on_error
from .errors import Forged

KEY_SIZE = 32  # bytes of a shared key
OVERHEAD = 24  # bytes that sealing adds to a datagram

_MAGIC = b"\xa7S"
_ID_SIZE = 6
_TAG_AT = 2 + _ID_SIZE
_TAG_SIZE = 16

Side = Literal["simulator", "agent"]


class Key:
    """Seals and opens datagrams of the side that is here with `KEY_SIZE` bytes that both hold.

    Each side's tags are its own: none can be sent back to it. A session's key has the id of the
    shared one.
    """

    def __init__(self, secret: bytes, side: Side, *, id_: bytes = b"") -> None:
        if len(secret) != KEY_SIZE:
            raise InputError(f"key: expected {KEY_SIZE} bytes, got {len(secret)}")
        self._secret = secret
        self.id = id_ or blake2b(key=secret, digest_size=_ID_SIZE, person=b"key id").digest()
        self._envelope = _MAGIC + self.id
        self._side = side
        there = "agent" if side == "simulator" else "simulator"
        # A keyed state is copied for each datagram: half the time of making a new one.
        self._ours = blake2b(key=secret, digest_size=_TAG_SIZE, person=side.encode())
        self._theirs = blake2b(key=secret, digest_size=_TAG_SIZE, person=there.encode())

    def for_session(self, session: int, nonce: int) -> "Key":
        """The key of one session, from the random numbers of both sides, 64 bits each."""
        numbers = session.to_bytes(8, "little") + nonce.to_bytes(8, "little")
        secret = blake2b(numbers, key=self._secret, digest_size=KEY_SIZE, person=b"session")
        return Key(secret.digest(), self._side, id_=self.id)

    def seal(self, message: bytes, asked: bytes = b"") -> bytes:
        """The datagram that carries a message. Only the sender of `asked` accepts the answer."""
        tag = self._ours.copy()
        tag.update(message + asked)
        return self._envelope + tag.digest() + message

    def open(self, datagram: bytes, asked: bytes = b"") -> bytes:
        """The message in a sealed datagram. Raises `Forged` if the key is another one."""
        message = message_of(datagram)
        tag = self._theirs.copy()
        tag.update(message + asked)
        envelope = datagram[:_TAG_AT]
        theirs = datagram[_TAG_AT:OVERHEAD]
        if not (envelope == self._envelope and compare_digest(tag.digest(), theirs)):
            raise Forged("key: the tag is not of this key and session")
        return message


def sealed(datagrams: list[bytes], key: Key | None) -> list[bytes]:
    """The datagrams of a message as they are sent: sealed where there is a key."""
    return [key.seal(datagram) for datagram in datagrams] if key else datagrams


def is_sealed(datagram: bytes) -> bool:
    """Whether a datagram says of itself that it is sealed."""
    return datagram[:2] == _MAGIC


def key_id(datagram: bytes) -> bytes:
    """The id of the key that a sealed datagram claims."""
    return datagram[2:_TAG_AT]


def message_of(datagram: bytes) -> bytes:
    """The message that a sealed datagram claims to carry, not verified."""
    return datagram[OVERHEAD:]


def read_key(path: Path | str) -> bytes:
    """The shared key of a file: a line of 64 hexadecimal digits.

    Raises `InputError` if the file cannot be read, holds something else, or others can read it.
    """
    try:
        mode = os.stat(path).st_mode
        is_file = stat.S_ISREG(mode)  # a FIFO would block for ever
        text = Path(path).read_bytes() if is_file else b""
    except OSError as error:
        raise InputError(f"key file: cannot read {path}: {error.strerror}") from None
    if is_file and mode & 0o077:
        raise InputError(
            f"key file: expected {path} to be readable by its owner alone (chmod 600), "
            f"got mode {mode & 0o777:o}"
        )
    try:
        (line,) = text.decode("ascii").split()
        key = bytes.fromhex(line)
    except ValueError:
        key = b""
    if len(key) != KEY_SIZE:
        raise InputError(f"key file: expected {2 * KEY_SIZE} hexadecimal digits in {path}")
    return key


def write_key(path: Path) -> None:
    """Write a new random key to a new file, readable by its owner alone.

    Raises `FileExistsError`, for a key is never replaced, or `OSError`; then there is no file.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        sentence = "expected a new file, got one that is there; a key is never replaced"
        raise FileExistsError(error.errno, sentence, str(path)) from None
    with removed_on_error(path), open(descriptor, "w", encoding="ascii") as file:
        file.write(secrets.token_hex(KEY_SIZE) + "\n")
