"""MAVLink out: numbers as pymavlink reads them, rates, and flights that stay as they are."""

import socket
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from math import cos, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import output, refused, run
from hypothesis import assume, given
from hypothesis import strategies as st
from peers import ANY, Running
from rotorgram.agents.pid import PID
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.trajectories import flown_trajectories, fly_episodes
from rotorgram.models import InputError
from rotorgram.udp import RemoteVectorEnv, Simulator
from rotorgram.udp.protocol.messages import Command

pytest.importorskip("pymavlink", reason="pymavlink is not installed")
from pymavlink.dialects.v20 import common
from pymavlink.quaternion import Quaternion
from rotorgram.autopilots.mavlink import MavlinkOut

Capsys = pytest.CaptureFixture[str]
CONFIG = EnvConfig.from_keywords("rotorgram/Hover-v0", episode_length=30)
SPEC = env_spec(CONFIG)
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Station:
    """A ground station on a free port."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.address: tuple[str, int] = self.socket.getsockname()
        self.flag = f"udp:127.0.0.1:{self.address[1]}"

    def messages(self, kind: str = "") -> list[Any]:
        """Messages that have come since the last call, of a kind, or all."""
        parser = common.MAVLink(None)
        found = []
        while True:
            try:
                datagram = self.socket.recv(2048)
            except BlockingIOError:
                return [one for one in found if kind in ("", one.get_type())]
            found += parser.parse_buffer(datagram)


@pytest.fixture
def station() -> Iterator[Station]:
    one = Station()
    with closing(one.socket):
        yield one


class Clock:
    """Of the wall, and it stands still."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def telemetry(**changes: Any) -> dict[str, np.ndarray]:
    """Of one drone."""
    numbers = {
        "position": (0.0, 0.0, 0.0),
        "attitude": LEVEL,
        "velocity": (0.0, 0.0, 0.0),
        "body_rates": (0.0, 0.0, 0.0),
        "thrust": (1.0, 2.0, 3.0, 4.0),
    } | changes
    return {name: np.array(values) for name, values in numbers.items()}


@contextmanager
def sending(
    station: Station, clock: Any = None, config: EnvConfig = CONFIG
) -> Iterator[MavlinkOut]:
    with closing(MavlinkOut(station.address, env_spec(config), clock or Clock())) as out:
        yield out


def shown(station: Station, **changes: Any) -> dict[str, Any]:
    """Messages of one step by their kind."""
    with sending(station) as out:
        out.show([telemetry(**changes)])
    found = station.messages()
    kinds = {one.get_type(): one for one in found}
    assert len(kinds) == len(found)
    return kinds


def test_east_north_up_becomes_north_east_down(station: Station) -> None:
    found = shown(
        station, position=(10.0, 20.0, 30.0), velocity=(1.0, 2.0, -3.0), body_rates=(0.1, 0.2, 0.3)
    )
    local = found["LOCAL_POSITION_NED"]
    assert (local.x, local.y, local.z) == (20.0, 10.0, -30.0)
    assert (local.vx, local.vy, local.vz) == (2.0, 1.0, 3.0)
    place = found["GLOBAL_POSITION_INT"]
    # 1e7 · 20 m / 6371 km in degrees; and 10 m on the parallel of 47.377° N.
    assert place.lat == 473_770_000 + 1_799
    assert place.lon == 85_420_000 + 1_328
    assert (place.alt, place.relative_alt) == (438_000, 30_000)
    assert (place.vx, place.vy, place.vz) == (200, 100, 300)
    rates = found["ATTITUDE"]
    assert (rates.rollspeed, rates.pitchspeed, rates.yawspeed) == pytest.approx((0.1, -0.2, -0.3))


@pytest.mark.parametrize(
    ("quaternion", "angles"),
    [
        (LEVEL, (0, 0, 90)),  # the nose to the east
        ((cos(np.pi / 4), 0, 0, sin(np.pi / 4)), (0, 0, 0)),  # turned left to the north
        ((cos(np.pi / 4), 0, 0, -sin(np.pi / 4)), (0, 0, 180)),
        ((cos(0.15), sin(0.15), 0, 0), (np.degrees(0.3), 0, 90)),  # the left side up
        ((cos(0.15), 0, sin(0.15), 0), (0, np.degrees(-0.3), 90)),  # the nose down
    ],
)
def test_roll_pitch_and_heading(
    station: Station, quaternion: tuple[float, ...], angles: tuple[float, ...]
) -> None:
    found = shown(station, attitude=quaternion)
    told = found["ATTITUDE"]
    degrees = np.degrees((told.roll, told.pitch, told.yaw))
    np.testing.assert_allclose(degrees, angles, atol=1e-4)
    assert found["GLOBAL_POSITION_INT"].hdg == round(100 * angles[2])


