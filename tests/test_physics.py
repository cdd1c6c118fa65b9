"""The vehicle flies by the closed forms, and the examination notices when it does not."""

import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest
from rotorgram.models import SCENE_XML, load_model
from rotorgram.models._measure import fly, ready
from rotorgram.models.checks import Check, closed_form_inertia, examine
from rotorgram.models.convergence import STEPS, convergence, observed_order

CHECKS = examine(load_model())


def _failed(model: mujoco.MjModel) -> set[str]:
    return {check.name for check in examine(model) if not check.passed}


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_check_passes(check: Check) -> None:
    assert check.passed, check


def test_names_are_unique_and_every_value_is_sourced() -> None:
    assert len({check.name for check in CHECKS}) == len(CHECKS)
    assert all(check.source for check in CHECKS)


@pytest.mark.parametrize(
    ("measured", "passed"), [(1.0, True), (1.25, True), (1.26, False), (math.nan, False)]
)
def test_passing_is_within_tolerance_and_never_nan(measured: float, passed: bool) -> None:
    check = Check(
        name="x", expected=1.0, measured=measured, tolerance=0.25, unit="m", source="hand"
    )
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
    model = load_model(0.25)
    examine(model)
    assert model.dof_damping.tolist() == [5.0, 5.0, 5.0, 0.0, 0.0, 0.0]


# --- broken models --------------------------------------------------------------------------------


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


def _no_limits(spec: mujoco.MjSpec) -> None:
    for actuator in spec.actuators:
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE


def _off_centre(spec: mujoco.MjSpec) -> None:
    spec.geom("hub").pos = [0.01, 0.0, 0.0]


def _air(spec: mujoco.MjSpec) -> None:
    spec.option.density = 1.225


def _no_skids(spec: mujoco.MjSpec) -> None:
    for name in ("skid left", "skid right"):
        spec.geom(name).contype = spec.geom(name).conaffinity = 0


@pytest.mark.parametrize(
    ("damage", "noticed"),
    [
        (_gravity, {"free fall in 2 s", "hover: acceleration", "climb at full thrust"}),
        (_yaw_like_roll, {"rank of the allocation matrix", "rotor 3: yaw torque per newton"}),
        (_swapped_rotors, {"rotor 1: roll torque per newton", "rotor 2: roll torque per newton"}),
        (_too_heavy, {"mass", "inertia Izz", "hover: acceleration", "climb at full thrust"}),
        (_euler, {"free fall in 2 s", "tumbling 10 s: relative change of energy"}),
        (
            _no_limits,
            {
                "thrust of all four with controls at 150 N",
                "thrust of all four with controls at −50 N",
            },
        ),
        (_off_centre, {"hover: angular acceleration", "inertia Iyy"}),
        (_air, {"free fall in 2 s"}),
        (_no_skids, {"at rest on the floor: height"}),
    ],
    ids=lambda value: value.__name__.strip("_") if callable(value) else "",
)
def test_examination_notices(damage: Callable[[mujoco.MjSpec], None], noticed: set[str]) -> None:
    spec = mujoco.MjSpec.from_file(str(SCENE_XML))
    damage(spec)
    assert noticed <= _failed(spec.compile())


def test_drag_is_noticed_by_the_frictionless_checks() -> None:
    assert "free fall in 2 s" in _failed(load_model(0.1))


def test_examination_refuses_what_is_no_quadcopter() -> None:
    pendulum = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    with pytest.raises(ValueError, match=r"expected one free joint and 4 actuators: .* got \(1, 1"):
        examine(pendulum)


def test_a_flight_with_warnings_is_no_measurement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs the warning into the working folder
    model = load_model()
    data = ready(model)
    data.qvel[0] = math.nan
    with pytest.raises(RuntimeError, match="without warnings, got mjWARN_BADQVEL"):
        fly(model, data, 0.1)


# --- the choice of integrator ---------------------------------------------------------------------


def test_rk4_is_exact_under_constant_force_and_of_fourth_order_in_tumbling() -> None:
    misses = convergence("RK4")
    assert max(miss.constant for miss in misses) < 1e-12
    assert observed_order([miss.tumbling for miss in misses]) == pytest.approx(4.0, abs=0.1)
    assert observed_order([miss.turning for miss in misses]) == pytest.approx(4.0, abs=0.1)
    assert misses[STEPS.index(0.005)].tumbling < 1e-8


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_the_cheaper_integrators_are_of_first_order(integrator: str) -> None:
    misses = convergence(integrator)
    for miss in misses:  # semi-implicit: a h t / 2 with a = 10.2 m/s², t = 1 s
        assert miss.constant == pytest.approx(10.2 * miss.timestep / 2, rel=1e-9)
    assert observed_order([miss.tumbling for miss in misses]) == pytest.approx(1.0, abs=0.1)
