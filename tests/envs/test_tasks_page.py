"""docs/tasks.md says what the tasks are and what their bounds compute."""

import re
from pathlib import Path

import gymnasium as gym
import pytest
import rotorgram.envs  # noqa: F401
from bounds import (
    landing_time,
    payload_time,
    racing_time,
    recovery_bounds,
    waypoints_time,
)
from contracts import spec_with
from rotorgram.envs.registry import task_type
from rotorgram.envs.tasks.racing import RacingOptions
from rotorgram.envs.tasks.recovery import RecoveryOptions
from rotorgram.envs.tasks.waypoints import WaypointsOptions
from rotorgram.models import Vehicle

PAGE = (Path(__file__).parents[2] / "docs" / "tasks.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| `([\w-]+)` \| .* \| `(\w+)` \| ([\dR+ ]+) \|", PAGE, re.MULTILINE)
TASKS = sorted(name for name in gym.registry if name.startswith("rotorgram/"))


def test_the_table_has_every_task() -> None:
    assert sorted(f"rotorgram/{name}" for name, *_ in ROWS) == TASKS


@pytest.mark.parametrize(("name", "headline", "size"), ROWS, ids=[row[0] for row in ROWS])
@pytest.mark.parametrize("vehicle", [None, "heavy_hexa"])
def test_headline_and_size(name: str, headline: str, size: str, vehicle: str | None) -> None:
    drones = 2 if name == "Cable-v0" else 1
    spec = spec_with(f"rotorgram/{name}", vehicle=vehicle, drones=drones)
    assert spec.headline is not None
    assert spec.headline.name == headline
    number, *rotors = size.split(" + ")
    count = int(number) + (Vehicle.load(vehicle).num_rotors if rotors == ["R"] else 0)
    assert spec.observation[0].shape == (count,)


@pytest.mark.parametrize("env_id", TASKS)
def test_the_docstring_is_a_specification(env_id: str) -> None:
    text = task_type(env_id).__doc__ or ""
    for title in ("Observation", "Action", "Reward", "Start, termination, truncation"):
        assert f"## {title}" in text
    assert "Terminated" in text
    assert "Truncated" in text


def test_the_table_of_crashes() -> None:
    rows = re.findall(r"^\| (`[^|]*) \| −(\d+) \|$", PAGE, re.MULTILINE)
    costs = {name: int(cost) for names, cost in rows for name in re.findall(r"[\w-]+-v0", names)}
    assert set(costs) == {name.split("/")[1] for name in TASKS} - {"Elevation-v0"}
    for name, cost in costs.items():
        assert -100 * task_type(f"rotorgram/{name}").worst_step == pytest.approx(cost)


def test_the_bounds_are_those_that_are_computed() -> None:
    paper = Vehicle.load()
    recovery = recovery_bounds(RecoveryOptions(), paper)
    for number, unit in (
        (waypoints_time(WaypointsOptions(), paper), "s"),
        (racing_time(RacingOptions(), paper), "s"),
        (racing_time(RacingOptions(track="dive"), paper), "s"),
        (landing_time(4.0, 1.0, paper), "s"),
        (recovery["turn_upright"], "s"),
        (recovery["height_lost"], "m"),
        (payload_time(1.0, 0.1, paper), "s"),
    ):
        assert re.search(rf" {number:.2f} {unit}\b", PAGE.replace("\n", " ")), number
