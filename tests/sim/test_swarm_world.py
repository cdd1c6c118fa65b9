"""Several drones in one world: as many alone where they keep apart, and a collision."""

import numpy as np
import pytest
from rotorgram.models import InputError, Vehicle
from rotorgram.models.swarm import drone_names, swarm_model
from rotorgram.sim import EffectOptions, InitialState, Randomization, World, make_world

EFFECTS = {
    "motor_lag": True,
    "rotor_drag": True,
    "wind": (3.0, 1.0, 0.0),
    "gusts": 6.0,
    "downwash": True,
}
DRAWN = {"mass": "uniform(0.8, 1.2)", "center_x": "uniform(-0.001, 0.001)"}


def begun(world: World, apart: float = 5.0) -> np.ndarray:
    """Positions from which all drones of a world start, each drone the same in all worlds."""
    worlds, drones = world.shape
    position = np.zeros((worlds, drones, 3))
    position[..., 0] = apart * np.arange(drones)
    position[..., 2] = 20.0
    everybody = np.ones(world.shape, bool)
    world.reset(everybody, InitialState(position=position))
    return position


def thrusts(vehicle: Vehicle, steps: int, count: int) -> np.ndarray:
    """Random thrusts near hover, N, shape (steps, count, R)."""
    share = np.random.default_rng(0).uniform(0.9, 1.1, (steps, count, vehicle.num_rotors))
    return share * vehicle.hover_thrust


@pytest.mark.parametrize("name", [None, "crazyflie2", "heavy_hexa"])
def test_drones_that_keep_apart_fly_bit_for_bit_as_alone(name: str | None) -> None:
    vehicle = Vehicle.load(name)
    drones = 4
    together = make_world(vehicle, 1, drones=drones)
    alone = make_world(vehicle, drones)
    begun(together)
    everybody = np.ones(alone.shape, bool)
    alone.reset(
        everybody, InitialState(position=together.state.position.reshape(drones, 1, 3).copy())
    )
    for thrust in thrusts(vehicle, 50, drones):
        together.step(thrust[None], 2)
        alone.step(thrust[:, None], 2)
    for field in ("position", "quaternion", "velocity", "body_rates", "thrust"):
        ours = getattr(together.state, field)[0]
        theirs = getattr(alone.state, field)[:, 0]
        assert ours.tobytes() == theirs.tobytes(), field
    assert not together.state.touching.any()


def test_a_batch_of_swarms_is_that_many_swarms() -> None:
    vehicle = Vehicle.load("crazyflie2")
    worlds = 3
    drones = 2
    effects = EffectOptions.from_options(EFFECTS)
    drawn = Randomization(DRAWN, effects)
    settings = {"drones": drones, "effects": effects, "randomize": drawn}
    batch = make_world(vehicle, worlds, **settings)
    batch.seed(np.ones((worlds, drones), bool), [5, 6, 7])
    begun(batch)
    given = thrusts(vehicle, 20, worlds * drones).reshape(20, worlds, drones, -1)
    for thrust in given:
        batch.step(thrust, 2)
    for i in range(worlds):
        one = make_world(vehicle, 1, **settings)
        one.seed(np.ones((1, drones), bool), [5 + i])
        begun(one)
        for thrust in given:
            one.step(thrust[i : i + 1], 2)
        assert one.state.position[0].tobytes() == batch.state.position[i].tobytes()


