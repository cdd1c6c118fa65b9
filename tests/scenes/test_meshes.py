"""Meshes of scenes: solid on `mujoco` and drawn as their convex hulls, refused elsewhere."""

import json
import struct
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from rotorgram.envs.config import EnvConfig
from rotorgram.models import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.scenes import SceneConfig, Solids, build_scene
from rotorgram.scenes.files import path_of
from rotorgram.sim import make_world
from worlds import begin

RACER = Path(__file__).parents[1] / "data" / "racer.xml"
RADIUS = 0.15
CORNERS = [(0, 0, 0), (2, 0, 0), (0, 3, 0), (0, 0, 1)]
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
PLACE = np.array((4.0, 1.0, 2.0))
MJCF = """
<mujoco>
  <compiler meshdir="shapes"/>
  <asset><mesh name="wedge" file="wedge.stl" scale="2 1 1"/></asset>
  <worldbody>
    <body pos="4 1 0" euler="0 0 30">
      <geom name="it" type="mesh" mesh="wedge" pos="0 0 2" euler="20 0 0" rgba="0.9 0.1 0.1 1"/>
    </body>
    <geom type="box" size="0.5 0.5 0.5" pos="-6 0 0.5"/>
  </worldbody>
</mujoco>
"""
HULL = 'kind = "hull"\nvertices = [[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 1]]\n'


def stl(corners: Any = CORNERS) -> bytes:
    """A binary STL file of a tetrahedron."""
    content = bytes(80) + struct.pack("<I", len(FACES))
    for face in FACES:
        numbers = [number for corner in face for number in corners[corner]]
        content += struct.pack("<12fH", 0, 0, 0, *numbers, 0)
    return content


def written(folder: Path, mesh: bytes, text: str = MJCF) -> str:
    """Path of a scene's file."""
    (folder / "shapes").mkdir(exist_ok=True)
    (folder / "shapes" / "wedge.stl").write_bytes(mesh)
    path = folder / "world.xml"
    path.write_text(text)
    return str(path)


@pytest.fixture
def scene(tmp_path: Path) -> str:
    return written(tmp_path, stl())


@pytest.fixture
def ball(tmp_path: Path) -> Vehicle:
    """A craft whose only solid geom is a ball about its origin."""
    file = tmp_path / "ball.xml"
    box = '<geom type="box" size="0.1 0.08 0.03"'
    file.write_text(RACER.read_text().replace(box, f'<geom type="sphere" size="{RADIUS}"', 1))
    return Vehicle.load(file)


def turned(axis: int, degrees: float) -> np.ndarray:
    """About x or z."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    if axis == 0:
        return np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def corners_of_the_world() -> np.ndarray:
    """Of the wedge, by the numbers of the file: scaled, tilted by 20 and turned by 30 degrees."""
    scaled = np.array(CORNERS) * (2.0, 1.0, 1.0)
    return PLACE + scaled @ (turned(2, 30.0) @ turned(0, 20.0)).T


def slope() -> tuple[np.ndarray, np.ndarray]:
    """Center and outward normal of the wedge's slanted face."""
    _, a, b, c = corners_of_the_world()
    normal = np.cross(b - a, c - a)
    return (a + b + c) / 3, normal / np.linalg.norm(normal)


def test_a_ball_touches_where_the_hull_is(ball: Vehicle, scene: str) -> None:
    center, normal = slope()
    world: Any = make_world(ball, 2, scene=SceneConfig.parse(scene))
    gaps = np.array([[1e-3], [-1e-3]])
    begin(world, position=(center + (RADIUS + gaps) * normal)[:, None])
    assert world.state.touching[:, 0].tolist() == [False, True]


def test_a_ball_that_falls_touches_where_the_hull_is(ball: Vehicle, scene: str) -> None:
    """It falls onto the slanted face, from 1 m above the point where it would touch."""
    center, normal = slope()
    start = center + RADIUS * normal + (0.0, 0.0, 1.0)
    world: Any = make_world(ball, 1, scene=SceneConfig.parse(scene))
    begin(world, position=start[None, None], thrust=np.zeros((1, 1, 4)))
    least = world.vehicle.thrust_low
    for _ in range(5_000):
        above = world.state.position[0, 0].copy()
        world.step(least, 1)
        if world.state.touching.any():
            break
    gap = (above - center) @ normal - RADIUS
    step = np.linalg.norm(world.state.velocity) * world.vehicle.timestep
    assert -1e-3 < gap < step + 1e-3


