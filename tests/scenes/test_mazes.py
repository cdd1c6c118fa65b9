"""Ways through scenes: by hand, and in every layout of a seed between the places of tasks."""

import sys
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Annotated

import gymnasium as gym
import numpy as np
import pytest
import rotorgram.envs  # noqa: F401
from find_path import find_path
from rotorgram.envs.config import EnvConfig
from rotorgram.models import InputError
from rotorgram.models.fields import Limits, immutable
from rotorgram.scenes import (
    SCENES,
    Draft,
    SceneConfig,
    SceneOptions,
    SceneType,
    Solids,
    register,
    seeded_scenes,
)
from rotorgram.scenes.obstacles import Obstacle
from rotorgram.udp.spawn import spawn_simulator

WALL = Obstacle(kind="box", size=(0.25, 3.0, 5.0), position=(5.0, 0.0, 0.0))
BOX = {"low": (0.0, -5.0, 0.0), "high": (10.0, 5.0, 1.0)}


def test_a_free_way_is_straight() -> None:
    way = find_path(Solids.none(), [(0.5, 0.5, 0.5), (9.5, 0.5, 0.5)], **BOX, radius=1.0, cell=1.0)
    assert way.tolist() == [[x + 0.5, 0.5, 0.5] for x in range(10)]


def test_a_way_leads_around_a_wall_and_keeps_away_from_it() -> None:
    wall = Solids.of_obstacles([WALL])
    way = find_path(wall, [(0.5, -0.5, 0.5), (9.5, -0.5, 0.5)], **BOX, radius=1.0, cell=1.0)
    assert (wall.distance(way) >= 1.0).all()
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    # The end of the wall is at y = -3. Four rows down and up diagonally, and straight between.
    assert Counter(steps.round(6).tolist()) == {1.0: 1, 1.414214: 8}
    assert way[:, 1].min() == -4.5


def test_without_a_way_there_are_no_points() -> None:
    wall = Solids.of_obstacles([WALL])
    ends = [(0.5, -0.5, 0.5), (9.5, -0.5, 0.5)]
    assert find_path(wall, ends, **BOX, radius=2.5, cell=1.0).shape == (0, 3)
    assert find_path(wall, [ends[0], (5.0, 0.5, 0.5)], **BOX, radius=0.1).shape == (0, 3)
    with pytest.raises(
        InputError, match=r"^ends: expected two places within the grid from .*, got .*11"
    ):
        find_path(wall, [ends[0], (11.0, 0.0, 0.5)], **BOX, radius=0.1)


def way_at_one_height(text: str, ends: list[tuple[float, ...]], radius: float) -> np.ndarray:
    """In one layer of cells, at the height of a flight, to the place near a goal that has room."""
    solids = Solids.of_scene(text).standing()
    around = np.array([(x, y, 0.0) for x in range(5) for y in range(5)])
    places = ends[1] - np.sign(ends[1]) * around
    (goal, *_) = places[solids.distance(places) > radius + 0.5]
    wide = max(abs(number) for end in ends for number in end[:2]) + 5
    height = ends[0][2]
    low, high = (-wide, -wide, height - 0.25), (wide, wide, height + 0.25)
    return find_path(solids, [ends[0], goal], low, high, radius=radius)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("text", "ends", "radius"),
    [
        ("forest:{},density=0.1,size=34x16,clear=ends", [(-15, 0, 2), (15, 0, 2)], 0.3),
        ("forest:{}", [(0, 0, 2), (50, 50, 2)], 1.4),
        ("warehouse:{}", [(0, 0, 2), (-28, 0, 2)], 1.4),
        ("gates:{}", [(0, 0, 2), (30, 0, 2)], 1.4),
        ("maze:{},clear=ends", [(-22, 0, 2), (22, 0, 2)], 0.5),
        ("maze:{}", [(0, 0, 2), (-22.5, 22.5, 2)], 0.5),
        ("maze:{},size=12x30,clear=ends", [(-4, 0, 2), (4, 0, 2)], 0.5),
        ("hills:{}", [(0, 0, 4), (30, 30, 4)], 0.5),  # around what is higher
    ],
)
def test_there_is_a_way_through_every_layout(
    text: str, ends: list[tuple[float, ...]], radius: float, seed: int
) -> None:
    assert len(way_at_one_height(text.format(seed), ends, radius)) > 10


