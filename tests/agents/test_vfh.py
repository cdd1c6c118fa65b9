"""VFH+: its stages by hand, and a flight through a thin wood."""

from typing import Any

import numpy as np
import pytest
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.models import InputError
from vfh import SECTORS, Vfh, candidates, histogram, masked, seen

FOREST = "rotorgram/Forest-v0"
UP = np.array([[0.0], [0.0], [1.0]])


def ring(**distances: float) -> Any:
    """A lidar of 360 rays that sees 12 m but along some, by `at_DEGREES`."""
    ranges = np.full((1, 360), 12.0)
    for name, distance in distances.items():
        ranges[0, int(name.removeprefix("at_"))] = distance
    return ranges


def blocked(*sectors: int) -> Any:
    free = np.ones((1, SECTORS), bool)
    free[0, list(sectors)] = False
    return free


def test_a_return_lies_in_its_sector() -> None:
    points = seen(ring(at_90=3.0), UP, np.array([1.5]), 12.0)[:, 0]
    (sector,) = np.flatnonzero(np.isfinite(points[0]))
    assert sector == 18
    assert points[:, 18] == pytest.approx([0.0, 3.0], abs=1e-12)


def test_a_tilted_lidar_leaves_out_the_ground() -> None:
    """Tilted by 30° to the front: a ray ahead goes down by half its length."""
    forward = np.array([[0.5], [0.0], [np.sqrt(0.75)]])
    ground = seen(ring(at_0=2.6), forward, np.array([1.5]), 12.0)  # 1.3 m below
    assert not np.isfinite(ground).any()
    trunk = seen(ring(at_0=2.0), forward, np.array([1.5]), 12.0)
    assert trunk[:, 0, 0] == pytest.approx([2.0 * np.sqrt(0.75), 0.0])
    behind = seen(ring(at_180=5.0), forward, np.array([1.5]), 12.0)  # a crown, 4 m high
    assert not np.isfinite(behind).any()


def test_obstacles_are_enlarged_by_the_craft() -> None:
    """At 2 m a radius of 1 m covers asin(1 / 2) = 30° to both sides: six sectors of 5°."""
    obstacles = np.full((2, 1, SECTORS), np.inf)
    obstacles[:, 0, 0] = 2.0, 0.0
    nearest = histogram(obstacles, 1.0 + 1e-9)
    covered = {sector % SECTORS for sector in range(-6, 7)}
    assert set(np.flatnonzero(nearest[0] == 2.0).tolist()) == covered
    assert np.isinf(nearest[0, 7:66]).all()


def test_circles_mask_what_a_fast_craft_cannot_reach() -> None:
    """At 3 m/s circles have 9 / 6 = 1.5 m: a post 1.5 m ahead on the left ends that side."""
    obstacles = np.full((2, 1, SECTORS), np.inf)
    angle = np.radians(20.0)
    obstacles[:, 0, 4] = 1.5 * np.cos(angle), 1.5 * np.sin(angle)
    closed = masked(obstacles, 0.5, np.zeros(1), np.array([3.0]))[0]
    assert not closed[:4].any()
    assert closed[5:36].all()
    assert not closed[37:].any()
    slow = masked(obstacles, 0.5, np.zeros(1), np.array([0.1]))[0]
    assert not slow.any()


def test_candidates_of_openings() -> None:
    everywhere = candidates(blocked(), np.array([np.radians(47.0)]))
    assert np.flatnonzero(everywhere[0]).tolist() == [9]  # the target's
    narrow = candidates(blocked(*range(5), *range(10, SECTORS)), np.zeros(1))
    assert np.flatnonzero(narrow[0]).tolist() == [7]  # the middle of five
    wide = candidates(blocked(*range(5), *range(36, SECTORS)), np.array([np.radians(100.0)]))
    assert np.flatnonzero(wide[0]).tolist() == [9, 20, 31]  # five within its borders, and 100°
    assert not candidates(blocked(*range(SECTORS)), np.zeros(1)).any()


def test_it_flies_through_a_wood() -> None:
    config = EnvConfig.from_keywords(FOREST, backend="rigid", density=0.05, **Vfh.options)
    env = LocalVectorEnv(config.unseen(), 12, autoreset_mode="Disabled")
    pilot, single = Vfh(env.env_spec), Vfh(env.env_spec)
    env.reset(seed=3)
    nobody = done = np.zeros(12, bool)
    success = np.zeros(12)
    while not done.all():
        actions = pilot.actions(env.observations)
        alone = single.act({name: array[0] for name, array in env.observations.items()})
        assert (alone == actions[0]).all()
        env.advance(actions, nobody, None, done)
        success = np.where(done, success, env.telemetry["metrics"][:, 0])
        done = done | env.terminated | env.truncated
    env.close()
    assert success.sum() >= 11


def test_what_it_cannot_fly_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"vfh: expected a lidar of one ring of 360 rays, got no"):
        Vfh(env_spec(EnvConfig(env_id=FOREST)))
    with pytest.raises(InputError, match="vfh: expected actions of the level velocity"):
        Vfh(env_spec(EnvConfig(env_id="rotorgram/Hover-v0")))
    hover = EnvConfig.from_keywords("rotorgram/Hover-v0", action="velocity")
    with pytest.raises(InputError, match="vfh: expected the observation 'wanted velocity x'"):
        Vfh(env_spec(hover))
