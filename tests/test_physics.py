"""Vehicles fly by the closed forms, and the examination notices when one does not."""

import math
import runpy
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rotorgram.models import QUAD_XML, InputError, Vehicle
from rotorgram.models.checks import Check, closed_form_inertia, examine

ROOT = Path(__file__).parent.parent
DATA = Path(__file__).parent / "data"
CHECKS = {
    name: examine(Vehicle.load(path))
    for name, path in (("paper", None), ("hexa", DATA / "hexa.xml"), ("small", DATA / "small.xml"))
}
EVERY = [
    pytest.param(check, id=f"{vehicle}: {check.name}")
    for vehicle, checks in CHECKS.items()
    for check in checks
]


@pytest.mark.parametrize("check", EVERY)
def test_check_passes(check: Check) -> None:
    assert check.passed, check


def test_names_are_unique_and_every_value_is_sourced() -> None:
    for checks in CHECKS.values():
        assert len({check.name for check in checks}) == len(checks)
        assert all(check.source for check in checks)


def test_every_vehicle_has_the_same_checks_and_the_papers_has_more() -> None:
    paper, hexa, small = (
        {check.name for check in checks if "per newton" not in check.name}
        for checks in CHECKS.values()
    )
    assert hexa == small < paper
    rotors = [sum("torques per newton" in c.name for c in checks) for checks in CHECKS.values()]
    assert rotors == [4, 6, 4]


@pytest.mark.parametrize(
    ("measured", "passed"), [(1.0, True), (1.25, True), (1.26, False), (math.nan, False)]
)
def test_passing_is_within_tolerance_and_never_nan(measured: float, passed: bool) -> None:
    check = Check("x", 1.0, measured, "m", "hand", tolerance=0.25)
    assert check.passed is passed


def test_inertia_by_hand() -> None:
    # Hub, 12 kg, 0.44 x 0.44 x 0.14: x: 0.44^2 + 0.14^2 = 0.2132; z: 2 * 0.44^2 = 0.3872.
    # An arm, 1.2 kg, r 0.035, L^2 = 2: along 1.2 * 0.001225 / 2 = 0.000735;
    #   across 1.2 * (0.003675 + 2) / 12 + 1.2 * 0.5 = 0.2003675 + 0.6 = 0.8003675.
    # A motor, 0.8 kg, r 0.09, h 0.12: x: 0.8 * (0.0243 + 0.0144) / 12 + 0.8 = 0.80258;
    #   z: 0.8 * 0.0081 / 2 + 0.8 * 2 = 1.60324.
    ixx = 0.2132 + 2 * (0.000735 + 0.8003675) + 4 * 0.80258
    izz = 0.3872 + 4 * 0.8003675 + 4 * 1.60324
    assert (ixx, izz) == pytest.approx((5.025725, 10.00163), abs=1e-12)
    assert closed_form_inertia() == pytest.approx((ixx, izz), abs=1e-12)


def test_examination_leaves_the_model_alone() -> None:
    vehicle = Vehicle.load(DATA / "small.xml", linear_drag=0.25)
    before = vehicle.model.dof_damping.copy(), vehicle.model.opt.density
    examine(vehicle)
    assert vehicle.model.dof_damping.tolist() == before[0].tolist()
    assert vehicle.model.opt.density == before[1] == 1.225
    assert vehicle.model.opt.disableflags == 0


def test_the_page_tells_every_check_of_the_papers_vehicle() -> None:
    page = (ROOT / "docs" / "physics.md").read_text()
    for check in CHECKS["paper"]:
        assert f"| {check.name} | {check.expected:.7g} |" in page
        assert f"| {check.tolerance:.0e} | {check.unit} | {check.source} |" in page


# --- damaged models -------------------------------------------------------------------------------


def _gravity(spec: mujoco.MjSpec) -> None:
    spec.option.gravity = [0.0, 0.0, -9.81]


