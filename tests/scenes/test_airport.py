"""The airport alone; test_scenery.py has what it shares with the scenes of a seed."""

import math
from contextlib import closing
from itertools import combinations

import mujoco
import numpy as np
import pytest
from rotorgram.models import Vehicle
from rotorgram.models.cameras import chosen_views
from rotorgram.rendering.cameras import Cameras
from rotorgram.scenes import AIRPORT_XML, add_scene, build_scene

OTHER = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1"/>
    <geom name="wall" type="plane" size="2 2 1" pos="2 0 0" euler="0 -90 0"/>
    <geom name="deck" type="plane" size="1 1 1" pos="0 0 0.5" contype="0" conaffinity="0"/>
    <body pos="0.3 0.2 1" euler="20 30 40">
      <freejoint/>
      <geom type="box" size="0.1 0.15 0.2"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_scene(scene="airport").compile()


@pytest.fixture(scope="module")
def airport(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the airport's geoms: all that the world body has beside the scene's floor."""
    ours = model.geom_bodyid == 0
    ours[model.geom("scene/floor").id] = False
    return np.flatnonzero(ours)


def other_at_the_airport() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(OTHER)
    add_scene(spec, "airport")
    return spec.compile()


def test_only_the_floor_is_hidden() -> None:
    model = other_at_the_airport()
    assert [model.geom(name).group[0] for name in ("floor", "wall", "deck")] == [3, 0, 0]
    assert model.geom("floor").contype[0] == 1


def test_the_scenes_own_scale_stays(model: mujoco.MjModel) -> None:
    plain = build_scene().compile()
    other = mujoco.MjSpec.from_string(OTHER).compile()
    for alone, there in ((plain, model), (other, other_at_the_airport())):
        assert there.stat.extent == alone.stat.extent
        assert there.stat.center.tolist() == alone.stat.center.tolist()
        assert there.vis.map.znear * there.stat.extent == pytest.approx(0.25)
        assert there.vis.map.zfar * there.stat.extent == pytest.approx(1200.0)


def test_it_has_geoms_alone_and_not_too_many(airport: np.ndarray) -> None:
    spec = mujoco.MjSpec.from_file(str(AIRPORT_XML))
    assert len(airport) == len(spec.geoms)  # all of them in the world body, which is static
    assert {geom.mass for geom in spec.geoms} == {0.0}
    assert 250 < len(airport) <= 400  # drawn in software too
    assert mujoco.mjtGeom.mjGEOM_ELLIPSOID not in [geom.type for geom in spec.geoms]


def corners(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """(4, 2) corners of a horizontal plane, m."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    level = rotation.reshape(3, 3)[:2, :2]
    signs = [[1, 1], [1, -1], [-1, -1], [-1, 1]]
    half = model.geom_size[geom, :2] * signs
    return np.asarray(model.geom_pos[geom, :2] + half @ level.T)


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two rectangles share more than an edge: no separating axis along any side."""
    for side in (a[0] - a[1], a[1] - a[2], b[0] - b[1], b[1] - b[2]):
        axis = side / np.linalg.norm(side)
        ours = a @ axis
        others = b @ axis
        if min(ours.max() - others.min(), others.max() - ours.min()) < 1e-6:
            return False
    return True


def test_flat_things_of_one_height_do_not_overlap(
    model: mujoco.MjModel, airport: np.ndarray
) -> None:
    """Where two did, both would be drawn, and lit twice."""
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    level = abs(model.geom_quat[:, 1:3]).max(axis=1) < 1e-9
    ends = model.geom_size[:, 0] > 0  # not the grass, which has no end
    flat = [geom for geom in airport if planes[geom] and level[geom] and ends[geom]]
    assert len(flat) > 80
    places = model.geom_pos
    heights = places[:, 2]
    assert heights[flat].max() <= 0.0
    for a, b in combinations(flat, 2):
        if math.isclose(heights[a], heights[b], abs_tol=1e-9):
            one = corners(model, a)
            other = corners(model, b)
            assert not overlap(one, other), (places[a].tolist(), places[b].tolist())


def test_sky_is_above_the_horizon_and_ground_below(opengl: None) -> None:
    vehicle = Vehicle.load()
    views = chosen_views(["front@160x120", "front_segmentation@160x120"], vehicle.cameras)
    state = {"position": np.array([[0.0, 0.0, 4.0]]), "quaternion": np.array([[1.0, 0, 0, 0]])}
    everybody = np.ones(1, bool)
    with closing(Cameras(vehicle, views, scene="airport")) as cameras:
        cameras.take({view.name: everybody for view in views}, state)
        picture = cameras.pictures["front"][0].astype(int)
        seen = cameras.pictures["front_segmentation"][0, ..., 0]
        names = cameras.objects
    antenna = (34.5 - 4) / (104 - vehicle.radius)  # the tower's tip, as if straight ahead
    clear = int(60 - 60 * antenna) - 2  # 90 degrees high: 60 pixels to each metre, 1 m ahead
    assert clear > 20
    assert (seen[:clear] == 0).all()
    assert (seen[62:] > 0).all()  # the ground ends 1200 m away, 0.2 degrees below the horizon
    sky = seen == 0
    red, green, blue = picture[sky].mean(axis=0)
    assert blue > green > red
    grass = seen == names.index("airport/grass")
    red, green, blue = picture[grass].mean(axis=0)
    assert green > red > blue
    apron = seen == names.index("airport/apron")
    grey = picture[apron].mean(axis=0)
    assert np.ptp(grey) < 20
    hidden = names.index("scene/floor") if "scene/floor" in names else -1
    assert not (seen == hidden).any()  # by the airport's own ground
