"""Writes the journal of a flight: every message once, in an MCAP file. See `docs/journal.md`.

A State or a Command is written as its whole binary message. All other messages are JSON with the
message in it as hexadecimal digits.
"""

import json
import logging
import os
import platform
import sys
import time
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from errno import EFBIG, EINTR
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from threading import RLock
from typing import Any, Final

from mcap.writer import Writer

from ...envs.spec import EnvSpec
from ..layouts import layout_of
from ..protocol import binary
from ..protocol.messages import Command, Hello, Message, State
from ..protocol.statistics import Statistics

ABOUT: Final = "rotorgram"  # name of the metadata about the whole file
FORMAT: Final = "3"  # version of the file's content, beside the protocol's in each datagram

_CHUNK: Final = 1 << 16  # bytes; 2 ms to write
_SECOND: Final = 10**9
_STATISTICS: Final = 10 * _SECOND
_MAX_CHANNELS: Final = 0xFFFF
_BUFFER: Final = 1 << 20  # bytes; more than a chunk, so that its records reach the file at once
_PACKAGES: Final = ("rotorgram", "mujoco", "gymnasium", "numpy", "mcap")

_log: Final = logging.getLogger("rotorgram.udp")

_EVENT: Final = "rotorgram.Event", '{"type": "object"}'
_NUMBER: Final = '{"type": "object", "additionalProperties": {"type": "number"}}'
_NUMBERS: Final = "rotorgram.Statistics", _NUMBER


