"""Pictures of cameras against rays, known points, known areas, MuJoCo's drawing."""

import gc
import math
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from capture import Lens, lens_of
from pictures import TABLES
from rotorgram.envs.spec import Mark
from rotorgram.models import InputError
from rotorgram.models.cameras import FARTHEST, Camera, chosen_views
from rotorgram.models.errors import NoOpenGL
from rotorgram.models.export import export_mjcf
from rotorgram.models.fleet import load_vehicles
from rotorgram.models.library import vehicle_names
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering.cameras import Cameras, drawn_model, objects_in
from rotorgram.rendering.gl import offscreen_context
from rotorgram.scenes import Layouts, Rays, Solids, seeded_scenes
from rotorgram.sim.rotations import to_world

BELLY = """
[[cameras]]
name = "belly"
position = [0.0, 0.0, -0.02]
look = [0.5, 0.0, -1.0]
up = [1.0, 0.0, 0.0]
resolution = [48, 32]
fovy = 1.0
rate = 0.5
kinds = ["depth", "rgb"]

[[cameras]]
name = "tower"
position = [0.3, -0.4, 1.2]
look = [-0.3, 0.4, -0.2]
stands = true
"""
TILTED = np.array([math.cos(0.2), math.sin(0.2), 0.0, 0.0])  # 0.4 rad about x


def vehicle_with(folder: Path, tables: str) -> Vehicle:
    own = Vehicle.load("crazyflie2").path.read_text("utf-8")
    file = folder / "own.toml"
    file.write_text(own + tables, "utf-8")
    return Vehicle.load(file)


def paper_with(folder: Path, before: str, custom: str = "") -> Path:
    """The paper's MJCF file with more before its first camera, and with custom texts."""
    text = Vehicle.load().path.read_text("utf-8")
    text = text.replace("<camera ", f"{before}<camera ", 1)
    text = text.replace("</mujoco>", f"<custom>{custom}</custom></mujoco>")
    file = folder / "own.xml"
    file.write_text(text, "utf-8")
    return file


def state(*places: Any, quaternion: Any = (1.0, 0.0, 0.0, 0.0), **more: Any) -> dict[str, Any]:
    turns = np.broadcast_to(np.asarray(quaternion), (len(places), 4))
    return {"position": np.array(places), "quaternion": turns, **more}


def take(cameras: Cameras, **told: Any) -> dict[str, np.ndarray]:
    everybody = np.ones(len(told["position"]), bool)
    cameras.take(dict.fromkeys(cameras.pictures, everybody), told)
    return {name: picture.copy() for name, picture in cameras.pictures.items()}


@pytest.fixture
def made(opengl: None) -> Iterator[Any]:
    """Makes cameras, and closes them."""
    opened: list[Cameras] = []

    def make(words: str, vehicle: Any = None, shape: tuple[int, int] = (1, 1), **more: Any) -> Any:
        craft = vehicle if isinstance(vehicle, Vehicle) else Vehicle.load(vehicle)
        views = chosen_views(words.split(), craft.cameras)
        opened.append(Cameras(craft, views, shape, **more))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


# ---- files and words


def test_cameras_of_a_toml_file(tmp_path: Path) -> None:
    vehicle = vehicle_with(tmp_path, BELLY)
    named = {camera.name: camera for camera in vehicle.cameras}
    assert {*named} == {"belly", "tower", "front", "down"}
    belly = named["belly"]
    tower = named["tower"]
    assert belly.resolution == (48, 32)
    assert belly.every == 2
    assert belly.kinds == ("rgb", "depth")
    assert belly.fovy == pytest.approx(1.0, rel=1e-6)
    assert belly.position == (0.0, 0.0, -0.02)
    assert belly.look == pytest.approx((0.5 / math.sqrt(1.25), 0.0, -1 / math.sqrt(1.25)))
    assert not belly.stands
    assert tower.stands
    assert tower.position == (0.3, -0.4, 1.2)
    assert Vehicle.load("crazyflie2").hash != vehicle.hash


