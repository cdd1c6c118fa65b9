"""ArduCopter in the seat: its parameters, what it is told, a peer that misbehaves, the program."""

import math
import os
from collections.abc import Iterator
from contextlib import closing
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import write_program
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rotorgram.autopilots.ardupilot import ArduPilot, motor_order, tuning
from rotorgram.autopilots.reading import Order, Propellers, Reading
from rotorgram.autopilots.seat import Seat, Start, seated
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.trajectories import Trajectory, fly_episodes
from rotorgram.models import InputError, Vehicle
from rotorgram.udp.protocol.errors import PeerClosed

pytest.importorskip("pymavlink", reason="autopilots are told by MAVLink: pip install pymavlink")

PROGRAM = os.environ.get("ROTORGRAM_ARDUPILOT", "")
needs_program = pytest.mark.skipif(
    not PROGRAM, reason="ROTORGRAM_ARDUPILOT names no program of ArduCopter's SITL"
)
RATE = 400.0
PEER = """\
import os, socket, struct, sys
words = dict(word.split("=", 1) for word in sys.argv[1:])
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.bind(("127.0.0.1", 0))
there = ("127.0.0.1", int(words["--sim-port-out"]))
def send(frame, *pulses):
    pulses = (*pulses, *[0] * 16)[:16]
    link.sendto(struct.pack("<HHI16H", 18458, 400, frame, *pulses), there)
send(0)
frame = 0
while True:
    data = link.recv(65536)
    frame += 1
{behaviour}
"""
TALKS = """\
    from pymavlink.dialects.v20 import ardupilotmega as mavlink
    if frame == 1:
        talk = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        talk.connect(("127.0.0.1", int(words["--serial0"].split(":")[2])))
        talk.setblocking(False)
        mav = mavlink.MAVLink(None)
        refused = True
    talk.send(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(mav))
    while True:
        try:
            messages = mav.parse_buffer(talk.recv(2048))
        except BlockingIOError:
            break
        for message in messages:
            with open(os.environ["SAID"], "a") as said:
                if message.get_type() == "MISSION_COUNT":
                    print("mission of", message.count, file=said)
                    talk.send(mavlink.MAVLink_mission_request_message(255, 190, 1).pack(mav))
                    continue
                if message.get_type() == "MISSION_ITEM_INT":
                    print("item", message.seq, message.x, message.y, message.z, file=said)
                    talk.send(mavlink.MAVLink_mission_ack_message(255, 190, 0).pack(mav))
                    continue
                if message.get_type() != "COMMAND_LONG":
                    goal = (message.x, message.y, message.z, message.yaw)
                    print("goal", *[f"{number:.6f}" for number in goal], file=said)
                    continue
                print(message.command, file=said)
            if message.command == 511:
                report = (895, 0, 0, 0, 0, 0, 0)
                talk.send(mavlink.MAVLink_ekf_status_report_message(*report).pack(mav))
            elif message.command == 400 and refused:
                refused = False
                talk.send(mavlink.MAVLink_command_ack_message(400, 4).pack(mav))
                talk.send(mavlink.MAVLink_statustext_message(4, b"Arm: not yet").pack(mav))
            else:
                talk.send(mavlink.MAVLink_command_ack_message(message.command, 0).pack(mav))
    send(frame)
"""


READS = """\
    import json
    pulses = [1000, 1000, 1000, 1000]
    pulses[0] += round(json.loads(data).get("battery", {}).get("voltage", 0.0))
    pulses[1] += sum(line == "BATT_MONITOR 4\\n" for line in open("vehicle.parm"))
    send(frame, *pulses)
"""


def start_of(program: Path, mode: str = "guided", vehicle: str = "paper", **keywords: Any) -> Start:
    keywords["vehicle"] = vehicle
    config = seated(EnvConfig.from_keywords("rotorgram/Hover-v0", **keywords), RATE)
    return Start(config, config.load_vehicle(), mode, program)


def written(folder: Path, behaviour: str) -> Path:
    """A program that does this for each state."""
    program = folder / "peer"
    write_program(program, PEER.format(behaviour=behaviour))
    return program


