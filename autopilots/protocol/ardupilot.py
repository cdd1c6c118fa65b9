"""ArduPilot's JSON interface for simulators: datagrams of servos, and a line of state in answer.

Body axes are x forward, y right, z down; the world is x north, y east, z down.
"""

import json
import struct
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...models import InputError
from ..reading import Reading
from .frames import angles_of, forward_right_down, north_east_down

_HEADER = struct.Struct("<HHI")
_CHANNELS = {18458: 16, 29569: 32}
_LOW, _HIGH = 1000.0, 2000.0  # µs
FIRST = 0.001
"""Time stamp of the first state, s: at 0 the program takes the time of its computer."""


class Servos(NamedTuple):
    """What a program wants of its servos."""

    frame: int
    """Number of the frame."""
    throttles: NDArray[np.float64]
    """Of each channel, 0 to 1."""


def servos(datagram: bytes) -> Servos:
    """Of a datagram. Raises `InputError`."""
    if len(datagram) >= _HEADER.size:
        magic, _, frame = _HEADER.unpack_from(datagram)  # between them the rate of its frames
        count = _CHANNELS.get(magic, -1)
        if len(datagram) == _HEADER.size + 2 * count:
            pulses = np.frombuffer(datagram, "<u2", count, _HEADER.size)
            return Servos(frame, np.clip((pulses - _LOW) / (_HIGH - _LOW), 0.0, 1.0))
    raise InputError(f"ardupilot: expected a datagram of servos, got {datagram[:16].hex()}")


def state_line(reading: Reading, optional: Mapping[str, object] = {}) -> bytes:
    """A step of its simulator, with fields that the interface takes besides those it needs.

    The program finds a field by its first letters: `velocity_wind` comes after `velocity`.
    """
    state = {
        "timestamp": reading.time + FIRST,
        "imu": {
            "gyro": forward_right_down(reading.rates),
            "accel_body": forward_right_down(reading.specific_force),
        },
        "position": north_east_down(reading.position),
        "attitude": angles_of(reading.quaternion),
        "velocity": north_east_down(reading.velocity),
        **optional,
    }
    return f"\n{json.dumps(state)}\n".encode()
