"""Writes the journal of a flight: every message once, in an MCAP file. See `docs/journal.md`.

A State or a Command is written as its whole binary message. All other messages are JSON with the
message in it as hexadecimal digits.
"""

import json
import logging
import os
import platform
import signal
import sys
import threading
import time
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from ...models.files import removed_on_error
from ..protocol.messages import Command, Hello, Message, State
from ..transport.stepped import Steppable

ABOUT = "rotorgram"  # name of the metadata about the whole file
FORMAT = "4"  # version of the file's content, beside the protocol's in each datagram

_CHUNK = 1 << 16  # bytes; 2 ms to write
_SECOND = 10**9
_BUFFER = 1 << 20  # bytes; more than a chunk, so that its records reach the file at once
_PACKAGES = ("rotorgram", "mujoco", "gymnasium", "numpy", "mcap")

_log = logging.getLogger("rotorgram.udp")


class Journal:
    """Writes every message that the tap of a link sees. A flight goes on when its journal cannot.

    At most one second of messages is in memory only. The file is complete after `close`, and when
    the journal is garbage-collected or the program ends; otherwise it can be read up to its end.

    Args:
        path: The file; it must not exist.
        side: `simulator` or `agent`.
        codec: Of the sessions.
        about: More metadata of the head, by name.
        models: MJCF of the vehicles, by the names of the attachments.

    Raises:
        FileExistsError: The file exists.
        OSError: It cannot be written.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        side: str,
        codec: str = "binary",
        about: Mapping[str, str] | None = None,
        models: Mapping[str, str] | None = None,
    ) -> None:
        self._codec = codec
        self._size = 0  # bytes that are not written yet
        now = self._flushed = time.time_ns()
        versions = software()
        head = {f"version of {name}": number for name, number in versions.items()}
        head |= {"format": FORMAT, "side": side, **(about or {})}
        try:
            self._file = file = McapFile(Path(path), f"rotorgram {versions.get('rotorgram', '')}")
        except FileExistsError:
            sentence = f"record: expected a file that does not exist yet, got {path}"
            raise FileExistsError(sentence) from None
        with removed_on_error(Path(path)):
            file.write_head(head, models or {}, now)
        weakref.finalize(self, file.close)

    def tap(self, slot: int, message: Message, datagram: bytes) -> None:
        """Take note of a message: a `Tap`. `write` pays for writing it."""
        if self._file.closed:
            return
        now = time.time_ns()
        if isinstance(message, State | Command):
            topic = "state" if isinstance(message, State) else "command"
            channel = self._file.channel(f"/slot{slot}/{topic}", "rotorgram")
            self._file.pending.append((channel, now, message.sequence, datagram))
        else:
            channel = self._file.channel(f"/slot{slot}/events", "json")
            self._file.pending.append((channel, now, 0, self._event(message, datagram)))
        self._size += len(datagram)
        if self._size > 4 * _CHUNK:  # nobody calls `write`
            self._flush(now)

    def write(self) -> None:
        """Write the messages. Call it when there is time: while the other side is at work."""
        now = time.time_ns()
        # Clocks are set back at times.
        if self._size > _CHUNK or not 0 <= now - self._flushed < _SECOND:
            self._flush(now)

    def close(self) -> None:
        """Write all, and finish the file. May be called again."""
        self._file.close()

    def _flush(self, now: int) -> None:
        self._size = 0
        self._flushed = now
        self._file.flush()

    def _event(self, message: Message, datagram: bytes) -> bytes:
        """A message for readers, with its datagram for programs."""
        words = {"type": type(message).__name__, "session": f"{message.session:016x}"}
        if isinstance(message, Hello):
            words["codec"] = self._codec
        for name in ("worlds", "spec", "seed", "sequence", "reason"):
            if hasattr(message, name):
                words[name] = getattr(message, name)
        words["datagram"] = datagram.hex()
        return json.dumps(words).encode()


def software() -> dict[str, str]:
    """Versions of the software that the numbers depend on, and the machine."""
    versions = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


def models_of(stepped: Steppable) -> tuple[dict[str, str], dict[str, str]]:
    """Metadata and attachments that describe the vehicles of a registered task; else empty.

    The attachments are the whole MJCF of each different vehicle, its includes resolved. The
    metadata `models` names the attachment of each drone of a world, in their order.
    """
    from ...envs.loop import Loop
    from ...models.mjcf import vehicle_spec

    if not isinstance(stepped, Loop):
        return {}, {}
    vehicle = stepped.task.vehicle
    members = getattr(vehicle, "members", (vehicle,))
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


# ---- the file


class McapFile:
    """Appends whole chunks to a new file, so that a killed program leaves a readable one.

    Messages wait in a list, which costs the exchange next to nothing, until `flush` makes a chunk
    of them. `library` is name and version of the program. A write that fails or is interrupted (a
    full device) may leave half a record, so it is the last. Ctrl-C and SIGTERM take effect after
    the write.
    """

    def __init__(self, path: Path, library: str) -> None:
        self.closed = False
        self.pending: list[tuple[int, int, int, bytes]] = []
        """Messages of the next chunk: channel, nanoseconds since 1970, sequence number, data."""
        self._path = path
        self._pid = os.getpid()
        self._channels: dict[str, int] = {}  # ids by topic
        self._file: Any = path.open("xb", buffering=_BUFFER)
        self._writer: Any = Writer(self._file, chunk_size=sys.maxsize, use_summary_offsets=False)
        self._writer.start("", library)
        self._event = self._writer.register_schema(
            "rotorgram.Event", "jsonschema", b'{"type": "object"}'
        )

    def channel(self, topic: str, encoding: str) -> int:
        """Id of the channel of a topic."""
        if topic not in self._channels:
            schema = self._event if encoding == "json" else 0
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema)
        return self._channels[topic]

    def write_head(self, about: Mapping[str, str], models: Mapping[str, str], time: int) -> None:
        """Write the metadata, and the models as attachments. Raises `OSError`."""
        with self._whole():
            self._writer.add_metadata(ABOUT, dict(about))
            for name, model in models.items():
                self._writer.add_attachment(0, time, name, "application/xml", model.encode())

    def flush(self, *, finish: bool = False) -> None:
        """Write all messages as one chunk; where that fails, log why the journal ends here."""
        if self.closed:
            return
        try:
            with self._whole():
                for channel, time, sequence, data in self.pending:
                    self._writer.add_message(channel, time, data, time, sequence & 0xFFFFFFFF)
                self.pending.clear()
                self._writer.flush()
                if finish:
                    self._writer.finish()
                    self.closed = True
        except OSError as error:
            sentence = "record: writing %s failed (%s): the flight goes on, its journal ends here"
            _log.warning(sentence, self._path, error.strerror or error)

    def close(self) -> None:
        """Finish the file, or give it up where that fails. A fork leaves it to its parent."""
        if os.getpid() == self._pid:
            self.flush(finish=True)
            self._file.close()

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Write what is added here, up to the device. If that is interrupted, it is the last."""
        with _deferred_signals():
            try:
                yield
                self._file.flush()
            except BaseException:
                self.closed = True
                with suppress(OSError):  # its buffer still holds bytes that a full device refused
                    self._file.raw.close()
                raise


@contextmanager
def _deferred_signals() -> Iterator[None]:
    """Call the handlers of Ctrl-C and SIGTERM after the block: they run in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handlers: dict[int, Any] = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if handler is not None:  # None: not set by Python, and cannot be set again
                handlers[number] = handler
                signal.signal(number, lambda signum, _: came.append(signum))
        yield
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
        for each in came:
            signal.raise_signal(each)
