"""Height fields: by hand, against MuJoCo's, in files, and flown over."""

import struct
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco import MjSpec, mjtGeom
from PIL import Image
from rotorgram.models import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.scenes import Layouts, Rays, SceneConfig, Solids, kernels
from rotorgram.sim import make_world
from worlds import ball_craft, begin

ROOF = """
[[obstacle]]
kind = "hfield"
size = [4, 2, 1]
position = [10, 0, 3]
heights = [[0, 2, 0], [0, 2, 0]]
"""
TURN = (0.9, 0.2, 0.1, 0.3)


def roof(tmp_path: Path) -> SceneConfig:
    """A roof of 8 m by 4 m, 4 m above the ground at its eaves and 5 m at its ridge."""
    file = tmp_path / "roof.toml"
    file.write_text(ROOF)
    return SceneConfig.parse(str(file))


def random_field(dice: np.random.Generator, turn: tuple[float, ...]) -> mujoco.MjModel:
    """7 by 11 random heights up to 2.5 m."""
    spec = MjSpec()
    heights = dice.random(77)
    heights[:2] = 0.0, 1.0
    spec.add_hfield(name="h", size=(6, 4, 2.5, 0.7), nrow=7, ncol=11, userdata=heights)
    place: Any = {"pos": (0.3, 0.2, 0.5), "quat": turn}
    spec.worldbody.add_geom(name="it", type=mjtGeom.mjGEOM_HFIELD, hfieldname="h", **place)
    return spec.compile()


def test_distances_from_a_roof(tmp_path: Path) -> None:
    """Its halves have a slope of 2 in 4: 1 m across the slope is 0.894 m up from it."""
    solids = Solids.of_scene(roof(tmp_path)).standing()
    slope = np.array((-1.0, 0.0, 2.0)) / np.sqrt(5.0)
    for way in (0.3, 0.9):
        assert solids.distance((8.0, 0.0, 4.0) + way * slope) == pytest.approx(way, abs=1e-9)
        assert solids.distance((8.0, 0.0, 4.0) - way * slope) == pytest.approx(-way, abs=1e-9)
    assert solids.distance((10.0, 0.0, 5.5)) == pytest.approx(0.5, abs=1e-9)  # over the ridge
    assert solids.distance((4.0, 0.0, 2.5)) == pytest.approx(2.0, abs=1e-9)  # beside its wall
    assert solids.distance((10.0, 0.0, 1.0)) == pytest.approx(1.0, abs=1e-9)  # below it
    assert 10.0 < solids.distance((10.0, 0.0, 20.0)) <= 15.0  # a lower bound


def test_rays_at_a_roof(tmp_path: Path) -> None:
    layouts = Layouts.of(Solids.of_scene(roof(tmp_path)).standing())
    ways = [[(0, 0, -1), (1, 0, 0), (1, 0, -0.5), (0, 0, 1), (-1, 0, 0)]]
    found = Rays(ways).cast(layouts, [8.0, 0.5, 9.0], [1.0, 0.0, 0.0, 0.0]).ravel()
    assert found == pytest.approx([5.0, 20.0, 20.0, 20.0, 20.0])
    beside = Rays(ways).cast(layouts, [0.0, 0.5, 3.5], [1.0, 0.0, 0.0, 0.0]).ravel()
    assert beside[1] == pytest.approx(7.0)  # 3.5 m high the roof begins 1 m behind its eaves
    within = Rays(ways).cast(layouts, [10.0, 0.5, 3.0], [1.0, 0.0, 0.0, 0.0]).ravel()
    assert within == pytest.approx([1.0, 4.0, 2.0 * np.sqrt(1.25), 2.0, 4.0])


