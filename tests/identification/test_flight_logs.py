"""Logs of real flights: columns, times; and impossible samples that are left out."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas
import pytest
from flight_logs import MOTION, FlightLog, read_log, with_lag
from rotorgram.models.errors import InputError
from rotorgram.models.vehicle import Vehicle

LIVELY = Vehicle.load(Path(__file__).parents[1] / "data" / "lively.toml")
SPEEDS = [f"m{i}_rads" for i in range(1, 5)]
COMMANDS = [f"m{i}_command_rads" for i in range(1, 5)]
ATTITUDE = ["qw", "qx", "qy", "qz"]
FRAME = pandas.DataFrame
Read = Callable[..., FlightLog]


@pytest.fixture
def table() -> FRAME:
    """2 s along x at 1 m/s, rolling by 0.5 rad/s; a command that steps after 0.1 s."""
    time = 0.01 * np.arange(200)
    columns = ["t", *MOTION, *SPEEDS, *COMMANDS]
    frame = pandas.DataFrame(0.0, index=range(200), columns=columns)
    frame["t"] = time
    frame["x"] = time
    frame["vx"] = 1.0
    frame["wx"] = 0.5
    frame["qw"] = np.cos(0.25 * time)
    frame["qx"] = np.sin(0.25 * time)
    frame[SPEEDS] = 600.0
    for name in COMMANDS:
        frame[name] = np.where(time < 0.095, 500.0, 600.0)
    return frame


@pytest.fixture
def read(tmp_path: Path) -> Read:
    def reading(table: FRAME, **more: float) -> FlightLog:
        file = tmp_path / "log.csv"
        table.to_csv(file, index=False)
        return read_log(file, LIVELY, **more)

    return reading


def test_lag_is_the_closed_form(table: FRAME, read: Read) -> None:
    log = read(table.drop(columns=SPEEDS))
    assert not log.measured
    speeds = with_lag(log, 0.05).speeds
    assert speeds[10, 0] == pytest.approx(500.0)
    left = 100 * np.exp(-0.05 / 0.05)
    assert speeds[15, 2] == pytest.approx(600 - left)


def test_a_log_may_have_another_period_and_signs_of_quaternions(table: FRAME, read: Read) -> None:
    signs = np.where(np.arange(200) % 3, 1, -1)
    table[ATTITUDE] *= signs[:, None]
    log = read(table, period=0.005)
    time = 0.005 * np.arange(399)
    np.testing.assert_allclose(log.states[:, 0], time, atol=1e-12)
    np.testing.assert_allclose(log.speeds, 600.0)
    sizes = np.abs(log.states[:, 3])
    np.testing.assert_allclose(sizes, np.cos(0.25 * time), atol=1e-5)


def without_speeds(table: FRAME) -> FRAME:
    return table.drop(columns=SPEEDS + COMMANDS)


def with_a_gap(table: FRAME) -> FRAME:
    return table.drop(index=range(50, 70))


def with_a_jump(table: FRAME) -> FRAME:
    later = table.index >= 100
    return table.assign(x=table.x + 5.0 * later)


def with_a_fast_rotor(table: FRAME) -> FRAME:
    table.loc[60, "m1_rads"] = 1e6
    return table


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda table: table.drop(columns="vy"), "expected a column vy"),
        (without_speeds, r"m1...4_rads"),
        (with_a_gap, r"no gap of more than 0\.1 s, got 0\.21 s"),
        (lambda table: table.assign(x=np.nan), "finite numbers"),
        (lambda table: table.assign(x="here"), "numbers in x"),
        (lambda table: table.head(0), r"^log\.csv: expected two or more samples, got 0$"),
        (with_a_jump, r"agree with velocities and rates, got a jump at 1 s"),
        (with_a_fast_rotor, r"rotor speeds of at most 5000 rad/s, got 1e\+06"),
    ],
)
def test_a_wrong_log_is_refused(
    table: FRAME, read: Read, change: Callable[[FRAME], FRAME], sentence: str
) -> None:
    """An empty log too: fault 54."""
    wrong = change(table)
    with pytest.raises(InputError, match=sentence):
        read(wrong)


@pytest.mark.parametrize("impossible", [1e6, 1e308, -50.0])
@pytest.mark.parametrize("row", [0, 60, 199])
@pytest.mark.parametrize("column", ["x", "vz"])
def test_an_impossible_sample_is_left_out(
    table: FRAME, read: Read, impossible: float, row: int, column: str
) -> None:
    """Fault 45: the velocity contradicts a position, or both positions contradict a velocity."""
    if column == "vz" and impossible < 1e308:
        impossible *= 10  # -500 m/s moves by 5 m in a sample
    table.loc[row, column] = impossible
    log = read(table)
    assert log.left_out == 1
    inside = row == 60
    count = 200 if inside else 199
    assert len(log.states) == count
    start = 0.01 if row == 0 else 0.0
    expected = start + 0.01 * np.arange(count)
    times = log.states[:, 0]
    np.testing.assert_allclose(times, expected, atol=1e-9)


def test_a_jump_of_the_attitude_is_left_out(table: FRAME, read: Read) -> None:
    log = read(table)
    assert log.left_out == 0
    table.loc[60, ATTITUDE] = (0.0, 0.0, 1.0, 0.0)  # on its head
    log = read(table)
    assert log.left_out == 1


TOPICS = {
    "vehicle_local_position": "float x;float y;float z;float vx;float vy;float vz",
    "vehicle_attitude": "float[4] q",
    "vehicle_angular_velocity": "float[3] xyz",
    "actuator_motors": "float[12] control",
}


def message(kind: str, content: bytes) -> bytes:
    head = struct.pack("<HB", len(content), ord(kind))
    return head + content


def ulog(path: Path) -> Path:
    """A PX4 log of 2 s: a climb at 1 m/s past 3 m north and 2 m east, rolled by 0.2 rad."""
    magic = b"\x55\x4c\x6f\x67\x01\x12\x35\x01"
    begin = struct.pack("<Q", 0)
    parts = [magic, begin, message("B", bytes(40))]
    for topic, fields in TOPICS.items():
        form = f"{topic}:uint64_t timestamp;{fields};"
        parts.append(message("F", form.encode()))
    for index, topic in enumerate(TOPICS):
        numbers = struct.pack("<BH", 0, index)
        parts.append(message("A", numbers + topic.encode()))
    attitude = (np.cos(0.1), np.sin(0.1), 0.0, 0.0)
    rates = (0.1, 0.2, 0.3)
    motors = (0.25, 0.5, 0.75, 1.0, *[np.nan] * 8)
    for step in range(201):
        down = -5.0 - 0.01 * step
        motion = (3.0, 2.0, down, 0.0, 0.0, -1.0)
        time = 1_000_000 + step * 10_000
        for index, row in enumerate((motion, attitude, rates, motors)):
            head = struct.pack("<HQ", index, time)
            content = np.array(row, "<f4").tobytes()
            parts.append(message("D", head + content))
    path.write_bytes(b"".join(parts))
    return path


def test_another_file_is_no_ulog_file(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    path = tmp_path / "flight.ulg"
    for content in (b"", bytes(4_000), b"t,x,y,z\n" * 500):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"^log: expected a ULog file, got flight.ulg: "):
            read_log(path, LIVELY)


def test_a_ulog_file_comes_in_our_frames(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    log = read_log(ulog(tmp_path / "flight.ulg"), LIVELY)
    assert not log.measured
    # North east down becomes north, west, up; forward right down becomes forward, left, up.
    position = log.states[100, :3]
    np.testing.assert_allclose(position, (3.0, -2.0, 6.0), atol=1e-6)
    velocity = log.states[50, 7:10]
    np.testing.assert_allclose(velocity, (0.0, 0.0, 1.0), atol=1e-6)
    attitude = (np.cos(0.1), np.sin(0.1), 0.0, 0.0)
    np.testing.assert_allclose(log.states[7, 3:7], attitude, atol=1e-6)
    rates = log.states[7, 10:]
    np.testing.assert_allclose(rates, (0.1, -0.2, -0.3), atol=1e-6)
    # A quarter of the largest thrust, 3 N, at 3e-6 N s²/rad², is 500 rad/s.
    assert log.speeds[7, 0] == pytest.approx(500.0)
    assert log.speeds[7, 3] == pytest.approx(1000.0)
