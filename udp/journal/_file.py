"""MCAP files: written so that a killed program leaves a readable file, and read in bounded memory.

Messages wait in a list, which costs the exchange next to nothing. The package `mcap` makes a chunk
of them in memory, and whole records reach the file at once.
"""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from errno import EFBIG, EINTR
from io import BytesIO
from pathlib import Path
from threading import RLock
from typing import Any, BinaryIO, Final

import zstandard
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from ..protocol.layout import MAX_MESSAGE

__all__ = ["MAGIC", "MAX_CHUNK", "McapFile", "read_records"]

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_CHUNK: Final = 2 * MAX_MESSAGE
"""Most bytes of a record or of a decompressed chunk that is read. Ours are of 64 KiB, or of one
message and 256 KiB where that is longer."""
_MAX_CHANNELS: Final = 0xFFFF
_SCHEMA_ENCODING: Final = {"ros1": "ros1msg", "json": "jsonschema"}


class _Waiting(BytesIO):
    """Whole records that are not in the file yet."""

    begin = 0  # of them, in the file

    def tell(self) -> int:
        return self.begin + super().tell()


class McapFile:
    """Appends to a new file, in whole records. Every method raises `OSError` where that fails.

    A write that an exception interrupts (a full device, Ctrl-C) may leave half a record. Then
    nothing more can be written, and `abandon` closes the file after the last whole record.
    Nothing is written before the first flush. `library` is name and version of the program.
    """

    def __init__(self, path: Path, library: str) -> None:
        self.pending: list[tuple[int, int, int, bytes]] = []
        """Messages of the next chunk: channel, nanoseconds since 1970, sequence number, data.
        Append to it; `flush` takes them."""
        self._schemas: dict[str, dict[str, int]] = {}  # ids by name and text
        self._channels: dict[tuple[str, int], int] = {}  # ids by topic and schema
        self._file = path.open("xb")
        self._waiting = _Waiting()
        self._writer: Any = Writer(self._waiting, chunk_size=sys.maxsize, use_summary_offsets=False)
        self._lock = RLock()
        self._broken = self._busy = False
        self._writer.start("", library)

    def channel(self, topic: str, encoding: str, name: str, text: str) -> int:
        """Id of the channel with this schema: `ros1` or `json`. A file has at most 65,535.

        A second schema of the same name, with another text, is numbered.
        """
        with self._lock:
            schemas = self._schemas.setdefault(name, {})
            if text not in schemas:
                name += f"{len(schemas) + 1}" if schemas else ""
                schemas[text] = self._writer.register_schema(
                    name, _SCHEMA_ENCODING[encoding], text.encode()
                )
            key = topic, schemas[text]
            if key not in self._channels:
                if len(self._channels) == _MAX_CHANNELS:
                    raise OSError(EFBIG, f"more than {_MAX_CHANNELS} channels")
                self._channels[key] = self._writer.register_channel(topic, encoding, key[1])
            return self._channels[key]

    def add_metadata(self, name: str, words: Mapping[str, str]) -> None:
        """Names and values, after all messages before."""
        with self._lock:
            self.flush()
            with self._whole():
                self._writer.add_metadata(name, dict(words))

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """A whole file."""
        with self._lock:
            self.flush()
            with self._whole():
                self._writer.add_attachment(0, time, name, media_type, data)

    def flush(self) -> None:
        """Write all messages as one chunk."""
        with self._lock:
            # Busy: called by a signal handler that interrupted us.
            if self._busy or self._file.closed or not self.pending:
                return
            self._busy = True
            try:
                count = len(self.pending)  # another thread may append meanwhile
                with self._whole():
                    for channel, time, sequence, data in self.pending[:count]:
                        self._writer.add_message(channel, time, data, time, sequence & 0xFFFFFFFF)
                    del self.pending[:count]
                    self._writer.flush()
            finally:
                self._busy = False

    def finish(self) -> None:
        """Write pending messages and the summary, and close the file. May be called again."""
        with self._lock:
            if self._busy or self._file.closed:
                return
            self.flush()
            with self._whole():
                self._writer.finish()
            self._file.close()

    def abandon(self) -> None:
        """Close the file after its last whole record. Pending messages are lost."""
        with self._lock:
            if self._file.closed:
                return
            raw = self._file.raw  # its buffer still holds the bytes that a full device refused
            with suppress(OSError):
                raw.truncate(self._waiting.begin)
            raw.close()

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Write what is added here, up to the device. If that is interrupted, it is the last."""
        if self._broken:
            raise OSError(EINTR, "a write was interrupted")
        self._broken = True
        yield
        records = self._waiting.getvalue()
        self._file.write(records)
        self._file.flush()
        self._waiting.begin += len(records)
        self._waiting.seek(0)
        self._waiting.truncate(0)
        self._broken = False


def read_records(file: BinaryIO) -> Iterator[McapRecord]:
    """The records of an MCAP file, those in chunks too, in order.

    Raises:
        ValueError: A record or chunk is larger than `MAX_CHUNK`, or compressed in another way, or
            a chunk has more records than bytes: each of ours has a checksum, and that stays.
        OSError: The file cannot be read.
        Exception: Any other, of the package `mcap`, where the file is damaged or cut off.
    """
    reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_CHUNK)
    for record in reader.records:
        if isinstance(record, Chunk):
            chunk = _decompressed(record)
            at = count = 0
            while at < len(chunk.data):  # before all of them are made
                at += 9 + int.from_bytes(chunk.data[at + 1 : at + 9], "little")  # opcode, length
                count += 1
                if count > (most := len(record.data)):
                    raise ValueError(f"expected at most {most} records in so many bytes, got more")
            yield from breakup_chunk(chunk, validate_crc=True)
        else:
            yield record


def _decompressed(chunk: Chunk) -> Chunk:
    """The same chunk without compression. A short chunk can decompress to any number of bytes."""
    if not chunk.compression:
        return chunk
    if chunk.compression != "zstd":
        raise ValueError(f"expected a chunk compressed by zstd, got {chunk.compression!r:.80}")
    if (size := chunk.uncompressed_size) > MAX_CHUNK:
        raise ValueError(f"expected chunks of at most {MAX_CHUNK} bytes, got one of {size}")
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK)
    data = decompressor.stream_reader(BytesIO(chunk.data)).read(size + 1)
    if len(data) != size:
        raise ValueError(f"expected a chunk of {size} bytes, got one of another size")
    return replace(chunk, compression="", data=data)
