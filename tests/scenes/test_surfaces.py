"""Along surfaces of random scenes: touch, contact, rays and pictures agree.

Touch, contact and rays within 1 mm; so do depth pictures of flat faces. Round solids are drawn with
flat sides, whose corners lie on the surface: what is drawn of them lies up to `SAG` radii below it.
"""

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pytest
from capture import lens_of
from mujoco import MjSpec, mjtGeom
from rotorgram.models.cameras import chosen_views
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering.cameras import Cameras
from rotorgram.scenes import Layouts, Rays, SceneConfig, Solids, kernels
from rotorgram.sim import make_world
from worlds import BALL_RADIUS, ball_craft, begin

BACKENDS = pytest.mark.parametrize("backend", ["rigid", "mujoco"])
SEEDS = pytest.mark.parametrize("seed", range(3))
MILLIMETRE = 1e-3  # m
STRIDE = 0.05  # m: of a walk along a surface
SLICES, STACKS = 28, 16  # of MuJoCo's round shapes
SAG = 1.0 - math.cos(math.pi / SLICES) * math.cos(math.pi / (2 * STACKS))
UPRIGHT = np.array((1.0, 0.0, 0.0, 0.0))
SMALL = "front_depth@24x18"


def random_scene(folder: Path, seed: int) -> SceneConfig:
    """Thirty solids of four kinds at any place and attitude above the ground, in a file."""
    kinds = (
        mjtGeom.mjGEOM_SPHERE,
        mjtGeom.mjGEOM_CAPSULE,
        mjtGeom.mjGEOM_CYLINDER,
        mjtGeom.mjGEOM_BOX,
    )
    dice = np.random.default_rng(seed)
    spec = MjSpec()
    for kind in (*kinds, None) * 6:
        size = dice.uniform((0.2, 0.5, 0.0), (0.6, 3.0, 0.0))
        if kind in (mjtGeom.mjGEOM_BOX, None):
            size = dice.uniform(0.3, 1.5, 3)
        place = dice.uniform((-20.0, -20.0, 2.0), (20.0, 20.0, 8.0))
        turn = dice.normal(size=4)
        if kind is None:
            kind, size, turn = thick(size, turn)
        spec.worldbody.add_geom(type=kind, size=size, pos=place, quat=turn)
    spec.compile()
    file = folder / f"random_{seed}.xml"
    file.write_text(spec.to_xml())
    return SceneConfig.parse(str(file))


