"""PX4 in the seat: numbers of its messages, and flights of a stand-in made from its sources."""

import math
import socket
import tempfile
from contextlib import ExitStack, closing, suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from commands import write_program
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.models import InputError
from rotorgram.udp.protocol.errors import PeerClosed, PeerSilent

pytest.importorskip("pymavlink", reason="pymavlink is not installed")
from pymavlink.dialects.v20 import common
from rotorgram.autopilots import find_stack, px4
from rotorgram.autopilots.protocol import px4 as protocol
from rotorgram.autopilots.px4 import parameters
from rotorgram.autopilots.reading import Order, Propellers, Reading
from rotorgram.autopilots.seat import Seat, Start, seated

PEER = Path(__file__).with_name("px4_peer.py")
STACK = find_stack("px4")
EAST = np.array((1.0, 0.0, 0.0, 0.0))
"""Level, the nose to the east."""


def reading(**changes):
    rest = np.zeros(3)
    usual = {
        "time": 2.0,
        "position": rest,
        "quaternion": EAST,
        "velocity": rest,
        "rates": rest,
        "specific_force": np.array((0.0, 0.0, 9.81)),
    }
    return Reading(**(usual | changes))


def test_sensors_in_its_frames_and_units():
    message = protocol.sensors(
        reading(
            specific_force=np.array((1.0, 2.0, 9.81)),
            rates=np.array((0.1, 0.2, 0.3)),
            position=np.array((0.0, 0.0, 92.0)),
        )
    )
    assert message.time_usec == 2_004_000
    assert (message.xacc, message.yacc, message.zacc) == (1.0, -2.0, -9.81)
    assert (message.xgyro, message.ygyro, message.zgyro) == (0.1, -0.2, -0.3)
    # Zurich's field, 1.287 east, 21.532 north, 43.231 µT down: ahead, to the right, down.
    field = message.xmag, message.ymag, message.zmag
    assert field == pytest.approx((0.01287, -0.21532, 0.43231), abs=1e-4)
    assert message.pressure_alt == 500.0
    # ISO 2533, table of the standard atmosphere: 954.612 hPa at 500 m.
    assert message.abs_pressure == pytest.approx(954.612, abs=0.01)
    assert message.fields_updated == 0x7 | 0x38 | 0x1C0 | 0x1A00
    assert message.id == 0


def test_no_magnetometer_and_no_barometer_repeats_its_values():
    """PX4 takes a value within 1e-6 of the last for the same, and many of them for a fault."""
    messages = [protocol.sensors(reading(time=2.0 + step / 250.0)) for step in range(60)]
    for before, after in pairwise(messages):
        assert abs(np.float32(after.xmag) - np.float32(before.xmag)) > 2e-6
        assert abs(np.float32(after.temperature) - np.float32(before.temperature)) > 2e-6


def test_a_fix():
    message = protocol.fix(
        reading(position=np.array((10.0, 20.0, 30.0)), velocity=np.array((-3.0, 4.0, 1.0)))
    )
    assert (message.lat, message.lon) == (473_770_000 + 1_799, 85_420_000 + 1_328)
    assert message.alt == 438_000
    assert (message.vn, message.ve, message.vd, message.vel) == (400, -300, -100, 500)
    assert message.cog == 65_535  # unknown: PX4 reads the velocity
    assert (message.fix_type, message.satellites_visible) == (3, 12)


def test_an_order_is_a_place_on_earth():
    message = protocol.setpoint(Order(np.array((10.0, 20.0, 30.0)), math.pi / 2), 3)
    assert (message.target_system, message.target_component) == (3, 1)
    assert (message.lat_int, message.lon_int) == (473_770_000 + 1_799, 85_420_000 + 1_328)
    assert message.alt == 438.0
    assert message.yaw == 0.0  # north
    assert message.coordinate_frame == 5
    assert message.type_mask == 8 + 16 + 32 + 64 + 128 + 256 + 2048


