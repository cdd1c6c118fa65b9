"""Gymnasium's render modes: pictures of what flies, and the same physics with and without."""

import math
from threading import Thread
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from pictures import HEXA, at
from rotorgram.envs import LocalVectorEnv, SingleEnv, register
from rotorgram.envs.parallel import LocalParallelEnv
from rotorgram.envs.rendering import Renderer
from rotorgram.envs.tasks import Elevation
from rotorgram.models import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering import Moment, NoOpenGL, live
from rotorgram.rendering.gl import offscreen_context
from rotorgram.rendering.stage import Stage
from rotorgram.sim import InitialState, stack
from swarms import RISE

try:
    offscreen_context(16, 16).free()
except NoOpenGL as error:
    pytest.skip(str(error), allow_module_level=True)


ENV_ID = "rotorgram/Elevation-v0"
IDS = (ENV_ID, "rotorgram/Hover-v0")


@pytest.mark.parametrize("env_id", IDS)
@pytest.mark.parametrize("vehicle", [None, HEXA])
def test_a_picture_of_one_drone_and_the_same_bits(env_id: str, vehicle: Any) -> None:
    env = gym.make(env_id, render_mode="rgb_array", vehicle=vehicle)
    plain = gym.make(env_id, vehicle=vehicle)
    first, _ = env.reset(seed=3)
    other, _ = plain.reset(seed=3)
    assert first.tobytes() == other.tobytes()
    before = env.render()
    full = env.action_space.high
    for _ in range(40):
        one = env.step(full)
        two = plain.step(full)
        assert one[0].tobytes() == two[0].tobytes()
        assert one[1:4] == two[1:4]
        if one[2]:
            break
    after = env.render()
    env.close()
    plain.close()
    for picture in (before, after):
        assert picture.shape == (360, 480, 3)
        assert picture.dtype == np.uint8
        top = picture[:30].mean(axis=(0, 1))
        bottom = picture[-30:].mean(axis=(0, 1))
        assert top[2] > top[0] + 20, "the sky is blue"
        assert abs(bottom[2] - bottom[0]) < 40, "the ground is not"
    assert (before != after).mean() > 0.05, "it climbed, and the camera with it"


def test_a_picture_of_each_of_many() -> None:
    class Stairs(Elevation):
        def begin(self, draw: Any) -> InitialState:
            super().begin(draw)
            return InitialState(position=stack((0.0, 0.0, np.array([[4.0], [5.0], [6.0]]))))

    register("Stairs-v0", Stairs)
    envs = gym.make_vec("Stairs-v0", num_envs=3, render_mode="rgb_array")
    with pytest.raises(gym.error.ResetNeeded, match="render: expected a call of reset"):
        envs.render()
    envs.reset(seed=0)
    low, middle, high = pictures = envs.render()
    envs.close()
    assert {picture.shape for picture in pictures} == {(180, 240, 3)}
    # The camera goes with the craft, so that the green disc of the target lies elsewhere.
    rows = [np.average(np.arange(180), weights=_green(picture)) for picture in pictures]
    assert rows[0] < rows[1] < rows[2]
    assert (low != middle).any()
    assert (middle != high).any()


def test_each_drone_is_drawn_as_its_own_vehicle() -> None:
    names = ("crazyflie2", "hummingbird")
    env = LocalVectorEnv("rotorgram/Formation-v0", 2, drones=2, vehicle=",".join(names))
    env.reset(seed=1)
    renderer = Renderer("rgb_array", env.loop)
    assert renderer.render()
    assert renderer._canvas
    model = renderer._canvas.stage.model
    renderer.close()
    roots = model.body_subtreemass[model.body_parentid == 0]
    assert sorted(roots[roots > 0])[:2] == pytest.approx([Vehicle.load(n).mass for n in names])


def _green(picture: np.ndarray) -> np.ndarray:
    red, green, blue = (picture[..., i].astype(int) for i in range(3))
    disc = (green > red + 60) & (green > blue + 20)
    assert disc.any()
    return disc.sum(axis=1)


def test_any_thread_may_ask_for_a_picture() -> None:
    env = gym.make(ENV_ID, render_mode="rgb_array")
    env.reset(seed=0)
    here = env.render()
    there = []
    thread = Thread(target=lambda: there.append(env.render()))
    thread.start()
    thread.join()
    closing = Thread(target=env.close)
    closing.start()
    closing.join()
    np.testing.assert_array_equal(here, there[0])


