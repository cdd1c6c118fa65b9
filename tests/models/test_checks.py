"""The examination passes sound vehicles, and finds each fault of a broken one by its own check."""

import inspect
import json
import math
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from broken_vehicles import (
    BROKEN,
    Row,
    break_vehicle,
    examination,
    inertial,
    markdown,
    numeric,
    reactions,
    read_report,
    replace,
    rows,
)
from measuring import read_rows, write_rows
from rotorgram.cli.vehicle import print_checks
from rotorgram.models import QUAD_XML, InputError, Vehicle, checks
from rotorgram.models.checks import (
    RANGES,
    THRUST_TO_WEIGHT,
    Check,
    ExaminedModel,
    check_allocation,
    check_hover,
    check_integrator,
    check_physics_step,
    check_rotors,
    check_terminal_velocity,
    check_trim,
    check_turns,
    check_units,
    examine,
    failed,
    recommended_step,
)

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parents[1] / "data"
PAGE = (ROOT / "docs" / "physics.md").read_text()
SOUND = [QUAD_XML, *sorted(DATA.glob("*.xml"))]
COMMITTED = ROOT / "docs" / "results" / "physics" / "broken_vehicles.csv"


def by_name(found: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in found}


def broken(folder: Path, *pairs: tuple[str, str]) -> Path:
    """The paper's vehicle with replaced text."""
    path: Path = break_vehicle(folder, replace(*pairs))
    return path


# --- sound vehicles -------------------------------------------------------------------------------


@pytest.mark.parametrize("path", SOUND, ids=lambda path: path.stem)
def test_a_sound_vehicle_passes_every_check(path: Path) -> None:
    found = examine(path)
    assert not failed(found)
    assert len(by_name(found)) == len(found)
    assert all(check.source and check.meaning for check in found)


def test_the_papers_vehicle_is_examined_in_less_than_a_second() -> None:
    begun = time.perf_counter()
    examine()
    assert time.perf_counter() - begun < 1.0


def test_vehicles_have_the_same_checks_and_more_rotors_have_more() -> None:
    quad, hexa = (
        {check.name for check in examine(path)} for path in (QUAD_XML, DATA / "small.xml")
    )
    assert quad == hexa
    assert [len(examine(path)) for path in (QUAD_XML, DATA / "hexa.xml")] == [59, 71]


def test_numbers_of_the_papers_vehicle_by_hand() -> None:
    found = by_name(examine())
    # 4 · 100 N / (20 kg · 9.8 m/s²); arms of √2 m; 20 / √8 kg/m³; moments over 40 kg·m².
    for name, value in (
        ("hover: thrust to weight", 400 / 196),
        ("hover: thrust of rotor3", 49.0),
        ("hover: margin of the tightest rotor", 100 / 49),
        ("units: arm", math.sqrt(2)),
        ("units: mass / arm³", 20 / math.sqrt(8)),
        ("units: reaction / arm", 0.05 / math.sqrt(2)),
        ("units: smallest moment / (mass arm²)", 5.025725 / 40),
        ("units: largest moment / (mass arm²)", 10.00163 / 40),
        ("inertia: triangle inequality", 10.05145 / 10.00163),
        ("mass against a force of 1 N", 20.0),
        ("allocation: condition", 1.0),
        ("free fall: depth", 19.6),
        ("gravity: size", 9.8),
    ):
        assert found[name].measured == pytest.approx(value, rel=1e-9), name
    assert found["hover: thrust of rotor3"].note == "25 % of weight"


def test_examination_leaves_the_model_alone() -> None:
    vehicle = Vehicle.load(DATA / "small.xml", linear_drag=0.25)
    before = vehicle.model.dof_damping.copy()
    examine(vehicle)
    assert vehicle.model.dof_damping.tolist() == before.tolist()
    assert vehicle.model.opt.density == 1.225
    assert vehicle.model.opt.disableflags == 0


def test_warnings_are_heard_again_after_an_examination() -> None:
    before = mujoco.MjLogConfig.get()
    examine()
    assert mujoco.MjLogConfig.get().logto_console == before.logto_console


# --- broken vehicles ------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_vehicle_fails_by_the_right_check(fault: str, tmp_path: Path) -> None:
    edit, name = BROKEN[fault]
    found = examine(break_vehicle(tmp_path, edit))
    assert name in by_name(failed(found))


