"""A scene from a user's file: what it says is solid, it travels with a config, hostile ones end."""

import json
import os
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from commands import Capsys, refused
from rotorgram.envs.config import EnvConfig, read_keywords
from rotorgram.models import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.scenes import SceneConfig, Solids, build_scene
from rotorgram.scenes.files import path_of
from rotorgram.sim import make_world
from rotorgram.udp.spawn import spawn_simulator
from worlds import begin

RACER = Path(__file__).parents[1] / "data" / "racer.xml"
TOML = """
obstacle = [
  { kind = "box", size = [0.5,2,1], position = [6,0,1], label = "wall", quaternion = [1, 0, 0, 1] },
  { kind = "sphere", size = [1], position = [0, 0, 9], color = [0.2, 0.4, 0.6] },
  { kind = "capsule", size = [0.5, 1], position = [-6, 0, 3], quaternion = [1, 0, 1, 0] },
  { kind = "cylinder", size = [0.2, 3], position = [0, 7, 3] },
]
"""
MJCF = """
<mujoco>
  <asset><material name="blue" rgba="0.2 0.4 0.6 1"/></asset>
  <default><default class="wall"><geom type="box" size="0.5 2 1"/></default></default>
  <worldbody>
    <light pos="0 0 9"/>
    <geom type="plane" size="0 0 1"/>
    <geom class="wall" pos="6 0 1" euler="0 0 90"/>
    <body pos="0 0 9"><geom size="1" material="blue"/></body>
    <geom type="capsule" size="0.5 1" pos="-6 0 3" quat="1 0 1 0"/>
    <geom type="cylinder" size="0.2 3" pos="0 7 3"/>
    <geom name="ghost" size="1" pos="0 0 3" contype="0" conaffinity="0"/>
  </worldbody>
</mujoco>
"""
FILES = {"world.toml": TOML, "world.xml": MJCF}
BACKENDS = pytest.mark.parametrize("backend", ["rigid", "mujoco"])


