"""The examination passes sound vehicles, and each fault of a broken one is found or refused."""

import json
import math
import time
import tomllib
from pathlib import Path
from typing import Any

import mujoco
import pytest
from broken_vehicles import (
    BROKEN,
    Row,
    break_vehicle,
    examination,
    markdown,
    numeric,
    read_report,
    replace,
    rows,
)
from measuring import read_rows, write_rows
from rotorgram.cli.vehicle import print_checks
from rotorgram.models import QUAD_XML, InputError, Vehicle
from rotorgram.models.checks import RULES, Check, examine, failed

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parents[1] / "data"
PAGE = (ROOT / "docs" / "physics.md").read_text()
SOUND = [QUAD_XML, *sorted(DATA.glob("*.xml"))]
COMMITTED = ROOT / "docs" / "results" / "physics" / "broken_vehicles.csv"


def by_name(found: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in found}


def faults(path: Path, *groups: str) -> set[str]:
    """Names of the checks that a vehicle fails."""
    return set(by_name(failed(examine(path, *groups))))


def broken(folder: Path, *pairs: tuple[str, str]) -> Path:
    """The paper's vehicle with replaced text."""
    return break_vehicle(folder, replace(*pairs))


# --- sound vehicles -------------------------------------------------------------------------------


@pytest.mark.parametrize("path", SOUND, ids=lambda path: path.stem)
def test_a_sound_vehicle_passes_every_check(path: Path) -> None:
    found = examine(path)
    assert not failed(found)
    assert len(by_name(found)) == len(found)
    assert all(check.source and check.meaning and check.equation for check in found)


def test_vehicles_have_the_same_checks_and_more_rotors_have_more() -> None:
    names = [check.name for check in examine(QUAD_XML)]
    assert names == [check.name for check in examine(DATA / "small.xml")]
    assert len(names) == 17
    assert len(examine(DATA / "hexa.xml")) == 19


BY_HAND = {
    # 4 · 100 N / (20 kg · 9.8 m/s²); arms of √2 m; 20 / √8 kg/m³; moments over 40 kg·m².
    "hover: thrust to weight": 400 / 196,
    "hover: margin of the tightest rotor": 100 / 49,
    "units: arm": math.sqrt(2),
    "units: mass / arm³": 20 / math.sqrt(8),
    "units: reaction / arm": 0.05 / math.sqrt(2),
    "units: smallest moment / (mass arm²)": 5.025725 / 40,
    "units: largest moment / (mass arm²)": 10.00163 / 40,
    "free fall: depth": 19.6,
    "gravity: size": 9.8,
}


def test_numbers_of_the_papers_vehicle_by_hand() -> None:
    found = by_name(examine())
    measured = {name: found[name].measured for name in BY_HAND}
    assert measured == pytest.approx(BY_HAND, rel=1e-9)


def test_an_examination_leaves_the_model_and_the_log_alone() -> None:
    vehicle = Vehicle.load(DATA / "small.xml", linear_drag=0.25)
    damping = vehicle.model.dof_damping.tolist()
    console = mujoco.MjLogConfig.get().logto_console
    examine(vehicle)
    assert vehicle.model.dof_damping.tolist() == damping
    assert vehicle.model.opt.density == 1.225
    assert vehicle.model.opt.disableflags == 0
    assert mujoco.MjLogConfig.get().logto_console == console


# --- broken vehicles ------------------------------------------------------------------------------


FAILED = json.loads((DATA / "faults.json").read_text("utf-8"))


@pytest.mark.parametrize("fault", FAILED)
def test_a_fault_fails_nothing_else(fault: str, tmp_path: Path) -> None:
    edit, _ = BROKEN[fault]
    path = break_vehicle(tmp_path, edit)
    assert faults(path) == set(FAILED[fault])


def test_the_sentence_is_that_of_flying(tmp_path: Path) -> None:
    path = broken(tmp_path, ('ctrlrange="0 100"', 'ctrlrange="0 45"'))
    with pytest.raises(InputError) as refusal:
        Vehicle.load(path)
    with pytest.raises(InputError) as again:
        examine(path)
    assert str(again.value) == str(refusal.value)