def test_nothing_is_found_where_nothing_is_broken(tmp_path: Path) -> None:
    assert not failed(examine(break_vehicle(tmp_path, lambda text: text)))


def test_there_are_many_faults_and_nearly_as_many_checks_that_find_them() -> None:
    assert len(BROKEN) >= 30
    assert len({name for _, name in BROKEN.values()}) >= 28


@pytest.mark.parametrize(
    ("fault", "names"),
    [
        ("reaction a hundred times too large", {"units: reaction / arm"}),
        ("physics step too long for its inertia", {"physics step"}),
        ("motors faster than the physics step", {"physics step"}),
        ("lengths in millimetres",
         {"units: arm", "units: mass / arm³", "units: reaction / arm"}),
        ("inertia against the triangle inequality",
         {"inertia: triangle inequality", "accepted by --vehicle"}),
        ("yaw signs in the pattern of roll",
         {"allocation: rank", "allocation: yaw apart from roll", "allocation: condition"}),
        ("yaw signs in the pattern of pitch",
         {"allocation: rank", "allocation: yaw apart from pitch", "allocation: condition"}),
    ],
)  # fmt: skip
def test_a_fault_fails_nothing_else(fault: str, names: set[str], tmp_path: Path) -> None:
    edit, _ = BROKEN[fault]
    assert set(by_name(failed(examine(break_vehicle(tmp_path, edit))))) == names


@pytest.mark.parametrize("rotor", [1, 2, 3, 4])
def test_the_rotor_with_the_wrong_sign_is_named(rotor: int, tmp_path: Path) -> None:
    signs = [1, -1, 1, -1]
    signs[rotor - 1] *= -1
    path = break_vehicle(tmp_path, reactions(*(0.05 * sign for sign in signs)))
    found = set(by_name(failed(check_turns(path))))
    assert found == {"turns: yaw of equal thrusts", f"turns: neighbours like rotor{rotor}"}


def test_every_reason_is_told_at_once(tmp_path: Path) -> None:
    path = broken(
        tmp_path,
        ('gravity="0 0 -9.8"', 'gravity="0 0 9.8"'),
        ('integrator="RK4"', ""),
        ('contype="1" conaffinity="1"', 'contype="0" conaffinity="0"'),
        ('ctrlrange="0 100"', 'ctrlrange="0 10"'),
    )
    found = set(by_name(failed(examine(path))))
    assert found >= {
        "accepted by --vehicle", "gravity: part along -z", "integrator: observed order",
        "hover: thrust to weight", "hover: thrust of rotor2",
    }  # fmt: skip


def test_what_flying_says_stands_in_the_first_check(tmp_path: Path) -> None:
    path = broken(tmp_path, ('ctrlrange="0 100"', 'ctrlrange="0 45"'))
    with pytest.raises(InputError) as refusal:
        Vehicle.load(path)
    assert examine(path)[0].meaning == str(refusal.value)


def test_a_wrong_coefficient_is_a_check(tmp_path: Path) -> None:
    path = break_vehicle(tmp_path, numeric(rotors__radius=400))
    found = by_name(failed(examine(path)))
    assert set(found) == {"accepted by --vehicle", "coefficients: faults"}
    assert found["coefficients: faults"].meaning.startswith(
        "rotors.radius: expected a number from 0.001"
    )


def test_a_negative_moment_is_found_although_mujoco_takes_it(tmp_path: Path) -> None:
    path = break_vehicle(tmp_path, inertial('diaginertia="-5 5 10"'))
    assert "inertia: smallest / largest moment" in by_name(failed(examine(path)))


def test_a_file_without_gravity_is_examined(tmp_path: Path) -> None:
    found = by_name(failed(examine(broken(tmp_path, ('gravity="0 0 -9.8"', 'gravity="0 0 0"')))))
    assert {"gravity: part along -z", "gravity: size", "hover: thrust to weight"} <= set(found)


@pytest.mark.parametrize("step", ["1e-8", "0.5", "1e300"])
def test_any_physics_step_is_examined_soon(step: str, tmp_path: Path) -> None:
    begun = time.perf_counter()
    found = examine(broken(tmp_path, ('timestep="0.01"', f'timestep="{step}"')))
    assert "physics step" in by_name(failed(found))
    assert time.perf_counter() - begun < 2.0


