"""Solids of scenes: distances against closed forms and MuJoCo's, grids, and what is refused."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco import MjSpec, mjtGeom
from rotorgram.models import InputError
from rotorgram.scenes import SCENES, Layouts, Rays, Solids
from sight import random_model

TURN = (0.6, 0.2, -0.3, 0.7)


def solids(kind: str, size: tuple[float, ...], **more: object) -> Solids:
    spec = MjSpec()
    geom = getattr(mjtGeom, f"mjGEOM_{kind.upper()}")
    size = (0.0, 0.0, 1.0) if kind == "plane" and not size else (*size, 0.0, 0.0)[:3]
    spec.worldbody.add_geom(name="it", type=geom, size=size, **more)
    return Solids.of_model(spec.compile())


@pytest.mark.parametrize(
    ("kind", "size", "point", "expected"),
    [
        ("sphere", (0.5,), (3.0, 0.0, 4.0), 4.5),
        ("sphere", (0.5,), (0.0, 0.2, 0.0), -0.3),
        ("capsule", (0.5, 1.0), (2.0, 0.0, 0.7), 1.5),
        ("capsule", (0.5, 1.0), (3.0, 0.0, 5.0), 4.5),
        ("capsule", (0.5, 1.0), (0.1, 0.0, 0.0), -0.4),
        ("cylinder", (0.5, 1.0), (0.0, 2.0, -0.9), 1.5),
        ("cylinder", (0.5, 1.0), (3.5, 0.0, 5.0), 5.0),
        ("cylinder", (0.5, 1.0), (0.0, 0.3, 0.0), -0.2),
        ("box", (1.0, 2.0, 3.0), (0.0, 0.0, 5.0), 2.0),
        ("box", (1.0, 2.0, 3.0), (4.0, 6.0, 0.0), 5.0),
        ("box", (1.0, 2.0, 3.0), (0.9, 0.0, 0.0), -0.1),
        ("plane", (), (7.0, 8.0, 2.0), 2.0),
        ("plane", (), (7.0, 8.0, -2.0), -2.0),
        ("plane", (20.0, 11.0, 1.0), (400.0, 0.0, 2.0), 2.0),  # level ground has no end
        ("box", (1.0, 1.0, 5e-4), (0.0, 0.0, 1.0), 0.9995),
    ],
)
def test_distances(
    kind: str, size: tuple[float, ...], point: tuple[float, ...], expected: float
) -> None:
    assert solids(kind, size).distance(point) == pytest.approx(expected, rel=1e-12)
    if kind == "plane":
        return
    turned = solids(kind, size, quat=TURN, pos=(5.0, -3.0, 2.0))
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, np.array(TURN) / math.dist(TURN, (0,) * 4))
    there = matrix.reshape(3, 3) @ point + (5.0, -3.0, 2.0)
    assert turned.distance(there) == pytest.approx(expected, rel=1e-9)


def test_a_plane_of_a_size_is_a_sheet_unless_it_can_touch() -> None:
    """MuJoCo lets craft collide with a plane beyond its size."""
    place: Any = {"size": (1.0, 2.0, 1.0), "quat": (0.7, 0.0, 0.7, 0.0), "pos": (3.0, 0.0, 1.0)}
    solid = solids("plane", **place)
    assert solid.distance((5.0, 9.0, 1.0)) == pytest.approx(2.0)
    assert solid.distance((1.0, 0.0, 1.0)) == pytest.approx(-2.0)
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, contype=0, conaffinity=0, **place)
    wall = Solids.of_model(spec.compile(), [True])
    assert wall.distance((5.0, 0.0, 1.0)) == pytest.approx(2.0)
    assert wall.distance((1.0, 0.0, 1.0)) == pytest.approx(2.0 - 1e-3)
    assert wall.distance((3.0, 6.0, 1.0)) == pytest.approx(4.0, abs=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_distances_by_formulas_of_another_form(seed: int) -> None:
    dice = np.random.default_rng(seed)
    model = random_model(dice, 20)
    scene = Solids.of_model(model)
    points = dice.uniform((-12, -12, 0.1), (12, 12, 9), (40, 3))
    found = scene.distance(points)
    for point, near in zip(points, found.tolist(), strict=True):
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        gaps = [_gap(model, geom, data, point) for geom in range(model.ngeom)]
        assert near == pytest.approx(min(gaps), abs=1e-9) or (near < 0 and min(gaps) <= 0)


def _gap(model: mujoco.MjModel, geom: int, data: mujoco.MjData, point: np.ndarray) -> float:
    """To the nearest point of a box, a segment, a disc."""
    local = data.geom_xmat[geom].reshape(3, 3).T @ (point - data.geom_xpos[geom])
    a, b, _ = size = model.geom_size[geom]
    kind = model.geom_type[geom]
    if kind == mjtGeom.mjGEOM_PLANE:
        return float(local[2])
    if kind == mjtGeom.mjGEOM_SPHERE:
        return math.dist(local, (0, 0, 0)) - a
    if kind == mjtGeom.mjGEOM_CAPSULE:
        return math.dist(local, (0, 0, np.clip(local[2], -b, b))) - a
    if kind == mjtGeom.mjGEOM_BOX:
        return math.dist(local, np.clip(local, -size, size))
    share = min(1.0, a / math.hypot(*local[:2]))
    return math.dist(local, (*(share * local[:2]), np.clip(local[2], -b, b)))


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_is_solid(name: str) -> None:
    scene = Solids.of_scene(name)
    assert len(scene) >= 1
    assert len(set(scene.names)) == len(scene)
    assert np.isfinite(scene.table).all()
    assert scene.distance((0.0, 0.0, 3.0)) > 0.5  # where flights begin


def test_a_field_is_the_distance_at_the_centers_of_cells() -> None:
    scene = Solids.of_scene("forest:3")
    field = scene.field((-10.0, -8.0, 0.0), (10.0, 8.0, 6.0), 0.5)
    assert field.shape == (40, 32, 12)
    assert field[3, 4, 5] == scene.distance((-8.25, -5.75, 2.75))
    assert scene.field((0, 0, 0), (1, 1, 1), 0.3).shape == (4, 4, 4)


def test_points_of_any_shape_and_an_empty_scene() -> None:
    scene = Solids.of_scene("plain")
    assert scene.distance(np.ones((2, 0, 3))).shape == (2, 0)
    assert scene.distance(np.ones((2, 5, 3))).tolist() == [[1.0] * 5] * 2
    assert scene.distance((1.0, 1.0, 1.0)).shape == ()
    none = Solids.of_model(MjSpec().compile())
    assert none.distance((0.0, 0.0, 0.0)) == math.inf
    assert Layouts.of(none, scene).kinds.shape == (2, 1)


def test_what_moves_and_what_nothing_touches_is_left_out() -> None:
    spec = MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.add_geom(name="moves", type=mjtGeom.mjGEOM_SPHERE, size=(1, 0, 0))
    fixed = spec.worldbody.add_body(pos=(1, 0, 0))
    fixed.add_geom(name="stands", type=mjtGeom.mjGEOM_SPHERE, size=(1, 0, 0), pos=(1, 0, 0))
    ghost = {"contype": 0, "conaffinity": 0}
    spec.worldbody.add_geom(name="ghost", type=mjtGeom.mjGEOM_SPHERE, size=(1, 0, 0), **ghost)
    scene = Solids.of_model(spec.compile())
    assert scene.names == ("stands",)
    assert scene.centers.tolist() == [[2.0, 0.0, 0.0]]


def test_models_with_joints_and_layouts_of_other_sizes() -> None:
    spec = MjSpec()
    spec.worldbody.add_geom(name="wall", type=mjtGeom.mjGEOM_BOX, size=(1, 1, 1), pos=(4, 0, 0))
    body = spec.worldbody.add_body()
    body.add_joint()
    body.add_geom(type=mjtGeom.mjGEOM_SPHERE, size=(0.1, 0, 0))
    scene = Solids.of_model(spec.compile())
    assert scene.names == ("wall",)
    layouts = Layouts.of(scene, Solids.of_scene("gates"))
    rays = Rays.pinhole(4, 4, 60.0)
    rows = np.ones((3, 5)).T  # columns one after another
    found = rays.cast(layouts, rows, [(1.0, 0.0, 0.0, 0.0)] * 5)
    assert (found[:, 1:3, 1:3] < 20.0).any()


def test_what_is_refused() -> None:
    scene = Solids.of_scene("plain")
    with pytest.raises(InputError, match=r"^points: expected shape \(\.\.\., 3\), got \(2,\)"):
        scene.distance((1.0, 2.0))
    with pytest.raises(InputError, match=r"^points: expected finite numbers, got \[nan"):
        scene.distance([math.nan, 0.0, 0.0])
    with pytest.raises(InputError, match=r"^cell: expected a number from 0.001 to 1000 m, got 0"):
        scene.field((0, 0, 0), (1, 1, 1), 0)
    with pytest.raises(InputError, match=r"^cell: expected at most 67108864 cells, got 1000000000"):
        scene.field((0, 0, 0), (1, 1, 1), 0.001)
    with pytest.raises(InputError, match=r"^low, high: expected two corners, each below the other"):
        scene.field((0, 0, 2), (1, 1, 1), 0.1)
    with pytest.raises(InputError, match=r"^scene: expected sphere, .*, hfield, got the mesh it$"):
        _mesh()
    with pytest.raises(InputError, match=r"^scene: expected sphere, .*, got the ellipsoid it$"):
        solids("ellipsoid", (0.5, 0.4, 1.5))
    with pytest.raises(
        InputError, match=r"^scene: it: obstacle: size: expected .* m, got \(20000\.0, 1\.0"
    ):
        solids("box", (2e4, 1.0, 1.0))
    with pytest.raises(
        InputError, match=r"^scene: it: obstacle: position: expected .* to 10000 m, got"
    ):
        solids("box", (1.0, 1.0, 1.0), pos=(2e4, 0.0, 0.0))


def _mesh() -> Solids:
    spec = MjSpec()
    spec.add_mesh(name="m", uservert=[0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1])
    spec.worldbody.add_geom(name="it", type=mjtGeom.mjGEOM_MESH, meshname="m")
    return Solids.of_model(spec.compile())
