"""CRTP packets between the Crazyflie's firmware as a program (SITL) and its simulator.

A packet is a header, of port and channel, and its content. Frames are ours.
"""

import struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..reading import Order, Reading

PORT: Final = 19950
"""Of the simulator."""
RATE: Final = 1000.0
"""Of IMU readings and motors, Hz."""
HELLO: Final = b"\xf3"
"""The firmware's first packet, and the answer."""

_G = 9.81  # m/s², of the firmware
_PER_G = 2048.0
_PER_DEGREE = 16.384  # per °/s
_IMU = struct.Struct("<BB6h")
_POSE = struct.Struct("<BB7f")
_GOAL = struct.Struct("<BB4f")
_MOTORS = struct.Struct("<4H")
_MOTORS_HEADER = 0x90


def imu_packet(reading: Reading) -> bytes:
    """Accelerometer and gyro."""
    forces = reading.specific_force / _G * _PER_G
    rates = np.degrees(reading.rates) * _PER_DEGREE
    numbers = np.clip(np.rint(np.concatenate((forces, rates))), -32768, 32767)
    return _IMU.pack(0x90, 0, *numbers.astype(int).tolist())


def pose_packet(reading: Reading) -> bytes:
    """What motion capture sees."""
    w, *vector = reading.quaternion.tolist()
    return _POSE.pack(0x61, 8, *reading.position.tolist(), *vector, w)


def goal_packet(order: Order) -> bytes:
    """A setpoint of position and heading."""
    return _GOAL.pack(0x70, 7, *order.goal.tolist(), np.degrees(order.heading))


def parameter_packet(group: str, name: str, value: int) -> bytes:
    """Set a parameter, uint8, by its name."""
    words = f"{group}\0{name}\0".encode()
    return b"\x23\x00" + words + bytes((0x08, value))


def throttles(packet: bytes) -> NDArray[np.float64] | None:
    """Of motors 1 to 4, from 0 to 1; None of another packet."""
    if len(packet) != 1 + _MOTORS.size or packet[0] & 0xF0 != _MOTORS_HEADER:
        return None
    return np.array(_MOTORS.unpack(packet[1:])) / 65535.0
