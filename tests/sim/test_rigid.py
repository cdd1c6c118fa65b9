"""The backend rigid: MuJoCo's flights without contact, and the tasks on it."""

import copy
import re
import sys
from pathlib import Path
from typing import Any

import contracts
import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rotorgram.envs import LocalVectorEnv, Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.models import QUAD_XML, Vehicle
from rotorgram.models.errors import InputError
from rotorgram.sim import PhysicsError, Randomization, make_world
from rotorgram.sim import world as sim_world
from rotorgram.sim.compile import llvm
from tables import SIM
from worlds import begin

ELEVATION = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
DATA = Path(__file__).parents[1] / "data"
FILES: dict[str, Any] = contracts.FILES | {"lively": DATA / "lively.toml"}
del FILES["small"]  # in a fluid
RACER = DATA / "racer.xml"
HEXA = DATA / "hexa.xml"
N = 4
EVERY = np.ones((N, 1), bool)


def arrays(vehicle: Vehicle, num_worlds: int = N, dtype: str = "float64", **rest: Any) -> Any:
    return make_world(vehicle, num_worlds, "rigid", dtype=dtype, **rest)


def attitudes(dice: np.random.Generator, count: int) -> np.ndarray:
    turned = dice.normal(size=(count, 1, 4))
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)


def tumbling(dice: np.random.Generator, count: int = N) -> dict[str, np.ndarray]:
    """Starts high up, at any attitude."""
    shape = (count, 1, 3)
    turned = attitudes(dice, count)
    return {
        "position": dice.uniform(1000.0, 1001.0, shape),
        "quaternion": turned,
        "velocity": dice.normal(size=shape),
        "body_rates": dice.normal(size=shape),
    }


def angle(ours: Any, theirs: np.ndarray) -> float:
    """Largest angle between attitudes, rad."""
    q = np.asarray(ours, np.float64)
    difference = abs(q - theirs).max(axis=-1)
    total = abs(q + theirs).max(axis=-1)
    apart = np.minimum(difference, total)
    return 4 * float(apart.max())