def test_a_wrong_coefficient_is_refused(tmp_path: Path) -> None:
    path = break_vehicle(tmp_path, numeric(rotors__radius=400))
    with pytest.raises(InputError, match=r"^rotors.radius: expected a number from 0.001 to 10 m,"):
        examine(path)


def test_a_long_physics_step_is_examined_soon(tmp_path: Path) -> None:
    path = broken(tmp_path, ('timestep="0.01"', 'timestep="0.5"'))
    begun = time.perf_counter()
    found = faults(path)
    assert time.perf_counter() - begun < 2.0
    assert "physics step: error of attitude" in found


# --- single groups, as a user's pytest calls them -------------------------------------------------


def test_a_path_and_a_vehicle_have_the_same_checks() -> None:
    path = DATA / "hexa.xml"
    expected = examine(path, "hover")
    assert len(expected) == 2
    assert examine(str(path), "hover") == expected
    assert examine(Vehicle.load(path), "hover") == expected
    assert examine(None, "hover") == examine(QUAD_XML, "hover")


def test_a_group_of_no_name_names_those_there_are() -> None:
    with pytest.raises(
        InputError, match=r"^groups: expected some of gravity, .*, floor, got 'hoover'"
    ):
        examine(QUAD_XML, "hoover")


@pytest.mark.parametrize(
    ("measured", "passed"), [(1.0, True), (1.25, True), (1.26, False), (math.nan, False)]
)
def test_passing_is_within_limits_and_never_nan(measured: float, passed: bool) -> None:
    check = Check(
        name="x", measured=measured, low=0.75, high=1.25, unit="m", equation="x = 1",
        source="hand", meaning="it is wrong", expected=1.0,
    )  # fmt: skip
    assert check.passed == passed
    assert check.tolerance == 0.25
    assert failed([check]) == ([] if passed else [check])


def test_the_error_of_a_step_falls_with_the_order_of_the_integrator(tmp_path: Path) -> None:
    """Turning by 0.04 and 0.02 rad in a step: RK4's falls 16 times, Euler's twice."""

    def error(step: float, integrator: str) -> float:
        steps = ('timestep="0.01"', f'timestep="{step}"')
        path = broken(tmp_path, steps, ('integrator="RK4"', f'integrator="{integrator}"'))
        return examine(path, "physics step")[0].measured

    assert error(0.01, "RK4") / error(0.005, "RK4") == pytest.approx(16, rel=0.1)
    assert error(0.01, "Euler") / error(0.005, "Euler") == pytest.approx(2, rel=0.1)


def test_a_light_craft_needs_a_shorter_step(tmp_path: Path) -> None:
    # Full torque turns it faster. RK4's error has the fourth power of the step.
    text = (DATA / "tiny.xml").read_text()
    (tmp_path / "tiny.xml").write_text(text.replace('timestep="0.005"', 'timestep="0.01"'))
    assert not faults(DATA / "tiny.xml", "physics step")
    assert faults(tmp_path / "tiny.xml", "physics step") == {"physics step: error of attitude"}


def test_a_center_of_mass_that_is_off_takes_margin(tmp_path: Path) -> None:
    # The hub of 12 kg 0.5 m in front: 0.3 m of 20 kg. Front 49 (1 + 0.3) N, of 100 N.
    path = broken(tmp_path, ('0.07" mass="12"', '0.07" pos="0.5 0 0" mass="12"'))
    found = by_name(examine(path, "hover"))
    margin = found["hover: margin of the tightest rotor"].measured
    assert margin == pytest.approx(100 / 63.7, rel=1e-6)
    assert not faults(path, "hover", "allocation")


@pytest.mark.parametrize(("high", "flies"), [(80, False), (100, True)])
def test_limits_of_force_below_those_of_control_are_refused(
    high: float, flies: bool, tmp_path: Path
) -> None:
    limited = f'ctrlrange="0 100" forcelimited="true" forcerange="0 {high}"'
    path = broken(tmp_path, ('ctrlrange="0 100"', limited))
    if flies:
        assert Vehicle.load(path).thrust_high.tolist() == [100.0] * 4
        return
    with pytest.raises(InputError, match=r"^vehicle: expected rotor rotor1 to have no forcerange"):
        examine(path)


