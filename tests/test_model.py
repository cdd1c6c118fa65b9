"""The MJCF: it states the numbers of `constants`, and nothing that nobody asked for."""

import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rotorgram.models import QUAD_XML, SCENE_XML, constants, load_model, loading, model_hash

ROTORS = ("rotor1", "rotor2", "rotor3", "rotor4")


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return load_model()


@pytest.fixture
def hovering(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("hover").id)
    mujoco.mj_forward(model, data)
    return data


def test_constants_are_the_papers_numbers() -> None:
    assert constants.MASS == 20.0
    assert constants.GRAVITY == 9.8
    assert constants.NUM_ROTORS == 4
    assert constants.MAX_THRUST == 100.0
    assert math.isclose(constants.HOVER_THRUST, 49.0, abs_tol=1e-12)
    assert math.isclose(constants.MAX_CLIMB_ACCELERATION, 10.2, abs_tol=1e-12)


def test_masses_of_the_parts_sum_to_the_whole() -> None:
    parts = constants.HUB_MASS + 4 * constants.ARM_MASS + 4 * constants.MOTOR_MASS
    assert parts == pytest.approx(constants.MASS, abs=1e-12)


def test_options(model: mujoco.MjModel) -> None:
    assert model.opt.timestep == constants.PHYSICS_TIMESTEP
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.gravity.tolist() == [0.0, 0.0, -constants.GRAVITY]
    assert model.opt.density == 0.0  # no air, so no aerodynamics
    assert model.opt.viscosity == 0.0
    assert model.opt.wind.tolist() == [0.0, 0.0, 0.0]
    assert model.opt.disableflags == 0
    assert model.opt.enableflags == 0


def test_one_free_body_and_four_thrusts(model: mujoco.MjModel) -> None:
    assert (model.nq, model.nv, model.nu, model.na) == (7, 6, 4, 0)
    assert model.jnt_type.tolist() == [mujoco.mjtJoint.mjJNT_FREE]
    assert [model.actuator(i).name for i in range(4)] == list(ROTORS)
    assert model.actuator_ctrlrange.tolist() == [[0.0, constants.MAX_THRUST]] * 4
    assert model.actuator_ctrllimited.all()


def test_nothing_is_added_silently(model: mujoco.MjModel) -> None:
    for name in ("dof_damping", "dof_armature", "dof_frictionloss", "jnt_stiffness"):
        assert not getattr(model, name).any(), name


def test_rotors_sit_where_constants_say_and_push_along_body_z(model: mujoco.MjModel) -> None:
    for i, rotor in enumerate(ROTORS):
        assert model.site(rotor).pos.tolist() == [*constants.ROTOR_POSITIONS[i], 0.0]
        yaw = constants.YAW_SIGNS[i] * constants.YAW_MOMENT_CONSTANT
        assert model.actuator(rotor).gear.tolist() == [0.0, 0.0, 1.0, 0.0, 0.0, yaw]


def test_yaw_differs_from_roll_and_pitch() -> None:
    roll = [math.copysign(1, y) for _, y in constants.ROTOR_POSITIONS]
    pitch = [math.copysign(1, -x) for x, _ in constants.ROTOR_POSITIONS]
    yaw = list(constants.YAW_SIGNS)
    opposite = [-sign for sign in yaw]
    assert roll not in (yaw, opposite)
    assert pitch not in (yaw, opposite)
    assert np.linalg.matrix_rank([[1, 1, 1, 1], roll, pitch, yaw]) == 4


def test_yaw_constant_follows_from_a_measured_propeller() -> None:
    # APC 10x4.7 at 6528 rpm, UIUC's static data: C_T 0.1274, C_P 0.0531; k = D C_P / (2 pi C_T)
    scaled = constants.ROTOR_DIAMETER * 0.0531 / (2 * math.pi * 0.1274)
    assert scaled == pytest.approx(0.0531, abs=1e-4)
    assert math.isclose(constants.YAW_MOMENT_CONSTANT, scaled, rel_tol=0.1)