@pytest.mark.parametrize("turn", [(1.0, 0.0, 0.0, 0.0), TURN])
def test_rays_are_mujocos_and_numba_has_the_bits_of_numpy(
    turn: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    dice = np.random.default_rng(4)
    model = random_field(dice, turn)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solids = Solids.of_model(model)
    places = dice.uniform((-8, -8, -1), (8, 8, 6), (40, 3)).astype(np.float32)
    places = places[solids.distance(places) > 0.0]
    rays = Rays.rings(8, 32, -60.0, 40.0)
    level = np.tile((1.0, 0.0, 0.0, 0.0), (len(places), 1))
    layouts = Layouts.of(solids)
    found = rays.cast(layouts, places, level)
    for place, row in zip(places.astype(float), found, strict=True):
        for ray, ours in zip(rays.directions.reshape(-1, 3), row.ravel(), strict=True):
            theirs = mujoco.mj_ray(model, data, place, ray, None, 1, -1, np.zeros(1, np.int32))
            assert ours == pytest.approx(theirs if 0.0 <= theirs < 20.0 else 20.0, abs=2e-4)
    assert 0.1 < (found < 20.0).mean() < 0.5
    points = dice.uniform((-8, -8, -1), (8, 8, 6), (1, 200, 3)).astype(np.float32)
    due = np.ones((1, 200), bool)
    code = kernels.compiled()
    assert code
    near = np.zeros((2, 1, 200), np.float32)
    still = np.zeros(2, np.float32)
    both = Layouts.of(Solids.ground() + solids)
    code.gaps(*both, np.zeros(1, np.int64), points, due, *still, near[0])
    kernels.gaps_by_numpy(*both, np.zeros(1, np.int64), points, due, *still, near[1])
    assert near[0].tobytes() == near[1].tobytes()
    monkeypatch.setattr(kernels, "compiled", lambda: None)
    assert rays.cast(layouts, places, level).tobytes() == found.tobytes()


@pytest.fixture
def ball(tmp_path: Path) -> Vehicle:
    """A craft whose only solid geom is a ball about its origin, of 0.15 m."""
    return ball_craft(tmp_path)


@pytest.mark.parametrize("backend", ["rigid", "mujoco"])
@pytest.mark.parametrize("layouts", ["1", "new", "4-5"])
def test_touch_contact_and_rays_agree_along_hills(
    ball: Vehicle, layouts: str, backend: str
) -> None:
    """Within 1 mm, at places where the hills are nearest."""
    seed = 1 if layouts == "1" else 4
    scene = SceneConfig.parse(f"hills:{seed}")
    solids = Solids.of_layout(scene, seed)
    dice = np.random.default_rng(seed)
    points = dice.uniform((-40, -40, 0.5), (40, 40, 8.0), (60_000, 3))
    is_land = np.array(["/ground" in name for name in solids.names])
    land = Solids.of_scene(scene)
    gap = land.distance(points)
    near = points[abs(gap - 0.15) < 0.01]
    assert len(near) > 60
    assert is_land.sum() == 1
    given = SceneConfig.parse(f"hills:{layouts}")
    if layouts != "1" and backend == "mujoco":
        with pytest.raises(
            InputError, match=rf"fields on mujoco in one layout, .*hills:{layouts}$"
        ):
            make_world(ball, 1, backend, scene=given)
        return
    world: Any = make_world(ball, len(near), backend, scene=given)
    begin(world, position=np.full((len(near), 1, 3), (0.0, 0.0, 50.0)))
    assert not world.state.touching.any()
    if world.scenery.varies:
        world.scenery.take(np.full(len(near), seed))
        world.random.begin = lambda mask: None
        world.scenery.begin = lambda random, mask: None
    begin(world, position=near[:, None])
    gap = land.distance(near) - 0.15
    sure = abs(gap) > 1e-3
    assert (world.state.touching[sure, 0] == (gap[sure] < 0)).all()
    assert 0 < (gap[sure] < 0).sum() < sure.sum()
    assert world.clearance()[:, 0] == pytest.approx(gap, abs=1e-4)
    level = np.tile((1.0, 0.0, 0.0, 0.0), (len(near), 1))
    rays = Rays.rings(24, 48, -89.0, 89.0)  # no solid is nearer than the distance
    least = rays.cast(Layouts.of(land), near, level).min(axis=(1, 2))
    assert (least > gap + 0.15 - 1e-3).all()
    assert (least < gap + 0.15 + 0.02).all()


def test_craft_starts_on_level_ground_and_hills_have_their_height() -> None:
    for seed in range(3):
        scene = SceneConfig.parse(f"hills:{seed},height=5,size=60x70")
        hills = Solids.of_layout(scene, seed)
        grid = hills.grids[0] + hills.centers[0, 2]
        assert grid.max() == pytest.approx(5.0)
        assert grid[[0, -1]].max() == grid[:, [0, -1]].max() == pytest.approx(-1.0)
        assert hills.distance((0.0, 0.0, 0.5)) > 1.0
    for seed in range(200):
        small = Solids.of_layout(SceneConfig.parse("hills:0,size=32x32"), seed)
        assert np.isfinite(small.table).all()
        assert small.grids[0].max() + small.centers[0, 2] <= 8.0 + 1e-9
    large = Solids.of_layout(SceneConfig.parse("hills:0,size=400x400"), 0)
    assert large.grids[0].shape == (251, 251)
    with pytest.raises(InputError, match=r"^scene: expected sides of at least 32 m, got 20 m"):
        SceneConfig.parse("hills:1,size=20x60")


MJCF = """
<mujoco>
  <asset><hfield name="land" nrow="2" ncol="3" size="4 2 2 1" {asset}/></asset>
  <worldbody><geom type="hfield" hfield="land" pos="10 0 3"/></worldbody>
</mujoco>
"""


def test_a_users_mjcf_has_the_distances_of_the_toml(tmp_path: Path) -> None:
    file = tmp_path / "land.xml"
    file.write_text(MJCF.format(asset='elevation="0 2 0 0 2 0"'))
    points = np.random.default_rng(0).uniform((4, -3, 0), (16, 3, 8), (100, 3))
    own = Solids.of_scene(str(file))
    assert own.distance(points) == pytest.approx(Solids.of_scene(roof(tmp_path)).distance(points))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ('size=[4,2,1]', "expected heights of an hfield alone, got a hfield"),
        ('size=[4,2,1]\nheights=[[0,1],[2]]', "heights: expected 2 or more rows of as many"),
        ('size=[4,2,1]\nheights=[[0,nan],[2,0]]', "heights: expected 2 or more rows of as many"),
        ('size=[4,2,1]\nheights=[[0,1]]', "heights: expected 2 or more rows of as many numbers"),
        ('size=[4,2,1]\nheights=[[0,1],[-2,0]]', "expected heights above the depth of the field"),
    ],
)  # fmt: skip
def test_wrong_fields_of_a_file(tmp_path: Path, content: str, sentence: str) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(f'[[obstacle]]\nkind="hfield"\n{content}\n')
    with pytest.raises(InputError, match=sentence):
        Solids.of_scene(str(file))