# --- the motion -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "drag"), [*((name, 0.0) for name in FILES), ("paper", 0.3), ("hexa", 0.3)]
)
def test_flies_as_mujoco_for_five_seconds(name: str, drag: float) -> None:
    """1e-6 m and 1e-6 rad, from any attitude, tumbling, at random thrusts; measured: 1e-9."""
    vehicle = Vehicle.load(FILES[name], linear_drag=drag)
    dice = np.random.default_rng(0)
    pose = tumbling(dice)
    ours = arrays(vehicle)
    theirs = make_world(vehicle, N, num_threads=1)
    substeps = vehicle.substeps(0.02)
    for world in (ours, theirs):
        begin(world, **pose)
    for _ in range(250):
        share = dice.uniform(0.9, 1.1, (N, 1, vehicle.num_rotors))
        thrust = vehicle.hover_thrust * share
        for world in (ours, theirs):
            world.step(thrust, substeps)
    assert not theirs.state.touching.any()
    assert abs(theirs.state.velocity).max() > 3
    expected = theirs.state.position
    assert_allclose(ours.state.position, expected, atol=1e-6, rtol=0)
    found = angle(ours.state.quaternion, theirs.state.quaternion)
    assert found < 1e-6
    assert_allclose(ours.acceleration(), theirs.acceleration(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", FILES)
def test_compiled_and_numpy_fly_the_same_bits(name: str, dtype: str) -> None:
    vehicle = Vehicle.load(FILES[name], linear_drag=0.2)
    drawn = {"mass": "uniform(0.8, 1.2)", "center_x": "uniform(0, 0.01)"}
    mass = Randomization(drawn, None)
    compiled = arrays(vehicle, dtype=dtype, randomize=mass, compiled=True)
    plain = arrays(vehicle, dtype=dtype, randomize=mass, compiled=False)
    dice = np.random.default_rng(0)
    pose = tumbling(dice)
    for world in (compiled, plain):
        world.random.seed(EVERY, range(N))
        begin(world, **pose)
    for _ in range(20):
        share = dice.uniform(0.5, 1.5, (N, 1, vehicle.num_rotors))
        thrust = vehicle.hover_thrust * share
        for world in (compiled, plain):
            world.step(thrust, 2)
    for name in ("position", "quaternion", "velocity", "body_rates"):
        found = getattr(compiled.state, name)
        expected = getattr(plain.state, name)
        assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize(("share", "most"), [(1.0, "1e6"), (5e-8, "100"), (5e-8, "1e6")])
def test_strong_rotors_and_a_light_craft_fly(share: float, most: str, tmp_path: Path) -> None:
    """20 kg and 1e-6 kg: two control steps at hover, at rest."""

    def lighter(found: re.Match[str]) -> str:
        mass = float(found[1]) * share
        return f'mass="{mass}"'

    text = QUAD_XML.read_text(encoding="utf-8")
    text = text.replace('"0 100"', f'"0 {most}"')
    text = re.sub(r'mass="([0-9.]+)"', lighter, text)
    file = tmp_path / "extreme.xml"
    file.write_text(text, encoding="utf-8")
    vehicle = Vehicle.load(file)
    world = arrays(vehicle, 1)
    begin(world, position=(9.0, 9.0, 9.0))
    thrust = np.tile(vehicle.hover_thrust, (1, 1, 1))
    world.step(thrust, 4)
    expected = np.full((1, 1, 3), 9.0)
    assert world.state.position == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_compiled_a_fast_spin_is_exact(dtype: str) -> None:
    """Three and a half turns in a control step of two physics steps: half a turn about z."""
    world = arrays(Vehicle.load(), 1, dtype)
    spin = 7 * np.pi / 0.02
    begin(world, position=(5.0, 5.0, 5.0), body_rates=(0.0, 0.0, spin))
    world.step(np.zeros((1, 1, 4)), 2)
    near = 1e-5 if dtype == "float32" else 1e-12
    w, x, y, z = world.state.quaternion[0, 0].tolist()
    expected = [0.0, 0.0, 0.0, 1.0]
    assert [w, x, y, abs(z)] == pytest.approx(expected, abs=near)


def test_arrays_have_the_same_bits_alone_and_in_a_batch() -> None:
    vehicle = Vehicle.load(FILES["hexa"])
    dice = np.random.default_rng(0)
    many = 19  # no multiple of what a processor computes at once
    pose = tumbling(dice, many)
    thrust = vehicle.hover_thrust * dice.uniform(0.9, 1.1, (many, 1, 6))
    batch = arrays(vehicle, many, "float32")
    begin(batch, **pose)
    batch.step(thrust, 2)
    for i in (0, 18):
        alone = arrays(vehicle, 1, "float32")
        own = {name: values[i : i + 1] for name, values in pose.items()}
        begin(alone, **own)
        alone.step(thrust[i : i + 1], 2)
        for name in ("position", "quaternion", "velocity", "body_rates"):
            one = getattr(alone.state, name)
            all_ = getattr(batch.state, name)
            found = one[0].tobytes()
            assert found == all_[i].tobytes()


def test_without_llvmlite_numpy_flies(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    request: pytest.FixtureRequest,
) -> None:
    vehicle = Vehicle.load(linear_drag=0.123)
    monkeypatch.setitem(sys.modules, "llvmlite", None)
    for function in (llvm._llvm, sim_world.tell_once):
        function.cache_clear()
        request.addfinalizer(function.cache_clear)
    with pytest.raises(
        InputError, match=r"^compiled: expected false where nothing compiles \(.*llvmlite"
    ):
        arrays(vehicle, compiled=True)
    arrays(vehicle)
    world = arrays(vehicle)
    begin(world, position=(9.0, 9.0, 9.0), velocity=(1.0, 1.0, 1.0))
    world.step(np.zeros((N, 1, 4)), 1)
    # v' = -0.123 v - (0, 0, g) over 0.01 s, solved.
    left = np.exp(-0.123 * 0.01)
    fallen = 9.8 / 0.123 * (1 - left)
    expected = (left, left, left - fallen)
    found = world.state.velocity[0, 0]
    assert_allclose(found, expected, rtol=1e-9)
    (told,) = caplog.messages  # once, for two worlds
    assert told.startswith("NumPy flies, which is slower: import of llvmlite")


def test_a_free_fall_is_exact() -> None:
    vehicle = Vehicle.load(linear_drag=0.0)
    world = arrays(vehicle, 1, "float32")
    begin(world, position=(10.0, 10.0, 10.0), velocity=(1.0, 2.0, 3.0))
    world.step(np.zeros((1, 1, 4)), 100)  # 1 s
    expected = (11.0, 12.0, 13.0 - 9.8 / 2)
    found = world.state.position[0, 0]
    assert_allclose(found, expected, atol=1e-4, rtol=0)
    expected = (1.0, 2.0, 3.0 - 9.8)
    assert_allclose(world.state.velocity[0, 0], expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("file", "effects"),
    [(RACER, SIM["rigid"]["effects"]), (HEXA, {"linear_drag": 0.2})],
    ids=["racer, all effects", "welded bodies"],
)
def test_effects_and_drawn_parameters(file: Path, effects: dict[str, Any]) -> None:
    """With float64 a seed draws what it draws on mujoco, gusts among it."""
    drawn = dict(SIM["rigid"]["drawn"])
    if file == HEXA:  # two bodies
        del drawn["inertia"]
    options = {"vehicle": file, "effects": effects, "randomize": drawn}
    options |= {"flight_band": 10.0, "goal": (0, 0, 60)}
    rigid = EnvConfig.from_keywords(HOVER, backend="rigid", dtype="float64", **options)
    ours = Loop(rigid, N)
    theirs = Loop(EnvConfig.from_keywords(HOVER, **options), N)
    still = np.zeros((N, ours.vehicle.num_rotors), np.float32)
    for loop in (ours, theirs):
        loop.advance(still, EVERY[:, 0], range(7, 7 + N))
    for name, values in theirs.world.parameters.items():
        found = ours.world.parameters[name].tolist()
        assert found == values.tolist()
    dice = np.random.default_rng(1)
    frozen = np.array([False, True, False, False])
    for step in range(20):
        actions = dice.uniform(-0.1, 0.1, still.shape).astype(np.float32)
        for loop in (ours, theirs):
            mask = frozen if step == 3 else None
            loop.advance(actions, frozen=mask)
        for name in ("position", "velocity", "body_rates", "quaternion", "thrust"):
            found = getattr(ours.world.state, name)
            expected = getattr(theirs.world.state, name)
            assert_allclose(found, expected, atol=1e-9, rtol=0)


def test_acceleration_and_below() -> None:
    world = arrays(Vehicle.load(), 3)
    half = np.sqrt(0.5)
    turned = np.zeros((3, 1, 4))
    turned[0, 0, 0] = 1.0
    turned[1, 0, :2] = half
    turned[2, 0, ::2] = np.cos(0.5), np.sin(0.5)
    begin(world, position=(2.0, 2.0, 2.0), quaternion=turned)
    # At hover thrust: level it stays, on its side it falls and is pushed along -y.
    expected = [[0.0, 0.0, 0.0], [0.0, -9.8, -9.8]]
    acceleration = world.acceleration()[:2, 0]
    assert_allclose(acceleration, expected, atol=1e-12, rtol=0)
    found = world.below()[:, 0]
    assert found == pytest.approx([2.0, np.inf, 2.0 / np.cos(1.0)])


@pytest.mark.parametrize("file", FILES.values(), ids=FILES)
def test_touches_the_ground_where_mujoco_does(file: Path) -> None:
    """Attitudes at random, just above and below the contact."""
    vehicle = Vehicle.load(file)
    dice = np.random.default_rng(3)
    count = 24
    turned = attitudes(dice, count)
    turned[0] = (1.0, 0.0, 0.0, 0.0)
    ours = arrays(vehicle, count)
    theirs = make_world(vehicle, count, num_threads=1)
    place = np.zeros((count, 1, 3))
    low = np.zeros(count)
    high = np.full(count, float(vehicle.model.stat.extent) * 2)
    for _ in range(40):
        middle = (low + high) / 2
        place[:, 0, 2] = middle
        begin(theirs, position=place, quaternion=turned)
        touching = theirs.state.touching[:, 0]
        low = np.where(touching, middle, low)
        high = np.where(touching, high, middle)
    small = 1e-4 * vehicle.rest_height
    for offset in (small, -small):
        place[:, 0, 2] = high + offset
        begin(ours, position=place, quaternion=turned)
        begin(theirs, position=place, quaternion=turned)
        found = ours.state.touching.tolist()
        assert found == theirs.state.touching.tolist()
        assert bool(ours.state.touching[0]) == (offset < 0)


# --- the tasks ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "size"), [(ELEVATION, 1.0), (HOVER, 0.3)])
@pytest.mark.parametrize("file", [None, HEXA, "crazyflie_brushless"])
def test_whole_episodes_agree_with_mujoco(env_id: str, size: float, file: Any) -> None:
    """From the same seeds: observations within a float32's rounding, rewards 1e-9, ends alike."""
    options = {"vehicle": file, "autoreset_mode": "Disabled"}
    theirs = LocalVectorEnv(env_id, N, **options)
    ours = LocalVectorEnv(env_id, N, backend="rigid", dtype="float64", **options)
    first = ours.reset(seed=5)[0]
    expected = theirs.reset(seed=5)[0]
    assert_array_equal(first, expected)
    dice = np.random.default_rng(2)
    shape = theirs.action_space.shape
    alive = np.ones(N, bool)
    for _ in range(250):
        actions = dice.uniform(-size, size, shape).astype(np.float32)
        for env in (ours, theirs):
            env.advance(actions, None, None, ~alive)
        assert_array_equal(ours.terminated, theirs.terminated)
        assert_array_equal(ours.truncated, theirs.truncated)
        assert_allclose(ours.observations, theirs.observations, atol=1e-6, rtol=1e-6)
        assert_allclose(ours.rewards, theirs.rewards, atol=1e-9, rtol=0)
        alive = ~theirs.done
        if not alive.any():
            break
    assert theirs.terminated.any() or theirs.truncated.any()


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"effects": {"payload": 0.1}}, "effects.payload: expected none with the backend rigid"),
        ({"dtype": "float16"}, "dtype: expected 'float32' or 'float64', or none, got 'float16'"),
        ({"compiled": 1}, "compiled: expected true or false, or none, got 1"),
        ({"num_threads": 2}, "num_threads: expected none with the backend rigid, got 2"),
        (
            {"vehicle": str(HEXA), "randomize": {"inertia": 1.1}},
            "randomize: inertia: expected a craft of one body with the backend rigid, got hexa",
        ),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], expected: str) -> None:
    options = {"backend": "rigid", **arguments}
    with pytest.raises(InputError, match=f"^{expected}"):
        LocalVectorEnv(HOVER, 2, **options)


