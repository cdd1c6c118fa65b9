"""The paper's vehicle flies by the paper's numbers and by closed forms; accuracy against cost."""

from math import exp
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from accuracy import Accuracy, accuracy, markdown
from measuring import read_rows, write_rows
from numpy.testing import assert_allclose
from rotorgram.models import Vehicle
from tables import SIM

approx = pytest.approx
ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parents[1] / "data"

# Drones 2023, 7, 225, section 2.2. The paper gives no inertia: that is of our geometry, below.
MASS, GRAVITY, MAX_THRUST = 20.0, 9.8, 100.0  # kg, m/s², N
IXX, IZZ = 5.025725, 10.00163  # kg·m²
SPIN = (1.0, 2.0, 3.0)  # rad/s


def ready(vehicle: Vehicle, thrust: Any = 0.0) -> Any:
    """Level, at rest, 1000 m above the floor, with thrusts in N."""
    data = mujoco.MjData(vehicle.model)
    data.qpos[:] = (0, 0, 1000, 1, 0, 0, 0)
    data.ctrl[:] = thrust
    return data


def fly(vehicle: Vehicle, data: Any, seconds: float) -> None:
    mujoco.mj_step(vehicle.model, data, nstep=round(seconds / vehicle.timestep))


def acceleration(vehicle: Vehicle, data: Any) -> np.ndarray:
    """Of the free joint, (6,), m/s², rad/s²."""
    mujoco.mj_forward(vehicle.model, data)
    return np.array(data.qacc)


# --- the paper's vehicle --------------------------------------------------------------------------


def test_inertia_by_hand() -> None:
    # Hub, 12 kg, 0.44 x 0.44 x 0.14: x: 0.44^2 + 0.14^2 = 0.2132; z: 2 * 0.44^2 = 0.3872.
    # An arm, 1.2 kg, r 0.035, L^2 = 2: along 1.2 * 0.001225 / 2 = 0.000735;
    #   across 1.2 * (0.003675 + 2) / 12 + 1.2 * 0.5 = 0.2003675 + 0.6 = 0.8003675.
    #   It lies at 45 degrees: of its moments x sees the mean, and z sees that across.
    # A motor, 0.8 kg, r 0.09, h 0.12: x: 0.8 * (0.0243 + 0.0144) / 12 + 0.8 = 0.80258;
    #   z: 0.8 * 0.0081 / 2 + 0.8 * 2 = 1.60324.
    ixx = 0.2132 + 2 * (0.000735 + 0.8003675) + 4 * 0.80258
    izz = 0.3872 + 4 * 0.8003675 + 4 * 1.60324
    assert (ixx, izz) == approx((IXX, IZZ), abs=1e-12)
    expected = np.diag([ixx, ixx, izz])
    assert_allclose(Vehicle.load().inertia, expected, atol=1e-9)


def test_forces_and_torques_meet_the_mass_and_the_inertia_of_the_paper() -> None:
    vehicle = Vehicle.load()
    data = ready(vehicle)
    fall = acceleration(vehicle, data)
    expected = [0, 0, -GRAVITY, 0, 0, 0]
    assert fall == approx(expected, abs=1e-9)
    for axis, size in enumerate((MASS, MASS, MASS, IXX, IXX, IZZ)):
        push = np.eye(6)[axis]
        data.qfrc_applied[:] = push
        answer = acceleration(vehicle, data) - fall
        assert answer == approx(push / size, abs=1e-9)


@pytest.mark.parametrize(("rotor", "torque"), SIM["torques"]["rows"])
def test_a_rotor_pushes_up_and_turns(rotor: int, torque: list[float]) -> None:
    vehicle = Vehicle.load()
    thrusts = np.zeros(4)
    thrusts[rotor] = MAX_THRUST
    data = ready(vehicle, thrusts)
    answer = acceleration(vehicle, data)
    assert answer[2] == approx(MAX_THRUST / MASS - GRAVITY, abs=1e-9)
    expected = MAX_THRUST * np.array(torque)
    found = answer[3:] * (IXX, IXX, IZZ)
    assert found == approx(expected, abs=1e-8)


@pytest.mark.parametrize(("asked", "given"), [(0, 0), (49, 49), (100, 100), (150, 100), (-50, 0)])
def test_two_seconds_at_equal_thrusts(asked: float, given: float) -> None:
    vehicle = Vehicle.load()
    data = ready(vehicle, asked)
    fly(vehicle, data, 2.0)
    climb = 4 * given / MASS - GRAVITY  # -9.8, 0 and 10.2 m/s²
    found = data.qpos[2] - 1000
    assert found == approx(2 * climb, abs=1e-9)
    expected = [0, 0]
    assert data.qpos[:2] == approx(expected, abs=1e-9)