@given(st.tuples(*4 * [st.floats(-1, 1)]).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_angles_are_those_of_the_quaternion(parts: tuple[float, ...]) -> None:
    own = Station()
    with closing(own.socket):
        found = shown(own, attitude=np.array(parts) / np.linalg.norm(parts))
    angles = found["ATTITUDE"]
    assume(abs(angles.pitch) < 1.55)  # else only the sum of roll and yaw is defined
    by_angles = Quaternion([angles.roll, angles.pitch, angles.yaw]).q  # of pymavlink
    w, x, y, z = np.array(parts) / np.linalg.norm(parts)
    # x and y of the world change places, and z points down; so do y and z of the body.
    north_east_down = np.sqrt(0.5) * np.array((w + z, x + y, x - y, w - z))
    alike = np.dot(by_angles, north_east_down)
    assert abs(alike) == pytest.approx(1, abs=1e-5)


def test_a_heartbeat_and_the_rotors(station: Station) -> None:
    found = shown(station)
    beat = found["HEARTBEAT"]
    assert beat.type == common.MAV_TYPE_QUADROTOR
    assert beat.autopilot == common.MAV_AUTOPILOT_GENERIC
    assert beat.base_mode == common.MAV_MODE_FLAG_SAFETY_ARMED
    assert beat.system_status == common.MAV_STATE_ACTIVE
    rotors = found["ACTUATOR_OUTPUT_STATUS"]
    assert rotors.active == 4
    assert rotors.actuator[:5] == [1.0, 2.0, 3.0, 4.0, 0.0]
    assert "BATTERY_STATUS" not in found
    six = shown(station, thrust=6 * (1.0,), battery=(0.5, 11.1))
    assert six["HEARTBEAT"].type == common.MAV_TYPE_HEXAROTOR
    battery = six["BATTERY_STATUS"]
    assert battery.battery_remaining == 50
    assert battery.voltages == [11_100] + 9 * [65535]


def test_what_no_message_can_hold_is_sent_as_its_limit(station: Station) -> None:
    found = shown(station, velocity=(400.0, -400.0, 1e9), battery=(1.0, 400.0))
    place = found["GLOBAL_POSITION_INT"]
    assert (place.vx, place.vy, place.vz) == (-32_700, 32_700, -32_700)
    assert found["BATTERY_STATUS"].voltages[0] == 65_000


def test_the_time_begins_anew_after_49_days(station: Station) -> None:
    spec = replace(SPEC, control_period=1000.0)
    clock = Clock()
    with closing(MavlinkOut(station.address, spec, clock)) as out:
        for _ in range(4294):
            out.show([])
        clock.now += 1.0
        out.show([telemetry()])
    assert station.messages("ATTITUDE")[0].time_boot_ms == 4_295_000_000 - 2**32


@pytest.mark.parametrize(("speed", "poses"), [(0.2, 500), (1.0, 100), (10.0, 11)])
def test_poses_and_heartbeats_keep_the_clock_on_the_wall(
    station: Station, speed: float, poses: int
) -> None:
    """Two seconds of flight, 250 steps a second: 50 poses a second at most, and a heartbeat."""
    clock = Clock()
    with sending(station, clock, CONFIG.changed(control_period=0.004)) as out:
        for step in range(500):
            clock.now = 100.0 + 0.004 * step / speed
            out.show([telemetry()])
    found = station.messages()
    times = [one.time_boot_ms for one in found if one.get_type() == "ATTITUDE"]
    assert len(times) == pytest.approx(poses, abs=1)
    assert times[0] == 4
    np.testing.assert_allclose(np.diff(times), max(20 * speed, 4), atol=4.001)
    beats = sum(one.get_type() == "HEARTBEAT" for one in found)
    assert beats == {0.2: 10, 1.0: 2, 10.0: 1}[speed]


def flown(env: Any, episodes: int = 3) -> list[tuple[bytes, ...]]:
    pilot = PID(env.env_spec)
    trajectories = fly_episodes(env, pilot, episodes)
    return [tuple(array.tobytes() for array in one.telemetry.values()) for one in trajectories]


def elevation(**options: Any) -> EnvConfig:
    return EnvConfig.from_keywords("rotorgram/Elevation-v0", episode_length=30, **options)


def test_a_flight_that_is_shown_has_the_same_bits(station: Station) -> None:
    with closing(LocalVectorEnv(elevation(), 2, autoreset_mode="Disabled")) as env:
        expected = flown(env)
        with sending(station, config=elevation()) as env.observer:
            assert flown(env) == expected
    words = [one.text for one in station.messages("STATUSTEXT")]
    # The first of two worlds flies the first and the third episode.
    assert words == 2 * ["episode begins", "episode truncated"]


def sent(out: MavlinkOut, simulator: Simulator, cause: Command) -> None:
    out(simulator.stepped, cause.resets)


def test_a_swarm_over_udp(station: Station) -> None:
    """Its simulator sends; each drone is a system of its own."""
    config = EnvConfig.from_keywords("rotorgram/Crossing-v0", drones=3, episode_length=10)
    rows = []
    for sends in (False, True):
        with closing(
            RemoteVectorEnv(ANY, num_envs=3, connect=False, autoreset_mode="Disabled")
        ) as env:
            simulator = Simulator(config, num_envs=3, server=env.address, bind=ANY)
            with sending(station, config=config) as out:
                if sends:
                    send = partial(sent, out, simulator)
                    simulator.observers.append(send)
                running = Running(simulator)
                env.reset(seed=7)
                told = [env.step(np.zeros(env.action_space.shape, np.float32)) for _ in range(10)]
                env.close()
                running.join()
        rows.append([(step[0].tobytes(), step[1].tobytes()) for step in told])
    assert rows[0] == rows[1]
    found = station.messages()
    systems = {one.get_srcSystem() for one in found if one.get_type() == "LOCAL_POSITION_NED"}
    assert systems == {1, 2, 3}
    words = [(one.get_srcSystem(), one.text) for one in found if one.get_type() == "STATUSTEXT"]
    # A simulator begins an episode by itself before it is told a seed.
    events = 2 * ["begins"] + ["truncated"]
    assert words == [(drone, f"episode {event}") for event in events for drone in (1, 2, 3)]


def test_flights_that_are_over_are_shown_along_their_frames(station: Station) -> None:
    config = elevation()
    (flight,) = flown_trajectories(PID(env_spec(config)), config, [0])
    clock = Clock()
    taken = []
    with sending(station, clock, config) as out:
        for frame in out.along(range(31), [flight]):
            taken.append(frame)
            clock.now += 0.02
    assert taken == list(range(31))
    found = station.messages("LOCAL_POSITION_NED")
    heights = [-one.z for one in found]
    np.testing.assert_allclose(heights, flight.telemetry["position"][:, 2], rtol=1e-6)


def test_commands_send(station: Station, capsys: Capsys, tmp_path: Path) -> None:
    words = ("--episodes", "1", "--episode-length", "25")
    quiet = output(capsys, "evaluate", "pid", *words)
    loud = output(capsys, "evaluate", "pid", *words, "--mavlink", station.flag)
    assert f"MAVLink goes to 127.0.0.1:{station.address[1]}" in loud
    means = [line for line in quiet.splitlines() if not line.startswith("wire")]
    assert set(means) <= set(loud.splitlines())
    kinds = {one.get_type() for one in station.messages()}
    assert {"HEARTBEAT", "ATTITUDE", "GLOBAL_POSITION_INT", "STATUSTEXT"} <= kinds
    train = (
        "train",
        "ppo",
        "--env-steps",
        "200",
        "--num-envs",
        "2",
        "--set",
        "steps_per_update=100",
    )
    status, _, err = run(capsys, *train, "--out", tmp_path / "run", "--mavlink", station.flag)
    assert (status, err) == (0, "")
    assert station.messages("ATTITUDE")


def test_nobody_receives(station: Station) -> None:
    station.socket.close()
    with sending(station) as out:
        for _ in range(3):
            out.say(np.array([True]), "begins")
            out.show([telemetry()])


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("127.0.0.1:14550", "mavlink: expected udp:HOST:PORT, got '127.0.0.1:14550'"),
        ("tcp:127.0.0.1:5760", "mavlink: expected udp:HOST:PORT, got 'tcp:127.0.0.1:5760'"),
        ("udp:14550", "address: expected HOST:PORT with a port up to 65535, got '14550'"),
        ("udp:127.0.0.1:0", "mavlink: expected a port from 1 to 65535, got 0"),
        ("udp:no such host:1", "host: expected a name or IPv4 address, got 'no such host'"),
    ],
)
def test_a_wrong_address(address: str, sentence: str, capsys: Capsys) -> None:
    words = ("evaluate", "pid", "--episodes", "1", "--mavlink", address)
    assert refused(capsys, *words) == f"rotorgram: {sentence}\n"


def test_an_env_that_tells_no_pose(station: Station) -> None:
    spec = replace(SPEC, telemetry=(), metrics=())
    with pytest.raises(InputError, match="mavlink: expected telemetry of attitude, body_rates"):
        MavlinkOut(station.address, spec)