def test_a_hull_of_toml_is_that_of_the_mesh(ball: Vehicle, tmp_path: Path) -> None:
    path = tmp_path / "world.toml"
    path.write_text(f"[[obstacle]]\n{HULL}position = [4, 1, 2]\nquaternion = [1, 0, 0, 1]\n")
    world: Any = make_world(ball, 2, scene=SceneConfig.parse(str(path)))
    normal = np.array((-2.0, 3.0, 6.0)) / 7.0  # (3, 2, 6) / 7, turned by 90 degrees about z
    face = PLACE + np.array((-0.9, 0.8, 0.3))  # 0.4 (0, 2, 0) + 0.3 (-3, 0, 0) + 0.3 (0, 0, 1)
    gaps = np.array([[1e-3], [-1e-3]])
    begin(world, position=(face + (RADIUS + gaps) * normal)[:, None])
    assert world.state.touching[:, 0].tolist() == [False, True]


def test_pictures_show_the_hull(scene: str) -> None:
    model = build_scene(scene=scene).compile()
    (name,) = (model.geom(i).name for i in range(model.ngeom) if "hull" in model.geom(i).name)
    assert name == "own/hull_1/hull"
    geom = model.geom(name)
    assert geom.rgba == pytest.approx([0.9, 0.1, 0.1, 1.0])
    assert (geom.contype[0], geom.conaffinity[0]) == (0, 0)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    center, normal = slope()
    hit = np.zeros(1, np.int32)
    way = mujoco.mj_ray(model, data, center + normal, -normal, None, 1, -1, hit)
    assert hit[0] == geom.id
    assert way == pytest.approx(1.0, abs=1e-4)


def test_who_does_not_know_it_refuses_it_by_name(scene: str) -> None:
    def refused(by: str, env_id: str = "rotorgram/Hover-v0", **options: Any) -> None:
        words = rf"^scene: expected no mesh .* with {by}: mujoco alone .*, got own/hull_1/hull$"
        with pytest.raises(InputError, match=words):
            EnvConfig.from_keywords(env_id, scene=scene, **options).resolve()

    refused("the backend rigid", backend="rigid")
    refused("the sensor lidar", sensors={"lidar": True})
    with pytest.raises(InputError, match=r"with distances: .* got own/hull_1/hull"):
        Solids.of_scene(scene)


@pytest.mark.parametrize("compiled", [True, False])
def test_a_task_that_reads_distances_refuses_it(scene: str, compiled: bool) -> None:
    env = gym.make(
        "rotorgram/Dodge-v0", scene=scene, backend="mujoco", compiled=compiled, sensors={}
    )
    words = r"a task that reads distances.* own/hull_1/hull$"
    with closing(env), pytest.raises(InputError, match=words):
        env.reset(seed=0)


def test_it_flies_the_same_bits_from_the_config_s_json(scene: str) -> None:
    config = EnvConfig(env_id="rotorgram/Hover-v0", scene=scene).resolve()
    there = EnvConfig.from_dict(json.loads(json.dumps(config.to_dict())))
    first = gym.make("rotorgram/Hover-v0", scene=config.scene)
    Path(scene).unlink()
    assert there == config
    assert there.digest == config.digest
    copy = SceneConfig.parse(path_of(there.scene)).embedded()
    assert copy.content == config.scene.content
    second = gym.make("rotorgram/Hover-v0", scene=there.scene, compiled=False)
    with closing(first), closing(second):
        assert first.reset(seed=3)[0].tobytes() == second.reset(seed=3)[0].tobytes()
        action = np.zeros(first.action_space.shape, np.float32)
        for _ in range(20):
            ours, theirs = first.step(action), second.step(action)
            assert ours[0].tobytes() == theirs[0].tobytes()
            assert ours[1:4] == theirs[1:4]


def test_a_mesh_of_the_vehicle_s_file(tmp_path: Path) -> None:
    """It collides on `mujoco`; `rigid` and a task that reads distances refuse it by name."""
    mesh = '<asset><mesh name="m" vertex="0 0 0 2 0 0 0 3 0 0 0 1"/></asset><worldbody>'
    rock = '<geom name="rock" type="mesh" mesh="m" pos="0 9 0"/></worldbody>'
    text = RACER.read_text().replace("<worldbody>", mesh, 1).replace("</worldbody>", rock, 1)
    file = tmp_path / "own.xml"
    file.write_text(text)
    with pytest.raises(InputError, match=r"^scene: expected .* the backend rigid: .*, got rock$"):
        EnvConfig(env_id="rotorgram/Hover-v0", vehicle=(str(file),), backend="rigid").resolve()
    world: Any = make_world(Vehicle.load(file), 1)
    begin(world, position=[[[0.3, 9.3, 0.3]]])
    assert world.state.touching.all()
    assert world.clearance() is None
    with pytest.raises(InputError, match=r"a task that reads distances: .*, got rock$"):
        world.scenery.distance(world.state.position)


