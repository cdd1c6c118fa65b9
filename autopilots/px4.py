"""PX4 in the seat: its program (SITL) in lock-step, flown by setpoints from outside (offboard)."""

import socket
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from pymavlink.dialects.v20 import common

from ..agents.policies import Observation
from ..models import InputError, Vehicle
from ..sim.control.gains import LEAD, Gains
from ..udp.protocol.errors import PeerClosed, PeerSilent
from .programs import ANSWER, HOST, Program, arrived
from .protocol import px4 as protocol
from .reading import Floats, Order, Propellers, Reading
from .seat import Stack, Start

BOOT = 5.0
"""Time until it gets orders, s of its clock: its estimate has to settle first."""
CONNECT = 30.0
"""Longest time until it connects, s."""
UNHEARD = 1.0 / protocol.RATE
"""Time that a step waits for outputs before there were any, s."""
_ABOVE = np.array((0.0, 0.0, 2.0))  # m: it lifts off for a goal above it alone
GPS_EVERY = 25
"""Steps between two fixes."""
ORDER_EVERY = 10
"""Steps between two setpoints: it wants more than two a second."""
COMMAND_EVERY = 250
"""Steps between two requests to arm and to fly by setpoints."""
LAG = 0.03
"""With which the rotors are taken to follow, s: its filters add to their own."""
_MAIN_MOTOR = 101  # function of an output: the first motor
_WE = (245, common.MAV_COMP_ID_ONBOARD_COMPUTER)
_BUILD = Path("build/px4_sitl_default")
_PARAMETERS = {
    "COM_RC_IN_MODE": 4.0,  # no sticks
    "SDLOG_MODE": -1.0,
    "MPC_TKO_RAMP_T": 0.0,  # its integrators would wind up while it stands under thrust
}


def parameters(vehicle: Vehicle, propellers: Propellers) -> dict[str, float]:
    """Its parameters for a vehicle: rotors, thrust and loops. Names are PX4's."""
    found = dict(_PARAMETERS)
    found["CA_ROTOR_COUNT"] = vehicle.num_rotors
    for number, rotor in enumerate(vehicle.rotors):
        x, y, _ = rotor.position
        found[f"CA_ROTOR{number}_PX"] = x
        found[f"CA_ROTOR{number}_PY"] = -y
        found[f"CA_ROTOR{number}_KM"] = -rotor.reaction[2]
        found[f"PWM_MAIN_FUNC{number + 1}"] = _MAIN_MOTOR + number
    found["THR_MDL_FAC"] = propellers.expo
    found["MPC_THR_HOVER"] = propellers.share
    found["MPC_THR_MIN"] = propellers.share / 4.0
    lag = vehicle.coefficients["rotors.time_constant"] or 0.0
    gains = Gains.of(vehicle, 1.0 / protocol.RATE, LEAD * max(lag, LAG))  # no lead of its own
    for axis, name in enumerate(("ROLL", "PITCH", "YAW")):
        levers = vehicle.allocation[1 + axis] * vehicle.thrust_high
        # Its mixer moves each rotor by sqrt(1/2) on average for a torque of 1; for yaw by 1.
        reach = np.sqrt(levers @ levers * np.count_nonzero(levers) / 2.0)
        if name == "YAW":
            reach = levers @ levers / abs(levers).max()
        gain = gains.rate[axis] * vehicle.inertia[axis, axis] / reach
        found[f"MC_{name}RATE_P"] = float(gain)
        found[f"MC_{name}RATE_I"] = float(gain)
        found[f"MC_{name}RATE_D"] = 0.0
        found[f"MC_{name}_P"] = gains.heading if name == "YAW" else gains.attitude
    for axes in ("XY", "Z"):
        found[f"MPC_{axes}_P"] = gains.position
        found[f"MPC_{axes}_VEL_P_ACC"] = gains.velocity
        found[f"MPC_{axes}_VEL_I_ACC"] = gains.velocity * gains.position / 4.0
    return found


