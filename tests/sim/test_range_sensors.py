"""Sensors with rays on a craft: where they look, when, and what is refused."""

from typing import Any

import numpy as np
import pytest
from rotorgram.envs import Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.models import InputError
from rotorgram.models.coefficients import RANGE_MODELS as MODELS
from rotorgram.scenes import Layouts, Rays, Solids
from rotorgram.scenes.returns import RANGES

WOOD = "forest:3,density=0.1,size=34x16,clear=ends"
EXACT: dict[str, Any] = {"growth": 0.0, "edge_dropout": 0.0, "near": 0.01}


def loop_with(sensors: dict[str, Any], worlds: int = 3, **options: Any) -> Loop:
    """A hover in a wood, whose episodes have begun."""
    config = EnvConfig.from_keywords(
        "rotorgram/Hover-v0", vehicle="crazyflie2", backend="rigid", compiled=False, scene=WOOD,
        sensors=sensors, start_band=1.0, flight_band=20.0, goal=(-15.0, 0.0, 3.0), **options,
    )  # fmt: skip
    loop = Loop(config, worlds)
    step(loop, np.ones(worlds, bool), list(range(worlds)))
    return loop


def step(loop: Loop, resets: Any = None, seeds: Any = None) -> None:
    actions = np.zeros((loop.num_envs, 4), np.float32)
    actions[:, 0] = 0.02
    loop.advance(actions, resets, seeds)


def cast(loop: Loop, rays: Rays, mount: Any = (0.0, 0.0, 0.0)) -> Any:
    state = loop.record.state
    layouts = Layouts.of(Solids.ground() + Solids.of_scene(WOOD).standing())
    place = state.position[:, 0] + np.array(
        [turned(q, mount) for q in state.quaternion[:, 0].astype(float)]
    )
    return rays.cast(layouts, place, state.quaternion[:, 0])


def turned(q: Any, vector: Any) -> Any:
    w, x, y, z = q
    matrix = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    return matrix @ vector


def test_depth_is_measured_along_the_axis_and_lidar_along_the_rays() -> None:
    lidar = {"model": "os0", "rows": 4, "columns": 16, "noise": 0.0, "near": 0.01}
    loop = loop_with({"depth": {"rows": 6, "columns": 8, **EXACT}, "lidar": lidar})
    camera = Rays.pinhole(6, 8, 87.0, reach=30.0)
    along = cast(loop, camera) * camera.directions[..., 0]
    seen = loop.observations["depth"]
    assert seen.dtype == np.float32
    assert seen == pytest.approx(np.minimum(along, 10.0), abs=1e-4)
    assert (seen < 10.0).any()
    rings = cast(loop, Rays.rings(4, 16, -45.0, 45.0, reach=35.0))
    assert loop.observations["lidar"] == pytest.approx(rings, abs=1e-4)
    assert loop.spec.observation[1].frame == "body, along the axis of the sensor"


def test_a_mount_moves_and_turns_a_sensor() -> None:
    mount = {"position": [0.3, -0.2, 0.1], "pitch": -90.0}
    loop = loop_with({"tof": {"model": "multiranger", "noise": 0.0, "share": 0.0, **mount}})
    # Pitched down, its front is the body's down, and its top is the body's front.
    down, up, left, right, front = loop.observations["tof"][:, 0].T
    rays = Rays([[(0, 0, -1), (0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0)]], reach=4.0)
    expected = cast(loop, rays, (0.3, -0.2, 0.1))[:, 0]
    got = np.column_stack((down, up, left, right, front))
    assert got == pytest.approx(expected, abs=1e-4)


