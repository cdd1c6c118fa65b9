"""Several drones in one world that meet, on mujoco, and what a swarm cannot have."""

import numpy as np
import pytest
from rotorgram.models import InputError, Vehicle
from rotorgram.models.swarm import drone_names, swarm_model
from rotorgram.sim import EffectOptions, make_world
from worlds import begin


def test_a_collision_keeps_momentum_and_gains_no_energy() -> None:
    """Two drones meet in free fall: their momentum but for gravity's is what it was."""
    vehicle = Vehicle.load()
    world = make_world(vehicle, 1, drones=2)
    position = np.array([[[-1.5, 0.0, 50.0], [1.5, 0.1, 50.05]]])
    velocity = np.array([[[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]])
    none = np.zeros((1, 2, vehicle.num_rotors))
    begin(world, position=position, velocity=velocity, thrust=none)
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
    begin(world, position=position)
    assert world.state.touching.tolist() == [[False, False, True], [True, True, False]]
    assert world.state.colliding.tolist() == [[False, False, False], [True, True, False]]
    position[1, 1, 2] = 25.0
    only = np.array([[False] * 3, [True] * 3])
    begin(world, only, position=position)
    assert world.state.touching.tolist() == [[False, False, True], [False, False, False]]
    assert not world.state.colliding.any()


def test_what_a_swarm_cannot_have_is_one_sentence() -> None:
    vehicle = Vehicle.load()
    payload = EffectOptions(payload=1.0, cable=1.0)
    world = make_world(vehicle, 1, drones=2, effects=payload)
    with pytest.raises(InputError, match=r"payload: expected one drone in a world, or a task .* 2"):
        begin(world, position=(5.0, 5.0, 5.0))
    with pytest.raises(InputError, match=r"expected a timestep of 0.01 as of"):
        swarm_model([vehicle, Vehicle.load("crazyflie2")])


def test_names_tell_the_crafts_apart() -> None:
    model = swarm_model([Vehicle.load()] * 2)
    assert drone_names(2) == ("drone_0", "drone_1")
    assert model.body("drone_1/quad").id == 2
    assert model.actuator("drone_1/rotor1").id == 4
