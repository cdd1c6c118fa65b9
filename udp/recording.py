"""Reads a journal, whole or cut off, and tells what is in it."""

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from mcap import records
from mcap.stream_reader import StreamReader

from . import binary
from ._mcap import MAGIC
from .errors import DecodeError
from .journal import ABOUT, FORMAT
from .messages import Close, Command, Hello, Message, Refuse, State, Unknown, Welcome

__all__ = [
    "Flight",
    "Item",
    "Recording",
    "SessionSummary",
    "Summary",
    "count_of",
    "read_journal",
    "summarize",
]

_TOPIC: Final = re.compile(r"/place([0-9]{1,9})/(state|command|events)")
_LARGEST: Final = 1 << 28
"""Bytes of a record. Ours are a thousand times smaller."""


@dataclass(eq=False)
class Flight:
    """A session: what one simulator flew at one place, from its Hello on."""

    index: int
    """Counts the sessions of the file, from 1."""
    place: int
    hello: Hello
    """By text none was said. Then it is what the agent knows, of session 0."""
    codec: str
    """`binary` or `text`."""
    welcome: Welcome | None = None

    @property
    def seed(self) -> int | None:
        """Of the reset before the first State. None if only the simulator knows it."""
        if self.welcome and self.welcome.seed is not None:
            return self.welcome.seed
        return self.hello.session if self.hello.session or self.codec == "binary" else None

    def __str__(self) -> str:
        return f"session {self.index} (place {self.place}, {self.hello.session:016x})"


class Item(NamedTuple):
    """A message of the journal."""

    flight: Flight
    time: int
    """When it was sent or taken, nanoseconds since 1970."""
    message: Message
    datagram: bytes
    """Its binary datagram, not sealed."""


