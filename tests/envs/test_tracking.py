"""The tracking task against values worked out by hand; a pilot flies every trajectory."""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from contracts import GOAL_OFFSET, NOW, TABLES, observed
from pilot import Pilot, fly, limited
from rotorgram.envs.tasks.tracking import snap_basis
from rotorgram.models import Vehicle
from rotorgram.models.errors import InputError

from flights import Shares, state_of, task_of

ID = "rotorgram/Tracking-v0"
HALF = (0.5, 0.5, 0.5)


def begun(share: float = 0.0, **options: Any) -> Any:
    task = task_of(ID, **{"trajectory": "circle", "preview": 1, **options})
    task.begin(NOW, Shares(share, HALF))
    return task


def test_a_circle_by_hand() -> None:
    """2 m in 10 s: after a quarter it is at the top, as fast as 2 π 2 m / 10 s."""
    task = task_of(ID, center=(1.0, 2.0, 6.0))
    pose = task.begin(NOW, Shares(0.25, (1.0, 0.5, 0.5)))
    assert pose.position == pytest.approx([1.3, 4.0, 6.0], abs=1e-9)  # 0.3 m aside
    assert pose.velocity == pytest.approx([-0.4 * math.pi, 0.0, 0.0], abs=1e-9)
    for _ in range(125):  # another quarter
        task.update_memory(state_of())
    assert task.goal(state_of()) == pytest.approx([-1.0, 2.0, 6.0])
    for _ in range(375):  # and round
        task.update_memory(state_of())
    assert task.goal(state_of()) == pytest.approx([1.0, 4.0, 6.0])


def test_a_lemniscate_by_hand() -> None:
    """At 45° of φ: (cos φ, sin φ cos φ) / (1 + sin² φ) = (√2 / 3, 1 / 3)."""
    task = begun(0.125, trajectory="lemniscate", radius=3.0, period=20.0)
    assert task.goal(state_of()) == pytest.approx([math.sqrt(2), 1.0, 5.0])
    table = task._table
    step = 0.02
    assert task._rates[1:-1] == pytest.approx((table[2:] - table[:-2]) / (2 * step), abs=1e-4)


def test_observation_by_hand() -> None:
    task = begun(preview_time=5.0)  # half a round later
    state = state_of(position=(1.0, 0.5, 4.0), velocity=(1.0, 2.0, 3.0))
    seen = observed(task, state)
    expected = TABLES["tracking: observation by hand, expected"]
    assert seen == pytest.approx([*expected, 0, 0.4 * math.pi, 0, -3, -0.5, 1], abs=1e-9)
    (spec,) = task.observation
    assert spec.components[:3] == GOAL_OFFSET
    assert spec.components[-1] == "reference 5 s later - position z"


def test_reward_and_metrics_by_hand() -> None:
    outcome = begun().outcome(state_of(position=(2.0, 1.5, 5.0), body_rates=(3.0, 0.0, 4.0)))
    assert outcome.reward["position"] == pytest.approx(-0.5)
    assert outcome.reward["rates"] == pytest.approx(-0.1)
    assert outcome.metrics["tracking_error"] == pytest.approx(1.5)
    assert outcome.metrics["reference_speed"] == pytest.approx(0.4 * math.pi)
    assert not outcome.terminated


@pytest.mark.parametrize(
    ("state", "ends"),
    [
        ({"position": (4.99, 0.0, 5.0)}, False),
        ({"position": (5.01, 0.0, 5.0)}, True),
    ],
)
def test_ends(state: dict[str, Any], ends: bool) -> None:
    outcome = begun().outcome(state_of(**{"position": (2.0, 0.0, 5.0), **state}))
    assert bool(outcome.terminated) == ends
    assert outcome.reward["termination"] == pytest.approx(-140.0 if ends else 0.0)


def test_minimum_snap_from_rest_to_rest() -> None:
    """Between two points it is 35 τ⁴ - 84 τ⁵ + 70 τ⁶ - 20 τ⁷; half of the way at half the time."""
    times = np.linspace(0.0, 1.0, 11)
    share = 35 * times**4 - 84 * times**5 + 70 * times**6 - 20 * times**7
    assert snap_basis(2, times) == pytest.approx(np.column_stack((1 - share, share)), abs=1e-9)
    rate = 140 * times**3 - 420 * times**4 + 420 * times**5 - 140 * times**6
    assert snap_basis(2, times, 1)[:, 1] == pytest.approx(rate, abs=1e-8)


