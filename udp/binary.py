"""The binary codec: messages to datagrams and back, as pure functions.

Little-endian throughout. Every datagram begins with 24 bytes: magic, version, type, CRC-32,
session, sequence. Arrays follow with the widest numbers first, so that each lies aligned.
`docs/protocol.md` has the byte tables.
"""

import struct
import zlib
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from .errors import DecodeError, VersionMismatch
from .keys import OVERHEAD
from .messages import (
    MAX_TEXT,
    Close,
    Command,
    Hello,
    Message,
    Refuse,
    State,
    Unknown,
    Wait,
    Welcome,
)

__all__ = [
    "COMMAND",
    "HEADER_SIZE",
    "HELLO",
    "MAGIC",
    "MAX_DATAGRAM",
    "MAX_MESSAGE",
    "MAX_WHOLE",
    "OF_SESSION",
    "PART",
    "STATE",
    "UNKNOWN",
    "VERSION",
    "check",
    "command_size",
    "decode",
    "encode",
    "frame",
    "peek",
    "state_size",
]

MAGIC: Final = b"\xa7R"
"""Not UTF-8, so that no text datagram begins with it."""
VERSION: Final = 2
MAX_DATAGRAM: Final = 65507
"""Largest payload of a UDP datagram over IPv4, bytes."""
MAX_MESSAGE: Final = MAX_DATAGRAM - OVERHEAD
"""Largest message in one datagram, bytes: room is left for the envelope of `keys`."""
MAX_WHOLE: Final = 1 << 24
"""Largest State or Command in all its parts, bytes."""
HEADER_SIZE: Final = 24

HELLO: Final = 1
STATE: Final = 4
COMMAND: Final = 5
UNKNOWN: Final = 8
_REFUSE: Final = 3
"""Hello's and Refuse's types, and the layouts of header and Refuse, are those of every version."""

PART: Final = 0x80
"""Set in the type of a part of a message: see `parts`."""

OF_SESSION: Final = frozenset({STATE, COMMAND, 6})
"""Types that belong to an open session: State, Command, Close. The others open one."""

_NUMBERED: Final = OF_SESSION | {UNKNOWN}
"""Types that have a sequence number."""
_MAY_BE_CUT: Final = (State, Command)

_HEADER: Final = struct.Struct("<2sBBIQQ")
_NUMBERS: Final = struct.Struct("<QQ")  # session, sequence: the end of the header
_STATE: Final = struct.Struct("<IHH")  # drones, observation size, telemetry size
_COMMAND: Final = struct.Struct("<IH6xI")  # drones, action size, number of seeds
_WELCOME: Final = struct.Struct("<QB7xQ")  # nonce, has seed, seed
_HELLO: Final = struct.Struct("<IHHHxxd16s")  # drones, sizes, discrete actions, period, model hash
_LENGTH: Final = struct.Struct("<H")
_FLAGS: Final = b"\0\1"
_ORDERS: Final = b"\0\1\2"
_HOLD: Final = 2
_F4: Final = np.dtype("<f4")
_F8: Final = np.dtype("<f8")
_U8: Final = np.dtype("<u8")


def encode(message: Message) -> bytes:
    """The bytes of a message: one datagram, or more than fit into one, to be cut by `parts`.

    Raises `ValueError` if a number or the whole does not fit.
    """
    kind = type(message)
    start, crc, encoder = _ENCODERS[kind]
    try:
        numbers = _NUMBERS.pack(message.session, getattr(message, "sequence", 0))
        rest = numbers + encoder(message)
    except struct.error as error:
        raise ValueError(f"{kind.__name__}: {error}") from None
    size, most = len(rest) + 8, MAX_WHOLE if kind in _MAY_BE_CUT else MAX_MESSAGE
    if size > most:
        raise ValueError(f"{kind.__name__}: expected at most {most} bytes, got {size}")
    return start + zlib.crc32(rest, crc).to_bytes(4, "little") + rest


def frame(kind: int, session: int, sequence: int, body: bytes) -> bytes:
    """A datagram: header and body."""
    start, numbers = MAGIC + bytes((VERSION, kind)), _NUMBERS.pack(session, sequence)
    crc = zlib.crc32(body, zlib.crc32(numbers, zlib.crc32(start)))
    return b"".join((start, crc.to_bytes(4, "little"), numbers, body))


def check(datagram: bytes) -> tuple[int, int, int]:
    """Type, session and sequence of a datagram whose header is as it should be.

    Raises `DecodeError` otherwise.
    """
    if len(datagram) < _HEADER.size:
        raise DecodeError(f"header: expected {_HEADER.size} bytes, got {len(datagram)}")
    magic, version, kind, crc, session, sequence = _HEADER.unpack_from(datagram)
    if magic != MAGIC:
        raise DecodeError(f"magic: expected {MAGIC.hex()}, got {magic.hex()}")
    if zlib.crc32(datagram[8:], zlib.crc32(datagram[:4])) != crc:
        raise DecodeError("checksum: the datagram was changed on its way")
    if version != VERSION and kind != _REFUSE:
        raise VersionMismatch(f"protocol version: expected {VERSION}, got {version}")
    if sequence and kind & ~PART not in _NUMBERED:
        raise DecodeError(f"sequence: expected 0 in type {kind}, got {sequence}")
    return kind, session, sequence


