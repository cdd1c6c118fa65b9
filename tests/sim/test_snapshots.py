"""After `restore(snapshot())` no later bit differs: in gusts, delays, swarms, with a payload."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from rotorgram.models import Vehicle
from rotorgram.sim import EffectOptions, InitialState, Randomization, World, make_world
from rotorgram.sim.sensors import Sensors, checked_sensors

AIR = {
    "motor_lag": True, "battery": True, "body_drag": True, "rotor_drag": True,
    "ground_effect": True, "wind": (2.0, -1.0, 0.5), "gusts": 3.0,
}  # fmt: skip
DRAWN = {
    "mass": "uniform(0.8, 1.2)", "center_x": "uniform(-0.001, 0.001)",
    "thrust_1": "uniform(0.9, 1.0)", "time_constant": "uniform(0.8, 1.2)",
    "wind_x": "uniform(-1, 1)", "body_drag": "uniform(0.5, 1.5)",
}  # fmt: skip
MEASURED = {
    "imu": True, "barometer": True, "magnetometer": {"noise": 0.3},
    "gps": {
        "rate": 10.0, "delay": 0.04, "dropout": 0.2, "noise": 0.5, "vertical_noise": 1.0,
        "velocity_noise": 0.1,
    },
    "motion_capture": {"noise": 0.001, "angle_noise": 0.01, "delay": 0.02},
    "rangefinder": {"noise": 0.01, "limit": 4.0}, "estimate": True,
}  # fmt: skip
PLAIN: dict[str, Any] = {"backend": "mujoco"}
CASES: dict[str, dict[str, Any]] = {
    "mujoco": PLAIN,
    "mujoco, all": PLAIN | {"effects": AIR, "randomize": DRAWN},
    "mujoco, payload": PLAIN | {"effects": {"payload": 0.005, "cable": 0.3}},
    "mujoco, drawn payload": PLAIN | {
        "effects": {"payload": 0.005, "cable": 0.3}, "randomize": {"payload": "uniform(0.5, 1.5)"},
    },
    "mujoco, swarm": PLAIN | {"drones": 3, "effects": {**AIR, "downwash": True}},
    "rigid": {"backend": "rigid"},
    "rigid, all": {"backend": "rigid", "effects": AIR, "randomize": DRAWN},
    "rigid, NumPy": {
        "backend": "rigid", "effects": AIR, "randomize": DRAWN, "compiled": False,
        "dtype": "float64",
    },
    "rigid, swarm": {
        "backend": "rigid", "drones": 3, "effects": {**AIR, "downwash": True}, "randomize": DRAWN,
    },
}  # fmt: skip


def world_of(
    worlds: int, effects: dict[str, Any] | None = None, randomize: Any = None, **given: Any
) -> World:
    options = EffectOptions.from_options(effects or {})
    drawn = Randomization(randomize, options) if randomize else None
    backend = given.pop("backend")
    vehicle = Vehicle.load("crazyflie2")
    return make_world(vehicle, worlds, backend, effects=options, randomize=drawn, **given)


def begin(world: World, mask: Any) -> None:
    """A start that is drawn, drones one metre apart."""
    draw = world.draw(mask)
    position = draw.uniform(-0.2, 0.2, (3,)) + np.array((0.0, 0.0, 3.0))
    if world.shape:
        position = position + np.arange(world.shape[1])[:, None] * (1.0, 0.0, 0.0)
    rates = draw.normal(0.1, (3,))
    world.reset(mask, InitialState(position=position, body_rates=rates))


def flight(world: World, sensors: Sensors, steps: int) -> list[bytes]:
    """Bits of the states and readings of steps, with resets and held worlds among them."""
    every = np.ones(world.shape, bool)[()]
    seen = []
    for step in range(steps):
        if step % 4 == 2:
            some = every
            if world.shape:
                some = np.arange(world.shape[0])[:, None] == np.zeros(world.shape[1])
            begin(world, some)
            sensors.begin(some)
        held = every
        if world.shape and step % 3 == 1:
            held = np.arange(world.shape[0])[:, None] % 2 == np.zeros(world.shape[1])
        thrust = (1.0 + 0.05 * np.sin(step)) * world.vehicle.hover_thrust
        thrust = thrust + 0.0 * world.state.command
        for again in (False, True):
            world.step(thrust, 2, held, again=again)
        sensors.sample(held)
        state = world.state
        arrays = [getattr(state, name) for name in state.__slots__]
        arrays += [world.acceleration(), world.below()]
        arrays += [*sensors.readings.values(), *world.parameters.values()]
        seen.append(b"".join(np.asarray(x).tobytes() for x in arrays if x is not None))
    return seen


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("case", CASES)
def test_no_later_bit_differs(case: str, worlds: int) -> None:
    period = 4 * Vehicle.load("crazyflie2").timestep
    measured = checked_sensors(
        MEASURED | {"gps": MEASURED["gps"] | {"rate": 1 / (5 * period), "delay": 2 * period},
                    "motion_capture": MEASURED["motion_capture"] | {"delay": period}}
    )  # fmt: skip
    world = world_of(worlds, **CASES[case])
    sensors = Sensors(measured, world, period)
    every = np.ones(world.shape, bool)[()]
    world.seed(every, list(range(worlds)))
    begin(world, every)
    sensors.begin(every)
    flight(world, sensors, 5)
    snapshots = world.snapshot(), sensors.snapshot()
    kept = {name: array.copy() for name, array in snapshots[0].items()}
    first = flight(world, sensors, 10)
    world.restore(snapshots[0])
    sensors.restore(snapshots[1])
    assert flight(world, sensors, 10) == first
    other = world_of(worlds, **CASES[case])  # another process's
    others = Sensors(measured, other, period)
    other.restore(snapshots[0])
    others.restore(snapshots[1])
    assert flight(other, others, 10) == first
    for name, array in snapshots[0].items():
        assert isinstance(array, np.ndarray)
        assert array.tobytes() == kept[name].tobytes()  # no view


@pytest.mark.parametrize("case", ["mujoco, all", "rigid, all"])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_worlds_are_copied(case: str, copied: Any) -> None:
    world = world_of(2, **CASES[case])
    every = np.ones(world.shape, bool)
    begin(world, every)
    world.step(world.vehicle.hover_thrust + 0.0 * world.state.command, 4)
    twin = copied(world)
    for _ in range(3):
        for either in (world, twin):
            begin(either, np.array([[True], [False]]))
            either.step(world.vehicle.hover_thrust + 0.0 * world.state.command, 4)
    assert twin.snapshot().keys() == world.snapshot().keys()
    for name, array in world.snapshot().items():
        assert twin.snapshot()[name].tobytes() == array.tobytes(), name
