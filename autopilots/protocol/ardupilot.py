"""ArduPilot's JSON interface for simulators: datagrams of servos, and a line of state in answer.

Body axes are x forward, y right, z down; the world is x north, y east, z down.
"""

import json
import math
import struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...models import InputError
from ...sim.rotations import axes_of
from ..reading import Reading

PORT: Final = 9002
"""Of the simulator."""

_HEADER = struct.Struct("<HHI")
_CHANNELS = {18458: 16, 29569: 32}
_LOW, _HIGH = 1000.0, 2000.0  # µs


class Servos(NamedTuple):
    """What a program wants of its servos."""

    rate: int
    """Of its frames, Hz."""
    frame: int
    """Number of the frame."""
    throttles: NDArray[np.float64]
    """Of each channel, 0 to 1."""


def servos(datagram: bytes) -> Servos:
    """Of a datagram. Raises `InputError`."""
    if len(datagram) >= _HEADER.size:
        magic, rate, frame = _HEADER.unpack_from(datagram)
        count = _CHANNELS.get(magic, -1)
        if len(datagram) == _HEADER.size + 2 * count:
            pulses = np.frombuffer(datagram, "<u2", count, _HEADER.size)
            return Servos(rate, frame, np.clip((pulses - _LOW) / (_HIGH - _LOW), 0.0, 1.0))
    raise InputError(f"ardupilot: expected a datagram of servos, got {datagram[:16].hex()}")


def state_line(reading: Reading) -> bytes:
    """What its sensors and its estimate begin from."""
    (front_x, front_y, front_z), (*_, left_z), (*_, up_z) = axes_of(reading.quaternion)
    turn = math.atan2(left_z, up_z), math.asin(min(max(front_z, -1.0), 1.0))
    flip = np.array((1.0, -1.0, -1.0))
    state = {
        "timestamp": reading.time,
        "imu": {
            "gyro": (flip * reading.rates).tolist(),
            "accel_body": (flip * reading.specific_force).tolist(),
        },
        "position": north_east_down(reading.position),
        "attitude": [*turn, math.atan2(front_x, front_y)],
        "velocity": north_east_down(reading.velocity),
    }
    return f"\n{json.dumps(state)}\n".encode()


def north_east_down(vector: NDArray[np.float64]) -> list[float]:
    """Of x east, y north, z up."""
    x, y, z = vector.tolist()
    return [y, x, -z]
