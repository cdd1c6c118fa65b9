"""What stands around drones: distances, touch on `rigid`, contact on `mujoco`."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from rotorgram.models import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.scenes import SCENES, Draft, SceneConfig, SceneType, Solids, kernels, register
from rotorgram.scenes.motion import along_ellipse
from rotorgram.sim import make_world
from rotorgram.sim.scenery import FAR
from worlds import BALL_RADIUS as RADIUS
from worlds import ball_craft, begin

RACER = Path(__file__).parents[1] / "data" / "racer.xml"
DENSE = "forest:new,density=0.05,size=40x30,clear=ends"
BACKENDS = pytest.mark.parametrize("backend", ["rigid", "mujoco"])


@pytest.fixture
def ball(tmp_path: Path) -> Vehicle:
    """A craft whose only solid geom is a ball about its origin."""
    return ball_craft(tmp_path)


def at(count: int, height: float) -> np.ndarray:
    """Over the origin."""
    return np.full((count, 1, 3), (0.0, 0.0, height))


def near_surfaces(scene: SceneConfig, seed: int, count: int) -> np.ndarray:
    """Points from which it is about the ball's radius to what stands there, and over the ground."""
    dice = np.random.default_rng(7)
    solids = Solids.of_scene(scene.with_seed(seed)).standing()
    chosen = dice.integers(len(solids), size=60_000)
    is_field = solids.kinds[chosen, None] == kernels.KINDS.index("hfield")
    reach = np.minimum(solids.halves[chosen], np.where(is_field, 45.0, 5.0)) + 0.3
    local = reach * dice.uniform(-1.0, 1.0, reach.shape)
    points = solids.centers[chosen] + (solids.axes[chosen] @ local[..., None])[..., 0]
    points = points[points[:, 2] > 0.5]
    gaps = solids.distance(points)
    near = points[abs(gaps - RADIUS) < 0.02]
    assert len(near) >= count
    return near[:count]


PLACES = [
    "forest:3", "warehouse:1", "gates:2", "gates:2-4", "airport", "hills:5", "maze:3", "aisles:1",
    "traffic:5", DENSE,
]  # fmt: skip


def test_a_ball_is_placed_in_every_scene() -> None:
    assert {SceneConfig.parse(text).name for text in PLACES} == {*SCENES} - {"plain"}


@pytest.mark.parametrize("text", PLACES)
def test_touch_contact_and_distance_agree_within_a_millimetre(ball: Vehicle, text: str) -> None:
    assert ball.radius == pytest.approx(RADIUS)
    scene = SceneConfig.parse(text)
    count = 60
    for backend in ("rigid", "mujoco"):
        world: Any = make_world(ball, count, backend, scene=scene)
        begin(world, position=at(count, 100.0))
        assert not world.state.touching.any()
        assert (world.clearance() > 20.0).all()
        seed = int(world.scenery.seeds[0])
        if world.scenery.varies:
            world.scenery.take(np.full(count, seed))
            world.random.begin = lambda mask: None
            world.scenery.begin = lambda random, mask: None
        points = near_surfaces(scene, seed, count)
        begin(world, position=points[:, None])
        gap = Solids.of_scene(scene.with_seed(seed)).standing().distance(points) - RADIUS
        assert world.clearance()[:, 0] == pytest.approx(gap, abs=1e-4)
        sure = abs(gap) > 1e-3
        assert sure.sum() > 40
        assert (world.state.touching[sure, 0] == (gap[sure] < 0)).all(), (backend, text)
        assert 0 < (gap[sure] < 0).sum() < sure.sum()


@BACKENDS
def test_a_post_is_not_flown_through(ball: Vehicle, backend: str) -> None:
    """At 30 m/s a step of 0.02 s leads past a post of the warehouse's width."""
    scene = SceneConfig.parse("warehouse:1")
    post = next(i for i, n in enumerate(Solids.of_scene(scene).names) if "post" in n)
    x, y, z = Solids.of_scene(scene).centers[post]
    world: Any = make_world(ball, 1, backend, scene=scene)
    begin(world, position=[[[x - 0.4, y, z]]], velocity=[[[30.0, 0.0, 0.0]]])
    assert not world.state.touching.any()
    world.step(world.state.thrust, 6)
    assert world.state.touching.all()
    if backend == "rigid":
        assert world.state.position[0, 0, 0] > x + 0.3  # it flies on: a task ends the episode
    else:
        assert world.state.position[0, 0, 0] < x