@pytest.mark.parametrize("points", [3, 5, 16])
def test_minimum_snap_through_points(points: int) -> None:
    knots = np.linspace(0.0, 1.0, points)
    assert snap_basis(points, knots) == pytest.approx(np.eye(points), abs=1e-6)
    ends = np.array([0.0, 1.0])
    for order in (1, 2, 3):
        assert np.abs(snap_basis(points, ends, order)).max() < 1e-4 * points**order
    # Six derivatives are continuous, and points on a line of any place add up to 1.
    inner = knots[1:-1]
    little = 1e-9
    for order in range(7):
        before, after = (snap_basis(points, inner + side, order) for side in (-little, little))
        assert before == pytest.approx(after, abs=1e-4 * points ** (order + 1))
    assert snap_basis(points, np.linspace(0, 1, 37)).sum(axis=1) == pytest.approx(1.0, abs=1e-6)


def test_nothing_snaps_less() -> None:
    """The integral of the squared snap grows with any change that keeps points and ends."""
    times = np.linspace(0.0, 1.0, 2001)
    points = np.array([0.0, 1.0, -0.5])
    snap = snap_basis(3, times, 4) @ points
    # A bump that is 0 at 0, 1/2 and 1 with four derivatives at the ends: (τ (1 - τ))⁵ (τ - 1/2).
    bump = np.polynomial.Polynomial([0, 1, -1]) ** 5 * np.polynomial.Polynomial([-0.5, 1])
    change = bump.deriv(4)(times)
    sizes = (np.trapezoid(values**2, times) for values in (snap, change))
    assert abs(np.trapezoid(snap * change, times)) < 1e-4 * math.sqrt(math.prod(sizes))


def test_a_snap_by_hand() -> None:
    """Two points, 8 s: in the middle after 4 s; at its end it stays."""
    task = task_of(ID, trajectory="snap", points=2, period=8.0)
    pose = task.begin(NOW, Shares(0.0, (0.0, 0.5, 0.5), (1.0, 1.0, 1.0), HALF))
    assert pose.position == pytest.approx([-2.0, 0.0, 5.0])
    assert pose.velocity == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    for steps, place in ((200, (0.0, 1.0, 5.5)), (200, (2.0, 2.0, 6.0)), (100, (2.0, 2.0, 6.0))):
        for _ in range(steps):
            task.update_memory(state_of())
        assert task.goal(state_of()) == pytest.approx(place, abs=1e-6)


def test_a_file_without_a_column_is_told_its_name(tmp_path: Path) -> None:
    file = tmp_path / "mine.csv"
    file.write_text("0,0,0,5\n1,1,0,5\n")
    with pytest.raises(InputError, match=r"with columns t, x, y, z, got .*: no column 't'$"):
        task_of(ID, trajectory=str(file))


def test_a_file_crosses_the_wire(tmp_path: Path) -> None:
    file = tmp_path / "mine.csv"
    file.write_text("t,x,y,z\n1.0,0,0,5\n2.0,1,0,5\n4.0,1,2,6\n")
    task = task_of(ID, trajectory=str(file))
    told = task.options.to_options()["trajectory"]
    file.unlink()
    task = task_of(ID, trajectory=told)
    assert task.options.trajectory == told
    pose = task.begin(NOW, Shares(0.0, HALF))
    assert pose.position.tolist() == [0.0, 0.0, 5.0]
    assert pose.velocity == pytest.approx([1.0, 0.0, 0.0])
    for steps, place in ((25, (0.5, 0.0, 5.0)), (75, (1.0, 1.0, 5.5)), (200, (1.0, 2.0, 6.0))):
        for _ in range(steps):
            task.update_memory(state_of())
        assert task.goal(state_of()) == pytest.approx(place)


@pytest.mark.parametrize(
    ("trajectory", "name"),
    [("circle", None), ("lemniscate", None), ("snap", None), ("lemniscate", "crazyflie2")],
)
def test_a_pilot_flies_it(trajectory: str, name: str | None) -> None:
    """Without feed-forward of the acceleration."""
    vehicle = Vehicle.load(name)
    env = gym.make_vec(ID, 4, vehicle=name, autoreset_mode="Disabled", trajectory=trajectory)
    first = 15 + vehicle.num_rotors

    def wanted(seen: np.ndarray) -> np.ndarray:
        speed = limited(2.0 * seen[:, :3], 2.0) + seen[:, first : first + 3]
        return 3.0 * (speed - seen[:, 3:6])

    metrics = fly(env, Pilot(vehicle), wanted, 3)
    assert len(metrics) == 600
    assert metrics[-150:, :, 0].max() < 0.8