@pytest.fixture(params=sorted(FILES))
def scene(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Path of a file."""
    path = tmp_path / request.param
    path.write_text(FILES[request.param])
    return str(path)


def written(folder: Path, content: str | bytes, name: str = "wrong.toml") -> str:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return str(path)


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ((6.0, 2.0, 1.9), 1.5),  # the wall is turned: 1 m deep in y
        ((3.0, 0.0, 1.0), 1.0),  # ground and wall are as near
        ((0.0, 0.0, 5.0), 3.0),
        ((-6.0, 0.0, 5.0), 1.5),
        ((-3.5, 0.0, 3.0), 1.0),
        ((2.0, 7.0, 3.0), 1.8),
        ((0.0, 0.0, 3.0), 3.0),  # what nothing can touch is not there
    ],
)
def test_distances(scene: str, point: tuple[float, ...], expected: float) -> None:
    assert Solids.of_scene(scene).distance(point) == pytest.approx(expected, abs=1e-9)


@BACKENDS
def test_it_is_solid(scene: str, backend: str) -> None:
    """A ball with a radius of 0.17 m at 1 cm from the wall, the sphere and the capsule, and in
    them."""
    world: Any = make_world(Vehicle.load(RACER), 6, backend, scene=SceneConfig.parse(scene))
    radius = world.vehicle.radius
    near = radius + 0.01
    places = [(6.0, 0.5 + near, 1.0), (0.0, 0.0, 8.0 - near), (-6.0, 0.0, 3.5 + near)]
    deep = [(6.0, 0.5, 1.0), (0.0, 0.0, 8.0), (-6.0, 0.0, 3.5)]
    begin(world, position=np.array(places + deep)[:, None])
    assert world.state.touching[:, 0].tolist() == [False] * 3 + [True] * 3
    assert world.clearance()[:3, 0] == pytest.approx([0.01] * 3, abs=1e-5)


def test_it_is_drawn_in_its_colours(scene: str) -> None:
    model = build_scene(scene=scene).compile()
    names = [model.geom(i).name for i in range(model.ngeom)]
    own = [name for name in names if name.startswith("own/")]
    assert len(own) == 4
    assert sum(name.startswith("own/wall_") and name.endswith("/box") for name in own) == 1
    (ball,) = (name for name in own if name.endswith("/sphere"))
    assert model.geom(ball).rgba == pytest.approx([0.2, 0.4, 0.6, 1.0])
    assert model.geom(ball).pos == pytest.approx([0.0, 0.0, 9.0])


@BACKENDS
def test_it_stands_in_place_of_the_obstacles_of_a_vehicle(
    scene: str, backend: str, tmp_path: Path
) -> None:
    body = '<geom name="post" type="cylinder" size="0.3 2" pos="3 3 2"/><body name="drone"'
    craft = RACER.read_text().replace('<body name="racer"', body.replace("drone", "racer"), 1)
    assert "post" in craft
    vehicle = Vehicle.load(written(tmp_path, craft, "own.xml"))
    at = np.array([[[3.0, 3.0, 2.0]]])
    touching = []
    for chosen in ("plain", scene):
        world: Any = make_world(vehicle, 1, backend, scene=SceneConfig.parse(chosen))
        begin(world, position=at)
        touching.append(bool(world.state.touching[0, 0]))
    assert touching == [True, False]
    model = build_scene(vehicle.path, scene).compile()
    assert mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "post") == -1


def test_content_travels_with_the_config_and_files_do_not(scene: str) -> None:
    config = EnvConfig(env_id="rotorgram/Hover-v0", scene=scene, backend="rigid").resolve()
    there = EnvConfig.from_dict(json.loads(json.dumps(config.to_dict())))
    solids = Solids.of_scene(scene)
    os.unlink(scene)
    assert there == config
    assert there.digest == config.digest
    assert there.changed(history=2).scene == config.scene
    assert (Solids.of_scene(there.scene).table == solids.table).all()
    copy = SceneConfig.parse(path_of(there.scene))  # as commands name it where the file is not
    assert (Solids.of_scene(copy).table == solids.table).all()
    with pytest.raises(InputError, match=rf"^scene: {scene}: expected a file, got none"):
        EnvConfig(env_id="rotorgram/Hover-v0", scene=scene).resolve()


def test_the_digest_is_that_of_the_content(tmp_path: Path) -> None:
    def digest(content: str, name: str) -> str:
        scene = written(tmp_path, content, name)
        return EnvConfig(env_id="rotorgram/Hover-v0", scene=scene).digest

    first = digest(TOML, "a.toml")
    assert digest("# a comment\n" + TOML, "b.toml") == first
    assert digest(TOML.replace("[0, 0, 9]", "[0, 0, 8]"), "c.toml") != first


def test_a_simulator_of_its_own_flies_in_it_to_the_bit(scene: str) -> None:
    config = EnvConfig(env_id="rotorgram/Hover-v0", scene=scene, backend="rigid").resolve()
    os.unlink(scene)
    local = gym.make("rotorgram/Hover-v0", scene=config.scene, backend="rigid")
    with spawn_simulator(config) as remote, closing(local):
        assert remote.reset(seed=3)[0].tobytes() == local.reset(seed=3)[0].tobytes()
        for _ in range(5):
            action = np.zeros(local.action_space.shape, np.float32)
            assert remote.step(action)[0].tobytes() == local.step(action)[0].tobytes()


def test_a_relative_path_in_a_config_is_beside_it(tmp_path: Path) -> None:
    written(tmp_path, TOML, "yard.toml")
    path = written(tmp_path, 'env_id = "rotorgram/Hover-v0"\nscene = "yard.toml"\n', "run.toml")
    config = EnvConfig.from_keywords(**read_keywords(path)).resolve()
    assert config.scene.name == str(tmp_path / "yard.toml")


BOX = '{ kind = "box", size = [1, 1, 1] }'


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("obstacle = 3", r"obstacle: expected a list of tables, got 3"),
        ("wall = []", r"obstacle: expected some of obstacle, got 'wall'"),
        ('obstacle = [{ kind = "cone", size = [1] }]', r"obstacle.kind: expected 'sphere' or .*"),
        ('obstacle = [{ kind = "box", size = [1, 1] }]', r"obstacle: expected a size of 3 numb.*"),
        ('obstacle = [{ kind = "sphere", size = [nan] }]', r"obstacle.size: .* got \[nan\]"),
        ('obstacle = [{ kind = "sphere", size = [-1] }]', r"obstacle.size: .* got \[-1\]"),
        (f"obstacle = [{BOX[:-1]}, position = [0, inf, 0] }}]", r"obstacle.position: expected .*"),
        (f"obstacle = [{BOX[:-1]}, quaternion = [0, 0, 0, 0] }}]", r"obstacle.quaternion: .*all 0"),
        (f"obstacle = [{BOX[:-1]}, heading = 3 }}]", r"obstacle: expected some of .* 'heading'"),
        (f'obstacle = [{BOX[:-1]}, label = "a/b" }}]', r"obstacle.label: expected a word .*"),
        (f"obstacle = [{f'{BOX},' * 10_001}]", r"obstacle: expected at most 10000, got 10001"),
        ("obstacle = [" + "[" * 9_000, r"file: expected a TOML file, got wrong.toml: .*"),
        (b"\xff\xfe", r"file: expected a TOML file, got wrong.toml: 'utf-8' codec .*"),
        ("#" * 1_000_001, r"file: expected a TOML file of at most 1000000 bytes, got 1000001"),
    ],
)
def test_hostile_toml(tmp_path: Path, content: str | bytes, sentence: str) -> None:
    scene = written(tmp_path, content)
    with pytest.raises(InputError, match=rf"^scene: {scene}: {sentence}"):
        Solids.of_scene(scene)


MANY = "<replicate count='10000000' offset='1 0 0'><geom size='1'/></replicate>"
NESTED = "<replicate count='1000'><replicate count='1000'><geom size='1'/></replicate></replicate>"
CLOTH = "type='grid' count='3 3 1' dim='2' spacing='1 1 1'"
FIELD = "<asset><hfield name='h' nrow='{0}' ncol='{0}' size='1 1 1 1'/></asset>"


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (f"<worldbody>{MANY}</worldbody>", r"file: expected at most 10000 elements, got .*"),
        (f"<worldbody>{NESTED}</worldbody>", r"file: expected at most 10000 elements, got .*"),
        (FIELD.format(30_000), r"file: expected .* of at most .*"),
        (
            f"<worldbody><flexcomp name='f' {CLOTH}/></worldbody>",
            r"expected geoms alone, got the flex or plugin f",
        ),
        (
            "<worldbody><body><joint/><geom name='door' size='1'/></body></worldbody>",
            r"expected geoms that stand still, got door, which moves",
        ),
        (
            "<worldbody><body mocap='true'><geom size='1'/></body></worldbody>",
            r"expected geoms that stand still, got one without a name, which moves",
        ),
        ("<worldbody><geom size='nan'/></worldbody>", r"expected MJCF that MuJoCo reads, got: .*"),
        ("<worldbody><geom size='-1'/></worldbody>", r"expected MJCF that MuJoCo reads, got: .*"),
        ("<worldbody><geom size='9e9'/></worldbody>", r"scene: geom 0: obstacle: size: .*"),
        ("<worldbody>", r"expected MJCF that MuJoCo reads, got: .*"),
        ("<include file='/dev/zero'/>", r"file: expected files, got /dev/zero"),
        ("<include file='..'/>", r"file: expected files, got .*"),
        ("<include file='../no.xml'/>", r"expected MJCF that MuJoCo reads, got: .*"),
        ("<!--" + "x" * (1 << 23) + "-->", r"file: expected files of at most 8388608 bytes.*"),
    ],
)
def test_hostile_mjcf(tmp_path: Path, content: str, sentence: str) -> None:
    scene = written(tmp_path, f"<mujoco>{content}</mujoco>", "wrong.xml")
    with pytest.raises(InputError, match=rf"^scene: {scene}: {sentence}") as caught:
        Solids.of_scene(scene)
    assert "\n" not in str(caught.value)


def test_what_is_no_file(tmp_path: Path) -> None:
    folder = tmp_path / "world.toml"
    folder.mkdir()
    with pytest.raises(InputError, match=r"^scene: .*: expected a file, got another thing"):
        Solids.of_scene(str(folder))
    with pytest.raises(InputError, match=r"^scene: cannot read .*: File name too long"):
        Solids.of_scene("x" * 5000 + ".toml")
    with pytest.raises(InputError, match=r"^scene: expected content of a file alone, got .*forest"):
        SceneConfig(name="forest", content=TOML)
    with pytest.raises(InputError, match=r"^obstacle: expected a TOML file, got a text: "):
        Solids.of_scene(SceneConfig(name="world.toml", content="no text of a file"))
    with pytest.raises(InputError, match=r"^scene: expected .*, got world.toml with seeds \(3,\)"):
        SceneConfig(name="world.toml", seeds=(3,))


def test_a_file_without_obstacles_is_read_once(tmp_path: Path) -> None:
    scene = SceneConfig.parse(written(tmp_path, "obstacle = []\n", "none.toml")).embedded()
    (tmp_path / "none.toml").unlink()
    assert scene.content
    assert len(Solids.of_scene(scene.embedded())) == 1


def test_serve_refuses_a_file_that_is_missing(capsys: Capsys) -> None:
    sentence = "scene: nowhere.toml: expected a file, got none"
    assert sentence in refused(capsys, "serve", "pid", "--scene", "nowhere.toml")


def test_what_mjcf_has_beside_geoms_is_left_out(tmp_path: Path) -> None:
    content = """<mujoco><worldbody>
      <body name="door"><joint name="hinge"/><site name="s"/>
      <geom name="g" size="1" contype="0" conaffinity="0"/></body>
      <site name="t"/><geom name="wall" type="box" size="1 1 1" pos="5 0 1"/>
    </worldbody>
    <contact><pair geom1="g" geom2="wall"/></contact>
    <tendon><spatial name="rope"><site site="s"/><geom geom="g"/><site site="t"/></spatial></tendon>
    <actuator><motor tendon="rope"/></actuator>
    <sensor><tendonpos tendon="rope"/></sensor></mujoco>"""
    scene = written(tmp_path, content, "door.xml")
    assert Solids.of_scene(scene).standing().distance((3.0, 0.0, 1.0)) == pytest.approx(1.0)


@pytest.mark.parametrize("ending", ["toml", "xml"])
def test_the_file_of_the_page(tmp_path: Path, ending: str) -> None:
    page = (Path(__file__).parents[2] / "docs" / "solids.md").read_text("utf-8")
    block = page.partition(f"```{ending}\n")[2].partition("```")[0]
    scene = written(tmp_path, block, f"my_world.{ending}")
    counts = {"toml": 5, "xml": 6}
    assert len(Solids.of_layout(SceneConfig.parse(scene), 0)) == counts[ending]


@pytest.mark.parametrize("tag", ["include", 'asset><model name="m"'])
def test_a_file_that_includes_itself_is_refused(tmp_path: Path, tag: str) -> None:
    closing = "</asset>" if tag.startswith("asset") else ""
    file = tmp_path / "a.xml"
    box = '<worldbody><geom type="box" size="1 1 1"/></worldbody>'
    file.write_text(f'<mujoco><{tag} file="a.xml"/>{closing}{box}</mujoco>')
    with pytest.raises(InputError, match="expected files that do not include themselves, got"):
        Solids.of_scene(str(file))


def test_an_ellipsoid_is_refused(tmp_path: Path) -> None:
    content = "<mujoco><worldbody><geom type='ellipsoid' size='1 1 1' pos='0 0 9'/></worldbody>"
    scene = written(tmp_path, content + "</mujoco>", "ball.xml")
    with pytest.raises(InputError, match=r"ball.xml: .*expected sphere, .*, got the ellipsoid"):
        Solids.of_scene(scene)
