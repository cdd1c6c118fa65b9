"""The paper's MJCF says what the paper says; `Vehicle` derives the numbers of any other."""

import copy
import math
import os
import pickle
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest
import rotorgram.models
from rotorgram.models import QUAD_XML, InputError, Vehicle
from rotorgram.scenes import build_scene

DATA = Path(__file__).parents[1] / "data"
ROTORS = ("rotor1", "rotor2", "rotor3", "rotor4")
REACTIONS = (0.05, -0.05, 0.05, -0.05)  # N·m per newton
BY_HAND = tomllib.loads((DATA / "by_hand.toml").read_text("utf-8"))
PLACES = BY_HAND["paper"]["places"]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_scene().compile()


@pytest.fixture
def hovering(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("hover").id)
    mujoco.mj_forward(model, data)
    return data


# --- the paper's vehicle --------------------------------------------------------------------------


def test_options(model: mujoco.MjModel) -> None:
    assert model.opt.timestep == 0.01
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.gravity.tolist() == [0.0, 0.0, -9.8]
    assert (model.opt.density, model.opt.viscosity) == (0.0, 0.0)  # no air, so no aerodynamics
    assert model.opt.wind.tolist() == [0.0, 0.0, 0.0]
    assert model.opt.disableflags == 0
    assert model.opt.enableflags == 0


def test_one_free_body_and_four_thrusts(model: mujoco.MjModel) -> None:
    assert model.nq == 7
    assert model.nv == 6
    assert model.nu == 4
    assert model.na == 0
    assert model.actuator_ctrlrange.tolist() == [[0.0, 100.0]] * 4
    for rotor, place, reaction in zip(ROTORS, PLACES, REACTIONS, strict=True):
        assert model.site(rotor).pos.tolist() == place
        assert model.actuator(rotor).gear.tolist() == [0.0, 0.0, 1.0, 0.0, 0.0, reaction]


def test_nothing_is_added_silently(model: mujoco.MjModel) -> None:
    for name in ("dof_damping", "dof_armature", "dof_frictionloss", "jnt_stiffness"):
        assert not getattr(model, name).any(), name


def test_yaw_constant_follows_from_a_measured_propeller(model: mujoco.MjModel) -> None:
    # APC 10x4.7 at 6528 rpm, UIUC's static data: C_T 0.1274, C_P 0.0531; k = D C_P / (2 pi C_T)
    diameter = 2 * model.geom("disc1").size[0]
    power_to_thrust = 0.0531 / 0.1274
    reaction = diameter * power_to_thrust / (2 * math.pi)
    assert reaction == pytest.approx(0.05, rel=0.1)


def test_every_mass_is_written_out() -> None:
    geoms = mujoco.MjSpec.from_file(str(QUAD_XML)).geoms
    assert not any(math.isnan(geom.mass) for geom in geoms)
    assert all(geom.density == 0.0 for geom in geoms)
    heavy = {geom.name: geom.mass for geom in geoms if geom.mass > 0}
    expected = {"hub": 12.0}
    for number in range(1, 5):
        expected[f"arm{number}"] = 1.2
        expected[f"motor{number}"] = 0.8
    assert heavy == expected
    assert sum(heavy.values()) == pytest.approx(20.0, abs=1e-12)


def test_front_is_marked_and_symmetric_otherwise(model: mujoco.MjModel) -> None:
    mark = model.geom("front mark")
    assert mark.pos[0] > 0.1
    assert mark.pos[1] == 0.0
    materials = [model.geom(f"disc{i}").matid[0] for i in range(1, 5)]
    assert materials[0] == materials[1] != materials[2] == materials[3]
    assert model.mat(materials[0]).name == "front disc"


def test_only_few_geoms_collide(model: mujoco.MjModel) -> None:
    colliding = {model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i]}
    motors = {f"motor{i}" for i in range(1, 5)}
    assert colliding == {"scene/floor", "hub", "skid left", "skid right"} | motors


def test_hover_keyframe_is_steady(hovering: mujoco.MjData) -> None:
    assert hovering.qpos.tolist() == [0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0]
    assert hovering.ctrl.tolist() == [49.0] * 4
    assert np.abs(hovering.qacc).max() < 1e-12


def test_sensors_at_hover(model: mujoco.MjModel, hovering: mujoco.MjData) -> None:
    expected = BY_HAND["sensors"]
    names = [model.sensor(i).name for i in range(model.nsensor)]
    assert names == list(expected)
    for name, value in expected.items():
        assert hovering.sensor(name).data == pytest.approx(value, abs=1e-12), name


OWN = {
    "ground": '<geom name="own" type="plane" size="0 0 1"/>',
    "sun": '<light name="own" pos="0 0 5"/>',
    "sky": '<texture name="own" type="skybox" builtin="flat" width="8" height="8"/>',
}


