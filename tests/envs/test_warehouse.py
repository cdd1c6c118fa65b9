"""`Warehouse-v0`: the way through the open aisles, by hand and in flight."""

import math
from typing import Any

import numpy as np
import pytest
from contracts import loop_of
from rotorgram.models import InputError
from rotorgram.scenes import SceneConfig, Solids
from rotorgram.scenes.generators import drafted

from flights import Shares, state_of, task_of

WAREHOUSE = "rotorgram/Warehouse-v0"
# Two rows, of x from -4 m to -1 m and from 1 m to 4 m: the middle aisle of the first is open, and
# the left one of the second. Start and goal are at x = -5 m and 5 m.
OPEN = np.array([(-2.5, 0.0, 1.25, 1.0, 0.0, 0.7), (2.5, 2.4, 1.25, 1.0, 0.0, 0.7)])
BETWEEN = math.hypot(2.0, 2.4)  # from the end of one open aisle to the mouth of the next
AFTER = math.hypot(1.0, 2.4)  # from there to the goal


def begun() -> Any:
    task = task_of(WAREHOUSE, aisles=3)
    shares = Shares((0.5, 0.5), 1.5)
    shares.openings = OPEN
    return task, task.begin(shares)


@pytest.mark.parametrize(
    ("x", "y", "way"),
    [
        (-5.0, 0.0, 1.0 + 3.0 + BETWEEN + 3.0 + AFTER),
        (-5.0, -2.4, math.hypot(1.0, 2.4) + 3.0 + BETWEEN + 3.0 + AFTER),
        (-2.0, 0.0, 1.0 + BETWEEN + 3.0 + AFTER),
        (-2.0, 2.4, 2.0 + 2.4 + 3.0 + BETWEEN + 3.0 + AFTER),
        (0.0, 2.4, 1.0 + 3.0 + AFTER),
        (2.0, 2.4, 2.0 + AFTER),
        (2.0, 0.0, 1.0 + 2.4 + 3.0 + AFTER),
        (4.5, 0.0, 0.5),
    ],
)
def test_the_way_by_hand(x: float, y: float, way: float) -> None:
    task, _ = begun()
    assert task.way(np.array((x, y, 1.0))) == pytest.approx(way)


def test_progress_is_what_the_way_became_shorter_by() -> None:
    task, pose = begun()
    assert pose.position == pytest.approx([-5.0, 0.0, 1.1])
    state = state_of(position=(-4.95, 0.0, 1.1))
    task.update_memory(state)
    assert task.outcome(state).reward["progress"] == pytest.approx(0.05 / 1.2)
    assert task.observe(state)["observation"][13] == pytest.approx(9.95)  # not the way: no secret


def test_the_order_lasts_a_second() -> None:
    """The middle aisle of the first row, and the left one of the second, in a hall of 7.2 m."""
    task, _ = begun()
    for time, order in ((0.0, [0.0, 2.4 / 3.6]), (0.9, [0.0, 2.4 / 3.6]), (1.0, [0.0, 0.0])):
        state = state_of(position=(-5.0, 0.0, 1.1), time=time)
        assert task.observe(state)["order"] == pytest.approx(order)


@pytest.mark.parametrize("seed", range(6))
def test_one_aisle_of_each_row_is_open(seed: int) -> None:
    scene = SceneConfig.parse(f"aisles:{seed}")
    solids = Solids.of_layout(scene, seed)
    openings = drafted(scene, seed).ways
    assert openings[:, 0] == pytest.approx([-2.5, 2.5])
    for x, door, *_ in openings:
        ends = [(x + 1.2, y, 1.0) for y in (-2.4, 0.0, 2.4)]
        is_open = solids.distance(ends) > 0.0
        assert is_open.sum() == 1
        assert ends[int(is_open.argmax())][1] == pytest.approx(door)
        mouths = [(x - 1.5, y, 1.0) for y in (-2.4, 0.0, 2.4)]
        assert solids.distance(mouths) == pytest.approx(0.7)
    assert (solids.distance([(-5.0, 0.0, 1.0), (5.0, 0.0, 1.0)]) > 0.9).all()
    assert len(solids) == 4 + 2 * (4 + 2)


def test_who_knows_the_aisles_arrives() -> None:
    loop = loop_of(WAREHOUSE, 6, backend="rigid")
    loop.advance(np.zeros((6, 4)), np.ones(6, bool), list(range(6)))
    openings = loop.world.scenery.openings
    assert len({tuple(rows) for rows in openings[:, :, 1].tolist()}) > 1
    aside = (1.6, 0.0, 0.0)
    ways = [[(*row[:2] - aside[:2], 1.1), (*row[:2] + aside[:2], 1.1)] for row in openings[:, 0]]
    later = [[(*row[:2] - aside[:2], 1.1), (*row[:2] + aside[:2], 1.1)] for row in openings[:, 1]]
    goal = np.full((6, 1, 3), (5.0, 0.0, 1.1))
    points = np.concatenate((ways, later, goal), axis=1)
    at = np.zeros(6, int)
    ended = np.zeros(6, bool)
    arrived = np.zeros(6)
    for _ in range(145):
        to_next = points[np.arange(6), at] - loop.telemetry["position"]
        away = np.linalg.norm(to_next, axis=1)
        at = np.minimum(at + (away < 0.2), 4)
        velocity = 1.5 * to_next / np.maximum(away, 0.75)[:, None]
        actions = np.column_stack((velocity, np.zeros(6))) / loop.spec.action_scale
        loop.advance(actions, None, None, ended)
        arrived = np.where(ended, arrived, loop.metrics["success"])
        ended = ended | loop.terminated
        if ended.all():
            break
    loop.close()
    assert arrived.tolist() == [1.0] * 6


def test_another_scene_is_refused() -> None:
    with pytest.raises(InputError, match=r"scene: expected aisles with rotorgram/Warehouse-v0"):
        task_of(WAREHOUSE, scene="forest:3")


def test_a_hall_of_another_size_is_refused() -> None:
    for size in ("15.9x9.6", "14x9.6", "4x4"):
        with pytest.raises(InputError, match=r"scene: expected aisles:new,size=12x4.8"):
            task_of("rotorgram/Warehouse-v0", scene=f"aisles:new,size={size}")