def test_mutated_outputs_raise_nothing_but_a_sentence():
    """Its parser drops what is broken; an intact message of wrong flags is refused by name."""
    dice = np.random.default_rng(5)
    here = common.MAVLink(None)
    here.robust_parsing = True
    there = common.MAVLink(None, 1, 1)
    seen = 0
    for number in range(20_000):
        message = common.MAVLink_hil_actuator_controls_message(number, 16 * [0.5], 129, 1)
        datagram = bytearray(message.pack(there))
        for place in dice.integers(0, len(datagram), dice.integers(0, 3)):
            datagram[place] = dice.integers(256)
        for found in here.parse_buffer(bytes(datagram[: dice.integers(1, 200)])) or ():
            if found.get_type() == "HIL_ACTUATOR_CONTROLS":
                seen += 1
                assert protocol.throttles(found).shape == (16,)
    assert 1_000 < seen < 10_000


def test_parameters_say_where_rotors_are_and_how_they_turn():
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", vehicle="crazyflie2")
    vehicle = config.load_vehicle()
    told = parameters(vehicle, Propellers(config, vehicle))
    assert told["CA_ROTOR_COUNT"] == 4
    for number, rotor in enumerate(vehicle.rotors):
        assert told[f"CA_ROTOR{number}_PX"] == rotor.position[0]
        assert told[f"CA_ROTOR{number}_PY"] == -rotor.position[1]
        # A rotor that turns counterclockwise, seen from above, pushes the craft clockwise.
        assert (told[f"CA_ROTOR{number}_KM"] > 0) == (rotor.reaction[2] < 0)
        assert told[f"PWM_MAIN_FUNC{number + 1}"] == 101 + number
    hover = vehicle.mass * vehicle.gravity / vehicle.thrust_high.sum()
    assert told["MPC_THR_HOVER"] == pytest.approx(hover)
    # The vehicle's file has the thrust 0.42517549 u + 0.57482451 u².
    assert told["THR_MDL_FAC"] == pytest.approx(0.57482451, abs=1e-4)


@pytest.fixture
def program(tmp_path):
    """The stand-in where a build of PX4 has its program."""
    file = tmp_path / "px4_sitl_default" / "bin" / "px4"
    file.parent.mkdir(parents=True)
    write_program(file, PEER.read_text())
    return file


def flown(program, vehicle, env_id="rotorgram/Waypoints-v0", drones=1, **options):
    config = EnvConfig.from_keywords(env_id, vehicle=vehicle, drones=drones, **options)
    config = seated(config, STACK.rate)
    start = Start(config, config.load_vehicle(), "offboard", program)
    with closing(LocalVectorEnv(config, drones, autoreset_mode="Disabled")) as env:
        seat = Seat(env.env_spec, start, STACK.make)
        with closing(seat):
            return fly_episodes(env, seat, 1, "final"), seat.tally


@pytest.mark.parametrize("vehicle", ["hummingbird", "heavy_hexa"])
def test_it_flies_waypoints_in_lock_step(program, vehicle):
    (flight,), tally = flown(program, vehicle, effects={"motor_lag": True})
    assert tally.faults == []
    assert tally.late == 0
    assert flight.headline[-1] == 0.0  # no points are left


def test_it_hovers_from_its_stand(program):
    """Its integrators do not wind up while it stands: with PX4's ramp it ends 0.12 m off."""
    (flight,), tally = flown(program, "skydio_x2", "rotorgram/Hover-v0")
    assert tally.faults == []
    assert flight.headline[-1] < 0.08


def test_a_flight_is_repeated_to_the_bit(program):
    poses = []
    for _ in range(2):
        (flight,), _ = flown(program, "hummingbird", episode_length=100)
        poses.append(flight.pose.tobytes())
    assert poses[0] == poses[1]


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("dies", "px4: expected outputs, got the end of its connection"),
        ("closes", "px4: expected outputs, got the end of its connection"),
        ("hangs", "px4: expected an answer within 1 s, got none"),
        ("nan", "autopilot: expected throttles from 0 to 1, got [nan, nan, nan, nan]"),
    ],
)
def test_without_its_outputs_the_motors_stop(program, monkeypatch, fault, sentence):
    monkeypatch.setenv("PEER_FAULT", fault)
    monkeypatch.setattr(px4, "ANSWER", 1.0)
    (flight,), tally = flown(program, "hummingbird")
    (said,) = tally.faults
    assert said.startswith(sentence)
    assert flight.terminated  # it falls
    assert flight.telemetry["position"][-1, 2] < flight.telemetry["position"][0, 2]
    assert (flight.telemetry["thrust"][-1] == 0.0).all()