@pytest.mark.parametrize("own", [[], ["ground"], ["ground", "sun"], ["ground", "sky"], [*OWN]])
def test_a_file_keeps_its_ground_sun_and_sky_and_gets_those_it_lacks(
    own: list[str], tmp_path: Path
) -> None:
    text = QUAD_XML.read_text(encoding="utf-8")
    inside = "".join(OWN[name] for name in own if name != "sky")
    text = text.replace("<worldbody>", f"<worldbody>{inside}", 1)
    sky = f"<asset>{OWN['sky']}</asset>" if "sky" in own else ""
    (tmp_path / "vehicle.xml").write_text(text.replace("<worldbody>", f"{sky}<worldbody>", 1))
    model = build_scene(tmp_path / "vehicle.xml").compile()
    suns = [model.light(i).name for i in range(model.nlight)]
    is_sky = model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX
    is_ground = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    skies = [model.tex(i).name for i in np.flatnonzero(is_sky)]
    grounds = [model.geom(i).name for i in np.flatnonzero(is_ground)]
    assert suns == ["own" if "sun" in own else "scene/sun"]
    assert skies == ["own" if "sky" in own else "scene/sky"]
    assert grounds == ["own" if "ground" in own else "scene/floor"]


# --- what follows from a compiled model -----------------------------------------------------------


def test_the_papers_vehicle() -> None:
    vehicle = Vehicle.load()
    assert vehicle is Vehicle.load(QUAD_XML)
    assert vehicle.mass == pytest.approx(20.0)
    assert vehicle.gravity == 9.8
    assert vehicle.timestep == 0.01
    assert vehicle.center_of_mass == pytest.approx(0.0, abs=1e-15)
    assert vehicle.rest_height == 0.4
    assert [rotor.name for rotor in vehicle.rotors] == list(ROTORS)
    assert [list(rotor.position) for rotor in vehicle.rotors] == PLACES
    for rotor in vehicle.rotors:
        assert rotor.axis == (0.0, 0.0, 1.0)
        assert rotor.low == 0.0
        assert rotor.high == 100.0
    expected = BY_HAND["paper"]["allocation"]
    np.testing.assert_allclose(vehicle.allocation, expected, atol=1e-15)
    assert vehicle.hover_thrust == pytest.approx([49.0] * 4, abs=1e-12)
    assert vehicle.max_acceleration == pytest.approx(10.2)
    assert vehicle.substeps(0.02) == 2
    assert vehicle.substeps(0.01) == 1