def test_every_mass_is_written_out() -> None:
    geoms = mujoco.MjSpec.from_file(str(QUAD_XML)).geoms
    assert not any(math.isnan(geom.mass) for geom in geoms)
    assert all(geom.density == 0.0 for geom in geoms)
    heavy = {geom.name: geom.mass for geom in geoms if geom.mass > 0}
    assert heavy.pop("hub") == constants.HUB_MASS
    assert [heavy.pop(f"arm{i}") for i in range(1, 5)] == [constants.ARM_MASS] * 4
    assert [heavy.pop(f"motor{i}") for i in range(1, 5)] == [constants.MOTOR_MASS] * 4
    assert not heavy


def test_geometry_is_that_of_constants(model: mujoco.MjModel) -> None:
    assert (2 * model.geom("hub").size).tolist() == list(constants.HUB_SIZE)
    for i, place in enumerate(constants.ROTOR_POSITIONS, start=1):
        arm, motor = model.geom(f"arm{i}"), model.geom(f"motor{i}")
        half = constants.ARM_LENGTH / 2
        assert arm.size[:2] == pytest.approx([constants.ARM_RADIUS, half], abs=1e-15)
        assert arm.pos == pytest.approx([place[0] / 2, place[1] / 2, 0.0], abs=1e-15)
        assert motor.size[:2].tolist() == [constants.MOTOR_RADIUS, constants.MOTOR_HEIGHT / 2]
        assert motor.pos.tolist() == [*place, 0.0]
        assert 2 * model.geom(f"disc{i}").size[0] == constants.ROTOR_DIAMETER
    skid = model.geom("skid left")
    assert skid.size[0] - skid.pos[2] == pytest.approx(constants.REST_HEIGHT, abs=1e-15)


def test_mass_is_centred(model: mujoco.MjModel) -> None:
    assert model.body("quad").mass[0] == pytest.approx(20.0, abs=1e-12)
    assert model.body("quad").ipos == pytest.approx([0.0, 0.0, 0.0], abs=1e-15)


def test_front_is_marked_and_symmetric_otherwise(model: mujoco.MjModel) -> None:
    mark = model.geom("front mark")
    assert mark.pos[0] > 0.1
    assert mark.pos[1] == 0.0
    materials = [model.geom(f"disc{i}").matid[0] for i in range(1, 5)]
    assert materials[0] == materials[1] != materials[2] == materials[3]
    assert model.mat(materials[0]).name == "front disc"


def test_without_what_is_only_looked_at_the_physics_is_the_same() -> None:
    models = load_model(0.3), load_model(0.3, visual=False)
    assert models[0].ngeom > models[1].ngeom
    dice, contacts = np.random.default_rng(0), 0
    data = [mujoco.MjData(model) for model in models]
    for one in data:
        one.qpos[:] = [0, 0, 3, 0.99, 0.1, 0.05, 0.02]
        one.qpos[3:] /= np.linalg.norm(one.qpos[3:])
    for _ in range(300):
        thrusts = dice.uniform(20, 70, 4)
        for model, one in zip(models, data, strict=True):
            one.ctrl[:] = thrusts
            mujoco.mj_step(model, one, 4)
        contacts += data[0].ncon
        for name in ("qpos", "qvel", "qacc", "sensordata"):
            assert getattr(data[0], name).tobytes() == getattr(data[1], name).tobytes()
        assert data[0].ncon == data[1].ncon
    assert contacts > 0  # it came down


def test_only_few_geoms_collide(model: mujoco.MjModel) -> None:
    colliding = {model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i]}
    motors = {f"motor{i}" for i in range(1, 5)}
    assert colliding == {"floor", "hub", "skid left", "skid right"} | motors


def test_hover_keyframe_is_steady(model: mujoco.MjModel, hovering: mujoco.MjData) -> None:
    assert hovering.qpos.tolist() == [0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0]
    assert hovering.ctrl.tolist() == [49.0] * 4
    assert np.abs(hovering.qacc).max() < 1e-12


