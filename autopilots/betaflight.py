"""Betaflight in the seat: its program, in lock-step or in real time, flown by sticks."""

import math
import socket
import time
from collections.abc import Iterator
from contextlib import closing
from functools import cache
from pathlib import Path

import numpy as np

from ..agents.policies import Observation
from ..models import InputError, Vehicle
from ..models.matrices import right_inverse
from ..sim.control.gains import Gains
from .programs import ANSWER, HOST, Program
from .protocol import betaflight as protocol
from .reading import Floats, Order, Propellers, Reading
from .seat import Stack, Start
from .sticks import StickPilot

BOOT = 8.0
"""Time until it arms, s of its clock: the gyro's calibration, and the grace after power on."""
ARMING = 0.5
"""Time with the throttle down after the switch, s."""
IDLE = 0.055
"""Throttle of its motors while they idle."""
FULL_ANGLE = 60.0
"""Angle of a full stick, °."""
APART = 10
"""Between the ports of two programs."""
MOST_MOTORS = 8
AT_ONCE = 8
"""Commands that its CLI is given together: they and the answers fit into its buffers."""
MORE_STARTS = 4
"""Most starts of a program after the first one, until its CLI answers."""
CLI_ANSWER = 2.0
"""Longest time for an answer of its CLI, s."""
FOREVER = 10**6
"""Longer than a program is configured, s of its clock."""
_PROMPT = "# "
_LOWEST = 1050.0  # µs: throttle 0
_ARM, _ANGLE = 4, 5  # channels
_AXES = ("roll", "pitch", "yaw")
_MEMORY = "eeprom.bin"
_SOURCE = Path(__file__).with_name("betaflight_lockstep.c")
_CONFIG = """\
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
REFERENCE_LAG = 0.02
"""Lag of the rotors for which its default gains are made, s."""
_RATE_GAIN = 94.0
"""Rate loops of roll and pitch of its default gains on a racer of 0.68 kg, 1/s."""
_FASTER = 5.25
"""Limit of the same, over those of our loops."""
_PER_P = math.degrees(0.032029) / 1000.0
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


def new_program(lockstep: bool, alone: int = 2) -> tuple[Program, dict[str, str]]:
    """A program that may run, and its environment. In lock-step it has ports of its own. Its clock
    first runs by itself for `alone` s, as fast as it can; then it waits for the first state.
    """
    ports = (protocol.STATE_PORT, protocol.STICKS_PORT)
    program = Program("betaflight", protocol.MOTORS_PORT, ports, APART if lockstep else 0)
    if not lockstep:
        return program, {}
    environment = {"LD_PRELOAD": program.library(_SOURCE), "BETAFLIGHT_LOCKSTEP": str(alone)}
    return program, environment | {"BETAFLIGHT_APART": str(program.moved)}


def _connected(port: int, deadline: float) -> socket.socket:
    """A connection to its CLI."""
    while True:
        try:
            return socket.create_connection((HOST, port), 0.5)
        except (ConnectionRefusedError, TimeoutError):  # it does not listen yet
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)


def _told(link: socket.socket, *commands: str, end: str = _PROMPT) -> str:
    """The answer of its CLI to commands: it echoes each, and ends with a prompt."""
    link.sendall("".join(f"{command}\r\n" for command in commands).encode())
    answer = ""
    deadline = time.monotonic() + CLI_ANSWER
    while not answer.endswith(end) or commands[-1] not in answer:
        if time.monotonic() > deadline:
            raise TimeoutError(f"no end of its answer to {commands[-1]!r}")
        try:
            part = link.recv(4096)
        except TimeoutError:
            link.sendall(b"\r\n")  # it may keep its last words until it has more to say
            continue
        if not part:
            break
        answer += part.decode(errors="replace")
    for command, said in zip(commands, answer.split(_PROMPT), strict=False):
        if "###ERROR" in said:
            raise InputError(
                f"betaflight: expected that it takes {command!r}, got {said.strip()!r}"
            )
    return answer


@cache
def configured(
    path: Path | None, commands: tuple[str, ...], lockstep: bool, more: int = MORE_STARTS
) -> tuple[tuple[int, int], bytes]:
    """A program's release, year and month, and its memory after commands of its CLI. It runs once
    for this. It is started anew, at most `more` times, where its CLI does not answer: if it starts
    slowly, one of its threads may close the CLI's port.

    Raises `InputError`, or `PeerSilent`.
    """
    program, environment = new_program(lockstep, FOREVER)
    with closing(program):
        program.start(path, environment=environment)
        deadline = time.monotonic() + ANSWER if path else math.inf
        try:
            with _connected(protocol.CLI_PORT + program.moved, deadline) as link:
                _told(link, "#")  # it wants silence behind this, 0.1 s of its clock
                link.settimeout(0.05)
                version = protocol.version_of(_told(link, "version"))
                for first in range(0, len(commands), AT_ONCE):
                    _told(link, *commands[first : first + AT_ONCE])
                _told(link, "save", end="Rebooting")
            return version, (program.folder / _MEMORY).read_bytes()
        except OSError as error:
            if not (path and more and isinstance(error, TimeoutError)):
                raise program.silent(f"its CLI, got none: {error}") from None
    return configured(path, commands, lockstep, more - 1)


class Betaflight(Stack):
    """A program of Betaflight's SITL, with the switches ARM and ANGLE."""

    boot = BOOT
    why = "it does not arm"

    def __init__(self, start: Start) -> None:
        config, vehicle, mode, path, real_time, pilot = start
        rotors = vehicle.num_rotors
        if rotors > MOST_MOTORS:
            raise InputError(
                f"betaflight: expected at most {MOST_MOTORS} rotors, "
                f"got {vehicle.name} with {rotors}"
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
        version, memory = configured(path, commands, not real_time)
        if not self._pilot.acro:
            full[:2] = FULL_ANGLE
        self._full = np.radians(full) * (1.0, 1.0, -1.0)
        self._yaw = protocol.yaw_of(version)
        self._channels = [1500.0, 1500.0, 1000.0, 1500.0, 1000.0, 1000.0]
        self._ordered = math.inf  # time of the first order
        self._real_time = real_time
        program, environment = new_program(not real_time)
        super().__init__(program, rotors)
        (program.folder / _MEMORY).write_bytes(memory)
        own_period = config.control_period if real_time else None
        program.start(path, environment=environment, period=own_period)
        program.meet(self._read)

    def _tell(self, reading: Reading, order: Order | None, observation: Observation) -> None:
        if order is not None:
            self._move_sticks(reading, order, observation)
        if self._steps % self.order_every == 0:
            sticks = protocol.sticks_packet(reading.time, self._channels)
            self._program.send(sticks, protocol.STICKS_PORT)
        # A stock program would take stamps for the speed of time: its own is constant.
        stamp = 1.0 if self._real_time else reading.time
        state = protocol.state_packet(reading, stamp, self._yaw)
        self._program.send(state, protocol.STATE_PORT)

    def _read(self, datagram: bytes) -> Floats:
        return protocol.throttles(datagram, len(self._throttles))

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
