"""A stand-in for the program `px4`, written from PX4's sources in our own words.

It knows nothing of rotorgram: NumPy and pymavlink alone.

* `simulator_mavlink`: connects to TCP 4560 + instance, asks for ground truth, says a heartbeat. A
  HIL_SENSOR of id 0 sets the clock. Outputs are sent from when the modules run, once for each
  update of the gyro, with the clock's time, in whole microseconds of PWM; they are 0 while
  disarmed.
* `DataValidator`: a magnetometer that repeats its values is not used.
* Startup script: parameters from variables PX4_PARAM_*, ports 14580 and 14540 for offboard.
* `commander`: arms when the estimate is there; offboard needs a second of setpoints, and ends a
  second after the last. Texts go to ground stations alone, in pieces of 50 characters.
* `mc_pos_control`, `mc_att_control`, `mc_rate_control`, `control_allocator`: their laws, with their
  parameters, in short. It takes off only for a goal above it, with a ramp of the largest velocity
  upwards, during which the integrators run. The estimator integrates the IMU and follows GPS with
  fixed gains; PX4's is an EKF.

The variable PEER_FAULT makes it fail at 12 s: dies, hangs, closes, nan; no_lockstep at once.
"""

import math
import os
import socket
import sys
import time

import numpy as np
from pymavlink.dialects.v20 import common

G = 9.80665
DECLINATION = math.radians(3.42)  # at Zurich
EARTH = 6_371_000.0
DOWN = np.array((0.0, 0.0, 1.0))
CUSTOM_OFFBOARD = 6


BOOT = 2.0
"""Time from the first sensors to the estimator on a slow machine, s."""


class Validator:
    """Of a magnetometer: whether it lives."""

    def __init__(self):
        self.last = np.zeros(3)
        self.equal = 0

    def lives(self, values):
        for before, value in zip(self.last, values, strict=True):
            self.equal = self.equal + 1 if abs(before - value) < 1e-6 else 0
        self.last = values
        return self.equal <= 1000


def parameter(name, default):
    return float(os.environ.get(f"PX4_PARAM_{name}", default))


def rotation(q):
    """From body to world, of a quaternion, scalar first."""
    w, x, y, z = q
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


class Estimator:
    """Attitude, velocity and position in north, east, down about the first fix."""

    def __init__(self):
        self.r = None  # body to world
        self.velocity = np.zeros(3)
        self.position = np.zeros(3)
        self.offset = np.zeros(3)  # of the acceleration
        self.reference = None
        self.fixes = 0

    def inertial(self, force, rates, field, dt):
        if self.r is None:
            down = -force / np.linalg.norm(force)
            east = np.cross(down, field)
            east /= np.linalg.norm(east)
            north = np.cross(east, down)
            c, s = math.cos(DECLINATION), math.sin(DECLINATION)
            turn = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
            self.r = turn @ np.array((north, east, down))
            return
        angle = rates * dt
        skew = np.array(
            ((0, -angle[2], angle[1]), (angle[2], 0, -angle[0]), (-angle[1], angle[0], 0))
        )
        self.r = self.r @ (np.eye(3) + skew + skew @ skew / 2)
        u, _, v = np.linalg.svd(self.r)
        self.r = u @ v
        acceleration = self.r @ force + G * DOWN + self.offset
        self.position += self.velocity * dt + acceleration * dt * dt / 2
        self.velocity += acceleration * dt

    def fix(self, message):
        latitude, longitude = message.lat * 1e-7, message.lon * 1e-7
        altitude = message.alt * 1e-3
        if self.reference is None:
            self.reference = latitude, longitude, altitude
        seen = np.array(self.local(latitude, longitude, altitude))
        speed = np.array((message.vn, message.ve, message.vd)) * 1e-2
        self.position += 0.2 * (seen - self.position)
        self.offset += 0.02 * (speed - self.velocity)
        self.velocity += 0.2 * (speed - self.velocity)
        self.fixes += 1

    def local(self, latitude, longitude, altitude):
        first = self.reference
        north = math.radians(latitude - first[0]) * EARTH
        east = math.radians(longitude - first[1]) * EARTH * math.cos(math.radians(first[0]))
        return north, east, first[2] - altitude