def test_tumbling_is_that_of_a_symmetric_top() -> None:
    # With Ixx = Iyy the rates about x and y turn about body z at (Izz - Ixx) / Ixx * wz.
    vehicle = Vehicle.load()
    data = ready(vehicle)
    data.qvel[3:] = SPIN
    fly(vehicle, data, 10.0)
    turned = complex(1, 2) * np.exp(1j * (IZZ - IXX) / IXX * 3 * 10)
    expected = [turned.real, turned.imag, 3]
    assert data.qvel[3:] == approx(expected, abs=1e-6)
    assert data.qpos[2] == approx(1000 - 490, abs=1e-9)


def test_it_rests_on_its_skids() -> None:
    vehicle = Vehicle.load()
    data = ready(vehicle)
    data.qpos[2] = 0.45
    fly(vehicle, data, 5.0)
    assert data.qpos[2] == approx(0.4, abs=1e-3)  # contacts are soft: it sinks by 0.1 mm
    assert np.abs(data.qvel).max() < 1e-6


# --- linear drag: Unity's Rigidbody.drag, in the limit of small steps -----------------------------


@pytest.mark.parametrize("name", ["hexa.xml", "small.xml"])
def test_linear_drag_is_a_force_and_no_torque(name: str) -> None:
    with_drag, without = (Vehicle.load(DATA / name, linear_drag=d) for d in (0.5, 0.0))
    answers = []
    for vehicle in (with_drag, without):
        data = ready(vehicle)
        data.qvel[:3] = (6, -8, 10)
        mujoco.mj_forward(vehicle.model, data)
        answers.append(data.qfrc_passive.copy())
    force = -0.5 * without.mass * np.array((6, -8, 10))
    expected = [*force, 0, 0, 0]
    found = answers[0] - answers[1]
    assert found == approx(expected, abs=1e-9)


def test_linear_drag_slows_a_hover_and_not_its_turn() -> None:
    vehicle = Vehicle.load(linear_drag=0.5)
    data = ready(vehicle, 49)
    data.qvel[:] = (10, 0, 0, 0, 0, 1)
    fly(vehicle, data, 2.0)
    expected = 10 * exp(-1)
    assert data.qvel[0] == approx(expected, abs=1e-9)
    assert data.qvel[5] == approx(1, abs=1e-9)


# --- accuracy against cost ------------------------------------------------------------------------

COMMITTED = ROOT / "docs" / "results" / "physics" / "accuracy.csv"


def _order(integrator: str, steps: tuple[float, ...]) -> float:
    """Slope of log(error) over log(step)."""
    rows = accuracy(Vehicle.load(), [integrator], steps)
    return float(np.polyfit(np.log(steps), np.log([row.position_m for row in rows]), 1)[0])


def test_rk4_is_of_fourth_order_in_tumbling_flight() -> None:
    found = _order("RK4", (0.004, 0.005, 0.01, 0.02))
    assert found == approx(4.0, abs=0.1)


@pytest.mark.parametrize("integrator", ["Euler", "implicit", "implicitfast"])
def test_the_others_are_of_first_order(integrator: str) -> None:
    found = _order(integrator, (0.002, 0.004, 0.005, 0.01))
    assert found == approx(1.0, abs=0.1)


def test_a_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    rows = accuracy(Vehicle.load(DATA / "small.xml"), ["RK4"], [0.01, 0.02])
    write_rows(tmp_path / "new" / "table.csv", rows)
    assert read_rows(tmp_path / "new" / "table.csv", Accuracy) == rows


def test_the_committed_table_is_of_this_vehicle_and_on_the_page() -> None:
    rows = read_rows(COMMITTED, Accuracy)
    assert markdown(rows) in (ROOT / "docs" / "physics.md").read_text()
    again = accuracy(Vehicle.load(), ["RK4", "Euler"], [0.005, 0.01])
    told = {(row.integrator, row.step_ms): row for row in rows}
    for row in again:
        committed = told[row.integrator, row.step_ms]
        assert row.position_m == approx(committed.position_m, rel=0.05)
        assert row.attitude_deg == approx(committed.attitude_deg, rel=0.05)
        assert row.sinks_mm == approx(committed.sinks_mm, rel=1e-3)


def test_the_step_of_the_papers_vehicle_is_as_true_as_the_page_says() -> None:
    rows = {(row.integrator, row.step_ms): row for row in read_rows(COMMITTED, Accuracy)}
    ours = rows["RK4", Vehicle.load().timestep * 1e3]
    assert ours.position_m < 1e-6
    expected = rows["RK4", 2].sinks_mm
    assert ours.sinks_mm == approx(expected, rel=0.02)
    assert ours.cost_us < 0.6 * rows["RK4", 5].cost_us
    assert rows["Euler", 5].position_m > 0.1
