"""Reads and summarizes a journal, whole or cut off."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap import records
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from ...envs.spec import EnvSpec
from ...models.errors import InputError, printable, shortened
from ..layouts import layout_of
from ..protocol import binary
from ..protocol.errors import DecodeError
from ..protocol.layout import MAX_MESSAGE
from ..protocol.messages import (
    Close,
    Command,
    Hello,
    Message,
    Refuse,
    State,
    Unknown,
    Welcome,
)
from ..protocol.party import first_seeds, reset_of_all
from .writer import ABOUT, FORMAT

MAX_CHUNK = 2 * MAX_MESSAGE
"""Most bytes of a record or of a decompressed chunk that is read. Ours are of 64 KiB, or of one
message and 256 KiB where that is longer."""
_TOPIC = re.compile(r"/slot([0-9]{1,9})")


@dataclass(eq=False)
class Session:
    """One simulator at one slot of an agent, from its Hello on.

    Attributes:
        spec: Of the env that is flown.
        layout: Of the States and Commands.

    Raises:
        InputError: The spec of the Hello is wrong.
    """

    index: int
    """Counts the sessions of the file, from 1."""
    slot: int
    hello: Hello
    """By text a simulator says none, and records one of its own."""
    first: int
    """Time of its first message, nanoseconds since 1970."""
    last: int = 0
    """Time of its last message so far; `states` and `ending` are so far too."""
    states: int = 0
    """Number of them."""
    ending: str = "not closed"
    """Reason of its Close or Refuse."""
    welcome: Welcome | None = None
    _command: Command | None = None
    _sequence: int | None = None  # of the last State

    def __post_init__(self) -> None:
        self.spec = EnvSpec.from_json(self.hello.spec)
        self.layout = layout_of(self.spec, self.hello.worlds)

    @property
    def num_envs(self) -> int:
        """Number of drones."""
        return self.layout.drones

    @property
    def seed(self) -> int:
        """Of the reset before the first State."""
        return self.welcome.first_seed if self.welcome else self.hello.session

    def take(self, message: Message, time: int) -> Command | None:
        """Take the next message: the Command before a State; None for any other."""
        self.last = time
        match message:
            case State():
                return self._take_state(message)
            case Command():
                self._command = message
            case Welcome():
                self.welcome = message
            case Close(reason=reason) if reason:
                self.ending = f"closed: {reason}"
            case Close() if not self.ending.startswith("closed"):
                self.ending = "closed"
            case Refuse(reason=reason):
                self.ending = f"refused: {reason}"
            case Unknown():
                self.ending = "the agent does not know this session"
        return None

    def _take_state(self, message: State) -> Command | None:
        self.states += 1
        before = self._sequence
        self._sequence = message.sequence
        if before is None:
            return reset_of_all(self.layout, first_seeds(self.seed, self.num_envs))
        command = self._command
        if command and before == command.sequence == message.sequence - 1:
            return command
        return None

    def __str__(self) -> str:
        return f"session {self.index} (slot {self.slot}, {self.hello.session:016x})"

    @property
    def summary(self) -> str:
        """What it is, and its counts."""
        began = datetime.fromtimestamp(self.first // 10**9, UTC)
        seconds = (self.last - self.first) / 1e9
        return (
            f"{self}: {count_of(self.num_envs, 'drone')} of {self.spec.env_id}, "
            f"{began:%Y-%m-%d %H:%M:%S} UTC, {seconds:.1f} s, {self.states} States; {self.ending}"
        )


class Item(NamedTuple):
    """A message of the journal."""

    session: Session
    time: int
    """When it was sent or taken, nanoseconds since 1970."""
    message: Message
    datagram: bytes
    """Its binary datagram, not sealed and not cut into fragments."""
    command: Command | None
    """That before a State: before the first of a session a reset of all drones. None: it is missing
    in the journal, or the message is no State."""

    @property
    def begins(self) -> bool:
        """Whether it is the first message of its session."""
        return isinstance(self.message, Hello)


class Recording:
    """The messages of a journal, in the order in which they were written. May be iterated again.

    One that a crash cut off is read up to the cut. Nothing that the file names is imported or made:
    a spec is data.

    Attributes:
        path: The file.
        about: Metadata of its head: side, versions; of a simulator also codec, config and backend.
        complete: Whether the file was finished, and could be read as far as was tried.
        ending: How it ends, in words.

    Raises:
        OSError: The file cannot be read.
        InputError: It is not a journal, or one of another version; while iterating: a message in it
            cannot be read.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.about: dict[str, str] = {}
        with self.path.open("rb") as file:
            head = file.read(len(MCAP0_MAGIC))
            if not MCAP0_MAGIC.startswith(head):
                raise InputError(f"{self.path}: expected an MCAP file, got another")
            file.seek(-len(head), 2)
            self._has_end = self.complete = file.read() == MCAP0_MAGIC
        self.ending = "complete" if self.complete else "cut off before its end"
        for record in self._records():
            if isinstance(record, records.Metadata) and record.name == ABOUT:
                self.about = record.metadata
            elif not isinstance(record, records.Header):
                break
        if self.about.get("format", FORMAT) != FORMAT or (self.complete and not self.about):
            got = self.about.get("format", "another MCAP file")
            raise InputError(
                f"{self.path}: expected a journal of format {FORMAT}, got {shortened(got)}"
            )

    def __iter__(self) -> Iterator[Item]:
        slots: dict[int, int] = {}  # by id of the channel
        sessions: dict[int, Session] = {}
        count = 0
        for record in self._records():
            if isinstance(record, records.Channel):
                if match := _TOPIC.fullmatch(record.topic):
                    slots[record.id] = int(match[1])
            elif isinstance(record, records.Message) and record.channel_id in slots:
                slot = slots[record.channel_id]
                session = sessions.get(slot)
                layout = session.layout if session else None
                try:
                    message = binary.decode(record.data, layout)
                    if isinstance(message, Hello):
                        count += 1
                        session = Session(count, slot, message, record.log_time)
                        sessions[slot] = session
                except (InputError, DecodeError) as error:
                    raise InputError(
                        f"{self.path}: a message that cannot be read: {error}"
                    ) from None
                if session is None or message.session != session.hello.session:
                    raise InputError(
                        f"{self.path}: expected a message of the session of the last Hello, "
                        f"got a {type(message).__name__} of {message.session:016x}"
                    )
                command = session.take(message, record.log_time)
                yield Item(session, record.log_time, message, record.data, command)

    def _records(self) -> Iterator[records.McapRecord]:
        with self.path.open("rb") as file:
            try:
                yield from _read_records(file)
            except OSError:
                raise
            except Exception as error:  # half a record raises anything
                what = f"damaged ({error})" if self._has_end else "cut off"
                self.complete = False
                self.ending = f"{what} at or before byte {file.tell()}"


