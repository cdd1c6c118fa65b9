"""The binary codec: messages to bytes and back, as pure functions. Little-endian throughout.

`docs/protocol.md` has every field of every message at its offset, and what a reader ignores: the
constants and structs below follow it, and `tests/golden.py` writes the bytes that both must give.
"""

import struct
import zlib
from collections.abc import Callable, Iterable
from math import isfinite
from typing import Any, Final

import numpy as np

from ...models.errors import InputError
from . import messages
from .errors import DecodeError, VersionMismatch
from .layout import COMMAND_ARRAYS_AT, MAX_MESSAGE, Layout, Slot
from .messages import MAX_SPEC, MAX_TEXT, Command, Extension, Message, State

MAGIC: Final = b"\xa7R"  # not UTF-8, so that no text datagram begins with it
VERSION: Final = 2
HEADER_SIZE: Final = 24

HELLO: Final = 1
_WELCOME: Final = 2
REFUSE: Final = 3
STATE: Final = 4
COMMAND: Final = 5
CLOSE: Final = 6
_WAIT: Final = 7
UNKNOWN: Final = 8
ALIVE: Final = 9
MISSING: Final = 10

FRAGMENT: Final = 0x80  # set in the type of a fragment of a message
OF_SESSION: Final = frozenset({STATE, COMMAND, CLOSE, ALIVE})
"""Types that belong to an open session, as Missing does but for that of a Hello."""

_NUMBERED: Final = OF_SESSION | {UNKNOWN, MISSING}  # types that have a sequence number

_HEADER: Final = struct.Struct("<2sBBIQQ")
_NUMBERS: Final = struct.Struct("<QQ")  # session, sequence: the end of the header
_HELLO_BODY: Final = struct.Struct("<BB2xII4x")
_WELCOME_BODY: Final = struct.Struct("<QQBB6x")
_STATE_BODY: Final = struct.Struct("<dQ")
_STATE_HEAD: Final = struct.Struct("<QQdQ")  # numbers and body
_COMMAND_BODY: Final = struct.Struct("<I4x")
_COMMAND_HEAD: Final = struct.Struct("<QQI4x")  # numbers and body
_MISSING_BODY: Final = struct.Struct("<BxHH")
_EXTENSION: Final = struct.Struct("<HH")
_LENGTH: Final = struct.Struct("<H")
_CRITICAL: Final = 1 << 15
_MAX_EXTENSIONS: Final = 64
LONGEST_HELLO: Final = (
    HEADER_SIZE + _HELLO_BODY.size + MAX_SPEC + _MAX_EXTENSIONS * (_EXTENSION.size + MAX_TEXT)
)  # bytes


def encode(message: Message, layout: Layout | None = None) -> bytes:
    """The bytes of a message, whole; a State or a Command needs the layout of its Hello.

    Raises `InputError` if a number, an array or the whole does not fit.
    """
    if isinstance(message, State):
        return encode_state(message, _expect(layout))
    if isinstance(message, Command):
        return encode_command(message, _expect(layout))
    name = type(message).__name__
    kind, encoder = _ENCODERS[type(message)]
    try:
        data = frame(kind, message.session, getattr(message, "sequence", 0), encoder(message))
    except struct.error as error:
        raise InputError(f"{name}: {error}") from None
    if len(data) > MAX_MESSAGE:
        raise InputError(f"{name}: expected at most {MAX_MESSAGE} bytes, got {len(data)}")
    return data


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
    if kind not in _MESSAGES:
        raise DecodeError(f"type: expected 1 to {len(_MESSAGES)}, got {kind}")
    message, _, decoder = _MESSAGES[kind]
    try:
        if kind in _DUE:
            return _DUE[kind][2](datagram, session, sequence, _expect(layout))
        numbers: dict[str, Any] = {"sequence": sequence} if kind in _NUMBERED else {}
        return message(session=session, **numbers, **decoder(datagram[HEADER_SIZE:]))
    except (ValueError, struct.error) as error:
        raise DecodeError(f"{message.__name__.lower()}: {error}") from None


