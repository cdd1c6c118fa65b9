"""The binary codec: messages to bytes and back, as pure functions. Little-endian throughout.

`docs/protocol.md` has every field of every message at its offset, and what a reader ignores: the
constants and structs below follow it, and `docs/golden.json` has the bytes that both must give.
"""

import struct
import zlib
from math import isfinite
from typing import Any

import numpy as np

from ...models.errors import InputError
from .errors import DecodeError, VersionMismatch
from .layout import Array, Layout, Record
from .messages import (
    MAX_SPEC,
    MAX_TEXT,
    Alive,
    Close,
    Command,
    Extension,
    Hello,
    Message,
    Missing,
    Refuse,
    State,
    Unknown,
    Wait,
    Welcome,
)

Step = State | Command
"""The messages of a control step."""

MAGIC = b"\xa7R"  # not UTF-8, so that no text datagram begins with it
VERSION = 3
HEADER_SIZE = 24

HELLO = 1
REFUSE = 3
STATE = 4
COMMAND = 5
CLOSE = 6
UNKNOWN = 8
ALIVE = 9
MISSING = 10
_MESSAGES = (
    Hello,
    Welcome,
    Refuse,
    State,
    Command,
    Close,
    Wait,
    Unknown,
    Alive,
    Missing,
)
"""In the order of their types, from 1 on."""

FRAGMENT = 0x80  # set in the type of a fragment of a message
_OF_SESSION = frozenset({STATE, COMMAND, CLOSE, ALIVE})
_NUMBERED = _OF_SESSION | {UNKNOWN, MISSING}  # types that have a sequence number

_HEADER = struct.Struct("<2sBBIQQ")
_NUMBERS = struct.Struct("<QQ")  # session, sequence: the end of the header
_HELLO_BODY = struct.Struct("<BB2xII4x")
_WELCOME_BODY = struct.Struct("<QQBB6x")
_REST_AT = 8  # first byte after the checksum
_STATE_HEAD = struct.Struct("<QQdQ")  # session and sequence too
_COMMAND_HEAD = struct.Struct("<QQII")
_MISSING_BODY = struct.Struct("<BxHH")
_EXTENSION = struct.Struct("<HH")
_START = {kind: MAGIC + bytes((VERSION, kind)) for kind in (STATE, COMMAND)}
_START_CRC = {kind: zlib.crc32(start) for kind, start in _START.items()}
_LENGTH = struct.Struct("<H")
_CRITICAL = 1 << 15
_MAX_EXTENSIONS = 64
LONGEST_HELLO = (
    HEADER_SIZE + _HELLO_BODY.size + MAX_SPEC + _MAX_EXTENSIONS * (_EXTENSION.size + MAX_TEXT)
)  # bytes


def encode(message: Message, layout: Layout | None = None) -> bytes:
    """The bytes of a message, whole; a State or a Command needs the layout of its Hello.

    Raises `InputError` if an array is not of the layout, or not finite.
    """
    if isinstance(message, Step):
        assert layout is not None
        return encode_step(message, layout)
    body = b""
    match message:
        case Hello():
            spec = message.spec.encode()
            body = _HELLO_BODY.pack(*message.versions, message.worlds, len(spec)) + spec
            body += _extensions(message.extensions)
        case Welcome(nonce=nonce, seed=seed):
            body = _WELCOME_BODY.pack(nonce, seed or 0, seed is not None, message.version)
            body += _extensions(message.extensions)
        case Refuse() | Close():
            reason = message.reason.encode()
            body = _LENGTH.pack(len(reason)) + reason
        case Missing():
            body = _MISSING_BODY.pack(message.kind, message.count, message.first)
            body += message.bitmap
    kind = _MESSAGES.index(type(message)) + 1
    return frame(kind, message.session, getattr(message, "sequence", 0), body)


def frame(kind: int, session: int, sequence: int, body: bytes) -> bytes:
    """A datagram: header and body."""
    start = MAGIC + bytes((VERSION, kind))
    rest = _NUMBERS.pack(session, sequence) + body
    return start + zlib.crc32(rest, zlib.crc32(start)).to_bytes(4, "little") + rest


def check(datagram: bytes) -> tuple[int, int, int]:
    """Type, session and sequence of a datagram. Raises `DecodeError` for a wrong header."""
    if len(datagram) < HEADER_SIZE:
        raise DecodeError(f"header: expected {HEADER_SIZE} bytes, got {len(datagram)}")
    magic, version, kind, crc, session, sequence = _HEADER.unpack_from(datagram)
    if magic != MAGIC:
        raise DecodeError(f"magic: expected {MAGIC.hex()}, got {magic.hex()}")
    if zlib.crc32(datagram[8:], zlib.crc32(datagram[:4])) != crc:
        raise DecodeError("checksum: the datagram was changed on its way")
    if version != VERSION and kind != REFUSE:
        raise VersionMismatch(f"protocol version: expected {VERSION}, got {version}")
    if sequence and kind & ~FRAGMENT not in _NUMBERED:
        raise DecodeError(f"sequence: expected 0 in type {kind}, got {sequence}")
    return kind, session, sequence


