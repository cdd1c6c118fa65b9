"""Effects against their closed forms."""

import json
import re
import xml.etree.ElementTree as ET
from itertools import pairwise
from math import cos, exp, log, log2, pi, sin, sqrt, tanh
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import worlds
from numpy.testing import assert_allclose
from rotorgram.envs import Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.models import InputError, Vehicle
from rotorgram.models.fields import read_table
from rotorgram.models.library import vehicle_names
from rotorgram.models.swarm import swarm_model
from rotorgram.sim import (
    PARAMETERS,
    EffectOptions,
    Randomization,
    World,
    make_world,
)  # fmt: skip
from rotorgram.sim.effects.gusts import Gusts
from rotorgram.sim.effects.rotors import RotorEffects
from tables import SIM
from worlds import EVERY, alone

approx = pytest.approx
ROOT = Path(__file__).parents[2]
RACER = ROOT / "tests" / "data" / "racer.xml"
# Of that file, typed here again.
M = 0.6
G = 9.81
H = 0.005
HOVER = M * G / 4
K = 5e-6  # thrust = K speed²
OMEGA = sqrt(HOVER / K)


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the files that `racer` writes."""
    monkeypatch.chdir(tmp_path)


def racer(
    timestep: float = H, low: str = "0", box: str = "0.1 0.08 0.03", **numbers: str | None
) -> Vehicle:
    """The racer with other coefficients, `group_name="1 2"`, or without one, None."""
    tree = ET.parse(RACER)
    custom: Any = tree.find("custom")
    option: Any = tree.find("option")
    option.set("timestep", str(timestep))
    for geom in tree.iter("geom"):
        geom.set("size", box)
    for motor in tree.iter("motor"):
        motor.set("ctrlrange", f"{low} 4")
    known = {}
    for one in custom:
        name = one.get("name").removeprefix("rotorgram/")
        known[name] = one
    for key, value in numbers.items():
        name = key.replace("_", ".", 1)
        if name in known:
            custom.remove(known[name])
        if value is not None:
            added = ET.Element("numeric", name=f"rotorgram/{name}", data=value)
            custom.append(added)
    file = Path(f"racer{timestep}.xml").absolute()
    tree.write(file)
    return Vehicle.load(file)


def dragging(timestep: float = H, **numbers: str | None) -> Vehicle:
    """A racer whose drag is 0.3 N s/m in all directions, or these numbers alone."""
    linear = None if numbers else "0.3 0.3 0.3"
    drag = {"drag_linear": linear, "drag_quadratic": None}
    return racer(timestep, **(drag | numbers))


def refused(sentence: str, build: Any, *given: Any, **named: Any) -> None:
    """Raises `InputError` with one sentence."""
    with pytest.raises(InputError, match=sentence) as caught:
        build(*given, **named)
    assert "\n" not in str(caught.value)


def effect_options(given: Any) -> EffectOptions:
    return read_table(EffectOptions, given, "effects")


def world_of(
    vehicle: Vehicle | None = None,
    num_worlds: int = 1,
    backend: Any = "mujoco",
    randomize: dict[str, Any] | None = None,
    **effects: Any,
) -> World:
    options = EffectOptions(**effects)
    drawn = Randomization(randomize or {}, options)
    vehicle = vehicle or Vehicle.load(RACER)
    return make_world(vehicle, num_worlds, backend, effects=options, randomize=drawn)


def begin(world: World, height: float = 50.0, mask: Any = None, **pose: Any) -> World:
    """Reset the worlds of a mask, level over the origin unless the pose says otherwise."""
    return worlds.begin(world, mask, position=(0.0, 0.0, height), **pose)


def fly(world: World, thrust: Any, steps: int, substeps: int = 1) -> World:
    thrusts = np.array(thrust, float)
    command = np.broadcast_to(thrusts, (*world.shape, 4)).copy()
    for _ in range(steps):
        world.step(command, substeps)
    return world


def fly_hovering(world: World) -> World:
    """A physics step of any vehicle with the thrusts of its hover."""
    world.step(world.vehicle.hover_thrust + 0 * world.state.command, 1)
    return world


def pushed(world: World, thrust: Any = HOVER) -> tuple[np.ndarray, np.ndarray]:
    """Acceleration of the body's origin, and its angular one, over one physics step."""
    before = alone(world)
    step = world.vehicle.timestep
    fly(world, thrust, 1)
    after = alone(world)
    acceleration = (after.velocity - before.velocity) / step
    turn = (after.body_rates - before.body_rates) / step
    return acceleration, turn


def states(world: World) -> list[np.ndarray]:
    names = ("position", "quaternion", "velocity", "body_rates", "thrust", "command", "touching")
    return [getattr(world.state, name).copy() for name in names]


# --- rotors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("first", "then", "time"), [(1.0, 3.0, 0.05), (3.0, 1.0, 0.08)])
def test_motor_lag_is_exponential_in_the_speed(first: float, then: float, time: float) -> None:
    world = world_of(motor_lag=True)
    begin(world, thrust=[first] * 4)
    a = sqrt(then)
    b = sqrt(first) - a
    fly(world, then, 1)
    # (1/h) ∫ (a + b exp(-t/T))² dt from 0 to h, of four rotors.
    e = exp(-H / time)
    mixed = 2 * a * b * (time / H) * (1 - e)
    square = b * b * (time / (2 * H)) * (1 - e * e)
    mean = a * a + mixed + square
    expected = H * (4 * mean / M - G)
    found = alone(world).velocity[2]
    assert found == approx(expected, rel=1e-12)
    fly(world, then, 19)
    root = a + b * exp(-20 * H / time)
    assert_allclose(alone(world).thrust, root * root, rtol=1e-12)
    assert (alone(world).command == then).all()


def test_a_very_short_and_a_very_long_time_constant() -> None:
    short = racer(rotors_time_constant="1e-4", rotors_time_constant_down=None)
    world = world_of(short, motor_lag=True, randomize={"time_constant": 0.01})
    begin(world)
    fly(world, 3.0, 1)
    assert_allclose(world.state.thrust, 3.0, rtol=1e-12)
    # Of the step 4 (√3 - √1)/1000 s · √1 · h · 2, to first order in the step.
    long = racer(rotors_time_constant="10", rotors_time_constant_down=None)
    world = world_of(long, motor_lag=True, randomize={"time_constant": 100})
    begin(world, thrust=[1.0] * 4)
    fly(world, 3.0, 1)
    expected = 2 * (sqrt(3) - 1) * H / 1000
    assert_allclose(world.state.thrust - 1.0, expected, rtol=1e-5)


