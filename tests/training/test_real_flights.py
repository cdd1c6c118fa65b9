"""The benchmark against recorded flights: its formulas, and the page that shows its figures."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rotorgram.models.vehicle import Vehicle
from rotorgram.models.vehicle_file import read_vehicle_file

pytest.importorskip("scipy")
pytest.importorskip("pandas")

import real_flights
from flight_logs import FlightLog
from prediction import Windows, numbers_of, predict

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results" / "real_flights"


def flight(count: int, velocity: float, start: float = 0.0) -> FlightLog:
    """Along x at a constant velocity, level, with rotors at rest."""
    states = np.zeros((count, 13))
    states[:, 0] = start + velocity * 0.01 * np.arange(count)
    states[:, 3] = 1.0
    states[:, 7] = velocity
    return FlightLog(
        name=f"flight{velocity:g}", period=0.01, states=states, speeds=np.zeros((count, 4))
    )


def test_the_published_formula_compares_the_end_of_a_flight_with_the_next() -> None:
    """Two flights of 12 samples, horizon 10: two starts each, in a table of four rows."""
    windows = Windows.cut([flight(12, 1.0), flight(12, 2.0, 50.0)], 10, 1, (1, 10))
    held = windows.start  # no step changes it
    position, _, velocity, _ = real_flights.published_formula(held, windows, 1)
    assert position == pytest.approx((0.01 + 0.01 + 0.02 + 0.02) / 4)
    assert velocity == pytest.approx(0.0)
    # Horizon 3: rows 2 and 3 of the table are of the second flight, at 50.02 and 50.04 m; the
    # predictions are those of the first one, at 0 and 0.01 m.
    position, _, velocity, _ = real_flights.published_formula(held, windows, 3)
    assert position == pytest.approx((50.02 + 50.03) / 2)
    assert velocity == pytest.approx(1.0)


def test_the_simulator_falls_from_each_start() -> None:
    vehicle = Vehicle.load(ROOT / "studies" / "nanodrone.toml")
    windows = Windows.cut([flight(60, 1.5)], 50, 5, (1, 10, 50))
    flown = real_flights.simulated(vehicle, windows)
    assert flown.shape == (2, 3, 13)
    end = flown[:, 2]
    np.testing.assert_allclose(end[:, 0], windows.start[:, 0] + 1.5 * 0.5, atol=1e-9)
    np.testing.assert_allclose(end[:, 2], -0.5 * 9.81 * 0.25, atol=1e-9)
    np.testing.assert_allclose(end[:, 3], 1.0)
    np.testing.assert_allclose(end[:, 9], -9.81 * 0.5, atol=1e-9)
    np.testing.assert_allclose(end[:, 10:], 0.0, atol=1e-12)


def test_the_baseline_lets_the_rates_decay_whatever_the_rotors_do() -> None:
    """Roll rates fall with a time constant of 0.25 s while one rotor is faster than the others."""
    (baseline,) = [one for one in real_flights.VARIANTS if one.name == "rates decay, no torques"]
    time = 0.01 * np.arange(120)
    flights = []
    for rate in (1.0, -2.0):
        angle = 0.25 * rate * (1 - np.exp(-time / 0.25))
        log = flight(120, 0.0)
        log.states[:, 10] = rate * np.exp(-time / 0.25)
        log.states[:, 3] = np.cos(angle / 2)
        log.states[:, 4] = np.sin(angle / 2)
        log.speeds[:] = (1750.0, 1720.0, 1720.0, 1690.0)
        flights.append(log)
    vehicle = Vehicle.load(ROOT / "studies" / "nanodrone.toml")
    windows = Windows.cut(flights, 50, 10, (10, 25, 50))
    damping = replace(baseline, groups=real_flights.DAMPING)
    numbers = real_flights._fitted(damping, vehicle, numbers_of(vehicle), windows, flights)
    predicted = predict(vehicle, [real_flights._flown(damping, numbers)], windows)[0]
    for place, horizon in ((1, 25), (2, 50)):
        expected = windows.start[:, 10:] * np.exp(-horizon / 25)
        np.testing.assert_allclose(predicted[:, place, 10:], expected, atol=0.02)


def test_the_page_has_the_figures_of_the_benchmark() -> None:
    page = (ROOT / "docs" / "real-flights.md").read_text(encoding="utf-8").replace("**", "")
    summary = json.loads((RESULTS / "summary.json").read_text())
    chosen = summary["model"]
    assert summary["unseen_score"][chosen] == min(summary["unseen_score"].values())
    with (RESULTS / "variants.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["formula"] == "published formula"]
    measures = ("position_m", "velocity_m_s", "attitude_rad", "rates_rad_s")
    count = 0
    for row in rows:
        if row["horizon"] != "50":
            continue
        numbers = [f"{float(row[name]):.3f}" for name in measures]
        name = row["model"]
        score = summary["unseen_score"].get(name)
        if score is not None:
            assert f"| {name} | {' | '.join(numbers[:3])} | {score:.2f} |" in page
        if name == chosen or name.startswith("published"):
            shown = "ours" if name == chosen else name
            assert f"| {shown} | {' | '.join(numbers)} |" in page
        count += 1
    assert count == 17
    position, attitude, velocity, _ = summary["ours"]
    assert f"{position:.3f} m, {velocity:.3f} m/s and {attitude:.3f} rad" in page


def test_ours_is_ahead_of_the_published_rows_at_half_a_second() -> None:
    summary = json.loads((RESULTS / "summary.json").read_text())
    assert summary["starts"] == 19347
    ours = summary["ours_by_the_published_formula"]
    published = summary["published"]
    for name in ("physics", "hybrid"):
        assert all(a < b for a, b in zip(ours, published[name], strict=True))


def test_the_library_says_what_was_measured_of_its_file() -> None:
    told = json.loads((RESULTS / "crazyflie_brushless.json").read_text(encoding="utf-8"))
    vehicle = Vehicle.load("crazyflie_brushless")
    now = real_flights.moving_numbers(vehicle)
    assert told["numbers"].keys() == now.keys()
    for name, number in now.items():
        np.testing.assert_allclose(told["numbers"][name], number, rtol=1e-12, err_msg=name)
    position, attitude, velocity, _ = told["errors"]["50"]
    file = read_vehicle_file(vehicle.path)
    written = {one.name: one.value for one in file.numbers}
    for name, value in (("position", position), ("velocity", velocity), ("attitude", attitude)):
        assert written[f"real_flights.{name}"] == pytest.approx(value, rel=5e-3)
    assert file.real_flights == "0.596 m, 3.7 m/s, 1.84 rad"