def test_one_that_keeps_its_own_clock_is_refused(program, monkeypatch):
    monkeypatch.setenv("PEER_FAULT", "no_lockstep")
    with pytest.raises(InputError, match="px4: expected one that was built with lock-step, got"):
        flown(program, "hummingbird")


def test_one_that_does_not_arm_says_why(program, monkeypatch):
    monkeypatch.setenv("PEER_FAULT", "refuses")
    monkeypatch.setattr("rotorgram.autopilots.seat.LONGEST_STAND", 8.0)
    with pytest.raises(InputError, match=r"N: Arming denied: Resolve .* first$"):
        flown(program, "hummingbird")


def test_one_that_does_not_connect(program, monkeypatch):
    program.write_text("#!/bin/sh\nsleep 60\n")
    monkeypatch.setattr(px4, "CONNECT", 0.2)
    with pytest.raises(PeerSilent, match=r"px4: expected it to connect to port 45\d\d, got"):
        flown(program, "hummingbird")


WRONG_TIME = """
import socket, sys, threading
from pymavlink.dialects.v20 import common
peer = socket.create_connection(("127.0.0.1", 4560 + int(sys.argv[2])))
hil = common.MAVLink(peer.makefile("wb", 0), 1, 1)
def talk():
    while {talks}:
        hil.hil_actuator_controls_send({time}, [{throttle}] * 16, 0, 1)
threading.Thread(target=talk, daemon=True).start()
hil.hil_actuator_controls_send({time}, [{throttle}] * 16, 0, 1)
while peer.recv(65536):
    pass
"""


def test_one_that_ends_before_it_connects_says_what_it_said(program, monkeypatch):
    monkeypatch.setattr(px4, "CONNECT", 0.5)
    program.write_text("#!/bin/sh\necho no model\nexit 3\n")
    with pytest.raises(PeerClosed, match=r"^px4: ended with status 3: no model$"):
        flown(program, "hummingbird")


def test_outputs_of_another_time_are_late(program, monkeypatch):
    monkeypatch.setattr(px4, "UNHEARD", 5.0)  # the first step, too, gets its outputs
    text = WRONG_TIME.format(talks=False, time=2**62, throttle=0.6)
    write_program(program, text)
    _, tally = flown(program, "hummingbird", episode_length=10)
    assert tally.faults == []
    assert tally.late == tally.steps


def test_one_that_repeats_old_outputs_is_named(program, monkeypatch):
    monkeypatch.setattr("rotorgram.autopilots.programs.ANSWER", 0.5)
    write_program(program, WRONG_TIME.format(talks=True, time=5, throttle=0))
    sentence = r"^px4: expected an answer within 5 s, got none$"
    with pytest.raises(PeerSilent, match=sentence):
        flown(program, "hummingbird")


def test_a_seat_that_nobody_holds_ends_its_program(program, monkeypatch):
    folders = program.parent / "folders"
    folders.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folders))
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", vehicle="hummingbird")
    config = seated(config, STACK.rate)
    stack = STACK.make(Start(config, config.load_vehicle(), "offboard", program))
    assert len(list(folders.iterdir())) == 1
    del stack
    assert not list(folders.iterdir())


def test_a_port_in_use_is_named(program, monkeypatch):
    monkeypatch.setattr("rotorgram.autopilots.protocol.px4.PORT", 46600)  # others fly by 4560
    with ExitStack() as taken:
        for port in range(46600, 46616):
            with suppress(OSError):
                taken.enter_context(socket.create_server(("127.0.0.1", port)))
        with pytest.raises(InputError, match=r"expected that port 466\d\d is free, got one in use"):
            flown(program, "hummingbird")


def test_several_fly_one_world(program):
    flights, tally = flown(
        program, "hummingbird", "rotorgram/Crossing-v0", drones=2, episode_length=400
    )
    assert tally.faults == []
    assert tally.late == 0
    assert [one.ending for one in flights] == ["truncated", "truncated"]
    for one in flights:
        assert one.headline[-1] < 0.1