WORLD = "<worldbody><geom type='mesh' mesh='m'/></worldbody>"
ASSET = "<asset><mesh name='m' {}/></asset>"


@pytest.mark.parametrize(
    ("asset", "sentence"),
    [
        ("file='/dev/zero'", r"expected files beside the scene's, of at most 8388608 bytes in all"),
        ("file='none.stl'", r"expected files beside .*, got none.stl"),
        ("file='large.stl'", r"expected files beside .*, got large.stl"),
        ("file='text.stl'", r"expected MJCF that MuJoCo reads, got: .*perhaps this is an ASCII"),
        ("file='nan.stl'", r"expected MJCF that MuJoCo reads, got: .*not finite"),
        ("file='flat.stl'", r"expected MJCF that MuJoCo reads, got: .*at least 4 vertices"),
        ("file='fine.stl' scale='1e9 1 1'", r"obstacle: vertices: expected 2 or more rows"),
        ("file='fine.stl' scale='1e-6 1 1'", r"obstacle: expected 4 to 2048 vertices .* got 4"),
        ("file='round.obj'", r"obstacle: expected 4 to 2048 .* maxhullvert .* got \d+ of a hull"),
        ("builtin='supertorus' params='9999 .2 1 1'", r"file: expected a params of at most 32"),
        ("file='fine.stl'><plugin plugin='p'/></mesh><mesh name='n' file='fine.stl'", r".*plugin"),
    ],
)  # fmt: skip
def test_hostile_meshes(tmp_path: Path, asset: str, sentence: str) -> None:
    dice = np.random.default_rng(0).normal(size=(3_000, 3))
    ball = dice / np.linalg.norm(dice, axis=1)[:, None]
    lines = [f"v {x} {y} {z}" for x, y, z in ball.tolist()] + ["f 1 2 3", "f 1 2 4"]
    with (tmp_path / "large.stl").open("wb") as file:
        file.truncate(1 << 40)  # a hole of a terabyte
    (tmp_path / "text.stl").write_text("solid it\nfacet normal 0 0 1\n" * 20)
    (tmp_path / "nan.stl").write_bytes(stl([*CORNERS[:3], (0, 0, np.nan)]))
    (tmp_path / "flat.stl").write_bytes(stl([*CORNERS[:3], (0, 0, 0)]))
    (tmp_path / "fine.stl").write_bytes(stl())
    (tmp_path / "round.obj").write_text("\n".join(lines))
    scene = tmp_path / "wrong.xml"
    scene.write_text(f"<mujoco>{ASSET.format(asset)}{WORLD}</mujoco>")
    with pytest.raises(InputError, match=rf"^scene: {scene}: {sentence}") as caught:
        SceneConfig.parse(str(scene)).embedded()
    assert "\n" not in str(caught.value)


def test_hulls_of_too_many_vertices_take_no_memory(tmp_path: Path) -> None:
    """200 times a mesh of 1,000 vertices, which have some 30 kB as text."""
    dice = np.random.default_rng(0).normal(size=(1_000, 3))
    ball = dice / np.linalg.norm(dice, axis=1)[:, None]
    lines = [f"v {x} {y} {z}" for x, y, z in ball.tolist()] + ["f 1 2 3", "f 1 2 4"]
    (tmp_path / "round.obj").write_text("\n".join(lines))
    geoms = "<worldbody><replicate count='200'><geom type='mesh' mesh='m'/></replicate></worldbody>"
    asset = ASSET.format("file='round.obj'")
    scene = tmp_path / "crowd.xml"
    scene.write_text(f"<mujoco>{asset}{geoms}</mujoco>")
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"expected text of at most 1000000 bytes, got more$"):
            SceneConfig.parse(str(scene)).embedded()
        assert tracemalloc.get_traced_memory()[1] < 8e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ('kind = "hull"', r"expected 4 to 2048 vertices of a hull alone, .* got 0 of a hull"),
        (HULL.replace("[0, 0, 1]", "[1, 1, 0]"), r"not in a plane, got 4 of a hull"),
        (HULL.replace("0, 0]", "0]").replace("3, 0]", "3]").replace("0, 1]", "1]"), r"got 4 of a"),
        (HULL.replace("[0, 0, 1]", "[0, 0, nan]"), r"obstacle.vertices: expected 2 or more rows"),
        (HULL.replace("hull", "plane"), r"vertices of a hull alone, .* got 4 of a plane"),
        (HULL + "size = [1]", r"expected a size of 0 numbers for a hull, got 1"),
    ],
)
def test_wrong_hulls(tmp_path: Path, content: str, sentence: str) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text(f"[[obstacle]]\n{content}\n")
    with pytest.raises(InputError, match=sentence):
        SceneConfig.parse(str(path)).embedded()
