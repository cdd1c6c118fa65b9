"""Betaflight in the seat: its program, in lock-step or in real time, flown by sticks."""

import math
import subprocess
from pathlib import Path
from typing import Final

import numpy as np

from ..agents.policies import Observation
from ..models import InputError, Vehicle
from ..sim.control.gains import Gains
from .programs import Program, compiled
from .protocol import betaflight as protocol
from .reading import Floats, Order, Propellers, Reading
from .seat import Start
from .sticks import PERIOD, StickPilot

BOOT: Final = 8.0
"""Time until it arms, s of its clock: the gyro's calibration, and the grace after power on."""
ARMING: Final = 0.5
"""Time with the throttle down after the switch, s."""
IDLE: Final = 0.055
"""Throttle of its motors while they idle."""
FULL_RATE: Final = 670.0
"""Yaw rate of a full stick, °/s."""
FULL_ANGLE: Final = 60.0
"""Angle of a full stick, °."""
_LOWEST: Final = 1050.0  # µs: throttle 0
_ARM, _ANGLE = 4, 5  # channels
_SOURCE: Final = Path(__file__).with_name("betaflight_lockstep.c")
_CONFIG: Final = """\
aux 0 0 0 1700 2100 0 0
aux 1 1 1 1700 2100 0 0
set acc_calibration = 0,0,0,1
set small_angle = 180
set roll_rc_rate = 67
set pitch_rc_rate = 67
set yaw_rc_rate = 67
set simplified_pids_mode = OFF
"""
REFERENCE_LAG: Final = 0.02
"""Lag of the rotors for which its default gains are made, s."""
_RATE_GAIN: Final = 94.0
"""Rate loops of roll and pitch of its default gains on a racer of 0.68 kg, 1/s."""
_PER_P: Final = math.degrees(0.032029) / 1000.0
"""Mixer output of a gain P of 1 for an error of 1 rad/s."""


def tuning(vehicle: Vehicle, propellers: Propellers) -> dict[str, int]:
    """Gains that make its loops as fast on this vehicle as the defaults do on a racer, slower by as
    much as the rotors' lag is longer.
    """
    lag = vehicle.coefficients["rotors.time_constant"] or REFERENCE_LAG
    slower = max(lag / REFERENCE_LAG, 1.0)
    gains: dict[str, float] = {"angle_p_gain": min(50.0, 2.0 / lag)}
    *_, pitch, yaw = Gains.of(vehicle, PERIOD, max(lag, REFERENCE_LAG)).rate
    fast = min(_RATE_GAIN / slower, 5.25 * pitch)
    for axis, (name, gain) in enumerate((("roll", fast), ("pitch", fast), ("yaw", yaw))):
        torque = abs(vehicle.allocation[1 + axis]) @ propellers.slope
        p = gain / (_PER_P * torque / vehicle.inertia[axis, axis])
        gains |= {f"p_{name}": p, f"i_{name}": 1.8 * p / slower, f"f_{name}": 0.0}
        if name != "yaw":
            gains |= dict.fromkeys((f"d_{name}", f"d_max_{name}"), 0.7 * p * slower)
    return {name: min(round(value), 250) for name, value in gains.items()}


class Betaflight:
    """A program of Betaflight's SITL in lock-step, with the switches ARM and ANGLE."""

    def __init__(self, start: Start) -> None:
        config, vehicle, _, program, _ = start
        self._dialect = protocol.dialect_of((2026, 6))
        self._order = motor_order(vehicle, self._dialect.motors)
        self._high = float(vehicle.thrust_high.sum())
        self._weight = vehicle.mass * vehicle.gravity
        self._propellers = Propellers(config, vehicle)
        self._pilot = StickPilot(config, vehicle)
        self._sticks_every = round(PERIOD * protocol.RATE)
        self._channels = [1500.0, 1500.0, 1000.0, 1500.0, 1000.0, 1000.0]
        self._steps = 0
        self._ordered = math.inf  # time of the first order
        self.ready = False
        self.why = "it does not arm"
        self.late = 0
        ports = (protocol.STATE_PORT, protocol.STICKS_PORT)
        self._program = Program("betaflight", protocol.MOTORS_PORT, ports)
        library = compiled(_SOURCE, self._program.folder)
        self._configure(program, vehicle)
        self._program.start(program, environment={"LD_PRELOAD": str(library)})
        self._program.receive()  # it has booted

    def _configure(self, program: Path, vehicle: Vehicle) -> None:
        first = vehicle.rotors[self._order[0]]
        turns = "OFF" if first.reaction[2] > 0.0 else "ON"
        file = self._program.folder / "config.txt"
        settings = {**tuning(vehicle, self._propellers), "yaw_motors_reversed": turns}
        lines = [f"set {name} = {value}\n" for name, value in settings.items()]
        file.write_text(_CONFIG + "".join(lines))
        subprocess.run(
            [program, "--config", file.name],
            cwd=self._program.folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=60,
        )

    def step(self, reading: Reading, order: Order | None, observation: Observation) -> Floats:
        """As `Stack.step`."""
        self.ready = reading.time >= BOOT
        if order is not None:
            self._ordered = min(self._ordered, reading.time)
        if self._steps % self._sticks_every == 0:
            self._move_sticks(reading, order, observation)
            self._program.send(
                protocol.sticks_packet(reading.time, self._channels), protocol.STICKS_PORT
            )
        self._steps += 1
        self._program.send(protocol.state_packet(reading, self._dialect), protocol.STATE_PORT)
        throttles = np.zeros(len(self._order))
        throttles[self._order] = protocol.throttles(self._program.receive())
        return throttles

    def _move_sticks(self, reading: Reading, order: Order | None, observation: Observation) -> None:
        if reading.time < self._ordered:
            return
        self._channels[_ARM] = self._channels[_ANGLE] = 2000.0
        if reading.time < self._ordered + ARMING:
            return
        if order is not None and order.stands:
            demands = np.array((self._weight, 0.0, 0.0, 0.0))
        else:
            demands = self._pilot.demands(reading, observation)
        thrust, roll, pitch, yaw_rate = demands.tolist()
        throttle = self._propellers.throttle(thrust / self._high)
        self._channels[:4] = (
            1500.0 + 500.0 * math.degrees(roll) / FULL_ANGLE,
            1500.0 + 500.0 * math.degrees(pitch) / FULL_ANGLE,
            _LOWEST + (2000.0 - _LOWEST) * (throttle - IDLE) / (1.0 - IDLE),
            1500.0 - 500.0 * math.degrees(yaw_rate) / FULL_RATE,
        )

    def close(self) -> None:
        """As `Stack.close`."""
        self._program.close()


def motor_order(vehicle: Vehicle, motors: tuple[tuple[int, int], ...]) -> list[int]:
    """The rotor at the place of each motor. Raises `InputError` for another craft."""
    places = [np.sign(np.round(rotor.position[:2], 6)).astype(int) for rotor in vehicle.rotors]
    found = [tuple(place.tolist()) for place in places]
    if sorted(found) != sorted(motors):
        raise InputError(
            "betaflight: expected a quadcopter with a rotor in each corner, "
            f"got {vehicle.name} with rotors at {found}"
        )
    return [found.index(motor) for motor in motors]