def test_a_collision_keeps_momentum_and_gains_no_energy() -> None:
    """Two drones meet in free fall: their momentum but for gravity's is what it was."""
    vehicle = Vehicle.load()
    world = make_world(vehicle, 1, drones=2)
    position = np.array([[[-1.5, 0.0, 50.0], [1.5, 0.1, 50.05]]])
    velocity = np.array([[[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]])
    none = np.zeros((1, 2, vehicle.num_rotors))
    world.reset(
        np.ones((1, 2), bool), InitialState(position=position, velocity=velocity, thrust=none)
    )
    state = world.state
    met = False
    time = 0.0

    def momentum() -> np.ndarray:
        return vehicle.mass * state.velocity[0].sum(axis=0)

    def kinetic() -> float:
        rates = state.body_rates[0]
        turning = np.einsum("ai,ij,aj->", rates, vehicle.inertia, rates)
        return 0.5 * (vehicle.mass * (state.velocity[0] ** 2).sum() + turning)

    before = momentum()
    start = kinetic()
    for _ in range(100):
        world.step(none, 1)
        time += vehicle.timestep
        met = met or bool(state.colliding.all())
        fallen = vehicle.gravity * time
        expected = before - (0.0, 0.0, 2 * vehicle.mass * fallen)
        assert momentum() == pytest.approx(expected, abs=1e-6)
        falling = vehicle.mass * (state.velocity[0, :, 2] ** 2).sum() / 2
        assert kinetic() - falling <= start * (1 + 1e-9) + 1e-9
    assert met
    assert kinetic() - vehicle.mass * fallen**2 < 0.9 * start  # what contact took
    assert state.velocity[0, 0, 0] < 1.0  # it was stopped


def test_the_ground_and_another_drone_are_told_apart() -> None:
    vehicle = Vehicle.load()
    world = make_world(vehicle, 2, drones=3)
    position = np.zeros((2, 3, 3))
    position[..., 0] = 10.0 * np.arange(3)
    position[..., 2] = 20.0
    position[0, 2, 2] = vehicle.rest_height - 1e-4
    position[1, 1] = position[1, 0] + (0.0, 0.0, 0.05)
    world.reset(np.ones((2, 3), bool), InitialState(position=position))
    assert world.state.touching.tolist() == [[False, False, True], [True, True, False]]
    assert world.state.colliding.tolist() == [[False, False, False], [True, True, False]]
    position[1, 1, 2] = 25.0
    only = np.array([[False] * 3, [True] * 3])
    world.reset(only, InitialState(position=position))
    assert world.state.touching.tolist() == [[False, False, True], [False, False, False]]
    assert not world.state.colliding.any()


def test_every_drone_has_a_draw_of_its_own() -> None:
    vehicle = Vehicle.load()
    drawn = Randomization({"mass": "uniform(0.8, 1.2)"}, EffectOptions())
    world = make_world(vehicle, 2, drones=3, randomize=drawn)
    everybody = np.ones((2, 3), bool)
    world.seed(everybody, [7, 8])
    begun(world)
    mass = world.parameters["mass"]
    assert mass.shape == (2, 3)
    assert len(np.unique(mass)) == 6
    thrust = np.broadcast_to(vehicle.hover_thrust, (2, 3, 4))
    lift = vehicle.hover_thrust.sum() / (vehicle.mass * world.parameters["mass"])
    world.step(thrust, 1)
    gained = world.state.velocity[..., 2] / vehicle.timestep
    assert gained == pytest.approx(lift - vehicle.gravity, abs=1e-9)


def test_what_a_swarm_cannot_have_is_one_sentence() -> None:
    vehicle = Vehicle.load()
    with pytest.raises(InputError, match=r"^drones: expected 1 to 1024, got 0$"):
        make_world(vehicle, 1, drones=0)
    payload = EffectOptions.from_options({"payload": 1.0, "cable": 1.0})
    world = make_world(vehicle, 1, drones=2, effects=payload)
    above = np.full((1, 2, 3), 5.0)
    with pytest.raises(InputError, match=r"payload: expected one drone in a world, or a task .* 2"):
        world.reset(np.ones((1, 2), bool), InitialState(position=above))
    with pytest.raises(InputError, match=r"expected a timestep of 0.01 as of"):
        swarm_model([vehicle, Vehicle.load("crazyflie2")])


def test_names_tell_the_crafts_apart() -> None:
    model = swarm_model([Vehicle.load()] * 2)
    assert drone_names(2) == ("drone_0", "drone_1")
    assert model.body("drone_1/quad").id == 2
    assert model.actuator("drone_1/rotor1").id == 4