def decode_due(
    kind: int, datagram: bytes, session: int, sequence: int, layout: Layout
) -> Message | None:
    """The message that is waited for, if this datagram is that one and whole.

    The short way of a lock-step: only one header can come, so it is compared, not read. None sends
    any other datagram, and one that is wrong, the way of `decode`, which tells why.
    """
    start, crc, decoder = _DUE[kind]
    if datagram[:4] != start or datagram[8:24] != _NUMBERS.pack(session, sequence):
        return None
    if zlib.crc32(datagram[8:], crc) != int.from_bytes(datagram[4:8], "little"):
        return None
    try:
        return decoder(datagram, session, sequence, layout)
    except (ValueError, struct.error):
        return None


def peek(datagram: bytes) -> tuple[int, int, int]:
    """Type (of a fragment its message's), session and sequence that a datagram claims, or zeros."""
    if len(datagram) < HEADER_SIZE or datagram[:2] != MAGIC:
        return 0, 0, 0
    _, _, kind, _, session, sequence = _HEADER.unpack_from(datagram)
    return kind & ~FRAGMENT, session, sequence


# ---- State and Command


def encode_state(m: State, layout: Layout) -> bytes:
    """The bytes of a State, whole. Raises `InputError` as `encode`."""
    slots = layout.state_slots
    arrays = (*m.observations, m.rewards, m.terminated, m.truncated, *m.telemetry)
    if len(arrays) != len(slots):
        raise InputError(f"State: expected {len(slots)} arrays, got {len(arrays)}")
    try:
        pieces = [_STATE_HEAD.pack(m.session, m.sequence, m.time, m.nonce)]
    except struct.error as error:
        raise InputError(f"State: {error}") from None
    for (shape, dtype, _, pad), array in zip(slots, arrays, strict=True):
        if array.shape != shape or (array.dtype is not dtype and array.dtype != dtype):
            raise _misfit("State", shape, dtype, array)
        pieces += (pad, array.tobytes())
    rest = b"".join(pieces)
    numbers = layout.state_numbers
    # NaN and infinity stay in a sum. Huge numbers may overflow, so a second look decides.
    if numbers is None or not isfinite(sum(numbers.unpack_from(rest, _BODY_AT))):
        _expect_finite_state(_START + rest, m.time, layout)
    crc = zlib.crc32(rest, _STATE_CRC)
    return _STATE_START + crc.to_bytes(4, "little") + rest


def _decode_state(data: bytes, session: int, sequence: int, layout: Layout) -> State:
    if len(data) != layout.state_size:
        raise _wrong_size(data, layout.state_size)
    time, nonce = _STATE_BODY.unpack_from(data, HEADER_SIZE)
    numbers = layout.state_numbers
    if numbers is None or not isfinite(sum(numbers.unpack_from(data, HEADER_SIZE))):
        _expect_finite_state(data, time, layout)
    terminated, truncated = layout.flags
    if wrong := data[terminated.at : truncated.end].translate(None, b"\0\1"):
        raise _wrong_flags(wrong, 1)
    arrays = []
    for shape, dtype, at, _ in layout.state_slots:
        arrays.append(np.ndarray(shape, dtype, data, at))
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


def encode_command(m: Command, layout: Layout) -> bytes:
    """The bytes of a Command, whole. Raises `InputError` as `encode`."""
    arrays = [(layout.actions, m.actions), (layout.orders, m.orders)]
    count = 0
    if m.seeds is not None:
        arrays.append((layout.seeds, m.seeds))
        count = layout.drones
    try:
        pieces = [_COMMAND_HEAD.pack(m.session, m.sequence, count)]
    except struct.error as error:
        raise InputError(f"Command: {error}") from None
    end = COMMAND_ARRAYS_AT
    for slot, array in arrays:
        if array.shape != slot.shape or array.dtype != slot.dtype:  # numbers are never converted
            raise _misfit("Command", slot.shape, slot.dtype, array)
        pieces += (bytes(slot.at - end), array.tobytes())
        end = slot.end
    rest = b"".join(pieces)
    flags = m.orders.tobytes().translate(None, b"\0\1\2")
    if flags:
        raise _wrong_flags(flags, 2)
    quick = layout.command_numbers
    if quick is None or not isfinite(sum(quick.unpack_from(rest, _ACTIONS_AT))):
        _check_actions(_START + rest, layout)
    crc = zlib.crc32(rest, _COMMAND_CRC)
    return _COMMAND_START + crc.to_bytes(4, "little") + rest


