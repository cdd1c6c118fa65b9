"""The journal of a flight: every message once, in an MCAP file. See `docs/journal.md`.

A State or a Command is written as the binary datagram that carries it, for that is a valid ROS 1
message of arrays whose lengths the schema fixes: any viewer of MCAP reads it. All else is JSON
with the datagram in it as hexadecimal digits.
"""

import json
import logging
import platform
import time
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from ..envs import ENV_ID
from ..models import QUAD_XML, SCENE_XML
from . import binary
from ._mcap import McapFile
from ._schemas import EVENT, NUMBERS, command_schema, state_schema
from .fleet import Fleet
from .interface import Interface
from .messages import Close, Command, Hello, Message, Refuse, State, Welcome
from .statistics import Statistics

__all__ = ["ABOUT", "FORMAT", "MODEL", "Journal", "of_agent", "of_simulator", "software"]

ABOUT: Final = "rotorgram"
"""Name of the metadata about the whole file; those of each session are named `session`."""
FORMAT: Final = "1"
"""Of what is in the file, beside the protocol's version in each datagram."""
MODEL: Final = "model.xml"
"""Name of the attachment that is the whole model of the simulator."""

_CHUNK: Final = 1 << 16  # bytes; 2 ms to write
_SECOND: Final = 10**9
_STATISTICS: Final = 10 * _SECOND
_COMMAND: Final = 5
_ONE: Final = object()
_PACKAGES: Final = ("rotorgram", "mujoco", "gymnasium", "numpy", "mcap")

_log: Final = logging.getLogger("rotorgram.udp")


