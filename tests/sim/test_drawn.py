"""Drawn craft: what is drawn, that a pool flies each as it flies alone, and the level wrench."""

from typing import Any

import numpy as np
import pytest
from rotorgram.envs import LocalVectorEnv
from rotorgram.models import InputError, Vehicle
from rotorgram.models.drawn import columns, drawn_craft, table_of
from rotorgram.models.fleet import Pool, load_vehicles
from rotorgram.models.library import vehicle_names
from rotorgram.sim.control.gains import Gains

HOVER = "rotorgram/Hover-v0"
FREE: dict[str, Any] = {"action": "wrench", "backend": "rigid", "flight_band": 50.0}
HIGH = (0.0, 0.0, 100.0)
WRENCHES = np.random.default_rng(3).uniform(-0.2, 0.2, (25, 1, 4)).astype(np.float32)
"""Some of which a weak craft cannot give."""


def flown(
    vehicle: str, envs: int, steps: int = 25, compiled: bool | None = None, **options: Any
) -> Any:
    """An env and the positions of a flight under wrenches that many craft cannot give."""
    given = {**FREE, "goal": HIGH, "dtype": "float64", **options}
    env = LocalVectorEnv(
        HOVER, envs, autoreset_mode="Disabled", vehicle=vehicle, compiled=compiled, **given
    )
    env.reset(seed=[5] * envs if envs == 1 else list(range(envs)))
    places = []
    for wrench in WRENCHES[:steps]:
        env.advance(np.repeat(wrench, envs, axis=0))
        places.append(env.loop.world.state.position[:, 0].copy())
    return env, np.array(places)


def test_draws_fill_their_ranges_and_a_number_stands_for_one_craft() -> None:
    craft = drawn_craft(range(3000))
    mass = np.log(craft.mass)
    arm = np.hypot(craft.x, craft.y).max(axis=1)
    for values, low, high in (
        (mass, np.log(0.02), np.log(20.0)),
        (craft.thrust_to_weight, 1.5, 6.0),
        (np.log(craft.reaction / arm), np.log(0.03), np.log(0.16)),
        (craft.center / arm, -0.3, 0.3),
    ):
        assert low <= values.min() < low + 0.01 * (high - low)
        assert high >= values.max() > high - 0.01 * (high - low)
        assert np.median(values) == pytest.approx((low + high) / 2, abs=0.05 * (high - low))
    assert craft.lag.min() == 1e-4
    assert 0.099 < craft.lag.max() <= 0.1
    assert np.mean(craft.lag == 1e-4) == pytest.approx(0.2, abs=0.03)
    assert np.mean(abs(craft.turn).sum(axis=1) == 6) == pytest.approx(0.4, abs=0.03)
    inertia = craft.inertia
    assert (inertia.sum(axis=1, keepdims=True) > 2 * inertia).all()  # a body that can be
    later = drawn_craft(range(7, 9))
    for ours, theirs in zip(craft, later, strict=True):
        np.testing.assert_array_equal(ours[7:9], theirs)


def test_every_craft_of_the_library_is_within_the_ranges() -> None:
    """But for the thrust of the Hummingbird, ten times its weight."""
    for name in vehicle_names():
        vehicle = Vehicle.load(name)
        weight = vehicle.mass * vehicle.gravity
        assert 0.02 <= vehicle.mass <= 20.0, name
        strength = vehicle.allocation[0] @ vehicle.thrust_high / weight
        assert 1.5 <= strength <= (11.0 if name == "hummingbird" else 6.0), name
        typical = 0.22 * vehicle.mass**0.42
        arm = max(np.hypot(*rotor.position[:2]) for rotor in vehicle.rotors)
        assert 0.7 < arm / typical < 1.9, name
        about = np.sqrt(vehicle.inertia[0, 0] * vehicle.inertia[1, 1])
        assert 0.16 < about / (vehicle.mass * arm * typical) < 0.5, name


