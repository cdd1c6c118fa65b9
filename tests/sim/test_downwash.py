"""The jets below drones: their formula, their momentum, and what they do to the drones in them."""

from math import cos, pi, radians, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.models import InputError, Vehicle
from rotorgram.models.library import vehicle_names
from rotorgram.sim import EffectOptions, World, make_world
from rotorgram.sim.effects.downwash import Downwash
from worlds import begin

approx = pytest.approx
ROOT = Path(__file__).parents[2]
BIRD = "hummingbird"
# Of its file, typed here again: four rotors at 0.17 m, their radius, and its drag along z.
LENGTH = 0.34
RADIUS = 0.1
DRAG = 0.01
MASS = Vehicle.load(BIRD).mass
WEIGHT = MASS * Vehicle.load(BIRD).gravity
SPEED = sqrt(WEIGHT / (2 * 1.225 * 4 * pi * RADIUS**2))  # at the rotors, in hover


def jet(below: float, beside: float = 0.0, thrust: float = WEIGHT) -> float:
    """Of the bird, at distances in its lengths."""
    numbers = (np.array([x]) for x in (thrust, below * LENGTH, beside * LENGTH))
    return float(Downwash(Vehicle.load(BIRD)).velocity(*numbers)[0])


def test_the_profile_by_hand() -> None:
    assert jet(5.0) == approx(SPEED * 10.11 / 10.817, rel=1e-6)
    half = 0.07668 * 10.817  # radius at which the velocity has halved
    assert jet(5.0, half) == approx(jet(5.0) / 2, rel=1e-6)
    share = 1 + 4 * (sqrt(2) - 1)
    expected = jet(5.0) / share**2
    assert jet(5.0, 2 * half) == approx(expected)
    found = jet(5.0, thrust=4 * WEIGHT)
    assert found == approx(2 * jet(5.0))
    assert jet(100.0) / jet(50.0) == approx(55.817 / 105.817)
    # Nearer than 2.5 lengths the speed falls to 0 at the height of the rotors, and above it is 0.
    assert jet(1.25) == approx(jet(2.5) / 2)
    assert jet(0.0) == 0.0
    assert jet(-1.0) == 0.0
    assert jet(5.0, thrust=-1.0) == 0.0


@pytest.mark.parametrize("name", sorted(set(vehicle_names()) - {"paper"}))
def test_the_momentum_of_a_jet_is_the_thrust_but_for_a_third(name: str) -> None:
    """ρ ∫ V² dA = ρ U² l² π B² S² / (3 (√2 - 1)) at every depth, by integration. Of an ideal rotor
    it is the thrust; the paper fits no momentum, so that this tells whether numbers are misread.
    """
    vehicle = Vehicle.load(name)
    if vehicle.coefficients["rotors.radius"] is None:
        pytest.skip("no rotors.radius")
    downwash = Downwash(vehicle)
    weight = vehicle.mass * vehicle.gravity
    for depth in (3.0, 30.0):
        radius = np.linspace(0.0, 60 * depth / 3 * downwash.length, 300_001)
        far = np.full_like(radius, depth * downwash.length)
        speed = downwash.velocity(np.full_like(radius, weight), far, radius)
        rings = speed**2 * radius
        momentum = 1.225 * 2 * pi * np.trapezoid(rings, radius)
        area = vehicle.num_rotors * pi * vehicle.coefficients["rotors.radius"] ** 2
        shape = pi * (10.11 * 0.07668) ** 2 / (3 * (sqrt(2) - 1))
        expected = weight / (2 * area) * downwash.length**2 * shape
        assert momentum == approx(expected, rel=1e-3)
        assert 2 / 3 < momentum / weight < 1.0


def birds(*lengths: Any, quaternion: Any = (1.0, 0.0, 0.0, 0.0), **effects: Any) -> World:
    """One world of birds at rest at 20 m, and places from there in lengths, at hover thrust."""
    options = EffectOptions(**effects)
    count = len(lengths)
    world = make_world(Vehicle.load(BIRD), 1, drones=count, effects=options)
    place = LENGTH * np.array(lengths) + (0.0, 0.0, 20.0)
    return begin(world, position=place.reshape(*world.shape, 3), quaternion=quaternion)


