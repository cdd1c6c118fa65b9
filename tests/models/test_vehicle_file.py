"""TOML files of vehicles: what they compile to, what is refused, and what is told of each number.

Expected values are written out: geometry, moments of inertia of boxes and cylinders, torques.
"""

import math
import os
import pickle
import re
import tomllib
from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from rotorgram.envs import LocalVectorEnv
from rotorgram.models import QUAD_XML, InputError, Vehicle, library, vehicle_file
from rotorgram.models.coefficients import COEFFICIENTS, table_of
from rotorgram.models.export import export_mjcf
from rotorgram.models.fields import Limits, limits_of
from rotorgram.models.vehicle_file import FRAMES, read_vehicle_file
from rotorgram.rendering.stage import Stage

ROOT = Path(__file__).parents[2]
DATA = ROOT / "tests" / "data"
BY_HAND = tomllib.loads((DATA / "by_hand.toml").read_text("utf-8"))
PAGE = (ROOT / "docs" / "vehicles.md").read_text(encoding="utf-8")

BODY = """
[body]
mass = 1.5
inertia = [0.02, 0.021, 0.035]
"""
CRAFT = f"""{BODY}
[rotors]
frame = "cross"
arm = 0.3
thrust = [0, 8]
reaction = 0.016
"""
LISTED = """
[rotors]
thrust = [0, 8]
reaction = 0.016
[[rotors.list]]
position = [0.2, 0.2, 0.0]
turn = "cw"
[[rotors.list]]
position = [0.2, -0.2, 0.0]
turn = "ccw"
[[rotors.list]]
position = [-0.2, -0.2, 0.0]
turn = "cw"
[[rotors.list]]
position = [-0.2, 0.2, 0.0]
turn = "ccw"
"""


def write(folder: Path, text: str, name: str = "craft.toml") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def load(folder: Path, text: str) -> Vehicle:
    return Vehicle.load(write(folder, text))


def flown(model: mujoco.MjModel, newtons: np.ndarray, steps: int = 200) -> np.ndarray:
    """State after a flight from 100 m with thrusts that vary, from a turn."""
    data = mujoco.MjData(model)
    data.qpos[2] = 100.0
    data.qvel[3:] = 0.3, -0.2, 0.1
    for step in range(steps):
        phases = 0.1 * step + np.arange(model.nu)
        data.ctrl[:] = newtons * (1 + 0.2 * np.sin(phases))
        mujoco.mj_step(model, data)
    return np.concatenate((data.qpos, data.qvel))


# ---- rotors