def reading_at(time: float) -> Reading:
    """At rest and level at (1, 2, 3) m, nose to the east."""
    position = np.array((1.0, 2.0, 3.0))
    rest = np.zeros(3)
    return Reading(
        time, position, np.array((1.0, 0.0, 0.0, 0.0)), rest, rest, np.array((0.0, 0.0, 9.81))
    )


@pytest.fixture
def peer(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[ArduPilot]:
    """A stack whose program does, for each state, what the test's parameter says."""
    program = written(tmp_path, request.param)
    with closing(ArduPilot(start_of(program))) as stack:
        yield stack


@pytest.mark.parametrize(
    ("name", "frame", "order"),
    [
        ("paper", (1, 1), [1, 3, 0, 2]),  # numbered clockwise from the front left
        ("hummingbird", (1, 1), [1, 3, 0, 2]),
        ("crazyflie2", (1, 1), [0, 2, 3, 1]),  # from the front right
        ("crazyflie_brushless", (1, 1), [0, 2, 3, 1]),
        ("skydio_x2", (1, 3), [3, 1, 2, 0]),  # its turn directions are those of H
        ("heavy_hexa", (2, 1), [2, 5, 0, 3, 1, 4]),
    ],
)
def test_motors_of_every_vehicle(name: str, frame: tuple[int, int], order: list[int]) -> None:
    assert motor_order(Vehicle.load(name)) == (*frame, order)


CRAFT = """\
[body]
mass = 1.5
inertia = [0.02, 0.02, 0.035]
[rotors]
frame = "{frame}"
arm = 0.25
thrust = [0.0, 7.5]
reaction = 0.016
"""


@pytest.mark.parametrize(("frame", "kind"), [("plus", (1, 0)), ("cross", (1, 1)), ("hexa", (2, 1))])
def test_frames_of_a_new_vehicle(frame: str, kind: tuple[int, int], tmp_path: Path) -> None:
    file = tmp_path / "craft.toml"
    file.write_text(CRAFT.format(frame=frame))
    vehicle = Vehicle.load(file)
    *found, order = motor_order(vehicle)
    assert tuple(found) == kind
    assert sorted(order) == list(range(vehicle.num_rotors))


@pytest.mark.parametrize("sensors", [{}, {"battery": {}}])
def test_a_battery_is_told(tmp_path: Path, sensors: dict[str, Any]) -> None:
    start = start_of(written(tmp_path, READS), effects={"battery": True}, sensors=sensors,
                     vehicle="heavy_hexa")  # fmt: skip
    told = {"battery": np.array([49.4])} if sensors else {}
    with closing(ArduPilot(start)) as stack:
        places = stack._order
        throttles = stack.step(reading_at(0.0), None, told)
    first, second = throttles[places[:2]]
    assert first == pytest.approx(0.049 if sensors else 0.0)
    assert second == pytest.approx(0.001 if sensors else 0.0)


def test_another_craft_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "craft.toml"
    file.write_text(CRAFT.format(frame="octo"))
    with pytest.raises(InputError, match="ardupilot: expected a quadcopter or a hexacopter, X or"):
        motor_order(Vehicle.load(file))


def test_gains_of_the_paper_vehicle() -> None:
    """Rotors of 100 N, 1 m from both axes, turn 5.025725 kg·m² by 200 N·m at the largest output.

    α is 4 · 49 N · 1 m over that inertia, and p = √(α / 2); the rate loop has 2 p.
    """
    vehicle = Vehicle.load("paper")
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", vehicle="paper")
    found = tuning(vehicle, Propellers(config, vehicle))
    p = math.sqrt(4 * 49.05 / 5.025725 / 2)
    assert found["MOT_THST_HOVER"] == pytest.approx(0.4905, rel=2e-3)
    assert found["MOT_THST_EXPO"] == pytest.approx(1.0)
    assert found["ATC_ANG_RLL_P"] == pytest.approx(p, rel=2e-3)
    assert found["ATC_RAT_RLL_P"] == pytest.approx(2 * p / (200.0 / 5.025725), rel=2e-3)
    assert found["ATC_RAT_RLL_D"] == 0.0  # rotors without a lag


def test_thrust_curve_becomes_its_exponent() -> None:
    """0.42517549 u + 0.57482451 u²."""
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", vehicle="crazyflie2")
    vehicle = config.load_vehicle()
    found = tuning(vehicle, Propellers(config, vehicle))
    assert found["MOT_THST_EXPO"] == pytest.approx(0.57482451, rel=1e-6)


@pytest.mark.parametrize(
    "peer", ["    send(frame - 1, 2000)\n    send(frame, 1500)"], indirect=True
)
def test_a_frame_that_comes_again_is_skipped(peer: ArduPilot) -> None:
    """The first motor is the rotor at the front right, the paper's second."""
    for step in range(5):
        assert peer.step(reading_at(step / RATE), None, {}).tolist() == [0.0, 0.5, 0.0, 0.0]
    assert peer.late == 0


@pytest.mark.parametrize("peer", ["    send(2 * frame, 1100)"], indirect=True)
def test_a_frame_that_is_missing_is_late(peer: ArduPilot) -> None:
    for step in range(3):
        peer.step(reading_at(step / RATE), None, {})
    assert peer.late == 3


@pytest.mark.parametrize("peer", ["    sys.exit('no memory is left')"], indirect=True)
def test_a_program_that_ends_says_why(peer: ArduPilot) -> None:
    with pytest.raises(PeerClosed, match="ardupilot: ended with status 1: no memory is left"):
        peer.step(reading_at(0.0), None, {})


@pytest.mark.parametrize("peer", ["    link.sendto(b'nonsense', there)"], indirect=True)
def test_another_datagram_is_refused(peer: ArduPilot) -> None:
    with pytest.raises(InputError, match="ardupilot: expected a datagram of servos, got 6e6f6e"):
        peer.step(reading_at(0.0), None, {})


def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str) -> tuple[list[str], set[str]]:
    """Messages to a program in three seconds, of which the craft stands two and a half, and why."""
    said = tmp_path / "said.txt"
    monkeypatch.setenv("SAID", str(said))
    program = written(tmp_path, TALKS)
    whys = set()
    with closing(ArduPilot(start_of(program, mode))) as stack:
        for step in range(1200):
            order = None
            if stack.ready:
                order = Order(np.array((2.0, 4.0, 6.0)), 0.5, stands=step < 1000)
            stack.step(reading_at(step / RATE), order, {})
            whys.add(stack.why)
    return said.read_text().splitlines(), whys


