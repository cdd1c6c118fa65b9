"""The vehicles that come with the package: each flies, and each number has a source."""

import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import vehicle_pages as pages
from rotorgram.models import Vehicle
from rotorgram.models.checks import examine
from rotorgram.models.library import vehicle_names
from rotorgram.models.vehicle_file import Number, read_vehicle_file
from tables import DATA

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "models" / "vehicles"
NAMES = ["crazyflie2", "crazyflie_brushless", "heavy_hexa", "hummingbird", "paper", "skydio_x2"]


def numbers(name: str) -> dict[str, Number]:
    file = read_vehicle_file(FOLDER / name / "vehicle.toml")
    return {one.name: one for one in file.numbers}


def test_the_library_has_these_vehicles() -> None:
    assert sorted(vehicle_names()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_the_page_is_what_the_command_would_write(name: str) -> None:
    page = (FOLDER / name / "README.md").read_text(encoding="utf-8")
    assert page == pages.readme(name)


def test_the_overview_is_what_the_command_would_write() -> None:
    assert pages.overview() in (ROOT / "docs" / "library.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", NAMES)
def test_every_number_has_a_source_that_the_page_names(name: str) -> None:
    for number in numbers(name).values():
        for source in pages.sources(number):
            assert pages.works_of(source), number.name


@pytest.mark.parametrize("name", NAMES)
def test_a_choice_between_sources_that_differ_by_5_percent_is_explained(name: str) -> None:
    for number in numbers(name).values():
        used = np.asarray(number.value)
        scale = np.abs(used).max()
        apart = 0.0
        for other in number.others:
            difference = np.abs(used - np.asarray(other.value)).max()
            apart = max(apart, difference / scale)
        assert apart < 0.05 or number.why, number.name


def test_a_source_that_names_no_work_is_refused() -> None:
    with pytest.raises(ValueError, match=r"begins with a work.*'somewhere'"):
        pages.works_of("somewhere")


@pytest.mark.parametrize("name", NAMES)
def test_it_passes_the_examination(name: str) -> None:
    vehicle = Vehicle.load(FOLDER / name / "vehicle.toml")
    for check in examine(vehicle):
        assert check.passed, check.name


@pytest.mark.parametrize("name", NAMES)
def test_its_picture_is_small(name: str) -> None:
    picture = (FOLDER / name / "picture.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) < 100_000


BY_HAND = tomllib.loads((DATA / "by_hand.toml").read_text("utf-8"))


@pytest.mark.parametrize(("name", "yaw"), BY_HAND["reactions"])
def test_rotors_turn_as_those_of_the_platform(name: str, yaw: str) -> None:
    vehicle = Vehicle.load(FOLDER / name / "vehicle.toml")
    signs = "".join("+" if torque > 0 else "-" for torque in vehicle.allocation[3])
    assert signs == yaw


def test_the_skydio_x2_has_the_inertia_of_the_menagerie_s_ellipsoids() -> None:
    # Four rotors of 0.25 kg with half axes 0.13, 0.13, 0.01 m, a body of 0.325 kg with 0.16, 0.04,
    # 0.02 m; an ellipsoid has m (b² + c²) / 5.
    vehicle = Vehicle.load(FOLDER / "skydio_x2" / "vehicle.toml")
    height = (0.5 * 0.05 + 0.5 * 0.08 + 0.325 * 0.02) / 1.325
    assert vehicle.center_of_mass == pytest.approx([0, 0, height], abs=1e-6)
    discs = 4 * 0.25 * (0.13**2 + 0.13**2) / 5
    arms = 4 * 0.25 * (0.14**2 + 0.18**2)
    body = 0.325 * (0.16**2 + 0.04**2) / 5
    assert vehicle.inertia[2, 2] == pytest.approx(discs + arms + body, abs=1e-6)
    xz = -0.25 * 0.14 * 2 * (0.08 - 0.05)  # -Σ m x z of the rotors
    assert vehicle.inertia[0, 2] == pytest.approx(xz, abs=1e-6)


def test_the_heavy_hexacopter_follows_from_its_derivations() -> None:
    told = numbers("heavy_hexa")
    density = 1.225
    radius = 0.2794
    area = np.pi * radius**2
    k = 45.0 / (120.0 / radius) ** 2
    assert told["rotors.thrust_coefficient"].value == pytest.approx(k, rel=1e-3)
    reaction = np.sqrt(k / (2 * density * area)) / 0.65
    assert told["rotors.reaction"].value == pytest.approx(reaction, rel=1e-3)
    power = 1 / (0.8 * 0.65 * np.sqrt(2 * density * area))
    assert told["rotors.power"].value == pytest.approx(power, rel=1e-3)
    turning = 0.06 * (2 * radius) ** 2 / 12 + 0.1 * 0.03**2  # a blade of 60 g, a bell of 0.1 kg
    motor = (60 / (2 * np.pi * 100)) ** 2 / 0.2
    hover = np.sqrt(11.54 * 9.81 / 6 / k)
    time = turning / (motor + 2 * reaction * k * hover)
    assert told["rotors.time_constant"].value == pytest.approx(time, rel=1e-2)


def test_with_the_menagerie_s_turn_directions_the_skydio_x2_cannot_yaw(tmp_path: Path) -> None:
    file = FOLDER / "skydio_x2" / "vehicle.toml"
    text = file.read_text("utf-8")
    ours = re.findall(r'turn = "(.*)"', text)
    assert ours == ["ccw", "cw", "ccw", "cw"]
    there = iter(["ccw", "cw", "cw", "ccw"])  # its gears have the yaw torques -, +, +, -
    file = tmp_path / "x2.toml"
    turned = re.sub(r'turn = ".*"', lambda _: f'turn = "{next(there)}"', text)
    file.write_text(turned, "utf-8")
    allocation = Vehicle.load(file).allocation
    assert np.linalg.matrix_rank(allocation, rtol=1e-6) == 3
    assert allocation[3] == pytest.approx(allocation[1] * 0.0201 / 0.18)


def test_the_crazyflies_rangefinder_has_the_noise_of_its_driver_at_its_limit() -> None:
    """zranger2.c: 2.5 mm · (1 + exp(k (d - 2.5 m))), which is 5 mm at d = 2.5 m."""
    for name in ("crazyflie2", "crazyflie_brushless"):
        own = Vehicle.load(name).coefficients
        assert own["sensors.range_noise"] == 0.005
        assert own["sensors.range_limit"] == 2.5