@pytest.mark.parametrize("frame", FRAMES)
def test_frames(frame: str, tmp_path: Path) -> None:
    vehicle = load(tmp_path, CRAFT.replace('"cross"', f'"{frame}"'))
    x, y = 0.3 * np.array(BY_HAND["frames"][frame]).T
    count = len(x)
    ones = np.ones(count)
    positions = np.array([rotor.position for rotor in vehicle.rotors]).T
    np.testing.assert_allclose(positions, [x, y, 0 * ones], atol=1e-15)
    turns = [0.016, -0.016] * (count // 2)
    np.testing.assert_allclose(vehicle.allocation, [ones, y, -x, turns], atol=1e-15)
    assert np.linalg.matrix_rank(vehicle.allocation) == 4
    np.testing.assert_allclose(vehicle.hover_thrust, 1.5 * 9.81 / count)
    assert [rotor.name for rotor in vehicle.rotors] == [f"rotor{i + 1}" for i in range(count)]


def test_a_rotor_that_turns_clockwise_turns_the_craft_counterclockwise(tmp_path: Path) -> None:
    vehicle = load(tmp_path, CRAFT)
    data = mujoco.MjData(vehicle.model)
    data.qpos[2] = 100.0
    data.ctrl[:] = 5.0, 0.0, 5.0, 0.0  # the odd ones turn clockwise
    mujoco.mj_step(vehicle.model, data)
    assert data.qvel[5] == pytest.approx(0.01 * 10 * 0.016 / 0.035)  # about +z


def test_a_list_of_tilted_rotors_above_the_origin(tmp_path: Path) -> None:
    tilted = LISTED.replace("0.0]\n", "0.05]\naxis = [0, {}, 2]\n").replace("thrust", "{}thrust", 1)
    text = BODY + tilted.format("", 0.5, -0.5, -0.5, 0.5)
    vehicle = load(tmp_path, text)
    up = 2 / math.hypot(2, 0.5)
    side = 0.5 / math.hypot(2, 0.5)
    first = vehicle.rotors[0]
    assert first.axis == pytest.approx((0.0, side, up))
    assert first.reaction == pytest.approx((0.0, 0.016 * side, 0.016 * up))
    # position × axis: (y az - z ay, z ax - x az, x ay - y ax), and the reaction along the axis
    roll = 0.2 * up - 0.05 * side
    pitch = 0.016 * side - 0.2 * up
    yaw = 0.2 * side + 0.016 * up
    assert vehicle.allocation[:, 0] == pytest.approx((up, roll, pitch, yaw))


# ---- bodies


def test_mass_inertia_and_center_are_those_of_the_file(tmp_path: Path) -> None:
    told = "inertia = [0.02, 0.021, 0.035, 0.001, -0.002, 0.0005]\n"
    told += "center_of_mass = [0.01, -0.02, 0.03]"
    vehicle = load(tmp_path, CRAFT.replace("inertia = [0.02, 0.021, 0.035]", told))
    assert vehicle.mass == 1.5
    np.testing.assert_allclose(vehicle.center_of_mass, (0.01, -0.02, 0.03), rtol=1e-14)
    expected = [[0.02, 0.001, -0.002], [0.001, 0.021, 0.0005], [-0.002, 0.0005, 0.035]]
    np.testing.assert_allclose(vehicle.inertia, expected, rtol=0, atol=1e-15)


def test_inertia_of_parts(tmp_path: Path) -> None:
    parts = """
[[body.parts]]
shape = "box"
mass = 1.2
size = [0.3, 0.2, 0.1]
yaw = 1.5707963267948966
[[body.parts]]
shape = "cylinder"
mass = 0.4
radius = 0.02
length = 0.3
position = [0.0, 0.0, -0.2]
axis = [0, 2, 0]
"""
    vehicle = load(tmp_path, CRAFT.replace(BODY, parts))
    assert vehicle.mass == pytest.approx(1.6, rel=1e-15)
    np.testing.assert_allclose(vehicle.center_of_mass, (0, 0, -0.05), atol=1e-15)
    # The box has its 0.3 m along y: (m / 12) (b² + c²). The cylinder lies along y: m r² / 2 about
    # it, m (3 r² + l²) / 12 across. Both are moved by Steiner, the box by 0.05 m along z, the
    # cylinder by 0.15 m: m d² about x and y.
    across = 0.4 * (3 * 0.0004 + 0.09) / 12
    along = 0.4 * 0.0004 / 2
    moved = 1.2 * 0.05**2 + 0.4 * 0.15**2
    xx = 0.1 * (0.09 + 0.01) + across + moved
    yy = 0.1 * (0.04 + 0.01) + along + moved
    zz = 0.1 * (0.04 + 0.09) + across
    expected = np.diag([xx, yy, zz])
    np.testing.assert_allclose(vehicle.inertia, expected, rtol=0, atol=1e-15)


def test_the_hull_stands_where_the_file_says(tmp_path: Path) -> None:
    told = "size = [0.2, 0.1, 0.06]\nground_clearance = 0.11"
    vehicle = load(tmp_path, CRAFT.replace("mass = 1.5", f"mass = 1.5\n{told}"))
    assert vehicle.rest_height == pytest.approx(0.11, abs=1e-8)
    data = mujoco.MjData(vehicle.model)
    data.qpos[2] = 0.15
    mujoco.mj_step(vehicle.model, data, nstep=300)
    assert data.qpos[2] == pytest.approx(0.11, abs=1e-3)  # soft contact lets it sink in
    assert data.qpos[3] == pytest.approx(1.0, abs=1e-6)  # upright


def test_a_craft_that_can_touch_nothing_flies(tmp_path: Path) -> None:
    """Neither contact nor touch: both backends fly it through the ground."""
    path = tmp_path / "quad.xml"
    path.write_text(QUAD_XML.read_text().replace('contype="1" conaffinity="1"', 'contype="0"'))
    for backend in ("mujoco", "rigid"):
        env = LocalVectorEnv("rotorgram/Elevation-v0", 2, backend=backend, vehicle=str(path))
        env.reset(seed=1)
        for _ in range(150):
            _, _, terminated, _, _ = env.step(env.action_space.low)
            assert not env.loop.world.state.touching.any()
            if terminated.any():
                break
        assert terminated.any()  # too far from the target


def test_the_papers_vehicle_as_toml_is_the_same_craft() -> None:
    toml = Vehicle.load("paper")
    xml = Vehicle.load()
    assert toml.mass == pytest.approx(20.0, rel=1e-14)
    assert toml.gravity == 9.8
    assert toml.timestep == 0.01
    assert toml.rest_height == pytest.approx(0.4, abs=1e-6)
    np.testing.assert_allclose(toml.thrust_high, xml.thrust_high)
    np.testing.assert_allclose(toml.inertia, xml.inertia, rtol=0, atol=1e-13)
    np.testing.assert_allclose(toml.allocation, xml.allocation, rtol=0, atol=1e-14)
    newtons = np.full(4, 49.0)
    ours = flown(toml.model, newtons)
    theirs = flown(xml.model, newtons)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


# ---- coefficients and provenance


def test_coefficients_reach_the_vehicle_with_all_digits(tmp_path: Path) -> None:
    text = CRAFT + "time_constant = 0.0123456789012\ncurve = [0.1, 0.9]\n"
    vehicle = load(
        tmp_path, text + "[drag]\nlinear = [0.1, 0.2, 0.3]\n[sensors]\nrange_limit = 4\n"
    )
    assert vehicle.coefficients.numbers() == {
        "rotors.time_constant": (0.0123456789012,),
        "rotors.curve": (0.1, 0.9),
        "drag.linear": (0.1, 0.2, 0.3),
        "sensors.range_limit": (4.0,),
    }


def test_provenance(tmp_path: Path) -> None:
    text = CRAFT.replace(
        "mass = 1.5",
        'source = "drawing"\nmass = { value = 1.5, source = "scales", why = "with battery", '
        'others = [ { value = 1.4, source = "datasheet" } ] }',
    )
    numbers = {one.name: one for one in read_vehicle_file(write(tmp_path, text)).numbers}
    mass, inertia, arm = (numbers[name] for name in ("body.mass", "body.inertia", "rotors.arm"))
    assert mass.value == 1.5
    assert mass.unit == "kg"
    assert mass.source == "scales"
    assert mass.why == "with battery"
    (other,) = mass.others
    assert other.value == 1.4
    assert other.source == "datasheet"
    assert inertia.value == (0.02, 0.021, 0.035)
    assert inertia.source == "drawing"
    assert arm.value == 0.3
    assert arm.source == ""
    assert arm.others == ()
    assert Vehicle.load(tmp_path / "craft.toml").mass == 1.5


def test_the_hash_is_of_numbers_to_the_last_digit(tmp_path: Path) -> None:
    def of(text: str, name: str = "craft.toml") -> str:
        return Vehicle.load(write(tmp_path, text, name)).hash

    plain = of(CRAFT)
    assert of('name = "craft"\n# a comment\n' + CRAFT, "other.toml") == plain
    told = '{ value = 1.50, source = "scales", others = [ { value = 1.4, source = "x" } ] }'
    assert of(CRAFT.replace("mass = 1.5", f"mass = {told}"), "third.toml") != plain  # its name
    named = 'name = "craft"\n' + CRAFT.replace("mass = 1.5", f"mass = {told}")
    assert of(named, "fourth.toml") == plain
    assert of('name = "craft"\n' + CRAFT.replace("1.5", "1.5000000001"), "fifth.toml") != plain


# ---- refusals


TETRAHEDRON = """
v {low} {low} {low}
v {high} {high} {low}
v {high} {low} {high}
v {low} {high} {high}
f 1 2 3
f 1 4 2
f 1 3 4
f 2 4 3
"""
REFUSALS = tomllib.loads((DATA / "refusals.toml").read_text("utf-8"))


@pytest.mark.parametrize(("old", "new", "sentence"), REFUSALS["toml"])
def test_a_wrong_file_is_one_sentence(old: str, new: str, sentence: str, tmp_path: Path) -> None:
    assert old in CRAFT
    text = CRAFT.replace(old, new, 1)
    with pytest.raises(InputError, match=f"^{sentence}") as caught:
        load(tmp_path, text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("start", "sentence"),
    [
        (f'name = "{101 * "n"}"', "vehicle.name: expected a text of 1 to 100 "),
        (f"{1000 * 'k'} = 1", "vehicle: expected some of .*, got 'k{78}…$"),
        (f"a = {5000 * '['}", "vehicle: expected a TOML .* too many in each other"),
        ("#" * 1_000_001, "vehicle: expected a TOML file of at most 1000000 bytes, got"),
    ],
    ids=["name", "key", "depth", "size"],
)
def test_a_long_file_is_one_sentence(start: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"^{sentence}"):
        load(tmp_path, f"{start}\n{CRAFT}")


@pytest.mark.parametrize(("old", "new", "sentence"), REFUSALS["list"])
def test_a_wrong_list_is_one_sentence(old: str, new: str, sentence: str, tmp_path: Path) -> None:
    assert old in LISTED
    text = BODY + LISTED.replace(old, new, 1)
    with pytest.raises(InputError, match=f"^{sentence}"):
        load(tmp_path, text)


@pytest.mark.parametrize(("part", "sentence"), REFUSALS["part"])
def test_a_wrong_part_is_one_sentence(part: str, sentence: str, tmp_path: Path) -> None:
    text = CRAFT.replace(BODY, f"[[body.parts]]\n{part}\n")
    with pytest.raises(InputError, match=f"^{sentence}"):
        load(tmp_path, text)


# ---- models of their own


URDF = (DATA / "quad.urdf").read_text("utf-8")
OF_URDF = """
[model]
file = "quad.urdf"
[rotors]
thrust = [0, 6]
reaction = 0.02
radius = 0.1
[[rotors.list]]
link = "prop1"
turn = "cw"
[[rotors.list]]
link = "prop2"
turn = "ccw"
[[rotors.list]]
link = "prop3"
turn = "cw"
[[rotors.list]]
link = "base"
position = [-0.2, 0.2, 0.04]
turn = "ccw"
"""


def test_urdf(tmp_path: Path) -> None:
    write(tmp_path, URDF, "quad.urdf")
    vehicle = load(tmp_path, OF_URDF)
    assert vehicle.mass == pytest.approx(1.0, rel=1e-14)
    np.testing.assert_allclose(vehicle.center_of_mass, (0, 0, 0.016), atol=1e-15)
    # Ixx: 0.004 + 0.8 · 0.006² + 4 · (1e-5 + 0.05 (0.2² + 0.024²)); Izz: 0.008 + 4 (2e-5 + 0.004)
    moments = np.diag(vehicle.inertia)
    expected = (0.004 + 2.88e-5 + 0.00815520, 0.005 + 2.88e-5 + 0.00815520, 0.02408)
    np.testing.assert_allclose(moments, expected, rtol=1e-12)
    np.testing.assert_allclose(vehicle.allocation, BY_HAND["urdf"]["allocation"], rtol=1e-14)
    assert vehicle.rest_height == pytest.approx(0.05)
    assert vehicle.timestep == 0.01
    assert vehicle.gravity == 9.81
    assert vehicle.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert vehicle.coefficients["rotors.radius"] == 0.1
    env = gym.make("rotorgram/Hover-v0", vehicle=vehicle.path)
    env.reset(seed=0)
    assert env.action_space.shape == (4,)


@pytest.mark.parametrize("place", ["hull.obj", "meshes/hull.obj"])
def test_meshes_of_a_package_are_found_above_a_urdf_file(place: str, tmp_path: Path) -> None:
    (tmp_path / "urdf").mkdir()
    mesh = f'<mesh filename="package://{tmp_path.name}/{place}"/>'
    urdf = URDF.replace('<box size="0.2 0.2 0.1"/>', mesh)
    write(tmp_path / "urdf", urdf, "quad.urdf")
    with pytest.raises(
        InputError, match=r"^model.file: expected its meshes .*, got no file for pack"
    ):
        load(tmp_path / "urdf", OF_URDF)
    tetrahedron(tmp_path / place, 0.07)
    vehicle = load(tmp_path / "urdf", OF_URDF)
    assert vehicle.rest_height == pytest.approx(0.07, abs=1e-4)
    assert vehicle.mass == pytest.approx(1.0)


def test_a_urdf_file_without_links(tmp_path: Path) -> None:
    write(tmp_path, '<robot name="nothing"/>', "quad.urdf")
    with pytest.raises(InputError, match=r"^model.file: expected a URDF file with links, got none"):
        load(tmp_path, OF_URDF)


@pytest.mark.parametrize(("old", "new", "sentence"), REFUSALS["model"])
def test_a_wrong_model_is_one_sentence(old: str, new: str, sentence: str, tmp_path: Path) -> None:
    write(tmp_path, URDF, "quad.urdf")
    text = OF_URDF.replace(old, new, 1)
    with pytest.raises(InputError, match=f"^{sentence}"):
        load(tmp_path, text)


def test_a_urdf_file_needs_a_file_that_names_its_rotors(tmp_path: Path) -> None:
    file = write(tmp_path, URDF, "quad.urdf")
    with pytest.raises(InputError, match=r"^vehicle: expected a TOML file that names the rotors"):
        Vehicle.load(file)


def test_mjcf_with_coefficients_from_toml(tmp_path: Path) -> None:
    source = DATA / "tiny.xml"
    (tmp_path / "tiny.xml").write_bytes(source.read_bytes())
    more = '[model]\nfile = "tiny.xml"\n[rotors]\nradius = 0.023\n[sensors]\nrange_limit = 4\n'
    vehicle = load(tmp_path, more)
    alone = Vehicle.load(source)
    assert vehicle.coefficients.numbers() == {
        "rotors.radius": (0.023,),
        "sensors.range_limit": (4.0,),
    }
    assert vehicle.mass == alone.mass
    assert vehicle.timestep == 0.005
    newtons = alone.hover_thrust
    assert (flown(vehicle.model, newtons) == flown(alone.model, newtons)).all()
    with pytest.raises(InputError, match=r"^rotors.list: expected none for a model's file with ac"):
        load(tmp_path, OF_URDF.replace("quad.urdf", "tiny.xml"))
    with pytest.raises(
        InputError,
        match=r"^rotors of the model's file: expected some of radius, .*, got 'reaction'",
    ):
        load(tmp_path, more.replace("radius", "reaction"))


def test_rotors_at_sites_of_mjcf(tmp_path: Path) -> None:
    text = (DATA / "tiny.xml").read_text()
    write(tmp_path, re.sub("<actuator>.*</actuator>", "", text, flags=re.DOTALL), "bare.xml")
    sites = OF_URDF.replace("quad.urdf", "bare.xml").replace("position = [-0.2, 0.2, 0.04]\n", "")
    for number, link in enumerate(("prop1", "prop2", "prop3", "base"), 1):
        sites = sites.replace(f'link = "{link}"', f'site = "s{number}"')
    vehicle = load(tmp_path, sites)
    assert vehicle.rotors[0].position == pytest.approx((0.0325, 0.0325, 0.0))
    assert vehicle.allocation[3] == pytest.approx([0.02, -0.02, 0.02, -0.02])
    moved = sites.replace('site = "s1"', 'site = "s1"\nposition = [0, 0, 1]')
    with pytest.raises(InputError, match=r"^rotors.list\[1\]: expected no position besides a site"):
        load(tmp_path, moved)


# ---- export


def tetrahedron(file: Path, size: float) -> None:
    """Wavefront file of a tetrahedron in a cube of twice the size, m."""
    file.parent.mkdir(exist_ok=True)
    file.write_text(TETRAHEDRON.format(high=size, low=-size))


def test_meshes_of_a_models_file(tmp_path: Path) -> None:
    mesh = tmp_path / "shapes" / "hull.obj"
    (tmp_path / "out").mkdir()
    tetrahedron(mesh, 0.05)
    tiny = (DATA / "tiny.xml").read_text()
    text = tiny.replace("<option", '<compiler meshdir="shapes"/><option', 1).replace(
        "<worldbody>", '<asset><mesh name="hull" file="hull.obj"/></asset><worldbody>'
    )
    hull = '<freejoint/><geom type="mesh" mesh="hull" mass="0.01" contype="1" conaffinity="1"/>'
    write(tmp_path, text.replace("<freejoint/>", hull), "model.xml")
    vehicle = load(tmp_path, '[model]\nfile = "model.xml"\n')
    assert vehicle.rest_height == pytest.approx(0.05, abs=1e-4)
    out = tmp_path / "out" / "craft.xml"
    export_mjcf(vehicle.path, out)
    exported = Vehicle.load(out)
    assert exported.rest_height == pytest.approx(vehicle.rest_height, abs=1e-6)
    tetrahedron(mesh, 0.06)
    os.utime(mesh, (1, 1))  # MuJoCo keeps meshes by the second
    os.utime(tmp_path / "model.xml", (1, 1))
    again = Vehicle.load(vehicle.path)
    assert again.rest_height == pytest.approx(0.06, abs=1e-4)
    assert again.hash != vehicle.hash


@pytest.mark.parametrize("text", [CRAFT + "radius = 0.0987\n", OF_URDF])
def test_export_keeps_six_digits(text: str, tmp_path: Path) -> None:
    write(tmp_path, URDF, "quad.urdf")
    vehicle = load(tmp_path, text)
    out = tmp_path / "sub" / "out.xml"
    out.parent.mkdir()
    export_mjcf(vehicle.path, out)
    again = Vehicle.load(out)
    assert again.mass == pytest.approx(vehicle.mass, rel=1e-6)
    assert again.coefficients == vehicle.coefficients
    np.testing.assert_allclose(again.allocation, vehicle.allocation, rtol=1e-5)
    np.testing.assert_allclose(np.diag(again.inertia), np.diag(vehicle.inertia), rtol=1e-5)
    with pytest.raises(InputError, match=r"^out: expected a file that ends in .xml, got"):
        export_mjcf(vehicle.path, tmp_path / "out.txt")
    with pytest.raises(InputError, match=r"^out: expected the name of a new file, got .*out.xml"):
        export_mjcf(out, out)


@pytest.mark.parametrize("given", [3, "", b"craft.toml", ["craft.toml"], "x" * 1001, "a\0b"])
def test_no_path_is_one_sentence(given: Any) -> None:
    with pytest.raises(InputError, match=r"^vehicle: expected a file, or one of crazyflie2, "):
        Vehicle.load(given)


def test_what_is_no_file_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "folder.xml").mkdir()
    (tmp_path / "loop.xml").symlink_to("loop.xml")
    os.mkfifo(tmp_path / "pipe.xml")  # which a reader would wait for
    for name in ("folder.xml", "loop.xml", "pipe.xml"):
        with pytest.raises(InputError, match=f"^vehicle: expected a file, or one of .*{name}"):
            Vehicle.load(tmp_path / name)