def test_cameras_of_an_mjcf_file(tmp_path: Path) -> None:
    eye = '<camera name="eye" pos="0.5 0 0" resolution="40 30" output="rgb segmentation"/>'
    rate = '<text name="rotorgram/cameras.eye.rate" data="0.25"/>'
    file = paper_with(tmp_path, eye, rate)
    named = {camera.name: camera for camera in Vehicle.load(file).file_cameras}
    assert {*named} == {"eye", "chase", "portrait"}  # the others are those of quad.xml
    eye = named["eye"]
    assert eye.resolution == (40, 30)
    assert eye.every == 4
    assert eye.kinds == ("rgb", "segmentation")
    assert eye.look == (0.0, 0.0, -1.0)  # MuJoCo's: along -z
    assert eye.up == (0.0, 1.0, 0.0)
    file = paper_with(tmp_path, eye, rate.replace("cameras.eye", "cameras.ear"))
    with pytest.raises(InputError, match=r"cameras.ear.rate: expected a camera of that name"):
        Vehicle.load(file)


@pytest.mark.parametrize(
    "words",
    [
        'name="flat" projection="orthographic" fovy="6"',
        'name="turning" mode="targetbody" target="world"',
        'name="../out"',
        'name="a@b"',
        "",
    ],
)
def test_cameras_that_are_left_out(made: Any, tmp_path: Path, words: str) -> None:
    file = paper_with(tmp_path, f"<camera {words}/>")
    assert [one.name for one in Vehicle.load(file).file_cameras] == ["chase", "portrait"]
    cameras = made("front", file, shape=(1, 2))
    seen = take(cameras, **state((0.0, 0.0, 3.0), (4.0, 0.0, 3.0)))
    assert seen["front"].std() > 1


@pytest.mark.parametrize(("lens", "sentence"), TABLES["wrong_mjcf_cameras"])
def test_wrong_cameras_of_an_mjcf_file(tmp_path: Path, lens: str, sentence: str) -> None:
    file = paper_with(tmp_path, f'<camera name="eye" resolution="40 30" {lens}/>')
    with pytest.raises(InputError, match=sentence):
        Vehicle.load(file)


def test_what_is_exported_has_its_cameras(made: Any, tmp_path: Path) -> None:
    craft = vehicle_with(tmp_path, BELLY)
    export_mjcf(craft.path, tmp_path / "own.xml")
    same = Vehicle.load(tmp_path / "own.xml")
    for ours, theirs in zip(craft.cameras, same.cameras, strict=True):
        for one in fields(Camera):
            value = getattr(ours, one.name)
            if one.name in ("position", "look", "up", "fovy"):
                value = pytest.approx(value, abs=1e-5)
            assert getattr(theirs, one.name) == value
    seen = take(made("belly", same), **state((0.0, 0.0, 1.0)))
    assert seen["belly"].std() > 1


def test_every_vehicle_has_two() -> None:
    front, down = Vehicle.load("crazyflie2").cameras
    assert front.name == "front"
    assert front.look == (1.0, 0.0, 0.0)
    assert down.name == "down"
    assert down.look == (0.0, 0.0, -1.0)
    assert down.up == (1.0, 0.0, 0.0)


