"""Writes the journal of a flight: every message once, in an MCAP file. See `docs/journal.md`.

A State or a Command is written as its whole binary message, which is a valid ROS 1 message of
arrays: the schema fixes their lengths, and any viewer of MCAP reads it. All other messages are
JSON with the message in it as hexadecimal digits.
"""

import json
import logging
import os
import platform
import re
import sys
import time
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from errno import EFBIG, EINTR
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from threading import RLock
from typing import Any, Final

from mcap.writer import Writer

from ...envs.spec import ArraySpec, EnvSpec
from ..layouts import layout_of
from ..protocol import binary
from ..protocol.layout import COMMAND_ARRAYS_AT, STATE_ARRAYS_AT, Layout, Slot
from ..protocol.messages import Command, Hello, Message, State
from ..protocol.statistics import Statistics

ABOUT: Final = "rotorgram"  # name of the metadata about the whole file
FORMAT: Final = "2"  # version of the file's content, beside the protocol's in each datagram

_CHUNK: Final = 1 << 16  # bytes; 2 ms to write
_SECOND: Final = 10**9
_STATISTICS: Final = 10 * _SECOND
_SEEDED: Final = binary.COMMAND | 0x100  # a Command whose ROS 1 message has one more array
_MAX_CHANNELS: Final = 0xFFFF
_BUFFER: Final = 1 << 20  # bytes; more than a chunk, so that its records reach the file at once
_PACKAGES: Final = ("rotorgram", "mujoco", "gymnasium", "numpy", "mcap")

_log: Final = logging.getLogger("rotorgram.udp")

_HEADER: Final = """uint8[2] magic
uint8 version
uint8 type
uint32 crc
uint64 session
uint64 sequence
"""
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
        model: MJCF of the vehicle, to keep in the file.

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
        model: str = "",
    ) -> None:
        self._statistics, self._slots, self._text_hello = statistics, slots, text_hello
        self._holders: dict[int, object] = {}  # by slot: number of a binary session, or a text one
        self._channels: dict[tuple[int, int], int] = {}  # by slot and kind: binary's or _SEEDED
        self._size = self._sessions = 0
        now = self._flushed = self._counted = time.time_ns()
        versions = software()
        about = {f"version of {name}": number for name, number in versions.items()}
        try:
            file = McapFile(Path(path), f"rotorgram {versions.get('rotorgram', '')}")
        except FileExistsError:
            sentence = f"record: expected a file that does not exist yet, got {path}"
            raise FileExistsError(sentence) from None
        try:
            file.add_metadata(ABOUT, {"format": FORMAT, "side": side, **about})
            if model:
                file.add_attachment("model.xml", "application/xml", model.encode(), now)
        except BaseException as error:
            file.abandon()
            Path(path).unlink()
            if isinstance(error, OSError):
                raise OSError(error.errno, error.strerror, str(path)) from None
            raise
        self._file, self._pending = file, file.pending
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
                seeded = isinstance(message, Command) and message.seeds is not None
                channel = self._channels[slot, _SEEDED if seeded else datagram[3]]
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
        self._size, self._flushed = 0, now

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
        spec = EnvSpec.from_json(hello.spec)
        layout = layout_of(spec, hello.worlds)
        words = {
            "index": str(self._sessions),
            "slot": str(slot),
            "session": f"{hello.session:016x}",
            "codec": codec,
            "drones": str(layout.drones),
            "spec": hello.spec,
        }
        self._file.add_metadata("session", words)
        for kind, topic, name, text in _schemas(spec, layout):
            self._channels[slot, kind] = self._file.channel(
                f"/slot{slot}/{topic}", "ros1", f"rotorgram/{name}", text
            )
        words = _words(hello, datagram) | {"codec": codec}
        self._add_json(f"/slot{slot}/events", _EVENT, words, now)

    def _count(self, now: int) -> None:
        self._counted = now
        self._add_json("/statistics", _NUMBERS, self._statistics.numbers(), now)

    def _add_json(
        self, topic: str, schema: tuple[str, str], words: Mapping[str, Any], now: int
    ) -> None:
        channel = self._file.channel(topic, "json", *schema)
        self._pending.append((channel, now, 0, json.dumps(words).encode()))


def software() -> dict[str, str]:
    """Versions of the software that the numbers depend on, and the machine."""
    versions = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def model_of(stepped: Any) -> str:
    """The whole MJCF of our tasks' vehicle, its includes resolved; "" for another env."""
    task = getattr(stepped, "task", None)
    if task is None:
        return ""
    from ...models.scene import build_scene

    return str(build_scene(task.vehicle.path, visual=False).to_xml())


# ---- ROS 1 messages


def _schemas(spec: EnvSpec, layout: Layout) -> Iterator[tuple[int, str, str, str]]:
    """Kind, topic, name and text of each ROS 1 message of this layout."""
    observation = _field_names("observation", spec.observation)
    telemetry = _field_names("telemetry", spec.telemetry)
    slots = (*layout.observation_slots, layout.rewards, *layout.flags, *layout.telemetry_slots)
    named = zip(
        (*observation, "rewards", "terminated", "truncated", *telemetry), slots, strict=True
    )
    text = _schema_text("float64 time\nuint64 nonce\n", STATE_ARRAYS_AT, named)
    yield binary.STATE, "state", "State", text
    arrays = [("actions", layout.actions), ("orders", layout.orders), ("seeds", layout.seeds)]
    for kind, name, count in (binary.COMMAND, "Command", 2), (_SEEDED, "SeededCommand", 3):
        fixed = "uint32 seed_count\nuint8[4] reserved\n"
        yield kind, "command", name, _schema_text(fixed, COMMAND_ARRAYS_AT, arrays[:count])


def _schema_text(fixed: str, at: int, arrays: Iterable[tuple[str, Slot]]) -> str:
    text = _HEADER + fixed
    for name, slot in arrays:
        if slot.at > at:
            text += f"uint8[{slot.at - at}] padding{at}\n"
        count = (slot.end - slot.at) // slot.dtype.itemsize
        text += f"{slot.dtype.name}[{count}] {name}\n"
        at = slot.end
    return text


def _field_names(prefix: str, arrays: Iterable[ArraySpec]) -> list[str]:
    """Names of arrays, made into different ones that ROS 1 allows."""
    fields: list[str] = []
    for array in arrays:
        field = f"{prefix}_{re.sub(r'[^a-zA-Z0-9_]', '_', array.name)}"
        while field in fields:
            field += "_"
        fields.append(field)
    return fields


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
        self._path, self._pid = path, os.getpid()
        self._schemas: dict[str, dict[str, int]] = {}  # ids by name and text
        self._channels: dict[tuple[str, int], int] = {}  # ids by topic and schema
        self._file: Any = path.open("xb", buffering=_BUFFER)
        self._writer: Any = Writer(self._file, chunk_size=sys.maxsize, use_summary_offsets=False)
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
                language = {"ros1": "ros1msg", "json": "jsonschema"}[encoding]
                schemas[text] = self._writer.register_schema(name, language, text.encode())
            key = topic, schemas[text]
            if key not in self._channels:
                if len(self._channels) == _MAX_CHANNELS:
                    raise OSError(EFBIG, f"more than {_MAX_CHANNELS} channels")
                self._channels[key] = self._writer.register_channel(topic, encoding, key[1])
            return self._channels[key]

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