HALF = 4 * (0.4 * 0.5 + 0.6 * 0.25)


@pytest.mark.parametrize(
    ("command", "thrust"), [(0.0, 0.0), (2.0, HALF), (4.0, 4.0), (9.0, 4.0), (-1.0, 0.0)]
)
def test_thrust_curve_at_throttles(command: float, thrust: float) -> None:
    world = world_of(thrust_curve=True)
    begin(world)
    fly(world, command, 1)
    assert_allclose(world.state.thrust, thrust, rtol=1e-14)


@pytest.mark.parametrize("resistance", ["0.05", "0.4"])
def test_battery_voltage_is_the_root_of_the_quadratic(resistance: str) -> None:
    """V = E - R I, with I V = 80 · 4 (F (V / 12.6)²)^1.5: a V² + V - E = 0."""
    vehicle = racer(battery_resistance=resistance, battery_capacity="1e4")
    a = float(resistance) * 80 * 4 * HOVER**1.5 / 12.6**3
    root = sqrt(1 + 4 * a * 12.6)
    voltage = (root - 1) / (2 * a)
    thrust = HOVER * (voltage / 12.6) ** 2
    for lag, steps in ((False, 1), (False, 2), (True, 300)):
        world = world_of(vehicle, battery=True, motor_lag=lag)
        begin(world)
        fly(world, HOVER, steps)
        assert_allclose(world.state.thrust, thrust, rtol=1e-6)


def test_battery_charge_by_integration() -> None:
    # Without resistance the power 80 · 4 F^1.5 (V / 12.6)³ draws I = 80 · 4 F^1.5 V² / 12.6³, and
    # V = 9.9 + 2.7 q falls by dV/dt = -2.7 I / (3600 · 0.5): 1/V = 1/12.6 + b t.
    vehicle = racer(battery_resistance="0")
    seconds = 30.0
    b = 2.7 / 1800 * 80 * 4 * HOVER**1.5 / 12.6**3
    voltage = 1 / (1 / 12.6 + b * seconds)
    rotors = RotorEffects(vehicle, EffectOptions(battery=True))
    thrust = np.full(4, HOVER)
    rotors.take({})
    rotors.begin(np.True_, thrust, {})
    assert rotors.charge == 1.0
    for _ in range(round(seconds / H)):
        rotors.step(thrust, None)
    expected = (voltage - 9.9) / 2.7
    assert rotors.charge == approx(expected, rel=1e-4)
    assert 0.2 < rotors.charge < 0.9


def test_an_empty_battery_stays_at_its_empty_voltage() -> None:
    vehicle = racer(battery_resistance="0", battery_capacity="1e-3")
    world = world_of(vehicle, battery=True, randomize={"battery_charge": 0})
    fly(begin(world), HOVER, 50)
    expected = HOVER * (9.9 / 12.6) ** 2
    assert_allclose(world.state.thrust, expected, rtol=1e-12)


def test_rotors_that_need_more_than_the_battery_gives() -> None:
    """Half the open voltage is where a source gives its most; the speeds then fall."""
    vehicle = racer(battery_resistance="0.5", battery_capacity="1e4")
    world = world_of(vehicle, battery=True, motor_lag=True)
    begin(world, thrust=[4.0] * 4)
    fly(world, 4.0, 1)
    # Of the first step: wanted is 4 · (6.3 / 12.6)², so that √F goes from 2 to 1.
    expected = (1 + exp(-H / 0.08)) ** 2
    assert_allclose(world.state.thrust, expected, rtol=1e-12)


def test_efficiency_of_one_rotor_turns_the_craft() -> None:
    world = world_of(efficiency=(1, 0.5, 1, 1))
    begin(world)
    assert_allclose(alone(world).thrust, (HOVER, HOVER / 2, HOVER, HOVER))
    assert_allclose(alone(world).command, HOVER)
    acceleration, turn = pushed(world)
    # Rotor 2, at (-0.14, -0.12) m, lacks HOVER / 2 and its reaction of -0.02 N·m/N.
    lost = HOVER / 2
    expected = (0.12 * lost / 4e-3, -0.14 * lost / 5e-3, 0.02 * lost / 8e-3)
    assert_allclose(turn, expected, rtol=2e-3)
    assert acceleration[2] == approx(-lost / M, rel=1e-2)
    assert_allclose(alone(world).thrust, (HOVER, lost, HOVER, HOVER))


# --- air ------------------------------------------------------------------------------------------


def test_linear_drag_is_exponential_and_turns_nothing() -> None:
    vehicle = dragging()
    world = world_of(vehicle, body_drag=True)
    begin(world, velocity=[5.0, 2.0, 0.0])
    fly(world, HOVER, 400)
    left = exp(-0.3 / M * 2.0)
    expected = (5 * left, 2 * left, 0.0)
    assert_allclose(alone(world).velocity, expected, rtol=1e-5, atol=1e-9)
    # It acts at the center of mass, 1 cm over the origin.
    assert_allclose(alone(world).body_rates, 0.0, atol=1e-12)
    begin(world, height=500.0)
    fly(world, 0.0, 4000)
    found = alone(world).velocity[2]
    assert found == approx(-M * G / 0.3, rel=1e-4)


def test_quadratic_drag_falls_as_a_hyperbolic_tangent() -> None:
    vehicle = dragging(drag_quadratic="0.02 0.02 0.02")
    world = world_of(vehicle, body_drag=True)
    begin(world, height=500.0)
    terminal = sqrt(M * G / 0.02)
    for seconds in (1.0, 2.0, 3.0):
        fly(world, 0.0, round(1.0 / H))
        fallen = terminal * tanh(G * seconds / terminal)
        assert alone(world).velocity[2] == approx(-fallen, rel=1e-5)
    fly(world, 0.0, 2000)
    found = alone(world).velocity[2]
    assert found == approx(-terminal, rel=1e-5)