def decode(datagram: bytes) -> Message:
    """The message in these bytes. Raises `DecodeError`, and nothing else, for any other bytes."""
    kind, session, sequence = check(datagram)
    decoder = _DECODERS.get(kind)
    if decoder is None:
        raise DecodeError(f"type: expected 1 to {len(_DECODERS)}, got {kind}")
    try:
        return decoder(datagram, session, sequence)
    except (ValueError, struct.error) as error:
        raise DecodeError(f"{decoder.__name__[8:]}: {error}") from None


def peek(datagram: bytes) -> tuple[int, int, int]:
    """Type, session and sequence that a datagram claims, nothing verified; zeros if it has none.

    The type of a part is that of its message.
    """
    if len(datagram) < HEADER_SIZE or datagram[:2] != MAGIC:
        return 0, 0, 0
    _, _, kind, _, session, sequence = _HEADER.unpack_from(datagram)
    return kind & ~PART, session, sequence


def state_size(hello: Hello) -> int:
    """Bytes of a State of the drones of a Hello."""
    n, m = hello.observation_low.size, len(hello.telemetry_names)
    return 32 + hello.num_drones * (8 * (1 + m) + 4 * n + 2)


def command_size(hello: Hello) -> int:
    """Bytes of a Command, with seeds, for the drones of a Hello."""
    return 40 + hello.num_drones * (8 + 4 * hello.action_low.size + 1)


def _encode_state(m: State) -> bytes:
    drones, size = m.observations.shape
    return b"".join(
        (
            _STATE.pack(drones, size, m.telemetry.shape[1]),
            m.rewards.astype(_F8, copy=False).tobytes(),
            m.telemetry.astype(_F8, copy=False).tobytes(),
            m.observations.astype(_F4, copy=False).tobytes(),
            m.terminated.astype(bool, copy=False).tobytes(),
            m.truncated.astype(bool, copy=False).tobytes(),
        )
    )


def _decode_state(data: bytes, session: int, sequence: int) -> State:
    drones, n, m = _STATE.unpack_from(data, 24)
    narrow = 32 + 8 * drones * (1 + m)
    flags = narrow + 4 * drones * n
    _expect_size(data, flags + 2 * drones)
    _expect_flags(data[flags:])
    return State(
        session=session,
        sequence=sequence,
        observations=np.ndarray((drones, n), _F4, data, narrow),
        rewards=np.ndarray((drones,), _F8, data, 32),
        terminated=np.ndarray((drones,), bool, data, flags),
        truncated=np.ndarray((drones,), bool, data, flags + drones),
        telemetry=np.ndarray((drones, m), _F8, data, 32 + 8 * drones),
    )