class Px4(Stack):
    """A program of PX4's SITL, the model `none_iris` with the parameters of the vehicle.

    It connects, and gets sensors 250 times a second of its clock. While it boots it gives no
    outputs, and the next reading comes after a step of real time; from its first outputs on, each
    step waits for those of its reading.
    """

    boot = BOOT
    why = "it does not arm"
    order_every = ORDER_EVERY

    def __init__(self, start: Start) -> None:
        config, vehicle, _, path, *_ = start
        self._sent = 0  # time of the latest reading, µs
        self._time = 0  # of the latest outputs, µs; 0 before the first
        program = Program("px4", protocol.OFFBOARD_PORT, (protocol.ORDERS_PORT,), apart=1)
        super().__init__(program, vehicle.num_rotors)
        number = program.moved
        port = protocol.PORT + number
        root = path.parent.parent if path else _BUILD
        arguments = ["-i", str(number), "-d", str(root / "etc")]
        settings = parameters(vehicle, Propellers(config, vehicle)).items()
        environment = {f"PX4_PARAM_{name}": f"{value:.7g}" for name, value in settings}
        environment["PX4_SIM_MODEL"] = "none_iris"
        with _listening(port) as server:
            server.settimeout(CONNECT if path else None)
            program.start(path, arguments, environment)
            try:
                self._peer = program.keep(server.accept()[0])
            except TimeoutError:
                raise program.silent(f"it to connect to port {port}, got nothing") from None
        self._peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._hil = common.MAVLink(SimpleNamespace(write=self._peer.sendall), *_WE)
        self._hil.robust_parsing = True
        self._system = 1 + number
        there = (HOST, protocol.ORDERS_PORT + number)
        link = program.link  # and no `self`: the program ends when nobody holds this
        orders = SimpleNamespace(write=lambda datagram: link.sendto(datagram, there))
        self._offboard = common.MAVLink(orders, *_WE)
        self._offboard.robust_parsing = True

    def step(self, reading: Reading, order: Order | None, observation: Observation) -> Floats:
        """As `Stack.step`."""
        try:
            return super().step(reading, order, observation)
        except (BrokenPipeError, ConnectionResetError):
            raise PeerClosed("px4: expected outputs, got the end of its connection") from None

    def _tell(self, reading: Reading, order: Order | None, observation: Observation) -> None:
        if order is not None:
            self._order(order)
        if self._steps % GPS_EVERY == 0:
            self._hil.send(protocol.fix(reading))
        self._hil.send(protocol.sensors(reading))
        self._sent = protocol.microseconds(reading)
        self._program.sent_at = time.monotonic()

    def _answer(self) -> Floats | None:
        """As of `Stack`. Before its first outputs none are waited for; those of a later time come
        too early for their step.
        """
        while self._time < self._sent:
            wait = ANSWER if self._time else UNHEARD
            try:
                received = self._program.receive(self._peer, wait)
            except PeerSilent:
                if self._time:
                    raise
                return self._throttles
            if not received:
                raise ConnectionResetError
            throttles = self._read(received)
            if throttles is not None:
                self._throttles = throttles
        return self._throttles if self._time == self._sent else None

    def _read(self, datagram: bytes) -> Floats | None:
        throttles = None
        for message in self._hil.parse_buffer(datagram) or ():
            if message.get_type() == "HIL_ACTUATOR_CONTROLS":
                outputs = protocol.throttles(message)
                self._time = message.time_usec
                if self._time >= self._sent:
                    throttles = outputs[: len(self._throttles)]
        return throttles

    def _order(self, order: Order) -> None:
        """Send where to fly, and now and then to do so; hear what it says about it."""
        if order.stands:
            order = order._replace(goal=order.goal + _ABOVE)
        self._offboard.send(protocol.setpoint(order, self._system))
        if self._steps % COMMAND_EVERY:
            return
        for request in protocol.requests(self._system):
            self._offboard.send(request)
        for datagram, _ in arrived(self._program.link):
            for message in self._offboard.parse_buffer(datagram) or ():
                if message.get_type() == "STATUSTEXT":
                    begun = self.why if message.chunk_seq else ""
                    self.why = begun + message.text.rstrip()


def _listening(port: int) -> socket.socket:
    try:
        return socket.create_server((HOST, port))
    except OSError:
        raise InputError(f"px4: expected that port {port} is free, got one in use") from None