FREE = '<freejoint name="free"/>'
SECOND = '<body pos="3 0 0"><freejoint/><geom size="0.1" mass="1"/></body></worldbody>'


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (FREE, "", "expected one free body and no other joints, got 0 free of 0 joints"),
        ("</worldbody>", SECOND, "expected one free body and no other joints, got 2 free of 2"),
        ('ctrlrange="0 100"', 'ctrlrange="0 inf"', "finite numbers, got others in actuator_c"),
        ("<mujoco", "<robot", "expected an MJCF file, got broken.xml: "),
    ],
)
def test_a_file_that_is_no_craft_is_one_sentence(
    old: str, new: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"^vehicle: .*{said}") as refusal:
        examine(broken(tmp_path, (old, new)))
    assert "\n" not in str(refusal.value)


# --- single groups, as a user's pytest calls them -------------------------------------------------


def test_groups_take_a_path_a_vehicle_or_a_craft() -> None:
    path = DATA / "hexa.xml"
    expected = [check.report() for check in check_hover(path)]
    for subject in (str(path), Vehicle.load(path), ExaminedModel.read(path)):
        assert [check.report() for check in check_hover(subject)] == expected
    assert [check.report() for check in check_hover()] == [
        check.report() for check in check_hover(QUAD_XML)
    ]


def test_every_group_has_a_name_of_its_own_and_examine_runs_it() -> None:
    groups = {n: g for n, g in inspect.getmembers(checks, callable) if n.startswith("check_")}
    assert set(groups.values()) == set(checks.CHECKS)
    assert [c.name for group in checks.CHECKS for c in group(QUAD_XML)] == [
        check.name for check in examine()
    ]
    for name in groups:
        assert f"`{name}`" in PAGE


@pytest.mark.parametrize(
    ("measured", "passed"), [(1.0, True), (1.25, True), (1.26, False), (math.nan, False)]
)
def test_passing_is_within_limits_and_never_nan(measured: float, passed: bool) -> None:
    check = Check(name="x", measured=measured, low=0.75, high=1.25, unit="m", source="hand",
                  meaning="it is wrong", expected=1.0)  # fmt: skip
    assert check.passed == passed
    assert check.tolerance == 0.25
    assert [one.name for one in failed([check])] == ([] if passed else ["x"])
    assert check.report()["measured"] == (None if math.isnan(measured) else measured)


def test_euler_is_of_first_order_and_rk4_of_fourth(tmp_path: Path) -> None:
    euler = broken(tmp_path, ('integrator="RK4"', 'integrator="Euler"'))
    assert check_integrator(euler)[0].measured == pytest.approx(1, abs=0.1)
    for path in SOUND:
        assert check_integrator(path)[0].measured == pytest.approx(4, abs=0.1)


def test_the_recommended_step_by_its_rule(tmp_path: Path) -> None:
    # Contacts of MuJoCo's default have 20 ms.
    assert recommended_step() == (0.01, "half the time constant of contacts")
    lag = break_vehicle(tmp_path, numeric(rotors__time_constant=0.004))
    assert recommended_step(lag) == (0.002, "time constant of the motors")
    lags = break_vehicle(
        tmp_path, numeric(rotors__time_constant=0.03, rotors__time_constant_down=0.0055)
    )
    assert recommended_step(lags) == (0.005, "time constant of the motors")
    euler = broken(tmp_path, ('integrator="RK4"', ""))
    assert recommended_step(euler) == (5e-5, "error of attitude of 0.01° a second")
    found = by_name(check_physics_step(euler))["physics step"]
    assert (found.measured, found.passed) == (0.01, False)


def test_euler_misses_a_free_fall_in_proportion_to_the_step(tmp_path: Path) -> None:
    # Of g t² / 2 it misses g h t / 2: 4.9 m in a second for each second of step.
    euler = ExaminedModel.read(broken(tmp_path, ('integrator="RK4"', "")))
    assert euler.convergence.fall == pytest.approx(4.9, rel=1e-6)
    assert ExaminedModel.read().convergence.fall < 1e-9