def test_a_drawn_craft_is_a_file_like_any_other() -> None:
    """Its mixing, of which a pool has the closed form, is that of its file."""
    table = table_of(drawn_craft(range(40)))
    for number in range(40):
        vehicle = Vehicle.load(f"drawn:{number}")
        gains = Gains.of(vehicle, 0.02)
        row = columns(table[number])
        count = vehicle.num_rotors
        mix = row["mix"].reshape(-1, 3)
        np.testing.assert_allclose(mix[:count], gains.mix, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(row["share"], [*gains.share, 0.0, 0.0][:6])
        assert row["highest"][0] * vehicle.mass == pytest.approx(gains.highest, rel=1e-6)
        assert vehicle.coefficients["rotors.time_constant"] == row["lag"][0]


IMU = {f"{what}_{kind}": 1e-9 for what in ("gyro", "accelerometer") for kind in ("noise", "walk")}
ESTIMATE: dict[str, Any] = {
    "imu": {**IMU, "gyro_bias": 0.0, "accelerometer_bias": 0.0},
    "motion_capture": {"noise": 1e-9, "angle_noise": 1e-9},
    "estimate": True,
    "observe": "estimate",
}


@pytest.mark.parametrize(
    "flight",
    [{}, {"effects": {"motor_lag": True}}, {"effects": {"motor_lag": True}, "sensors": ESTIMATE}],
    ids=["ideal", "lag", "estimate"],
)
def test_a_pool_flies_each_craft_as_it_flies_alone(flight: dict[str, Any]) -> None:
    """Other worlds have other craft, and a craft of 1 kg flies like its own file's."""
    env, together = flown("drawn:0-99", 6, **flight)
    rows = table_of(drawn_craft(range(100)))
    found = [
        int(np.flatnonzero((rows == row).all(axis=1))[0])
        for row in env.loop.world.state.craft[:, 0]
    ]
    assert len(set(found)) > 3
    seen = env.observations
    for world, number in enumerate(found):
        given = {**FREE, "goal": HIGH, "dtype": "float64", **flight}
        alone = LocalVectorEnv(
            HOVER, 1, autoreset_mode="Disabled", vehicle=f"drawn:{number}", **given
        )
        alone.reset(seed=[world])
        for step, wrench in enumerate(WRENCHES):
            alone.advance(wrench)
            place = alone.loop.world.state.position[0, 0]
            np.testing.assert_allclose(together[step, world], place, rtol=0, atol=1e-6)
        np.testing.assert_allclose(seen[world], alone.observations[0], rtol=0, atol=1e-5)


def test_a_policy_is_told_what_the_craft_can_give() -> None:
    """The paper's: 20 m/s² of lift, in actions; 196 N, half of 400, about hover give the rest, as
    `test_gains_of_the_papers_craft` has it: 38.9993 and 0.97984 rad/s². No lag.
    """
    env, _ = flown("paper", 1, steps=1)
    lift = (400 - 196) / 20 / 20
    told = (lift, 38.9993 / 150, 38.9993 / 150, 0.97984 / 30, 0.0)
    np.testing.assert_allclose(env.observations[0, -5:], told, rtol=1e-4)


def test_compiled_pools_and_numpy_s_have_the_same_bits() -> None:
    for dtype in ("float32", "float64"):
        kinds = [
            flown("drawn:0-99", 5, effects={"motor_lag": True}, compiled=compiled, dtype=dtype)[1]
            for compiled in (False, None)
        ]
        np.testing.assert_array_equal(*kinds)


def test_each_episode_draws_another_craft_and_a_snapshot_keeps_it() -> None:
    env, _ = flown("drawn:0-99", 4, compiled=False)
    world = env.loop.world
    first = world.state.craft.copy()
    kept = world.snapshot()
    env.reset()
    assert (world.state.craft != first).any(axis=2).any()
    world.restore(kept)
    np.testing.assert_array_equal(world.state.craft, first)
    before = world.acceleration()
    env.reset(seed=[0, 1, 2, 3])
    np.testing.assert_array_equal(world.state.craft, first)
    world.restore(kept)
    np.testing.assert_array_equal(world.acceleration(), before)


@pytest.mark.parametrize("vehicle", ["hummingbird", "heavy_hexa", "drawn:0-99"])
def test_a_wrench_is_an_acceleration_whatever_the_craft(vehicle: str) -> None:
    """A small one, which every craft gives, and the observation tells what was applied."""
    env, _ = flown(vehicle, 3, steps=1, start_tilt=0.0, start_heading=0.0)
    env.reset(seed=[0, 1, 2])
    wrench = np.tile(np.float32((0.05, 0.02, -0.01, 0.01)), (3, 1))
    env.advance(wrench)
    world = env.loop.world
    np.testing.assert_allclose(env.observations[:, -9:-5], wrench, atol=2e-6)
    turned = wrench[:, 1:] * (150.0, 150.0, 30.0) * 0.02
    np.testing.assert_allclose(world.state.body_rates[:, 0], turned, rtol=0.02, atol=1e-3)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"action": "rotors"}, "action: expected wrench with craft of drawn:0-2047, got rotors"),
        (
            {"backend": "mujoco"},
            "expected one with the backend mujoco, as drawn:7, got a pool of craft, drawn:0-",
        ),
        ({"vehicle": "drawn:9-1"}, "expected drawn, drawn:NUMBER or drawn:FIRST-LAST with at most"),
        ({"vehicle": "drawn:0-5000"}, "at most 4096 craft"),
        ({"vehicle": "drawn:x"}, "expected drawn, drawn:NUMBER"),
        ({"effects": {"body_drag": True}}, "body_drag"),
    ],
    ids=str,
)
def test_what_a_pool_cannot_have_is_refused(options: dict[str, Any], sentence: str) -> None:
    given = {**FREE, "vehicle": "drawn", **options}
    with pytest.raises(InputError, match=sentence):
        LocalVectorEnv(HOVER, 2, autoreset_mode="Disabled", **given)


def test_a_pool_stands_alone() -> None:
    with pytest.raises(InputError, match="expected no others besides drawn craft, got"):
        load_vehicles("hummingbird,drawn", 2)
    with pytest.raises(InputError, match="expected one craft, as drawn:3, got drawn:3-4"):
        Vehicle.load("drawn:3-4")
    flown("drawn:3-4", 2, steps=1)  # four rotors both
    pool = load_vehicles("drawn:3-4", 2)
    assert isinstance(pool, Pool)
    assert pool.numbers == range(3, 5)
    assert load_vehicles("drawn:3-4", 1).hash == pool.hash != load_vehicles("drawn:3-5", 1).hash