def _read_records(file: BinaryIO) -> Iterator[records.McapRecord]:
    """The records of an MCAP file, those in chunks too, in order.

    Raises:
        ValueError: A record or a decompressed chunk is larger than `MAX_CHUNK`.
        OSError: The file cannot be read.
        Exception: Any other, of the package `mcap`, where the file is damaged or cut off.
    """
    reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_CHUNK)
    for record in reader.records:
        if not isinstance(record, records.Chunk):
            yield record
            continue
        size = record.uncompressed_size
        if record.compression == "zstd":  # a short chunk can decompress to any number of bytes
            size = max(size, zstandard.frame_content_size(record.data))
        if size > MAX_CHUNK:
            raise ValueError(f"expected chunks of at most {MAX_CHUNK} bytes, got one of {size}")
        yield from breakup_chunk(record, validate_crc=True)


class Summary(Recording):
    """Counts of a journal.

    Attributes:
        sessions: All of them, as they ended.
    """

    def __init__(self, path: Path | str) -> None:
        super().__init__(path)
        self.sessions = [item.session for item in self if item.begins]

    def __str__(self) -> str:
        side = f"written by the {self.about['side']}, " if "side" in self.about else ""
        head = f"{self.path}: {side}{self.ending}, {count_of(len(self.sessions), 'session')}"
        return printable("\n".join([head, *(session.summary for session in self.sessions)]))


def count_of(count: int, what: str) -> str:
    """A number and a noun: 1 session, 2 sessions."""
    return f"1 {what}" if count == 1 else f"{count} {what}s"