def decode(datagram: bytes, layout: Layout | None = None) -> Message:
    """The message in these bytes, its fragments put together. A State or a Command needs a layout.

    Raises `DecodeError`, and nothing else, for any other bytes.
    """
    kind, session, sequence = check(datagram)
    if not 1 <= kind <= len(_MESSAGES):
        raise DecodeError(f"type: expected 1 to {len(_MESSAGES)}, got {kind}")
    try:
        if kind in (STATE, COMMAND):
            if layout is None:
                raise InputError("expected a Hello before it, got none")
            return _decode_step(kind, datagram, session, sequence, layout)
        return _decode_body(kind, session, sequence, datagram[HEADER_SIZE:])
    except (ValueError, struct.error) as error:
        raise DecodeError(f"{_MESSAGES[kind - 1].__name__.lower()}: {error}") from None


def decode_due(
    kind: int, datagram: bytes, session: int, sequence: int, layout: Layout
) -> Message | None:
    """The message that is waited for, if this datagram is that one and whole.

    The short way of a lock-step: only one header can come, so it is compared, not read. None sends
    any other datagram, and one that is wrong, the way of `decode`, which tells why.
    """
    if datagram[:4] != _START[kind] or datagram[8:24] != _NUMBERS.pack(session, sequence):
        return None
    if zlib.crc32(datagram[8:], _START_CRC[kind]) != int.from_bytes(datagram[4:8], "little"):
        return None
    try:
        return _decode_step(kind, datagram, session, sequence, layout)
    except (ValueError, struct.error):
        return None


def peek(datagram: bytes) -> tuple[int, int, int]:
    """Type (of a fragment its message's), session and sequence that a datagram claims, or zeros."""
    if len(datagram) < HEADER_SIZE or datagram[:2] != MAGIC:
        return 0, 0, 0
    _, _, kind, _, session, sequence = _HEADER.unpack_from(datagram)
    return kind & ~FRAGMENT, session, sequence


def is_of_session(kind: int, sequence: int) -> bool:
    """Whether a message belongs to an open session: a Missing of a Hello does not."""
    return kind in _OF_SESSION or (kind == MISSING and sequence > 0)


# ---- State and Command


def encode_step(m: Step, layout: Layout) -> bytes:
    """The bytes of a State or a Command, whole. Raises `InputError` as `encode`."""
    time = 0.0
    arrays: tuple[Array, ...]
    if isinstance(m, State):
        kind = STATE
        record = layout.state
        time = m.time
        pieces = [_STATE_HEAD.pack(m.session, m.sequence, time, m.nonce)]
        arrays = (*m.observations, m.rewards, m.terminated, m.truncated, *m.telemetry)
    else:
        kind = COMMAND
        has_seeds = m.seeds is not None
        has_asks = m.asks is not None
        record = layout.commands[has_seeds, has_asks]
        drones = layout.drones
        counts = drones * has_seeds, drones * has_asks
        pieces = [_COMMAND_HEAD.pack(m.session, m.sequence, *counts)]
        arrays = (m.actions, m.orders)
        if m.seeds is not None:
            arrays += (m.seeds,)
        if m.asks is not None:
            arrays += (m.asks,)
    for slot, array in zip(record.slots, arrays, strict=True):
        if array.shape != slot.shape or array.dtype != slot.dtype:  # numbers are never converted
            raise InputError(
                f"{type(m).__name__}: expected {slot.dtype.name} of shape {slot.shape}, "
                f"got {array.dtype.name} of shape {array.shape}"
            )
        pieces += (slot.pad, array.tobytes())
    rest = b"".join(pieces)
    data = _START[kind] + zlib.crc32(rest, _START_CRC[kind]).to_bytes(4, "little") + rest
    if wrong := data[record.flags].translate(None, record.legal):
        raise _wrong_flags(wrong, record)
    # NaN and infinity stay in a sum. Huge numbers may overflow, so a second look decides.
    numbers = record.numbers
    if numbers is None or not isfinite(sum(numbers.unpack_from(data, record.slots[0].at), time)):
        _check_numbers(data, time, record, layout)
    return data