def test_angular_drag_is_exponential() -> None:
    vehicle = dragging(drag_angular="0.01 0.01 0.02")
    world = world_of(vehicle, body_drag=True)
    begin(world, body_rates=[0, 0, 5.0])
    fly(world, HOVER, 100)
    # Izz is 8e-3 kg m².
    left = 5 * exp(-0.02 / 8e-3 * 0.5)
    expected = (0, 0, left)
    assert_allclose(alone(world).body_rates, expected, rtol=1e-3, atol=1e-12)
    vehicle = dragging(drag_angular="0.5 0.5 0.5")
    refused(
        r": expected drag.angular, times mass over inertia, of at most 60 N s/m, .* got 75$",
        world_of,
        vehicle,
        body_drag=True,
    )


def test_the_moment_of_the_air_is_in_proportion_to_the_velocity() -> None:
    vehicle = dragging(1e-4, drag_moment="3e-4 5e-4")
    world = world_of(vehicle, body_drag=True, wind=(0.5, 0, 0))
    begin(world, velocity=[2.5, -1.0, 3.0])
    acceleration, turn = pushed(world, 0.0)
    # 3e-4 · -1 over 4e-3 kg m², and -5e-4 · 2 over 5e-3 kg m².
    expected = (-0.075, -0.2, 0.0)
    assert_allclose(turn, expected, rtol=1e-6, atol=1e-9)
    # The origin is 1 cm below the center of mass, which only falls.
    assert_allclose(acceleration, (0.002, -0.00075, -G), rtol=1e-3)


def test_body_drag_in_body_axes() -> None:
    vehicle = racer(1e-4)
    nose_down = [sqrt(0.5), 0.0, sqrt(0.5), 0.0]  # body x is the world's -z
    world = world_of(vehicle, body_drag=True)
    begin(world, quaternion=nose_down, velocity=[3.0, 4.0, -12.0])
    # Body axes: x forward 12, y 4, z: the world's x, 3. |v| = 13.
    acceleration, _ = pushed(world, 0.0)
    x = -(0.1 + 0.02 * 13) * 3
    y = -(0.06 + 0.012 * 13) * 4
    z = (0.05 + 0.01 * 13) * 12
    expected = (x / M, y / M, z / M - G)
    assert_allclose(acceleration, expected, rtol=1e-3)


def test_rotors_in_sideways_and_vertical_motion() -> None:
    vehicle = racer(1e-4)
    world = world_of(vehicle, rotor_drag=True)
    begin(world, velocity=[3.0, 0.0, 0.0])
    acceleration, turn = pushed(world)
    drag = -4 * 1e-4 * OMEGA * 3
    lift = 4 * 3e-3 * 9
    # The rotors are 1 cm over the center of mass, and the origin 1 cm under it.
    pitch = 0.01 * drag / 5e-3
    assert_allclose(turn, (0, pitch, 0), rtol=1e-3, atol=1e-9)
    expected = (drag / M - 0.01 * pitch, 0, lift / M)
    assert_allclose(acceleration, expected, rtol=1e-3, atol=1e-6)
    world = begin(world, velocity=[0.0, 0.0, 2.0])
    acceleration, turn = pushed(world)
    loss = 4 * 2e-4 * OMEGA * 2
    expected = (0, 0, -loss / M)
    assert_allclose(acceleration, expected, rtol=1e-3, atol=1e-9)
    assert_allclose(turn, 0.0, atol=1e-9)


def test_rotors_of_a_turning_craft() -> None:
    world = world_of(racer(1e-4), rotor_drag=True)
    begin(world, body_rates=[0.0, 0.0, 5.0])
    _, turn = pushed(world)
    # Each rotor goes around at 5 rad/s and a radius² of 0.14² + 0.12².
    yaw = -4 * 1e-4 * OMEGA * 5 * (0.14**2 + 0.12**2)
    expected = (0, 0, yaw / 8e-3)
    assert_allclose(turn, expected, rtol=1e-3, atol=1e-6)
    begin(world, body_rates=[5.0, 0.0, 0.0])
    _, turn = pushed(world)
    # Inflow at ±0.12 m; in the plane 0.02 · 5 m/s, whose force has an arm of 1 cm.
    roll = -4 * OMEGA * 5 * (2e-4 * 0.12**2 + 1e-4 * 0.02 * 0.01)
    expected = (roll / 4e-3, 0, 0)
    assert_allclose(turn, expected, rtol=1e-3, atol=1e-6)


def lifted(height: float) -> float:
    """Share of thrust that a rotor of a radius of 0.1 m gains at this height over the ground."""
    ratio = 0.1 / (4 * height)
    return 1 / (1 - ratio**2) - 1


def test_rotors_with_tilted_axes() -> None:
    """Rotors 1 and 2, on the right, lean outwards by 0.3 rad, and the others to the left."""
    lean = {-1: sin(-0.3), 1: sin(0.3)}
    text = RACER.read_text().replace('timestep="0.005"', 'timestep="1e-4"')
    for index, side in ((1, -1), (2, -1), (3, 1), (4, 1)):
        before = f'site="r{index}" gear="0 0 1'
        text = text.replace(before, f'site="r{index}" gear="0 {lean[side]} {cos(0.3)}')
    Path("tilted.xml").write_text(text)
    vehicle = Vehicle.load("tilted.xml")
    thrust = vehicle.hover_thrust[0]
    assert thrust == approx(HOVER / cos(0.3), rel=1e-6)
    world = world_of(vehicle, rotor_drag=True, ground_effect=True)
    velocity = np.array((3.0, 2.0, 1.0))
    height = 0.2
    begin(world, height, velocity=velocity)
    acceleration, turn = pushed(world, vehicle.hover_thrust)
    force = np.zeros(3)
    torque = np.zeros(3)
    speed = sqrt(thrust / K)
    more = thrust * lifted(height + 0.02)
    for x, y in ((0.14, -0.12), (-0.14, -0.12), (-0.14, 0.12), (0.14, 0.12)):
        side = 1 if y > 0 else -1
        axis = np.array((0, lean[side], cos(0.3)))
        along = velocity @ axis
        plane = velocity - along * axis
        drag = -1e-4 * speed * plane
        lift = more - 2e-4 * speed * along + 3e-3 * plane @ plane
        push = drag + lift * axis
        force += push
        torque += np.cross((x, y, 0.01), push)  # about the center of mass
    expected = torque / (4e-3, 5e-3, 8e-3)
    assert_allclose(turn, expected, rtol=2e-3, atol=1e-3)
    origin = force / M + np.cross(expected, (0, 0, -0.01))
    assert_allclose(acceleration, origin, rtol=2e-3, atol=1e-3)