def test_a_mesh_without_a_path_is_refused(tmp_path: Path) -> None:
    text = URDF
    end = text.index("</link>")
    mesh = '<collision><geometry><mesh filename="package://"/></geometry></collision>'
    write(tmp_path, text[:end] + mesh + text[end:], "quad.urdf")
    with pytest.raises(InputError, match=r"^model.file: expected its meshes .*no file for package"):
        load(tmp_path, OF_URDF)


# ---- everything that takes a vehicle


def test_a_vehicle_goes_where_a_path_goes(tmp_path: Path) -> None:
    vehicle = load(tmp_path, CRAFT)
    assert pickle.loads(pickle.dumps(vehicle)) is vehicle
    many = gym.make_vec("rotorgram/Elevation-v0", num_envs=3, vehicle=str(vehicle.path))
    many.reset(seed=0)
    many.step(many.action_space.sample())
    many.close()


def test_it_is_drawn_with_an_orange_front(tmp_path: Path) -> None:
    stage = Stage("plain", drones=2, vehicle=load(tmp_path, CRAFT).path)
    discs = [stage.model.geom(i) for i in range(stage.model.ngeom)]
    discs = [geom for geom in discs if "disc" in geom.name]
    assert len(discs) == 8
    for disc in discs:
        red, _, blue, _ = disc.rgba
        assert (red > blue) == (disc.pos[0] > 0), disc.name


