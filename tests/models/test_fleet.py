"""A world whose drones have vehicles of their own."""

import copy
import pickle
from itertools import permutations

import numpy as np
import pytest
from orca import Orca
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.models import InputError, Vehicle
from rotorgram.models.fleet import Fleet, load_vehicles, members_of
from rotorgram.sim import LEVELS, EffectOptions, InitialState, make_controller, make_world
from rotorgram.sim.control import Gains
from rotorgram.udp.spawn import spawn_simulator
from worlds import alone, begin

MIX = "crazyflie2,hummingbird,paper"
FORMATION = "rotorgram/Formation-v0"
CROSSING = "rotorgram/Crossing-v0"


def test_vehicles_go_to_the_drones_in_turn() -> None:
    fleet = load_vehicles("crazyflie2, paper", 5)
    assert isinstance(fleet, Fleet)
    one = Vehicle.load("crazyflie2")
    other = Vehicle.load("paper")
    in_turn = [one, other, one, other, one]
    assert [craft.hash for craft in fleet.members] == [craft.hash for craft in in_turn]
    assert load_vehicles("paper", 3) is other
    assert load_vehicles("paper,paper", 2) is other  # alike: one for all
    assert members_of(other, 2) == (other, other)
    with pytest.raises(InputError, match=r"vehicle: expected at most one .* of 2 drones, got 3"):
        load_vehicles(MIX, 2)
    with pytest.raises(InputError, match=r"expected 4 rotors as of Crazyflie 2.x, got 6 of"):
        load_vehicles("crazyflie2,heavy_hexa", 2)


def test_a_fleet_has_the_numbers_of_its_vehicles_under_one_step_and_gravity() -> None:
    fleet = load_vehicles("paper,crazyflie2", 2)
    paper = Vehicle.load("paper")
    nano = Vehicle.load("crazyflie2")
    assert paper.gravity != nano.gravity
    assert fleet.timestep == nano.timestep
    assert fleet.gravity == paper.gravity
    assert fleet.mass.tolist() == [paper.mass, nano.mass]
    assert fleet.hover_thrust.sum(axis=1) == pytest.approx(paper.gravity * fleet.mass)
    np.testing.assert_array_equal(fleet.thrust_high, [paper.thrust_high, nano.thrust_high])
    assert fleet.radius == paper.radius
    assert fleet.rest_height == paper.rest_height
    assert len(fleet.hash) == 32
    assert fleet.hash != load_vehicles("crazyflie2,paper", 2).hash
    assert pickle.loads(pickle.dumps(fleet)).hash == fleet.hash
    assert copy.deepcopy(fleet) is fleet
    assert nano.timestep == Vehicle.load("crazyflie2").timestep != paper.timestep


def test_drones_far_apart_fly_as_each_vehicle_alone() -> None:
    """Within 1e-9 m after 2 s: a world of three has larger matrices, which round otherwise."""
    fleet = load_vehicles(MIX, 3)
    assert isinstance(fleet, Fleet)
    places = np.array([[[0.0, 0, 50], [100, 0, 50], [0, 200, 50]]])
    rates = np.array([[[0.3, -0.2, 0.1], [0.0, 0.4, 0.2], [0.1, 0.0, -0.3]]])
    steps = round(2 / fleet.timestep)
    together = make_world(fleet, 1, drones=3)
    everyone = np.ones((1, 3), bool)
    together.reset(everyone, InitialState(position=places, body_rates=rates))
    assert together.state.thrust[0] == pytest.approx(fleet.hover_thrust)
    together.step(1.05 * fleet.hover_thrust[None], steps)
    for i, craft in enumerate(fleet.members):
        single = make_world(craft, 1)
        begin(single, position=places[0, i], body_rates=rates[0, i])
        single.step(1.05 * craft.hover_thrust, steps)
        place = together.state.position[0, i]
        attitude = together.state.quaternion[0, i]
        assert place == pytest.approx(alone(single).position, abs=1e-9)
        assert attitude == pytest.approx(alone(single).quaternion, abs=1e-9)


