"""Betaflight's datagrams and CLI: golden bytes, round trips, and what is refused."""

import math
import socket
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rotorgram.autopilots.betaflight import configuration, new_program
from rotorgram.autopilots.protocol import betaflight as protocol
from rotorgram.autopilots.reading import Propellers, Reading
from rotorgram.envs.config import EnvConfig
from rotorgram.models import InputError
from rotorgram.sim.control.gains import Gains

READING = Reading(
    time=0.25,
    position=np.array((1.0, 2.0, 3.0)),
    quaternion=np.array((0.5, 0.5, -0.5, 0.25)),
    velocity=np.array((4.0, 5.0, 6.0)),
    rates=np.array((0.125, 0.25, 0.375)),
    specific_force=np.array((1.5, 2.5, 9.75)),
)


@pytest.mark.parametrize(("version", "yaw"), [((2026, 12), 0.375), ((2025, 12), -0.375)])
def test_bytes_of_a_state(version: tuple[int, int], yaw: float) -> None:
    packet = protocol.state_packet(READING, READING.time, protocol.yaw_of(version))
    assert struct.unpack("<18d", packet) == (
        0.25, 0.125, -0.25, yaw, -1.5, -2.5, -9.75, 0.5, 0.5, 0.5, -0.25, 4.0, 5.0, 6.0,
        0.0, 0.0, 3.0, 101325.0,
    )  # fmt: skip


def test_bytes_of_sticks() -> None:
    packet = protocol.sticks_packet(0.5, (1500.4, 999.0, 2000.6, 1234.5, 2000.0))
    channels = "dc05 e803 d007 d204 d007" + "e803" * 11
    assert packet == struct.pack("<d", 0.5) + bytes.fromhex(channels)


def test_throttles_of_six_motors() -> None:
    outputs = (1000.0, 1055.0, 1500.0, 2000.0, 2100.0, 900.0)
    datagram = struct.pack("<H2x16f", 6, *outputs, *[1500.0] * 10)
    expected = (0.0, 0.055, 0.5, 1.0, 1.0, 0.0)
    assert protocol.throttles(datagram, 6) == pytest.approx(expected, abs=1e-7)


@given(st.lists(st.floats(0.0, 1.0, width=32), min_size=1, max_size=8))
def test_throttles_come_back(values: list[float]) -> None:
    outputs = [1000.0 + 1000.0 * value for value in values] + [0.0] * (16 - len(values))
    datagram = struct.pack("<H2x16f", len(values), *outputs)
    assert protocol.throttles(datagram, len(values)) == pytest.approx(values, abs=1e-6)


@given(st.binary(max_size=80) | st.binary(min_size=68, max_size=68))
def test_hostile_motors_give_throttles_or_are_refused(datagram: bytes) -> None:
    try:
        found = protocol.throttles(datagram, 4)
    except InputError:
        return
    assert found.shape == (4,)
    assert ((found >= 0.0) & (found <= 1.0)).all()


@pytest.mark.parametrize(
    ("datagram", "words"),
    [
        (b"\0" * 16, "expected 68 bytes of motors, got 16"),
        (struct.pack("<H2x16f", 4, *[1500.0] * 16), "expected 6 motors, got 4"),
        (struct.pack("<H2x16f", 6, math.nan, *[1500.0] * 15), "expected finite motors"),
    ],
)
def test_wrong_motors_are_refused(datagram: bytes, words: str) -> None:
    with pytest.raises(InputError, match=words):
        protocol.throttles(datagram, 6)


@pytest.mark.parametrize(
    ("text", "version"),
    [
        ("# Betaflight / SITL (SITL) 2025.12.6 Nov 24 2026 / 04:04:36", (2025, 12)),
        ("# Betaflight / SITL (SITL) 2026.12.0-alpha Nov 23 2026", (2026, 12)),
    ],
)
def test_release_of_the_cli(text: str, version: tuple[int, int]) -> None:
    assert protocol.version_of(text) == version


@given(st.text(max_size=300))
def test_another_cli_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="betaflight: expected a release as"):
        protocol.version_of(text)


def commands(vehicle: str) -> list[str]:
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", vehicle=vehicle)
    craft = config.load_vehicle()
    gains = Gains.of(craft, 0.01)
    full = np.array((670.0, 670.0, 300.0))
    return list(configuration(craft, Propellers(config, craft), gains, full, False))


def test_mixer_of_a_quadcopter() -> None:
    """Rotors clockwise from the front left; the first and the third push it counterclockwise."""
    mixer = [line for line in commands("hummingbird") if line.startswith("mmix")]
    assert mixer == [
        "mmix reset",
        "mmix 0 1.0 1.0000 -1.0000 1.0000",
        "mmix 1 1.0 -1.0000 -1.0000 -1.0000",
        "mmix 2 1.0 -1.0000 1.0000 1.0000",
        "mmix 3 1.0 1.0000 1.0000 -1.0000",
    ]


def test_mixer_of_a_hexacopter() -> None:
    """Its rotors are at 30°, 90° and 150° to the left and to the right of the nose."""
    mixer = [line.split()[3:] for line in commands("heavy_hexa") if line.startswith("mmix")][1:]
    expected = [
        (0.5, -1.0, 1.0), (-0.5, -1.0, -1.0), (-1.0, 0.0, 1.0),
        (-0.5, 1.0, -1.0), (0.5, 1.0, 1.0), (1.0, 0.0, -1.0),
    ]  # fmt: skip
    assert np.array(mixer, float) == pytest.approx(np.array(expected), abs=1e-3)


def test_settings_stay_in_their_range() -> None:
    """The paper's quadcopter of 20 kg would need larger gains than it takes."""
    lines = commands("paper")
    values = [int(line.split(" = ")[1]) for line in lines if line.startswith(("set p_", "set i_"))]
    assert len(values) == 6
    assert all(0 <= value <= 250 for value in values)


def test_a_port_in_use_is_refused() -> None:
    """In real time its ports are fixed."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", protocol.STATE_PORT))
        with pytest.raises(InputError, match="expected that port 9003 is free, got one in use"):
            new_program(lockstep=False)