def test_commands_one_after_the_other_then_the_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is sent until it is accepted; the goal is relative to where the craft stood."""
    lines, whys = told(tmp_path, monkeypatch, "guided")
    assert lines[:5] == ["511", "176", "400", "400", "22"]
    assert set(lines[5:]) == {f"goal 2.000000 1.000000 -3.000000 {math.pi / 2 - 0.5:.6f}"}
    assert "Arm: not yet" in whys


def test_a_mission_to_the_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """4 m north of 47.377° and 2 m east of 8.542°, 3 m above where it stood.

    A degree of latitude has 111,319.5 m with the earth's radius of 6,378,137 m.
    """
    lines, _ = told(tmp_path, monkeypatch, "auto")
    assert lines[:6] == ["511", "176", "400", "400", "22", "mission of 2"]
    north = round(473_770_000 + 4.0 / 111_319.5 * 1e7)
    east = round(85_420_000 + 2.0 / (111_319.5 * math.cos(math.radians(47.377))) * 1e7)
    assert lines[6:] == [f"item 1 {north} {east} 3.0", "300"]


def test_without_its_program_the_motors_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that asks for a throttle of 0.8 until it ends, half a second after it lifts."""
    monkeypatch.setenv("SAID", str(tmp_path / "said.txt"))
    lifts = "send(frame, *[1800] * 4)\n    if frame == 200: sys.exit('it is over')"
    start = start_of(written(tmp_path, TALKS.replace("send(frame)", lifts)))
    with closing(LocalVectorEnv(start.config, 1, autoreset_mode="Disabled")) as env:
        seat = Seat(env.env_spec, start, ArduPilot)
        (flight,) = fly_episodes(env, seat, 1, "final")
    (fault,) = seat.tally.faults
    assert fault == "ardupilot: ended with status 1: it is over; after 0.498 s"
    assert flight.actions[198, 0] == pytest.approx((64.0 - 49.05) / (100.0 - 49.05), abs=2e-3)
    assert (flight.actions[199:] == -1.0).all()


