"""Betaflight in the seat: its program, in lock-step or in real time, flown by sticks."""

import math
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from ..agents.policies import Observation
from ..models import InputError, Vehicle
from ..models.matrices import right_inverse
from ..sim.control.gains import Gains
from .programs import ANSWER, HOST, Program, compiled
from .protocol import betaflight as protocol
from .reading import Floats, Order, Propellers, Reading
from .seat import Start
from .sticks import Pilot, StickPilot

BOOT: Final = 8.0
"""Time until it arms, s of its clock: the gyro's calibration, and the grace after power on."""
ARMING: Final = 0.5
"""Time with the throttle down after the switch, s."""
IDLE: Final = 0.055
"""Throttle of its motors while they idle."""
FULL_ANGLE: Final = 60.0
"""Angle of a full stick, °."""
APART: Final = 10
"""Between the ports of two programs."""
MOST_MOTORS: Final = 8
_LOWEST: Final = 1050.0  # µs: throttle 0
_ARM, _ANGLE = 4, 5  # channels
_AXES = ("roll", "pitch", "yaw")
_BEHIND: Final = 0.005  # s: a longer delay is not made up for
_MEMORY: Final = "eeprom.bin"
_SOURCE: Final = Path(__file__).with_name("betaflight_lockstep.c")
_CONFIG: Final = """\
aux 0 0 0 1700 2100 0 0
aux 1 1 1 1700 2100 0 0
set acc_calibration = 0,0,0,1
set small_angle = 180
set rc_smoothing = OFF
set simplified_pids_mode = OFF
set yaw_motors_reversed = ON
set tpa_rate = 0
set throttle_boost = 0
set anti_gravity_gain = 0
set angle_feedforward = 0
mixer CUSTOM
mmix reset
"""
REFERENCE_LAG: Final = 0.02
"""Lag of the rotors for which its default gains are made, s."""
_RATE_GAIN: Final = 94.0
"""Rate loops of roll and pitch of its default gains on a racer of 0.68 kg, 1/s."""
_FASTER: Final = 5.25
"""Limit of the same, over those of our loops."""
_PER_P: Final = math.degrees(0.032029) / 1000.0
"""Mixer output of a gain P of 1 for an error of 1 rad/s."""


def configuration(
    vehicle: Vehicle, propellers: Propellers, gains: Gains, full_rates: Floats, matches: bool
) -> Iterator[str]:
    """Commands of its CLI for a vehicle: the mixer, with motors in the order of the rotors, the
    rates of full sticks, °/s, shape (3,), and the gains, by those of our loops.

    Its rate loops of roll and pitch are as fast on this vehicle as the defaults are on a racer,
    slower where the rotors' lag is longer. If it `matches` they are as fast as our loops.
    """
    yield from _CONFIG.splitlines()
    mix = right_inverse(vehicle.allocation)[:, 1:]
    mix = mix / np.abs(mix).max(axis=0)
    for motor, shares in enumerate(mix.tolist()):
        yield f"mmix {motor} 1.0 " + " ".join(f"{share:.4f}" for share in shares)
    lag = vehicle.coefficients["rotors.time_constant"] or REFERENCE_LAG
    slower = max(lag / REFERENCE_LAG, 1.0)
    settings = {"angle_p_gain": 10.0 * gains.attitude, "iterm_relax_cutoff": 15.0 / slower}
    torques = vehicle.allocation[1:] * propellers.slope * mix.T
    per_ps = torques.sum(axis=1) / vehicle.inertia.diagonal() * _PER_P
    fast = gains.rate[0] if matches else min(_RATE_GAIN / slower**0.7, _FASTER * gains.rate[0])
    integral = 1.8 * (fast / _RATE_GAIN) ** 3
    rates = fast, fast, gains.rate[2]
    for name, rate, per_p, full in zip(_AXES, rates, per_ps, full_rates, strict=True):
        p = rate / per_p
        settings |= {f"p_{name}": p, f"i_{name}": integral * p, f"f_{name}": 0.0}
        settings[f"{name}_rc_rate"] = full / 10.0
        if name != "yaw":
            settings |= dict.fromkeys((f"d_{name}", f"d_max_{name}"), 0.7 * p * slower)
    for name, value in settings.items():
        yield f"set {name} = {min(round(value), 250)}"


