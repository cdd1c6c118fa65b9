"""Messages that are larger than a datagram: cut into fragments, and put together again.

A fragment is a datagram with the header of its message, 128 added to its type, and a header of its
own: its number, the number of all, and whether its sender waits for an answer (docs/protocol.md).

A message is sent in bursts. The last fragment of a burst asks for an answer: a `Missing` with the
fragments that have not come, or, if all have, the answer to the message. So only missing fragments
are sent again, and the bursts follow each other at the pace of the round trip.
"""

import struct
from math import ceil
from zlib import crc32

import numpy as np

from . import binary
from .binary import HEADER_SIZE
from .errors import DecodeError
from .messages import Missing

NEAR = 65_507 - 24
"""Largest datagram of the binary codec on loopback, bytes: UDP's over IPv4, less a seal."""
FAR = 1_200
"""The same elsewhere: less than any network's, so that no datagram is cut on its way."""
MAX_FRAGMENTS = 1 << 14

_FRAGMENT = struct.Struct("<HHB3x")
_OVERHEAD = HEADER_SIZE + _FRAGMENT.size
_ASKS_AT = 28
_BURST = 3 << 16  # bytes: what the smallest buffer that systems give a socket holds
_LARGEST_BITMAP = 128  # bytes of the bitmap of a Missing: it tells of 1,024 fragments


class Transfer:
    """One message on its way, or a line of text: in one datagram, or in fragments.

    `largest` are the bytes of the largest datagram, a seal not counted.
    """

    def __init__(self, message: bytes, largest: int) -> None:
        self.message = message
        self.count = 1
        if len(message) > largest:
            self.count = ceil(len(message) / (largest - _OVERHEAD))
            self._slice = ceil(len(message) / self.count)
            self.count = ceil(len(message) / self._slice)  # fewer, where rounding made empty ones
            self._start = message[:3] + bytes((message[3] | binary.FRAGMENT,))
            self._crc = crc32(message[8:HEADER_SIZE], crc32(self._start))
        self._burst: list[int] = []
        self._next = 0  # no fragment from this one on was sent

    def start(self) -> list[bytes]:
        """The datagrams to send first."""
        if self.count == 1:
            return [self.message]
        self._next = 0
        return self._send(list(range(self.count)))

    def resend(self, missing: Missing) -> list[bytes]:
        """The datagrams to send after the receiver has said which fragments are missing."""
        if self.count != missing.count or not self._burst:
            return []
        numbers = missing.numbers()
        covered = missing.first + 8 * len(missing.bitmap)
        numbers += range(max(self._next, covered), self.count)
        return self._send(numbers)

    def probe(self) -> list[bytes]:
        """The datagrams that ask for an answer when none has come in time."""
        return self._send(self._burst[-1:]) if self._burst else self.start()

    def _send(self, numbers: list[int]) -> list[bytes]:
        if not numbers:
            return []
        burst = numbers[: max(_BURST // self._slice, 2)]
        self._burst = burst
        self._next = max(self._next, burst[-1] + 1)
        return [self._fragment(number, asks=number == burst[-1]) for number in burst]

    def _fragment(self, number: int, *, asks: bool) -> bytes:
        at = number * self._slice
        head = _FRAGMENT.pack(number, self.count, asks)
        slice_ = self.message[at : at + self._slice]
        crc = crc32(slice_, crc32(head, self._crc)).to_bytes(4, "little")
        return b"".join((self._start, crc, self.message[8:HEADER_SIZE], head, slice_))


def is_fragment(datagram: bytes) -> bool:
    """Whether a datagram, not sealed, says of itself that it is a fragment."""
    return len(datagram) > 3 and datagram[3] >= binary.FRAGMENT


def asks(datagram: bytes) -> bool:
    """Whether a fragment's sender waits for an answer."""
    return len(datagram) > _ASKS_AT and datagram[_ASKS_AT] == 1


class Assembler:
    """Puts one message after the other together, from fragments in any order, repeated ones too.

    Fragments of a message that is older than the one at hand change nothing. Repeats of a message
    have the same bytes and cuts, so fragments of several repeats make one. More bytes than
    `largest`, those of the largest message that can come, are never kept.
    """

    def __init__(self, largest: int) -> None:
        self._largest = largest
        self._begin((0, 0, -1), 0)

    def take(self, fragment: bytes) -> bytes | None:
        """Take a fragment with a checked header; the message, if it is whole now.

        Raises `DecodeError` if the fragment's numbers make no sense, or it is too much.
        """
        if len(fragment) <= _OVERHEAD:
            raise DecodeError(f"fragment: expected a slice of a message, got {len(fragment)} bytes")
        number, count, is_asking = _FRAGMENT.unpack_from(fragment, HEADER_SIZE)
        if not (number < count <= MAX_FRAGMENTS and is_asking <= 1):
            raise DecodeError(
                f"fragment: expected one of at most {MAX_FRAGMENTS}, got {number} of {count}"
            )
        header = binary.peek(fragment)
        if header[:2] == self._header[:2] and header[2] < self._header[2]:
            return None
        if (header, count) != (self._header, self._count):
            self._begin(header, count)
        if number in self._slices:
            return None
        slice_ = fragment[_OVERHEAD:]
        if self._size + len(slice_) > self._largest:
            self._begin(header, count)
            raise DecodeError(f"fragments: expected at most {self._largest} bytes in all, got more")
        self._slices[number] = slice_
        self._size += len(slice_)
        if len(self._slices) < count:
            return None
        message = b"".join([self._slices[i] for i in range(count)])
        self._begin(header, count)
        if is_fragment(message) or binary.peek(message) != header:
            raise DecodeError("fragments: expected a message with the header of its fragments")
        return message

    def missing(self) -> Missing | None:
        """What is missing of the message that is coming; None if none is."""
        if not self._slices:
            return None
        first = next(i for i in range(self._count) if i not in self._slices)
        span = min(self._count - first, 8 * _LARGEST_BITMAP)
        lacking = np.array([first + i not in self._slices for i in range(span)])
        kind, session, sequence = self._header
        bitmap = np.packbits(lacking, bitorder="little").tobytes()
        return Missing(
            session=session,
            sequence=sequence,
            kind=kind,
            count=self._count,
            first=first,
            bitmap=bitmap,
        )

    def ask(self, fragment: bytes) -> list[bytes]:
        """The answer to a fragment whose sender waits for one, in no more bytes than it has; none
        where the message is whole.
        """
        missing = self.missing() if asks(fragment) else None
        if missing is None:
            return []
        body = binary.encode(missing)[HEADER_SIZE : len(fragment)]
        return [binary.frame(binary.MISSING, missing.session, missing.sequence, body)]

    def _begin(self, header: tuple[int, int, int], count: int) -> None:
        self._header = header
        self._count = count
        self._slices: dict[int, bytes] = {}
        self._size = 0