@pytest.mark.parametrize("level", LEVELS)
def test_every_level_is_flown_by_each_vehicle_s_own_controller(level: str) -> None:
    """With the ranges of the least able: an action of 0 hovers, one of 1 means the same to all."""
    fleet = load_vehicles(MIX, 3)
    assert isinstance(fleet, Fleet)
    env = LocalVectorEnv(FORMATION, 6, drones=3, vehicle=MIX, action=level)
    env.reset(seed=0)
    state = env.loop.world.state
    start = state.position.copy()
    for _ in range(25):
        env.step(np.zeros(env.action_space.shape, np.float32))
    assert state.position == pytest.approx(start, abs=1e-4)
    controller = make_controller(level, fleet, fleet.timestep)
    dice = np.random.default_rng(0)
    action = dice.uniform(-0.3, 0.3, (2, 3, len(controller.low)))
    thrust = controller.thrust(action, state)
    assert thrust.shape == (2, 3, 4)
    if level in ("rotors", "offset", "increment"):
        for i, craft in enumerate(fleet.members):
            own = make_controller(level, craft, fleet.timestep)
            its = slice(i, i + 1)
            expected = own.thrust(action[:, its], state.of([i]))
            np.testing.assert_allclose(thrust[:, its], np.broadcast_to(expected, (2, 1, 4)), 1e-6)
    if level == "velocity":
        gains = [Gains.of(craft, fleet.timestep) for craft in fleet.members]
        slowest = min(one.most_velocity[0] for one in gains)
        assert env.env_spec.action_scale[0] == slowest


def test_an_asked_velocity_is_reached_by_all() -> None:
    env = LocalVectorEnv(FORMATION, 3, drones=3, vehicle=MIX, autoreset_mode="Disabled")
    env.reset(seed=0)
    action = np.zeros((3, 4), np.float32)
    action[:, 2] = 0.5
    for _ in range(200):
        env.step(action)
    asked = 0.5 * env.env_spec.action_scale[2]
    climb = env.loop.world.state.velocity[0, :, 2]
    assert climb == pytest.approx(np.full(3, asked), rel=1e-3)


def test_the_clearance_is_between_the_spheres_of_each() -> None:
    env = LocalVectorEnv(FORMATION, 3, drones=3, vehicle=MIX)
    env.reset(seed=0)
    place = env.loop.world.state.position[0]
    fleet = load_vehicles(MIX, 3)
    radii = [craft.radius for craft in members_of(fleet, 3)]
    room = np.full((3, 3), np.inf)
    for one, other in permutations(range(3), 2):
        distance = np.linalg.norm(place[one] - place[other])
        room[one, other] = distance - radii[one] - radii[other]
    assert env.loop.metrics["clearance"] == pytest.approx(room.min(axis=1))


def test_over_udp_it_is_the_same_to_the_bit() -> None:
    options = {"drones": 3, "vehicle": MIX}
    local = LocalVectorEnv(CROSSING, 3, **options)
    with spawn_simulator(EnvConfig.from_keywords(CROSSING, **options), num_envs=3) as remote:
        assert remote.env_spec == local.env_spec
        ours = local.reset(seed=5)
        theirs = remote.reset(seed=5)
        remote.action_space.seed(1)
        for _ in range(40):
            assert theirs[0].tobytes() == ours[0].tobytes()
            actions = remote.action_space.sample()
            ours = local.step(actions)
            theirs = remote.step(actions)
            for mine, its in zip(ours[1:4], theirs[1:4], strict=True):
                assert mine.tolist() == its.tolist()


def test_orca_crosses_with_different_vehicles() -> None:
    env = LocalVectorEnv(CROSSING, 8, drones=4, vehicle="crazyflie2,hummingbird",
                         autoreset_mode="Disabled")  # fmt: skip
    flights = fly_episodes(env, Orca(env.env_spec), 2, "final")
    for flight in flights:
        assert flight.ending == "truncated"
        errors, room = flight.telemetry["metrics"].T
        assert errors[-100:].mean() < 0.1
        assert room.min() > 0.0


def test_what_a_fleet_cannot_have_is_one_sentence() -> None:
    fleet = load_vehicles("crazyflie2,paper", 2)
    with pytest.raises(InputError, match=r"vehicle: expected one with the backend rigid, got"):
        make_world(fleet, 1, "rigid", drones=2)
    lag = EffectOptions(motor_lag=True)
    with pytest.raises(InputError, match=r"expected none with several vehicles, got motor_lag"):
        make_world(fleet, 1, drones=2, effects=lag)
    with pytest.raises(InputError, match=r"sensors: expected none with several vehicles, got imu"):
        LocalVectorEnv(FORMATION, 2, drones=2, vehicle="crazyflie2,paper", sensors={"imu": True})
    with pytest.raises(InputError, match=r"cameras: expected none with several vehicles, got down"):
        LocalVectorEnv(FORMATION, 2, drones=2, vehicle="crazyflie2,paper", cameras="down")
    with pytest.raises(InputError, match=r"vehicle: expected one for all drones that carry"):
        LocalVectorEnv("rotorgram/Cable-v0", 2, drones=2, vehicle="crazyflie2,paper")
