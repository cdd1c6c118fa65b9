"""MCAP files: written so that a killed program leaves a readable file, and read in bounded memory.

The records are those of the package `mcap`. Messages wait in a list, which costs the exchange
next to nothing, and a chunk of them is written at once.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from errno import EFBIG, EINTR
from io import BytesIO
from pathlib import Path
from threading import RLock
from typing import Any, BinaryIO, Final

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk

from ..protocol.layout import MAX_MESSAGE

__all__ = ["MAGIC", "MAX_CHUNK", "Entry", "McapFile", "read_records"]

MAGIC: Final = b"\x89MCAP0\r\n"
MAX_CHUNK: Final = 2 * MAX_MESSAGE
"""Most bytes of a record or of a decompressed chunk that is read. Ours are of 64 KiB, or of one
message and 256 KiB where that is longer."""
_MAX_CHANNELS: Final = 0xFFFF
_MESSAGE: Final = struct.Struct("<BQHIQQ")
"""A message before its data: opcode, length, channel, sequence, times of log and publication."""
_MESSAGE_INDEX: Final = struct.Struct("<BQHI")
_FOOTER: Final = struct.Struct("<BQQQ")
_OPCODE_AND_LENGTH: Final = 9  # bytes, of every record

Entry = tuple[int, int, int, bytes]
"""A message that waits to be written: channel, nanoseconds since 1970, sequence number, data."""


class McapFile:
    """Appends to a new file, in whole records.

    A write that an exception interrupts (a full device, Ctrl-C) may leave half a record. Then
    nothing more can be written, and `abandon` closes the file after the last whole record.

    Attributes:
        pending: Messages of the next chunk. Append to it; `flush` takes them.

    Args:
        path: The file; it must not exist.
        library: Name and version of the program that writes.

    Raises:
        FileExistsError: The file exists.
        OSError: It cannot be written. All other methods raise this too.
    """

    def __init__(self, path: Path, library: str) -> None:
        self.pending: list[Entry] = []
        self._definitions: list[bytes] = []  # schemas and channels of the next chunk
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._indexes: list[McapRecord] = []
        self._counts: defaultdict[int, int] = defaultdict(int)
        """Messages of each channel."""
        self._times: list[int] = []
        """First and last of each chunk."""
        self._file = path.open("xb")
        self._lock = RLock()
        self._broken = self._busy = False
        self._end = 0
        try:
            with self._whole():
                self._write(MAGIC + _bytes(Header("", library)))
        except BaseException:
            self.abandon()
            path.unlink()
            raise

    def add_schema(self, name: str, encoding: str, text: str) -> int:
        """Its id."""
        with self._lock:
            number = len(self._schemas) + 1
            schema = Schema(id=number, data=text.encode(), encoding=encoding, name=name)
            self._schemas.append(schema)
            self._definitions.append(_bytes(schema))
            return number

    def add_channel(self, topic: str, encoding: str, schema: int) -> int:
        """Its id. A file has at most 65,535 channels."""
        with self._lock:
            number = len(self._channels) + 1
            if number > _MAX_CHANNELS:
                raise OSError(EFBIG, f"more than {_MAX_CHANNELS} channels")
            channel = Channel(
                id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata={}
            )
            self._channels.append(channel)
            self._definitions.append(_bytes(channel))
            return number

    def add_metadata(self, name: str, words: Mapping[str, str]) -> None:
        """Names and values, after all messages before."""
        with self._lock:
            self.flush()
            record = _bytes(Metadata(name=name, metadata=dict(words)))
            self._indexes.append(MetadataIndex(offset=self._end, length=len(record), name=name))
            with self._whole():
                self._write(record)

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """A whole file."""
        with self._lock:
            self.flush()
            whole = Attachment(
                create_time=0, log_time=time, name=name, media_type=media_type, data=data
            )
            record = _bytes(whole)
            index = AttachmentIndex(
                offset=self._end, length=len(record), create_time=0, log_time=time,
                data_size=len(data), name=name, media_type=media_type,
            )  # fmt: skip
            self._indexes.append(index)
            with self._whole():
                self._write(record)

    def flush(self) -> None:
        """Write all messages as one chunk."""
        with self._lock:
            # Busy: called by a signal handler that interrupted us.
            if self._busy or self._file.closed:
                return
            self._busy = True
            try:
                count = len(self.pending)  # another thread may append meanwhile
                if count:
                    with self._whole():
                        self._write_chunk(self.pending[:count])
                        del self.pending[:count]
            finally:
                self._busy = False

    def finish(self) -> None:
        """Write pending messages and the summary, and close the file. May be called again."""
        with self._lock:
            if self._busy or self._file.closed:
                return
            self.flush()
            end = _bytes(DataEnd(0))
            begin, kinds = self._end + len(end), [type(index) for index in self._indexes]
            counted = Statistics(
                attachment_count=kinds.count(AttachmentIndex),
                channel_count=len(self._channels),
                channel_message_counts=self._counts,
                chunk_count=kinds.count(ChunkIndex),
                message_count=sum(self._counts.values()),
                metadata_count=kinds.count(MetadataIndex),
                message_start_time=min(self._times, default=0),
                message_end_time=max(self._times, default=0),
                schema_count=len(self._schemas),
            )
            indexes = sorted(self._indexes, key=lambda index: type(index).__name__)  # in groups
            records = (*self._schemas, *self._channels, counted, *indexes)
            summary = b"".join(map(_bytes, records))
            crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 20, begin, 0), zlib.crc32(summary))
            footer = Footer(summary_start=begin, summary_offset_start=0, summary_crc=crc)
            with self._whole():
                self._write(end + summary + _bytes(footer) + MAGIC)
            self._file.close()

    def abandon(self) -> None:
        """Close the file after its last whole record. Pending messages are lost."""
        with self._lock:
            if self._file.closed:
                return
            raw = self._file.raw  # its buffer still holds the bytes that a full device refused
            with suppress(OSError):
                raw.truncate(self._end)
            raw.close()

    def _write_chunk(self, entries: list[Entry]) -> None:
        """Without the package's own writer, which takes 4 µs for each message."""
        pieces = self._definitions.copy()
        at = sum(map(len, pieces))
        places: defaultdict[int, list[int]] = defaultdict(list)
        """Of each channel: time and offset of each message."""
        for channel, time, sequence, data in entries:
            places[channel] += (time, at)
            length = _MESSAGE.size - _OPCODE_AND_LENGTH + len(data)
            pieces.append(
                _MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence & 0xFFFFFFFF, time, time)
            )
            pieces.append(data)
            at += _OPCODE_AND_LENGTH + length
        raw = b"".join(pieces)
        data = zstandard.compress(raw)
        first, last = min(entry[1] for entry in entries), max(entry[1] for entry in entries)
        chunk = _bytes(
            Chunk(
                compression="zstd", data=data, message_start_time=first, message_end_time=last,
                uncompressed_crc=zlib.crc32(raw), uncompressed_size=len(raw),
            )
        )  # fmt: skip
        records, offsets = chunk, {}
        for channel, numbers in places.items():
            offsets[channel] = self._end + len(records)
            size = 8 * len(numbers)
            records += _MESSAGE_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size)
            records += struct.pack(f"<{len(numbers)}Q", *numbers)
        index = ChunkIndex(
            message_start_time=first, message_end_time=last, chunk_start_offset=self._end,
            chunk_length=len(chunk), message_index_offsets=offsets,
            message_index_length=len(records) - len(chunk), compression="zstd",
            compressed_size=len(data), uncompressed_size=len(raw),
        )  # fmt: skip
        self._write(records)
        self._definitions.clear()
        self._indexes.append(index)
        self._times += (first, last)
        for channel, numbers in places.items():
            self._counts[channel] += len(numbers) // 2

    def _write(self, records: bytes) -> None:
        """Write whole records, up to the device."""
        self._file.write(records)
        self._file.flush()
        self._end += len(records)

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """What an exception interrupts here is the last that is written."""
        if self._broken:
            raise OSError(EINTR, "a write was interrupted")
        self._broken = True
        yield
        self._broken = False


def _bytes(record: McapRecord) -> bytes:
    builder: Any = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data


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
                at += _OPCODE_AND_LENGTH + int.from_bytes(chunk.data[at + 1 : at + 9], "little")
                count += 1
                if count > len(record.data):
                    most = len(record.data)
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
    if chunk.uncompressed_size > MAX_CHUNK:
        size = chunk.uncompressed_size
        raise ValueError(f"expected chunks of at most {MAX_CHUNK} bytes, got one of {size}")
    stream = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK).stream_reader(
        BytesIO(chunk.data)
    )
    data = stream.read(chunk.uncompressed_size + 1)
    if len(data) != chunk.uncompressed_size:
        size = chunk.uncompressed_size
        raise ValueError(f"expected a chunk of {size} bytes, got one of another size")
    return replace(chunk, compression="", data=data)