def test_a_hexacopter_with_throttles_and_a_camera_in_front() -> None:
    vehicle = Vehicle.load(DATA / "hexa.xml")
    # 1.8 + 0.6 + 6 · 0.05 + 2 · 0.04 kg centred in x and y, and 0.25 kg of camera at (0.12, 0.01)
    assert vehicle.mass == pytest.approx(3.03)
    camera = np.array((0.12, 0.01))
    assert vehicle.center_of_mass[:2] == pytest.approx(0.25 * camera / 3.03)
    assert vehicle.num_rotors == 6
    assert vehicle.thrust_low.tolist() == [0] * 6
    assert vehicle.thrust_high.tolist() == [12] * 6
    assert [rotor.newtons for rotor in vehicle.rotors] == [12] * 6
    reactions = [rotor.reaction[2] * 12 for rotor in vehicle.rotors]
    assert reactions == pytest.approx([0.19, -0.19] * 3)
    front = vehicle.hover_thrust[0]
    rear = vehicle.hover_thrust[3]
    assert front > 3.03 * 9.81 / 6 > rear
    wanted = [3.03 * 9.81, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(vehicle.allocation @ vehicle.hover_thrust, wanted, atol=1e-12)
    assert vehicle.rest_height == pytest.approx(0.17)


def test_rotors_whose_sites_point_down() -> None:
    vehicle = Vehicle.load(DATA / "small.xml")
    for rotor in vehicle.rotors:
        assert rotor.axis == pytest.approx((0, 0, 1))
    expected = BY_HAND["small"]["allocation"]
    np.testing.assert_allclose(vehicle.allocation, expected, atol=1e-12)


def test_tilted_rotors_share_the_weight_without_a_drift(tmp_path: Path) -> None:
    gears = ("0.6 0 0.8 0 0 0", "-0.28 0 0.96 0 0 0")
    motors = "".join(f'<motor class="quad" site="imu" gear="{gear}"/>' for gear in gears)
    hover = Vehicle.load(_moved(tmp_path, "</actuator>", motors + "</actuator>")).hover_thrust
    assert 0.6 * hover[4] == pytest.approx(0.28 * hover[5], rel=1e-9)
    weight = hover[:4].sum() + 0.8 * hover[4] + 0.96 * hover[5]
    assert weight == pytest.approx(20 * 9.8, rel=1e-9)


def test_a_vehicle_is_never_copied_and_is_pickled_by_its_file() -> None:
    vehicle = Vehicle.load(DATA / "hexa.xml", linear_drag=0.5)
    assert copy.deepcopy(vehicle) is vehicle
    assert pickle.loads(pickle.dumps(vehicle)).hash == vehicle.hash


def test_linear_drag_brakes_translation_only() -> None:
    damping = Vehicle.load(linear_drag=0.5).model.dof_damping
    assert damping.tolist() == pytest.approx([10.0, 10.0, 10.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("drag", [-0.1, 101.0, math.nan, math.inf, "much"])
def test_bad_drag_is_refused_in_words(drag: float) -> None:
    with pytest.raises(InputError, match="linear_drag: expected a number from 0 to 100 /s, got"):
        Vehicle.load(linear_drag=drag)


def _moved(folder: Path, old: str = "", new: str = "", name: str = "quad.xml") -> Path:
    """A copy of the paper's vehicle in `folder`, with `old` replaced by `new`."""
    text = QUAD_XML.read_text()
    assert old in text
    text = re.sub("<keyframe>.*</keyframe>", "", text, flags=re.DOTALL)  # it knows the old numbers
    (folder / name).write_text(text.replace(old, new))
    return folder / name


def test_hash_names_vehicle_and_drag_and_not_the_folder(tmp_path: Path) -> None:
    name = Vehicle.load().hash
    assert len(name) == 32
    assert set(name) <= set("0123456789abcdef")
    assert name == Vehicle.load(linear_drag=-0.0).hash
    for comment in ("<!-- ", "<!-- else "):
        (tmp_path / "other.xml").write_text(QUAD_XML.read_text().replace("<!-- ", comment))
        assert Vehicle.load(tmp_path / "other.xml").hash == name
    drags = [Vehicle.load(linear_drag=drag).hash for drag in (0.0, 0.25, 0.5)]
    assert drags[0] == name
    assert len(set(drags)) == 3


@pytest.mark.parametrize(
    ("old", "new"), [('mass="12"', 'mass="12.5"'), ("0.05", "0.06"), ("RK4", "Euler")]
)
def test_hash_sees_every_number(tmp_path: Path, old: str, new: str) -> None:
    assert Vehicle.load(_moved(tmp_path, old, new)).hash != Vehicle.load().hash


def test_hash_sees_into_included_files(tmp_path: Path) -> None:
    shutil.copy(DATA / "hexa.xml", tmp_path)
    outer = tmp_path / "outer.xml"
    outer.write_text('<mujoco model="hexacopter"><include file="hexa.xml"/></mujoco>')
    assert Vehicle.load(outer).hash == Vehicle.load(DATA / "hexa.xml").hash


def test_a_file_that_was_written_anew_is_loaded_anew(tmp_path: Path) -> None:
    path = _moved(tmp_path)
    before = Vehicle.load(path)
    _moved(tmp_path, 'mass="12"', 'mass="13"')
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
    assert before.mass == pytest.approx(20)
    assert Vehicle.load(path).mass == pytest.approx(21)


# --- what is no vehicle ---------------------------------------------------------------------------

REFUSALS = tomllib.loads((DATA / "refusals.toml").read_text("utf-8"))


@pytest.mark.parametrize(("old", "new", "sentence"), REFUSALS["mjcf"])
def test_what_is_no_vehicle_is_refused_in_one_sentence(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    path = _moved(tmp_path, old, new)
    with pytest.raises(InputError, match=f"^vehicle: .*{sentence}") as refusal:
        Vehicle.load(path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("tag", ["include", "model"])
def test_sizes_of_other_files_are_bounded_too(tmp_path: Path, tag: str) -> None:
    (tmp_path / "other.xml").write_text('<mujoco><size nuserdata="9999999"/></mujoco>')
    other = f'<asset><{tag} name="other" file="other.xml"/>'
    path = _moved(tmp_path, "<asset>", other)
    with pytest.raises(InputError, match="a nuserdata of at most 1000000 in <size>, got 9999999"):
        Vehicle.load(path)


HEIGHTS = '<hfield nrow="4096" ncol="4096" size="1 1 1 1"/>'
NUMERIC = '<numeric name="a" size="9000" data="0"/>'


@pytest.mark.parametrize(
    "parts", [f"<asset>{5 * HEIGHTS}</asset>", f"<custom>{8000 * NUMERIC}</custom>"]
)
def test_all_parts_together_are_bounded(tmp_path: Path, parts: str) -> None:
    """Each is small enough; together they take more than 0.5 GB."""
    path = _moved(tmp_path, "</mujoco>", f"{parts}</mujoco>")
    with pytest.raises(InputError, match="at most 67108864 numbers of assets and sensors, got"):
        Vehicle.load(path)


def test_a_file_that_is_not_there() -> None:
    with pytest.raises(InputError, match=r"vehicle: cannot read nowhere\.xml: No such file"):
        Vehicle.load("nowhere.xml")


# --- imports --------------------------------------------------------------------------------------


def test_paths_come_without_mujoco() -> None:
    code = (
        "import sys, rotorgram.models, rotorgram.scenes\n"
        "assert rotorgram.scenes.SCENE_XML.is_file()\n"
        "assert rotorgram.scenes.AIRPORT_XML.is_file()\n"
        "assert 'mujoco' not in sys.modules\n"
        "rotorgram.models.Vehicle\n"
        "assert 'mujoco' in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Vehicel'"):
        _ = rotorgram.models.Vehicel
