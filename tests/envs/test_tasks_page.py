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
    drones = task_type(f"rotorgram/{name}").min_drones
    spec = spec_with(f"rotorgram/{name}", vehicle=vehicle, drones=drones)
    assert spec.headline is not None
    assert spec.headline.name == headline
    number, *rotors = size.split(" + ")
    count = int(number)
    if rotors == ["R"]:
        count += Vehicle.load(vehicle).num_rotors
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
    costs = {}
    for names, cost in rows:
        for name in re.findall(r"[\w-]+-v0", names):
            costs[f"rotorgram/{name}"] = int(cost)
    assert set(costs) == {*TASKS} - {"rotorgram/Elevation-v0"}
    for env_id, cost in costs.items():
        worst = task_type(env_id).worst_step
        assert -100 * worst == pytest.approx(cost)


def test_the_bounds_are_those_that_are_computed() -> None:
    paper = Vehicle.load()
    recovery = recovery_bounds(RecoveryOptions(), paper)
    text = PAGE.replace("\n", " ")
    height_lost = recovery["height_lost"]
    assert re.search(rf" {height_lost:.2f} m\b", text)
    times = [recovery["turn_upright"]]
    times.append(waypoints_time(WaypointsOptions(), paper))
    times.append(racing_time(RacingOptions(), paper))
    times.append(racing_time(RacingOptions(track="dive"), paper))
    times.append(landing_time(4.0, 1.0, paper))
    times.append(payload_time(1.0, 0.1, paper))
    for time in times:
        assert re.search(rf" {time:.2f} s\b", text), time