def test_drag_at_its_limit_is_stable() -> None:
    """Half of the mass over the physics step, 60 N s/m; the rotors' as a turn's."""
    vehicle = dragging(drag_linear="60 60 60")
    world = world_of(vehicle, body_drag=True)
    begin(world, velocity=[5.0, -5.0, 0.0])
    fly(world, HOVER, 100)
    assert_allclose(world.state.velocity, 0.0, atol=1e-9)
    vehicle = racer(rotors_inflow="0.003", rotors_drag="0", rotors_lift="0")
    world = world_of(vehicle, rotor_drag=True)
    begin(world, body_rates=[3.0, 0.0, 0.0])
    fly(world, HOVER, 400)
    assert_allclose(world.state.body_rates, 0.0, atol=1e-9)


RATIOS = [(0.3, 4 / 3), (0.5, 4 / 3), (1.0, 16 / 15), (2.0, 64 / 63), (50.0, 40000 / 39999)]


@pytest.mark.parametrize(("radii", "ratio"), RATIOS)
def test_ground_effect_at_heights(radii: float, ratio: float) -> None:
    # Rotors of a radius of 0.1 m, 0.02 m over the origin. Below half a radius it grows no further;
    # the box, here thin, does not touch there.
    vehicle = racer(1e-4, box="0.1 0.08 0.003")
    world = world_of(vehicle, ground_effect=True)
    begin(world, height=0.1 * radii - 0.02)
    acceleration, turn = pushed(world)
    expected = G * (ratio - 1)
    assert acceleration[2] == approx(expected, rel=1e-6)
    assert_allclose(turn, 0.0, atol=1e-9)


def test_ground_effect_lifts_the_lower_rotors_more() -> None:
    angle = 0.1  # rolled to the right: rotors 1 and 2, on the right, are lower
    world = world_of(racer(1e-4), ground_effect=True)
    rolled = [cos(angle / 2), sin(angle / 2), 0, 0]
    begin(world, 0.2, quaternion=rolled)
    _, turn = pushed(world)
    middle = 0.2 + cos(angle) * 0.02
    offset = sin(angle) * 0.12
    low = HOVER * lifted(middle - offset)
    high = HOVER * lifted(middle + offset)
    roll = 0.12 * 2 * (high - low)
    expected = (roll / 4e-3, 0, 0)
    assert_allclose(turn, expected, rtol=1e-4, atol=1e-9)
    assert roll < 0


def test_a_craft_drifts_to_the_velocity_of_the_wind() -> None:
    vehicle = dragging()
    world = world_of(vehicle, body_drag=True, wind=(3, -2, 0.5))
    begin(world)
    fly(world, HOVER, 400)
    share = 1 - exp(-0.3 / M * 2.0)
    expected = np.array((3, -2, 0.5)) * share
    assert_allclose(alone(world).velocity, expected, rtol=1e-5)
    # A drawn wind adds to it.
    world = world_of(vehicle, body_drag=True, wind=(3, 0, 0), randomize={"wind_y": 4})
    fly(begin(world), HOVER, 400)
    expected = (3 * share, 4 * share, 0)
    assert_allclose(alone(world).velocity, expected, rtol=1e-5, atol=1e-9)


def test_linear_drag_of_the_option_is_against_the_ground_in_any_wind() -> None:
    file = dragging().path
    vehicle = Vehicle.load(file, linear_drag=0.5)
    world = world_of(vehicle, body_drag=True, wind=(0, 0, 3))
    begin(world)
    fly(world, HOVER, 4000)
    # 0.3 (3 - v) = 0.5 · 0.6 v.
    expected = (0, 0, 1.5)
    assert_allclose(alone(world).velocity, expected, rtol=1e-6, atol=1e-9)


def test_drag_of_a_turning_craft_is_that_of_its_center() -> None:
    vehicle = dragging(1e-4)
    world = world_of(vehicle, body_drag=True)
    begin(world, body_rates=[5.0, 0, 0])
    acceleration, turn = pushed(world, 0.0)
    # The center of mass, 1 cm over the origin, moves at -0.05 m/s along y, and about the origin.
    expected = (0, 0.3 * 0.05 / M, 25 * 0.01 - G)
    assert_allclose(acceleration, expected, rtol=1e-2)
    assert_allclose(turn, 0.0, atol=1e-9)


EVERYTHING: dict[str, Any] = {
    "motor_lag": True,
    "thrust_curve": True,
    "body_drag": True,
    "rotor_drag": True,
    "ground_effect": True,
    "wind": (1.0, 2.0, 0.3),
    "efficiency": (1.0, 0.9, 1.0, 0.95),
}


@pytest.mark.parametrize(
    ("options", "height", "rates"),
    [
        (EVERYTHING, 0.6, [2.0, -1.0, 3.0]),
        ({"ground_effect": True}, 0.07, [0] * 3),
    ],
    ids=["all", "ground_effect"],
)
def test_the_order_of_the_air_forces_is_two(
    options: dict[str, Any], height: float, rates: list[float]
) -> None:
    ends = []
    for step in (0.005, 0.0025, 0.00125, 0.000625):
        world = world_of(racer(step), **options)
        begin(world, height, velocity=[4.0, -3.0, 1.0], body_rates=rates)
        steps = round(0.2 / step)
        fly(world, (3.0, 3.1, 3.2, 3.0), steps)
        end = np.concatenate((world.state.position, world.state.velocity))
        ends.append(end)
    gaps = [float(np.linalg.norm(a - b)) for a, b in pairwise(ends)]
    for coarse, fine in pairwise(gaps):
        order = log2(coarse / fine)
        assert 1.8 < order < 2.2, gaps


# --- gusts ----------------------------------------------------------------------------------------

