"""Options and arithmetic of the elevation task against values worked out by hand."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contracts import TABLES, observed, rows_of, spec_with
from hypothesis import given
from hypothesis import strategies as st
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.specification import make_task
from rotorgram.envs.tasks.elevation import ElevationOptions
from rotorgram.sim import WorldState

from flights import about
from flights import state_of as one_state

ID = "rotorgram/Elevation-v0"


def state_of(n: int, **arrays: Any) -> WorldState:
    """Level craft at rest at 5 m and at hover thrust, but for the arrays that are given."""
    one = one_state()
    fields = {}
    for name in ("position", "quaternion", "velocity", "body_rates", "thrust", "touching"):
        usual = getattr(one, name)
        values = np.asarray(arrays.get(name, [usual] * n), usual.dtype)
        fields[name] = values.reshape(n, 1, *usual.shape)
    return WorldState(**fields, command=fields["thrust"])


def task_of(n: int, target: float = 5.0, **options: Any) -> Any:
    config = EnvConfig.from_keywords(ID, **{"target": target, **options})
    task: Any = make_task(config, shape=(n, 1))
    task.memory.target = np.full((n, 1), target)
    return task


# --- options ----------------------------------------------------------------------------------


def test_defaults() -> None:
    assert asdict(ElevationOptions()) == {
        "target": 5.0,
        "start_band": 1.0,
        "flight_band": 3.0,
        "action_type": "continuous",
        "observation": "full",
        "thrust_scale": None,
    }


# --- bounds -----------------------------------------------------------------------------------


def test_bounds_by_hand() -> None:
    # 2 * 10.2 * 6 = 122.4; half a period at 10.2 m/s2: 0.102, squared 0.010404.
    # sqrt(122.410404) = 11.06392354; one period more: + 0.204.
    low, high = spec_with(ID).observation[0].bounds()
    np.testing.assert_allclose(high, [3.2253585, 11.267928, 100 / 49 - 1], rtol=1e-6)
    np.testing.assert_allclose(low, [-3.2253585, -11.267928, -1.0], rtol=1e-6)


def test_float32_bounds_lie_outside_the_float64_ones() -> None:
    for band in np.linspace(1.1, 40.0, 50).tolist():
        task = task_of(1, flight_band=band)
        low, high = task.observation[0].bounds()
        assert (high.astype(np.float32) == high).all()
        assert (high > (task.error_bound, task.rate_bound, 51 / 49)).all()
        assert low[2] < -1
        assert (low[:2] == -high[:2]).all()


# --- arithmetic -------------------------------------------------------------------------------


@rows_of("thrust", "options, cases", ids=str)
def test_thrust(options: dict[str, Any], cases: list[tuple[float, float, float]]) -> None:
    present, actions, expected = (np.array(column) for column in zip(*cases, strict=True))
    state = state_of(len(cases), thrust=np.repeat(present, 4))
    controller = task_of(len(cases), **options).controller
    sent = actions.astype(float).reshape(-1, 1, 1)
    thrust = controller.thrust(sent, state)
    given = np.broadcast_to(thrust, (len(cases), 1, 4))
    assert given.tolist() == [[[f] * 4] for f in expected]


@rows_of("reward", "error, reward")
def test_reward(error: float, reward: float) -> None:
    state = state_of(2, position=[[0, 0, 5.0 - error]] * 2, touching=[False, True])
    outcome = task_of(2).outcome(state)
    assert outcome.reward["elevation"].ravel() == pytest.approx(reward)
    assert outcome.reward["termination"].ravel().tolist() == [0.0, -20.0]
    assert outcome.metrics["elevation_error"].ravel() == pytest.approx(error)


@given(st.floats(-100, 100), st.floats(-100, 100))
def test_reward_falls_with_distance_and_is_bounded(a: float, b: float) -> None:
    near, far = sorted((a, b), key=abs)
    task = task_of(2, target=1000.0)
    state = state_of(2, position=[[0, 0, 1000.0 - near], [0, 0, 1000.0 - far]])
    first, second = task.outcome(state).reward["elevation"].ravel()
    assert -1 < second <= first <= 1


def test_ends_by_hand() -> None:
    heights, tilts, touching, expected = zip(*TABLES["elevation: ends"], strict=True)
    places = [[0, 0, z] for z in heights]
    turned = [about((0.6, 0.8, 0), degrees) for degrees in tilts]
    state = state_of(7, position=places, quaternion=turned, touching=touching)
    ended = task_of(7).outcome(state).terminated
    assert ended.ravel().tolist() == list(expected)


def test_observation_by_hand() -> None:
    state = state_of(1, position=[0, 0, 4.25], velocity=[1, 2, -0.5], thrust=[73.5] * 4)
    full = observed(task_of(1), state)
    assert full.tolist() == [[[0.75, 0.5, 0.5]]]
    error = observed(task_of(1, observation="error"), state)
    assert error.tolist() == [[[0.75]]]


# --- the page ---------------------------------------------------------------------------------


def test_the_page_tells_the_metrics_of_both_tasks() -> None:
    page = (Path(__file__).parents[2] / "docs" / "task.md").read_text()
    expected = []
    for env_id in (ID, "rotorgram/Hover-v0"):
        for metric in spec_with(env_id).metrics:
            bounds = [f"{x:g}" if x else "" for x in (metric.settled, metric.held)]
            name = env_id.split("/")[1]
            expected.append([name, metric.name, metric.unit, *bounds])
    told = []
    for line in page.splitlines():
        if re.match(r"\| `\w+-v0` \| `\w+_error`", line):
            cells = [cell.strip(" `") for cell in line.strip("| ").split("|")]
            task, metric, *rest = [*cells, ""][:5]
            told.append([task, metric.split("`")[0], *rest])
    assert told == expected


def test_the_page_and_the_class_tell_the_same_numbers() -> None:
    page = (Path(__file__).parents[2] / "docs" / "task.md").read_text()
    config = EnvConfig(env_id=ID)
    options = ElevationOptions()
    for sentence in (
        f"| {options.target:g} m, or drawn from (low, high)",
        f"uniform within {options.start_band:g} m of the target",
        f"| {options.flight_band:g} m about the target",
        f"| {config.control_period:g} s |",
        f"| {config.episode_length} steps, 5 s |",
        "(s − \\|E\\|) / (s + \\|E\\|), s = 0.5 m",
        "5 N per unit and step; 20 N as an offset",
    ):
        assert sentence in page