TOP = (0.0, 0.0, 0.0)
LOWER = (0.0, 0.0, -5.0)


def hover(world: World, steps: int = 1) -> np.ndarray:
    """Velocities after physics steps at hover thrust, shape (A, 3)."""
    thrust = np.broadcast_to(world.vehicle.hover_thrust, world.state.thrust.shape)
    world.step(thrust, steps)
    return np.array(world.state.velocity).reshape(-1, 3)


def test_the_lower_drone_is_pushed_down_by_its_drag_and_the_upper_is_not() -> None:
    world = birds(TOP, LOWER, body_drag=True, downwash=True)
    velocity = hover(world)
    wind = jet(5.0)
    expected = -DRAG * wind * wind / MASS * world.vehicle.timestep
    assert velocity[1] == approx([0.0, 0.0, expected], rel=1e-3, abs=1e-12)
    assert velocity[0] == approx([0.0, 0.0, 0.0], abs=1e-12)
    assert hover(world, 200)[1, 2] < -0.2  # m/s, after 2 s
    assert abs(hover(world)[0, 2]) < 1e-9


def test_rotors_in_the_jet_lose_thrust_by_their_inflow() -> None:
    world = birds(TOP, LOWER, rotor_drag=True, downwash=True)
    own = world.vehicle.coefficients
    speeds = np.sqrt(world.vehicle.hover_thrust / own["rotors.thrust_coefficient"])
    lost = own["rotors.inflow"] * speeds.sum() * jet(5.0)
    expected = -lost / MASS * world.vehicle.timestep
    found = hover(world)[1, 2]
    assert found == approx(expected, rel=1e-3)


def test_a_tilted_craft_blows_along_its_own_axis() -> None:
    """By 30° about y: its jet goes down and to -x, and misses the one straight below."""
    tilt = radians(30)
    quaternion = (cos(tilt / 2), 0.0, sin(tilt / 2), 0.0)
    there = (-8 * sin(tilt), 0.0, -8 * cos(tilt))
    world = birds(TOP, there, (0.0, 0.0, -8.0), quaternion=quaternion)
    air = np.stack(Downwash(world.vehicle).air(world.state), axis=-1)[0]
    assert air[0] == approx([0.0, 0.0, 0.0], abs=1e-3)
    own = jet(8.0)
    side = jet(8.0 * cos(tilt), 8.0 * sin(tilt))
    speed = np.linalg.norm(air[1])
    assert speed == approx(own, rel=0.02)  # the third one's edge besides
    expected = [-0.5, 0.0, -sqrt(0.75)]
    assert air[1] / speed == approx(expected, abs=1e-6)
    found = np.linalg.norm(air[2])
    assert found == approx(side, rel=0.02)
    assert side < 0.1 * own


def test_jets_of_several_add_up() -> None:
    world = birds(TOP, (0.0, 0.0, -4.0), (0.0, 0.0, -9.0))
    air = np.stack(Downwash(world.vehicle).air(world.state), axis=-1)[0]
    expected = [0.0, 0.0, -(jet(9.0) + jet(5.0))]
    assert air[2] == approx(expected, rel=1e-6)


@pytest.mark.parametrize("places", [[TOP], [TOP, (6.0, 0.0, 0.0)]])
def test_alone_and_side_by_side_it_changes_no_bit(places: Any) -> None:
    flown = []
    for on in (True, False):
        world = birds(*places, body_drag=True, wind=(1.0, 0.5, 0.0), downwash=on)
        flown.append(hover(world, 5).tobytes())
    assert flown[0] == flown[1]


def test_what_lacks_is_one_sentence() -> None:
    with pytest.raises(InputError, match="effects: expected body_drag or rotor_drag, on which"):
        birds(TOP, LOWER, downwash=True)
    with pytest.raises(InputError, match=r"rotors\.radius in .*, which downwash needs"):
        Downwash(Vehicle.load())
    with pytest.raises(InputError, match=r"effects\.downwash: expected true or false, got 1"):
        EffectOptions(downwash=1)  # type: ignore[arg-type]
