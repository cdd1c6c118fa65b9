"""Metrics against values computed by hand."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from comparisons import ERROR, GATES, HEADLINE, spec_of
from rotorgram.envs import Metric
from rotorgram.training.metrics import (
    Curve,
    Headline,
    average_return,
    final_evaluations,
    first_lasting_snapshot,
    measure_run,
    overshoot,
    settling_time,
    spread_over_seeds,
    steady_state,
)
from rotorgram.training.results import COLUMNS


def evaluations(*rows: tuple[object, ...]) -> pd.DataFrame:
    """Rows of (row, seed, env_steps, steady, settling_time, terminated)."""
    names = ["row", "seed", "env_steps", "steady", "settling_time", "terminated"]
    frame = pd.DataFrame(rows, columns=names)
    frame["episode"] = frame.groupby(["row", "seed", "env_steps"]).cumcount()
    frame = frame.assign(seconds=frame["env_steps"] / 100, length=10, start=1.0, overshoot=0.2)
    return frame.assign(**{"return": 5.0})[list(COLUMNS["evaluations"])]


def per_seed(frame: pd.DataFrame, headline: Headline, name: str) -> list[float]:
    """A measure of each seed."""
    return [measure_run(run, headline)[name] for _, run in frame.groupby("seed")]


def test_the_steady_state_is_the_mean_size_of_the_last_quarter():
    sizes = HEADLINE.size(np.array([5, 4, 3, 2, 1, 1, 0.1, -0.3]))
    assert steady_state(sizes) == pytest.approx(0.2)
    assert steady_state(np.array([3.0, 2.0])) == 2.0  # at least the last step
    assert math.isnan(steady_state(np.array([])))
    assert steady_state(np.array([0.0, 0.0, 0.0, 1.0]), final=True) == 1.0  # as of a landing
    assert math.isnan(steady_state(np.array([]), final=True))


def test_of_a_final_metric_an_end_that_holds_the_goal_is_no_crash():
    landed = Metric(name="landed", unit="", goal="high", held=0.75, final=True)
    rows = [("a", 0, 100, value, math.nan, True) for value in (1.0, 1.0, 1.0, 0.0)]
    frame = evaluations(*rows, *(("a", 1, 100, 1.0, math.nan, True) for _ in range(4)))
    final = Headline.of(spec_of(landed))
    assert per_seed(frame, final, "crashed") == [1, 0]
    # Three of four are the bound: the mean counts the crash, which is not held against it again.
    assert per_seed(frame, final, "held") == [1, 1]
    once = Headline.of(spec_of(replace(landed, final=False)))
    assert per_seed(frame, once, "crashed") == [4, 4]
    assert per_seed(frame, once, "held") == [0, 0]
    for held, expected in ((0.75, 100.0), (0.76, math.nan)):
        headline = Headline.of(spec_of(replace(landed, held=held)))
        steps, _ = first_lasting_snapshot(frame[frame["seed"] == 0], headline)
        assert steps == pytest.approx(expected, nan_ok=True)


def test_a_headline_says_how_its_numbers_are_read():
    gates = Headline.of(spec_of(GATES))
    distance = Headline.of(spec_of(replace(ERROR, signed=False)))
    assert HEADLINE.size_symbol == "|E|"
    assert distance.size_symbol == "E"
    assert gates.size_symbol == "gates_passed"
    assert HEADLINE.held_text == "|E| < 0.1 m"
    assert gates.held_text == "gates_passed ≥ 3"
    assert HEADLINE.labelled("Steady |E|") == "Steady |E| (m)"
    assert gates.labelled("Steady") == "Steady"
    assert HEADLINE.size([-1.0]) == 1.0
    assert gates.size([-1.0]) == -1.0


def test_the_bound_of_a_goal():
    low = HEADLINE.holds([0.05, 0.1, math.nan])
    assert low.tolist() == [True, False, False]
    high = Headline.of(spec_of(GATES)).holds([2.9, 3.0, math.nan])
    assert high.tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ([1.0, 0.04, 0.2, 0.03, -0.04], 0.3),  # leaves the band once more at step 2
        ([0.01, 0.02], 0.0),
        ([1.0, 0.5, 0.05], math.nan),  # the band is open: 0.05 is not below 0.05
        ([0.01, 0.02, 1.0], math.nan),
        ([1.0, 0.0, math.nan], math.nan),
        ([], math.nan),
    ],
)
def test_settling_time(errors, expected):
    value = settling_time(np.array(errors), control_period=0.1, tolerance=0.05)
    assert value == pytest.approx(expected, nan_ok=True)


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ([2.0, 0.5, -0.3, 0.1], 0.3),
        ([-2.0, 0.4, -0.1], 0.4),
        ([2.0, 1.0, 0.5], 0.0),
        ([0.0, 0.1, -0.2], 0.2),
        ([], math.nan),
    ],
)
def test_overshoot(errors, expected):
    assert overshoot(np.array(errors)) == pytest.approx(expected, nan_ok=True)


def test_reaching_the_target_counts_from_the_first_snapshot_that_lasts():
    errors = {0: 2.0, 100: 0.05, 200: 0.3, 300: 0.05, 400: 0.09}
    run = evaluations(*(("a2c", 0, steps, error, 1.0, False) for steps, error in errors.items()))
    assert first_lasting_snapshot(run, HEADLINE) == (300.0, 3.0)
    assert first_lasting_snapshot(run.iloc[::-1], HEADLINE)[0] == 300.0  # whatever the rows' order
    worse = run.assign(steady=run["steady"] + 0.02)  # the last is 0.11 m
    assert np.isnan(first_lasting_snapshot(worse, HEADLINE)).all()
    gates = Headline.of(spec_of(GATES))
    passed = run.assign(steady=[5.0, 2.0, 3.0, 4.0, 3.0])
    assert first_lasting_snapshot(passed, gates) == (200.0, 2.0)


def test_a_snapshot_is_its_mean_and_a_crash_or_a_gap_is_a_miss():
    good = [("a2c", 0, 100, 0.05, 1.0, False), ("a2c", 0, 100, 0.13, 1.0, False)]
    assert first_lasting_snapshot(evaluations(*good), HEADLINE)[0] == 100.0  # mean 0.09
    crash = ("a2c", 0, 100, 0.0, math.nan, True)
    assert math.isnan(first_lasting_snapshot(evaluations(*good, crash), HEADLINE)[0])
    gap = ("a2c", 0, 100, math.nan, math.nan, False)
    assert math.isnan(first_lasting_snapshot(evaluations(*good, gap), HEADLINE)[0])


def test_a_run_holds_without_a_crash_and_without_a_gap():
    frame = evaluations(
        ("a2c", 0, 100, 0.05, 1.0, False), ("a2c", 0, 100, 0.13, 1.0, False),
        ("a2c", 1, 100, 0.01, 1.0, False), ("a2c", 1, 100, 0.01, 1.0, True),
        ("a2c", 2, 100, 0.01, 1.0, False), ("a2c", 2, 100, math.nan, math.nan, False),
        ("a2c", 3, 100, 0.2, 1.0, False),
    )  # fmt: skip
    assert per_seed(frame, HEADLINE, "held") == [1, 0, 0, 0]


def test_the_final_evaluation_is_each_runs_own_last_snapshot():
    frame = evaluations(
        ("a2c", 0, 100, 1.0, math.nan, False),
        ("a2c", 0, 200, 0.1, 2.0, False),
        ("a2c", 0, 200, 0.3, 9.0, True),
        ("a2c", 1, 150, 0.5, math.nan, False),
        ("pid", 0, 0, 0.0, 1.0, False),
    )
    assert final_evaluations(frame)["env_steps"].tolist() == [200, 200, 150, 0]
    first = measure_run(frame[(frame["row"] == "a2c") & (frame["seed"] == 0)], HEADLINE)
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
    three = spread_over_seeds([line(10, 1.0), line(10, 2.0), line(6, 6.0)], grid)
    assert three.x.tolist() == [0.0, 5.0]
    assert three.middle.tolist() == [3.0, 3.0]
    assert three.low.tolist() == [1.0, 1.0]
    assert three.high.tolist() == [6.0, 6.0]
    five = spread_over_seeds([line(10, height) for height in (0.0, 1.0, 2.0, 3.0, 40.0)], grid)
    assert five.low[0] == 1.0
    assert five.middle[0] == 2.0
    assert five.high[0] == 3.0