def _decode_command(data: bytes, session: int, sequence: int, layout: Layout) -> Command:
    (count,) = _COMMAND_BODY.unpack_from(data, HEADER_SIZE)
    if count not in (0, layout.drones):
        raise InputError(f"seeds: expected 0 or {layout.drones}, got {count}")
    slots = [layout.actions, layout.orders, layout.seeds][: 3 if count else 2]
    if len(data) != slots[-1].end:
        raise _wrong_size(data, slots[-1].end)
    orders = layout.orders
    flags = data[orders.at : orders.end].translate(None, b"\0\1\2")
    if flags:
        raise _wrong_flags(flags, 2)
    quick = layout.command_numbers
    if quick is None or not isfinite(sum(quick.unpack_from(data, COMMAND_ARRAYS_AT))):
        _check_actions(data, layout)
    arrays = []
    for slot in slots:
        arrays.append(np.ndarray(slot.shape, slot.dtype, data, slot.at))
    return Command(
        session=session,
        sequence=sequence,
        actions=arrays[0],
        orders=arrays[1],
        seeds=arrays[2] if count else None,
    )


def _check_actions(data: bytes, layout: Layout) -> None:
    """Raises `InputError` for a choice that does not exist, or numbers that are not finite."""
    actions = layout.actions
    if not layout.choices:
        _expect_finite("action", data, (actions,))
        return
    numbers = actions.view(data)
    beyond = (numbers < 0) | (numbers >= layout.choices)
    if beyond.any():
        most = layout.choices - 1
        raise InputError(f"action: expected a choice 0 to {most}, got {numbers[beyond][0]}")


def _misfit(what: str, shape: tuple[int, ...], dtype: np.dtype, array: np.ndarray) -> InputError:
    return InputError(
        f"{what}: expected {dtype.name} of shape {shape}, "
        f"got {array.dtype.name} of shape {array.shape}"
    )


def _expect_finite_state(data: bytes, time: float, layout: Layout) -> None:
    if not isfinite(time):
        raise InputError(f"time: expected a finite number, got {time}")
    _expect_finite("observation, reward, telemetry", data, layout.state_floats)


def _expect_finite(what: str, data: bytes, slots: Iterable[Slot]) -> None:
    for slot in slots:
        array = slot.view(data)
        finite = np.isfinite(array)
        if not finite.all():
            first = np.argwhere(~finite)[0].tolist()
            raise InputError(f"{what}: expected finite numbers, got {array[*first]} at {first}")


def _expect(layout: Layout | None) -> Layout:
    if layout is None:
        raise InputError("expected a Hello before it, got none")
    return layout


def _wrong_size(data: bytes, size: int) -> InputError:
    return InputError(f"expected {size} bytes, got {len(data)}")


def _wrong_flags(wrong: bytes, most: int) -> InputError:
    return InputError(f"flags: expected 0 to {most}, got {wrong[0]}")


# ---- all others: the body of a message, and its fields


def _encode_hello(m: messages.Hello) -> bytes:
    spec = m.spec.encode()
    return _HELLO_BODY.pack(*m.versions, m.worlds, len(spec)) + spec + _extensions(m.extensions)


def _decode_hello(body: bytes) -> dict[str, Any]:
    low, high, worlds, size = _HELLO_BODY.unpack_from(body)
    at = _HELLO_BODY.size
    most = min(MAX_SPEC, len(body) - at)
    if not size <= most:
        raise InputError(f"spec: expected at most {most} bytes, got {size}")
    spec = body[at : at + size].decode()
    extensions = _take_extensions(body, at + size)
    return {"spec": spec, "worlds": worlds, "versions": (low, high), "extensions": extensions}


def _encode_welcome(m: messages.Welcome) -> bytes:
    body = _WELCOME_BODY.pack(m.nonce, m.seed or 0, m.seed is not None, m.version)
    return body + _extensions(m.extensions)


def _decode_welcome(body: bytes) -> dict[str, Any]:
    nonce, seed, has_seed, version = _WELCOME_BODY.unpack_from(body)
    if not has_seed <= 1:
        raise InputError(f"has seed: expected 0 or 1, got {has_seed}")
    extensions = _take_extensions(body, _WELCOME_BODY.size)
    seed = seed if has_seed else None
    return {"nonce": nonce, "version": version, "seed": seed, "extensions": extensions}


