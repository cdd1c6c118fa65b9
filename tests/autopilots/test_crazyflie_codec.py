"""Bytes of CRTP packets between the Crazyflie's firmware and its simulator."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rotorgram.autopilots.protocol import crazyflie as protocol
from rotorgram.autopilots.reading import Order, Reading

REST = np.zeros(3)
UPRIGHT = np.array((1.0, 0.0, 0.0, 0.0))
THREE = st.tuples(*[st.floats(-300.0, 300.0)] * 3)


def reading(
    position: object = REST,
    quaternion: object = UPRIGHT,
    rates: object = REST,
    force: object = REST,
) -> Reading:
    arrays = [np.array(one, float) for one in (position, quaternion, REST, rates, force)]
    return Reading(0.0, *arrays)


def test_an_imu_reading_is_six_whole_numbers() -> None:
    """1 g is 2048 and 1 °/s is 16.384: 90 °/s are 1474.56."""
    packet = protocol.imu_packet(reading(rates=(0.0, 0.0, np.pi / 2), force=(0.0, -9.81, 9.81)))
    assert packet.hex() == "9000" + "0000" + "00f8" + "0008" + "0000" + "0000" + "c305"


def test_an_imu_reading_stops_at_its_range() -> None:
    """16 g and 2000 °/s."""
    packet = protocol.imu_packet(reading(rates=(-99.0, 0.0, 99.0), force=(999.0, -999.0, 0.0)))
    assert struct.unpack("<6h", packet[2:]) == (32767, -32768, 0, -32768, 0, 32767)


@given(rates=THREE, force=THREE)
def test_an_imu_reading_is_exact_to_half_a_step(
    rates: tuple[float, ...], force: tuple[float, ...]
) -> None:
    packet = protocol.imu_packet(reading(rates=rates, force=force))
    numbers = np.array(struct.unpack("<6h", packet[2:]))
    forces = np.clip(force, -16 * 9.81, 32767 / 2048 * 9.81)
    turns = np.clip(np.degrees(rates), -2000.0, 32767 / 16.384)
    assert numbers[:3] / 2048 * 9.81 == pytest.approx(forces, abs=0.51 / 2048 * 9.81)
    assert numbers[3:] / 16.384 == pytest.approx(turns, abs=0.51 / 16.384)


def test_a_pose_has_the_scalar_of_its_quaternion_last() -> None:
    packet = protocol.pose_packet(
        reading(position=(1.0, 2.0, -0.5), quaternion=(0.5, 0.0, -0.5, 0.25))
    )
    assert (
        packet.hex()
        == "6108"
        + "0000803f"
        + "00000040"
        + "000000bf"
        + "00000000"
        + "000000bf"
        + ("0000803e" + "0000003f")
    )


def test_a_goal_has_its_heading_in_degrees() -> None:
    packet = protocol.goal_packet(Order(np.array((1.0, 0.0, 2.0)), np.pi / 2))
    assert packet.hex() == "7007" + "0000803f" + "00000000" + "00000040" + "0000b442"


@pytest.mark.parametrize(
    ("kind", "value", "end"),
    [("B", 2, "08" + "02"), ("H", 36556, "09" + "cc8e"), ("f", 0.25, "06" + "0000803e")],
)
def test_a_parameter_is_set_by_its_name(kind: str, value: float, end: str) -> None:
    packet = protocol.parameter_packet("ring", "on", kind, value)
    assert packet == b"\x23\x00ring\x00on\x00" + bytes.fromhex(end)


def test_throttles_are_shares_of_16_bits() -> None:
    packet = bytes.fromhex("90" + "0000" + "ffff" + "3333" + "0100")
    throttles = protocol.throttles(packet)
    assert throttles is not None
    assert throttles.tolist() == [0.0, 1.0, 0.2, 1 / 65535]


@pytest.mark.parametrize(
    "packet", ["", "90", "9000000000000000", "90000000000000000000", "800000000000000000"]
)
def test_other_packets_have_no_throttles(packet: str) -> None:
    assert protocol.throttles(bytes.fromhex(packet)) is None


@given(st.binary(max_size=70))
def test_no_bytes_give_throttles_out_of_range(packet: bytes) -> None:
    throttles = protocol.throttles(packet)
    is_motors = len(packet) == 9 and packet[0] >> 4 == 9
    assert (throttles is not None) == is_motors
    if throttles is not None:
        assert throttles.shape == (4,)
        assert ((throttles >= 0.0) & (throttles <= 1.0)).all()


def test_mutated_motors_are_motors_or_nothing() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100_000):
        packet = bytearray.fromhex("90" + "cc8e" * 4)
        packet[rng.integers(9)] = rng.integers(256)
        throttles = protocol.throttles(bytes(packet[: rng.integers(7, 10)]))
        assert throttles is None or float(throttles.max()) <= 1.0


@pytest.mark.parametrize(
    ("packet", "belongs"), [("", False), ("9000", True), ("93", True), ("80", False)]
)
def test_sensors_and_motors_belong_to_the_simulator(packet: str, belongs: bool) -> None:
    assert protocol.is_simulated(bytes.fromhex(packet)) == belongs
