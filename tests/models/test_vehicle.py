"""Vehicles from other MJCF files fly every task; tests/models/test_model.py has what is derived."""

import math
import re
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from rotorgram.cli import main
from rotorgram.envs import Loop
from rotorgram.envs.config import EnvConfig
from rotorgram.models.errors import InputError
from rotorgram.models.vehicle import Vehicle

ELEVATION = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
DATA = Path(__file__).parents[1] / "data"

UNEQUAL = """<mujoco model="unequal">
  <option timestep="0.005" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="craft" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="0.1 0.1 0.05" mass="2"/>
      <geom type="sphere" size="0.02" pos="0.05 -0.02 -0.06" mass="0.3"/>
      <site name="a" pos="0.3 0.2 0.02"/>
      <site name="b" pos="0.25 -0.3 0"/>
      <site name="c" pos="-0.2 -0.25 0"/>
      <site name="d" pos="-0.35 0.2 0.01"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="a" site="a" gear="0 0 2 0 0 0.04" ctrllimited="true" ctrlrange="0 10"/>
    <general name="b" site="b" gear="0 0 1 0 0 -0.02" gainprm="4" ctrllimited="true"
      ctrlrange="0 5"/>
    <motor name="c" site="c" gear="0 0 1 0 0 0.02" ctrllimited="true" ctrlrange="0 20"/>
    <motor name="d" site="d" gear="0 0 0.5 0 0 -0.01" ctrllimited="true" ctrlrange="0 40"/>
  </actuator>
</mujoco>"""

BODY = """<body name="craft" pos="0 0 1">
  <freejoint/>
  <geom type="box" size="0.05 0.05 0.05" mass="1"/>
  <site name="a" pos="0.2 0 0"/>
  <site name="b" pos="-0.1 0.17 0"/>
  <site name="c" pos="-0.1 -0.17 0"/>
</body>"""

INCLUDING = """<mujoco model="included">
  <option timestep="0.01" integrator="RK4"/>
  <default><motor ctrllimited="true" ctrlrange="0 9"/></default>
  <worldbody>
    <geom name="meadow" type="plane" size="0 0 1" pos="0 0 0.5"/>
    <include file="craft.xml"/>
  </worldbody>
  <actuator>
    <motor site="a" gear="0 0 1 0 0 0"/>
    <motor site="b" gear="0 0 1 0 0 0"/>
    <motor site="c" gear="0 0 1 0 0 0"/>
  </actuator>
</mujoco>"""


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    unequal = tmp_path / "unequal.xml"
    included = tmp_path / "included.xml"
    unequal.write_text(UNEQUAL)
    included.write_text(INCLUDING)
    (tmp_path / "craft.xml").write_text(f"<mujoco>{BODY}</mujoco>")
    return {"unequal": unequal, "included": included, "hexa": DATA / "hexa.xml"}


@pytest.mark.parametrize("name", ["unequal", "included", "hexa"])
def test_action_zero_hovers_and_any_other_climbs(files: dict[str, Path], name: str) -> None:
    """Every vehicle holds still, level and straight at action 0, whatever its rotors are."""
    vehicle = Vehicle.load(files[name])
    heights = {}
    for action in (0.0, 0.2):
        env = gym.make(ELEVATION, vehicle=files[name], start_band=0.0, action="offset")
        _, info = env.reset(seed=0)
        for _ in range(100):
            *_, info = env.step(np.array([action], np.float32))
        sine = math.hypot(info["qx"], info["qy"], info["qz"])
        aside = math.hypot(info["x"], info["y"])
        assert np.degrees(2 * sine) < 1e-6
        assert aside < 1e-6
        heights[action] = info["z"]
        thrusts = [info[f"F{i + 1}"] for i in range(vehicle.num_rotors)]
        # All rotors in proportion to hover: no torque, whatever the arms.
        share = np.array(thrusts) / vehicle.hover_thrust
        np.testing.assert_allclose(share, share[0], rtol=1e-9)
    assert heights[0.0] == pytest.approx(5.0, abs=1e-6)
    assert heights[0.2] > 5.0 + 0.1


