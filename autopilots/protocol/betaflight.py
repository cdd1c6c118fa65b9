"""Betaflight's simulator protocol: bytes of datagrams, and words of its CLI. No socket, no clock.

Body axes of ours are x forward, y left, z up. What Betaflight takes for them was found by flying
it, and differs between releases: see `YAW_TURNED`.
"""

import math
import re
import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...models import InputError
from ..reading import Reading

MOTORS_PORT = 9001
STATE_PORT = 9003
STICKS_PORT = 9004
CLI_PORT = 5761
YAW_TURNED = (2026, 6)
"""The first release, year and month, whose gyro has z the other way."""

_STATE = struct.Struct("<18d")
_STICKS = struct.Struct("<d16H")
_MOTORS = struct.Struct("<H2x16f")
_PRESSURE = 101325.0  # Pa: at the ground


def version_of(text: str) -> tuple[int, int]:
    """Release, year and month, in what its CLI says. Raises `InputError`."""
    found = re.search(r"SITL\) (20\d\d)\.(\d{1,2})\.", text)
    if found is None:
        raise InputError(f"betaflight: expected a release as 2026.6.2, got {text[-200:]!r}")
    return int(found[1]), int(found[2])


def yaw_of(version: tuple[int, int]) -> float:
    """Sign of the gyro's z of a release."""
    return 1.0 if version >= YAW_TURNED else -1.0


def state_packet(reading: Reading, time: float, yaw: float) -> bytes:
    """Sensor readings, 18 doubles, with a time stamp, s. The place on earth is left out."""
    p, q, r = reading.rates.tolist()
    x, y, z = reading.specific_force.tolist()
    w, i, j, k = reading.quaternion.tolist()
    altitude = reading.position[2]
    return _STATE.pack(
        time, p, -q, yaw * r, -x, -y, -z, w, i, -j, -k, *reading.velocity.tolist(),
        0.0, 0.0, altitude, _PRESSURE,
    )  # fmt: skip


def sticks_packet(time: float, channels: Sequence[float]) -> bytes:
    """16 channels, µs from 1000 to 2000: roll, pitch, throttle, yaw, switches."""
    clipped = [min(max(round(channel), 1000), 2000) for channel in channels]
    return _STICKS.pack(time, *clipped, *[1000] * (16 - len(clipped)))


def throttles(datagram: bytes, motors: int) -> NDArray[np.float64]:
    """Throttle of each motor, 0 to 1, from its outputs of 1000 to 2000 µs. Raises `InputError`."""
    if len(datagram) != _MOTORS.size:
        raise InputError(
            f"betaflight: expected {_MOTORS.size} bytes of motors, got {len(datagram)}"
        )
    count, *values = _MOTORS.unpack(datagram)
    if count != motors:
        raise InputError(f"betaflight: expected {motors} motors, got {count}")
    outputs = values[:motors]
    if not all(map(math.isfinite, outputs)):
        raise InputError(f"betaflight: expected finite motors, got {outputs}")
    return np.array([min(max(output / 1000.0 - 1.0, 0.0), 1.0) for output in outputs])
