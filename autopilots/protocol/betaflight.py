"""Betaflight's simulator protocol and MSP: bytes of datagrams and frames. No socket, no clock.

Body axes of ours are x forward, y left, z up. What Betaflight takes for them was found by flying
it, and differs between releases: see `Dialect`.
"""

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...models import InputError
from ..reading import Reading

MOTORS_PORT: Final = 9002
STATE_PORT: Final = 9003
STICKS_PORT: Final = 9004
MSP_PORT: Final = 5761
RATE: Final = 1000.0
"""Of states and motors, Hz: its gyro's."""

FC_VERSION: Final = 3
STATUS: Final = 150
"""Commands of MSP."""

_STATE = struct.Struct("<18d")
_STICKS = struct.Struct("<d16H")
_MOTORS = struct.Struct("<4f")
_PRESSURE = 101325.0  # Pa: of the ground, where altitude is told beside it


class Dialect(NamedTuple):
    """What a release takes and gives."""

    yaw: float
    """Sign of the gyro's z."""
    motors: tuple[tuple[int, int], ...]
    """Where each motor sits: signs of x and y."""


_REAR_RIGHT = (-1, -1)
_FRONT_RIGHT = (1, -1)
_REAR_LEFT = (-1, 1)
_FRONT_LEFT = (1, 1)
DIALECTS: Final = {
    (2026, 6): Dialect(1.0, (_REAR_RIGHT, _FRONT_RIGHT, _REAR_LEFT, _FRONT_LEFT)),
    (0, 0): Dialect(-1.0, (_FRONT_RIGHT, _REAR_LEFT, _FRONT_LEFT, _REAR_RIGHT)),
}
"""By the first release, year and month, that speaks so; the newest first."""


def dialect_of(version: tuple[int, int]) -> Dialect:
    """Of a release, year and month."""
    return next(found for first, found in DIALECTS.items() if version >= first)


def state_packet(reading: Reading, dialect: Dialect) -> bytes:
    """What its sensors say: 18 doubles. Its place on earth is not told, its altitude is."""
    p, q, r = reading.rates
    x, y, z = reading.specific_force
    w, i, j, k = reading.quaternion
    altitude = reading.position[2]
    return _STATE.pack(
        reading.time, p, -q, dialect.yaw * r, -x, -y, -z, w, i, -j, -k, *reading.velocity,
        0.0, 0.0, altitude, _PRESSURE,
    )  # fmt: skip


def sticks_packet(time: float, channels: Sequence[float]) -> bytes:
    """16 channels, µs from 1000 to 2000: roll, pitch, throttle, yaw, switches."""
    clipped = np.clip(np.rint(channels), 1000, 2000).astype(int).tolist()
    return _STICKS.pack(time, *clipped, *[1000] * (16 - len(clipped)))


def throttles(datagram: bytes) -> NDArray[np.float64]:
    """Of its four motors, from 0 to 1. Raises `InputError`."""
    if len(datagram) != _MOTORS.size:
        raise InputError(
            f"betaflight: expected {_MOTORS.size} bytes of motors, got {len(datagram)}"
        )
    values = np.array(_MOTORS.unpack(datagram))
    if not np.isfinite(values).all():
        raise InputError(f"betaflight: expected finite motors, got {values.tolist()}")
    clipped: NDArray[np.float64] = np.clip(values, 0.0, 1.0)
    return clipped


# ---- MSP, version 1


def request(command: int) -> bytes:
    """A frame that asks, without content."""
    return b"$M<\x00" + bytes((command, command))


def answer(received: bytes, command: int) -> bytes | None:
    """The content of the first whole frame that answers a command; None: it has not come yet."""
    start = received.find(b"$M>")
    while start >= 0 and len(received) >= start + 5:
        size, kind = received[start + 3 : start + 5]
        frame = received[start + 3 : start + 6 + size]
        if len(frame) < size + 3:
            return None
        check = 0
        for byte in frame:
            check ^= byte
        if kind == command and check == 0:
            return frame[2:-1]
        start = received.find(b"$M>", start + 1)
    return None


class Status(NamedTuple):
    """What MSP_STATUS_EX tells."""

    armed: bool
    refusals: int
    """Flags: why it does not arm."""


def status(content: bytes) -> Status:
    """From the content of an answer to `STATUS`. Raises `InputError`."""
    try:
        (modes,) = struct.unpack_from("<I", content, 6)
        after_modes = 16 + (content[15] & 15)
        (refusals,) = struct.unpack_from("<I", content, after_modes + 1)
    except (struct.error, IndexError):
        raise InputError(f"betaflight: expected its status, got {content.hex()}") from None
    return Status(bool(modes & 1), refusals)
