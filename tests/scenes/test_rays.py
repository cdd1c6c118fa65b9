"""Rays: the same bits by NumPy and by Numba, against mj_ray, and by hand."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.models import InputError
from rotorgram.scenes import Layouts, Rays, SceneConfig, Solids, kernels, returns
from rotorgram.scenes.obstacles import Obstacle
from rotorgram.scenes.returns import ErrorModel
from rotorgram.sim.random import words_of
from sight import OFF, REACH, SENSORS, SIDES, by_mujoco, random_model, random_poses

LEVEL = (1.0, 0.0, 0.0, 0.0)
AHEAD = Rays.pinhole(6, 32, 120.0).directions
PATTERNS = {
    **SENSORS,
    "depth of 6 x 32": Rays.pinhole(6, 32, 120.0),
    "up to a plane": Rays(AHEAD, 9.0 / AHEAD[..., 0]),
    "one ring": Rays.rings(1, 360, 0.0, 0.0),
    "8 x 8": Rays.pinhole(8, 8, 45.0),
    "five": Rays([[(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)]]),
    "one down": Rays([[(0, 0, -1)]]),
    "down, one below another": Rays([[(0.0, 0.1, -1)], [(0, 0, -1)], [(0.1, 0, -1)]]),
}


@pytest.fixture
def by_numpy(monkeypatch: pytest.MonkeyPatch) -> Any:
    def cast(rays: Rays, *given: Any, **more: Any) -> np.ndarray:
        with monkeypatch.context() as patch:
            patch.setattr(kernels, "compiled", lambda: None)
            return rays.cast(*given, **more)

    return cast


@pytest.mark.parametrize("name", PATTERNS)
def test_numba_has_the_bits_of_numpy(name: str, by_numpy: Any) -> None:
    """In several scenes of different sizes; a sensor alone has the bits of all together."""
    assert kernels.compiled()
    dice = np.random.default_rng(5)
    models = [random_model(dice, count) for count in (20, 60, 200)]
    scenes = [Solids.of_model(model) for model in models]
    scenes.append(Solids.of_scene("forest:2"))
    layouts = Layouts.of(*scenes)
    place, turn = random_poses(dice, 12, SIDES[60])
    which = np.arange(12) % 4
    rays = PATTERNS[name]
    fast = rays.cast(layouts, place, turn, which=which)
    slow = by_numpy(rays, layouts, place, turn, which=which)
    assert fast.dtype == np.float32
    assert fast.shape == (12, *rays.directions.shape[:2])
    assert fast.tobytes() == slow.tobytes()
    assert (fast < REACH).any()
    for world in (0, 5):
        alone = rays.cast(Layouts.of(scenes[which[world]]), place[world], turn[world])
        assert alone.tobytes() == fast[world].tobytes()


@pytest.mark.parametrize("name", SENSORS)
def test_rays_are_mujocos(name: str) -> None:
    dice = np.random.default_rng(11)
    rays = SENSORS[name]
    for _ in range(4):
        model = random_model(dice, 60)
        place, turn = random_poses(dice, 1, SIDES[60])
        ours = rays.cast(Layouts.of(Solids.of_model(model)), place, turn).ravel()
        theirs = by_mujoco(model, place[0], turn[0], rays.directions.reshape(-1, 3))
        assert (abs(ours - theirs) < OFF).all()
        assert (ours < REACH).mean() > 0.1


def test_a_ray_from_within_meets_what_it_leaves() -> None:
    model = random_model(np.random.default_rng(0), 20)
    scene = Solids.of_model(model)
    rays = Rays([[(1.0, 0.0, 0.0), (0.0, 0.0, -1.0)]])
    ours = rays.cast(Layouts.of(scene), scene.centers[1:], [LEVEL] * 19)
    for number in range(19):
        start = scene.centers[number + 1].astype(np.float32)
        theirs = by_mujoco(model, start, np.array(LEVEL), rays.directions[0])
        assert ours[number, 0] == pytest.approx(theirs, abs=1e-4)


def test_directions() -> None:
    picture = Rays.pinhole(2, 4, 90.0).directions
    assert picture.shape == (2, 4, 3)
    assert picture[0, 0] / picture[0, 0, 0] == pytest.approx((1.0, 0.75, 0.25))  # left, above
    assert picture[1, 3] / picture[1, 3, 0] == pytest.approx((1.0, -0.75, -0.25))
    ring = Rays.rings(2, 4, -30.0, 0.0).directions
    assert ring[0] == pytest.approx(
        np.array(((1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0))), abs=1e-15
    )
    assert ring[1, 1] == pytest.approx((0.0, 0.75**0.5, -0.5), abs=1e-12)


def test_the_ground_below_a_sensor() -> None:
    layouts = Layouts.of(Solids.of_scene("plain"))
    rays = Rays([[(0.0, 0.0, -1.0), (1.0, 0.0, -1.0), (1.0, 0.0, 0.0)]], reach=5.0)
    found = rays.cast(layouts, (3.0, -2.0, 2.0), LEVEL)
    assert found.ravel() == pytest.approx((2.0, 2.0 * 2**0.5, 5.0))
    nose_down = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
    found = rays.cast(layouts, [(0.0, 0.0, 2.0)], [nose_down])
    assert found.ravel() == pytest.approx((5.0, 2.0 * 2**0.5, 2.0), abs=1e-6)


def test_each_ray_ends_where_it_should() -> None:
    wall = Solids.of_obstacles([Obstacle(kind="box", size=(1.0, 50.0, 50.0), position=(9.0, 0, 0))])
    layouts = Layouts.of(wall)  # its face is 8 m ahead
    for depth in (7.9, 7.995, 8.005, 30.0):
        rays = Rays(AHEAD, depth / AHEAD[..., 0])
        found = rays.cast(layouts, (0.0, 0.0, 0.0), LEVEL)[0] * AHEAD[..., 0]
        assert found == pytest.approx(np.full((6, 32), min(depth, 8.0)), abs=1e-4)


CODE = """
import ctypes
import sys
import numpy as np
from rotorgram.scenes import Layouts, Rays, kernels, returns
code, reader = kernels.compiled(), returns.compiled()
assert code and reader
given = dict(np.load(sys.argv[1]))
kinds, tables, which = layouts = [given[name] for name in ("kinds", "tables", "which")]
points, ways, turns = given["points"], given["ways"], given["turns"]
sensor = Rays.pinhole(24, 32, 90)
found = {"rays": sensor.cast(Layouts(kinds, tables), points, turns, which=which)}
due = np.ones((len(points), 1), bool)
still, radius = np.float32(0.0), np.float32(0.3)
layout = ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p
nearest, first = (
    ctypes.CFUNCTYPE(ctypes.c_float, *layout, *[ctypes.c_float] * count)(function.address)
    for function, count in ((code.nearest, 5), (code.first, 6))
)
for left in (still, np.float32(0.5)):
    gaps = np.empty((len(points), 1), np.float32)
    code.gaps(*layouts, points[:, None], due, left, radius, gaps)
    near = []
    for n, point in zip(which, points):
        address = kinds.shape[1], kinds[n].ctypes.data, tables[n].ctypes.data
        near.append(nearest(*address, *point.tolist(), left, radius))
    found |= {f"gaps {left}": gaps[:, 0], f"nearest {left}": np.float32(near)}