def test_bare_names_are_of_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine").mkdir()
    write(tmp_path / "mine", CRAFT, "vehicle.toml")
    monkeypatch.setattr(library, "LIBRARY", tmp_path)
    assert library.vehicle_names() == ["mine"]
    vehicle = Vehicle.load("mine")
    assert vehicle.name == "mine"
    assert vehicle.path == tmp_path / "mine" / "vehicle.toml"
    sentence = r"^vehicle: expected a file, or one of mine or drawn:NUMBER, got 'yours'"
    with pytest.raises(InputError, match=sentence):
        Vehicle.load("yours")


# ---- the page


TABLES = {
    "": vehicle_file.Tables,
    "body.": vehicle_file.Body,
    "body.parts.": vehicle_file.Box,
    "rotors.": vehicle_file.RotorTable,
    "rotors.list.": vehicle_file.PlacedRotor,
    "cameras.": vehicle_file.Camera,
    "real_flights.": table_of("real_flights"),
}


def limits_of_all() -> dict[str, Limits]:
    """Of every number of a file, by its dotted name."""
    found: dict[str, Limits] = {}
    for name, limits in COEFFICIENTS.items():
        known = re.sub(r"^sensors\.\w+\.\w+\.", "sensors.KIND.", name)  # of all kinds and models
        assert found.setdefault(known, limits) == limits, name
    for prefix, kind in (*TABLES.items(), ("body.parts.", vehicle_file.Cylinder)):
        found |= {prefix + name: limits for name, limits in limits_of(kind).items()}
    return found


def test_the_page_has_every_field_with_its_limits() -> None:
    rows = re.findall(r"^\| `([\w.]+)` \| ([^|]*) \| ([^|]*) \| ([^|]*) \|", PAGE, re.MULTILINE)
    page = {name: (count, unit, limits) for name, count, unit, limits in rows}
    fields = {}
    for name, limits in limits_of_all().items():
        count = {0: "1 or more"}.get(limits.count, str(limits.count))
        fields[name] = (count, limits.unit, f"{limits.low:g} to {limits.high:g}")
    fields["body.inertia"] = ("3 or 6", "kg m²", "-1e+09 to 1e+09")
    assert page == fields


@pytest.mark.parametrize("number", range(PAGE.count("```toml")))
def test_the_files_of_the_page_fly(number: int, tmp_path: Path) -> None:
    text = re.findall(r"^```toml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[number]
    vehicle = load(tmp_path, text)
    assert vehicle.num_rotors >= 4
    assert np.linalg.matrix_rank(vehicle.allocation) == 4
