"""Writes the journal of a flight: every message once, in an MCAP file. See `docs/journal.md`.

A message is written as its whole datagram of the binary codec.
"""

import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from ...models.files import removed_on_error, software_versions
from ..protocol.messages import Message
from ..protocol.statistics import warn

ABOUT = "rotorgram"  # name of the metadata about the whole file
FORMAT = "5"  # version of the file's content, beside the protocol's in each datagram

_CHUNK = 1 << 16  # bytes; 2 ms to write
_SECOND = 10**9
_BUFFER = 1 << 20  # bytes; more than a chunk, so that its records reach the file at once


class Journal:
    """Writes every message that the tap of a link sees. A flight goes on when its journal cannot.

    It appends whole chunks, so that a killed program leaves a readable file: at most one second of
    messages is in memory only. The file is complete after `close`. A write that fails or is
    interrupted (a full device) may leave half a record, so nothing follows it. Ctrl-C and SIGTERM
    take effect after the write.

    Args:
        path: The file; it must not exist.
        side: `simulator` or `agent`.
        about: More metadata of the head, by name.

    Raises:
        FileExistsError: The file exists.
        OSError: It cannot be written.
    """

    def __init__(
        self, path: Path | str, *, side: str, about: Mapping[str, str] | None = None
    ) -> None:
        self._path = Path(path)
        self._pid = os.getpid()
        self._closed = False
        self._pending: list[tuple[int, int, int, bytes]] = []
        """Messages of the next chunk: channel, nanoseconds since 1970, sequence number, data."""
        self._size = 0  # bytes of these
        self._flushed = time.time_ns()
        self._channels: dict[int, int] = {}  # ids by slot
        versions = software_versions() | {"machine": platform.machine()}
        head = {f"version of {name}": number for name, number in versions.items()}
        head |= {"format": FORMAT, "side": side, **(about or {})}
        try:
            self._file: Any = self._path.open("xb", buffering=_BUFFER)
        except FileExistsError:
            raise FileExistsError(
                f"record: expected a file that does not exist yet, got {path}"
            ) from None
        writer: Any = Writer(self._file, chunk_size=sys.maxsize, use_summary_offsets=False)
        self._writer = writer
        with removed_on_error(self._path), self._writing():
            writer.start("", f"rotorgram {versions.get('rotorgram', '')}")
            writer.add_metadata(ABOUT, head)

    def tap(self, slot: int, message: Message, datagram: bytes) -> None:
        """Queue a message, as a `Tap`; `write` writes it."""
        if self._closed:
            return
        if slot not in self._channels:
            self._channels[slot] = self._writer.register_channel(f"/slot{slot}", "rotorgram", 0)
        sequence = getattr(message, "sequence", 0)
        self._pending.append((self._channels[slot], time.time_ns(), sequence, datagram))
        self._size += len(datagram)

    def write(self) -> None:
        """Write the messages. Call it when there is time: while the other side is at work."""
        # A negative time: the clock was set back.
        if self._size > _CHUNK or not 0 <= time.time_ns() - self._flushed < _SECOND:
            self._flush()

    def close(self) -> None:
        """Write all, and finish the file, or give it up where that fails. May be called again.

        In a forked child it does nothing.
        """
        if os.getpid() == self._pid:
            try:
                self._flush(finish=True)
            finally:
                self._file.close()

    def _flush(self, *, finish: bool = False) -> None:
        """Write all messages as one chunk; where that fails, log why the journal ends here."""
        if self._closed:
            return
        self._size = 0
        self._flushed = time.time_ns()
        try:
            with self._writing():
                for channel, now, sequence, data in self._pending:
                    self._writer.add_message(channel, now, data, now, sequence & 0xFFFFFFFF)
                self._pending.clear()
                self._writer.flush()
                if finish:
                    self._writer.finish()
                    self._closed = True
        except OSError as error:
            warn(
                f"record: writing {self._path} failed ({error.strerror or error}): "
                "the flight goes on, its journal ends here"
            )

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Flush what the block writes to the device. If that fails, nothing more is written."""
        with _deferred_signals():
            try:
                yield
                self._file.flush()
            except BaseException:
                self._closed = True
                with suppress(OSError):  # its buffer still holds bytes that a full device refused
                    self._file.raw.close()
                raise


@contextmanager
def _deferred_signals() -> Iterator[None]:
    """Delay the handlers of Ctrl-C and SIGTERM to the end of the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handlers = {
        number: handler
        for number in (signal.SIGINT, signal.SIGTERM)
        if (handler := signal.getsignal(number)) is not None  # else it cannot be set again
    }
    try:
        for number in handlers:
            signal.signal(number, lambda signum, _: came.append(signum))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for each in came:
            signal.raise_signal(each)