def _decode_step(kind: int, data: bytes, session: int, sequence: int, layout: Layout) -> Step:
    time = 0.0
    if kind == STATE:
        record = layout.state
        _, _, time, nonce = _STATE_HEAD.unpack_from(data, _REST_AT)
    else:
        _, _, *counts = _COMMAND_HEAD.unpack_from(data, _REST_AT)
        if not {0, layout.drones}.issuperset(counts):
            raise InputError(f"seeds, requests: expected 0 or {layout.drones}, got {counts}")
        has_seeds, has_asks = map(bool, counts)
        record = layout.commands[has_seeds, has_asks]
    if len(data) != record.size:
        raise InputError(f"expected {record.size} bytes, got {len(data)}")
    if wrong := data[record.flags].translate(None, record.legal):
        raise _wrong_flags(wrong, record)
    numbers = record.numbers
    if numbers is None or not isfinite(sum(numbers.unpack_from(data, record.slots[0].at), time)):
        _check_numbers(data, time, record, layout)
    arrays = []
    for slot in record.slots:
        arrays.append(np.ndarray(slot.shape, slot.dtype, data, slot.at))
    if kind == COMMAND:
        actions, orders, *optional = arrays
        return Command(
            session=session,
            sequence=sequence,
            actions=actions,
            orders=orders,
            seeds=optional[0] if has_seeds else None,
            asks=optional[-1] if has_asks else None,
        )
    first = len(layout.observation)
    return State(
        session=session,
        sequence=sequence,
        time=time,
        nonce=nonce,
        observations=tuple(arrays[:first]),
        rewards=arrays[first],
        terminated=arrays[first + 1],
        truncated=arrays[first + 2],
        telemetry=tuple(arrays[first + 3 :]),
    )


def _check_numbers(data: bytes, time: float, record: Record, layout: Layout) -> None:
    """Raises `InputError` for numbers that are not finite, or a choice or a request that does not
    exist.
    """
    if not isfinite(time):
        raise InputError(f"time: expected a finite number, got {time}")
    for slot in record.slots:
        if slot.dtype.kind != "f":
            continue
        array = slot.view(data)
        finite = np.isfinite(array)
        if not finite.all():
            first = np.argwhere(~finite)[0].tolist()
            what = "observation, reward, telemetry" if record is layout.state else "action"
            raise InputError(f"{what}: expected finite numbers, got {array[*first]} at {first}")
    if layout.choices and record is not layout.state:
        actions = layout.actions.view(data)
        beyond = (actions < 0) | (actions >= layout.choices)
        if beyond.any():
            most = layout.choices - 1
            raise InputError(f"action: expected a choice 0 to {most}, got {actions[beyond][0]}")
    if record.asks is not None:
        offered = layout.asked_bits
        unknown = record.asks.view(data) & ~np.uint64(offered)
        if unknown.any():
            raise InputError(f"requests: expected bits of {offered:#x}, got {unknown.max():#x}")


def _wrong_flags(wrong: bytes, record: Record) -> InputError:
    return InputError(f"flags: expected 0 to {record.legal[-1]}, got {wrong[0]}")


# ---- the bodies of all others


def _decode_body(kind: int, session: int, sequence: int, body: bytes) -> Message:
    fields: dict[str, Any] = {"session": session}
    if kind in _NUMBERED:
        fields["sequence"] = sequence
    message = _MESSAGES[kind - 1]
    if message is Hello:
        low, high, fields["worlds"], size = _HELLO_BODY.unpack_from(body)
        fields["versions"] = low, high
        at = _HELLO_BODY.size
        most = min(MAX_SPEC, len(body) - at)
        if size > most:
            raise InputError(f"spec: expected at most {most} bytes, got {size}")
        fields["spec"] = body[at : at + size].decode()
        fields["extensions"] = _take_extensions(body, at + size)
    elif message is Welcome:
        fields["nonce"], seed, has_seed, fields["version"] = _WELCOME_BODY.unpack_from(body)
        if has_seed > 1:
            raise InputError(f"has seed: expected 0 or 1, got {has_seed}")
        fields["seed"] = seed if has_seed else None
        fields["extensions"] = _take_extensions(body, _WELCOME_BODY.size)
    elif message is Missing:
        fields["kind"], fields["count"], fields["first"] = _MISSING_BODY.unpack_from(body)
        fields["bitmap"] = body[_MISSING_BODY.size :]
    elif message in (Refuse, Close):
        (size,) = _LENGTH.unpack_from(body)
        reason = body[_LENGTH.size :]
        if len(reason) != size:
            raise InputError(f"reason: expected {size} bytes, got {len(reason)}")
        fields["reason"] = reason.decode()
    elif body:
        raise InputError(f"expected no bytes, got {len(body)}")
    return message(**fields)


def _extensions(extensions: tuple[Extension, ...]) -> bytes:
    data = b""
    for each in extensions:
        number = each.number | (_CRITICAL if each.critical else 0)
        data += _EXTENSION.pack(number, len(each.value)) + each.value
    return data


def _take_extensions(data: bytes, at: int) -> tuple[Extension, ...]:
    extensions: list[Extension] = []
    while at < len(data):
        if len(extensions) == _MAX_EXTENSIONS:
            raise InputError(f"extensions: expected at most {_MAX_EXTENSIONS}, got more")
        number, size = _EXTENSION.unpack_from(data, at)
        at += _EXTENSION.size
        value = data[at : at + size]
        if len(value) < size or size > MAX_TEXT:
            raise InputError(
                f"extension: expected at most {MAX_TEXT} bytes, all {size} of them, "
                f"got {len(value)}"
            )
        extensions.append(Extension(number & ~_CRITICAL, value, bool(number & _CRITICAL)))
        at += size
    return tuple(extensions)
