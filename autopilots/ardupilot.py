"""ArduCopter in the seat: its program (SITL) by the JSON interface, told where to fly by MAVLink.

Its clock is ours from the first step on: the flight has the same bits each time.
"""

import math
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from ..agents.policies import Observation
from ..models import InputError, Vehicle
from ..sim.control.gains import Gains
from .programs import HOST, Program, arrived
from .protocol import ardupilot as protocol
from .protocol.frames import ORIGIN, geodetic, north_east_down
from .reading import Floats, Order, Propellers, Reading
from .seat import Stack, Start

PERIOD = 0.01
"""Time that its filters and its loop need, s."""
MOST_ACCELERATION = 5.0
"""Largest horizontal acceleration on the way to a goal, m/s²."""
TALK_EVERY = 20
"""Steps between two messages to it."""
ASK_EVERY = 400
"""Steps between two requests for reports of its estimate, until they say that it is ready."""
MOVED = 0.05
"""Least distance between the goals of two missions, m."""
_EARTH = 6_378_100.0
"""Radius that it takes for the earth's, m: RADIUS_OF_EARTH."""
_TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
_NEAR = 25.0  # °: between a rotor and the place of its motor
_OPTIONS = (
    "--serial1=none:0",
    "--serial2=none:0",
    "--defaults=vehicle.parm",
    f"--home={ORIGIN[0]},{ORIGIN[1]},0,0",
    "--speedup=1000",
    "--start-time=1700000000",  # GPS tells it the time
)
_FORCED = 21196  # to arm without checks
_READY = (
    mavlink.EKF_ATTITUDE
    | mavlink.EKF_VELOCITY_HORIZ
    | mavlink.EKF_VELOCITY_VERT
    | mavlink.EKF_POS_HORIZ_REL
    | mavlink.EKF_POS_HORIZ_ABS
)
_POSITION_AND_YAW = 0b100111111000  # what a setpoint leaves out has its bit set


def motor_order(vehicle: Vehicle) -> tuple[int, int, list[int]]:
    """FRAME_CLASS, FRAME_TYPE, and the rotor at the place of each motor. Raises `InputError`."""
    x, y, _ = np.array([rotor.position for rotor in vehicle.rotors]).T
    places = np.degrees(np.arctan2(-y, x))
    turns = np.sign([rotor.reaction[2] for rotor in vehicle.rotors])
    for frame in _TABLES["frames"]:
        angles = np.array(frame["angles"])
        off = (places - angles[:, np.newaxis] + 180.0) % 360.0 - 180.0
        same_turn = turns == np.array(frame["turns"])[:, np.newaxis]
        matches = (np.abs(off) < _NEAR) & same_turn
        if len(angles) == len(places) and matches.any(axis=1).all():
            return frame["class"], frame["type"], matches.argmax(axis=1).tolist()
    raise InputError(
        "ardupilot: expected a quadcopter or a hexacopter, X or plus, with its turn directions, "
        f"got {vehicle.name} with rotors at {places.round().tolist()}° from the nose"
    )


def tuning(vehicle: Vehicle, propellers: Propellers) -> dict[str, float]:
    """Parameters of a vehicle: its loops are as fast as those of our own control levels."""
    lag = vehicle.coefficients["rotors.time_constant"] or 0.0
    gains = Gains.of(vehicle, PERIOD, lag)
    hover = propellers.share
    acceleration = min(MOST_ACCELERATION, gains.most_acceleration[0] / 2.0)
    levers = vehicle.allocation[1:]
    torques = levers**2 @ vehicle.thrust_high / np.abs(levers).max(axis=1)
    found: dict[str, float] = {
        "MOT_THST_HOVER": hover,
        "MOT_THST_EXPO": propellers.expo,
        "PSC_ACCZ_P": hover,
        "PSC_ACCZ_I": 2.0 * hover,
        "PSC_POSXY_P": gains.position,
        "PSC_VELXY_P": gains.velocity,
        "PSC_VELXY_I": gains.velocity / 2.0,
        "WPNAV_ACCEL": 100.0 * acceleration,  # cm/s²
    }
    angle_gains = (gains.attitude, gains.attitude, gains.heading)
    for axis, name in enumerate(("RLL", "PIT", "YAW")):
        turned = torques[axis] / vehicle.inertia[axis, axis] / 2.0  # rad/s² at its largest output
        p = gains.rate[axis] / turned
        found |= {
            f"ATC_ANG_{name}_P": angle_gains[axis],
            f"ATC_RAT_{name}_P": p,
            f"ATC_RAT_{name}_I": p * gains.attitude / 5.0,
            f"ATC_RAT_{name}_D": p * lag * 2.0 / 3.0,
            f"ATC_ACCEL_{name[0]}_MAX": 100.0 * math.degrees(hover * turned),  # 0.01°/s²
        }
    return found


