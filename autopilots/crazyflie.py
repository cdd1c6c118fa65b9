"""The Crazyflie's firmware in the seat: its program (SITL), in lock-step or in real time."""

import math
import time
from pathlib import Path
from typing import Final

import numpy as np

from ..agents.policies import Observation
from ..models import InputError, Vehicle
from ..udp.protocol.errors import PeerSilent
from . import find_stack
from .programs import ANSWER, HOST, Program, compiled
from .protocol import crazyflie as protocol
from .reading import Floats, Order, Propellers, Reading
from .seat import Start

BOOT: Final = 4.0
"""Time until it takes goals, s of its clock: it finds the gyro's bias from 1024 samples at rest."""
POSE_EVERY: Final = 10
"""Steps between two poses, as motion capture gives them at 100 Hz."""
ORDER_EVERY: Final = 20
_CORNERS: Final = [[1, -1], [-1, -1], [-1, 1], [1, 1]]
"""Signs of x and y of its motors."""
_FULL: Final = 65535.0
_SHORTEST: Final = 1e-5  # s
_SOURCE: Final = Path(__file__).with_name("crazyflie_lockstep.c")


def parameters(vehicle: Vehicle, propellers: Propellers) -> list[bytes]:
    """Packets that tell the firmware mass, arm, curve and hover throttle of a vehicle."""
    hover = propellers.hover * _FULL
    curve = vehicle.coefficients["rotors.curve"] or (0.0, 0.0, 1.0)
    _, linear, square = vehicle.thrust_high[0] * np.array(curve)
    return [
        protocol.parameter_packet("posCtlPid", "thrustBase", "H", round(hover)),
        protocol.parameter_packet("ctrlMel", "mass", "f", vehicle.mass),
        protocol.parameter_packet(
            "ctrlMel", "massThrust", "f", hover / (vehicle.mass * protocol.G)
        ),
        protocol.parameter_packet(
            "quadSysId", "armLength", "f", math.hypot(*vehicle.rotors[0].position[:2])
        ),
        protocol.parameter_packet("quadSysId", "pwmToThrustA", "f", square),
        protocol.parameter_packet("quadSysId", "pwmToThrustB", "f", linear),
    ]


class Client:
    """A socket where a user's program, such as one with cflib, may talk to the firmware."""

    def __init__(self, program: Program, port: int) -> None:
        self._link = program.listen(port)
        self._link.setblocking(False)
        self._there: tuple[str, int] | None = None

    def take(self) -> bytes | None:
        """The next packet for the firmware."""
        try:
            packet, self._there = self._link.recvfrom(64)
        except (BlockingIOError, ConnectionError):
            return None
        if packet[:1] == protocol.NOTHING:
            self.give(protocol.NOTHING)
            return None
        return None if protocol.is_simulated(packet) else packet

    def give(self, packet: bytes) -> None:
        """Send what the firmware said, if there is a client."""
        if self._there is not None:
            self._link.sendto(packet, self._there)


class Crazyflie:
    """A program of the firmware, with a port for another client of it.

    In lock-step its clock goes on by 1 ms for each reading of the IMU; it answers with its motors
    or, without any, with an empty datagram. In real time it keeps its own clock.
    """

    def __init__(self, start: Start) -> None:
        config, vehicle, mode, program, self._real_time = start
        corners = [np.sign(rotor.position[:2]).tolist() for rotor in vehicle.rotors]
        if corners != _CORNERS:
            raise InputError(
                "crazyflie: expected four rotors, clockwise from the front right, "
                f"got {vehicle.name} with rotors at {corners}"
            )
        self._parameters = parameters(vehicle, Propellers(config, vehicle))
        controller = find_stack("crazyflie").modes.index(mode)
        if controller:
            packet = protocol.parameter_packet("stabilizer", "controller", "B", controller)
            self._parameters.append(packet)
        self._steps = 0
        self._throttles = np.zeros(4)
        self.order_every = ORDER_EVERY
        self.ready = False
        self.why = "the firmware gives no thrust"
        self.late = 0
        self._program = Program("crazyflie", protocol.PORT, (protocol.CLIENT_PORT,), apart=1)
        number = self._program.number
        self._client = Client(self._program, protocol.CLIENT_PORT + number)
        environment = {"LD_PRELOAD": str(compiled(_SOURCE, self._program.folder))}
        if self._real_time:
            environment["ROTORGRAM_OWN_CLOCK"] = "1"
        words = [str(protocol.PORT + number), HOST]
        self._program.start(program, words, environment, own_clock=self._real_time)
        self._program.meet(protocol.check_greeting)
        self._program.send(protocol.HELLO)
        self._due = self._heard = time.monotonic()

    def step(self, reading: Reading, order: Order | None, observation: Observation) -> Floats:
        """As `Stack.step`."""
        self.ready = reading.time >= BOOT
        if self._steps % POSE_EVERY == 0:
            self._program.send(protocol.pose_packet(reading))
        if order is not None:
            self._program.send(protocol.goal_packet(order))
        elif self.ready and self._parameters:
            self._program.send(self._parameters.pop())
        elif packet := self._client.take():
            self._program.send(packet)
        self._program.send(protocol.imu_packet(reading))
        self._steps += 1
        self._due = max(self._due + 1.0 / protocol.RATE, time.monotonic())
        answered = self._take_answers()
        if self._real_time and not answered:
            self.late += 1
        return self._throttles

    def _take_answers(self) -> bool:
        """Take what it sends in this step. Returns whether motors were in it."""
        answered = False
        while packet := self._receive():
            throttles = protocol.throttles(packet)
            if throttles is None:
                self._client.give(packet)
                continue
            self._throttles = throttles
            if not self._real_time:
                return True
            answered = True
            self._heard = time.monotonic()
        return answered

    def _receive(self) -> bytes:
        """Its next packet; an empty one where the step ends."""
        now = time.monotonic()
        is_silent = self.ready and now - self._heard > ANSWER
        if is_silent or not self._real_time:
            return self._program.receive()
        try:
            return self._program.receive(wait=max(self._due - now, _SHORTEST))
        except PeerSilent:
            return b""

    def close(self) -> None:
        """As `Stack.close`."""
        self._program.close()