@pytest.mark.parametrize(("old", "new", "sentence"), TABLES["wrong_cameras"])
def test_wrong_cameras_of_a_file(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert old in BELLY
    with pytest.raises(InputError, match=sentence):
        vehicle_with(tmp_path, BELLY.replace(old, new))


def test_words_choose_views(tmp_path: Path) -> None:
    cameras = vehicle_with(tmp_path, BELLY).cameras
    views = chosen_views(["belly", "front_depth@20x10", "down_segmentation"], cameras)
    told = [(view.name, view.shape, view.dtype) for view in views]
    assert told == [
        ("belly", (32, 48, 3), "uint8"),
        ("belly_depth", (32, 48, 1), "float32"),
        ("front_depth", (10, 20, 1), "float32"),
        ("down_segmentation", (64, 64, 1), "int32"),
    ]
    for word, sentence in TABLES["wrong_words"]:
        with pytest.raises(InputError, match=sentence):
            chosen_views([word], cameras)
    assert len(chosen_views(["front", "front_rgb", "belly", "belly_depth"], cameras)) == 3
    with pytest.raises(InputError, match="expected each picture in one size, got 'front' in two"):
        chosen_views(["front", "front_rgb@8x8"], cameras)


# ---- pictures


def test_depth_is_that_of_rays(made: Any) -> None:
    """1,000 pixels, over ground and another craft, against MuJoCo's rays."""
    cameras = made("chase_depth@160x120", shape=(1, 2))
    told = state((0.0, 0.0, 3.0), (-1.5, 0.4, 3.4), quaternion=TILTED)
    depth = take(cameras, **told)["chase_depth"][0, ..., 0]
    lens = lens_of(cameras, cameras.views[0])
    dice = np.random.default_rng(3)
    rows = dice.integers(120, size=1000)
    columns = dice.integers(160, size=1000)
    model = cameras.model
    data = cameras.data
    eye = -lens.rotation.T @ lens.translation
    groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    errors = []
    seen = []
    hit = np.zeros(1, np.int32)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        ray = np.linalg.solve(lens.matrix, (column + 0.5, row + 0.5, 1.0))  # 1 m of depth
        way = lens.rotation.T @ ray
        length = mujoco.mj_ray(model, data, eye, way, groups, True, -1, hit)
        if length < 0 or length > FARTHEST:
            assert depth[row, column] == pytest.approx(FARTHEST, rel=1e-5)
            continue
        errors.append(abs(depth[row, column] / length - 1.0))
        seen.append(int(hit[0]))
    ground = np.array(seen) == model.geom("scene/floor").id
    of_ground = np.array(errors)[ground]
    of_craft = np.array(errors)[~ground]
    assert 100 < len(of_craft) < len(of_ground)
    assert of_ground.max() < 1e-4
    assert np.median(of_craft) < 1e-4
    # Edges of round shapes, which OpenGL draws with flat sides.
    assert np.mean(of_craft < 0.01) > 0.97


def pixels_of(lens: Lens, points: np.ndarray) -> np.ndarray:
    """Columns and rows of points of the world, shape (..., 3), m: shape (..., 2), pixels."""
    seen = points @ lens.rotation.T + lens.translation
    return np.asarray((seen / seen[..., 2:] @ lens.matrix.T)[..., :2])


@pytest.mark.parametrize(
    "lens",
    [
        'fovy="38"',
        'resolution="320 240" sensorsize=".0064 .0048" focal=".0075 .0065" '
        'principal=".0004 -.0003"',
    ],
    ids=["fovy", "intrinsics"],
)
def test_known_points_come_to_their_pixels(made: Any, tmp_path: Path, lens: str) -> None:
    """Rotor tips, drawn as small balls, by their colour; half a pixel."""
    paper = Vehicle.load()
    text = paper.path.read_text("utf-8")
    tips = [np.add(rotor.position, (0.0, 0.0, 0.3)) for rotor in paper.rotors]
    balls = "".join(
        f'<geom type="sphere" size="0.04" pos="{x} {y} {z}" rgba="1 0 1 1" mass="0" contype="0" '
        'conaffinity="0"/>'
        for x, y, z in tips
    )
    start = text.index("<camera ")
    text = text[:start] + balls + text[start:].replace('fovy="38"', lens)
    file = tmp_path / "tips.xml"
    file.write_text(text, "utf-8")
    cameras = made("portrait@320x240", file)
    told = state((1.0, 2.0, 5.0), quaternion=TILTED)
    picture = take(cameras, **told)["portrait"][0].astype(int)
    red, green, blue = np.moveaxis(picture, 2, 0)
    pink = (red > 2 * green) & (blue > 2 * green)
    places = np.argwhere(pink)[:, ::-1] + 0.5
    lens = lens_of(cameras, cameras.views[0])
    for tip in tips:
        point = told["position"][0] + to_world(TILTED, tip)
        pixel = pixels_of(lens, point)
        near = np.linalg.norm(places - pixel, axis=1) < 8
        assert near.sum() > 6
        assert np.abs(places[near].mean(axis=0) - pixel).max() < 0.5


@pytest.mark.parametrize("scene", seeded_scenes())
def test_depth_is_that_of_rays_among_solids(made: Any, scene: str) -> None:
    """Without MuJoCo's rays: what is seen is what is solid, but in pixels on edges."""
    cameras = made("front_depth@96x72", "crazyflie2", scene=f"{scene}:3")
    told = state((3.0, -2.0, 4.0), quaternion=TILTED)
    depth = take(cameras, **told)["front_depth"][0, ..., 0]
    lens = lens_of(cameras, cameras.views[0])
    rows, columns = np.mgrid[:72, :96] + 0.5
    pixels = np.stack((columns, rows, np.ones_like(rows)), axis=-1)
    ahead = pixels @ np.linalg.inv(lens.matrix).T @ lens.rotation  # 1 m of depth each
    eye = -lens.rotation.T @ lens.translation
    scenery = Layouts.of(Solids.of_scene(f"{scene}:3"))
    found = Rays(ahead, reach=100.0).cast(scenery, eye, (1.0, 0.0, 0.0, 0.0))[0]
    found = found / np.linalg.norm(ahead, axis=-1)
    near = found < 30.0
    errors = abs(found / depth - 1.0)[near]
    assert near.mean() > 0.3
    assert np.median(errors) < 3e-4
    assert (errors < 5e-3).mean() > 0.97  # balls are drawn with corners


def test_points_of_a_depth_picture_lie_on_the_ground(made: Any) -> None:
    cameras = made("down_depth@32x24", "crazyflie2")
    told = state((0.3, 0.2, 2.0), quaternion=TILTED)
    depth = take(cameras, **told)["down_depth"][0, ..., 0]
    lens = lens_of(cameras, cameras.views[0])
    rows, columns = np.indices(depth.shape) + 0.5
    rays = np.stack((columns, rows, np.ones(depth.shape)), axis=-1)
    seen = rays @ np.linalg.inv(lens.matrix).T * depth[..., None]
    points = (seen - lens.translation) @ lens.rotation
    assert np.abs(points[..., 2]).max() < 1e-3


def test_segmentation_knows_the_pad_by_its_area(made: Any) -> None:
    """A disc of 0.5 m below a camera at 2 m: π (r f / h)² pixels."""
    craft = Vehicle.load("crazyflie2")
    pad = Mark(shape="disc", size=0.5, moves=True)
    cameras = made("down_segmentation@128x128", craft, marks=[pad])
    assert cameras.objects == ("nothing", "scene/floor", "drone_0", "task/disc_0 of drone_0")
    assert objects_in(drawn_model(craft, 1, "plain", [pad], payload=False))[0] == cameras.objects
    told = state((0.0, 0.0, 2.0), goal=np.array([[0.1, 0.2, 0.0]]))
    picture = take(cameras, **told)["down_segmentation"][0, ..., 0]
    assert set(np.unique(picture)) <= {1, 2, 3}
    lens = lens_of(cameras, cameras.views[0])
    thick = 0.04 * craft.rest_height
    height = 2.0 - 0.75 * craft.rest_height - thick  # of the camera over the disc's upper side
    expected = math.pi * (0.5 * lens.matrix[0, 0] / height) ** 2
    disc = np.argwhere(picture == 3)
    assert len(disc) == pytest.approx(expected, rel=0.02)
    middle = disc.mean(axis=0)[::-1] + 0.5
    projected = pixels_of(lens, np.array([0.1, 0.2, thick]))
    assert np.abs(middle - projected).max() < 0.5


@pytest.mark.parametrize("name", vehicle_names())
def test_down_sees_the_ground_on_which_a_craft_stands(made: Any, name: str) -> None:
    craft = Vehicle.load(name)
    pad = Mark(shape="disc", size=4 * craft.radius, moves=True)
    cameras = made("down_depth down_segmentation", craft, marks=[pad])
    goal = np.zeros((1, 3))
    seen = take(cameras, **state((0.0, 0.0, craft.rest_height), goal=goal))
    assert (seen["down_segmentation"] == cameras.objects.index("task/disc_0 of drone_0")).all()
    assert seen["down_depth"].max() < craft.rest_height


def test_colours_are_what_mujoco_draws_of_each_camera_alone(made: Any) -> None:
    cameras = made("front@80x60 down@80x60", shape=(1, 2))
    told = state((0.0, 0.0, 3.0), (6.0, 0.5, 3.5), quaternion=TILTED)
    pictures = take(cameras, **told)
    model, scene = cameras.model, mujoco.MjvScene(cameras.model, 10_000)
    scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = False
    gl = offscreen_context(80, 60)
    rect = mujoco.MjrRect(0, 0, 80, 60)
    with gl.as_current():
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        for name, drone in (("front", 0), ("down", 0), ("front", 1)):
            view = mujoco.MjvCamera()
            every = mujoco.mjtCatBit.mjCAT_ALL
            view.type = mujoco.mjtCamera.mjCAMERA_FIXED
            view.fixedcamid = model.camera(f"drone_{drone}/{name}").id
            option = mujoco.MjvOption()
            for _ in range(2):  # the first lays the floor around the camera before this one
                mujoco.mjv_updateScene(model, cameras.data, option, None, view, every, scene)
            mujoco.mjr_render(rect, scene, context)
            pixels = np.zeros((60, 80, 3), np.uint8)
            mujoco.mjr_readPixels(pixels, None, rect, context)
            assert len(np.unique(pixels)) > 20
            assert (pixels[::-1] == pictures[name][drone]).all()
        context.free()
    gl.free()


def test_one_that_stands_sees_all_drones_alike(made: Any, tmp_path: Path) -> None:
    cameras = made("tower_segmentation", vehicle_with(tmp_path, BELLY), shape=(2, 2))
    places = (0.0, 0.0, 1.0), (0.2, 0.2, 1.0), (0.0, 0.0, 1.0), (-0.1, 0.0, 0.8)
    pictures = take(cameras, **state(*places))["tower_segmentation"]
    assert (pictures[0] == pictures[1]).all()
    assert (pictures[2] == pictures[3]).all()
    assert (pictures[0] != pictures[2]).any()
    drones = {cameras.objects.index("drone_0"), cameras.objects.index("drone_1")}
    assert drones < set(np.unique(pictures[0]))


def test_a_picture_is_taken_where_it_is_due(made: Any) -> None:
    cameras = made("down", "crazyflie2", shape=(2, 1))
    before = take(cameras, **state((0.0, 0.0, 1.0), (0.0, 0.0, 1.0)))["down"]
    told = state((0.3, 0.0, 2.0), (0.3, 0.0, 2.0))
    cameras.take({"down": np.array([True, False])}, told)
    assert (cameras.pictures["down"][0] != before[0]).any()
    assert (cameras.pictures["down"][1] == before[1]).all()


def test_different_vehicles_in_one_world(made: Any, tmp_path: Path) -> None:
    """Each draws from as near as the smallest needs; `down` of each is its own."""
    fleet = load_vehicles("crazyflie2,paper", 2)
    cameras = made("down_depth down_segmentation", fleet, shape=(1, 2))
    small = Vehicle.load("crazyflie2")
    large = Vehicle.load()
    told = state((0.0, 0.0, small.rest_height), (3.0, 0.0, large.rest_height))
    seen = take(cameras, **told)
    for number, craft in enumerate((small, large)):
        picture = seen["down_depth"][number, ..., 0]
        expected = 0.25 * craft.rest_height
        assert picture == pytest.approx(expected, rel=1e-3)
    assert (seen["down_segmentation"] == cameras.objects.index("scene/floor")).all()


def test_a_camera_sees_through_its_own_discs(made: Any, tmp_path: Path) -> None:
    """And not through those of others: above each of two craft is an eye, and one stands."""
    eye = (
        '[[cameras]]\nname = "eye"\nposition = [0.0, 0.0, 0.2]\nlook = [0, 0, -1]\nfovy = 1.0\n'
        '[[cameras]]\nname = "lamp"\nposition = [0.0, 0.0, 1.2]\nlook = [0, 0, -1]\nfovy = 1.0\n'
        "stands = true\n"
    )
    craft = vehicle_with(tmp_path, eye)
    words = "eye@128x128 eye_segmentation@128x128 lamp_segmentation@128x128 lamp@128x128"
    cameras = made(words, craft, shape=(1, 2))
    seen = take(cameras, **state((0.0, 0.0, 1.0), (5.0, 0.0, 1.0)))
    own = (seen["eye_segmentation"][0] == 2).sum()
    lamp = (seen["lamp_segmentation"][0] == 2).sum()
    assert cameras.objects[2] == "drone_0"
    assert lamp > 1.5 * own > 100  # with and without discs, from one place
    apart = np.abs(seen["eye"][0].astype(int) - seen["lamp"][0])
    assert apart.max() <= 1  # colours have them
    second = (seen["eye_segmentation"][1] == 3).sum()
    assert second == own


def test_cameras_after_their_end(made: Any) -> None:
    cameras = made("down", "crazyflie2")
    take(cameras, **state((0.0, 0.0, 1.0)))
    cameras.close()
    with pytest.raises(NoOpenGL, match="expected cameras that are open, got closed ones"):
        take(cameras, **state((0.0, 0.0, 1.0)))


def test_cameras_that_nobody_closes_free_their_own_objects_alone(made: Any) -> None:
    """Also when garbage is collected while others draw; their objects have the same numbers."""
    cameras = made("down", "crazyflie2")
    pose = state((0.0, 0.0, 1.0))
    before = take(cameras, **pose)["down"]
    forgotten = [Cameras(Vehicle.load("crazyflie2"), cameras.views)]
    take(forgotten[0], **pose)
    forgotten.append(forgotten)  # a cycle
    with cameras._drawing.current():
        del forgotten
        gc.collect()
        assert (take(cameras, **pose)["down"] == before).all()


def test_a_camera_can_be_told_apart_from_its_kind() -> None:
    cameras = [Camera(name="a_depth"), Camera(name="a", kinds=("depth",))]
    assert [view.name for view in chosen_views(["a_depth"], cameras)] == ["a_depth"]
