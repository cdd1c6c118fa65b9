"""An MCAP file that stays readable, whatever ends the program that writes it.

The records are those of `mcap.writer.Writer`. Around it: messages wait in a list, which costs the
exchange next to nothing, and a chunk of them is written at once.
"""

from collections.abc import Mapping
from contextlib import suppress
from errno import EFBIG, EINTR
from pathlib import Path
from threading import RLock
from typing import Final

from mcap.writer import CompressionType, Writer

__all__ = ["MAGIC", "Entry", "McapFile"]

MAGIC: Final = b"\x89MCAP0\r\n"
_NEVER: Final = 1 << 40  # bytes; `flush` says when a chunk ends
_MOST_CHANNELS: Final = 0xFFFF

Entry = tuple[int, int, int, bytes]
"""A message that waits to be written: channel, nanoseconds since 1970, sequence number, data."""


class McapFile:
    """Appends to a new file, in whole records.

    A write that an exception interrupts (a full device, Ctrl-C) may have left half of one. Then
    nothing more can be written, and `abandon` closes the file behind the last that is whole.

    Attributes:
        pending: Messages of the next chunk. Append to it; `encode` and `flush` take them.

    Args:
        path: The file; it must not exist.
        library: Name and version of the program that writes.

    Raises:
        FileExistsError: It does.
        OSError: It cannot be written. All other methods raise this too.
    """

    def __init__(self, path: Path, library: str) -> None:
        self.pending: list[Entry] = []
        self._file = path.open("xb")
        self._lock = RLock()
        self._broken, self._busy = True, False
        self._end = self._channels = 0
        self._writer = Writer(self._file, chunk_size=_NEVER, compression=CompressionType.ZSTD)
        try:
            self._writer.start(profile="", library=library)
            self._settle()
        except BaseException:
            self.abandon()
            path.unlink()
            raise

    def add_schema(self, name: str, encoding: str, text: str) -> int:
        """Its id."""
        with self._lock:
            self._broken = True
            number: int = self._writer.register_schema(name, encoding, text.encode())
            self._settle()
            return number

    def add_channel(self, topic: str, encoding: str, schema: int) -> int:
        """Its id. A file has 65,535 of them at most."""
        with self._lock:
            if self._channels == _MOST_CHANNELS:
                raise OSError(EFBIG, f"more than {_MOST_CHANNELS} channels")
            self._broken = True
            number: int = self._writer.register_channel(topic, encoding, schema)
            self._channels += 1
            self._settle()
            return number

    def add_metadata(self, name: str, words: Mapping[str, str]) -> None:
        """Names and values, after all messages before."""
        with self._lock:
            self.flush()
            self._broken = True
            self._writer.add_metadata(name, dict(words))
            self._settle()

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """A whole file."""
        with self._lock:
            self.flush()
            self._broken = True
            self._writer.add_attachment(
                create_time=0, log_time=time, name=name, media_type=media_type, data=data
            )
            self._settle()

    def encode(self) -> None:
        """Put the pending messages into the chunk that is written next."""
        with self._lock:
            if self._busy or self._file.closed:  # busy: a signal's handler, in the midst of this
                return
            if self._broken:
                raise OSError(EINTR, "a write was interrupted")
            self._broken = self._busy = True
            count = len(self.pending)  # another thread may append meanwhile
            try:
                for channel, time, sequence, data in self.pending[:count]:
                    self._writer.add_message(channel, time, data, time, sequence & 0xFFFFFFFF)
            finally:
                self._busy = False
            del self.pending[:count]
            self._broken = False

    def flush(self) -> None:
        """Write all messages as one chunk."""
        with self._lock:
            self.encode()
            if not self._busy and not self._file.closed:
                self._broken = True
                self._writer.flush()  # type: ignore[no-untyped-call]
                self._settle()

    def finish(self) -> None:
        """Write what is pending and the summary, and close the file. May be called again."""
        with self._lock:
            if self._busy or self._file.closed:
                return
            self.flush()
            self._broken = True
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()

    def abandon(self) -> None:
        """Close the file behind its last whole record. What is pending is lost."""
        with self._lock:
            if self._file.closed:
                return
            raw = self._file.raw  # not by its buffer, which has what a full device has refused
            with suppress(OSError):
                raw.truncate(self._end)
            raw.close()

    def _settle(self) -> None:
        """What was written until here is whole."""
        self._file.flush()
        self._end = self._file.tell()
        self._broken = False
