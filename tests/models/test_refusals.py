"""What a vehicle's file may not hold: sizes that take all memory, numbers that overflow."""

from pathlib import Path

import pytest
from rotorgram.models import QUAD_XML, InputError, Vehicle
from rotorgram.models.checks import examine
from rotorgram.models.mjcf import read_spec


def changed(folder: Path, old: str, new: str) -> Path:
    text = QUAD_XML.read_text(encoding="utf-8")
    assert old in text
    path = folder / "quad.xml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("size", "sentence"),
    [
        ('nuser_body="1000000000"', "a nuser_body of at most 100 in <size>, got 1000000000"),
        ('nuser_geom="101"', "a nuser_geom of at most 100 in <size>, got 101"),
        ('nstack="2000000000"', "a nstack of at most 10000000 in <size>, got 2000000000"),
        ('nkey="1000000"', "a nkey of at most 100 in <size>, got 1000000"),
        ('njmax="100000"', "a njmax of at most 4000 in <size>, got 100000"),
        ('memory="2G"', "a memory of at most 1G, got 2G"),
    ],
)
def test_sizes_are_bounded_before_the_file_is_read(
    tmp_path: Path, size: str, sentence: str
) -> None:
    path = changed(tmp_path, "<option", f"<size {size}/><option")
    with pytest.raises(InputError) as caught:
        read_spec(path)
    assert str(caught.value) == f"vehicle: expected {sentence}"


@pytest.mark.parametrize("tag", ["include", "model"])
def test_sizes_of_other_files_are_bounded_too(tmp_path: Path, tag: str) -> None:
    (tmp_path / "other.xml").write_text('<mujoco><size nuserdata="9999999"/></mujoco>')
    other = f'<{tag} name="other" file="other.xml"/>'
    path = changed(tmp_path, "<asset>", f"<asset>{other}")
    with pytest.raises(InputError, match="a nuserdata of at most 1000000 in <size>, got 9999999"):
        read_spec(path)


@pytest.mark.parametrize(
    ("parent", "parts"),
    [
        ("asset", '<hfield nrow="4096" ncol="4096" size="1 1 1 1"/>' * 5),
        ("custom", '<numeric name="a" size="9000" data="0"/>' * 8000),
    ],
)
def test_all_parts_together_are_bounded(tmp_path: Path, parent: str, parts: str) -> None:
    """Each is small enough; together they take more than 0.5 GB."""
    path = changed(tmp_path, "</mujoco>", f"<{parent}>{parts}</{parent}></mujoco>")
    with pytest.raises(InputError, match="at most 67108864 numbers of assets and sensors, got"):
        read_spec(path)


def test_a_custom_numeric_is_bounded(tmp_path: Path) -> None:
    numeric = '<custom><numeric name="a" size="1000000000" data="0"/></custom>'
    path = changed(tmp_path, "</mujoco>", f"{numeric}</mujoco>")
    with pytest.raises(InputError, match="a size of at most 10000 in <numeric>, got 1000000000"):
        read_spec(path)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('timestep="0.01"', 'timestep="nan"', "finite numbers, got others in timestep"),
        ('gravity="0 0 -9.8"', 'gravity="0 0 nan"', "finite numbers, got others in gravity"),
        ('mass="12"', 'mass="1e308"', "a mass of at most 1e\\+09 kg, got 1e\\+308"),
    ],
)
def test_numbers_that_nothing_can_fly_with(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    path = changed(tmp_path, old, new)
    for call in (Vehicle.load, examine):
        with pytest.raises(InputError, match=f"^vehicle: expected {sentence}"):
            call(path)


def test_the_crazyflies_rangefinder_has_the_noise_of_its_driver_at_its_limit() -> None:
    """zranger2.c: 2.5 mm · (1 + exp(k (d - 2.5 m))), which is 5 mm at d = 2.5 m."""
    for name in ("crazyflie2", "crazyflie_brushless"):
        sensors = Vehicle.load(name).coefficients.sensors
        assert sensors.range_noise == 0.005
        assert sensors.range_limit == 2.5