class Firmware(NamedTuple):
    """A program's release, and its memory with a configuration."""

    version: tuple[int, int]
    """Year and month."""
    memory: bytes


class Running(Program):
    """A program of Betaflight that may run: in lock-step with ports of its own."""

    def __init__(self, path: Path | None, lockstep: bool) -> None:
        ports = (protocol.STATE_PORT, protocol.STICKS_PORT)
        super().__init__("betaflight", protocol.MOTORS_PORT, ports, APART if lockstep else 0)
        self.apart = self.number * APART
        self._path = path
        self._environment: dict[str, str] = {}
        if lockstep:
            library = compiled(_SOURCE, self.folder)
            self._environment = {"LD_PRELOAD": str(library), "BETAFLIGHT_APART": str(self.apart)}

    def fly(self, memory: bytes, motors: int) -> None:
        """Start it with a memory, and wait until it has booted."""
        (self.folder / _MEMORY).write_bytes(memory)
        environment = {**self._environment, "BETAFLIGHT_LOCKSTEP": "1"}
        self.start(self._path, environment=environment, own_clock=not self._environment)
        self.meet(lambda datagram: protocol.throttles(datagram, motors))

    def tell(self, datagram: bytes, port: int) -> None:
        """Send to one of its ports, given as of the first program."""
        self.send(datagram, port + self.apart)

    def configured(self, commands: Sequence[str]) -> Firmware:
        """Start it, and give commands to its CLI. Raises `InputError`, or `PeerSilent`."""
        self.start(self._path, environment=self._environment)
        try:
            with self._connected() as link:
                _told(link, "#")  # it wants silence behind this, 0.1 s of its clock
                link.settimeout(0.05)
                version = protocol.version_of(_told(link, "version"))
                for command in commands:
                    _told(link, command)
                _told(link, "save", "Rebooting")
            memory = (self.folder / _MEMORY).read_bytes()
        except OSError as error:
            raise self.silent(f"its CLI, got none: {error}") from None
        return Firmware(version, memory)

    def _connected(self) -> socket.socket:
        deadline = time.monotonic() + ANSWER
        while True:
            try:
                return socket.create_connection((HOST, protocol.CLI_PORT + self.apart), 0.5)
            except (ConnectionRefusedError, TimeoutError):  # it does not listen yet
                if self._path and time.monotonic() > deadline:
                    raise
                time.sleep(0.01)


def _told(link: socket.socket, command: str, end: str = "# ") -> str:
    """The answer of its CLI to a command."""
    link.sendall(f"{command}\r\n".encode())
    answer = ""
    deadline = time.monotonic() + ANSWER
    while not answer.endswith(end):
        if time.monotonic() > deadline:
            raise TimeoutError(f"no end of its answer to {command!r}")
        try:
            part = link.recv(4096)
        except TimeoutError:
            link.sendall(b"\r\n")  # it may keep its last words until it has more to say
            continue
        if not part:
            break
        answer += part.decode(errors="replace")
    if "###ERROR" in answer:
        raise InputError(f"betaflight: expected that it takes {command!r}, got {answer.strip()!r}")
    return answer


@cache
def configured(path: Path | None, commands: tuple[str, ...], lockstep: bool) -> Firmware:
    """What a program becomes by commands of its CLI. It runs once for this."""
    running = Running(path, lockstep)
    with closing(running):
        return running.configured(commands)