def test_what_mujoco_moves_in_another_way_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "other.xml"

    def racer(options: str) -> Any:
        text = RACER.read_text()
        file.write_text(text.replace('integrator="RK4"', options))
        vehicle = Vehicle.load(file)
        return arrays(vehicle)

    racer('integrator="RK4" wind="3 0 0"')  # without a fluid it does nothing
    for options in ('integrator="Euler"', 'integrator="RK4" density="1.2"'):
        with pytest.raises(InputError, match=r"vehicle: expected RK4, .* others in racer"):
            racer(options)


def test_obstacles_of_a_file_are_solid_or_refused_by_name(tmp_path: Path) -> None:
    file = tmp_path / "wood.xml"
    text = RACER.read_text()
    tree = '<geom name="tree" type="cylinder" size="0.1 2" pos="1 0 2"/></worldbody>'
    wood = text.replace("</worldbody>", tree, 1)
    file.write_text(wood)
    vehicle = Vehicle.load(file)
    for world in (make_world(vehicle, 1), arrays(vehicle, 1)):
        begin(world, position=(0.5, 0.0, 2.0))
        assert not world.state.touching.any()
        begin(world, position=(0.9, 0.0, 2.0))
        assert world.state.touching.all()
    rough = 'type="mesh" mesh="hill" pos="9 0 0"/></worldbody>'
    corners = '<mesh name="hill" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>'
    hill = f"<asset>{corners}</asset><worldbody>"
    file.write_text(wood.replace("<worldbody>", hill, 1).replace(tree[6:], 'name="rock" ' + rough))
    with pytest.raises(
        InputError, match=r"^scene: expected no mesh .* the backend rigid: .* got rock$"
    ):
        arrays(Vehicle.load(file))
    seen = tree.replace("/>", ' contype="0" conaffinity="0"/>')  # which nothing touches
    wood = text.replace("</worldbody>", seen, 1)
    file.write_text(wood)
    vehicle = Vehicle.load(file)
    arrays(vehicle)


def test_a_bad_state_raises_and_a_reset_mends_it() -> None:
    config = EnvConfig.from_keywords(ELEVATION, backend="rigid")
    loop = Loop(config, 2)
    every = np.ones(2, bool)
    still = np.zeros((2, 1))
    loop.advance(still, every, [0, 1])
    velocity = np.zeros((2, 1, 3))
    velocity[1] = 1e30
    begin(loop.world, position=(9.0, 9.0, 9.0), velocity=velocity)
    with pytest.raises(PhysicsError, match=r"bad states in envs \[1\]: reset the env"):
        loop.advance(still)
    with pytest.raises(gym.error.ResetNeeded):
        loop.advance(still)
    loop.advance(still, every, [0, 1])
    loop.advance(still)
    observations = loop.observations["observation"]
    found = abs(observations[:, 1:]).max()
    assert found < 1e-6


def test_a_world_is_not_copied() -> None:
    with pytest.raises(TypeError, match="cannot be copied"):
        copy.copy(make_world(Vehicle.load(), 2, "rigid"))