def test_the_error_is_as_large_as_predicted() -> None:
    craft = ExaminedModel.read(DATA / "tiny.xml")
    found = craft.convergence
    reached = []
    for steps in (40, 3200):  # of a flight in which it turns by 8 rad
        model = craft.falling(gravity=np.zeros(3), timestep=8 / found.turn / steps)
        data = craft.ready(model=model)
        data.qvel[3:] = found.turn * np.array((1, 2, 3)) / math.sqrt(14)
        data.qfrc_applied[3] = 0.05 * craft.moments[0] * found.turn**2
        mujoco.mj_step(model, data, nstep=steps)
        reached.append(np.array(data.qpos[3:]))
    apart = 4 * math.asin(math.dist(*reached) / 2)
    assert found.at(0.2 / found.turn) * 8 / found.turn == pytest.approx(apart, rel=0.1)


def test_a_light_craft_needs_a_shorter_step() -> None:
    # Full torque turns it faster, and the error of RK4 has the fourth power of the step.
    heavy = ExaminedModel.read()
    light = ExaminedModel.read(DATA / "tiny.xml")
    assert light.convergence.turn > 5 * heavy.convergence.turn
    assert light.convergence.at(0.01) == pytest.approx(16 * light.convergence.at(0.005), rel=0.2)
    assert light.convergence.at(0.01) > 1000 * heavy.convergence.at(0.01)


@pytest.mark.parametrize(
    ("drag", "final"),
    [
        ({"drag__linear": "0 0 10"}, 19.6),  # m g / c
        ({"drag__quadratic": "0 0 1.96"}, 10.0),  # √(m g / c)
        ({"drag__linear": "0 0 9.8", "drag__quadratic": "0 0 0.98"}, 10.0),  # 98 + 98 N = m g
    ],
)
def test_terminal_velocity_by_hand(drag: dict[str, Any], final: float, tmp_path: Path) -> None:
    fall, units = check_terminal_velocity(break_vehicle(tmp_path, numeric(**drag)))
    assert units.measured == pytest.approx(final, rel=1e-12)
    assert fall.measured == pytest.approx(final, rel=1e-3)
    assert fall.passed


def test_linear_drag_of_a_vehicle_has_a_terminal_velocity_too() -> None:
    _, units = check_terminal_velocity(Vehicle.load(linear_drag=0.5))
    assert units.measured == pytest.approx(9.8 / 0.5)
    assert check_terminal_velocity() == []


def test_a_center_of_mass_that_is_off_moves_the_shares(tmp_path: Path) -> None:
    # The hub of 12 kg 0.5 m in front: 0.3 m of 20 kg. Front 49 (1 + 0.3), rear 49 (1 - 0.3).
    path = broken(tmp_path, ('0.07" mass="12"', '0.07" pos="0.5 0 0" mass="12"'))
    found = by_name(check_hover(path))
    for rotor, newtons in enumerate((63.7, 63.7, 34.3, 34.3), 1):
        assert found[f"hover: thrust of rotor{rotor}"].measured == pytest.approx(newtons, rel=1e-6)
    assert not failed([*check_hover(path), *check_trim(path), *check_allocation(path)])


def test_limits_of_force_are_measured(tmp_path: Path) -> None:
    path = broken(
        tmp_path, ('ctrlrange="0 100"', 'ctrlrange="0 100" forcelimited="true" forcerange="0 80"')
    )
    # 80 N come of 100: 0.2 N are missing of each newton, and with arms of 1 m 0.2 N·m.
    for check in failed(check_rotors(path)):
        assert check.name.startswith("effect of rotor")
        assert check.measured == pytest.approx(0.2, rel=1e-6)
    assert len(failed(check_rotors(path))) == 4


# --- ranges ---------------------------------------------------------------------------------------