ends = []
for n, point, way in zip(which, points, ways):
    address = kinds.shape[1], kinds[n].ctypes.data, tables[n].ctypes.data
    ends.append(first(*address, *point.tolist(), *way.tolist()))
found["first"] = np.float32(ends)
steps = np.arange(len(points), dtype=np.uint32)
found["words"] = np.empty((len(points), 768), np.uint32)
reader.words(given["keys"], np.uint64(7), steps, steps, found["words"])
ranges = found["rays"].reshape(len(points), 768)
found["readings"] = np.empty_like(ranges)
read = given["scale"], given["columns"].item(), found["words"], given["errors"], found["readings"]
reader.readings(ranges, *read)
np.savez(sys.argv[2], **found)
"""
ERRORS = ErrorModel(0.3, 15.0, 0.01, 0.01, 0.003, 0.05, 0.3)


def given_to_kernels() -> dict[str, Any]:
    """A wood, hills, and balls and posts on their ways; sensors at random places in them."""
    dice = np.random.default_rng(3)
    solids = [
        Solids.ground() + Solids.of_layout(SceneConfig.parse(text), 1)
        for text in ("forest:1", "hills:1", "traffic:1")
    ]
    kinds, tables = Layouts.of(*solids)
    tables[2, kernels.WAYS, 1 : len(solids[2])] = dice.normal(size=(3, len(solids[2]) - 1))
    count = 51
    ways = dice.normal(size=(count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return {
        "kinds": kinds,
        "tables": tables,
        "which": np.arange(count) % 3,
        "points": dice.uniform((-30, -30, 1), (30, 30, 8), (count, 3)).astype(np.float32),
        "ways": ways.astype(np.float32),
        "turns": dice.normal(size=(count, 4)),
        "keys": dice.integers(0, 2**32, (count, 2), dtype=np.uint32),
        "scale": np.full(768, 0.9, np.float32),
        "columns": np.array(32),
        "errors": ERRORS.numbers(),
    }


def found_by_numpy(given: dict[str, Any], cast: Any) -> dict[str, np.ndarray]:
    """What the compiled code should find."""
    kinds, tables, which = layouts = [given[name] for name in ("kinds", "tables", "which")]
    points, ways, turns = given["points"], given["ways"], given["turns"]
    count = len(points)
    sensor = Rays.pinhole(24, 32, 90)
    found = {"rays": cast(sensor, Layouts(kinds, tables), points, turns, which=which)}
    due = np.ones((count, 1), bool)
    for left in (0.0, 0.5):
        gaps = np.empty((count, 1), np.float32)
        moved = np.float32(left), np.float32(0.3)
        kernels.gaps_by_numpy(*layouts, points[:, None], due, *moved, gaps)
        found |= {f"gaps {left}": gaps[:, 0], f"nearest {left}": gaps[:, 0]}
    first = [
        kernels.first_by_numpy(kinds[n], tables[n], point[:, None], way[:, None])[0]
        for n, point, way in zip(which.tolist(), points, ways, strict=True)
    ]
    found["first"] = np.array(first, np.float32)
    steps = np.arange(count, dtype=np.uint32)
    found["words"] = words_of(given["keys"], 7, steps, steps, 768)
    ranges = found["rays"].reshape(count, 768)
    found["readings"] = np.empty_like(ranges)
    read = (
        given["scale"],
        given["columns"].item(),
        found["words"],
        given["errors"],
        found["readings"],
    )
    returns.by_numpy(ranges, *read)
    return found


@pytest.mark.timeout(300)  # two processes compile everything
def test_cold_and_cached_code_have_the_same_bits(tmp_path: Path, by_numpy: Any) -> None:
    """Those of NumPy: rays, distances of both kinds, first solids, random words, readings."""
    around = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    older = {**around, "NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2"}
    given = given_to_kernels()
    np.savez(tmp_path / "given.npz", **given)
    expected = found_by_numpy(given, by_numpy)
    assert (expected["first"] < REACH).any()
    assert (expected["gaps 0.0"] != expected["gaps 0.5"]).any()
    assert 0.1 < (expected["readings"] == ERRORS.reach).mean() < 0.9
    for name, env in {"cold": around, "cached": around, "older": older}.items():
        out = tmp_path / f"{name}.npz"
        subprocess.run(
            [sys.executable, "-c", CODE, tmp_path / "given.npz", out], env=env, check=True
        )
        found = dict(np.load(out))
        assert found.keys() == expected.keys()
        for kernel, array in expected.items():
            assert found[kernel].dtype == array.dtype
            assert found[kernel].tobytes() == array.tobytes(), (name, kernel)
    assert any(tmp_path.rglob("*.nbc"))


def test_what_is_refused() -> None:
    layouts = Layouts.of(Solids.of_scene("plain"))
    rays = Rays.pinhole(2, 2, 90.0)
    for call, sentence in (
        (lambda: Rays.pinhole(0, 2, 90.0), "rows: expected a whole number from 1 to 4096, got 0"),
        (lambda: Rays.pinhole(4096, 4096, 90.0), "rays: expected a whole number from 1 to 1048576"),
        (lambda: Rays.pinhole(2, 2, 180.0), "fov: expected a number from 0.1 to 179 degrees"),
        (lambda: Rays.rings(2, 2, -91.0, 0.0), "low: expected a number from -90 to 90 degrees"),
        (lambda: Rays([(1.0, 0.0, 0.0)]), r"directions: expected shape \(rows, columns, 3\)"),
        (lambda: Rays([[(0.0, 0.0, 0.0)]]), "directions: expected vectors that are not 0"),
        (lambda: Rays.pinhole(2, 2, 90.0, reach=0), "reach: expected a number from"),
        (
            lambda: Rays([[(1, 0, 0)]], reach=[1, 2]),
            r"reach: expected one number or shape \(1, 1\)",
        ),
        (
            lambda: rays.cast(layouts, (0, 0, np.nan), LEVEL),
            "position: expected finite numbers, got",
        ),
        (lambda: rays.cast(layouts, (0, 1), LEVEL), r"rays: expected positions \(W, 3\) and quat"),
        (
            lambda: rays.cast(layouts, (0, 0, 1), LEVEL, which=1),
            "which: expected whole numbers from",
        ),
        (
            lambda: rays.cast(layouts, (0, 0, 1), LEVEL, which=0.5),
            "which: expected whole numbers from",
        ),
        (
            lambda: rays.cast(layouts, (0, 0, 1), LEVEL, which=[0, 0]),
            "which: expected whole numbers from",
        ),
        (
            lambda: rays.cast(layouts, "here", LEVEL),
            "position: expected finite numbers, got 'here'",
        ),
        (lambda: rays.cast(layouts, (0, 0, 1e6), LEVEL), "rays: expected positions within 20000"),
        (lambda: rays.cast(layouts, (0, 0, 1), (0, 0, 0, 0)), "rays: expected positions within"),
    ):
        with pytest.raises(InputError, match=f"^{sentence}"):
            call()
