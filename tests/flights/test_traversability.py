"""How hard a layout is, and what `evaluate` prints of flights among solids."""

from pathlib import Path

import numpy as np
import pytest
from commands import Capsys, output
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import flown_trajectories, mean_traversability
from rotorgram.models import InputError
from rotorgram.scenes import Solids
from rotorgram.scenes.config import SceneConfig
from rotorgram.scenes.generators import Draft

VFH = f"{Path(__file__).parents[2]}/examples/vfh.py:Vfh"


def walls() -> Solids:
    """A room of 10 m by 10 m, of four walls that are 0.2 m thick."""
    draft = Draft(SceneConfig(), 0)
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        half = (0.1 + 5.0 * abs(y), 0.1 + 5.0 * abs(x), 2.0)
        draft.add(f"wall {x} {y}", "box", half, (5.1 * x, 5.1 * y, 2.0), "")
    return Solids.drawn([draft])


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


def test_layouts_of_flights() -> None:
    bare = EnvConfig.from_keywords("rotorgram/Hover-v0", backend="rigid", episode_length=5)
    assert np.isnan(mean_traversability(flown_trajectories(None, bare, [0])))
    scene = "forest:5,density=0.1,size=30x30"
    config = EnvConfig.from_keywords("rotorgram/Hover-v0", scene=scene, episode_length=5)
    flights = flown_trajectories(None, config, [0, 1])
    radius = flights[0].spec.constants["radius"]
    height = [one.telemetry["position"][0, 2] for one in flights]
    wood = Solids.of_scene(scene).standing()
    expected = [wood.traversability(radius, (-15, -15, z), (15, 15, z)) for z in height]
    assert mean_traversability(flights) == pytest.approx(sum(expected) / 2)
    assert 1.0 < sum(expected) / 2 < 100.0


def test_what_evaluate_prints(capsys: Capsys) -> None:
    scene = ("--scene", "forest:unseen,density=0.1,size=34x16,clear=ends")
    words = ("--env", "rotorgram/Forest-v0", *scene, "--episode-length", 20, "--episodes", 1)
    shown = output(capsys, "evaluate", VFH, *words, "--env.speed", 3)
    assert "steady     success 0.0000\n" in shown
    assert "touched    0\n" in shown
    assert "flight time 1 s\n" in shown
    for name in ("mean speed ", "top speed ", "least clearance ", "scene      traversability "):
        assert f"\n{name}" in shown