def test_a_rate_and_a_delay_hold_readings_back() -> None:
    """At 10 Hz and 0.04 s late, with steps of 0.02 s."""
    sensors = {"rows": 3, "columns": 4, "rate": 10.0, "delay": 0.04, **EXACT}
    loop = loop_with({"depth": sensors}, 1)
    fresh = [loop_with({"depth": {**sensors, "rate": 50.0, "delay": 0.0}}, 1)]
    exact = [fresh[0].observations["depth"].copy()]
    late = [loop.observations["depth"].copy()]
    for _ in range(12):
        step(loop)
        step(fresh[0])
        late.append(loop.observations["depth"].copy())
        exact.append(fresh[0].observations["depth"].copy())
    for now in range(13):
        taken = max(0, (now - 2) // 5 * 5)
        assert (late[now] == exact[taken]).all(), now
    assert (exact[10] != exact[5]).any()


def test_each_ray_and_step_has_noise_of_its_own() -> None:
    noisy = {"model": "rplidar_a1", "columns": 64, "dropout": 0.1}
    loop = loop_with({"lidar": noisy}, 2)
    quiet = loop_with({"lidar": {**noisy, "share": 0.0, "dropout": 0.0}}, 2)
    errors = []
    lost = []
    for _ in range(20):
        step(loop)
        step(quiet)
        seen, exact = loop.observations["lidar"], quiet.observations["lidar"]
        known = (seen < 12.0) & (exact < 11.0)
        errors.append(np.where(known, seen / exact - 1.0, np.nan))
        lost.append(seen[exact < 11.0] == 12.0)
    assert np.concatenate(lost).mean() == pytest.approx(0.1, abs=0.05)
    flat = np.array(errors)
    assert np.nanstd(flat) == pytest.approx(0.01, rel=0.1)
    assert not (flat[3] == flat[8]).any()  # at 10 Hz
    assert not (flat[:, 0] == flat[:, 1]).any()


def test_a_sensor_is_as_fast_as_its_data_sheet_says() -> None:
    loop = loop_with({"lidar": {"noise": 0.0}, "depth": {"rows": 2, "columns": 3, **EXACT}}, 1)
    kept = {name: [] for name in ("lidar", "depth")}
    for _ in range(11):
        for name, rows in kept.items():
            rows.append(loop.observations[name].tobytes())
        step(loop)
    assert len(set(kept["lidar"])) == 3  # 10 Hz
    assert len(set(kept["depth"])) == 11


def test_observations_are_copies() -> None:
    loop = loop_with({"depth": {"rows": 2, "columns": 3, "rate": 5.0}}, 1)
    before = loop.observations["depth"].copy()
    loop.observations["depth"][:] = -7.0
    step(loop)
    assert (loop.observations["depth"] == before).all()


def test_every_model_says_where_its_numbers_come_from() -> None:
    assert set(MODELS) == set(RANGES)
    for models in MODELS.values():
        for model in models.values():
            assert len(model["source"]) > 30
            assert 0 < model["near"] < model["reach"]


@pytest.mark.parametrize(
    ("sensors", "sentence"),
    [
        ({"depth": {"model": "d999"}}, "sensors.depth.model: expected 'd435', got 'd999'"),
        ({"depth": {"rows": 0}}, "sensors.depth.rows: expected a whole number from 1 to"),
        ({"depth": {"low": 3.0}}, "sensors.depth: expected some of model, rows, .*, got 'low'"),
        ({"depth": {"near": 10.0}}, "sensors.depth.reach: expected more than near = 10 m, got 10"),
        ({"lidar": {"rate": 7.0}}, "sensors.lidar.rate: expected the control rate of 50 Hz over"),
        (
            {"lidar": {"rate": 50.0}},
            "sensors.lidar.rate: expected at most 10 Hz of a mid360, got 50",
        ),
        ({"lidar": {"low": 9.0, "high": 3.0}}, "sensors.lidar: expected low <= high, got 9 and 3"),
        ({"tof": {"delay": 0.03}}, "sensors.tof.delay: expected a whole number of control"),
        (
            {"depth": {"fov": 170.0, "reach": 1000.0}},
            "sensors.depth: its longest ray: expected a number from 0 to 10000 m, got 1",
        ),
        ({"tof": 3}, "sensors.tof: expected true, or settings by name, got 3"),
    ],
)
def test_wrong_settings(sensors: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        loop_with(sensors)