@pytest.mark.parametrize("name", ["unequal", "included", "hexa"])
def test_acceleration_is_that_of_newton(files: dict[str, Path], name: str) -> None:
    """Thrust in newtons reaches the body in newtons, whatever gear and gain."""
    vehicle = Vehicle.load(files[name])
    loop = Loop(EnvConfig.from_keywords(ELEVATION, vehicle=files[name], action="offset"))
    still = np.zeros((1, 1), np.float32)
    loop.advance(still, np.ones(1, bool), [0])
    start = loop.telemetry["position"][0, 2]
    for _ in range(10):
        loop.advance(still + 0.25)
    force = float(loop.telemetry["thrust"].sum()) - vehicle.mass * vehicle.gravity
    climbed = loop.telemetry["position"][0, 2] - start
    assert climbed == pytest.approx(0.5 * force / vehicle.mass * 0.2**2, rel=1e-6)


def test_unequal_arms_gears_gains_and_an_offset_mass(files: dict[str, Path]) -> None:
    vehicle = Vehicle.load(files["unequal"])
    assert vehicle.mass == pytest.approx(2.3)
    offset = np.array([0.05, -0.02, -0.06])
    assert vehicle.center_of_mass == pytest.approx(offset * 0.3 / 2.3)
    assert vehicle.thrust_high.tolist() == pytest.approx([20.0] * 4)
    assert [rotor.newtons for rotor in vehicle.rotors] == [2.0, 4.0, 1.0, 0.5]
    for rotor, sign in zip(vehicle.rotors, (1, -1, 1, -1), strict=True):
        assert rotor.reaction == pytest.approx((0.0, 0.0, 0.02 * sign))
    hover = vehicle.hover_thrust
    assert hover.sum() == pytest.approx(2.3 * 9.81)
    arms = np.array([rotor.position for rotor in vehicle.rotors]) - vehicle.center_of_mass
    torques = hover @ arms[:, :2]
    assert torques == pytest.approx(np.zeros(2), abs=1e-9)
    assert len(set(hover.round(3).tolist())) > 1


def test_a_file_has_its_own_ground_and_no_other(files: dict[str, Path]) -> None:
    vehicle = Vehicle.load(files["included"])
    planes = vehicle.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    assert planes.sum() == 1
    assert vehicle.model.geom(int(planes.argmax())).name == "meadow"
    assert vehicle.rest_height == pytest.approx(0.55)  # a box of 0.1 m on ground at 0.5 m


def test_each_vehicle_has_the_spec_of_its_rotors(files: dict[str, Path]) -> None:
    env = gym.make(HOVER, vehicle=files["included"])
    assert env.action_space.shape == (3,)
    assert env.observation_space.shape == (18,)
    spec = env.unwrapped.env_spec  # type: ignore[attr-defined]
    assert spec.vehicle == "included"
    assert spec.vehicle_hash == Vehicle.load(files["included"]).hash
    assert spec.telemetry[4].components == ("F1", "F2", "F3")
    assert spec.telemetry[4].high == 9.0


def test_a_period_that_does_not_fit_the_files_step(files: dict[str, Path]) -> None:
    gym.make(ELEVATION, vehicle=files["unequal"], control_period=0.005)
    with pytest.raises(InputError, match=r"^control_period: .* 0.01 s, .* timestep .* got 0.015"):
        gym.make(ELEVATION, vehicle=files["included"], control_period=0.015)


def test_a_shorter_period_shortens_the_physics_step(files: dict[str, Path]) -> None:
    config = EnvConfig(env_id=ELEVATION, vehicle=str(files["included"]), control_period=0.005)
    assert config.load_vehicle().timestep == 0.005
    assert Vehicle.load(files["included"]).timestep == 0.01


def test_a_policy_flies_another_vehicle_only_if_the_user_names_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ("--vehicle", str(DATA / "small.xml"))
    run = str(tmp_path / "run")
    task = ("--env", HOVER, "--num-envs", "4", "--env-steps", "256")
    assert main(["train", "a2c", *task, *small, "--out", run]) == 0
    paper = ("--vehicle", str(Vehicle.load().path))
    capsys.readouterr()
    returns = []
    for named in (small, (), paper):
        assert main(["evaluate", run, "--episodes", "1", *named]) == 0
        returns.append(re.findall("return .*", capsys.readouterr().out))
    assert returns[0] == returns[1] != returns[2]
