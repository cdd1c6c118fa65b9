"""The Crazyflie's firmware in the seat: its program (SITL), in lock-step or in real time."""

import math
from pathlib import Path

import numpy as np

from ..agents.export.crazyflie import MOTORS
from ..agents.policies import Observation
from ..models import InputError, Vehicle
from . import find_stack
from .programs import HOST, Program, arrived
from .protocol import crazyflie as protocol
from .reading import Floats, Order, Propellers, Reading
from .seat import Stack, Start

BOOT = 4.0
"""Time until it takes goals, s of its clock: it finds the gyro's bias from 1024 samples at rest."""
POSE_EVERY = 10
"""Steps between two poses, as motion capture gives them at 100 Hz."""
ORDER_EVERY = 20
PATIENCE = 5.0
"""Time from which the goal of a craft that still stands climbs, s of its clock."""
_CLIMB = np.array((0.0, 0.0, 0.1))
"""That climb, m/s: INDI takes thrust from a craft that does not move."""
_FULL = 65535.0
_SOURCE = Path(__file__).with_name("crazyflie_lockstep.c")


def parameters(vehicle: Vehicle, propellers: Propellers) -> list[bytes]:
    """Packets that tell the firmware mass, arm, curve and hover throttle of a vehicle."""
    hover = propellers.hover * _FULL
    curve = vehicle.coefficients["rotors.curve"] or (0.0, 0.0, 1.0)
    _, linear, square = vehicle.thrust_high[0] * np.array(curve)
    values = (
        ("posCtlPid", "thrustBase", "H", round(hover)),
        ("ctrlMel", "mass", "f", vehicle.mass),
        ("ctrlMel", "massThrust", "f", hover / (vehicle.mass * protocol.G)),
        ("quadSysId", "armLength", "f", math.hypot(*vehicle.rotors[0].position[:2])),
        ("quadSysId", "pwmToThrustA", "f", square),
        ("quadSysId", "pwmToThrustB", "f", linear),
    )
    return [protocol.parameter_packet(*value) for value in values]


class Client:
    """A socket where a user's program, such as one with cflib, may talk to the firmware."""

    def __init__(self, program: Program) -> None:
        self._link = program.listen(protocol.CLIENT_PORT)
        self._there: tuple[str, int] | None = None

    def take(self) -> bytes | None:
        """The next packet for the firmware."""
        for packet, sender in arrived(self._link):
            self._there = sender
            if packet[:1] == protocol.NOTHING:
                self.give(protocol.NOTHING)
            elif not protocol.is_simulated(packet):
                return packet
        return None

    def give(self, packet: bytes) -> None:
        """Send what the firmware said, if there is a client."""
        if self._there is not None:
            self._link.sendto(packet, self._there)


class Crazyflie(Stack):
    """A program of the firmware, with a port for another client of it.

    In lock-step its clock goes on by 1 ms for each reading of the IMU; it answers with its motors
    or, without any, with an empty datagram. In real time it keeps its own clock.
    """

    boot = BOOT
    why = "the firmware gives no thrust"
    order_every = ORDER_EVERY

    def __init__(self, start: Start) -> None:
        config, vehicle, mode, path, real_time, _ = start
        corners = np.sign([rotor.position[:2] for rotor in vehicle.rotors]).tolist()
        if not np.array_equal(corners, MOTORS):
            raise InputError(
                "crazyflie: expected four rotors, clockwise from the front right, "
                f"got {vehicle.name} with rotors at {corners}"
            )
        self._parameters = parameters(vehicle, Propellers(config, vehicle))
        controller = find_stack("crazyflie").modes.index(mode)
        if controller:
            packet = protocol.parameter_packet("stabilizer", "controller", "B", controller)
            self._parameters.append(packet)
        program = Program("crazyflie", protocol.PORT, (protocol.CLIENT_PORT,), apart=1)
        super().__init__(program, len(MOTORS))
        self._client = Client(program)
        environment = {"LD_PRELOAD": program.library(_SOURCE)}
        if real_time:
            environment["ROTORGRAM_OWN_CLOCK"] = "1"
        words = [str(protocol.PORT + program.moved), HOST]
        own_period = config.control_period if real_time else None
        program.start(path, words, environment, own_period)
        program.meet(protocol.check_greeting)
        program.send(protocol.HELLO)

    def _tell(self, reading: Reading, order: Order | None, observation: Observation) -> None:
        if self._steps % POSE_EVERY == 0:
            self._program.send(protocol.pose_packet(reading))
        if order is not None:
            if order.stands:
                order = order._replace(goal=order.goal + _CLIMB * max(reading.time - PATIENCE, 0.0))
            self._program.send(protocol.goal_packet(order))
        elif self.ready and self._parameters:
            self._program.send(self._parameters.pop())
        elif packet := self._client.take():
            self._program.send(packet)
        self._program.send(protocol.imu_packet(reading))

    def _read(self, datagram: bytes) -> Floats | None:
        if not datagram:
            return self._throttles
        throttles = protocol.throttles(datagram)
        if throttles is None:
            self._client.give(datagram)
        return throttles
