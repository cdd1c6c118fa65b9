"""CRTP packets between the Crazyflie's firmware as a program (SITL) and its simulator.

A packet is a header, of port and channel, and its content. Frames are ours.
"""

import struct

import numpy as np
from numpy.typing import NDArray

from ...models import InputError
from ..reading import Order, Reading

PORT = 19950
"""Of the simulator."""
CLIENT_PORT = 19850
"""Where clients such as cflib look for a Crazyflie."""
HELLO = b"\xf3"
"""The firmware's first packet, and the answer."""
NOTHING = b"\xff"
"""A packet without content, by which clients find and hold a link."""
G = 9.81
"""Of the firmware, m/s²."""

_PER_G = 2048.0
_PER_DEGREE = 16.384  # per °/s
_IMU = struct.Struct("<BB6h")
_POSE = struct.Struct("<BB7f")
_GOAL = struct.Struct("<BB4f")
_MOTORS = struct.Struct("<4H")
_MOTORS_HEADER = 0x90
_KINDS = {"B": 0x08, "H": 0x09, "f": 0x06}


def check_greeting(packet: bytes) -> None:
    """Raise `InputError` for another packet."""
    if packet != HELLO:
        raise InputError(f"crazyflie: expected its greeting, got {packet.hex()}")


def imu_packet(reading: Reading) -> bytes:
    """Accelerometer and gyro."""
    forces = reading.specific_force / G * _PER_G
    rates = np.degrees(reading.rates) * _PER_DEGREE
    numbers = np.concatenate((forces, rates)).tolist()
    whole = [round(min(max(number, -32768.0), 32767.0)) for number in numbers]
    return _IMU.pack(0x90, 0, *whole)


def pose_packet(reading: Reading) -> bytes:
    """What motion capture sees."""
    w, *vector = reading.quaternion.tolist()
    return _POSE.pack(0x61, 8, *reading.position.tolist(), *vector, w)


def goal_packet(order: Order) -> bytes:
    """A setpoint of position and heading."""
    return _GOAL.pack(0x70, 7, *order.goal.tolist(), np.degrees(order.heading))


def parameter_packet(group: str, name: str, kind: str, value: float) -> bytes:
    """Set a parameter by its name, of a kind of `struct`: B, H or f."""
    words = f"{group}\0{name}\0".encode()
    return b"\x23\x00" + words + struct.pack(f"<B{kind}", _KINDS[kind], value)


def is_simulated(packet: bytes) -> bool:
    """Whether it is of the port of sensors and motors, which belongs to the simulator."""
    return len(packet) > 0 and packet[0] & 0xF0 == _MOTORS_HEADER


def throttles(packet: bytes) -> NDArray[np.float64] | None:
    """Of motors 1 to 4, from 0 to 1; None of another packet."""
    if len(packet) != 1 + _MOTORS.size or not is_simulated(packet):
        return None
    return np.array(_MOTORS.unpack(packet[1:])) / 65535.0