def test_pictures_of_heights_are_refused_before_they_are_read(tmp_path: Path) -> None:
    header = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", 60_000, 60_000)
    (tmp_path / "land.png").write_bytes(header + b"\x08\0\0\0\0" + bytes(40))
    file = tmp_path / "land.xml"
    png = '<mujoco><asset><hfield name="land" file="land.png" size="4 2 2 1"/></asset></mujoco>'
    file.write_text(png)
    with pytest.raises(InputError, match=r"at most 65536 heights, got 60000 x 60000"):
        Solids.of_scene(str(file))
    file.write_text(MJCF.format(asset="").replace('"2" ncol="3"', '"300" ncol="300"'))
    with pytest.raises(InputError, match=r"at most 65536 heights, got 300 x 300"):
        Solids.of_scene(str(file))


def test_a_picture_of_heights(tmp_path: Path) -> None:
    rows = np.array([[0, 255, 0], [0, 255, 0]], np.uint8)
    Image.fromarray(rows).save(tmp_path / "land.png")
    file = tmp_path / "land.xml"
    words = MJCF.format(asset="").replace('nrow="2" ncol="3"', 'file="land.png"')
    file.write_text(words)
    points = np.random.default_rng(0).uniform((4, -3, 0), (16, 3, 8), (100, 3))
    own = Solids.of_scene(str(file))
    assert own.distance(points) == pytest.approx(Solids.of_scene(roof(tmp_path)).distance(points))
