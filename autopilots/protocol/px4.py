"""PX4's MAVLink: sensors and actuators of its simulator, and orders from outside (offboard).

From its documentation and its source, `simulator_mavlink`: no PX4 flew here. Body axes are
x forward, y right, z down; the world is x north, y east, z down.
"""

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common

from ...models import InputError
from ...sim.rotations import to_body
from ...sim.sensors import SENSOR_TYPES
from ...sim.sensors.barometer import isa_pressure
from ..reading import Order, Reading
from . import frames

Message: TypeAlias = common.MAVLink_message

PORT = 4560
"""Of the simulator, TCP. An instance moves each port by its number."""
OFFBOARD_PORT = 14540
"""To which PX4 sends what an offboard computer reads, UDP."""
ORDERS_PORT = 14580
"""At which it listens to that computer."""
RATE = 250.0
"""Of the sensors of a simulator, Hz, and so of its rate loop."""
OFFBOARD = 6
"""Its main mode in which it follows setpoints from outside."""

_FIELD = np.array(SENSOR_TYPES["magnetometer"].about.settings["field"].default)
_GAUSS = 0.01  # per µT
_TEMPERATURE = 15.0  # °C
_ALIVE = 1e-3  # G/s and °C/s: PX4 takes values within 1e-6 of each other for equal
_FIELDS = 0x1BFF  # of HIL_SENSOR: all but the differential pressure
_FIX = 3  # in three dimensions
_ACCURACY = 50  # cm, of the position that GPS claims
_SATELLITES = 12
_NO_COURSE = 65535  # PX4 reads the velocity
_POSITION_AND_YAW = 0b100111111000  # what a setpoint leaves out has its bit set


def microseconds(reading: Reading) -> int:
    """Time of a reading on PX4's clock, which begins after 0."""
    return round(1e6 * (reading.time + 1.0 / RATE))


def sensors(reading: Reading) -> Message:
    """Accelerometer, gyro, magnetometer and barometer. Sets PX4's clock.

    PX4 drops a magnetometer or a barometer that repeats its values, and without a heading it does
    not arm: field and temperature change by 4e-6 G and °C in each message.
    """
    alive = _ALIVE * (reading.time % 0.1)
    field = _GAUSS * to_body(reading.quaternion, _FIELD) + alive
    altitude = frames.ORIGIN[2] + float(reading.position[2])
    return common.MAVLink_hil_sensor_message(
        microseconds(reading),
        *frames.forward_right_down(reading.specific_force),
        *frames.forward_right_down(reading.rates),
        *frames.forward_right_down(field),
        float(isa_pressure(altitude)) / 100.0,  # hPa
        0.0,
        altitude,
        _TEMPERATURE + alive,
        _FIELDS,
    )


def fix(reading: Reading) -> Message:
    """What GPS reads."""
    north, east, down = frames.north_east_down(100.0 * reading.velocity)
    return common.MAVLink_hil_gps_message(
        microseconds(reading),
        _FIX,
        *frames.geodetic(reading.position),
        _ACCURACY,
        _ACCURACY,
        round(math.hypot(north, east)),
        round(north),
        round(east),
        round(down),
        _NO_COURSE,
        _SATELLITES,
    )


def throttles(message: common.MAVLink_hil_actuator_controls_message) -> NDArray[np.float64]:
    """Of the outputs, 0 to 1. Raises `InputError` for a PX4 that keeps its own clock."""
    if not message.flags & common.HIL_ACTUATOR_CONTROLS_FLAGS_LOCKSTEP:
        raise InputError("px4: expected one that was built with lock-step, got one without")
    return np.array(message.controls)


def setpoint(order: Order, system: int) -> Message:
    """A place on earth and a heading to fly to: where PX4 has its origin does not matter."""
    latitude, longitude, altitude = frames.geodetic(order.goal)
    nothing = 6 * [0.0]
    return common.MAVLink_set_position_target_global_int_message(
        0,
        system,
        1,
        common.MAV_FRAME_GLOBAL_INT,
        _POSITION_AND_YAW,
        latitude,
        longitude,
        altitude / 1000.0,
        *nothing,
        math.pi / 2 - order.heading,
        0.0,
    )


def requests(system: int) -> list[Message]:
    """To fly by setpoints from outside, and to let the motors turn.

    A heartbeat comes first: PX4 says why it does not arm only to a ground station.
    """
    rest = 5 * [0.0]
    return [
        common.MAVLink_heartbeat_message(
            common.MAV_TYPE_GCS, common.MAV_AUTOPILOT_INVALID, 0, 0, common.MAV_STATE_ACTIVE, 3
        ),
        common.MAVLink_command_long_message(
            system,
            1,
            common.MAV_CMD_DO_SET_MODE,
            0,
            common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
            OFFBOARD,
            *rest,
        ),
        common.MAVLink_command_long_message(
            system, 1, common.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1.0, 0.0, *rest
        ),
    ]