class ArduPilot(Stack):
    """A program of ArduCopter's SITL. Its ports are free ones: many run side by side."""

    why = "its estimate has not begun"
    order_every = TALK_EVERY

    def __init__(self, start: Start) -> None:
        config, vehicle, mode, path, *_ = start
        self._auto = mode == "auto"
        self._goal = np.full(3, np.inf)
        frame_class, frame_type, self._order = motor_order(vehicle)
        values = _TABLES["parameters"] | tuning(vehicle, Propellers(config, vehicle))
        values |= {"FRAME_CLASS": frame_class, "FRAME_TYPE": frame_type}
        for sensor in config.sensors:
            values |= _TABLES["sensors"].get(sensor, {})
        self._origin: Floats | None = None
        self._optional: dict[str, object] = {}
        if any(config.effects.wind):
            wind = np.array(config.effects.wind)
            self._optional["velocity_wind"] = north_east_down(wind)
        self._commands = [
            (mavlink.MAV_CMD_DO_SET_MODE, 1, mavlink.COPTER_MODE_GUIDED),
            (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, _FORCED),
            (mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 1),
        ]
        program = Program("ardupilot", 0)
        super().__init__(program, len(self._order))
        self._talk = program.listen(0)
        self._mav = mavlink.MAVLink(SimpleNamespace(write=self._talk.send), srcSystem=255)
        self._mav.robust_parsing = True
        self._heard = False
        lines = [f"{name} {value:.6g}\n" for name, value in values.items()]
        (program.folder / "vehicle.parm").write_text("".join(lines))
        ports = [link.getsockname()[1] for link in (program.link, self._talk)]
        program.start(
            path,
            [
                f"--model=JSON:{HOST}",
                f"--sim-port-out={ports[0]}",
                f"--serial0=udpclient:{HOST}:{ports[1]}",
                *_OPTIONS,
            ],
        )
        self._frame = protocol.servos(program.meet(protocol.servos)).frame

    def _tell(self, reading: Reading, order: Order | None, observation: Observation) -> None:
        if self._origin is None:
            self._origin = reading.position
        if self._steps % TALK_EVERY == 0:
            self._listen()
            if self._heard:
                self._talk_of(order, self._origin)
        if "rangefinder" in observation:
            self._optional["rng_1"] = observation["rangefinder"].item()
        if "battery" in observation:
            self._optional["battery"] = {"voltage": observation["battery"].item()}
        self._program.send(protocol.state_line(reading, self._optional))

    def _read(self, datagram: bytes) -> Floats | None:
        """Throttles of the next frame. A frame comes again after a second of silence."""
        servos = protocol.servos(datagram)
        if servos.frame <= self._frame:
            return None
        self.late += servos.frame > self._frame + 1
        self._frame = servos.frame
        throttles = np.zeros(len(self._order))
        throttles[self._order] = servos.throttles[: len(self._order)]
        return throttles

    def _listen(self) -> None:
        """Take its messages."""
        data = b""
        for datagram, there in arrived(self._talk):
            self._talk.connect(there)
            data += datagram
            self._heard = True
        for message in self._mav.parse_buffer(data) or ():
            match message.get_type():
                case "STATUSTEXT":
                    self.why = message.text
                case "EKF_STATUS_REPORT":
                    self.ready = message.flags & _READY == _READY
                case "COMMAND_ACK" if self._commands and message.result == 0:
                    if message.command == self._commands[0][0]:
                        del self._commands[0]
                case "MISSION_REQUEST":
                    self._send_item(message.seq)
                case "MISSION_ACK" if message.type == 0:
                    self._commands = [(mavlink.MAV_CMD_MISSION_START,)]

    def _talk_of(self, order: Order | None, origin: Floats) -> None:
        """One message: a command until it is accepted, then the goal."""
        if not self.ready and self._steps % ASK_EVERY == 0:
            report = mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT
            self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, report, 100_000)
        elif order is not None and self._commands:
            self._command(*self._commands[0])
        elif order is None or order.stands:
            return
        elif self._auto:
            if np.linalg.norm(order.goal - self._goal) > MOVED:
                self._goal = order.goal
                self._mav.mission_count_send(1, 1, 2)
        else:
            goal = north_east_down(order.goal - origin)
            yaw = math.pi / 2 - order.heading
            moves = [0.0] * 6
            frame = mavlink.MAV_FRAME_LOCAL_NED
            fields = (0, 1, 1, frame, _POSITION_AND_YAW, *goal, *moves, yaw, 0)
            self._mav.set_position_target_local_ned_send(*fields)

    def _send_item(self, number: int) -> None:
        """Of a mission to the goal. Its first item, home, has no effect."""
        assert self._origin is not None
        latitude, longitude, _ = geodetic(self._goal, _EARTH)
        height = self._goal[2] - self._origin[2]
        frame = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
        place = latitude, longitude, height
        to = mavlink.MAV_CMD_NAV_WAYPOINT
        self._mav.mission_item_int_send(1, 1, number, frame, to, 0, 1, 1, 0, 0, 0, *place)

    def _command(self, number: int, *values: int) -> None:
        filled = (*values, *[0] * 7)[:7]
        self._mav.command_long_send(1, 1, number, 0, *filled)