class Recording:
    """The messages of a journal, in the order in which they were written. May be iterated again.

    Attributes:
        path: The file.
        about: What its head says: side, env id, options, versions.
        attachments: Files in its head, by name.
        complete: Whether the file was finished, and all of it could be read, as far as was tried.
        ending: In words what it ends with.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no journal, or one of another version.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.about: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        with self.path.open("rb") as file:
            head = file.read(len(MAGIC))
            if head != MAGIC[: len(head)]:
                raise ValueError(f"{self.path}: expected an MCAP file, got another")
            file.seek(-min(len(MAGIC), os.fstat(file.fileno()).st_size), os.SEEK_END)
            self.complete = file.read() == MAGIC
        self.ending = "complete" if self.complete else "cut off before its end"
        for record in self._records():
            if isinstance(record, records.Metadata) and record.name == ABOUT:
                self.about = record.metadata
            elif isinstance(record, records.Attachment):
                self.attachments[record.name] = record.data
            elif not isinstance(record, records.Header):
                break
        if self.about.get("format", FORMAT) != FORMAT or (self.complete and not self.about):
            raise ValueError(
                f"{self.path}: expected a journal of format {FORMAT}, "
                f"got {self.about.get('format', 'another MCAP file')}"
            )

    def __iter__(self) -> Iterator[Item]:
        places: dict[int, tuple[int, str]] = {}
        flights: dict[int, Flight] = {}
        count = 0
        for record in self._records():
            if isinstance(record, records.Channel):
                if match := _TOPIC.fullmatch(record.topic):
                    places[record.id] = int(match[1]), match[2]
            elif isinstance(record, records.Message) and record.channel_id in places:
                place, kind = places[record.channel_id]
                message, datagram, codec = self._message(kind, record.data)
                if isinstance(message, Hello):
                    count += 1
                    flights[place] = Flight(count, place, message, codec)
                flight = flights.get(place)
                if flight is None or message.session != flight.hello.session:
                    raise ValueError(
                        f"{self.path}: expected a message of the session of the last Hello, "
                        f"got a {type(message).__name__} of {message.session:016x}"
                    )
                if isinstance(message, Welcome):
                    flight.welcome = message
                yield Item(flight, record.log_time, message, datagram)

    def _message(self, kind: str, data: bytes) -> tuple[Message, bytes, str]:
        codec = ""
        try:
            if kind == "events":
                words = json.loads(data)
                data, codec = bytes.fromhex(words["datagram"]), words.get("codec", "")
            return binary.decode(data), data, codec
        except (ValueError, KeyError, TypeError, AttributeError, DecodeError) as error:
            raise ValueError(f"{self.path}: a message that cannot be read: {error}") from None

    def _records(self) -> Iterator[records.McapRecord]:
        with self.path.open("rb") as file:
            reader = StreamReader(file, validate_crcs=True, record_size_limit=_LARGEST)
            all_records = reader.records
            while True:
                try:
                    record = next(all_records)
                except StopIteration:
                    return
                except OSError:
                    raise
                except Exception as error:  # whatever half a record makes of its reader
                    what = f"damaged ({error})" if self.complete else "cut off"
                    self.complete = False
                    self.ending = f"{what} at or before byte {file.tell()}"
                    return
                yield record


def read_journal(path: Path | str) -> Recording:
    """The messages of a journal. One that was cut off, by a crash, is read up to the cut."""
    return Recording(path)


# ---- what is in it


@dataclass(kw_only=True)
class SessionSummary:
    """What happened in one session."""

    flight: Flight
    first: int
    """Time of its first message, nanoseconds since 1970."""
    last: int
    states: int = 0
    steps: int = 0
    """Of all drones together; resets are none."""
    episodes: int = 0
    """Those that ended."""
    returns: float = 0.0
    """Sum over them of the rewards of each."""
    ending: str = "not closed"
    """How it was closed or refused, in words."""

    @property
    def seconds(self) -> float:
        """From its first message to its last."""
        return (self.last - self.first) / 1e9

    def __str__(self) -> str:
        flight, hello = self.flight, self.flight.hello
        drones = "1 drone" if hello.num_drones == 1 else f"{hello.num_drones} drones"
        mean = f", mean return {self.returns / self.episodes:.2f}" if self.episodes else ""
        return (
            f"{flight}: {drones} of {hello.env_id}, {flight.codec}, {_clock(self.first)}, "
            f"{self.seconds:.1f} s, {self.steps} steps, {self.episodes} episodes{mean}; "
            f"{self.ending}"
        )


@dataclass(kw_only=True)
class Summary:
    """What is in a journal."""

    path: Path
    side: str
    """`simulator` or `agent`."""
    complete: bool
    ending: str
    sessions: list[SessionSummary] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """Of all drones of all sessions."""
        return sum(session.steps for session in self.sessions)

    @property
    def episodes(self) -> int:
        """Those that ended, of all sessions."""
        return sum(session.episodes for session in self.sessions)

    @property
    def mean_return(self) -> float | None:
        """Of the episodes that ended; None if none did."""
        total = sum(session.returns for session in self.sessions)
        return total / self.episodes if self.episodes else None

    def __str__(self) -> str:
        side = f"written by the {self.side}, " if self.side else ""
        head = f"{self.path}: {side}{self.ending}, {count_of(len(self.sessions), 'session')}"
        return "\n".join([head, *map(str, self.sessions)])


class _Tally:
    """Counts the steps, episodes and returns of one session."""

    def __init__(self, summary: SessionSummary) -> None:
        self.summary = summary
        self._returns = np.zeros(summary.flight.hello.num_drones)
        self._command: Command | None = None

    def take(self, item: Item) -> None:
        summary, message = self.summary, item.message
        summary.last = item.time
        match message:
            case Command():
                self._command = message
            case State():
                self._take_state(message)
            case Close(reason=reason) if reason:
                summary.ending = f"closed: {reason}"
            case Close() if not summary.ending.startswith("closed"):
                summary.ending = "closed"
            case Refuse(reason=reason):
                summary.ending = f"refused: {reason}"
            case Unknown():
                summary.ending = "the agent does not know this session"

    def _take_state(self, state: State) -> None:
        summary, command = self.summary, self._command
        summary.states += 1
        resets = np.ones(len(state.rewards), bool) if command is None else command.resets
        stepped = ~resets if command is None or command.holds is None else ~resets & ~command.holds
        self._returns[resets] = 0.0
        self._returns += np.where(stepped, state.rewards, 0.0)
        summary.steps += int(stepped.sum())
        ended = (state.terminated | state.truncated) & stepped
        summary.episodes += int(ended.sum())
        summary.returns += float(self._returns[ended].sum())


def summarize(path: Path | str) -> Summary:
    """What is in a journal. Raises `ValueError` if it is none, `OSError` if it cannot be read."""
    recording = read_journal(path)
    tallies: dict[int, _Tally] = {}
    for item in recording:
        if item.flight.index not in tallies:
            summary = SessionSummary(flight=item.flight, first=item.time, last=item.time)
            tallies[item.flight.index] = _Tally(summary)
        tallies[item.flight.index].take(item)
    return Summary(
        path=recording.path,
        side=recording.about.get("side", ""),
        complete=recording.complete,
        ending=recording.ending,
        sessions=[tally.summary for tally in tallies.values()],
    )


def _clock(time: int) -> str:
    return datetime.fromtimestamp(time // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def count_of(count: int, what: str) -> str:
    """So many of something, in words."""
    return f"1 {what}" if count == 1 else f"{count} {what}s"