class Journal:
    """Writes what the tap of a link sees. A flight goes on when its journal cannot.

    At most one second of it is in memory only. The file is complete after `close`, and when the
    journal is garbage-collected or the program ends; without that it can be read up to its end.

    Args:
        path: The file; it must not exist.
        about: What is known before any simulator has come, by name.
        attachments: XML files to keep, by name.
        text_hello: What a simulator says that has no Hello, since it speaks text.
    """

    def __init__(
        self,
        path: Path | str,
        *,
        about: Mapping[str, str],
        attachments: Mapping[str, str],
        text_hello: Hello | None = None,
    ) -> None:
        self._path = Path(path)
        self._about = about
        self._attachments = attachments
        self._text_hello = text_hello
        self._seats: Sequence[object] = ()
        self._seated: dict[int, object] = {}
        self._schemas: dict[str, dict[str, int]] = {}
        self._topics: dict[tuple[str, int], int] = {}
        self._channels: dict[tuple[int, int], int] = {}
        """Channel by place and type of the message: 4 State, 5 Command."""
        self._size = self._sessions = 0
        self._open = False

    def start(self, statistics: Statistics, seats: Sequence[object] = ()) -> None:
        """Make the file. Nothing is written before.

        Args:
            statistics: Those of the link. They are written every 10 s, and at the end.
            seats: Who has which place of an agent: somebody else is another session. Only text
                needs it, where all sessions have the same number.

        Raises:
            FileExistsError: The file is there already.
            OSError: It cannot be written.
        """
        now = self._flushed = self._counted = time.time_ns()
        library = f"rotorgram {self._about.get('version of rotorgram', '')}"
        try:
            file = McapFile(self._path, library)
        except FileExistsError:
            raise FileExistsError(
                f"record: expected a file that does not exist yet, got {self._path}"
            ) from None
        try:
            file.add_metadata(ABOUT, {"format": FORMAT, **self._about})
            for name, text in self._attachments.items():
                file.add_attachment(name, "application/xml", text.encode(), now)
        except BaseException:
            file.abandon()
            self._path.unlink()
            raise
        self._file, self._pending = file, file.pending
        self._statistics, self._seats = statistics, seats
        self._finalizer = weakref.finalize(self, _finish, file, self._path)
        self._open = True

    def tap(self, place: int, message: Message, datagram: bytes) -> None:
        """Take note of a message. See `link.Tap`. What it costs to write it is paid in `write`."""
        now = time.time_ns()
        if not self._open:
            return
        try:
            if isinstance(message, State | Command):
                channel = self._channels.get((place, datagram[3]))
                if channel is None or not message.session:
                    channel = self._text_channel(place, message, datagram, now)
                self._pending.append((channel, now, message.sequence, datagram))
            else:
                self._tell(place, message, datagram, now)
            self._size += len(datagram)
            if self._size > 4 * _CHUNK:  # nobody calls `write`
                self._flush(now)
        except OSError as error:
            self._give_up(error)

    def write(self) -> None:
        """Write what there is. To be called when there is time: while the other side is at work."""
        if not self._open:
            return
        now = time.time_ns()
        try:
            self._file.encode()
            # Clocks are set back at times.
            if self._size > _CHUNK or not 0 <= now - self._flushed < _SECOND:
                self._flush(now)
        except OSError as error:
            self._give_up(error)

    def close(self) -> None:
        """Write all, and finish the file. May be called again."""
        if not self._open:
            return
        try:
            self._count(time.time_ns())
        except OSError as error:
            self._give_up(error)
        self._open = False
        _finish(self._file, self._path)
        self._finalizer.detach()  # not before: Ctrl-C may have come in between

    def _flush(self, now: int) -> None:
        if not 0 <= now - self._counted < _STATISTICS:
            self._count(now)
        self._file.flush()
        self._size, self._flushed = 0, now

    def _give_up(self, error: OSError) -> None:
        self._open = False
        _abandon(self._file, self._path, error)
        self._finalizer.detach()  # not before: Ctrl-C may have come in between

    # ---- what is not a State or a Command

    def _tell(self, place: int, message: Message, datagram: bytes, now: int) -> None:
        if isinstance(message, Hello):
            self._begin(place, message, "binary", now)
        self._add_json(f"/place{place}/events", EVENT, _words(message, datagram), now)

    def _text_channel(self, place: int, message: State | Command, datagram: bytes, now: int) -> int:
        """Channel of a message by text. A State of somebody new begins a session."""
        key = place, datagram[3]
        hello = self._text_hello
        if hello and self._seat(place) is not self._seated.get(place):
            self._begin(place, hello, "text", now)
            words = _words(hello, binary.encode(hello)) | {"codec": "text"}
            self._add_json(f"/place{place}/events", EVENT, words, now)
        return self._channels[key]

    def _begin(self, place: int, hello: Hello, codec: str, now: int) -> None:
        """Take note of a new session, whose messages may have other sizes."""
        self._flush(now)
        self._seated[place] = self._seat(place)
        self._sessions += 1
        words = {
            "index": str(self._sessions),
            "place": str(place),
            "session": f"{hello.session:016x}",
            "codec": codec,
            "env_id": hello.env_id,
            "options": hello.options,
            "drones": str(hello.num_drones),
            "control_period": repr(hello.control_period),
            "model_hash": hello.model_hash,
            "telemetry": ",".join(hello.telemetry_names),
        }
        self._file.add_metadata("session", words)
        for kind, name, text in (
            (binary.STATE, "State", state_schema(hello)),
            (_COMMAND, "Command", command_schema(hello)),
        ):
            schema = self._schema(f"rotorgram/{name}", "ros1msg", text)
            topic = f"/place{place}/{name.lower()}"
            self._channels[place, kind] = self._topic(topic, "ros1", schema)

    def _seat(self, place: int) -> object:
        """Who has that place; nobody else ever has a simulator's."""
        return self._seats[place] if self._seats else _ONE

    def _count(self, now: int) -> None:
        self._counted = now
        self._add_json("/statistics", NUMBERS, self._statistics.numbers(), now)

    def _add_json(
        self, topic: str, schema: tuple[str, str], words: Mapping[str, Any], now: int
    ) -> None:
        name, text = schema
        channel = self._topic(topic, "json", self._schema(name, "jsonschema", text))
        self._pending.append((channel, now, 0, json.dumps(words).encode()))

    def _schema(self, name: str, encoding: str, text: str) -> int:
        """Id of a schema. A second one of the same name, of other sizes, is numbered."""
        known = self._schemas.setdefault(name, {})
        if text not in known:
            number = f"{len(known) + 1}" if known else ""
            known[text] = self._file.add_schema(name + number, encoding, text)
        return known[text]

    def _topic(self, topic: str, encoding: str, schema: int) -> int:
        if (topic, schema) not in self._topics:
            self._topics[topic, schema] = self._file.add_channel(topic, encoding, schema)
        return self._topics[topic, schema]