def fly(
    env: str, vehicle: str, drones: int = 1, mode: str = "guided", **keywords: object
) -> tuple[list[Trajectory], Seat]:
    config = EnvConfig.from_keywords(env, vehicle=vehicle, drones=drones, **keywords)
    config = seated(config, RATE)
    start = Start(config, config.load_vehicle(), mode, Path(PROGRAM).absolute())
    opened = LocalVectorEnv(config, config.drones, autoreset_mode="Disabled")
    with closing(opened) as env_:
        seat = Seat(env_.env_spec, start, ArduPilot)
        return fly_episodes(env_, seat, 1, "final"), seat


def distance(flight: Trajectory) -> np.ndarray:
    return np.linalg.norm(flight.pose[:, :3] - flight.telemetry["goal"], axis=1)


@needs_program
def test_four_waypoints_twice_with_the_same_bits() -> None:
    hashes = []
    for _ in range(2):
        (flight,), seat = fly("rotorgram/Waypoints-v0", "skydio_x2")
        assert flight.telemetry["metrics"][-1, 0] == 0.0  # points left: each within 0.3 m
        assert not seat.tally.late
        assert not seat.tally.faults
        hashes.append(blake2b(flight.pose.tobytes()).hexdigest())
    assert hashes[0] == hashes[1]


@needs_program
@pytest.mark.parametrize("vehicle", ["heavy_hexa", "crazyflie2"])
def test_hovers_without_hand_tuning(vehicle: str) -> None:
    (flight,), _ = fly("rotorgram/Hover-v0", vehicle)
    assert distance(flight)[-400:].max() < 0.1


@needs_program
def test_flies_missions() -> None:
    (flight,), _ = fly("rotorgram/Waypoints-v0", "heavy_hexa", mode="auto")
    assert flight.telemetry["metrics"][-1, 0] == 0.0


@needs_program
def test_holds_in_wind_and_gusts_with_a_rangefinder() -> None:
    effects = {"body_drag": True, "rotor_drag": True, "wind": (5.0, 0.0, 0.0), "gusts": 5.0}
    sensors = {"rangefinder": {"noise": 0.0, "limit": 10.0}}
    keywords = {"effects": effects, "sensors": sensors}
    (flight,), _ = fly("rotorgram/Hover-v0", "hummingbird", **keywords)
    assert distance(flight)[-400:].max() < 0.3


@needs_program
def test_reads_the_voltage_of_the_battery(monkeypatch: pytest.MonkeyPatch) -> None:
    voltages: list[float] = []
    listen = ArduPilot._listen

    def ask_and_listen(stack: ArduPilot) -> None:
        status = mavlink.MAVLINK_MSG_ID_SYS_STATUS
        if stack.ready:
            stack._command(mavlink.MAV_CMD_REQUEST_MESSAGE, status)
        listen(stack)

    def parsed(link: mavlink.MAVLink, data: bytes) -> Any:
        messages = parse(link, data) or []
        reports = [one for one in messages if one.get_type() == "SYS_STATUS"]
        voltages.extend(1e-3 * one.voltage_battery for one in reports)
        return messages

    parse = mavlink.MAVLink.parse_buffer
    monkeypatch.setattr(ArduPilot, "_listen", ask_and_listen)
    monkeypatch.setattr(mavlink.MAVLink, "parse_buffer", parsed)
    keywords = {"effects": {"battery": True}, "sensors": {"battery": True}}
    (flight,), _ = fly("rotorgram/Hover-v0", "heavy_hexa", **keywords)
    flown = flight.telemetry["battery"][:, 1]
    assert len(voltages) > 50
    assert voltages[-1] == pytest.approx(flown[-1], abs=0.05)
    assert max(voltages) == pytest.approx(flown.max(), abs=0.3)  # on its stand it had more


@needs_program
def test_a_swarm_flies_by_a_program_each() -> None:
    flights, seat = fly("rotorgram/Formation-v0", "hummingbird", drones=2)
    assert [distance(one)[-400:].max() < 0.1 for one in flights] == [True, True]
    assert not seat.tally.faults