def thick(size: np.ndarray, turn: np.ndarray) -> tuple[mjtGeom, np.ndarray, np.ndarray]:
    """A capsule with its axis along the longest side of a box, or the box if it is flat."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, turn / np.linalg.norm(turn))
    order = np.argsort(size)
    axes = matrix.reshape(3, 3)[:, order]
    axes[:, 0] *= np.linalg.det(axes).round()  # right-handed again
    turned = np.empty(4)
    mujoco.mju_mat2Quat(turned, axes.ravel())
    thin, wide, long = size[order]
    if thin < wide / 2:
        return mjtGeom.mjGEOM_BOX, size[order], turned
    return mjtGeom.mjGEOM_CAPSULE, np.array((wide, long - wide, 0.0)), turned


class Surface(NamedTuple):
    """N points of surfaces, world frame."""

    points: np.ndarray
    """m, (N, 3)."""
    normals: np.ndarray
    """Unit vectors that point out of the solid, (N, 3)."""

    def above(self, height: float) -> np.ndarray:
        """Points at a distance along the normals, m."""
        return self.points + height * self.normals


def slope_of(solids: Solids, points: np.ndarray) -> np.ndarray:
    """Gradient of the distance, by differences, (N, 3)."""
    small = 1e-5 * np.eye(3)
    return np.stack(
        [(solids.distance(points + one) - solids.distance(points - one)) / 2e-5 for one in small],
        axis=-1,
    )


def walks(solids: Solids, count: int, seed: int) -> Iterator[Surface]:
    """Steps of craft that go along the surface of a solid each, always in one direction.

    A step leaves those out that are not where one solid alone is near: above an edge, or between
    two solids.
    """
    dice = np.random.default_rng(seed)
    owner = np.arange(count) % len(solids)
    points = solids.centers[owner] + dice.normal(size=(count, 3))
    ahead = dice.normal(size=(count, 3))
    for _ in range(40):
        for _ in range(3):  # back to the height of a craft that touches
            slope = slope_of(solids, points)
            size = np.linalg.norm(slope, axis=1, keepdims=True)
            normals = slope / np.maximum(size, 0.1)
            points = points - (solids.distance(points) - BALL_RADIUS)[:, None] * normals
        is_smooth = abs(np.linalg.norm(slope_of(solids, points), axis=1) - 1.0) < 1e-6
        normals = slope_of(solids, points)
        below = points - BALL_RADIUS * normals
        is_alone = abs(solids.distance(below)) < 1e-6
        is_above = points[:, 2] > 2 * BALL_RADIUS
        kept = is_smooth & is_alone & is_above
        yield Surface(below[kept], normals[kept])
        along = ahead - (ahead * normals).sum(axis=1, keepdims=True) * normals
        points = points + STRIDE * along / np.linalg.norm(along, axis=1, keepdims=True)


def owners(solids: Solids, points: np.ndarray) -> np.ndarray:
    """Number of the solid on whose surface each point lies, (...); -1 where there is none."""
    gaps = np.stack([abs(solids[i : i + 1].distance(points)) for i in range(len(solids))])
    return np.where(gaps.min(axis=0) < MILLIMETRE, gaps.argmin(axis=0), -1)


def walked(scene: SceneConfig, seed: int) -> Surface:
    """All steps of a craft for each solid; nearly every solid is met."""
    solids = Solids.of_scene(scene).standing()
    steps = list(walks(solids, len(solids), seed))
    together = Surface(*(np.concatenate(arrays) for arrays in zip(*steps, strict=True)))
    assert len(together.points) > 600
    met = np.unique(owners(solids, together.points))
    assert len(met) > 25
    assert len(np.unique(solids.kinds[met])) == 4
    return together


def facing(normals: np.ndarray) -> np.ndarray:
    """Attitudes of sensors that look against normals, quaternions (N, 4)."""
    half = np.column_stack(
        (1.0 - normals[:, 0], 0.0 * normals[:, 0], normals[:, 2], -normals[:, 1])
    )
    return half / np.linalg.norm(half, axis=1, keepdims=True)


@SEEDS
@BACKENDS
def test_a_craft_touches_below_its_radius_alone(tmp_path: Path, backend: str, seed: int) -> None:
    """Along surfaces, 1 mm above and 1 mm below the height at which it touches."""
    scene = random_scene(tmp_path, seed)
    surface = walked(scene, seed)
    count = len(surface.points)
    world: Any = make_world(ball_craft(tmp_path), count, backend, scene=scene)
    for gap in (MILLIMETRE, -MILLIMETRE):
        begin(world, position=surface.above(BALL_RADIUS + gap)[:, None])
        assert (world.state.touching == (gap < 0)).all()
        assert world.clearance() == pytest.approx(np.full((count, 1), gap), abs=1e-4)


@BACKENDS
def test_a_craft_flies_along_and_into_surfaces(tmp_path: Path, backend: str) -> None:
    """For 0.02 s at 0.5 m/s, from 1 mm above: it flies 1 cm, past a surface or into it."""
    scene = random_scene(tmp_path, 0)
    surface = walked(scene, 0)
    solids = Solids.of_scene(scene).standing()
    sideways = np.cross(surface.normals, np.random.default_rng(0).normal(size=3))
    along = sideways / np.linalg.norm(sideways, axis=1, keepdims=True)
    count = len(surface.points)
    world: Any = make_world(ball_craft(tmp_path), count, backend, scene=scene)
    touched = []
    for way in (along, -surface.normals):
        start = surface.above(BALL_RADIUS + MILLIMETRE)
        begin(world, position=start[:, None], velocity=0.5 * way[:, None])
        assert not world.state.touching.any()
        world.step(world.state.thrust, 4)
        touched.append(world.state.touching[:, 0].copy())
        if way is along:
            flown = np.linalg.norm(world.state.position[:, 0] - start, axis=1)
            gap = solids.distance(world.state.position[:, 0]) - BALL_RADIUS
    is_free = gap > 0.5 * MILLIMETRE
    assert is_free.mean() > 0.95  # the others fly at a further solid
    assert flown[is_free] == pytest.approx(np.full(is_free.sum(), 0.01), abs=MILLIMETRE)
    assert not touched[0][is_free].any()
    assert touched[1].all()


@SEEDS
def test_rays_end_at_the_surface(tmp_path: Path, seed: int) -> None:
    """From the craft, against the normal."""
    scene = random_scene(tmp_path, seed)
    surface = walked(scene, seed)
    layouts = Layouts.of(Solids.of_scene(scene))
    straight = Rays([[(1.0, 0.0, 0.0)]])
    turn = facing(surface.normals)
    for gap in (MILLIMETRE, -MILLIMETRE):
        height = BALL_RADIUS + gap
        found = straight.cast(layouts, surface.above(height), turn).ravel()
        assert abs(found - height).max() < 0.1 * MILLIMETRE


def same_around(numbers: np.ndarray) -> np.ndarray:
    """Which pixels have the number of all eight around them; none at the border."""
    blocks = np.lib.stride_tricks.sliding_window_view(numbers, (3, 3))
    alike = (blocks == numbers[1:-1, 1:-1, None, None]).all(axis=(2, 3))
    return np.pad(alike, 1)


def shot(cameras: Cameras, place: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, ...]:
    """A depth picture, m, (R, C), the place of its camera, m, and the way from there of each pixel
    for 1 m of depth, m, (R, C, 3).
    """
    (view,) = cameras.views
    pose = {"position": place[None], "quaternion": turn[None]}
    cameras.take({view.name: np.ones(1, bool)}, pose)
    picture = cameras.pictures[view.name][0, ..., 0].copy()
    lens = lens_of(cameras, view)
    eye = -lens.rotation.T @ lens.translation
    rows, columns = np.indices(picture.shape) + 0.5
    pixels = np.stack((columns, rows, np.ones(picture.shape)), axis=-1)
    return picture, eye, pixels @ np.linalg.inv(lens.matrix).T @ lens.rotation


@SEEDS
def test_depth_pictures_show_the_surface(opengl: None, tmp_path: Path, seed: int) -> None:
    """From 1 m, along the rays of the pixels, up to 3 m: beyond, the numbers of the depth buffer
    are too coarse. Pixels on edges are left out, and those that see a round solid from the side: at
    an angle to its normal, a sag looks deeper by the inverse of the cosine.
    """
    scene = random_scene(tmp_path, seed)
    surface = walked(scene, seed)
    solids = Solids.of_scene(scene).standing()
    scenery = Layouts.of(solids)
    places = surface.above(1.0)
    turns = facing(surface.normals)
    has_room = np.flatnonzero(abs(solids.distance(places) - 1.0) < 1e-6)
    craft = Vehicle.load("crazyflie2")
    of_flat, of_round = [], []  # m; shares of a sag
    with closing(Cameras(craft, chosen_views([SMALL], craft.cameras), scene=scene)) as cameras:
        for one in has_room[:: len(has_room) // 60]:
            picture, eye, ways = shot(cameras, places[one], turns[one])
            rays = Rays(ways, reach=3.0)
            length = rays.cast(scenery, eye, UPRIGHT)[0]
            ends = eye + length[..., None] * rays.directions
            number = owners(solids, ends)
            cosine = -(slope_of(solids, ends) * rays.directions).sum(axis=-1)
            deeper = picture * np.linalg.norm(ways, axis=-1) - length
            is_seen = same_around(number) & (number >= 0)
            assert (deeper > -MILLIMETRE)[is_seen].all()
            is_flat = solids.kinds[number] == kernels.BOX
            is_round = ~is_flat & (cosine > 0.5)
            sag = SAG * solids.halves[number, 0] / np.maximum(cosine, 0.5)
            of_flat += deeper[is_seen & is_flat].tolist()
            of_round += (deeper / sag)[is_seen & is_round].tolist()
    assert min(len(of_flat), len(of_round)) > 1000
    assert max(of_flat) < MILLIMETRE
    assert 0.9 < max(of_round) < 1.01
