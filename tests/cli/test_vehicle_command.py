"""`rotorgram vehicle`: write, show, examine and export a vehicle's file."""

import re
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import mujoco
import pytest
from commands import WRONG, Capsys, output, run, words_of
from rotorgram.cli import vehicle as command
from rotorgram.models import Vehicle
from rotorgram.models.vehicle_file import FRAMES

DATA = Path(__file__).parents[1] / "data"


def vehicle(capsys: Capsys, *words: object) -> str:
    """Output of `rotorgram vehicle`, which ends well."""
    return output(capsys, "vehicle", *words)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_new_file_flies_as_it_is(frame: str, tmp_path: Path, capsys: Capsys) -> None:
    file = tmp_path / "mine.toml"
    out = vehicle(capsys, "new", file, "--frame", frame)
    assert out == f"vehicle: {file} (rotorgram vehicle check {file} examines it)\n"
    craft = Vehicle.load(file)
    assert craft.num_rotors == {"hexa": 6, "octo": 8}.get(frame, 4)
    assert craft.thrust_high.sum() == pytest.approx(30.0)
    vehicle(capsys, "check", file)


def test_a_new_file_is_still_one_with_what_its_comments_offer(
    tmp_path: Path, capsys: Capsys
) -> None:
    file = tmp_path / "mine.toml"
    vehicle(capsys, "new", file)
    text = file.read_text(encoding="utf-8")
    offered = re.sub(r"^# (?=\[|\w+ = )", "", text, flags=re.MULTILINE)
    file.write_text(offered, encoding="utf-8")
    assert list(Vehicle.load(file).coefficients.numbers()) == [
        "rotors.radius",
        "rotors.time_constant",
        "drag.linear",
        "drag.quadratic",
        "sensors.gyro_noise",
    ]


def test_the_frames_are_those_of_the_file() -> None:
    hint = get_type_hints(command.Vehicle)["frame"]
    assert get_args(hint) == tuple(FRAMES)


def test_show(tmp_path: Path, capsys: Capsys) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(
        'name = "shown"\n[body]\ninertia = [0.02, 0.021, 0.035]\n[body.mass]\nvalue = 2\n'
        'source = "scales"\nwhy = "with battery"\nothers = [{ value = 1.9, source = "maker" }]\n'
        '[rotors]\nframe = "cross"\narm = 0.3\nthrust = [0, 10]\nreaction = 0.016\n'
        '[[cameras]]\nname = "low"\nresolution = [160, 120]\nrate = 0.5\nlook = [0, 0, -1]\n'
        'kinds = ["rgb", "depth"]\nfovy = 1.0\n'
        '[sensors.lidar]\nmodel = "os0"\nyaw = { value = 90, source = "drawing 12" }\n'
    )
    out = vehicle(capsys, "show", file)
    assert out.startswith(f"shown ({file})\n")
    for line in (
        "mass              2 kg",
        "centre of mass    0, 0, 0 m",
        "Ixx, Iyy, Izz     0.02, 0.021, 0.035 kg m²",
        "hover thrust      4.905, 4.905, 4.905, 4.905 N",  # 2 · 9.81 / 4
        "hover throttle    49.05, 49.05, 49.05, 49.05 %",
        "thrust to weight  2.039",  # 40 / 19.62
        "rotor2            0.212132, -0.212132, 0 m; 0, 0, 1; 0, 0, -0.016 N m/N; 0 to 10 N",
        "low               rgb, depth 160 × 120, at (0 0 0) m in the body, looks along (0 0 -1), "
        "57.3 degrees high, every 2 steps",
        "body.mass = 2 kg\n    scales\n    why: with battery\n    also 1.9 kg: maker",
        "rotors.arm = 0.3 m",
        "sensors.lidar.os0.yaw = 90 degrees\n    drawing 12",
    ):
        assert f"\n{line}\n" in out
    for what in (DATA / "tiny.xml", Vehicle.load().path):
        out = vehicle(capsys, "show", what)
        assert "\nmass " in out


def test_show_has_what_a_models_file_tells(tmp_path: Path, capsys: Capsys) -> None:
    model = (DATA / "racer.xml").read_text(encoding="utf-8")
    (tmp_path / "racer.xml").write_text(model, encoding="utf-8")
    file = tmp_path / "mine.toml"
    file.write_text('[model]\nfile = "racer.xml"\n[rotors]\nradius = 0.25\n')
    assert 'name="rotorgram/rotors.time_constant" data="0.05"' in model
    out = vehicle(capsys, "show", file)
    numbers, others = out.split("\nnumbers of mine.toml\n")[1].split("coefficients of racer.xml\n")
    assert numbers == "rotors.radius = 0.25 m\n\n"
    assert "rotors.time_constant = 0.05\n" in others
    assert "radius" not in others


def test_export(tmp_path: Path, capsys: Capsys) -> None:
    file = tmp_path / "mine.toml"
    out = tmp_path / "mine.xml"
    vehicle(capsys, "new", file)
    words = vehicle(capsys, "export", file, out)
    assert words == f"vehicle: {out}\n"
    model = mujoco.MjModel.from_xml_path(str(out))
    assert model.body_mass[1] == 1.5
    vehicle(capsys, "export", DATA / "hexa.xml", tmp_path / "hexa.xml")
    again = Vehicle.load(tmp_path / "hexa.xml")
    assert again.num_rotors == 6
    assert again.mass == pytest.approx(Vehicle.load(DATA / "hexa.xml").mass, rel=1e-6)


@pytest.mark.parametrize(("line", "sentence"), WRONG["vehicle"])
def test_wrong_words_are_one_sentence(
    line: str, sentence: str, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.toml").touch()
    Path("there.xml").touch()
    status, out, err = run(capsys, "vehicle", *words_of(line))
    assert status == (2 if line.startswith("check") else 1)
    assert out == ""
    assert re.match(rf"rotorgram: {sentence}.*\n$", err)


def test_an_action_that_there_is_not(capsys: Capsys) -> None:
    assert run(capsys, "vehicle", "fly", "x.toml")[0] == 2


def test_a_wrong_flag_loads_nothing_heavy() -> None:
    words = ["vehicle", "show", "x.toml", "--wrong"]
    program = (
        "import sys; from rotorgram.cli import main\n"
        f"try: main({words})\n"
        "except SystemExit as error: assert error.code == 2\n"
        "print({'mujoco', 'numpy', 'torch'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "set()\n"


def test_every_command_takes_the_file(tmp_path: Path, capsys: Capsys) -> None:
    file = tmp_path / "mine.toml"
    folder = tmp_path / "run"
    journal = tmp_path / "flight.mcap"
    own = ("--vehicle", file)
    vehicle(capsys, "new", file, "--frame", "hexa")
    task = ("--env", "rotorgram/Hover-v0", *own)
    output(capsys, "train", "a2c", *task, "--env-steps", 256, "--out", folder)
    output(capsys, "evaluate", folder, "--episodes", 1, *own, "--record", journal)
    output(capsys, "replay", journal, "--verify", *own)
    status, out, _ = run(capsys, "replay", journal, "--verify")
    assert status == 1  # the paper's has other rotors
    assert re.search(r"vehicle_hash .*\(--vehicle names its file\)", out)
