"""Plans: solids where they stand, paths in the colours of their speed, marks."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.contour import QuadContourSet
from rotorgram.cli import main
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.plots import drawn_plan
from rotorgram.flights.trajectories import Trajectory, flown_trajectories
from rotorgram.models import InputError
from rotorgram.scenes import Solids
from rotorgram.udp.spawn import spawn_simulator

SCENE = "forest:3,size=30x30,density=0.05"
PERIOD = 0.02  # s


def straight(start: tuple[float, ...], end: tuple[float, ...], **options: str) -> Trajectory:
    """A flight at 3 m/s from one point to another, which terminates there."""
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", **{"scene": SCENE, **options})
    length = np.linalg.norm(np.subtract(end, start))
    steps = round(length / (3.0 * PERIOD))
    share = np.linspace(0.0, 1.0, steps + 1)[:, None]
    position = np.array(start) + share * np.subtract(end, start)
    return Trajectory(
        spec=env_spec(config),
        telemetry={
            "position": position,
            "attitude": np.tile((1.0, 0.0, 0.0, 0.0), (steps + 1, 1)),
            "goal": np.tile((6.0, 0.0, 2.0), (steps + 1, 1)),
        },
        rewards=np.zeros(steps),
        actions=np.zeros((steps, 4)),
        ending="terminated",
    )


def nearest_trunk(solids: Solids) -> tuple[np.ndarray, float]:
    """Center in the plane, and radius, m, of the trunk next to the origin."""
    trunks = [i for i, name in enumerate(solids.names) if name.endswith("trunk")]
    first = min(trunks, key=lambda i: float(np.hypot(*solids.centers[i, :2])))
    return solids.centers[first, :2], float(solids.halves[first, 0])


def test_a_plan_has_the_trunks_where_they_stand_and_the_path_by_its_speed() -> None:
    solids = Solids.of_scene(SCENE)
    trunk, radius = nearest_trunk(solids)
    flight = straight((0.0, 0.0, 2.0), (*(trunk * 1.5), 2.0))
    (axes, _) = drawn_plan({"one": flight}).axes
    (outlines,) = (one for one in axes.collections if isinstance(one, QuadContourSet))
    (filled,) = outlines.get_paths()
    for angle in np.linspace(0.0, 2 * np.pi, 8):
        way = np.array((np.cos(angle), np.sin(angle)))
        inside = trunk + (radius - 0.05) * way
        beside = trunk + (radius + 0.05) * way
        assert filled.contains_point(inside) == (solids.distance((*inside, 2.0)) < 0)
        assert filled.contains_point(inside)
        assert filled.contains_point(beside) == (solids.distance((*beside, 2.0)) < 0)
    (dots,) = (one for one in axes.collections if isinstance(one, PathCollection))
    np.testing.assert_allclose(dots.get_offsets(), flight.pose[:, :2])
    np.testing.assert_allclose(dots.get_array(), 3.0, rtol=0.01)
    assert axes.get_title("left") == f"{SCENE}: solids at a height of 2.0 m"


def test_a_plan_marks_start_goal_and_where_a_solid_was_touched() -> None:
    trunk, radius = nearest_trunk(Solids.of_scene(SCENE))
    away = trunk / np.hypot(*trunk)
    spec = straight((0.0, 0.0, 2.0), (1.0, 0.0, 2.0)).spec
    reach = radius + 0.9 * float(np.max(spec.constants["radius"]))
    touches = straight((0.0, 0.0, 2.0), (*(trunk - reach * away), 2.0))
    passes = straight((0.0, 0.0, 5.0), (0.5, 0.0, 5.0))
    (axes, _) = drawn_plan({"one": touches, "other": passes}).axes
    marks = {str(line.get_label()): np.transpose(line.get_data()) for line in axes.lines}
    np.testing.assert_allclose(marks["start"], [(0.0, 0.0), (0.0, 0.0)])
    np.testing.assert_allclose(np.unique(marks["goal"], axis=0), [(6.0, 0.0)])
    np.testing.assert_allclose(marks["touched"], [trunk - reach * away])


def test_flights_of_two_layouts_have_no_plan() -> None:
    ends = (0.0, 0.0, 2.0), (1.0, 0.0, 2.0)
    flights = {"a": straight(*ends), "b": straight(*ends, scene="forest:4")}
    with pytest.raises(InputError, match="scene: expected one for all flights of a picture, got"):
        drawn_plan(flights)


def test_a_recorded_flight_gives_a_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mcap")
    journal = tmp_path / "forest.mcap"
    config = EnvConfig.from_keywords("rotorgram/Forest-v0", backend="rigid")
    with spawn_simulator(config, record=journal) as env:
        env.reset(seed=1)
        for _ in range(3):
            env.step(np.zeros(4, np.float32))
    out = tmp_path / "plan.svg"
    assert main(["plot", str(journal), "--plan", "--out", str(out)]) == 0
    words = {element.text for element in ElementTree.parse(out).iter() if element.text}
    assert {"start", "goal", "touched", "speed (m/s)", "x (m)", "y (m)"} <= words
    assert "plan.svg" in capsys.readouterr().out


def test_a_plan_of_solids_that_move_is_refused() -> None:
    config = EnvConfig.from_keywords("rotorgram/Dodge-v0", backend="rigid", episode_length=3)
    flights = flown_trajectories(None, config, [0])
    with pytest.raises(InputError, match="plan: expected a scene whose solids stand still, got tr"):
        drawn_plan({"one": flights[0]})