def test_there_is_a_way_across_the_airport() -> None:
    """Around what stands on the straight line."""
    ends = [(0, 0, 2), (50, 50, 2)]
    radius = 1.4
    solids = Solids.of_scene("airport").standing()
    straight = np.linspace(*ends, 200)
    assert (solids.distance(straight) < radius).any()
    way = way_at_one_height("airport", ends, radius)
    assert abs(way[[0, -1]] - ends).max() <= 0.5
    assert (solids.distance(way) >= radius).all()
    length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    assert 50 * 2**0.5 < length < 55 * 2**0.5


@pytest.mark.parametrize(
    ("size", "cells"),
    [((30.0, 24.0), (10, 8)), ((31.5, 100.0), (10, 33)), ((48.0, 48.0), (16, 16))],
)
def test_a_maze_has_the_stated_walls(size: tuple[float, float], cells: tuple[int, int]) -> None:
    """A tree of n cells opens n - 1 of the sides between them; a tenth of the others is left out.
    Walls at the two ends are left out too.
    """
    columns, rows = cells
    sides = columns * (rows - 1) + rows * (columns - 1)
    closed = sides - (columns * rows - 1)
    counts = []
    for seed in range(20):
        options = {"size": size, "clear": "ends"}
        scene = SceneConfig(name="maze", options=options, seeds=(seed,))
        names = Solids.of_scene(scene).names
        counts.append(sum(name.startswith("maze/wall_") for name in names))
    assert 0.9 * closed - 10 < np.mean(counts) < 0.9 * closed
    assert max(counts) < closed


def test_a_forest_has_the_stated_density() -> None:
    scene = SceneConfig.parse("forest,density=0.1,size=40x30,clear=ends")
    names = Solids.of_layout(scene, 5).names
    assert sum(name.endswith("/trunk") for name in names) == 0.1 * 40 * 30


def test_what_a_maze_refuses() -> None:
    with pytest.raises(InputError, match=r"^scene: expected some of size, clear, got 'density'"):
        SceneConfig.parse("maze:1,density=0.1")
    with pytest.raises(InputError, match=r"^scene: expected at most 10000 parts, got 17694"):
        EnvConfig(scene="maze:1,size=400x400")
    with pytest.raises(InputError, match=r"^scene: expected a size of 30 m or more, or clear="):
        SceneConfig.parse("maze:1,size=24x24")


# ---- a scene of one's own

MODULE = """
from rotorgram.scenes import Draft, SceneType, register

LOOKS = {"grass": {"colours": [[0.3, 0.5, 0.2]]}, "steel": {"colours": [[0.4, 0.4, 0.5]]}}


def posts(draft: Draft) -> None:
    draft.add("ground/floor", "plane", (60, 60, 1), (0, 0, 0), "grass")
    for i in range(20):
        x, y = draft.around(0.2, 20.0)
        draft.add(f"post_{i}/pole", "cylinder", (0.2, 3, 0), (x, y, 3), "steel")


register("posts", SceneType(draw=posts, materials=LOOKS))
"""