def of_simulator(path: Path | str, fleet: Fleet, options: Mapping[str, Any]) -> Journal:
    """A journal of the simulator that flies these drones, with the whole model."""
    about = _about("simulator", fleet.hello.env_id, options)
    model = _model_of(fleet)
    attachments = {MODEL: model} if model else {}
    return Journal(path, about=about, attachments=attachments, text_hello=fleet.hello)


def of_agent(
    path: Path | str, env_id: str, options: Mapping[str, Any], interface: Interface
) -> Journal:
    """A journal of the agent that flies this env, with the files of the model if it is ours."""
    ours = (QUAD_XML, SCENE_XML) if env_id == ENV_ID else ()
    return Journal(
        path,
        about=_about("agent", env_id, options),
        attachments={file.name: file.read_text("utf-8") for file in ours},
        text_hello=_hello(env_id, interface),
    )


def software() -> dict[str, str]:
    """Versions of what the numbers depend on, and the machine."""
    versions = {"python": platform.python_version(), "machine": platform.machine()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def _words(message: Message, datagram: bytes) -> dict[str, Any]:
    """A message for readers, and its datagram for programs."""
    words: dict[str, Any] = {"type": type(message).__name__, "session": f"{message.session:016x}"}
    match message:
        case Hello():
            words |= {
                "codec": "binary",
                "env_id": message.env_id,
                "drones": message.num_drones,
                "control_period": message.control_period,
                "model_hash": message.model_hash,
                "telemetry": message.telemetry_names,
                "options": message.options,
            }
        case Welcome(seed=seed):
            words["seed"] = None if seed is None else str(seed)
        case Close(sequence=sequence, reason=reason):
            words |= {"sequence": sequence, "reason": reason}
        case Refuse(reason=reason):
            words["reason"] = reason
    return words | {"datagram": datagram.hex()}


def _about(side: str, env_id: str, options: Mapping[str, Any]) -> dict[str, str]:
    versions = {f"version of {name}": number for name, number in software().items()}
    given = json.dumps(dict(options), default=str)
    return {"side": side, "env_id": env_id, "options": given, **versions}


def _model_of(fleet: Fleet) -> str:
    """The whole MJCF of the first env, its includes resolved; "" if it has none."""
    if fleet.hello.env_id == ENV_ID:
        from ..models.loading import model_xml

        return model_xml()
    # As the envs of Gymnasium have it. What MuJoCo saves by itself is the last model loaded.
    path = getattr(fleet.env.unwrapped, "fullpath", None)
    if not isinstance(path, str):
        return ""
    try:
        import mujoco

        return str(mujoco.MjSpec.from_file(path).to_xml())
    except (ImportError, ValueError, OSError):
        return ""


def _hello(env_id: str, interface: Interface) -> Hello:
    """What a simulator by text would say, as far as its agent knows."""
    action = interface.action
    if isinstance(action, spaces.Discrete):
        low, high, discrete = np.zeros(1), np.array([action.n - 1]), int(action.n)
    else:
        assert isinstance(action, spaces.Box)
        low, high, discrete = action.low, action.high, 0
    return Hello(
        session=0,
        env_id=env_id,
        num_drones=1,
        observation_low=interface.observation.low,
        observation_high=interface.observation.high,
        action_low=low.astype(np.float32),
        action_high=high.astype(np.float32),
        discrete_actions=discrete,
        control_period=interface.control_period,
        model_hash="0" * 32,
        telemetry_names=interface.telemetry,
        options=interface.options,
    )


def _finish(file: McapFile, path: Path) -> None:
    """Finish a file, be it when its program ends."""
    try:
        file.finish()
    except OSError as error:
        _abandon(file, path, error)


def _abandon(file: McapFile, path: Path, error: OSError) -> None:
    _log.warning(
        "record: writing %s failed (%s): the flight goes on, its journal ends here",
        path,
        error.strerror or error,
    )
    with suppress(OSError):  # as much as was written can be read
        file.abandon()