def _encode_nothing(m: messages.Wait | messages.Unknown | messages.Alive) -> bytes:
    return b""


def _decode_nothing(body: bytes) -> dict[str, Any]:
    if body:
        raise _wrong_size(body, 0)
    return {}


def _encode_missing(m: messages.Missing) -> bytes:
    return _MISSING_BODY.pack(m.kind, m.count, m.first) + m.bitmap


def _decode_missing(body: bytes) -> dict[str, Any]:
    kind, count, first = _MISSING_BODY.unpack_from(body)
    bitmap = body[_MISSING_BODY.size :]
    return {"kind": kind, "count": count, "first": first, "bitmap": bitmap}


def _encode_reason(m: messages.Refuse | messages.Close) -> bytes:
    raw = m.reason.encode()
    return _LENGTH.pack(len(raw)) + raw


def _decode_reason(body: bytes) -> dict[str, Any]:
    (size,) = _LENGTH.unpack_from(body)
    if not size <= MAX_TEXT:
        raise InputError(f"reason: expected at most {MAX_TEXT} bytes, got {size}")
    if len(body) != _LENGTH.size + size:
        raise _wrong_size(body, _LENGTH.size + size)
    return {"reason": body[_LENGTH.size :].decode()}


def _extensions(extensions: tuple[Extension, ...]) -> bytes:
    return b"".join(
        _EXTENSION.pack(e.number | (_CRITICAL if e.critical else 0), len(e.value)) + e.value
        for e in extensions
    )


def _take_extensions(data: bytes, at: int) -> tuple[Extension, ...]:
    extensions: list[Extension] = []
    while at < len(data):
        if not len(extensions) < _MAX_EXTENSIONS:
            raise InputError(f"extensions: expected at most {_MAX_EXTENSIONS}, got more")
        number, size = _EXTENSION.unpack_from(data, at)
        at += _EXTENSION.size
        if not size <= len(data) - at:
            raise InputError(f"extension: expected {size} bytes, got {len(data) - at}")
        critical = bool(number & _CRITICAL)
        value = data[at : at + size]
        extensions.append(Extension(number=number & ~_CRITICAL, value=value, critical=critical))
        at += size
    return tuple(extensions)


_MESSAGES: Final[dict[int, tuple[type[Message], Callable[..., bytes], Callable[..., Any]]]] = {
    HELLO: (messages.Hello, _encode_hello, _decode_hello),
    _WELCOME: (messages.Welcome, _encode_welcome, _decode_welcome),
    REFUSE: (messages.Refuse, _encode_reason, _decode_reason),
    STATE: (State, encode_state, _decode_state),
    COMMAND: (Command, encode_command, _decode_command),
    CLOSE: (messages.Close, _encode_reason, _decode_reason),
    _WAIT: (messages.Wait, _encode_nothing, _decode_nothing),
    UNKNOWN: (messages.Unknown, _encode_nothing, _decode_nothing),
    ALIVE: (messages.Alive, _encode_nothing, _decode_nothing),
    MISSING: (messages.Missing, _encode_missing, _decode_missing),
}

_ENCODERS: Final = {message: (kind, encoder) for kind, (message, encoder, _) in _MESSAGES.items()}

# The start and body position of the two messages of a step; the CRC-32 goes on from the start's.
_STATE_START: Final = MAGIC + bytes((VERSION, STATE))
_COMMAND_START: Final = MAGIC + bytes((VERSION, COMMAND))
_STATE_CRC: Final = zlib.crc32(_STATE_START)
_COMMAND_CRC: Final = zlib.crc32(_COMMAND_START)
_START: Final = bytes(8)  # in the place of a start, for a look at arrays by their offset
_BODY_AT: Final = HEADER_SIZE - len(_START)
_ACTIONS_AT: Final = COMMAND_ARRAYS_AT - len(_START)

_DUE: Final[dict[int, tuple[bytes, int, Callable[..., State | Command]]]] = {
    STATE: (_STATE_START, _STATE_CRC, _decode_state),
    COMMAND: (_COMMAND_START, _COMMAND_CRC, _decode_command),
}
