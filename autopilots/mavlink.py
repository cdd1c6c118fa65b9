"""MAVLink out: what ground stations and plotting tools need to show a flight."""

import socket
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common

from ..envs.autoreset import AdvancingVectorEnv
from ..envs.spec import EnvSpec
from ..flights.trajectories import Flights
from ..models import InputError
from ..udp.protocol.client import Address
from ..udp.protocol.party import Mask, World
from ..udp.transport.sockets import resolve
from .protocol import frames

Array = NDArray[np.float64]
Row = Mapping[str, Array]
"""Telemetry of a drone by name, shape (n,)."""
Flown = AdvancingVectorEnv | World
Frame = TypeVar("Frame")

POSE_PERIOD = 0.02
"""Least time between two poses of a drone, s of the clock on the wall: a flight that is faster than
real time would flood its receiver.
"""
BEAT_PERIOD = 1.0
"""Least time between two heartbeats, likewise."""
MOST_DRONES = 254
"""System 255 is the ground station."""
_NEEDED = ("position", "attitude", "velocity", "body_rates", "thrust")
_TYPES = {4: common.MAV_TYPE_QUADROTOR, 6: common.MAV_TYPE_HEXAROTOR}
_ACTUATORS = 32  # of a message
_CELLS = 10
_UNKNOWN = 65535
_FASTEST = 327.0  # m/s, of a message
_HIGHEST = 65.0  # V, likewise


class MavlinkOut:
    """Sends what the drones of the first world do as MAVLink, by UDP. Nothing is received.

    Drone i is system i + 1, a generic autopilot that is armed; drones from `MOST_DRONES` on are
    left out. Positions on earth are about `frames.ORIGIN`. `time_boot_ms` is the simulated time
    since the first step. Whether anybody receives does not matter.

    Raises `InputError` for an address that is none, or an env that does not tell a pose.
    """

    def __init__(
        self, where: Address, spec: EnvSpec, now: Callable[[], float] = time.monotonic
    ) -> None:
        spec.check_telemetry(_NEEDED, "mavlink")
        there = resolve(where, insecure=True)
        if not there[1]:
            raise InputError("mavlink: expected a port from 1 to 65535, got 0")
        drones = range(min(len(spec.agents), MOST_DRONES))
        self._period = spec.control_period
        self._steps = 0
        self._now = now
        self._pose_due = self._beat_due = now()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect(there)
        self._links = [common.MAVLink(self, drone + 1, 1) for drone in drones]

    def __call__(self, flown: Flown, begun: Mask | None) -> None:
        """Look at drones after a step, in which some episodes began, shape (N,)."""
        if begun is not None:
            self.say(begun, "begins")
        self.say(flown.terminated, "terminated")
        self.say(flown.truncated, "truncated")
        self.show(_rows_of(flown))

    def say(self, drones: Mask, event: str) -> None:
        """Tell what happened to the episode of some drones, shape (N,)."""
        for link, happened in zip(self._links, drones.tolist(), strict=False):
            if happened:
                link.statustext_send(common.MAV_SEVERITY_NOTICE, f"episode {event}".encode())

    def show(self, rows: Iterable[Row]) -> None:
        """Send what is due after a step, from the telemetry of each drone."""
        self._steps += 1
        now = self._now()
        if now < self._pose_due:
            return
        self._pose_due = max(self._pose_due + POSE_PERIOD, now)
        beats = now >= self._beat_due
        if beats:
            self._beat_due = now + BEAT_PERIOD
        time_ms = round(1000.0 * self._steps * self._period) % 2**32  # after 49 days from 0
        for link, row in zip(self._links, rows, strict=False):
            if beats:
                _send_beat(link, row)
            _send_pose(link, row, time_ms)

    def along(self, frames: Iterable[Frame], flights: Flights) -> Iterator[Frame]:
        """Frames of flights that began together; the step of each is sent when the next is asked
        for.
        """
        self.say(np.ones(len(flights), bool), "begins")
        for step, frame in enumerate(frames):
            yield frame
            self.show(one.row(step) for one in flights)
        for ending in ("terminated", "truncated"):
            self.say(np.array([one.ending == ending for one in flights]), ending)

    def write(self, datagram: bytes) -> None:
        """Send a message."""
        with suppress(OSError):  # nobody listens, or the buffer is full
            self._socket.send(datagram)

    def close(self) -> None:
        """Close the socket. It may be called again."""
        self._socket.close()


def _rows_of(flown: Flown) -> Iterator[Row]:
    telemetry = flown.telemetry
    for drone in range(len(flown.rewards)):
        yield {name: values[drone] for name, values in telemetry.items()}


def _send_beat(link: common.MAVLink, row: Row) -> None:
    kind = _TYPES.get(len(row["thrust"]), common.MAV_TYPE_GENERIC_MULTIROTOR)
    armed = common.MAV_MODE_FLAG_SAFETY_ARMED
    link.heartbeat_send(kind, common.MAV_AUTOPILOT_GENERIC, armed, 0, common.MAV_STATE_ACTIVE)
    if "battery" in row:
        charge, voltage = row["battery"].tolist()
        cells = [round(1000.0 * min(voltage, _HIGHEST))] + (_CELLS - 1) * [_UNKNOWN]
        link.battery_status_send(0, 0, 0, 32767, cells, -1, -1, -1, round(100.0 * charge))


def _send_pose(link: common.MAVLink, row: Row, time_ms: int) -> None:
    angles = frames.angles_of(row["attitude"])
    rates = frames.forward_right_down(row["body_rates"])
    position = frames.north_east_down(row["position"])
    velocity = frames.north_east_down(row["velocity"])
    speeds = [round(100.0 * speed) for speed in np.clip(velocity, -_FASTEST, _FASTEST)]
    place = frames.geodetic(row["position"])
    height = round(-1000.0 * position[2])
    heading = round(np.degrees(100.0 * angles[2])) % 36000
    thrusts = row["thrust"].tolist()
    rest = (_ACTUATORS - len(thrusts)) * [0.0]
    link.attitude_send(time_ms, *angles, *rates)
    link.local_position_ned_send(time_ms, *position, *velocity)
    link.global_position_int_send(time_ms, *place, height, *speeds, heading)
    link.actuator_output_status_send(1000 * time_ms, len(thrusts), thrusts + rest)