def _yaw_like_roll(spec: mujoco.MjSpec) -> None:
    for name, sign in zip(("rotor1", "rotor2", "rotor3", "rotor4"), (1, -1, -1, 1), strict=True):
        spec.actuator(name).gear = [0.0, 0.0, 1.0, 0.0, 0.0, sign * 0.05]


def _swapped_rotors(spec: mujoco.MjSpec) -> None:
    spec.site("rotor1").pos, spec.site("rotor2").pos = [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]


def _too_heavy(spec: mujoco.MjSpec) -> None:
    spec.geom("hub").mass = 13.0


def _euler(spec: mujoco.MjSpec) -> None:
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER


def _other_limits(spec: mujoco.MjSpec) -> None:
    for actuator in spec.actuators:
        actuator.ctrlrange = [-60.0, 160.0]


def _off_centre(spec: mujoco.MjSpec) -> None:
    spec.geom("hub").pos = [0.01, 0.0, 0.0]


def _air(spec: mujoco.MjSpec) -> None:
    spec.option.density = 1.225


def _no_skids(spec: mujoco.MjSpec) -> None:
    for name in ("skid left", "skid right"):
        spec.geom(name).contype = spec.geom(name).conaffinity = 0


def _weak_motors(spec: mujoco.MjSpec) -> None:
    for actuator in spec.actuators:
        actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [0, 80]


def _armature(spec: mujoco.MjSpec) -> None:
    spec.joint("free").armature = 0.1


DAMAGES: list[tuple[Callable[[mujoco.MjSpec], None], set[str]]] = [
    (_gravity, {"2 s at no thrust: acceleration", "2 s at 49 N each: acceleration"}),
    (_yaw_like_roll, {"rank of the allocation matrix", "rear left rotor: yaw torque per newton"}),
    (
        _swapped_rotors,
        {f"front {side} rotor: roll torque per newton" for side in ("left", "right")},
    ),
    (_too_heavy, {"mass of the paper", "inertia Izz", "2 s at 100 N each: acceleration"}),
    (_euler, {"free fall in 2 s", "tumbling 10 s: relative change of energy"}),
    (_other_limits, {f"thrust of all four when asked for {x} N each" for x in (150, -50)}),
    (_off_centre, {"inertia Iyy", "centre of mass off the geometrical centre"}),
    (_air, {"2 s at no thrust: acceleration"}),
    (_no_skids, {"height of rest"}),
    (_weak_motors, {"thrust of all when asked for more than they have"}),
    (_armature, {"mass", "inertia: difference of the matrices"}),
]


@pytest.mark.parametrize(
    ("damage", "noticed"), DAMAGES, ids=[damage.__name__.strip("_") for damage, _ in DAMAGES]
)
def test_examination_notices(
    tmp_path: Path, damage: Callable[[mujoco.MjSpec], None], noticed: set[str]
) -> None:
    spec = mujoco.MjSpec.from_file(str(QUAD_XML))
    spec.delete(spec.key("hover"))
    damage(spec)
    spec.compile()
    spec.to_file(str(tmp_path / "damaged.xml"))
    checks = examine(Vehicle.load(tmp_path / "damaged.xml"), paper=True)
    assert noticed <= {check.name for check in checks if not check.passed}


def test_drag_is_noticed_by_the_frictionless_checks() -> None:
    failed = {check.name for check in examine(Vehicle.load(linear_drag=0.1)) if not check.passed}
    assert "2 s at no thrust: acceleration" in failed


def test_a_hexacopter_is_not_the_papers() -> None:
    with pytest.raises(InputError, match="vehicle: expected the 4 rotors of the paper, got 6"):
        examine(Vehicle.load(DATA / "hexa.xml"), paper=True)


def _changed(folder: Path, old: str, new: str) -> Path:
    text = (DATA / "hexa.xml").read_text()
    assert old in text
    (folder / "changed.xml").write_text(text.replace(old, new))
    return folder / "changed.xml"


