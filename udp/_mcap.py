"""An MCAP file that stays readable, whatever ends the program that writes it.

`mcap.writer.Writer` takes 3.3 µs per message, and cannot take one back that Ctrl-C cut in two. Here
a message is one entry in a list, and a chunk of them is encoded, compressed and written at once:
0.8 µs per message. All other records are those of `mcap.records`.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from errno import EFBIG
from pathlib import Path
from threading import RLock
from typing import Final

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
    SummaryOffset,
)

__all__ = ["MAGIC", "Entry", "McapFile"]

MAGIC: Final = b"\x89MCAP0\r\n"
_MESSAGE: Final = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, two times
_PLACE: Final = struct.Struct("<QQ")  # time, offset: a line of a message index
_INDEX: Final = struct.Struct("<BQHI")  # opcode, length, channel, size of the lines
_FOOTER: Final = struct.Struct("<BQQQ")  # opcode, length, summary start, offsets' start
_MORE: Final = _MESSAGE.size - 9  # bytes of a message record beside its data
_GROUPS: Final = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
)
"""What the summary repeats, each by its offset in the file."""


Entry = tuple[int, int, int, bytes]
"""A message that waits to be written: channel, nanoseconds since 1970, sequence number, data."""


@dataclass(frozen=True)
class _Totals:
    """Of all chunks so far."""

    counts: Counter[int] = field(default_factory=Counter)
    """Messages by channel."""
    first: int = 0
    last: int = 0


class McapFile:
    """Appends to a new file.

    Every method writes whole records where the last complete one ended, and then takes note of it
    without a call in between. So one that an exception interrupts (a full device, Ctrl-C) has done
    nothing, and may be called again.

    Attributes:
        pending: Messages of the next chunk. Append to it; `flush` writes and removes them.

    Args:
        path: The file; it must not exist.
        library: Name and version of the program that writes.

    Raises:
        FileExistsError: It does.
        OSError: It cannot be written. All other methods raise this too.
    """

    def __init__(self, path: Path, library: str) -> None:
        self.pending: list[Entry] = []
        self._file = path.open("xb", buffering=0)
        self._lock = RLock()
        self._busy = False
        self._compress = zstandard.ZstdCompressor(level=1).compress
        self._groups: dict[Opcode, dict[int, bytes]] = {group: {} for group in _GROUPS}
        self._totals = _Totals()
        start = MAGIC + _encoded(Header(profile="", library=library))
        self._end = 0
        try:
            self._put(start)
        except BaseException:
            self._file.close()
            path.unlink()
            raise
        self._end = len(start)

    def add_schema(self, name: str, encoding: str, text: str) -> int:
        """Its id."""
        number = len(self._groups[Opcode.SCHEMA]) + 1
        schema = _encoded(Schema(id=number, name=name, encoding=encoding, data=text.encode()))
        self._add(schema, Opcode.SCHEMA, schema)
        return number

    def add_channel(self, topic: str, encoding: str, schema: int) -> int:
        """Its id. A file has 65,535 of them at most."""
        number = len(self._groups[Opcode.CHANNEL]) + 1
        if number > 0xFFFF:
            raise OSError(EFBIG, "more than 65535 channels")
        channel = _encoded(
            Channel(
                id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=schema
            )
        )
        self._add(channel, Opcode.CHANNEL, channel)
        return number

    def add_metadata(self, name: str, words: Mapping[str, str]) -> None:
        """Names and values, after all messages before."""
        self.flush()
        record = _encoded(Metadata(name=name, metadata=dict(words)))
        index = MetadataIndex(offset=self._end, length=len(record), name=name)
        self._add(record, Opcode.METADATA_INDEX, _encoded(index))

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """A whole file."""
        self.flush()
        record = _encoded(
            Attachment(create_time=0, log_time=time, name=name, media_type=media_type, data=data)
        )
        index = AttachmentIndex(
            offset=self._end,
            length=len(record),
            log_time=time,
            create_time=0,
            data_size=len(data),
            name=name,
            media_type=media_type,
        )
        self._add(record, Opcode.ATTACHMENT_INDEX, _encoded(index))

    def flush(self) -> None:
        """Write the pending messages as one chunk."""
        with self._lock:
            if self._busy or self._file.closed:  # busy: a signal's handler, in the midst of a write
                return
            self._busy = True
            try:
                self._flush()
            finally:
                self._busy = False

    def finish(self) -> None:
        """Write what is pending and the summary, and close the file. May be called again."""
        with self._lock:
            if self._busy or self._file.closed:
                return
            self._busy = True
            try:
                self._flush()
                data = self._summary()
                self._put(data)
                self._file.truncate(self._end + len(data))
                self._file.close()
            finally:
                self._busy = False

    def abandon(self) -> None:
        """Close the file behind its last whole record. What is pending is lost."""
        with self._lock:
            if not self._file.closed:
                try:
                    self._file.truncate(self._end)
                finally:
                    self._file.close()

    def _add(self, record: bytes, group: Opcode, line: bytes) -> None:
        with self._lock:
            if self._file.closed:
                return
            at = self._end
            self._put(record)
            end = at + len(record)
            self._groups[group][at], self._end = line, end

    def _flush(self) -> None:
        pending, at = self.pending, self._end
        count = len(pending)
        if not count:
            return
        data, line, totals = self._chunk(pending[:count])
        self._put(data)
        end = at + len(data)
        # No calls from here on, so no signal's handler either: all is done, or nothing.
        self._groups[Opcode.CHUNK_INDEX][at], self._totals, self._end = line, totals, end
        del pending[:count]

    def _put(self, data: bytes) -> None:
        """Write behind the last whole record."""
        self._file.seek(self._end)
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]

    def _chunk(self, entries: list[Entry]) -> tuple[bytes, bytes, _Totals]:
        """The next chunk with its message indexes, its line in the summary, and totals with it."""
        raw, lines = _messages(entries)
        packed = self._compress(raw)
        first, last = min(entry[1] for entry in entries), max(entry[1] for entry in entries)
        chunk = _encoded(
            Chunk(
                compression="zstd",
                data=packed,
                message_start_time=first,
                message_end_time=last,
                uncompressed_crc=zlib.crc32(raw),
                uncompressed_size=len(raw),
            )
        )
        end = self._end + len(chunk)
        parts, offsets = [chunk], {}
        for channel, places in lines.items():
            size = _PLACE.size * len(places)
            parts += _INDEX.pack(Opcode.MESSAGE_INDEX, size + 6, channel, size), *places
            offsets[channel] = end
            end += _INDEX.size + size
        line = ChunkIndex(
            message_start_time=first,
            message_end_time=last,
            chunk_start_offset=self._end,
            chunk_length=len(chunk),
            message_index_offsets=offsets,
            message_index_length=end - self._end - len(chunk),
            compression="zstd",
            compressed_size=len(packed),
            uncompressed_size=len(raw),
        )
        before = self._totals
        counts = before.counts + Counter(
            {channel: len(places) for channel, places in lines.items()}
        )
        totals = _Totals(counts, min(before.first or first, first), max(before.last, last))
        return b"".join(parts), _encoded(line), totals

    def _summary(self) -> bytes:
        """All that follows the data: their end, the summary, the footer and the magic."""
        groups, totals = self._groups, self._totals
        end = _encoded(DataEnd(data_section_crc=0))
        start = self._end + len(end)
        statistics = Statistics(
            message_count=totals.counts.total(),
            schema_count=len(groups[Opcode.SCHEMA]),
            channel_count=len(groups[Opcode.CHANNEL]),
            attachment_count=len(groups[Opcode.ATTACHMENT_INDEX]),
            metadata_count=len(groups[Opcode.METADATA_INDEX]),
            chunk_count=len(groups[Opcode.CHUNK_INDEX]),
            message_start_time=totals.first,
            message_end_time=totals.last,
            channel_message_counts=dict(totals.counts),
        )
        texts = {group: b"".join(lines.values()) for group, lines in groups.items()}
        texts[Opcode.STATISTICS] = _encoded(statistics)
        body, offsets = b"", b""
        for group, text in texts.items():
            if text:
                where = SummaryOffset(
                    group_opcode=group, group_start=start + len(body), group_length=len(text)
                )
                offsets += _encoded(where)
                body += text
        head = _FOOTER.pack(Opcode.FOOTER, 20, start, start + len(body))
        crc = zlib.crc32(head, zlib.crc32(body + offsets))
        footer = Footer(
            summary_start=start, summary_offset_start=start + len(body), summary_crc=crc
        )
        return end + body + offsets + _encoded(footer) + MAGIC


def _messages(entries: list[Entry]) -> tuple[bytes, dict[int, list[bytes]]]:
    """Message records, and for each channel the lines of its index: times and offsets."""
    parts: list[bytes] = []
    lines: dict[int, list[bytes]] = {}
    offset = 0
    pack, place = _MESSAGE.pack, _PLACE.pack
    for channel, time, sequence, data in entries:
        size = len(data) + _MORE
        parts += pack(5, size, channel, sequence & 0xFFFFFFFF, time, time), data
        try:
            lines[channel].append(place(time, offset))
        except KeyError:
            lines[channel] = [place(time, offset)]
        offset += size + 9
    return b"".join(parts), lines


def _encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
