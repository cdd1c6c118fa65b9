"""Curves of a training for TensorBoard: which updates are written, and how little of it."""

import math
import time
from pathlib import Path
from struct import pack

_POINTS = 200  # of each curve: the width of a chart, and less than 1 MB for all
_LEAST = 100  # env steps between two points: in short runs more would cost time
_PREFIX = "events.out.tfevents."
_START = b"\x3a\x02\x08\x01"  # a SessionLog with the status START


_CRC = []  # CRC-32C of each byte
for _crc in range(256):
    for _ in range(8):
        _crc = _crc >> 1 ^ (0x82F63B78 if _crc & 1 else 0)
    _CRC.append(_crc)


class ScalarWriter:
    """Writes numbers by name at the first update, then at the first after so many env steps.

    So many are a two hundredth of the run, and at least 100: curves of agents that update at
    different times have points near the same env steps. Each begin or resume makes an event file.
    TensorBoard is told to forget points beyond `behind`: a process that was killed has lost them.
    """

    def __init__(self, folder: Path, env_steps: int, *, behind: int = 0) -> None:
        self._every = max(math.ceil(env_steps / _POINTS), _LEAST)
        self._last = behind or -1
        self._written: int | None = None
        folder.mkdir(parents=True, exist_ok=True)
        # Not TensorFlow's or torch's writer: they name a file by the clock, and TensorBoard reads
        # files in the order of their names. After the clock went back it would skip the new one.
        number = len(list(folder.glob(f"{_PREFIX}*")))
        name = f"{_PREFIX}{number:010}.rotorgram"
        self._file = open(folder / name, "xb")  # noqa: SIM115  until `close`
        self.flush = self._file.flush
        self.close = self._file.close
        self._add(0, _field(3, b"brain.Event:2"))
        # TensorBoard drops what it has read from this step on. One of its two readers skips the
        # first such mark of a folder: so a fresh training has one too.
        self._add(behind + 1, _START)

    def due(self, env_steps: int, *, last: bool = False) -> bool:
        """Asked at every update: whether to write at it; at the last, if it is not written yet."""
        due = env_steps // self._every > self._last // self._every
        self._last = env_steps
        return due or (last and self._written != env_steps)

    def write(self, env_steps: int, numbers: dict[str, float]) -> None:
        """Write finite numbers as one event: a sixth of what so many `add_scalar` take."""
        values = [
            _field(1, _field(1, tag.encode()) + b"\x15" + pack("<f", value))
            for tag, value in numbers.items()
        ]
        self._add(env_steps, _field(5, b"".join(values)))
        self._written = env_steps

    def _add(self, step: int, content: bytes) -> None:
        """Append an Event of TensorFlow's `event.proto`: time, step, and a field with the rest."""
        data = b"\x09" + pack("<d", time.time()) + b"\x10" + _varint(step) + content
        size = pack("<Q", len(data))
        self._file.write(size + _checksum(size) + data + _checksum(data))


def _field(number: int, content: bytes) -> bytes:
    """A field of a Protocol Buffers message: bytes, a text or a message."""
    return bytes((8 * number + 2,)) + _varint(len(content)) + content


def _varint(number: int) -> bytes:
    """Seven bits in each byte, the lowest first; the highest bit says that another follows."""
    parts = bytearray()
    while number > 127:
        parts.append(number & 127 | 128)
        number >>= 7
    return bytes((*parts, number))


def _checksum(data: bytes) -> bytes:
    """CRC-32C, masked as TensorFlow's records have it: its own writer takes 0.1 s to import."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC[(crc ^ byte) & 0xFF]
    crc ^= 0xFFFFFFFF
    turned = crc >> 15 | crc << 17
    return pack("<I", turned + 0xA282EAD8 & 0xFFFFFFFF)