def test_sensors_at_hover(model: mujoco.MjModel, hovering: mujoco.MjData) -> None:
    expected = {
        "position": [0.0, 0.0, 5.0],
        "orientation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.0, 0.0, 0.0],
        "gyro": [0.0, 0.0, 0.0],
        "accelerometer": [0.0, 0.0, 9.8],  # at rest it feels what holds it up
    }
    assert [model.sensor(i).name for i in range(model.nsensor)] == list(expected)
    for name, value in expected.items():
        assert hovering.sensor(name).data == pytest.approx(value, abs=1e-12), name


def test_sensors_know_their_frames(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    quarter = math.sqrt(0.5)  # nose to the left: body x is world y
    data.qpos[:] = (1.0, 2.0, 3.0, quarter, 0.0, 0.0, quarter)
    data.qvel[:] = (4.0, 5.0, 6.0, 0.1, 0.2, 0.3)
    data.ctrl[:] = 0.0
    mujoco.mj_forward(model, data)
    assert data.sensor("position").data == pytest.approx([1.0, 2.0, 3.0])
    assert data.sensor("velocity").data == pytest.approx([4.0, 5.0, 6.0])  # world
    assert data.sensor("gyro").data == pytest.approx([0.1, 0.2, 0.3])  # body
    assert data.sensor("accelerometer").data == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)  # falling


def test_vehicle_alone_compiles_and_weighs_the_same() -> None:
    alone = mujoco.MjModel.from_xml_path(str(QUAD_XML))
    assert mujoco.mj_getTotalmass(alone) == pytest.approx(20.0, abs=1e-12)
    assert alone.nbody == 2


def test_offscreen_buffer_is_large_enough(model: mujoco.MjModel) -> None:
    assert model.vis.global_.offwidth >= 1280
    assert model.vis.global_.offheight >= 720


def test_linear_drag_brakes_translation_only() -> None:
    assert load_model(0.5).dof_damping.tolist() == pytest.approx([10.0, 10.0, 10.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("drag", [-0.1, math.nan, math.inf, -math.inf])
def test_bad_drag_is_refused_in_words(drag: float) -> None:
    with pytest.raises(ValueError, match=r"expected a finite number >= 0 \(1/s\), got"):
        load_model(drag)
    with pytest.raises(ValueError, match="linear_drag"):
        model_hash(drag)


def test_hash_names_the_model() -> None:
    name = model_hash()
    assert len(name) == 32
    assert set(name) <= set("0123456789abcdef")
    assert name == model_hash() == model_hash(-0.0)
    assert name != model_hash(0.5) != model_hash(0.25)


def _moved(folder: Path, old: str = "", new: str = "") -> Path:
    """A copy of the models in `folder`, with `old` replaced by `new` in the vehicle."""
    shutil.copy(SCENE_XML, folder)
    (folder / "quad.xml").write_text(QUAD_XML.read_text().replace(old, new))
    return folder / "scene.xml"


def test_hash_does_not_depend_on_the_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = model_hash()
    monkeypatch.setattr(loading, "SCENE_XML", _moved(tmp_path))
    assert model_hash() == here


@pytest.mark.parametrize(
    ("old", "new"), [('mass="12"', 'mass="12.5"'), ("0.05", "0.06"), ("RK4", "Euler")]
)
def test_hash_sees_into_the_included_vehicle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str
) -> None:
    here = model_hash()
    monkeypatch.setattr(loading, "SCENE_XML", _moved(tmp_path, old, new))
    assert model_hash() != here


def test_numbers_come_without_mujoco() -> None:
    code = (
        "import sys, rotorgram.models, rotorgram.models.constants as c\n"
        "assert c.MASS == 20.0 and rotorgram.models.SCENE_XML.is_file()\n"
        "assert 'mujoco' not in sys.modules\n"
        "rotorgram.models.load_model\n"
        "assert 'mujoco' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, env=dict(os.environ))


def test_unknown_names_are_refused() -> None:
    import rotorgram.models

    with pytest.raises(AttributeError, match="no attribute 'load_modle'"):
        _ = rotorgram.models.load_modle
