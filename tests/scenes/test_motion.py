"""Solids that move: where they are, who meets them, and who sees them."""

import math
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from capture import lens_of
from rotorgram.envs import Loop
from rotorgram.envs.compiled import CompiledLoop, make_loop
from rotorgram.envs.config import EnvConfig
from rotorgram.models.cameras import chosen_views
from rotorgram.models.errors import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering.cameras import Cameras
from rotorgram.scenes import (
    SCENES,
    Draft,
    Layouts,
    Rays,
    SceneConfig,
    SceneType,
    Solids,
    register,
)
from rotorgram.scenes.motion import REST, along_ellipse, offsets, thrown
from rotorgram.sim import make_world

PERIOD = 0.02  # s: of a control step
BACKENDS = pytest.mark.parametrize("backend", ["rigid", "mujoco"])


def test_where_solids_are() -> None:
    throw = thrown((3.0, -4.0, 5.0), 2.0)
    circle = along_ellipse((2.0, 0.0, 0.0), (0.0, 2.0, 0.0), 8.0)
    line = along_ellipse((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 4.0)
    motions = np.array([throw, circle, line, np.zeros(11)])
    half = math.sqrt(0.5)
    expected = {
        0.0: [(0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0)],
        1.0: [(0, 0, 0), (2 * half - 2, 2 * half, 0), (0, 0, -1), (0, 0, 0)],
        4.0: [(6, -8, 10 - 19.6), (-4, 0, 0), (0, 0, 0), (0, 0, 0)],
    }
    for time, places in expected.items():
        assert offsets(motions, np.array([time])) == pytest.approx(np.array(places, float))
    both = offsets(np.stack((motions, motions)), np.array([[1.0], [4.0]]))
    assert both[1] == pytest.approx(np.array(expected[4.0], float))


def test_every_ball_is_thrown_at_the_craft() -> None:
    for seed in range(20):
        solids = Solids.of_layout(SceneConfig.parse("traffic:new"), seed)
        assert solids.moves.all()
        names = np.array(solids.names)
        balls = np.array(["ball" in name for name in names])
        times = np.arange(0.0, 12.0, 0.01)
        tracks = solids.centers + offsets(np.stack([solids.motions] * len(times)), times[:, None])
        away = np.linalg.norm(tracks - (0.0, 0.0, 2.0), axis=-1)
        assert (away[:, balls].min(axis=0) < 0.7).all()
        assert (away[0, balls] > 6.0).all()
        firsts = np.sort(away[:, balls].argmin(axis=0))
        assert (np.diff(firsts) > 0).all()  # one after the other
        posts = np.hypot(tracks[:, ~balls, 0], tracks[:, ~balls, 1])
        assert (posts.min(axis=0) < 1.1).all()


def loop_in(scene: str, backend: str, worlds: int = 2, **options: Any) -> Loop:
    """Hovers 2 m above the origin, at rest."""
    keywords: dict[str, Any] = {
        "vehicle": "hummingbird", "start_band": 0.0, "goal": (0.0, 0.0, 2.0), "flight_band": 30.0,
        "control_period": PERIOD, "action": "velocity", "episode_length": 1000, "compiled": False,
    }  # fmt: skip
    config = EnvConfig.from_keywords(
        "rotorgram/Hover-v0", scene=scene, backend=backend, **keywords | options
    )
    loop = make_loop(config, worlds)
    step(loop, begins=True)
    return loop


def step(loop: Loop, *, begins: bool = False) -> None:
    count = loop.num_envs
    begun = np.full(count, begins)
    seeds = list(range(count)) if begins else None
    loop.advance(np.zeros((count, 4), np.float32), begun, seeds, loop.done & ~begun)


@BACKENDS
def test_a_craft_that_waits_is_hit_when_a_solid_arrives(backend: str) -> None:
    loop = loop_in("traffic:new", backend)
    seeds = loop.world.scenery.seeds.tolist()
    assert len(set(seeds)) == 2
    radius = loop.vehicle.radius
    hits: dict[int, int] = {}
    for number in range(1, 900):
        step(loop)
        state = loop.record.state
        for world, seed in enumerate(seeds):
            if world in hits:
                continue
            solids = Solids.of_layout(SceneConfig.parse("traffic:new"), seed).at(number * PERIOD)
            room = solids.distance(state.position[world, 0]) - radius
            clearance = loop.world.clearance()[world, 0]
            assert clearance == pytest.approx(room, abs=1e-4)
            if loop.terminated[world]:
                hits[world] = number
                assert room < (0.002 if backend == "rigid" else 0.02)
            elif backend == "rigid":
                assert room > -1e-4  # not missed
        if len(hits) == 2:
            break
    assert len(hits) == 2


def test_rays_and_pictures_see_them_where_they_are(opengl: None) -> None:
    scene = "traffic:5"
    time = 2.2
    place = np.array([[0.0, 0.0, 1.5]])
    turn = np.array([[1.0, 0.0, 0.0, 0.0]])
    vehicle = Vehicle.load("hummingbird")
    views = chosen_views(["front_depth@32x24"], vehicle.cameras)
    seen = {}
    with closing(Cameras(vehicle, views, scene=scene)) as cameras:
        for now in (0.0, time):
            state = {"position": place, "quaternion": turn, "time": np.array([now])}
            cameras.take({views[0].name: np.ones(1, bool)}, state)
            seen[now] = cameras.pictures[views[0].name][0, ..., 0].copy()
        lens = lens_of(cameras, views[0])
    assert (abs(seen[0.0] - seen[time]) > 0.5).any()
    fx, fy = lens.matrix[0, 0], lens.matrix[1, 1]
    rows, columns = np.mgrid[:24, :32] + 0.5
    x = (columns - lens.matrix[0, 2]) / fx
    y = (rows - lens.matrix[1, 2]) / fy
    rays = np.stack((x, y, np.ones_like(x)), axis=-1) @ lens.rotation
    size = np.linalg.norm(rays, axis=-1)
    origin = -lens.rotation.T @ lens.translation
    for now, picture in seen.items():
        layouts = Layouts.of(Solids.of_scene(scene).at(now))
        along = Rays(rays / size[..., None], reach=90.0).cast(layouts, origin[None], turn)[0]
        flat = along / size
        near = (picture < 30.0) & (flat < 30.0)
        assert near.sum() > 100
        assert (abs(picture - flat)[near] < 0.02 * flat[near]).mean() > 0.97  # all but edges


def test_a_batch_has_the_pictures_of_its_layouts(opengl: None) -> None:
    """Two worlds in one of two layouts each: the picture of a world that is alone in it."""
    keywords: dict[str, Any] = {"cameras": "front_depth@32x24"}
    seen = {}
    for layout in range(2):
        loop = loop_in(f"traffic:{layout}", "rigid", **keywords)
        for _ in range(40):
            step(loop)
        seen[layout] = loop.observations["front_depth"]
    assert (seen[0] != seen[1]).any()
    both = loop_in("traffic:0-1", "rigid", **keywords)
    for _ in range(40):
        step(both)
    for world, layout in enumerate(both.world.scenery.seeds.tolist()):
        assert (both.observations["front_depth"][world] == seen[layout][world]).all()


def test_a_scene_says_whether_its_solids_move() -> None:
    def draw(draft: Draft) -> None:
        draft.add("ground/floor", "plane", (9, 9, 1), (0, 0, 0), "")
        motion = thrown((1.0, 0.0, 0.0), 0.0) if draft.rng.integers(2) else REST
        draft.add("ball_0/ball", "sphere", (0.5, 0, 0), (9, 0, 1), "", motion=motion)

    craft = Vehicle.load("crazyflie2")
    scene = "balls:0-9"
    try:
        register("balls", SceneType(draw=draw))
        with pytest.raises(InputError, match="scene: expected balls to be registered with moves"):
            make_world(craft, 2, "rigid", scene=SceneConfig.parse(scene))
        register("balls", SceneType(draw=draw, moves=True))
        assert make_world(craft, 2, "rigid", scene=SceneConfig.parse(scene)).scenery.moves
    finally:
        SCENES.pop("balls")


@BACKENDS
def test_a_snapshot_brings_them_back(backend: str) -> None:
    ours = loop_in("traffic:0-5", backend, sensors={"lidar": True})
    theirs = loop_in("traffic:0-5", backend, sensors={"lidar": True})
    for _ in range(40):
        step(ours)
    theirs.restore(ours.snapshot())
    assert (ours.record.state.clearance == theirs.record.state.clearance).all()
    for _ in range(20):
        step(ours)
        step(theirs)
        assert (ours.observations["lidar"] == theirs.observations["lidar"]).all()
        assert (ours.world.clearance() == theirs.world.clearance()).all()


@BACKENDS
def test_a_touch_within_a_step_has_the_same_bits_everywhere(backend: str) -> None:
    """Balls of 0.1 m at 20 m/s are over the craft from 0.77 s to 0.8 s, and pass it in a step."""

    def draw(draft: Draft) -> None:
        draft.add("ground/floor", "plane", (9, 9, 1), (0, 0, 0), "")
        x = draft.uniform(9.95, 9.98)
        motion = along_ellipse((10.0, 0.0, 0.0), (0.0, 0.0, 0.0), math.pi)
        draft.add("ball_0/ball", "sphere", (0.1, 0, 0), (x, 0, 2), "", motion=motion)

    register("darts", SceneType(draw=draw, moves=True))
    try:
        options: dict[str, Any] = {"control_period": 0.1, "start_tilt": 0.0}
        ours = loop_in("darts:new", backend, **options)
        fast = loop_in("darts:new", backend, compiled=None, **options)
        alone = loop_in("darts:new", backend, 1, compiled=None, **options)
        kept = loop_in("darts:new", backend, compiled=None, **options)
        assert isinstance(fast, CompiledLoop)
        for number in range(1, 9):
            for loop in (ours, fast, alone, kept):
                step(loop)
            assert (ours.world.clearance() > 0.0).all()
            assert ours.terminated.tolist() == [number == 8] * 2
            state = ours.snapshot()
            for loop in (fast, kept):
                found = loop.snapshot()
                assert found.keys() == state.keys()
                assert all(found[name].tobytes() == state[name].tobytes() for name in state)
            for name, array in alone.snapshot().items():
                assert array.ndim < 2 or array[0].tobytes() == state[name][0].tobytes()
            kept.restore(state)
        assert not fast.refusal
    finally:
        SCENES.pop("darts")


def test_drones_see_each_other() -> None:
    exact = {"noise": 0.0, "share": 0.0, "dropout": 0.0, "near": 0.01}
    config = EnvConfig.from_keywords(
        "rotorgram/Formation-v0", drones=3, vehicle="hummingbird", backend="rigid",
        compiled=False, sensors={"lidar": {**exact, "model": "os0", "rows": 64, "columns": 1024}},
    )  # fmt: skip
    loop = Loop(config, 2)
    begun = np.ones(6, bool)
    loop.advance(np.zeros((6, 4), np.float32), begun, list(range(6)))
    place = loop.record.state.position
    seen = loop.observations["lidar"].reshape(2, 3, -1).min(axis=-1)
    for world in range(2):
        for drone in range(3):
            others = np.delete(place[world], drone, axis=0)
            nearest = np.linalg.norm(others - place[world, drone], axis=1).min()
            least = nearest - loop.vehicle.radius
            ground = place[world, drone, 2]
            assert seen[world, drone] == pytest.approx(min(least, ground), abs=0.02)


def test_each_layout_of_a_scene_has_as_many_openings() -> None:
    def draw(draft: Draft) -> None:
        draft.add("ground/floor", "plane", (9, 9, 1), (0, 0, 0), "")
        count = 1 + int(draft.rng.integers(4))
        draft.openings = [(float(i), 0.0, 1.0, 1.0, 0.0, 0.5) for i in range(count)]

    register("holes", SceneType(draw=draw))
    try:
        with pytest.raises(InputError, match=r"scene: expected [1-4] openings in each layout of h"):
            make_world(Vehicle.load("crazyflie2"), 8, "rigid", scene=SceneConfig.parse("holes:0-9"))
    finally:
        SCENES.pop("holes")
