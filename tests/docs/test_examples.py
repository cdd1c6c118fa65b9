"""Every script of examples/ runs, with less to do than by default, and says what it should."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from programs import EXAMPLES, free_port, rotorgram, run

SHORT = {
    "find_path.py": ([], r"^\d\d+ points, \d\d\.\d m$"),
    "fly_pid.py": ([], r"return 2\d\d\.\d, elevation 6\.000 m of 6\.0 m"),
    "mpc.py": (["--steps", "75"], r"step 75: 0\.[0-2]\d\d m from the goal"),
    "ppo_loop.py": (["--updates", "2"], r"update 2: 4,096 steps, return -?\d+\.\d"),
    "record_replay_render.py": ([], r"identical: \d+ States[^|]*film: flight\.mp4"),
    "sb3_ppo.py": (["--env-steps", "2048"], r"return -?\d+\.\d ± \d+\.\d of at most 250"),
    "train_headless.py": (["--env-steps", "3000"], r"steady-state \|E\|: \d\.\d+ m"),
}


def run_script(script: str, folder: Path, *arguments: str) -> str:
    return run([sys.executable, str(EXAMPLES / script), *arguments], folder)


@pytest.mark.parametrize("script", SHORT)
def test_it_runs(script: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if "render" in script:
        request.getfixturevalue("opengl")
    arguments, expected = SHORT[script]
    assert re.search(expected, run_script(script, tmp_path, *arguments))


def test_the_text_agent_flies_a_simulator(tmp_path: Path) -> None:
    port = free_port()
    addresses = ("--bind", "127.0.0.1:0", "--server", f"127.0.0.1:{port}")
    with subprocess.Popen(rotorgram("sim", "--codec", "text", *addresses)) as simulator:
        lines = run_script("text_agent.py", tmp_path, str(port)).splitlines()
        assert simulator.wait(20) == 0
    assert [line.split(":")[0] for line in lines] == [f"episode {i}" for i in range(3)]
    assert all(float(line.split()[-1]) > 150 for line in lines)


def test_the_detector_learns_from_pictures(opengl: None, tmp_path: Path) -> None:
    craft = ("--vehicle", "crazyflie2")
    flight = ("--env", "rotorgram/Landing-v0", *craft, "--episodes", "5", "--record", "pad.mcap")
    run(rotorgram("evaluate", "geometric", *flight), tmp_path)
    cameras = ("--cameras", "down@32x32", "down_segmentation@32x32")
    moved = ("--every", "9", "--aside", "1", "--tilt", "0.4", "--fast")
    words = ("pad.mcap", *craft, "--scene", "airport", *cameras, *moved)
    run_script("capture.py", tmp_path, *words, "--out", "pad", "--jobs", "1")
    words = ("pad", "--epochs", "2", "--out", "result.json")
    told = run_script("pad_detector.py", tmp_path, *words)
    assert json.loads(told) == json.loads((tmp_path / "result.json").read_text())
    (one,) = json.loads(told)["seeds"]
    assert 0.0 < one["median error"] < 32


def test_a_clone_flies_as_the_pilot_of_a_journal(tmp_path: Path) -> None:
    flight = ("--env", "rotorgram/Hover-v0", "--episodes", "10", "--record", "flight.mcap")
    run(rotorgram("evaluate", "geometric", *flight), tmp_path)
    told = run_script("clone.py", tmp_path, "flight.mcap", "--epochs", "60")
    assert told.startswith("10 flights, 2,500 steps: ")
    pilot, clone = re.findall(r"last position_error (\S+), (\d+) crashed", told)
    assert float(pilot[0]) < 0.01
    assert 0.0 < float(clone[0]) < 0.5
    assert clone[1] == "0"


def test_every_script_is_run() -> None:
    scripts = {path.name for path in EXAMPLES.glob("*.py")}
    # test_own_task.py, test_capture.py, test_datasets.py, test_swarm_tasks.py, test_vfh.py.
    others = {"landing.py", "capture.py", "dataset.py", "orca.py", "vfh.py"}
    others |= {"text_agent.py", "pad_detector.py", "clone.py"}
    assert scripts == {*SHORT, *others}
    page = (EXAMPLES / "README.md").read_text()
    assert all(f"({script})" in page for script in scripts)
