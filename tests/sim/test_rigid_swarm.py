"""Several drones in a world: alone as together, rigid as mujoco, and who meets on rigid."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.parallel import LocalParallelEnv
from rotorgram.models import Vehicle
from rotorgram.sim import (
    EffectOptions,
    Randomization,
    make_world,
)
from tables import SIM
from worlds import begin

FORMATION = "rotorgram/Formation-v0"
CROSSING = "rotorgram/Crossing-v0"
MOVED = ("position", "quaternion", "velocity", "body_rates", "thrust")
EFFECTS = {"motor_lag": True, "rotor_drag": True, "wind": (3.0, 1.0, 0.0)}
DRAWN = SIM["rigid"]["drawn"]


def arrays(vehicle: Vehicle, worlds: int, drones: int, dtype: str = "float64", **rest: Any) -> Any:
    given = {"drones": drones, "dtype": dtype, **rest}
    return make_world(vehicle, worlds, "rigid", **given)


def tumbling(worlds: int, drones: int) -> dict[str, np.ndarray]:
    """Starts high up, 50 m apart, at any attitude."""
    dice = np.random.default_rng(0)
    shape = (worlds, drones)
    turned = dice.normal(size=(*shape, 4))
    turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
    position = dice.uniform(1000.0, 1001.0, (*shape, 3))
    position[..., 0] += 50.0 * np.arange(drones)
    return {
        "position": position,
        "quaternion": turned,
        "velocity": dice.normal(size=(*shape, 3)),
        "body_rates": dice.normal(size=(*shape, 3)),
    }


def near_hover(vehicle: Vehicle, steps: int, *shape: int) -> np.ndarray:
    """Random thrusts, N, shape (steps, *shape, R)."""
    dice = np.random.default_rng(1)
    share = dice.uniform(0.9, 1.1, (steps, *shape, vehicle.num_rotors))
    return share * vehicle.hover_thrust


# --- flights --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "backend", [{"backend": "mujoco"}, {}, {"compiled": False}], ids=["mujoco", "rigid", "NumPy"]
)
@pytest.mark.parametrize(
    ("name", "effects"), [(None, {}), ("crazyflie2", EFFECTS), ("heavy_hexa", {})]
)
def test_drones_that_keep_apart_fly_bit_for_bit_as_alone(
    name: str | None, effects: dict[str, Any], backend: dict[str, Any]
) -> None:
    vehicle = Vehicle.load(name)
    options: Any = {"effects": EffectOptions(**effects), "backend": "rigid", **backend}
    together = make_world(vehicle, 2, drones=3, **options)
    alone = make_world(vehicle, 6, **options)
    pose = tumbling(2, 3)
    begin(together, **pose)
    apart = {name: values.reshape(6, 1, -1) for name, values in pose.items()}
    begin(alone, **apart)
    for step, thrust in enumerate(near_hover(vehicle, 20, 2, 3)):
        some = np.array([[True] * 3, [step % 4 > 0] * 3])
        together.step(thrust, 2, some)
        alone.step(thrust.reshape(6, 1, -1), 2, some.reshape(6, 1))
    for field in MOVED:
        ours = getattr(together.state, field)
        theirs = getattr(alone.state, field)
        assert ours.tobytes() == theirs.tobytes(), field
    expected = alone.acceleration().reshape(2, 3, 3)
    assert together.acceleration() == pytest.approx(expected, abs=1e-9)
    assert not together.state.touching.any()
    assert not together.state.colliding.any()


def test_every_drone_has_the_draws_that_it_has_on_mujoco() -> None:
    """Of mass and the like, and of gusts; float64."""
    vehicle = Vehicle.load("crazyflie2")
    shape = (2, 3)
    effects = EffectOptions(**EFFECTS, gusts=6.0)
    drawing = Randomization(DRAWN, effects)
    given: Any = {"drones": 3, "effects": effects, "randomize": drawing}
    ours = make_world(vehicle, 2, "rigid", dtype="float64", **given)
    theirs = make_world(vehicle, 2, **given)

    for world in (ours, theirs):
        every = np.ones(shape, bool)
        world.random.seed(every, [7, 8])
        begin(world, every, **tumbling(*shape))
    for name in DRAWN:
        drawn = np.asarray(ours.parameters[name])
        assert drawn.tolist() == theirs.parameters[name].tolist()
        assert len(np.unique(drawn)) == 6
    some = np.array([[True] * 3, [False] * 3])
    for step, thrust in enumerate(near_hover(vehicle, 20, *shape)):
        for world in (ours, theirs):
            mask = some if step == 5 else None
            world.step(thrust, 2, mask)
    for field in MOVED:
        found = getattr(ours.state, field)
        expected = getattr(theirs.state, field)
        assert_allclose(found, expected, atol=1e-9, rtol=0, err_msg=field)


def test_downwash_is_that_of_mujoco_and_of_a_world_alone() -> None:
    """Nine drones one above the other, each in the jets of those above it."""
    vehicle = Vehicle.load("hummingbird")
    effects = EffectOptions(body_drag=True, downwash=True)
    dice = np.random.default_rng(0)
    place = dice.uniform(-0.1, 0.1, (2, 9, 3))
    place[..., 2] += 20.0 + 1.0 * np.arange(9)
    thrust = np.broadcast_to(0.95 * vehicle.hover_thrust, (2, 9, 4))
    ours = arrays(vehicle, 2, 9, effects=effects)
    theirs = make_world(vehicle, 2, drones=9, effects=effects)
    alone = arrays(vehicle, 1, 9, effects=effects)
    begin(ours, position=place)
    begin(theirs, position=place)
    begin(alone, position=place[1:])
    for _ in range(25):
        ours.step(thrust, 2)
        theirs.step(thrust, 2)
        alone.step(thrust[1:], 2)
    expected = theirs.state.position
    assert_allclose(ours.state.position, expected, atol=1e-9, rtol=0)
    found = ours.state.position[1].tobytes()
    assert found == alone.state.position[0].tobytes()
    speed = ours.state.velocity[..., 2]
    assert (speed[:, 0] < speed[:, 8] - 0.1).all()  # the lowest, and that above all jets


# --- who meets ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [None, "crazyflie2"])
def test_spheres_touch_at_two_radii_and_fly_on(name: str | None) -> None:
    """Two drones of a world fall side by side and towards each other, ten radii a second each.

    Their spheres are one radius apart, and closer by 0.4 radii after every look: they touch at the
    third, and until 4 radii have passed twice. A third drone, and another world, keep apart.
    """
    vehicle = Vehicle.load(name, linear_drag=0.0)
    radius = vehicle.radius
    looks = round(0.02 / vehicle.timestep)
    world = arrays(vehicle, 2, 3)
    position = np.zeros((2, 3, 3))
    velocity = np.zeros((2, 3, 3))
    position[..., 2] = 1000.0
    position[..., 0] = np.array((-1.5, 1.5, 20.0)) * radius
    velocity[0, 0, 0] = 10 * radius
    velocity[0, 1, 0] = -10 * radius
    none = np.zeros((2, 3, vehicle.num_rotors))

    pose = {"position": position, "velocity": velocity, "thrust": none}
    begin(world, **pose)
    state = world.state
    seen = []
    assert not state.touching.any()
    for _ in range(14):
        world.step(none, looks)
        assert state.touching.tolist() == state.colliding.tolist()
        assert state.touching[0, 0] == state.touching[0, 1]
        assert not state.touching[1].any()
        assert not state.touching[0, 2]
        seen.append(bool(state.touching[0, 0]))
    # Apart by 3 - 0.4 n radii: below 2 from n = 3 on, past each other, and until n = 12.
    assert seen == [False] * 2 + [True] * 10 + [False] * 2
    expected = 10 * radius * np.array((1.0, -1.0, 0.0))
    found = np.asarray(state.velocity[0, :, 0])
    assert found == pytest.approx(expected, abs=1e-12)


def test_a_touch_is_told_of_all_looks_of_a_control_step() -> None:
    """They pass each other within one step: later calls keep what was seen before."""
    vehicle = Vehicle.load(linear_drag=0.0)
    radius = vehicle.radius
    sides = np.array((-1.0, 1.0))
    position = np.zeros((1, 2, 3))
    velocity = np.zeros((1, 2, 3))
    position[0, :, 0] = 3 * radius * sides
    position[..., 2] = 900.0
    velocity[0, :, 0] = -50 * radius * sides
    none = np.zeros((1, 2, 4))
    for held in (20, 10):
        world = arrays(vehicle, 1, 2)
        begin(world, position=position, velocity=velocity, thrust=none)
        world.command(none, None)
        for call in world.calls(20, held):
            world.push(None)
            world.fly(call, None)
        found = world.state.position[0, 0, 0]
        assert found > 5 * radius
        frozen = np.zeros((1, 2), bool)
        world.step(none, 2, frozen)  # nothing is forgotten
        assert world.state.colliding.all()
        world.step(none, 2)
        assert not world.state.touching.any()


def test_of_128_drones_those_that_overlap_are_told() -> None:
    vehicle = Vehicle.load("crazyflie2")
    world = arrays(vehicle, 2, 128, "float32")
    radius = vehicle.radius
    position = np.zeros((2, 128, 3))
    position[..., 0] = 2.001 * radius * np.arange(128)
    position[..., 2] = 100.0
    position[0, 127, :2] = position[0, 40, 0], 1.999 * radius  # beside the 41st, and near two more
    position[1, 0, 2] = position[1, 1, 2] = 0.0  # on the ground, no drone among them
    begin(world, position=position)
    colliding = np.flatnonzero(world.state.colliding[0])
    assert colliding.tolist() == [40, 127]
    touching = np.flatnonzero(world.state.touching[0])
    assert touching.tolist() == [40, 127]
    on_ground = np.flatnonzero(world.state.touching[1])
    assert on_ground.tolist() == [0, 1]
    assert not world.state.colliding[1].any()


def test_it_tells_a_touch_earlier_than_mujoco() -> None:
    """Frames of 2 m side by side meet at 2 m or later; their spheres do before."""
    vehicle = Vehicle.load()
    place = np.array([[[0.0, 0.0, 20.0], [1.99 * vehicle.radius, 0.0, 20.0]]])
    ours = begin(arrays(vehicle, 1, 2), position=place)
    theirs = begin(make_world(vehicle, 1, drones=2), position=place)
    assert ours.state.touching.all()
    assert not theirs.state.touching.any()


def test_a_mask_moves_and_tells_of_its_worlds_alone() -> None:
    vehicle = Vehicle.load()
    shape = (2, 2)
    world = arrays(vehicle, *shape)
    place = np.zeros((2, 2, 3))
    place[..., 2] = 20.0  # both in one place
    begin(world, position=place)
    assert world.state.colliding.all()
    apart = place.copy()
    apart[:, 1, 1] = 50.0
    first = np.array([[True] * 2, [False] * 2])
    second = np.array([[False] * 2, [True] * 2])
    begin(world, second, position=apart)
    found = world.state.touching.tolist()
    assert found == [[True, True], [False, False]]
    thrust = np.broadcast_to(1.1 * vehicle.hover_thrust, (2, 2, 4))
    before = world.state.position[0].tobytes()
    world.step(thrust, 2, second)
    assert world.state.position[0].tobytes() == before
    assert world.state.colliding.tolist() == [[True, True], [False, False]]
    expected = np.broadcast_to(vehicle.hover_thrust, (2, 4))
    assert world.state.thrust[0] == pytest.approx(expected)
    # 0.1 g over 0.02 s.
    climb = 0.1 * vehicle.gravity * 0.02
    assert world.state.velocity[0, :, 2].tolist() == [0.0, 0.0]
    assert world.state.velocity[1, :, 2] == pytest.approx([climb, climb])
    begin(world, first, position=apart)
    assert not world.state.touching.any()


# --- the tasks ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("vehicle", "fastest"), [(None, 0.5), ("crazyflie2", 0.02)])
@pytest.mark.parametrize("env_id", [FORMATION, CROSSING])
def test_whole_episodes_agree_with_mujoco_until_a_touch(
    env_id: str, vehicle: str | None, fastest: float
) -> None:
    """From the same seeds, all straight to their goals: in Crossing they meet in the middle.

    Observations within a float32's rounding, rewards 1e-9; the end is that spheres overlap.
    """
    options: Any = {"drones": 4, "vehicle": vehicle, "autoreset_mode": "Disabled"}
    theirs = LocalVectorEnv(env_id, 8, radio_loss=0.2, **options)
    ours = LocalVectorEnv(env_id, 8, radio_loss=0.2, backend="rigid", dtype="float64", **options)
    first, _ = ours.reset(seed=5)
    seen, _ = theirs.reset(seed=5)
    assert_array_equal(first, seen)
    met = False
    flown = 0
    for _ in range(500):
        actions = np.zeros((8, 4), np.float32)
        actions[:, :3] = np.clip(seen[:, :3], -fastest, fastest)
        for env in (ours, theirs):
            env.advance(actions)
        met = bool(ours.terminated.any())
        if met:
            break
        flown += 1
        seen = theirs.observations
        assert_array_equal(ours.truncated, theirs.truncated)
        assert_allclose(ours.observations, seen, atol=1e-6, rtol=1e-6)
        assert_allclose(ours.rewards, theirs.rewards, atol=1e-9, rtol=0)
        if ours.done.any():
            break
    assert flown > 30
    if env_id == CROSSING:
        assert met
    if met:
        room = ours.loop.metrics["clearance"]
        assert (ours.terminated == (room < 0)).all()
        found = theirs.loop.metrics["clearance"]
        assert found == pytest.approx(room, abs=1e-6)
        assert not theirs.terminated.any()


def test_one_that_touches_leaves_and_the_others_fly_on() -> None:
    env = LocalParallelEnv(CROSSING, 4, vehicle="crazyflie2", backend="rigid")
    observations, _ = env.reset(seed=5)  # two that are opposite start at nearly one height
    left: list[str] = []
    while len(left) < 2:
        actions = {name: np.zeros(4, np.float32) for name in env.agents}
        for name in ("drone_0", "drone_2"):
            way = observations[name][:3]
            actions[name][:3] = np.clip(way, -0.1, 0.1)
        observations, _, terminated, _, _ = env.step(actions)
        left += [name for name, ends in terminated.items() if ends]
    assert left == ["drone_0", "drone_2"]
    assert env.agents == ["drone_1", "drone_3"]
    env.close()