class Betaflight:
    """A program of Betaflight's SITL, with the switches ARM and ANGLE."""

    def __init__(self, start: Start, pilot: Pilot | None = None) -> None:
        config, vehicle, mode, program, real_time = start
        self._rotors = vehicle.num_rotors
        if self._rotors > MOST_MOTORS:
            raise InputError(
                f"betaflight: expected at most {MOST_MOTORS} rotors, "
                f"got {vehicle.name} with {self._rotors}"
            )
        self._high = float(vehicle.thrust_high.sum())
        self._weight = vehicle.mass * vehicle.gravity
        self._propellers = Propellers(config, vehicle)
        self._pilot = StickPilot(config, vehicle, pilot, mode == "acro")
        period = 1000.0 * self._pilot.period
        self.order_every = round(period)
        if not math.isclose(period, self.order_every):
            raise InputError(
                f"policy: expected a control period of whole ms with betaflight, got {period:g} ms"
            )
        gains = self._pilot.gains
        full = 10.0 * np.clip(np.ceil(np.degrees(gains.most_rate) / 10.0), 1.0, 199.0)
        matches = pilot is not None and pilot.matches
        commands = tuple(configuration(vehicle, self._propellers, gains, full, matches))
        version, memory = configured(program, commands, not real_time)
        if not self._pilot.acro:
            full[:2] = FULL_ANGLE
        self._full = np.radians(full) * (1.0, 1.0, -1.0)
        self._yaw = protocol.yaw_of(version)
        self._channels = [1500.0, 1500.0, 1000.0, 1500.0, 1000.0, 1000.0]
        self._steps = 0
        self._ordered = math.inf  # time of the first order
        self._throttles = np.zeros(self._rotors)
        self.ready = False
        self.why = "it does not arm"
        self.late = 0
        self._program = Running(program, not real_time)
        self._program.fly(memory, self._rotors)
        self._due = self._heard = math.nan
        if real_time:
            self._due = self._heard = time.monotonic()
            self._program.link.setblocking(False)

    def step(self, reading: Reading, order: Order | None, observation: Observation) -> Floats:
        """As `Stack.step`."""
        self.ready = reading.time >= BOOT
        if order is not None:
            self._move_sticks(reading, order, observation)
        if self._steps % self.order_every == 0:
            sticks = protocol.sticks_packet(reading.time, self._channels)
            self._program.tell(sticks, protocol.STICKS_PORT)
        self._steps += 1
        # A stock program would take stamps for the speed of time: its own is constant.
        stamp = reading.time if math.isnan(self._due) else 1.0
        state = protocol.state_packet(reading, stamp, self._yaw)
        self._program.tell(state, protocol.STATE_PORT)
        received = self._program.receive() if math.isnan(self._due) else self._newest()
        if received is not None:
            self._throttles = protocol.throttles(received, self._rotors)
        else:
            self.late += 1
        return self._throttles

    def _newest(self) -> bytes | None:
        """What came last in a period of real time."""
        self._due = max(self._due, time.monotonic() - _BEHIND) + 1.0 / protocol.RATE
        time.sleep(max(self._due - time.monotonic(), 0.0))
        newest = None
        while True:
            try:
                newest = self._program.link.recv(2048)
            except BlockingIOError:
                break
        now = time.monotonic()
        if newest is not None:
            self._heard = now
        elif now - self._heard > ANSWER:
            return self._program.receive(wait=0.1)
        return newest

    def _move_sticks(self, reading: Reading, order: Order, observation: Observation) -> None:
        self._ordered = min(self._ordered, reading.time)
        self._channels[_ARM] = 2000.0
        self._channels[_ANGLE] = 1000.0 if self._pilot.acro else 2000.0
        if reading.time < self._ordered + ARMING:
            return
        if order.stands:
            demands = self._pilot.held(self._weight, reading)
        else:
            demands = self._pilot.demands(reading, observation)
        throttle = self._propellers.throttle(demands[0] / self._high)
        roll, pitch, yaw = (1500.0 + 500.0 * demands[1:] / self._full).tolist()
        height = _LOWEST + (2000.0 - _LOWEST) * (throttle - IDLE) / (1.0 - IDLE)
        self._channels[:4] = roll, pitch, height, yaw

    def close(self) -> None:
        """As `Stack.close`."""
        self._program.close()