SPEED = 6.0
HEIGHT = 20.0
W20 = 8.0
FEET = 20.0 / 0.3048
L_U = 20.0 / (0.177 + 0.000823 * FEET) ** 1.2
L_W = 20.0
SIGMA_U = 0.8 / (0.177 + 0.000823 * FEET) ** 0.4
SIGMA_W = 0.8
VARIANCES = np.square((SIGMA_U, SIGMA_U, SIGMA_W))


def gusts(
    num: int,
    steps: int,
    step: float,
    wind: tuple[float, ...] = (6.0, 0.0, 0.0),
    height: float = HEIGHT,
) -> np.ndarray:
    """Gusts of so many worlds, shape (steps, num, 3)."""
    air = Gusts(W20, wind, step)
    dice = np.random.default_rng(0)
    mask = np.ones((num, 1), bool)
    heights = np.full((num, 1), height)
    noise = dice.standard_normal((num, 1, 5))
    air.begin(mask, heights, noise)
    rows = []
    for _ in range(steps):
        noise = dice.standard_normal((num, 1, 5))
        air.step(None, noise)
        rows.append(air.velocity)
    blown = np.array(rows)[..., 0]
    return blown.transpose(0, 2, 1)


def test_gusts_are_stationary_from_the_first_step() -> None:
    num = 20_000
    blown = gusts(num, 40, 0.25)
    for row in (blown[0], blown[1], blown[-1]):
        mean = abs(row.mean(axis=0))
        assert (mean < 5 * SIGMA_U / sqrt(num)).all()
        share = row.var(axis=0) / VARIANCES
        assert_allclose(share, 1.0, atol=5 * sqrt(2 / num))
        expected = np.eye(3)
        found = np.corrcoef(row.T)
        assert_allclose(found, expected, atol=5 / sqrt(num))


def test_correlation_of_gusts_over_time() -> None:
    """Along the wind exp(-r / L); across it (1 - r / 2L) exp(-r / L), with r = V t."""
    num = 20_000
    step = 0.5
    blown = gusts(num, 80, step, wind=(0.0, 6.0, 0.0))  # along y
    for count in (1, 5, 20, 60):
        product = blown[0] * blown[count]
        seen = product.mean(axis=0) / VARIANCES
        r = SPEED * step * count
        along = exp(-r / L_U)
        across = (1 - r / (2 * L_U)) * exp(-r / L_U)
        up = (1 - r / (2 * L_W)) * exp(-r / L_W)
        expected = (across, along, up)
        assert_allclose(seen, expected, atol=5 * sqrt(2 / num))


def test_spectra_of_gusts() -> None:
    """Welch's estimate, with a Hann window, over worlds, averaged in bands of frequency."""
    num = 300
    steps = 4096
    step = 0.02
    blown = gusts(num, steps, step)
    window = np.hanning(steps)[:, None, None]
    spectrum = np.fft.rfft(blown * window, axis=0)
    power = abs(spectrum) ** 2
    # One-sided over the angular frequency: 2 · step / (2π · Σ window²).
    energy = np.square(window).sum()
    density = power.mean(axis=1) * step / (pi * energy)
    omega = 2 * pi * np.fft.rfftfreq(steps, step)
    x = omega * L_U / SPEED
    y = omega * L_W / SPEED
    level = SIGMA_U**2 * L_U / (pi * SPEED)
    level_up = SIGMA_W**2 * L_W / (pi * SPEED)
    along = 2 * level / (1 + x**2)
    across = level * (1 + 3 * x**2) / (1 + x**2) ** 2
    up = level_up * (1 + 3 * y**2) / (1 + y**2) ** 2
    # Between what the window blurs and what sampling folds back.
    for axis, curve in enumerate((along, across, up)):
        for first, last in ((8, 16), (16, 32), (32, 64), (64, 128), (128, 256), (256, 400)):
            # (last - first) bins of `num` worlds; neighbours under the window count half.
            count = num * (last - first)
            sigma = sqrt(2 / count)
            found = density[first:last, axis].mean()
            share = found / curve[first:last].mean()
            assert share == approx(1.0, abs=5 * sigma + 0.03), (axis, first)


@pytest.mark.parametrize(("height", "feet"), [(0.0, 10.0), (30.48, 100.0), (900.0, 1000.0)])
def test_scales_of_gusts_at_heights(height: float, feet: float) -> None:
    """10 to 1,000 feet; σ_u / σ_w = 1 / (0.177 + 0.000823 h)^0.4, and L_w = h."""
    num = 20_000
    blown = gusts(num, 2, 0.3, height=height)
    ratio = blown[0].std(axis=0) / 0.8
    across = 1 / (0.177 + 0.000823 * feet) ** 0.4
    expected = (across, across, 1.0)
    assert_allclose(ratio, expected, rtol=5 / sqrt(2 * num))
    r = SPEED * 0.3 / (feet * 0.3048)
    product = blown[0, :, 2] * blown[1, :, 2]
    seen = product.mean() / 0.64
    up = (1 - r / 2) * exp(-r)
    assert seen == approx(up, abs=5 * sqrt(2 / num))


@pytest.mark.parametrize("step", [1e-5, 1e-3])
def test_gusts_in_short_steps_are_numbers(step: float) -> None:
    blown = gusts(2000, 3, step, wind=(0.0, 0.0, 0.0), height=300.0)
    assert np.isfinite(blown).all()
    assert blown.std() == approx(0.8, rel=0.1)
    # In a short time t, with V = 1 m/s: E (u(t) - u(0))² = 2 σ² t / L.
    feet = 300 / 0.3048
    length = 300 / (0.177 + 0.000823 * feet) ** 1.2
    sigma = 0.8 / (0.177 + 0.000823 * feet) ** 0.4
    change = blown[1, :, 0] - blown[0, :, 0]
    moved = np.square(change).mean()
    expected = 2 * sigma**2 * step / length
    assert moved == approx(expected, rel=5 * sqrt(2 / 2000))


# --- a payload ------------------------------------------------------------------------------------


