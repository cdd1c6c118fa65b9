"""Measures of flights among solids, and how hard a layout is."""

import numpy as np
import pytest
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.surroundings import Passage
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.models import InputError
from rotorgram.scenes import Solids
from rotorgram.scenes.config import SceneConfig
from rotorgram.scenes.generators import Draft


def walls() -> Solids:
    """A room of 10 m by 10 m, of four walls that are 0.2 m thick."""
    draft = Draft(SceneConfig(), 0)
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        half = (0.1 + 5.0 * abs(y), 0.1 + 5.0 * abs(x), 2.0)
        draft.add(f"wall {x} {y}", "box", half, (5.1 * x, 5.1 * y, 2.0), "")
    return Solids.of_parts(draft.parts, "room")


def test_traversability_of_an_empty_room() -> None:
    """The mean way from a place in a square of side a to its border, in all directions, is
    a (4 ln(1 + √2) + (4 - 4 √2) / 3) / (2 π): 0.473 a.
    """
    a = 9.0  # a sphere of 0.5 m has so much room
    mean = a * (4 * np.log(1 + np.sqrt(2)) + (4 - 4 * np.sqrt(2)) / 3) / (2 * np.pi)
    found = walls().traversability(0.5, (-4.5, -4.5, 2.0), (4.5, 4.5, 2.0), count=20_000)
    assert found == pytest.approx(mean / 0.5, rel=0.02)
    open_air = Solids.none().traversability(0.5, (-4.5, -4.5, 2.0), (4.5, 4.5, 2.0), count=20_000)
    assert open_air == pytest.approx(found, rel=5e-3)


def test_more_trees_are_harder() -> None:
    box = (-17.0, -8.0, 1.5), (17.0, 8.0, 1.5)
    hard, harder = (
        Solids.of_scene(f"forest:3,density={density},size=34x16,clear=ends").standing()
        for density in (0.05, 0.2)
    )
    assert hard.traversability(0.2, *box) > 1.5 * harder.traversability(0.2, *box)
    assert hard.traversability(0.2, *box) == hard.traversability(0.2, *box)
    assert hard.traversability(0.2, *box) > hard.traversability(0.4, *box)


def test_no_room_is_0_and_a_radius_has_limits() -> None:
    assert walls().traversability(0.5, (4.9, -1.0, 1.0), (5.2, 1.0, 1.0)) == 0.0
    with pytest.raises(InputError, match="radius: expected"):
        walls().traversability(0.0, (0, 0, 1), (1, 1, 1))


def test_flights_over_bare_ground_have_no_passage() -> None:
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", backend="rigid", episode_length=5)
    assert Passage.of(flown_trajectories(None, config, [0])) is None


def test_a_passage_by_hand() -> None:
    config = EnvConfig.from_keywords("rotorgram/Forest-v0", backend="rigid", episode_length=8)
    (flight,) = flown_trajectories(None, config, [0])
    passage = Passage.of([flight])
    assert passage is not None
    speeds = np.linalg.norm(flight.telemetry["velocity"], axis=1)
    assert passage.time == pytest.approx(0.4)
    assert passage.mean_speed == pytest.approx(speeds[1:].mean())
    assert passage.top_speed == pytest.approx(speeds.max())
    names = [metric.name for metric in flight.spec.metrics]
    told = flight.telemetry["metrics"][-1, names.index("least_clearance")]
    assert passage.least_clearance == pytest.approx(told, abs=1e-3)  # the task leaves out the start
    assert passage.touched == 0.0
    assert 5.0 < passage.traversability < 100.0


def test_clearance_is_that_of_solids_where_they_are() -> None:
    config = EnvConfig.from_keywords("rotorgram/Dodge-v0", backend="rigid", episode_length=70)
    (flight,) = flown_trajectories(None, config, [0])
    passage = Passage.of([flight])
    assert passage is not None
    names = [metric.name for metric in flight.spec.metrics]
    told = flight.telemetry["metrics"][-1, names.index("least_clearance")]
    assert passage.least_clearance == pytest.approx(told, abs=1e-4)
    still = Solids.of_layout(flight.scene, flight.scene.seed).distance(flight.pose[:, :3])
    assert abs(still.min() - flight.spec.constants["radius"] - told) > 0.1