class Allocator:
    """From torques and thrust to outputs."""

    def __init__(self):
        count = int(parameter("CA_ROTOR_COUNT", 0))
        columns = []
        for i in range(count):
            assert int(parameter(f"PWM_MAIN_FUNC{i + 1}", 0)) == 101 + i
            x, y = parameter(f"CA_ROTOR{i}_PX", 0), parameter(f"CA_ROTOR{i}_PY", 0)
            thrust = 6.5 * np.array((0.0, 0.0, -1.0))
            moment = np.cross((x, y, 0.0), thrust) - parameter(f"CA_ROTOR{i}_KM", 0.05) * thrust
            columns.append((*moment, thrust[2]))
        mix = np.linalg.pinv(np.array(columns).T)
        scales = np.ones(4)
        level = []
        for axis in (0, 1):
            used = np.count_nonzero(abs(mix[:, axis]) > 1e-3)
            level.append(math.sqrt((mix[:, axis] ** 2).sum() / (used / 2)))
        scales[:2] = max(level)
        scales[2] = mix[:, 2].max()
        scales[3] = abs(mix[:, 3]).mean()
        self.mix = mix / scales
        self.factor = parameter("THR_MDL_FAC", 0.0)

    def outputs(self, torques, collective):
        wanted = np.clip(self.mix @ (*torques, -collective), 0.0, 1.0)
        f = self.factor
        if f != 0.0:
            wanted = (np.sqrt((1 - f) ** 2 + 4 * f * wanted) - (1 - f)) / (2 * f)
        return np.trunc(1000.0 * wanted) / 1000.0


class Controller:
    """Positions to torques and thrust."""

    def __init__(self):
        self.hover = parameter("MPC_THR_HOVER", 0.5)
        self.least = parameter("MPC_THR_MIN", 0.12)
        self.p = np.array([parameter(f"MPC_{a}_P", 1.0) for a in ("XY", "XY", "Z")])
        self.v = np.array([parameter(f"MPC_{a}_VEL_P_ACC", 2.0) for a in ("XY", "XY", "Z")])
        integral = {"XY": 0.4, "Z": 2.0}
        self.vi = np.array(
            [parameter(f"MPC_{a}_VEL_I_ACC", integral[a]) for a in ("XY", "XY", "Z")]
        )
        self.ramp = parameter("MPC_TKO_RAMP_T", 3.0)
        axes = ("ROLL", "PITCH", "YAW")
        self.attitude = np.array([parameter(f"MC_{a}_P", 5.0) for a in axes])
        self.rate = np.array([parameter(f"MC_{a}RATE_P", 0.15) for a in axes])
        self.rate_i = np.array([parameter(f"MC_{a}RATE_I", 0.2) for a in axes])
        self.reset()

    def reset(self):
        self.torque = np.zeros(3)
        self.lift = np.zeros(3)
        self.since = None  # it is armed, s
        self.lifts = None  # the ramp began, s
        self.landed = True

    def climb(self, now, above):
        """Largest velocity upwards, m/s, and whether it flies. None before the take-off."""
        if self.since is None:
            self.since = now
        if self.lifts is None:
            if now - self.since < 1.0 or not above:  # the spool-up, or no goal above it
                return None, False
            self.lifts = now
        share = (now - self.lifts) / self.ramp if self.ramp > 0.0 else 1.0
        none = -G / self.v[2]  # downwards: it asks for no thrust
        return none + min(share, 1.0) * (3.0 - none), share >= 1.0

    def step(self, now, dt, estimate, rates, goal, yaw):
        up, flies = self.climb(now, goal[2] < estimate.position[2])
        if up is None:
            return np.zeros(3), 0.0
        wanted = self.p * (goal - estimate.position)
        level = np.linalg.norm(wanted[:2])
        wanted[:2] *= min(1.0, 12.0 / max(level, 1e-9))
        wanted[2] = max(min(wanted[2], 1.5), -up)
        error = wanted - estimate.velocity
        acceleration = self.v * error + self.lift
        body_z = np.array((-acceleration[0], -acceleration[1], G))
        tilt = math.atan2(np.linalg.norm(body_z[:2]), G)
        most = math.radians(45 if flies else 12)
        if tilt > most:
            body_z[:2] *= math.tan(most) / math.tan(tilt)
        body_z /= np.linalg.norm(body_z)
        collective = (self.hover - acceleration[2] * self.hover / G) / body_z[2]
        least = self.least if flies else 0.001
        if (collective <= least and error[2] > 0.0) or (collective >= 1.0 and error[2] < 0.0):
            error[2] = 0.0
        self.lift += self.vi * error * dt
        self.lift[2] = np.clip(self.lift[2], -G, G)
        collective = np.clip(collective, least, 1.0)
        if collective > self.least + 0.1 * (self.hover - self.least):
            self.landed = False
        left = np.cross(body_z, (math.cos(yaw), math.sin(yaw), 0.0))
        left /= np.linalg.norm(left)
        wanted_r = np.array((np.cross(left, body_z), left, body_z)).T
        off = estimate.r.T @ wanted_r
        turn = np.array((off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1])) / 2
        rate_error = self.attitude * turn - rates
        torques = self.rate * rate_error + self.torque
        if not self.landed:
            self.torque = np.clip(self.torque + self.rate_i * rate_error * dt, -0.3, 0.3)
        return torques, collective