def test_a_scene_of_ones_own_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In process, and in a simulator that imports the file; layouts differ by episode."""
    (tmp_path / "my_posts.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    __import__("my_posts")
    try:
        assert "posts" in seeded_scenes()
        config = EnvConfig(env_id="rotorgram/Hover-v0", scene="posts:new", backend="rigid")
        assert len(Solids.of_layout(config.scene, 3)) == 20
        assert config.own_task == "my_posts:rotorgram/Hover-v0"
        assert len(config.resolve().task_hash) == 32
        local = gym.make("rotorgram/Hover-v0", scene="posts:new", backend="rigid")
        layouts = set()
        with spawn_simulator(config) as remote, closing(local):
            for seed in (1, 2):
                here, there = remote.reset(seed=seed), local.reset(seed=seed)
                assert here[0].tobytes() == there[0].tobytes()
                assert here[1]["layout"] == there[1]["layout"]
                layouts.add(here[1]["layout"])
        assert len(layouts) == 2
    finally:
        SCENES.pop("posts", None)
        sys.modules.pop("my_posts", None)


@immutable
class RowOptions(SceneOptions):
    """Of a row of posts."""

    count: Annotated[int, Limits(1, 100, whole=True)] = 3
    spacing: Annotated[float, Limits(0.5, 10.0, "m")] = 2.0

    @property
    def most(self) -> int:
        """One for each."""
        return self.count


def row(draft: Draft) -> None:
    for i in range(draft.options.count):
        place = (9.0 + draft.options.spacing * i, 0.0, 1.0)
        draft.add(f"post_{i}/pole", "cylinder", (0.2, 1, 0), place, "steel")


def test_a_scene_of_ones_own_has_options_of_its_own() -> None:
    register("row", SceneType(draw=row, options=RowOptions))
    try:
        scene = SceneConfig.parse("row:new,count=7,spacing=1.5")
        assert str(scene) == "row:new,count=7,spacing=1.5"
        assert scene.values.count == 7
        assert len(Solids.of_layout(scene, 4)) == 7
        assert len(Solids.of_scene("row")) == 3
        assert Solids.of_scene("row:2,spacing=4").centers[1, 0] == 13.0
        config = EnvConfig(env_id="rotorgram/Hover-v0", scene="row:1,count=5")
        assert EnvConfig.from_dict(config.to_dict()) == config
        with pytest.raises(
            InputError, match=r"^scene.count: expected a whole number from 1 to 100"
        ):
            SceneConfig.parse("row:1,count=200")
        with pytest.raises(
            InputError, match=r"^scene: expected some of count, spacing, got 'size'"
        ):
            SceneConfig.parse("row:1,size=3x3")
        with pytest.raises(
            InputError, match=r"^scene: expected no options with warehouse, got size"
        ):
            SceneConfig.parse("warehouse:1,size=3x3")
    finally:
        SCENES.pop("row")


def test_wrong_scenes_of_ones_own() -> None:
    def too_many(draft: Draft) -> None:
        for i in range(3):
            draft.add(f"ball_{i}/ball", "sphere", (1, 0, 0), (0, 0, 9), "")

    with pytest.raises(InputError, match=r"^scene: expected a name such as my_scene, got 'My'"):
        register("My", SceneType(draw=too_many))
    with pytest.raises(InputError, match=r"^scene: expected a name such as my_scene, got 'plain'"):
        register("plain", SceneType(draw=too_many))
    with pytest.raises(InputError, match=r"^scene: expected mine to have a function that draws"):
        register("mine", SceneType())

    class Two(SceneOptions):
        most = 2

    def wrong(draft: Draft) -> None:
        draft.add("ball_0/ball", "sphere", (-1, 0, 0), (0, 0, 9), "")
        draft.add("ball_1/ball", "sphere", (1, 0, 0), (0, float("nan"), 9), "")

    def wrong_heading(draft: Draft) -> None:
        draft.add("box_0/box", "box", (1, 1, 1), (0, 0, 9), "", heading=float("nan"))

    def wrong_motion(draft: Draft) -> None:
        draft.add("box_0/box", "box", (1, 1, 1), (0, 0, 9), "", motion=(float("nan"),) * 11)

    for draw in (wrong, wrong_heading, wrong_motion):
        register("mine", SceneType(draw=draw, moves=True))
        words = r"^scene: expected sizes, places, turns, motions within 1e6, .* in mine"
        with pytest.raises(InputError, match=words):
            Solids.of_scene("mine:2")

    def wrong_kind(draft: Draft) -> None:
        draft.add("cone_0/tip", "cone", (1, 1, 1), (0, 0, 9), "")

    register("mine", SceneType(draw=wrong_kind))
    with pytest.raises(InputError, match=r"^scene: kind of cone_0/tip: expected 'sphere' or"):
        Solids.of_scene("mine:3")
    register("mine", SceneType(draw=too_many, options=Two))
    try:
        with pytest.raises(InputError, match=r"^scene: expected at most 2 parts of mine, got 3"):
            Solids.of_scene("mine:1")
    finally:
        SCENES.pop("mine")