def test_a_window_shows_a_moment_once(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    class View:
        def __init__(self, stage: Stage, _: object) -> None:
            assert stage.drones == 1

        def draw_in_time(self, *moments: Moment) -> None:
            drawn.extend(moments)

        def close(self) -> None:
            drawn.append(None)

    monkeypatch.setattr(live, "LiveView", View)
    env = gym.make(ENV_ID, render_mode="human")
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(1, np.float32))
        assert env.render() is None
    env.close()
    assert [moment and moment.step for moment in drawn] == [0, 1, 2, 3, None]


def test_no_picture_without_a_mode(caplog: pytest.LogCaptureFixture) -> None:
    for env in (SingleEnv(ENV_ID), LocalVectorEnv(ENV_ID, 2)):
        env.reset(seed=0)
        with pytest.warns(UserWarning, match="render: expected render_mode"):
            assert env.render() is None
        env.close()


def test_a_path_begins_anew_with_each_episode() -> None:
    stage = Stage("plain")
    scene = mujoco.MjvScene(stage.model, 100)

    def count() -> int:
        scene.ngeom = 0
        stage.decorate(scene)
        return int(scene.ngeom)

    stage.show(at(5.0))
    assert count() == 1, "the disc"
    for step in range(1, 10):
        stage.show(at(5 + 0.1 * step, step=step))
    assert count() == 1 + 3, "pieces from steps 0, 3, 6; the one that begins at 9 has no length"
    stage.show(at(6.5, step=10))
    assert count() == 1 + 4
    stage.show(at(4.0, step=2, episode=1))  # steps are left out, the start among them
    assert count() == 1
    stage.show(at(4.0, step=2, episode=2, goal=None))
    assert count() == 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"scene": "moon"}, "scene: expected 'plain' or 'airport' .* got 'moon'"),
        ({"drones": 0}, "drones: expected 1 or more, got 0"),
        ({"vehicle": "nowhere.xml"}, "vehicle: cannot read nowhere.xml"),
    ],
)
def test_wrong_stages(arguments: dict[str, Any], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        Stage(**arguments)


def test_drones_of_one_world_are_in_one_picture_where_they_are() -> None:
    env = LocalParallelEnv(RISE, 3, "rgb_array")
    env.reset(seed=1)
    picture = env.render()
    assert picture.shape == (360, 480, 3)
    assert picture.dtype == np.uint8
    env.close()
    stage = Stage("plain", 2)
    stage.show(*(at(9.0, position=(2.0 * x, -x, 9.0)) for x in (1.0, 4.0)))
    places = stage.data.qpos.reshape(2, 7)[:, :3]
    assert places == pytest.approx(np.array([[2.0, -1.0, 9.0], [8.0, -4.0, 9.0]]))
    assert stage.least_distance == pytest.approx(math.hypot(6.0, 3.0))
    assert Stage("plain").least_distance is None


def test_cameras_hold_every_craft_and_goal_of_one_world() -> None:
    stage = Stage("plain", 2)
    moments = []
    for y in ((-1.0, 5.0), (4.0, -20.0)):
        craft, goal = ((0.0, one, 9.0) for one in y)
        moments.append(at(9.0, position=craft, goal=goal))
    stage.show(*moments)
    radii = {"chase": 3.85, "top": 5.5, "front": 6.9, "side": 6.9, "free": 3.85}
    for name, count in radii.items():  # the goals are at y = 5 and -20 m
        camera = stage.camera(name)
        assert camera.distance == pytest.approx(count * stage.radius + 25.0), name
    assert stage.camera("chase").lookat[1] == pytest.approx(1.5)  # the craft at y = 1.5 m
    assert stage.camera("free").lookat[1] == pytest.approx(-7.5)  # and the goals at 7.5 m


def test_drones_of_one_world_are_named_and_have_paths_and_goals_of_their_own_colour() -> None:
    stage = Stage("plain", 2)
    for step in range(10):
        x = 0.1 * step
        both = (at(9.0, position=(x, y, 9.0), goal=(5.0, y, 9.0), step=step) for y in (-1.0, -4.0))
        stage.show(*both)
    scene = mujoco.MjvScene(stage.model, 1000)
    stage.decorate(scene)
    geoms = scene.geoms[: scene.ngeom]
    kinds = mujoco.mjtGeom
    labels = [geom for geom in geoms if geom.type == kinds.mjGEOM_LABEL]
    assert [geom.label.strip() for geom in labels] == ["drone_0", "drone_1"]
    assert [geom.pos[1] for geom in labels] == pytest.approx([-1.0, -4.0])  # over their crafts
    colors: dict[float, set[tuple[float, ...]]] = {-1.0: set(), -4.0: set()}
    for geom in geoms:
        if geom.type in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
            colors[round(float(geom.pos[1]), 6)].add(tuple(geom.rgba[:3].tolist()))
    assert [len(own) for own in colors.values()] == [1, 1]
    assert colors[-1.0] != colors[-4.0]
