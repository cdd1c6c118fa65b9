"""ArduPilot's JSON interface: its bytes, what is refused, and that nothing else is raised."""

import json
import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rotorgram.autopilots.protocol import ardupilot as protocol
from rotorgram.autopilots.reading import Reading
from rotorgram.models import InputError

FRAME = bytes.fromhex("1a48900103000000" + "e803dc05d007" + "0000" * 12 + "0e08")
"""Magic 18458, 400 Hz, frame 3; 1000, 1500, 2000, twelve times 0, 2062 µs."""


def reading_of(time: float = 0.25) -> Reading:
    """A craft with its nose to the north, 1 m east, 2 m north, 3 m high, level."""
    half = math.sqrt(0.5)
    return Reading(
        time,
        np.array((1.0, 2.0, 3.0)),
        np.array((half, 0.0, 0.0, half)),
        np.array((0.5, -0.5, 0.25)),
        np.array((0.1, 0.2, 0.3)),
        np.array((0.0, 1.0, 9.81)),
    )


def test_servos_of_a_recorded_datagram() -> None:
    found = protocol.servos(FRAME)
    assert found.frame == 3
    assert found.throttles.tolist() == [0.0, 0.5, 1.0, *[0.0] * 12, 1.0]


def test_servos_of_32_channels() -> None:
    found = protocol.servos(struct.pack("<HHI32H", 29569, 400, 7, *range(1000, 1032)))
    assert found.frame == 7
    assert found.throttles[31] == pytest.approx(0.031)


@pytest.mark.parametrize(
    "datagram",
    [b"", FRAME[:-1], FRAME + b"\0", b"\0\0" + FRAME[2:], struct.pack("<H", 29569) + FRAME[2:]],
)
def test_another_datagram_is_refused(datagram: bytes) -> None:
    with pytest.raises(InputError, match="ardupilot: expected a datagram of servos, got"):
        protocol.servos(datagram)


@given(st.one_of(st.binary(max_size=80), st.binary(min_size=40, max_size=40)))
def test_no_datagram_gives_more_than_full_throttle(datagram: bytes) -> None:
    try:
        found = protocol.servos(datagram)
    except InputError:
        return
    assert ((found.throttles >= 0.0) & (found.throttles <= 1.0)).all()


def test_mutated_datagrams_raise_nothing_else() -> None:
    random = np.random.default_rng(1)
    refused = 0
    for _ in range(20_000):
        datagram = bytearray(FRAME)
        at = int(random.integers(len(datagram)))
        datagram[at] = int(random.integers(256))
        try:
            assert len(protocol.servos(bytes(datagram)).throttles) == 16
        except InputError:
            refused += 1
    assert 700 < refused < 1300  # a magic of two bytes of forty: one in twenty


def test_state_in_north_east_down() -> None:
    line = protocol.state_line(reading_of())
    assert (line[:1], line[-1:], line.count(b"\n")) == (b"\n", b"\n", 2)
    state = json.loads(line)
    assert state["timestamp"] == 0.25 + 0.001
    assert state["position"] == [2.0, 1.0, -3.0]
    assert state["velocity"] == [-0.5, 0.5, -0.25]
    assert state["imu"] == {"gyro": [0.1, -0.2, -0.3], "accel_body": [0.0, -1.0, -9.81]}
    assert state["attitude"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-15)


@given(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.floats(-3.0, 3.0))
def test_attitude_is_roll_pitch_yaw(roll: float, pitch: float, yaw: float) -> None:
    """Rotations about down, right, forward, one after the other, of a craft that looks north."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    aerospace = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    w, x, y, z = aerospace
    # From forward, left, up to east, north, up: a half turn about forward on the right, and one
    # about the middle of north and east on the left.
    half = math.sqrt(0.5)
    turned = _product((0.0, half, half, 0.0), _product((w, x, y, z), (0.0, 1.0, 0.0, 0.0)))
    state = json.loads(protocol.state_line(reading_of()._replace(quaternion=turned)))
    assert state["attitude"] == pytest.approx([roll, pitch, yaw], abs=1e-7)


def _product(a: tuple[float, ...], b: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """Hamilton's."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        )
    )


def test_optional_fields_come_after_those_that_they_resemble() -> None:
    """The program takes what follows the first `velocity`."""
    line = protocol.state_line(reading_of(), {"velocity_wind": [1.0, 2.0, 0.0], "rng_1": 4.5})
    assert line.index(b'"velocity"') < line.index(b'"velocity_wind"')
    assert json.loads(line)["rng_1"] == 4.5


def test_the_first_time_stamp_is_no_zero() -> None:
    """At 0 the program takes its computer's time, and no two flights are the same."""
    assert json.loads(protocol.state_line(reading_of(0.0)))["timestamp"] > 0.0