def test_the_tension_of_a_cable_is_the_weight_of_its_payload() -> None:
    world = world_of(payload=0.15, cable=0.5)
    begin(world)
    lifting = HOVER * 0.75 / 0.6
    fly(world, lifting, 400)
    assert_allclose(alone(world).velocity, 0.0, atol=1e-9)
    found = alone(world).position[2]
    assert found == approx(50.0, abs=2e-3)  # the cable gives a little
    # With its own hover it sinks together with the payload, at g · 0.15 / 0.75.
    fly(begin(world), HOVER, 400)
    expected = -G * 0.15 / 0.75 * 2.0
    assert alone(world).velocity[2] == approx(expected, rel=1e-3)


def test_a_cable_is_slack_in_free_fall() -> None:
    world = world_of(payload=0.15, cable=0.5)
    begin(world)
    fly(world, 0.0, 200)
    assert alone(world).velocity[2] == approx(-G * 1.0, rel=1e-12)
    assert alone(world).payload_velocity[2] == approx(-G * 1.0, rel=1e-12)
    found = alone(world).payload_velocity[:2].tolist()
    assert found == [0.0, 0.0]
    assert world_of().state.payload_velocity is None


def pendulum(vehicle: Vehicle, mass: float, cable: float, angle: float) -> tuple[Any, Any]:
    """Model and data with a payload that hangs at an angle in x, under a craft at 50 m."""
    model = swarm_model([vehicle], payload=mass, cable=cable)
    data = mujoco.MjData(model)
    data.qpos[:7] = (0, 0, 50, 1, 0, 0, 0)
    data.qpos[7:10] = (cable * sin(angle), 0, 50 - cable * cos(angle))
    return model, data


def test_the_period_of_a_pendulum() -> None:
    # Under the paper's 20 kg, held against the weight of both: 2π √(L/g) √(M / (M + m)).
    model, data = pendulum(Vehicle.load(), 0.2, 2.0, 0.05)
    data.ctrl[:] = 20.2 * 9.8 / 4
    crossings = []
    last = 1.0
    while len(crossings) < 5:
        mujoco.mj_step(model, data)
        offset = data.qpos[7] - data.qpos[0]
        if offset * last < 0:
            past = 0.01 * offset / (offset - last)
            crossings.append(data.time - past)
        last = offset
    period = (crossings[4] - crossings[0]) / 2
    expected = 2 * pi * sqrt(2.0 / 9.8) * sqrt(20 / 20.2)
    assert period == approx(expected, rel=1e-3)


def test_a_cable_conserves_momentum() -> None:
    model, data = pendulum(Vehicle.load(RACER), 0.15, 0.5, 0.0)
    data.qvel[6:9] = (2.0, 1.0, -3.0)  # away: the cable pulls
    data.ctrl[:] = 0.0
    for _ in range(200):
        mujoco.mj_step(model, data)
    mujoco.mj_subtreeVel(model, data)
    craft, ball = model.jnt_bodyid
    of_craft = 0.6 * data.subtree_linvel[craft]
    of_ball = 0.15 * data.subtree_linvel[ball]
    momentum = of_craft + of_ball
    given = 0.15 * np.array((2.0, 1.0, -3.0))
    expected = given - (0, 0, 0.75 * G)
    assert_allclose(momentum, expected, rtol=1e-7)
    assert data.qvel[2] != -G  # it did pull


def test_a_payload_touches_the_ground_before_the_craft_does() -> None:
    world = world_of(payload=0.15, cable=0.5)
    begin(world, height=0.7)
    assert not alone(world).touching
    # It falls at g · (1 - 0.6 / 0.75), and the ball, 0.033 m in radius, has 0.167 m to go.
    seconds = sqrt(2 * 0.167 / (0.2 * G))
    fly(world, HOVER, 1, round(0.9 * seconds / H))
    assert not alone(world).touching
    fly(world, HOVER, 1, round(0.2 * seconds / H))
    assert alone(world).touching
    found = alone(world).position[2]
    assert found == approx(0.53, abs=0.05)


def test_a_payload_that_hangs_in_the_ground_or_in_the_craft_is_refused() -> None:
    world = world_of(payload=0.15, cable=2.0)
    refused(r"^start: expected a height over 2\.033 m, .*, got 1 m$", begin, world, 1.0)
    short = r"^effects\.cable: expected a length .*, got 0\.05 m$"
    refused(short, world_of, payload=10.0, cable=0.05)


# --- off, alone and together ----------------------------------------------------------------------


@pytest.mark.parametrize("num_worlds", [1, 3])
def test_off_is_bit_for_bit_absence(num_worlds: int) -> None:
    vehicle = Vehicle.load(RACER)
    off = EffectOptions(motor_lag=False, wind=(0, 0, 0), efficiency=(), gusts=0)
    flown = []
    for given in ({}, {"effects": EffectOptions()}, {"effects": off}):
        world = make_world(vehicle, num_worlds, **given)
        begin(world, 0.5, velocity=[1, 2, 0])
        fly(world, (1.4, 1.5, 1.3, 1.4), 50, 4)
        arrays = [array.tobytes() for array in states(world)]
        flown.append(arrays)
    assert flown[0] == flown[1] == flown[2]


HUNG = {"motor_lag": True, "body_drag": True, "payload": 0.05, "cable": 0.4}


def test_a_closed_world_keeps_its_state_and_no_memory_of_the_simulator() -> None:
    world = world_of(None, 2, randomize={"mass": 1.2, "center_x": 0.01}, **HUNG)
    begin(world)
    fly(world, 2.0, 5)
    before = world.state.position.copy()
    world.close()
    assert world.state.position.tobytes() == before.tobytes()
    for value in vars(world).values():
        if isinstance(value, np.ndarray):
            assert value.base is None


# --- randomisation --------------------------------------------------------------------------------