@pytest.fixture
def dart() -> Iterator[SceneConfig]:
    """A ball of 0.1 m at x = 10 cos(2 t) m and 2 m above the ground: at 20 m/s over the origin."""

    def draw(draft: Draft) -> None:
        draft.add("ground/floor", "plane", (9, 9, 1), (0, 0, 0), "")
        motion = along_ellipse((10.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.pi)
        draft.add("ball_0/ball", "sphere", (0.1, 0, 0), (10, 0, 2), "", motion=motion)

    register("dart", SceneType(draw=draw, moves=True))
    yield SceneConfig.parse("dart:1")
    SCENES.pop("dart")


@BACKENDS
@pytest.mark.parametrize(("start", "steps", "touches"), [(0.7, 20, 15), (0.75, 10, 5)])
def test_a_fast_ball_touches_within_a_control_step(
    ball: Vehicle, dart: SceneConfig, backend: str, start: float, steps: int, touches: int
) -> None:
    """Its center is within 0.25 m of the craft's from 0.773 s to 0.798 s."""
    world: Any = make_world(ball, 1, backend, scene=dart)
    begin(world, position=at(1, 2.0))
    everybody = np.ones((1, 1), bool)
    for time in (start, 0.8):
        world.scenery.move(everybody, np.array([time]))
        assert world.clearance()[0, 0] > 0.0  # neither at the beginning nor at the end
    world.command(world.state.thrust, None)
    touched = []
    for call in world.calls(steps, steps):
        world.push(None)
        world.fly(call, None)
        touched.append(bool(world.state.touching[0, 0]))
    assert len(touched) == steps
    assert ball.timestep == 0.005
    assert touched.index(True) + 1 == touches
    assert all(touched[touches:])
    world.scenery.move(everybody, np.array([0.9]))
    world.step(world.state.thrust, steps)
    assert not world.state.touching.any()


@BACKENDS
@pytest.mark.parametrize("moves", [True, False])
def test_a_scene_may_have_nothing_but_ground(ball: Vehicle, backend: str, moves: bool) -> None:
    def draw(draft: Draft) -> None:
        draft.add("ground/floor", "plane", (9, 9, 1), (0, 0, 0), "")

    register("bare", SceneType(draw=draw, moves=moves))
    try:
        for text in ("bare:1", "bare:0-3", "bare:new"):
            world: Any = make_world(ball, 2, backend, scene=SceneConfig.parse(text))
            begin(world, position=at(2, 1.0))
            world.scenery.move(np.ones((2, 1), bool), np.full(2, 0.5))
            world.step(world.state.thrust, 2)
            assert (world.scenery.distance(world.state.position) == FAR).all()
            assert not world.state.touching.any()
    finally:
        SCENES.pop("bare")


def test_a_ball_moves_over_a_height_field(ball: Vehicle) -> None:
    """It has 0.1 m and is at x = 3 cos(2 t) m; the field is level, 2 m below both."""

    def draw(draft: Draft) -> None:
        draft.add("ground/floor", "plane", (9, 9, 1), (0, 0, 0), "")
        draft.add_heights("sand_0/field", np.array((20.0, 20.0)), np.ones((9, 9)), 1.0, "")
        motion = along_ellipse((3.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.pi)
        draft.add("ball_0/ball", "sphere", (0.1, 0, 0), (3, 0, 3), "", motion=motion)

    register("sand", SceneType(draw=draw, moves=True))
    try:
        with pytest.raises(InputError, match=r"where nothing moves, got sand:0$"):
            make_world(ball, 2, scene=SceneConfig.parse("sand:0"))
        world: Any = make_world(ball, 2, "rigid", scene=SceneConfig.parse("sand:0-3"))
        begin(world, position=at(2, 3.0))
        assert world.scenery.distance(world.state.position) == pytest.approx(2.0, abs=1e-5)
        time = np.arccos(1 / 3) / 2
        world.scenery.move(np.ones((2, 1), bool), np.full(2, time))
        assert world.scenery.distance(world.state.position) == pytest.approx(0.9, abs=1e-5)
    finally:
        SCENES.pop("sand")


def test_no_touch_is_missed_and_few_distances_are_computed(
    monkeypatch: pytest.MonkeyPatch, ball: Vehicle
) -> None:
    """Against the distances of all physics steps, between solids on straight lines."""
    count, period, steps = 8, 0.04, 8
    world: Any = make_world(ball, count, "rigid", scene=SceneConfig.parse("traffic:0-9"))
    world.random.seed(np.ones((count, 1), bool), list(range(count)))
    asked = []
    distance = world.scenery.distance

    def counted(position: Any, due: Any, *further: float) -> Any:
        asked.append(due.mean())
        return distance(position, due, *further)

    monkeypatch.setattr(world.scenery, "distance", counted)
    begin(world, position=at(count, 2.0))
    solids = [Solids.of_layout(world.scenery.scene, seed) for seed in world.scenery.seeds]
    asked.clear()
    found = []
    expected = []
    for number in range(1, 201):
        world.scenery.move(np.ones((count, 1), bool), np.full(count, number * period))
        world.command(world.state.thrust, None)
        ends = [[one.at(n * period).centers for one in solids] for n in (number - 1, number)]
        for step, call in enumerate(world.calls(steps, steps), 1):
            world.push(None)
            world.state.touching = np.zeros((count, 1), bool)
            world.fly(call, None)
            found.append(world.state.touching[:, 0])
            for one, first, last in zip(solids, *ends, strict=True):
                now = replace(one, centers=first + (last - first) * step / steps)
                expected.append(now.distance((0.0, 0.0, 2.0)) - RADIUS)
    gap = np.reshape(expected, (-1, count))
    sure = abs(gap) > 1e-3
    assert (np.array(found) == (gap < 0))[sure].all()
    assert 20 < (gap < 0).sum() < 0.1 * gap.size
    assert 1 / steps <= np.mean(asked) < 2.5 / steps


@BACKENDS
def test_each_episode_of_each_world_has_a_layout_of_its_own(ball: Vehicle, backend: str) -> None:
    given = {name: SceneConfig.parse(f"forest:{name}") for name in ("new", "unseen", "2-4")}
    for name, scene in given.items():
        world: Any = make_world(ball, 8, backend, scene=scene)
        everybody = np.ones((8, 1), bool)
        world.random.seed(everybody, list(range(8)))
        begin(world, position=at(8, 50.0))
        first = world.scenery.seeds.copy()
        kept = world.snapshot()
        half = np.arange(8)[:, None] < 4
        begin(world, half, position=at(8, 50.0))
        seeds = world.scenery.seeds
        assert (seeds[4:] == first[4:]).all()
        if name == "2-4":
            assert set(first) | set(seeds) == {2, 3, 4}
            continue
        assert len({*first.tolist(), *seeds[:4].tolist()}) == 12
        assert (np.concatenate((first, seeds)) % 2 == (name == "unseen")).all()
        alone: Any = make_world(ball, 1, backend, scene=scene)
        alone.random.seed(everybody[:1], [3])
        begin(alone, position=[[[0.0, 0.0, 50.0]]])
        assert alone.scenery.seeds[0] == first[3]
        world.restore(kept)
        assert (world.scenery.seeds == first).all()


def test_numba_has_the_bits_of_numpy(monkeypatch: pytest.MonkeyPatch, ball: Vehicle) -> None:
    assert kernels.compiled()
    world: Any = make_world(ball, 6, "rigid", scene=SceneConfig.parse(DENSE))
    begin(world, position=at(6, 3.0))
    dice = np.random.default_rng(3)
    for _ in range(20):
        points = dice.uniform((-20, -15, 0), (20, 15, 15), (6, 1, 3)).astype(np.float32)
        due = dice.random((6, 1)) < 0.7
        fast = world.scenery.distance(points, due)
        with monkeypatch.context() as patch:
            patch.setattr(kernels, "compiled", lambda: None)
            slow = world.scenery.distance(points, due)
        assert fast.dtype == slow.dtype == np.float32
        assert fast.tobytes() == slow.tobytes()
        assert not fast[~due].any()


@BACKENDS
def test_over_bare_ground_nothing_is_near(ball: Vehicle, backend: str) -> None:
    world: Any = make_world(ball, 2, backend)
    begin(world, position=[[[0.0, 0.0, 1.0]], [[0.0, 0.0, 2.0]]])
    assert not world.scenery
    assert (world.clearance() == FAR).all()
    assert "scenery/seeds" not in world.snapshot()


def test_a_distance_is_looked_for_only_where_a_craft_may_have_come_near(
    monkeypatch: pytest.MonkeyPatch, ball: Vehicle
) -> None:
    world: Any = make_world(ball, 1, "rigid", scene=SceneConfig.parse("forest:3"))
    begin(world, position=[[[0.0, 0.0, 10.0]]])
    slack = float(world.slack[0, 0])
    assert slack > 5.0
    asked = []
    distance = world.scenery.distance

    def counted(position: Any, due: Any, *further: float) -> Any:
        asked.append(bool(due.any()))
        return distance(position, due, *further)

    monkeypatch.setattr(world.scenery, "distance", counted)
    begin(world, position=[[[0.0, 0.0, 10.0]]], velocity=[[[15.0, 0.0, 0.0]]])
    for _ in range(400):
        world.step(world.state.thrust, 1)
    way = float(world.state.position[0, 0, 0])
    assert way > 5.0
    assert 2 <= sum(asked) < 80
    assert world.slack[0, 0] <= distance(world.state.position)[0, 0] - ball.radius + 1e-4


def test_geoms_of_a_layout_are_those_that_mujoco_compiles(ball: Vehicle) -> None:
    """Frames too: its compiler notes which geoms have the axes of their body."""
    scene = SceneConfig.parse("gates:2-4")
    world: Any = make_world(ball, 1, scene=scene)
    begin(world, position=at(1, 100.0))
    model = world._batch.get_model(0)
    seed = int(world.scenery.seeds[0])
    fixed: Any = make_world(ball, 1, scene=scene.with_seed(seed))
    other = fixed._batch.model
    data = [mujoco.MjData(one) for one in (model, other)]
    for one, its in zip((model, other), data, strict=True):
        mujoco.mj_kinematics(one, its)
    own, theirs = (np.flatnonzero(one.geom_bodyid == 0)[1:] for one in (model, other))
    count = len(theirs)
    assert count == world.scenery.most
    for name in ("geom_xpos", "geom_xmat"):
        found, expected = (
            getattr(its, name)[ids] for its, ids in zip(data, (own, theirs), strict=True)
        )
        assert found == pytest.approx(expected, abs=1e-9), name
    for name in ("geom_type", "geom_size", "geom_rbound", "geom_aabb"):
        found, expected = (getattr(one, name)[ids] for one, ids in ((model, own), (other, theirs)))
        assert found == pytest.approx(expected, abs=1e-9), name


def test_a_bad_state_leaves_nothing_behind(ball: Vehicle) -> None:
    world: Any = make_world(ball, 1, "rigid", scene=SceneConfig.parse("forest:3"))
    begin(world, position=at(1, 10.0))
    world.slack[:] = np.nan
    begin(world, position=at(1, 10.0))
    assert np.isfinite(world.slack).all()


def test_what_lies_below_the_ground_is_not_touched(ball: Vehicle) -> None:
    world: Any = make_world(ball, 1, "rigid", scene=SceneConfig.parse("airport"))
    begin(world, position=at(1, RADIUS + 0.05))
    assert not world.state.touching.any()
    assert (world.clearance() > 5.0).all()


def test_obstacles_that_move_are_refused_by_name(tmp_path: Path) -> None:
    file = tmp_path / "lift.xml"
    lift = '<body mocap="true"><geom name="lift" type="box" size="1 1 1" pos="9 0 0"/></body>'
    file.write_text(RACER.read_text().replace("</worldbody>", f"{lift}</worldbody>", 1))
    vehicle = Vehicle.load(file)
    make_world(vehicle, 1)
    with pytest.raises(InputError, match=r"^scene: expected .* the backend rigid: .*, got lift$"):
        make_world(vehicle, 1, "rigid")


@BACKENDS
def test_a_snapshot_from_before_the_first_episode(ball: Vehicle, backend: str) -> None:
    world: Any = make_world(ball, 2, backend, scene=SceneConfig.parse("forest:new"))
    kept = world.snapshot()
    begin(world, position=at(2, 50.0))
    world.restore(kept)
    assert (world.scenery.seeds == -1).all()