class Px4:
    def __init__(self, instance):
        self.instance = instance
        self.fault = os.environ.get("PEER_FAULT", "")
        self.tcp = connected(4560 + instance)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind(("127.0.0.1", 14580 + instance))
        self.udp.setblocking(False)
        self.there = ("127.0.0.1", 14540 + instance)
        self.mav = common.MAVLink(None, 1 + instance, 1)
        self.offboard_mav = common.MAVLink(None, 1 + instance, 1)
        self.estimate = Estimator()
        self.control = Controller()
        self.allocator = Allocator()
        self.magnetometer = Validator()
        self.station = -math.inf  # latest heartbeat of a ground station, s
        self.clock = None  # µs
        self.first = None
        self.armed = False
        self.mode = 0
        self.goal = None
        self.setpoints = []  # times of the stream's first and last
        self.beat = -1.0
        request = common.MAVLink_command_long_message(0, 0, 511, 0, 115, 5e3, 0, 0, 0, 0, 0)
        self.send(request)
        self.send(common.MAVLink_heartbeat_message(0, 12, 0, 0, 0, 3))

    def send(self, message):
        self.tcp.sendall(message.pack(self.mav))

    def tell(self, message):
        self.udp.sendto(message.pack(self.offboard_mav), self.there)

    def say(self, now, text):
        if now - self.station > 2.5:
            return
        for piece in range(0, len(text), 50):
            words = text[piece : piece + 50].encode()
            self.tell(common.MAVLink_statustext_message(4, words, 1, piece // 50))

    def run(self):
        while received := self.tcp.recv(4096):
            for message in self.mav.parse_buffer(received) or ():
                if message.get_type() == "HIL_GPS" and self.estimate.r is not None:
                    self.estimate.fix(message)
                elif message.get_type() == "HIL_SENSOR" and message.id == 0:
                    self.sensor(message)

    def sensor(self, message):
        before = self.clock
        self.clock = message.time_usec
        if before is None:
            self.first = self.clock
            before = self.clock - 4000
        assert self.clock > before  # a clock that went back would stop all that waits
        assert message.fields_updated & 0x1A3F == 0x1A3F
        now = self.clock * 1e-6
        dt = (self.clock - before) * 1e-6
        force = np.array((message.xacc, message.yacc, message.zacc))
        rates = np.array((message.xgyro, message.ygyro, message.zgyro))
        field = np.array((message.xmag, message.ymag, message.zmag))
        lives = self.magnetometer.lives(field)
        if self.estimate.r is not None or (lives and now - self.first * 1e-6 > BOOT):
            self.estimate.inertial(force, rates, field, dt)
        self.hear(now)
        if now - self.beat >= 1.0:
            self.beat = now
            self.tell(common.MAVLink_heartbeat_message(2, 12, 0, self.mode << 16, 3, 3))
        if now - self.first * 1e-6 < 1.0:
            return  # the script still starts modules
        self.fail(now)
        streams = self.setpoints and now - self.setpoints[1] < 1.0
        if self.mode == CUSTOM_OFFBOARD and not streams:
            self.mode = 0
        controls = np.zeros(16)
        if self.armed and self.mode == CUSTOM_OFFBOARD:
            torques, collective = self.control.step(
                now, dt, self.estimate, rates, self.goal[:3], self.goal[3]
            )
            outputs = self.allocator.outputs(torques, collective)
            controls[: len(outputs)] = outputs
        if self.fault == "nan" and now > 12.0:
            controls[:] = math.nan
        flags = 0 if self.fault == "no_lockstep" else 1
        mode = 1 | (128 if self.armed else 0)
        self.send(
            common.MAVLink_hil_actuator_controls_message(self.clock, controls.tolist(), mode, flags)
        )

    def fail(self, now):
        if now < 12.0:
            return
        if self.fault == "dies":
            print("Segmentation fault", flush=True)
            os._exit(3)
        if self.fault == "closes":
            self.tcp.close()
            time.sleep(60)
        if self.fault == "hangs":
            time.sleep(60)

    def hear(self, now):
        while True:
            try:
                datagram = self.udp.recv(2048)
            except BlockingIOError:
                return
            for message in self.offboard_mav.parse_buffer(datagram) or ():
                if message.get_type() == "HEARTBEAT":
                    if message.type == common.MAV_TYPE_GCS:
                        self.station = now
                    continue
                if message.target_system not in (0, 1 + self.instance):
                    continue
                if message.get_type() == "SET_POSITION_TARGET_GLOBAL_INT":
                    self.setpoint(message, now)
                elif message.get_type() == "COMMAND_LONG" and message.target_system:
                    self.command(message, now)

    def setpoint(self, message, now):
        assert message.coordinate_frame == common.MAV_FRAME_GLOBAL_INT
        assert message.type_mask & 0b111 == 0  # position
        assert message.type_mask & 0b111111000 == 0b111111000  # no velocity, no acceleration
        assert message.type_mask & 0x400 == 0  # yaw
        if self.estimate.reference is None:
            return
        place = self.estimate.local(message.lat_int * 1e-7, message.lon_int * 1e-7, message.alt)
        self.goal = (*place, message.yaw)
        if not self.setpoints or now - self.setpoints[1] > 0.5:
            self.setpoints = [now, now]
        self.setpoints[1] = now

    def command(self, message, now):
        accepted = False
        if message.command == common.MAV_CMD_DO_SET_MODE:
            streams = self.setpoints and now - self.setpoints[0] > 1.0
            wanted = int(message.param2) if int(message.param1) & 1 else 0
            accepted = wanted == CUSTOM_OFFBOARD and bool(streams)
            if accepted:
                self.mode = wanted
        elif message.command == common.MAV_CMD_COMPONENT_ARM_DISARM:
            accepted = self.estimate.fixes >= 20 and "refuses" not in self.fault
            if accepted and not self.armed:
                self.armed = message.param1 == 1.0
                self.control.reset()
            if not accepted:
                self.say(now, "Arming denied: Resolve system health failures first\t")
        self.tell(common.MAVLink_command_ack_message(message.command, 0 if accepted else 1))


def connected(port):
    while True:
        one = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            one.connect(("127.0.0.1", port))
            return one
        except OSError:
            one.close()
            time.sleep(0.005)


def main(words):
    assert os.environ["PX4_SIM_MODEL"] == "none_iris"
    assert words[2] == "-d"
    assert words[3].endswith("/etc")
    Px4(int(words[words.index("-i") + 1])).run()


if __name__ == "__main__":
    main(sys.argv[1:])