PUBLISHED = {
    # mass kg, arm m, least and largest moment kg·m², reaction m, radius m, thrust to weight
    "Crazyflie 2, RotorPy": (0.03, 0.043, 1.43e-5, 2.89e-5, 7.8e-10 / 2.3e-8, None, 1.95),
    "Crazyflie 2, gym-pybullet-drones": (
        0.027, 0.0397, 1.4e-5, 2.17e-5, 7.94e-12 / 3.16e-10, 0.0231348, 2.25),
    "AscTec Hummingbird, RotorPy": (0.5, 0.17, 3.65e-3, 7.03e-3, 1.36e-7 / 5.57e-6, 0.1, 10.2),
    "AscTec Firefly, RotorS": (1.53, 0.215, 0.0347563, 0.0977, 0.016, 0.1, 2.4),
    "AscTec Neo with 11 inch propellers, RotorS": (
        3.45, 0.2895, 0.060887, 0.148916, 0.016754, 0.1397, 2.47),
    "Skydio X2, mujoco_menagerie": (
        1.325, 0.228035, 0.0254117, 0.0607113, 0.0201, 0.13, 4.0),
    "the paper's, rotorgram": (20.0, 1.41421, 5.025725, 10.00163, 0.05, 0.4, 2.04),
}  # fmt: skip


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_vehicles_are_in_the_ranges_and_wrong_units_are_not(name: str) -> None:
    mass, arm, least, largest, reaction, radius, strength = PUBLISHED[name]
    values = {
        "mass / arm³": mass / arm**3,
        "arm": arm,
        "smallest moment / (mass arm²)": least / (mass * arm**2),
        "largest moment / (mass arm²)": largest / (mass * arm**2),
        "reaction / arm": reaction / arm,
    }
    if radius:
        values |= {"reaction / rotor radius": reaction / radius, "rotor radius / arm": radius / arm}
    for key, value in values.items():
        low = RANGES[key].low
        high = RANGES[key].high
        assert low < value < high, key
        if key != "arm":
            assert value / 1000 < low < high < value * 1000, key
    assert arm / 1000 < RANGES["arm"].low < RANGES["arm"].high < arm * 1000
    assert THRUST_TO_WEIGHT.low < strength < THRUST_TO_WEIGHT.high
    told = [values.get(key) for key in list(RANGES)[:7]]
    cells = " | ".join("" if value is None else f"{value:.3g}" for value in told)
    assert f"| {name} | {strength:g} | {cells} |" in PAGE


def test_the_ranges_are_on_the_page() -> None:
    for name, limits in {"thrust to weight": THRUST_TO_WEIGHT, **RANGES}.items():
        unit = f" {limits.unit}" if limits.unit else ""
        assert f"| {name} | {limits.low:g} to {limits.high:g}{unit} | {limits.source} |" in PAGE


def test_units_of_coefficients(tmp_path: Path) -> None:
    # 100 N at 1000 rad/s, on a radius of 0.1 m: 100 m/s at the tip.
    path = break_vehicle(tmp_path, numeric(rotors__radius=0.1, rotors__thrust_coefficient=1e-4))
    found = by_name(check_units(path))
    assert found["units: tip speed"].measured == pytest.approx(100)
    assert found["units: reaction / rotor radius"].measured == pytest.approx(0.5)


# --- what is committed and printed ----------------------------------------------------------------


def test_the_committed_table_is_true_and_on_the_page(tmp_path: Path) -> None:
    committed = read_rows(COMMITTED, Row)
    again = rows()
    assert markdown(committed) in PAGE
    assert all(row.found for row in committed)
    for old, new in zip(committed, again, strict=True):
        assert old.fault == new.fault
        assert old.found_by == new.found_by
        assert old.failed == new.failed
        assert old.checks == new.checks
        assert old.flies == new.flies
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


def test_json_has_stable_keys(capsys: pytest.CaptureFixture[str]) -> None:
    print_checks(examine(DATA / "tiny.xml"), as_json=True)
    report = json.loads(capsys.readouterr().out)
    assert set(report) == {"passed", "checks"}
    assert report["passed"] is True
    for check in report["checks"]:
        assert set(check) == {
            "name", "measured", "expected", "tolerance", "low", "high", "unit", "source", "meaning",
            "note", "passed",
        }  # fmt: skip


def test_the_table_has_a_sentence_for_each_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit, name = BROKEN["yaw signs in the pattern of roll"]
    print_checks(examine(break_vehicle(tmp_path, edit)))
    out = capsys.readouterr().out
    assert out.count("FAILED") == 3
    assert f"{name}: yaw signs follow the pattern of roll: none without the other\n" in out
    assert out.endswith("56 of 59 checks passed\n")