def test_drawn_mass_inertia_and_center_are_those_of_a_compiled_model() -> None:
    text = RACER.read_text().replace(
        'pos="0 0 0.01" mass="0.6" diaginertia="4e-3 5e-3 8e-3"',
        # 1.2 times the mass, 1.2 · 1.1 times the inertia, (0.02, -0.01, 0.005) further.
        'pos="0.02 -0.01 0.015" mass="0.72" diaginertia="5.28e-3 6.6e-3 10.56e-3"',
    )
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[2] = 50.0
    data.qvel[3:6] = (0.3, 0.2, 0.1)
    data.ctrl[:] = HOVER
    drawn = {"mass": 1.2, "inertia": 1.1, "center_x": 0.02, "center_y": -0.01, "center_z": 0.005}
    world = world_of(randomize=drawn)
    begin(world, body_rates=[0.3, 0.2, 0.1])
    fly(world, HOVER, 200)
    mujoco.mj_step(model, data, 200)
    state = alone(world)
    expected = data.qpos[:3]
    assert_allclose(state.position, expected, rtol=0, atol=1e-12)
    expected = data.qpos[3:7]
    assert_allclose(state.quaternion, expected, rtol=0, atol=1e-12)
    expected = data.qvel[:3]
    assert_allclose(state.velocity, expected, rtol=0, atol=1e-12)
    expected = data.qvel[3:6]
    assert_allclose(state.body_rates, expected, rtol=0, atol=1e-12)
    assert abs(state.body_rates).max() > 1


@pytest.mark.parametrize("name", [None, *vehicle_names()])
def test_a_drawn_center_turns_every_vehicle(name: str | None) -> None:
    vehicle = Vehicle.load(name)
    weight = vehicle.mass * vehicle.gravity
    x = 0.02 * vehicle.inertia[0, 0] / weight
    y = -0.03 * vehicle.inertia[1, 1] / weight
    world = world_of(vehicle, randomize={"center_x": x, "center_y": y})
    begin(world)
    rates = alone(fly_hovering(world)).body_rates / vehicle.timestep
    # The thrust m g acts at (-x, -y) from the center: the torque is (-y m g, x m g, 0).
    turn = np.linalg.solve(vehicle.inertia, (-y * weight, x * weight, 0.0))
    assert_allclose(rates, turn, rtol=1e-4, atol=1e-6)


def test_a_drawn_center_leaves_what_touches_where_it_is() -> None:
    """A box that is all of the mass, off the origin: MuJoCo takes its frame for the center's."""
    text = RACER.read_text().replace(' size="0.1', ' pos="0 0 0.01" mass="0.6" size="0.1')
    text = re.sub("<inertial.*/>", "", text)
    Path("box.xml").write_text(text)
    world = world_of(Vehicle.load("box.xml"), randomize={"center_z": -0.05})
    begin(world, 0.021)  # The box reaches 0.02 m below the origin.
    assert not world.state.touching
    begin(world, 0.019)
    assert world.state.touching


