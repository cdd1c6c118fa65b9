"""Metrics against values computed by hand."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from comparisons import ERROR, GATES, HEADLINE, spec_of
from rotorgram.envs import Metric
from rotorgram.training.metrics import (
    Curve,
    Headline,
    average_return,
    first_lasting_snapshot,
    measure_run,
    overshoot,
    settling_time,
    spread_over_seeds,
    steady_state,
)
from rotorgram.training.results import COLUMNS

DATA = Path(__file__).parents[1] / "data"
BY_HAND = tomllib.loads((DATA / "measures.toml").read_text())


def evaluations(*names: str) -> pd.DataFrame:
    """Evaluation episodes of the data, by name."""
    columns = ["row", "seed", "env_steps", "steady", "settling_time", "terminated"]
    rows = [row for name in names for row in BY_HAND["evaluations"][name]]
    frame = pd.DataFrame(rows, columns=columns)
    frame["episode"] = frame.groupby(["row", "seed", "env_steps"]).cumcount()
    frame["seconds"] = frame["env_steps"] / 100
    frame = frame.assign(length=10, start=1.0, overshoot=0.2)
    frame["return"] = 5.0
    return frame[list(COLUMNS["evaluations"])]


def per_seed(frame: pd.DataFrame, headline: Headline, name: str) -> list[float]:
    """A measure of each seed."""
    return [measure_run(run, headline)[name] for _, run in frame.groupby("seed")]


def headline_of(metric: Metric, **changes: Any) -> Headline:
    """The headline of a metric, with some changes."""
    return Headline.of(spec_of(replace(metric, **changes)))


def test_the_steady_state_is_the_mean_size_of_the_last_quarter():
    sizes = HEADLINE.size(np.array([5, 4, 3, 2, 1, 1, 0.1, -0.3]))
    assert steady_state(sizes) == pytest.approx(0.2)
    assert steady_state(np.array([3.0, 2.0])) == 2.0  # at least the last step
    assert math.isnan(steady_state(np.array([])))
    assert steady_state(np.array([0.0, 0.0, 0.0, 1.0]), final=True) == 1.0  # as of a landing
    assert math.isnan(steady_state(np.array([]), final=True))


def test_of_a_final_metric_an_end_that_holds_the_goal_is_no_crash():
    landed = Metric(name="landed", unit="", goal="high", held=0.75, final=True)
    frame = evaluations("landings")
    final = headline_of(landed)
    assert per_seed(frame, final, "crashed") == [1, 0]
    # Three of four are the bound: the mean counts the crash, which is not held against it again.
    assert per_seed(frame, final, "held") == [1, 1]
    once = headline_of(landed, final=False)
    assert per_seed(frame, once, "crashed") == [4, 4]
    assert per_seed(frame, once, "held") == [0, 0]
    first = frame[frame["seed"] == 0]
    steps, _ = first_lasting_snapshot(first, headline_of(landed, held=0.75))
    assert steps == 100.0
    steps, _ = first_lasting_snapshot(first, headline_of(landed, held=0.76))
    assert math.isnan(steps)


def test_a_headline_says_how_its_numbers_are_read():
    gates = headline_of(GATES)
    distance = headline_of(ERROR, signed=False)
    assert HEADLINE.size_symbol == "|E|"
    assert distance.size_symbol == "E"
    assert gates.size_symbol == "gates_passed"
    assert HEADLINE.held_text == "|E| < 0.1 m"
    assert gates.held_text == "gates_passed ≥ 3"
    assert HEADLINE.labelled("Steady |E|") == "Steady |E| (m)"
    assert gates.labelled("Steady") == "Steady"
    assert HEADLINE.size(np.array([-1.0])) == 1.0
    assert gates.size(np.array([-1.0])) == -1.0


def test_the_bound_of_a_goal():
    low = HEADLINE.holds([0.05, 0.1, math.nan])
    assert low.tolist() == [True, False, False]
    high = headline_of(GATES).holds([2.9, 3.0, math.nan])
    assert high.tolist() == [False, True, False]


@pytest.mark.parametrize(("errors", "expected"), BY_HAND["settling"])
def test_settling_time(errors: list[float], expected: float) -> None:
    value = settling_time(np.array(errors), control_period=0.1, tolerance=0.05)
    assert value == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(("errors", "expected"), BY_HAND["overshoot"])
def test_overshoot(errors: list[float], expected: float) -> None:
    assert overshoot(np.array(errors)) == pytest.approx(expected, nan_ok=True)


def test_reaching_the_target_counts_from_the_first_snapshot_that_lasts():
    run = evaluations("snapshots")
    assert first_lasting_snapshot(run, HEADLINE) == (300.0, 3.0)
    backwards = run.iloc[::-1]
    assert first_lasting_snapshot(backwards, HEADLINE)[0] == 300.0
    worse = run.assign(steady=run["steady"] + 0.02)  # the last is 0.11 m
    assert np.isnan(first_lasting_snapshot(worse, HEADLINE)).all()
    passed = run.assign(steady=[5.0, 2.0, 3.0, 4.0, 3.0])
    assert first_lasting_snapshot(passed, headline_of(GATES)) == (200.0, 2.0)


def test_a_snapshot_is_its_mean_and_a_crash_or_a_gap_is_a_miss():
    steps, _ = first_lasting_snapshot(evaluations("good"), HEADLINE)
    assert steps == 100.0  # mean 0.09
    for miss in ("crash", "gap"):
        steps, _ = first_lasting_snapshot(evaluations("good", miss), HEADLINE)
        assert math.isnan(steps)


def test_a_run_holds_without_a_crash_and_without_a_gap():
    assert per_seed(evaluations("seeds"), HEADLINE, "held") == [1, 0, 0, 0]


def test_the_final_evaluation_is_each_runs_own_last_snapshot():
    frame = evaluations("last_snapshots")
    a2c = frame[frame["row"] == "a2c"]
    first = measure_run(a2c[a2c["seed"] == 0], HEADLINE)
    assert first["steady"] == pytest.approx(0.2)
    assert first["settling_time"] == 2.0  # a crash has not settled, whatever its row says
    assert first["episodes"] == 2
    assert first["settled"] == 1
    assert first["crashed"] == 1
    pid = measure_run(frame[frame["row"] == "pid"], HEADLINE)
    # An agent that is not trained has reached nothing by training.
    assert math.isnan(pid["env_steps_to_hold"])


def test_average_return_is_a_mean_over_a_share_of_training():
    run = pd.DataFrame({"last_step": [10, 20, 30, 40], "return": [1.0, 2.0, 4.0, 8.0]})
    curve = average_return(run, share=0.5)  # the last 20 steps: two episodes
    assert curve.x.tolist() == [10, 20, 30, 40]
    assert curve.y.tolist() == [1.0, 1.5, 3.0, 6.0]
    assert average_return(run, share=0.01).y.tolist() == [1.0, 2.0, 4.0, 8.0]


def test_spread_over_seeds_keeps_to_what_all_seeds_reach():
    def line(end: float, height: float) -> Curve:
        return Curve(np.array([0.0, end]), np.array([height, height]))

    grid = np.array([0.0, 5.0, 10.0])
    curves = [line(10, 1.0), line(10, 2.0), line(6, 6.0)]
    three = spread_over_seeds(curves, grid)
    assert three.x.tolist() == [0.0, 5.0]
    assert three.middle.tolist() == [3.0, 3.0]
    assert three.low.tolist() == [1.0, 1.0]
    assert three.high.tolist() == [6.0, 6.0]
    curves = [line(10, height) for height in (0.0, 1.0, 2.0, 3.0, 40.0)]
    five = spread_over_seeds(curves, grid)
    assert five.low[0] == 1.0
    assert five.middle[0] == 2.0
    assert five.high[0] == 3.0
