"""Messages that are larger than a datagram: cut into parts, and put together again.

A part is a datagram with the header of its message, but for the highest bit of the type, which is
set. Its body is its number, the number of parts, and a slice of the message, header included.
"""

import struct
from math import ceil
from typing import Final

from . import binary
from .binary import HEADER_SIZE, MAX_MESSAGE
from .errors import DecodeError

__all__ = ["MAX_PARTS", "Assembler", "cut", "is_first", "is_part", "turned"]

MAX_PARTS: Final = 8192
"""Most parts of one message. We cut as few as will do; another sender may cut finer."""

_PART: Final = struct.Struct("<HH4x")  # number, from 0; how many
_LARGEST_SLICE: Final = MAX_MESSAGE - HEADER_SIZE - _PART.size


def cut(message: bytes) -> list[bytes]:
    """The datagrams of a message of the binary codec: itself, or parts of the same size."""
    if len(message) <= MAX_MESSAGE:
        return [message]
    kind, session, sequence = binary.peek(message)
    count = ceil(len(message) / _LARGEST_SLICE)
    size = ceil(len(message) / count)
    return [
        binary.frame(
            kind | binary.PART,
            session,
            sequence,
            _PART.pack(number, count) + message[number * size : (number + 1) * size],
        )
        for number in range(count)
    ]


def turned(parts: list[bytes], times: int) -> list[bytes]:
    """The parts in another order for each repeat: where a buffer is full, it is of others."""
    if len(parts) == 1:
        return parts
    first = times * (len(parts) // 2 + 1) % len(parts)
    return parts[first:] + parts[:first]


def is_part(datagram: bytes) -> bool:
    """Whether a datagram, not sealed, says of itself that it is a part."""
    return len(datagram) > 3 and datagram[3] >= binary.PART


def is_first(datagram: bytes) -> bool:
    """Whether a datagram, not sealed, is a whole message or the first part of one."""
    at = HEADER_SIZE
    return not is_part(datagram) or datagram[at : at + 2] == b"\0\0"


class Assembler:
    """Puts one message after the other together, from parts in any order, repeated ones too.

    Parts of a message that is older than the one at hand change nothing. Repeats of a message have
    the same bytes, so parts of several repeats make one.

    Args:
        largest: Bytes of the largest message that can come: more are never kept.
    """

    def __init__(self, largest: int) -> None:
        self._largest = min(largest, binary.MAX_WHOLE)
        self._sequence = -1
        self._count = 0
        self._slices: dict[int, bytes] = {}
        self._size = 0

    def take(self, sequence: int, part: bytes) -> bytes | None:
        """Take a part of the message of that number; the message, if it is whole now.

        Raises:
            DecodeError: The part's numbers make no sense, or it is too much.
        """
        if len(part) <= HEADER_SIZE + _PART.size:
            raise DecodeError(f"part: expected a slice of a message, got {len(part)} bytes")
        number, count = _PART.unpack_from(part, HEADER_SIZE)
        if not number < count <= MAX_PARTS:
            raise DecodeError(f"part: expected one of at most {MAX_PARTS}, got {number} of {count}")
        if sequence < self._sequence:
            return None
        if (sequence, count) != (self._sequence, self._count):
            self._begin(sequence, count)
        if number in self._slices:
            return None
        slice_ = part[HEADER_SIZE + _PART.size :]
        if self._size + len(slice_) > self._largest:
            self._begin(sequence, count)
            raise DecodeError(f"parts: expected at most {self._largest} bytes in all, got more")
        self._slices[number] = slice_
        self._size += len(slice_)
        if len(self._slices) < count:
            return None
        message = b"".join(self._slices[i] for i in range(count))
        self._begin(sequence, count)
        if binary.peek(message) != binary.peek(part):
            raise DecodeError("parts: expected those of a message with the header of its parts")
        return message

    def _begin(self, sequence: int, count: int) -> None:
        self._sequence, self._count = sequence, count
        self._slices, self._size = {}, 0