class Journal:
    """Writes every message that the tap of a link sees. A flight goes on when its journal cannot.

    At most one second of messages is in memory only. The file is complete after `close`, and when
    the journal is garbage-collected or the program ends; otherwise it can be read up to its end.

    Args:
        path: The file; it must not exist.
        statistics: Those of the link. They are written every 10 s, and at the end.
        side: `simulator` or `agent`.
        slots: Sessions in the slots of an agent; another one in a slot is another session. Only the
            text codec needs them: there all sessions have the same number.
        text_hello: Stands for the Hello that the text codec does not have. An agent gives it the
            session 0.
        about: More metadata of the head, by name.
        models: MJCF of the vehicles, by the names of the attachments.

    Raises:
        FileExistsError: The file exists.
        OSError: It cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        statistics: Statistics,
        *,
        side: str,
        slots: Sequence[object] = ("the only agent",),
        text_hello: Hello | None = None,
        about: Mapping[str, str] | None = None,
        models: Mapping[str, str] | None = None,
    ) -> None:
        self._statistics = statistics
        self._slots = slots
        self._text_hello = text_hello
        self._holders: dict[int, object] = {}  # by slot: number of a binary session, or a text one
        self._channels: dict[tuple[int, int], int] = {}  # by slot and kind of message
        self._size = self._sessions = 0
        now = self._flushed = self._counted = time.time_ns()
        versions = software()
        head = {f"version of {name}": number for name, number in versions.items()}
        head |= {"format": FORMAT, "side": side, **(about or {})}
        try:
            file = McapFile(Path(path), f"rotorgram {versions.get('rotorgram', '')}")
        except FileExistsError:
            sentence = f"record: expected a file that does not exist yet, got {path}"
            raise FileExistsError(sentence) from None
        try:
            file.add_metadata(ABOUT, head)
            for name, model in (models or {}).items():
                file.add_attachment(name, "application/xml", model.encode(), now)
        except BaseException as error:
            file.abandon()
            Path(path).unlink()
            if isinstance(error, OSError):
                raise OSError(error.errno, error.strerror, str(path)) from None
            raise
        self._file = file
        self._pending = file.pending
        weakref.finalize(self, file.close)

    def tap(self, slot: int, message: Message, datagram: bytes) -> None:
        """Take note of a message: a `Tap`. `write` pays for writing it."""
        now = time.time_ns()
        if self._file.closed:
            return
        try:
            if isinstance(message, Hello):
                self._begin(slot, message, datagram, "binary", now)
                self._holders[slot] = message.session
            elif message.session != self._holders.get(slot):  # no Hello: by text
                self._begin_by_text(slot, now)
            if isinstance(message, State | Command):
                channel = self._channels[slot, datagram[3]]
                self._pending.append((channel, now, message.sequence, datagram))
            elif not isinstance(message, Hello):
                self._add_json(f"/slot{slot}/events", _EVENT, _words(message, datagram), now)
            self._size += len(datagram)
            if self._size > 4 * _CHUNK:  # nobody calls `write`
                self._flush(now)
        except OSError as error:
            self._file.give_up(error)

    def write(self) -> None:
        """Write the messages. Call it when there is time: while the other side is at work."""
        if self._file.closed:
            return
        now = time.time_ns()
        try:
            # Clocks are set back at times.
            if self._size > _CHUNK or not 0 <= now - self._flushed < _SECOND:
                self._flush(now)
        except OSError as error:
            self._file.give_up(error)

    def close(self) -> None:
        """Write all, and finish the file. May be called again."""
        if self._file.closed:
            return
        try:
            self._count(time.time_ns())
        except OSError as error:
            self._file.give_up(error)
        self._file.close()

    def _flush(self, now: int) -> None:
        if not 0 <= now - self._counted < _STATISTICS:
            self._count(now)
        self._file.flush()
        self._size = 0
        self._flushed = now

    # ---- sessions

    def _begin_by_text(self, slot: int, now: int) -> None:
        """Begin a session if this is the first message of a new text simulator."""
        hello = self._text_hello
        assert hello is not None, "the text codec needs a text_hello"
        holder = self._slots[slot]
        if holder is not self._holders.get(slot):
            self._holders[slot] = holder
            self._begin(slot, hello, binary.encode(hello), "text", now)

    def _begin(self, slot: int, hello: Hello, datagram: bytes, codec: str, now: int) -> None:
        """Take note of a new session, whose messages may have another layout."""
        self._flush(now)
        self._sessions += 1
        layout = layout_of(EnvSpec.from_json(hello.spec), hello.worlds)
        words = {
            "index": str(self._sessions),
            "slot": str(slot),
            "session": f"{hello.session:016x}",
            "codec": codec,
            "drones": str(layout.drones),
            "spec": hello.spec,
        }
        self._file.add_metadata("session", words)
        for kind, topic in ((binary.STATE, "state"), (binary.COMMAND, "command")):
            channel = self._file.channel(f"/slot{slot}/{topic}", "rotorgram")
            self._channels[slot, kind] = channel
        words = _words(hello, datagram) | {"codec": codec}
        self._add_json(f"/slot{slot}/events", _EVENT, words, now)

    def _count(self, now: int) -> None:
        self._counted = now
        self._add_json("/statistics", _NUMBERS, self._statistics.numbers(), now)

    def _add_json(
        self, topic: str, schema: tuple[str, str], words: Mapping[str, Any], now: int
    ) -> None:
        channel = self._file.channel(topic, "json", schema)
        self._pending.append((channel, now, 0, json.dumps(words).encode()))


def software() -> dict[str, str]:
    """Versions of the software that the numbers depend on, and the machine."""
    versions = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def models_of(stepped: Any) -> tuple[dict[str, str], dict[str, str]]:
    """Metadata and attachments that describe the vehicles of a registered task; else empty.

    The attachments are the whole MJCF of each different vehicle, its includes resolved. The
    metadata `models` names the attachment of each drone of a world, in their order.
    """
    task = getattr(stepped, "task", None)
    if task is None:
        return {}, {}

    from ...models.mjcf import vehicle_spec

    members = getattr(task.vehicle, "members", (task.vehicle,))
    names: dict[str, str] = {}  # by hash
    models: dict[str, str] = {}
    for vehicle in members:
        if vehicle.hash not in names:
            name = f"model{len(names) or ''}.xml"
            names[vehicle.hash] = name
            models[name] = str(vehicle_spec(vehicle.path).to_xml())
    about = {"models": " ".join(names[vehicle.hash] for vehicle in members)}
    about["config"] = json.dumps(stepped.config.to_dict())
    about["backend"] = stepped.config.backend.name
    return about, models


def _words(message: Message, datagram: bytes) -> dict[str, Any]:
    """A message for readers, and its datagram for programs."""
    words = {"type": type(message).__name__, "session": f"{message.session:016x}"}
    names = ("worlds", "spec", "seed", "sequence", "reason")
    told = {name: getattr(message, name) for name in names if hasattr(message, name)}
    return {**words, **told, "datagram": datagram.hex()}


# ---- the file


class McapFile:
    """Appends whole records to a new file, so that a killed program leaves a readable one.

    Messages wait in a list, which costs the exchange next to nothing, until `flush` makes a chunk
    of them. Nothing is written before the first flush. `library` is name and version of the
    program. Every method but `close` and `give_up` raises `OSError` where it fails.

    A write that an exception interrupts (a full device, Ctrl-C) may leave half a record. Then
    nothing more can be written, and `abandon` closes the file after the last whole record.
    """

    def __init__(self, path: Path, library: str) -> None:
        self.closed = False
        self.pending: list[tuple[int, int, int, bytes]] = []
        """Messages of the next chunk: channel, nanoseconds since 1970, sequence number, data.
        Append to it; `flush` takes them."""
        self.size = 0  # bytes of the whole records in the file
        self._path = path
        self._pid = os.getpid()
        self._schemas: dict[tuple[str, str], int] = {}  # ids by name and text
        self._channels: dict[str, int] = {}  # ids by topic
        self._file: Any = path.open("xb", buffering=_BUFFER)
        self._writer: Any = Writer(self._file, chunk_size=sys.maxsize, use_summary_offsets=False)
        self._lock = RLock()
        self._broken = self._busy = False
        self._writer.start("", library)

    def channel(self, topic: str, encoding: str, schema: tuple[str, str] | None = None) -> int:
        """Id of the channel with this JSON schema (name, text). A file has at most 65,535."""
        with self._lock:
            if schema and schema not in self._schemas:
                name, text = schema
                number = self._writer.register_schema(name, "jsonschema", text.encode())
                self._schemas[schema] = number
            if topic not in self._channels:
                if len(self._channels) == _MAX_CHANNELS:
                    raise OSError(EFBIG, f"more than {_MAX_CHANNELS} channels")
                number = self._schemas[schema] if schema else 0  # 0: none
                self._channels[topic] = self._writer.register_channel(topic, encoding, number)
            return self._channels[topic]

    def add_metadata(self, name: str, words: Mapping[str, str]) -> None:
        """Write names and values, after all messages before."""
        self.flush()
        with self._whole():
            self._writer.add_metadata(name, dict(words))

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """Write a whole file, after all messages before."""
        self.flush()
        with self._whole():
            self._writer.add_attachment(0, time, name, media_type, data)

    def flush(self) -> None:
        """Write all messages as one chunk."""
        with self._lock:
            # Busy: called by a signal handler that interrupted us.
            if self._busy or self.closed or not self.pending:
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
            if self._busy or self.closed:
                return
            self.flush()
            with self._whole():
                self._writer.finish()
            self.closed = True
            self._file.close()

    def close(self) -> None:
        """Finish the file, or give it up where that fails. A fork leaves it to its parent."""
        if os.getpid() == self._pid:
            try:
                self.finish()
            except OSError as error:
                self.give_up(error)

    def give_up(self, error: OSError) -> None:
        """Log why the journal ends here, and abandon the file: what was written can be read."""
        sentence = "record: writing %s failed (%s): the flight goes on, its journal ends here"
        _log.warning(sentence, self._path, error.strerror or error)
        with suppress(OSError):
            self.abandon()

    def abandon(self) -> None:
        """Close the file after its last whole record. Pending messages are lost."""
        with self._lock:
            if self.closed:
                return
            raw = self._file.raw  # its buffer still holds the bytes that a full device refused
            try:
                raw.truncate(self.size)
            except (OSError, ValueError):  # ValueError: a second interrupt found it closed
                pass
            finally:
                raw.close()
                self.closed = True

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Write what is added here, up to the device. If that is interrupted, it is the last."""
        with self._lock:
            if self._broken:
                raise OSError(EINTR, "a write was interrupted")
            self._broken = True
            yield
            self._file.flush()
            self.size = self._file.tell()
            self._broken = False