def test_a_tiny_physics_step_is_refused_before_any_flight(tmp_path: Path) -> None:
    vehicle = Vehicle.load(_changed(tmp_path, 'timestep="0.005"', 'timestep="0.00005"'))
    with pytest.raises(InputError, match=r"at least 0\.0001 s to be examined, got 5e-05"):
        examine(vehicle)


def test_a_flight_with_warnings_is_no_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs the warning into the working folder
    path = _changed(tmp_path, 'timestep="0.005"', 'timestep="0.05"')
    vehicle = Vehicle.load(path, linear_drag=100.0)  # RK4 is unstable above 2.78 / 0.05 s
    with pytest.raises(InputError, match="vehicle: expected a flight without warnings, got mjWARN"):
        examine(vehicle)


def test_ctrl_c_ends_an_examination(tmp_path: Path) -> None:
    path = _changed(tmp_path, 'timestep="0.005"', 'timestep="0.0001"')
    code = (
        "import threading, signal, sys\n"
        "from rotorgram.models import Vehicle\n"
        "from rotorgram.models.checks import examine\n"
        "vehicle = Vehicle.load(sys.argv[1])\n"
        "threading.Timer(0.2, signal.raise_signal, [signal.SIGINT]).start()\n"
        "examine(vehicle)\n"
        "print('examined')\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (-signal.SIGINT, "")
    assert done.stderr.endswith("KeyboardInterrupt\n")


# --- accuracy against cost ------------------------------------------------------------------------

COMMITTED = ROOT / "docs" / "results" / "physics" / "accuracy.csv"
_script = runpy.run_path(str(ROOT / "benchmarks" / "accuracy.py"))
accuracy, markdown, read, write = (_script[n] for n in ("accuracy", "markdown", "read", "write"))


def _order(integrator: str, steps: tuple[float, ...]) -> float:
    """Slope of log(error) over log(step)."""
    rows = accuracy(Vehicle.load(), [integrator], steps)
    return float(np.polyfit(np.log(steps), np.log([row.position_m for row in rows]), 1)[0])


def test_rk4_is_of_fourth_order_in_tumbling_flight() -> None:
    assert _order("RK4", (0.004, 0.005, 0.01, 0.02)) == pytest.approx(4.0, abs=0.1)


@pytest.mark.parametrize("integrator", ["Euler", "implicit", "implicitfast"])
def test_the_others_are_of_first_order(integrator: str) -> None:
    assert _order(integrator, (0.002, 0.004, 0.005, 0.01)) == pytest.approx(1.0, abs=0.1)


def test_a_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    rows = accuracy(Vehicle.load(DATA / "small.xml"), ["RK4"], [0.01, 0.02])
    write(tmp_path / "new" / "table.csv", rows)
    assert read(tmp_path / "new" / "table.csv") == rows


def test_the_committed_table_is_of_this_vehicle_and_on_the_page() -> None:
    rows = read(COMMITTED)
    assert markdown(rows) in (ROOT / "docs" / "physics.md").read_text()
    again = accuracy(Vehicle.load(), ["RK4", "Euler"], [0.005, 0.01])
    told = {(row.integrator, row.step_ms): row for row in rows}
    for row in again:
        committed = told[row.integrator, row.step_ms]
        assert row.position_m == pytest.approx(committed.position_m, rel=0.05)
        assert row.attitude_deg == pytest.approx(committed.attitude_deg, rel=0.05)
        assert row.sinks_mm == pytest.approx(committed.sinks_mm, rel=1e-3)


def test_the_step_of_the_papers_vehicle_is_as_true_as_the_page_says() -> None:
    rows = {(row.integrator, row.step_ms): row for row in read(COMMITTED)}
    ours = rows["RK4", Vehicle.load().timestep * 1e3]
    assert ours.position_m < 1e-6
    assert ours.sinks_mm == pytest.approx(rows["RK4", 2].sinks_mm, rel=0.02)
    assert ours.cost_us < 0.6 * rows["RK4", 5].cost_us
    assert rows["Euler", 5].position_m > 0.1
