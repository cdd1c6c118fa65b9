"""The Crazyflie's firmware in the seat: its program (SITL), in lock-step."""

import time
from typing import Final

import numpy as np

from ..agents.policies import Observation
from ..models import InputError
from . import find_stack
from .programs import ANSWER, HOST, Program
from .protocol import crazyflie as protocol
from .reading import Floats, Order, Reading
from .seat import Start

BOOT: Final = 4.0
"""Time until it takes goals, s of its clock: it finds the gyro's bias from 1024 samples at rest."""
POSE_EVERY: Final = 10
"""Steps between two poses, as motion capture gives them at 100 Hz."""
GOAL_EVERY: Final = 20
LOCKSTEP_PORT: Final = 19960


class Crazyflie:
    """A program of the firmware whose clock goes on by 1 ms for each datagram to its lock-step
    port, which it sends back when all tasks wait.
    """

    def __init__(self, start: Start) -> None:
        _, vehicle, mode, program, _ = start
        if vehicle.num_rotors != 4:
            raise InputError(f"crazyflie: expected a quadcopter, got {vehicle.name}")
        self._controller = find_stack("crazyflie").modes.index(mode)
        self._steps = 0
        self._throttles = np.zeros(4)
        self.ready = False
        self.why = "the firmware gives no thrust"
        self.late = 0
        self._program = Program("crazyflie", protocol.PORT, (LOCKSTEP_PORT,))
        self._link = self._program.link
        self._clock = self._program.listen(0)
        words = [str(protocol.PORT), HOST]
        self._program.start(program, words, {"CF_LOCKSTEP_PORT": str(LOCKSTEP_PORT)})
        self._link.settimeout(ANSWER)
        hello, self._there = self._link.recvfrom(64)
        if hello != protocol.HELLO:
            raise InputError(f"crazyflie: expected its greeting, got {hello.hex()}")
        self._send(protocol.HELLO)
        self._link.setblocking(False)
        self._clock.connect((HOST, LOCKSTEP_PORT))

    def step(self, reading: Reading, order: Order | None, observation: Observation) -> Floats:
        """As `Stack.step`."""
        self.ready = reading.time >= BOOT
        if self._steps % POSE_EVERY == 0:
            self._send(protocol.pose_packet(reading))
        if order is not None and self._steps % GOAL_EVERY == 0:
            self._send(protocol.goal_packet(order))
        if self._steps == round(BOOT * protocol.RATE) and self._controller:
            packet = protocol.parameter_packet("stabilizer", "controller", self._controller)
            self._send(packet)
        self._send(protocol.imu_packet(reading))
        self._tick()
        self._steps += 1
        return self._throttles

    def _tick(self) -> None:
        """Let its clock go on, and take what it sent meanwhile."""
        deadline = time.monotonic() + ANSWER
        while True:
            try:
                self._clock.send(b"tick")
                self._program.receive(self._clock)
                break
            except ConnectionRefusedError:  # it does not listen yet
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.01)
        while True:
            try:
                packet = self._link.recv(64)
            except BlockingIOError:
                return
            throttles = protocol.throttles(packet)
            if throttles is not None:
                self._throttles = throttles

    def _send(self, packet: bytes) -> None:
        self._link.sendto(packet, self._there)

    def close(self) -> None:
        """As `Stack.close`."""
        self._program.close()