def _encode_command(m: Command) -> bytes:
    drones, size = m.actions.shape
    seeds = b"" if m.seeds is None else m.seeds.astype(_U8, copy=False).tobytes()
    return b"".join(
        (
            _COMMAND.pack(drones, size, len(seeds) // 8),
            seeds,
            m.actions.astype(_F4, copy=False).tobytes(),
            _orders(m).tobytes(),
        )
    )


def _orders(m: Command) -> np.ndarray:
    orders: np.ndarray = m.resets.astype(np.uint8)
    if m.holds is not None:
        orders += _HOLD * m.holds.astype(np.uint8)
    return orders


def _decode_command(data: bytes, session: int, sequence: int) -> Command:
    drones, k, count = _COMMAND.unpack_from(data, 24)
    if count not in (0, drones):
        raise ValueError(f"seeds: expected 0 or {drones}, got {count}")
    at = 40 + 8 * count
    flags = at + 4 * drones * k
    _expect_size(data, flags + drones)
    holds = None
    if data.find(_HOLD, flags) < 0:
        _expect_flags(data[flags:])
        resets = np.ndarray((drones,), bool, data, flags)
    else:
        _expect_flags(data[flags:], _ORDERS)
        orders = np.ndarray((drones,), np.uint8, data, flags)
        resets, holds = orders == 1, orders == _HOLD
    return Command(
        session=session,
        sequence=sequence,
        actions=np.ndarray((drones, k), _F4, data, at),
        resets=resets,
        seeds=np.ndarray((drones,), _U8, data, 40) if count else None,
        holds=holds,
    )


def _encode_hello(m: Hello) -> bytes:
    n, k = m.observation_low.size, m.action_low.size
    bounds = (m.observation_low, m.observation_high, m.action_low, m.action_high)
    return b"".join(
        (
            _HELLO.pack(m.num_drones, n, k, m.discrete_actions, m.control_period,
                        bytes.fromhex(m.model_hash)),
            *(b.astype(_F4).tobytes() for b in bounds),
            _text(m.env_id),
            _text(",".join(m.telemetry_names)),
            _text(m.options),
        )
    )  # fmt: skip


def _decode_hello(data: bytes, session: int, sequence: int) -> Hello:
    drones, n, k, discrete, period, model_hash = _HELLO.unpack_from(data, 24)
    at = 24 + _HELLO.size
    end = at + 8 * (n + k)
    if len(data) < end:
        raise ValueError(f"expected at least {end} bytes, got {len(data)}")
    bounds = np.frombuffer(data, _F4, 2 * (n + k), at)
    env_id, end = _take_text(data, end)
    names, end = _take_text(data, end)
    options, end = _take_text(data, end)
    _expect_size(data, end)
    return Hello(
        session=session,
        env_id=env_id,
        num_drones=drones,
        observation_low=bounds[:n],
        observation_high=bounds[n : 2 * n],
        action_low=bounds[2 * n : 2 * n + k],
        action_high=bounds[2 * n + k :],
        discrete_actions=discrete,
        control_period=period,
        model_hash=model_hash.hex(),
        telemetry_names=tuple(names.split(",")) if names else (),
        options=options,
    )


def _encode_welcome(m: Welcome) -> bytes:
    return _WELCOME.pack(m.nonce, m.seed is not None, m.seed or 0)


def _decode_welcome(data: bytes, session: int, sequence: int) -> Welcome:
    _expect_size(data, 24 + _WELCOME.size)
    nonce, has_seed, seed = _WELCOME.unpack_from(data, 24)
    if has_seed > 1:
        raise ValueError(f"has seed: expected 0 or 1, got {has_seed}")
    return Welcome(session=session, nonce=nonce, seed=seed if has_seed else None)


def _encode_nothing(m: Wait | Unknown) -> bytes:
    return b""


def _decode_wait(data: bytes, session: int, sequence: int) -> Wait:
    _expect_size(data, 24)
    return Wait(session=session)


def _decode_unknown(data: bytes, session: int, sequence: int) -> Unknown:
    _expect_size(data, 24)
    return Unknown(session=session, sequence=sequence)


def _encode_reason(m: Refuse | Close) -> bytes:
    return _text(m.reason)


def _decode_refuse(data: bytes, session: int, sequence: int) -> Refuse:
    return Refuse(session=session, reason=_only_text(data))


def _decode_close(data: bytes, session: int, sequence: int) -> Close:
    return Close(session=session, sequence=sequence, reason=_only_text(data))


def _text(text: str) -> bytes:
    raw = text.encode()
    return _LENGTH.pack(len(raw)) + raw


def _take_text(data: bytes, at: int) -> tuple[str, int]:
    (size,) = _LENGTH.unpack_from(data, at)
    end = at + 2 + size
    if size > MAX_TEXT or len(data) < end:
        most = min(MAX_TEXT, len(data) - at - 2)
        raise ValueError(f"text: expected at most {most} bytes, got {size}")
    return data[at + 2 : end].decode(), end


def _only_text(data: bytes) -> str:
    text, end = _take_text(data, 24)
    _expect_size(data, end)
    return text


def _expect_size(data: bytes, size: int) -> None:
    if len(data) != size:
        raise ValueError(f"expected {size} bytes, got {len(data)}")


def _expect_flags(flags: bytes, allowed: bytes = _FLAGS) -> None:
    if wrong := flags.translate(None, allowed):
        raise ValueError(f"flags: expected 0 to {len(allowed) - 1}, got {wrong[0]}")


def _entry(
    number: int, encoder: Callable[[Any], bytes]
) -> tuple[bytes, int, Callable[[Any], bytes]]:
    start = MAGIC + bytes((VERSION, number))
    return start, zlib.crc32(start), encoder


_ENCODERS: Final[dict[type, tuple[bytes, int, Callable[[Any], bytes]]]] = {
    Hello: _entry(HELLO, _encode_hello),
    Welcome: _entry(2, _encode_welcome),
    Refuse: _entry(_REFUSE, _encode_reason),
    State: _entry(STATE, _encode_state),
    Command: _entry(COMMAND, _encode_command),
    Close: _entry(6, _encode_reason),
    Wait: _entry(7, _encode_nothing),
    Unknown: _entry(UNKNOWN, _encode_nothing),
}
"""First four bytes of a datagram, their CRC-32, and the function for the rest."""

_DECODERS: Final[dict[int, Callable[[bytes, int, int], Message]]] = {
    HELLO: _decode_hello,
    2: _decode_welcome,
    _REFUSE: _decode_refuse,
    STATE: _decode_state,
    COMMAND: _decode_command,
    6: _decode_close,
    7: _decode_wait,
    UNKNOWN: _decode_unknown,
}