# --- ranges ---------------------------------------------------------------------------------------

RANGES = {
    name.removeprefix("units: "): rule for name, rule in RULES.items() if name.startswith("units: ")
}
PUBLISHED = tomllib.loads((DATA / "by_hand.toml").read_text("utf-8"))["published"]


def ratios(craft: dict[str, Any]) -> dict[str, float]:
    """Those of a published vehicle, by the names of their rules."""
    arm = craft["arm"]
    inertia = craft["mass"] * arm**2
    least, largest = craft["moments"]
    found = {
        "mass / arm³": craft["mass"] / arm**3,
        "arm": arm,
        "smallest moment / (mass arm²)": least / inertia,
        "largest moment / (mass arm²)": largest / inertia,
        "reaction / arm": craft["reaction"] / arm,
    }
    if "radius" in craft:
        found["reaction / rotor radius"] = craft["reaction"] / craft["radius"]
        found["rotor radius / arm"] = craft["radius"] / arm
    return found


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_vehicles_are_in_the_ranges_and_wrong_units_are_not(name: str) -> None:
    strength = PUBLISHED[name]["strength"]
    values = ratios(PUBLISHED[name])
    for key, value in values.items():
        rule = RANGES[key]
        assert rule.low < value < rule.high, key
        assert value / 1000 < rule.low, key
        assert rule.high < value * 1000, key
    rule = RULES["hover: thrust to weight"]
    assert rule.low < strength < rule.high
    numbers = [values.get(key) for key in list(RANGES)[:7]]
    cells = " | ".join("" if value is None else f"{value:.3g}" for value in numbers)
    assert f"| {name} | {strength:g} | {cells} |" in PAGE


def test_the_ranges_are_on_the_page() -> None:
    for name, rule in {"thrust to weight": RULES["hover: thrust to weight"], **RANGES}.items():
        limits = f"{rule.low:g} to {rule.high:g} {rule.unit}".strip()
        assert f"| {name} | {limits} | {rule.source} |" in PAGE


def test_units_of_coefficients(tmp_path: Path) -> None:
    # 100 N at 1000 rad/s, on a radius of 0.1 m: 100 m/s at the tip.
    path = break_vehicle(tmp_path, numeric(rotors__radius=0.1, rotors__thrust_coefficient=1e-4))
    found = by_name(examine(path, "units"))
    assert found["units: tip speed"].measured == pytest.approx(100)
    assert found["units: reaction / rotor radius"].measured == pytest.approx(0.5)


# --- what is committed and printed ----------------------------------------------------------------


def test_the_committed_table_is_true_and_on_the_page(tmp_path: Path) -> None:
    committed = read_rows(COMMITTED, Row)
    again = rows()
    assert markdown(committed) in PAGE
    assert all(row.found for row in committed)
    assert [row.fault for row in again] == list(BROKEN)
    for old, new in zip(committed, again, strict=True):
        assert new.found
        assert old.fault == new.fault
        assert old.found_by == new.found_by
        assert old.failed == new.failed
        assert old.checks == new.checks
    write_rows(tmp_path / "new" / "table.csv", again)
    assert read_rows(tmp_path / "new" / "table.csv", Row) == again


def test_the_committed_examination_is_on_the_page() -> None:
    seconds, committed = read_report(COMMITTED.with_suffix(".json"))
    assert seconds < 1
    assert examination(committed) in PAGE
    assert not failed(committed)
    for old, new in zip(committed, examine(), strict=True):
        assert old.name == new.name
        assert old.source == new.source
        assert old.meaning == new.meaning


def test_the_table_has_a_sentence_for_each_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit, name = BROKEN["yaw signs in the pattern of roll"]
    print_checks(examine(break_vehicle(tmp_path, edit)))
    out = capsys.readouterr().out
    assert out.count("FAILED") == 1
    assert f"{name}: torques cannot be commanded apart: yaw signs in the pattern of roll" in out
    assert out.endswith("16 of 17 checks passed\n")