def test_drawn_drag_thrust_and_mass_scale_what_they_name() -> None:
    drawn = {"mass": 2.0, "thrust": 1.5, "body_drag": 0.5}
    vehicle = dragging(1e-4)
    world = world_of(vehicle, body_drag=True, randomize=drawn)
    begin(world, velocity=[4.0, 0, 0])
    acceleration, _ = pushed(world)
    slowed = -0.5 * 0.3 * 4 / 1.2
    lifting = 1.5 * 4 * HOVER / 1.2 - G
    expected = (slowed, 0, lifting)
    assert_allclose(acceleration, expected, rtol=1e-4, atol=1e-9)
    assert_allclose(alone(world).thrust, 1.5 * HOVER)
    # The drag of Unity's bodies is an acceleration: it does not know the mass.
    draggy = Vehicle.load(linear_drag=0.5)
    world = world_of(draggy, randomize={"mass": 2.0})
    begin(world, velocity=[4.0, 0, 0])
    fly(world, 98.0, 100)
    expected = (4 * exp(-0.5), 0, 0)
    assert_allclose(alone(world).velocity, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("num_worlds", [1, 3])
def test_a_drawn_reaction_one_rotor_and_a_payload(num_worlds: int) -> None:
    drawn = {"reaction": 2.0, "thrust_2": 0.5}
    world = world_of(None, num_worlds, "mujoco", drawn)
    begin(world)
    fly(world, HOVER, 1)
    rates = world.state.body_rates.reshape(-1, 3)
    # Rotor 2 at (-0.14, -0.12) lacks half of its thrust; of the turns it lacks -0.02 twice.
    lost = 0.5 * HOVER * H
    expected = (lost * 0.12 / 4e-3, -lost * 0.14 / 5e-3, lost * 0.04 / 8e-3)
    assert_allclose(rates, [expected] * num_worlds, rtol=1e-3)
    given = world_of(None, num_worlds, "mujoco", {"payload": 2.0}, payload=0.1, cable=0.5)
    heavy = world_of(None, num_worlds, payload=0.2, cable=0.5)
    for one in (given, heavy):
        fly(begin(one), HOVER, 10, 4)
    assert_allclose(given.state.position, heavy.state.position, atol=1e-9)


def test_a_drawn_strength_of_gusts() -> None:
    ours = world_of(randomize={"gusts": 2.0}, gusts=2.0, body_drag=True)
    begin(ours)
    theirs = world_of(gusts=4.0, body_drag=True)
    begin(theirs)
    for world in (ours, theirs):
        world.random.seed(EVERY, [3])
        fly(begin(world), HOVER, 20)
    assert alone(ours).velocity.tolist() == alone(theirs).velocity.tolist() != [0.0, 0.0, 0.0]


def test_a_rotor_that_the_vehicle_lacks_is_refused() -> None:
    sentence = "thrust_5: expected one of the 4 rotors of the vehicle"
    refused(sentence, world_of, randomize={"thrust_5": 0.5})


def test_distributions_are_told_in_one_way_of_writing() -> None:
    texts = {
        "mass": " uniform(.8,1.20)", "inertia": np.float32(1.5), "center_x": np.int64(0),
        "thrust": "loguniform(1,5e-0)", "center_z": "uniform( 0,0.125 )", "reaction": "1.25",
    }  # fmt: skip
    told = Randomization(texts, None).to_options()
    found = json.loads(json.dumps(told))
    assert found == {
        "mass": "uniform(0.8, 1.2)", "inertia": 1.5, "center_x": 0.0,
        "thrust": "loguniform(1, 5)", "center_z": "uniform(0, 0.125)", "reaction": 1.25,
    }  # fmt: skip
    assert Randomization(told, None).to_options() == told


def test_whole_numbers_have_equal_chances() -> None:
    world = world_of(None, 3000, randomize={"action_delay": "uniform(0, 2)"})
    begin(world)
    values, counts = np.unique(world.parameters["action_delay"], return_counts=True)
    assert values.tolist() == [0.0, 1.0, 2.0]
    deviation = sqrt(3000 * 2 / 9)
    assert (abs(counts - 1000) < 4 * deviation).all()


def check_distribution(
    text: Any, mean: float, deviation: float = 0.0, low: float | None = None, high: float = 0.0
) -> None:
    """Of the factors of the mass of 5000 drones; without ends all are the mean."""
    num = 5000
    world = world_of(None, num, randomize={"mass": text})
    everybody = np.ones((num, 1), bool)
    world.random.seed(everybody, list(range(num)))
    begin(world)
    values = world.parameters["mass"]
    error = 5 / sqrt(num)
    assert values.mean() == approx(mean, abs=deviation * error + 1e-12)
    assert values.std() == approx(deviation, rel=error, abs=1e-12)
    if low is None:
        low = high = mean
    assert low <= values.min()
    assert values.max() <= high


def test_distributions() -> None:
    check_distribution("uniform(0.8, 1.2)", 1.0, 0.4 / sqrt(12), 0.8, 1.2)
    # The mean of 2^u with u from -1 to 1, and its mean square, (4 - 1/4) / (2 ln 4).
    mean = 1.5 / log(4)
    deviation = sqrt(3.75 / (2 * log(4)) - mean**2)
    check_distribution(" loguniform ( 0.5,2 ) ", mean, deviation, 0.5, 2.0)
    check_distribution("1.2", 1.2)
    check_distribution(2, 2.0)
    check_distribution(np.float64(0.7), 0.7)


def test_wrong_distributions() -> None:
    effects = EffectOptions()
    for sentence, drawn in SIM["wrong"]["randomize"]:
        refused(sentence, Randomization, drawn, effects)
    refused("^randomize: expected a mapping from .*, got 'mass'$", Randomization, "mass", None)
    sentence = r"^randomize: mass: expected uniform.*, with .* from 0\.1 to 10, got "
    for text in (None, *SIM["wrong"]["masses"]):
        refused(sentence, Randomization, {"mass": text}, effects)


@pytest.mark.parametrize("num_worlds", [1, 4])
def test_randomisation_and_gusts_do_not_move_the_starts(num_worlds: int) -> None:
    starts = []
    for options in (
        {},
        {"randomize": {"mass": "uniform(0.8,1.2)"}},
        {"effects": {"body_drag": True, "gusts": 5.0}},
    ):
        config = EnvConfig.from_keywords("rotorgram/Hover-v0", vehicle=RACER, **options)
        loop = Loop(config, num_worlds)
        everybody = np.ones(num_worlds, bool)
        still = np.zeros((num_worlds, 4))
        for _ in range(2):
            loop.advance(still, everybody, range(num_worlds))
            loop.advance(still)
            loop.advance(still, everybody)
        starts.append(loop.observations["observation"].tobytes())
    assert starts[0] == starts[1] == starts[2]


# --- wrong options and vehicles -------------------------------------------------------------------


def test_wrong_options() -> None:
    for sentence, options in SIM["wrong"]["effects"]:
        refused(f"^effects{sentence}", effect_options, options)
    refused("^effects.wind: expected 3 numbers .*, got None", effect_options, {"wind": None})
    refused(r"^effects: expected values by name .*, got \[1\]$", effect_options, [1])
    refused("^effects: expected some of .*, got 1$", effect_options, {1: 2})


@pytest.mark.parametrize(("sentence", "effects", "numbers"), SIM["wrong"]["vehicles"])
def test_effects_that_a_vehicle_cannot_have(
    sentence: str, effects: dict[str, Any], numbers: dict[str, str]
) -> None:
    known = {name: text or None for name, text in numbers.items()}
    refused(sentence, world_of, racer(**known), **effects)


def test_options_are_kept_as_floats_and_come_back() -> None:
    given = {"wind": np.array((1, 2, 3)), "gusts": np.int64(4), "efficiency": [1, 0.5]}
    options = effect_options(given)
    told = {"wind": (1.0, 2.0, 3.0), "gusts": 4.0, "efficiency": (1.0, 0.5)}
    assert options.to_options() == told
    assert effect_options(told) == options
    assert EffectOptions().to_options() == {}


def test_rotors_that_push_both_ways_lose_efficiency_and_pass_the_ground() -> None:
    vehicle = racer(1e-4, low="-1")
    options = {"efficiency": (0.5,) * 4, "ground_effect": True, "rotor_drag": True}
    world = world_of(vehicle, **options)
    begin(world, 0.3, velocity=[0.0, 0.0, 2.0])
    acceleration, _ = pushed(world, -0.8)
    # A reversed rotor has neither ground effect nor drag.
    expected = -4 * 0.4 / M - G
    assert acceleration[2] == approx(expected, rel=1e-9)


# --- the page -------------------------------------------------------------------------------------


def test_the_page_has_every_effect_and_every_parameter() -> None:
    page = (ROOT / "docs" / "effects.md").read_text()
    for name in EffectOptions.__dataclass_fields__:
        assert f"`{name}" in page
    for name, one in PARAMETERS.items():
        unit = one.unit or "factor"
        limits = f"{one.low:g} to {one.high:g}"
        needs = " or ".join(f"`{effect}`" for effect in one.needs) or "–"
        assert f"| `{name}` | {one.meaning} | {unit} | {limits} | {needs} |" in page
    assert not re.search(r"\bNaN\b|TODO", page)


def test_the_costs_on_the_page_are_those_that_were_measured() -> None:
    page = (ROOT / "docs" / "effects.md").read_text()
    cost = json.loads((ROOT / "docs" / "results" / "effects" / "cost.json").read_text())
    one = cost["drones"]["1"]
    many = cost["drones"]["1024"]
    assert one["ratio_to_none"]["none"] == 1.0
    assert many["ratio_to_none"]["none"] == 1.0
    for name in one["ratio_to_none"]:
        columns = [name.replace("_", " ")]
        for drones in (one, many):
            speed = drones["steps_per_second"][name]
            ratio = drones["ratio_to_none"][name]
            columns += [f"{speed:,.0f}", f"{ratio:.2f}"]
        row = " | ".join(columns)
        assert f"| {row} |" in page
