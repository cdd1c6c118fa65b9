"""The command line as a user meets it: good input, wrong input, Ctrl-C, a missing peer."""

import json
import logging
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
import pytest
from commands import (
    WRONG,
    Capsys,
    output,
    refused,
    run,
    start,
    started,
    words_of,
)
from rotorgram.agents import load
from rotorgram.agents.checkpoints import store
from rotorgram.cli import COMMANDS, _trainer, main
from rotorgram.cli._env import fitted
from rotorgram.cli._parser import parse
from rotorgram.cli._scalars import ScalarWriter
from rotorgram.cli.serve import Serve
from rotorgram.cli.sim import Sim
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.models import QUAD_XML, InputError
from rotorgram.training.results import Results
from rotorgram.udp import Simulator
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

SWARM = ("--env", "rotorgram/Formation-v0", "--drones", "2")
ORCA = f"{Path(__file__).parents[2]}/examples/orca.py:Orca"


@pytest.fixture(autouse=True)
def _nothing_runs_on() -> Iterator[None]:
    """After a test that failed, too."""
    yield
    for process in started:
        process.kill()
        if process.stdout is not None and not process.stdout.closed:
            process.communicate()
    started.clear()


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


@pytest.mark.parametrize("command", [[], *[[c] for c in COMMANDS]], ids=" ".join)
def test_help(command: list[str], capsys: Capsys) -> None:
    out = output(capsys, *command, "--help")
    assert "usage: rotorgram" in out


@pytest.mark.parametrize(
    ("command", "default"),
    [("train", "the preset's"), ("benchmark", "the preset's")],
)
def test_help_names_the_default_backend(command: str, default: str, capsys: Capsys) -> None:
    words = " ".join(run(capsys, command, "--help")[1].replace("│", " ").split())
    flag = words.partition("--backend ")[2].partition(" --")[0]
    assert f"(default: {default})" in flag


@pytest.mark.parametrize(("line", "sentence"), WRONG["commands"])
def test_wrong_input_is_one_sentence(line: str, sentence: str, capsys: Capsys) -> None:
    assert sentence in refused(capsys, *words_of(line))


def test_a_long_address_is_shortened(capsys: Capsys) -> None:
    server = "127.0.0.1:" + 5000 * "1"
    assert "address: expected HOST:PORT" in refused(capsys, "sim", "--server", server)


@pytest.mark.parametrize(
    "arguments", [["train", "dqn"], ["sim", "--speed", "2"], ["soar"], ["compare", "--seeds", "x"]]
)
def test_wrong_flags_name_what_was_expected(arguments: list[str], capsys: Capsys) -> None:
    status, out, err = run(capsys, *arguments)
    assert status == 2
    assert "Traceback" not in out + err
    assert arguments[-1] in out + err or arguments[-2] in out + err


INTERRUPTED = """
import os, signal, sys
from rotorgram import cli
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may ignore it
cli._run = lambda words: exec("os.kill(os.getpid(), signal.SIGINT)")
sys.exit(cli.main([]))
"""


def test_ctrl_c_while_a_dataclass_is_made_exits_with_130(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without our exception, Python ends a module that it runs by `-m` by the signal."""
    (tmp_path / "interrupted.py").write_text(INTERRUPTED)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    command = [sys.executable, "-m", "interrupted"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr == "rotorgram: interrupted\n"


def test_no_command_and_an_unknown_one(capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(capsys)[0] == 2
    status, _, err = run(capsys, "soar")
    assert status == 2
    assert err.count("\n") == 1
    assert "expected a command of sim, train, " in err
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    out = output(capsys, "--version")
    assert "PYTHONSAFEPATH" not in os.environ, "scripts that run later find their neighbours"
    assert re.fullmatch(r"rotorgram \d+\.\d+\.\d+\n", out)


def test_a_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy raises ValueError for our bugs too."""

    def broken(self: Sim) -> int:
        raise ValueError("operands could not be broadcast together")

    monkeypatch.setattr(Sim, "run", broken)
    with pytest.raises(ValueError, match="broadcast"):
        main(["sim"])


def test_flags_that_are_set_to_their_default_are_set() -> None:
    words = ["--env.target", "5", "--num-envs=1", "--no-view", "--action", "offset"]
    command = parse(Sim, "rotorgram sim", words)
    assert command.given == {"env.target", "num_envs", "view", "action"}
    assert command.options == {"target": 5.0, "action": "offset"}
    assert parse(Sim, "rotorgram sim", []).options == {}


def test_options_are_those_of_the_task(capsys: Capsys) -> None:
    _, out, _ = run(capsys, "sim", "--env", "rotorgram/Hover-v0", "--help")
    assert "--env.start-tilt" in out
    assert "--env.target" not in out
    command = parse(Sim, "rotorgram sim", ["--env.target", "4", "6"])
    assert command.options == {"target": [4.0, 6.0]}, "as JSON gives it"


TASK = """
from rotorgram.envs import register
from rotorgram.envs.tasks.elevation import Elevation


class Low(Elevation):
    pass


register("Low-v0", Low)
"""


def test_a_task_of_the_working_directory(tmp_path: Path) -> None:
    """It trains and flies; an agent that lacks its file serves it."""
    (tmp_path / "low_task.py").write_text(TASK)
    env = "--env low_task:Low-v0 --env.target 4"
    done = shell(f"cd {tmp_path} && rotorgram train a2c {env} --env-steps 300 --out run")
    assert done.returncode == 0, done.stderr
    kept = load(tmp_path / "run" / "checkpoint.safetensors")
    assert kept.env_id == "Low-v0"
    assert kept.spec.options["target"] == 4.0
    done = shell(f"rotorgram evaluate {tmp_path}/run --episodes 1")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "or --env MODULE:Low-v0 with the module" in done.stderr
    agent = start("serve", tmp_path / "run", "--listen", "127.0.0.1:0", "--episodes", 1)
    assert agent.stdout is not None
    server = agent.stdout.readline().split()[5]
    done = shell(f"cd {tmp_path} && rotorgram sim {env} --bind 127.0.0.1:0 --server {server}")
    assert done.returncode == 0, done.stderr
    assert "episode 0: return" in agent.communicate(timeout=30)[0]


@pytest.mark.parametrize("words", [["--help"], ["sim", "--help"], ["sim", "--speed", "2"]])
def test_a_narrow_terminal(words: list[str]) -> None:
    """In five columns tyro takes gigabytes."""
    limited = "import resource as r, sys; r.setrlimit(r.RLIMIT_AS, (4 << 30, 4 << 30));"
    program = limited + "from rotorgram.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", program, *words],
        env={**os.environ, "COLUMNS": "5"},
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert done.returncode == (0 if "--help" in words else 2), done.stderr
    assert "Traceback" not in done.stderr


def shell(command: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run a line of bash, in which `rotorgram` is the command of this installation."""
    function = f'rotorgram() {{ {shlex.quote(sys.executable)} -P -m rotorgram.cli "$@"; }}'
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {function}; {command}"],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.parametrize(
    ("command", "status", "error"),
    [
        ("rotorgram --help >&-", 0, ""),
        ("rotorgram sim --help >&- 2>&-", 0, ""),
        (
            "rotorgram vehicle check paper > /dev/full",
            1,
            "rotorgram: standard output: No space left",
        ),
        ("(sleep 1; rotorgram --help) | true", 141, ""),
    ],
)
def test_standard_output_that_takes_nothing(command: str, status: int, error: str) -> None:
    done = shell(command)
    assert done.returncode == status, done.stderr
    assert done.stderr.startswith(error)
    assert done.stderr.count("\n") == bool(error)


@pytest.mark.parametrize("out", ["> /dev/full", "| true"])
def test_a_training_goes_on_without_standard_output(out: str, tmp_path: Path) -> None:
    done = shell(f"rotorgram train a2c --env-steps 600 --out {tmp_path}/run {out}")
    assert done.returncode == (1 if "full" in out else 141)
    assert done.stderr.count("\n") == ("full" in out)
    assert load(tmp_path / "run" / "checkpoint.safetensors").position.env_steps == 600


def test_standard_output_in_ascii() -> None:
    commands = ("rotorgram --help", "rotorgram render --help", "rotorgram vehicle check paper",
                "rotorgram evaluate pid --episodes 1")  # fmt: skip
    for command in commands:
        done = shell(command, PYTHONIOENCODING="ascii")
        assert done.returncode == 0, command
        assert done.stderr == "", command


def test_an_opengl_that_does_not_exist() -> None:
    """It is told to commands that draw; others go on."""
    assert shell("rotorgram vehicle check paper", MUJOCO_GL="nonsense").returncode == 0
    done = shell("rotorgram render random --out /nowhere/a.mp4", MUJOCO_GL="nonsense")
    assert "Traceback" not in done.stderr
    assert done.returncode in (1, 2)


def test_a_folder_of_that_name_in_the_working_directory(tmp_path: Path) -> None:
    """The simulators that a command starts import the package, not that folder."""
    (tmp_path / "rotorgram").mkdir()
    (tmp_path / "rotorgram" / "__init__.py").write_text("raise SystemExit('the wrong one')")
    done = shell(f"cd {tmp_path} && rotorgram evaluate pid --episodes 1")
    assert done.returncode == 0, done.stderr


def test_a_model_with_a_tiny_time_step(tmp_path: Path, capsys: Capsys) -> None:
    model = QUAD_XML.read_text(encoding="utf-8").replace('timestep="0.01"', 'timestep="1e-8"')
    (tmp_path / "quad.xml").write_text(model)
    sentence = refused(capsys, "vehicle", "check", tmp_path / "quad.xml", status=2)
    assert "expected a physics step of at least" in sentence


@pytest.mark.parametrize(
    ("command", "file"),
    [
        ("vehicle new v.toml", "v.toml"),
        ("vehicle export crazyflie2 v.xml", "v.xml"),
        ("evaluate pid --episodes 1 --record r.mcap", "r.mcap"),
    ],
)
def test_a_file_that_cannot_be_written_is_named_and_leaves_its_name_free(
    command: str, file: str, tmp_path: Path
) -> None:
    done = shell(f"cd {tmp_path} && ulimit -f 0 && rotorgram {command}")
    assert done.returncode == 1
    assert done.stderr == f"rotorgram: {file}: File too large\n"
    assert list(tmp_path.iterdir()) == []


def test_a_training_that_writes_nothing_leaves_the_name_of_its_folder_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(_trainer, "write_json", full)
    err = refused(capsys, "train", "a2c", "--out", tmp_path / "run")
    assert err == f"rotorgram: {tmp_path}/run/config.json: No space left on device\n"
    assert list(tmp_path.iterdir()) == []


def test_a_key_replaces_no_device(capsys: Capsys) -> None:
    err = refused(capsys, "key", "/dev/full")
    assert err.endswith(
        "/dev/full: expected a new file, got one that is there; a key is never replaced\n"
    )


def test_curves_go_on_after_the_clock_went_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = ScalarWriter(tmp_path, 1000)
    for step in range(100, 600, 100):
        first.write(step, {"x": 1.0})
    first.close()
    monkeypatch.setattr(time, "time", lambda: 1e9)
    resumed = ScalarWriter(tmp_path, 1000, behind=300)
    for step in range(400, 800, 100):
        resumed.write(step, {"x": 2.0})
    resumed.close()
    board = EventAccumulator(str(tmp_path))
    board.Reload()
    points = [(point.step, point.value) for point in board.Scalars("x")]
    assert points == [(100, 1), (200, 1), (300, 1), (400, 2), (500, 2), (600, 2), (700, 2)]


def test_port_in_use(capsys: Capsys) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{sock.getsockname()[1]}"
        for command in (["serve", "pid", "--listen", address], ["sim", "--bind", address]):
            assert f"cannot bind {address}: the port is in use" in refused(capsys, *command)


def test_unreachable_agent(capsys: Capsys) -> None:
    server = f"127.0.0.1:{free_port()}"
    flags = ("--server", server, "--bind", "127.0.0.1:0", "--timeout", 0.5)
    sentence = f"no answer from the agent at {server} for 0.5 s"
    assert sentence in refused(capsys, "sim", *flags)


def test_an_agent_that_is_late(capsys: Capsys) -> None:
    """After a second the simulator tells, once, that nobody is there; it goes on asking."""
    address = f"127.0.0.1:{free_port()}"
    simulator = start("sim", "--server", address, "--bind", "127.0.0.1:0")
    assert simulator.stderr is not None
    began = time.monotonic()
    sentence = simulator.stderr.readline()
    assert time.monotonic() - began < 10
    assert f"no answer from the agent at {address} for 1 s" in sentence
    assert "; nothing listens on that port; asking for 120 s in all" in sentence
    output(capsys, "serve", "pid", "--listen", address, "--episodes", 1)
    out, err = simulator.communicate(timeout=30)
    assert simulator.returncode == 0
    assert err == ""
    assert "the agent closed" in out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--vehicle", "nowhere.xml"], "vehicle: cannot read nowhere.xml: No such file"),
        (["--control-period", "0.013"], "control_period: expected a positive multiple of the"),
    ],
)
def test_an_error_of_our_own_simulator_is_told_once(
    words: list[str], sentence: str, capsys: Capsys
) -> None:
    err = refused(capsys, "evaluate", "pid", "--episodes", 1, *words)
    assert err.startswith(f"rotorgram: {sentence}")


def test_a_course_that_is_flown_to_its_end_is_no_crash(capsys: Capsys) -> None:
    task = ("--env", "rotorgram/Waypoints-v0", "--env.points", 1, "--backend", "rigid")
    out = output(capsys, "evaluate", "geometric", "--episodes", 1, *task)
    assert "episodes   1, 1 terminated, 0 crashed\n" in out
    assert "steady     points_left 0.0000\n" in out
    assert re.search(
        r"^settling   points_left to 0\.5: \d\.\d\d s \(1 of 1 episodes\)$", out, re.MULTILINE
    )


def test_check_model(capsys: Capsys) -> None:
    out = output(capsys, "vehicle", "check", "paper")
    passed, checks = re.search(r"(\d+) of (\d+) checks passed", out).groups()  # type: ignore[union-attr]
    assert passed == checks
    output(capsys, "vehicle", "check", Path(__file__).parents[1] / "data" / "hexa.xml")


def test_check_model_names_what_fails_and_exits_with_1(tmp_path: Path, capsys: Capsys) -> None:
    text = QUAD_XML.read_text(encoding="utf-8").replace('ctrlrange="0 100"', 'ctrlrange="0 50"')
    (tmp_path / "weak.xml").write_text(text)
    status, out, err = run(capsys, "vehicle", "check", tmp_path / "weak.xml")
    assert (status, err) == (1, "")
    sentences = [line for line in out.splitlines() if line.startswith("hover: ")]
    assert len(sentences) == 2
    assert sentences[0].startswith("hover: thrust to weight: ")
    assert sentences[1].startswith("hover: margin of the tightest rotor: ")
    rows = [line for line in out.splitlines() if "FAILED" in line and "thrust to weight" in line]
    assert f"{200 / 196:.4g}" in rows[0]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (None, "vehicle: cannot read "),
        ("nonsense", "vehicle: expected an MJCF file, got drone.xml: "),
        ("<mujoco/>", "vehicle: expected one free body and no other joints, got 0 free of 0"),
    ],
)
def test_check_model_of_what_is_no_vehicle(
    text: str | None, sentence: str, tmp_path: Path, capsys: Capsys
) -> None:
    if text is not None:
        (tmp_path / "drone.xml").write_text(text)
    status, out, err = run(capsys, "vehicle", "check", tmp_path / "drone.xml")
    assert status == 2
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith(f"rotorgram: {sentence}")


def test_worlds_of_the_simulator_that_comes(tmp_path: Path, capsys: Capsys) -> None:
    here = f"127.0.0.1:{free_port()}"
    swarm = ("sim", *SWARM, "--num-envs", 4, "--server", here, "--bind", "127.0.0.1:0")
    flags = ("--env", "rotorgram/Formation-v0", "--listen", here)
    simulator = start(*swarm)
    err = refused(capsys, "evaluate", ORCA, *flags, "--drones", 4, "--episodes", 1)
    assert err == "rotorgram: drones: expected a simulator of 4 in each world, got one of 2\n"
    assert "the agent closed" in simulator.communicate(timeout=10)[0]
    simulator = start(*swarm)
    settings = ("--num-envs", 4, "--env-steps", 64, "--set", "steps_per_update=32", "hidden=[8]")
    status, *_ = run(capsys, "train", "ippo", *flags, *settings, "--out", tmp_path / "run")
    simulator.communicate(timeout=10)
    assert status == 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["num_envs"] == 4
    assert config["env"]["drones"] == 2


def test_train_with_many_drones(tmp_path: Path, capsys: Capsys) -> None:
    folder = tmp_path / "run"
    port = free_port()
    settings = ("--env-steps", 1200, "--num-envs", 4, "--set", "steps_per_update=100")
    listen = ("--listen", f"127.0.0.1:{port}", "--num-simulators", 2)
    flags = ("--server", f"127.0.0.1:{port}", "--bind", "127.0.0.1:0", "--num-envs", 2)
    simulators = [start("sim", *flags) for _ in range(2)]
    out = output(capsys, "train", "a2c", "--out", folder, *settings, *listen)
    assert f"waiting for 2 simulators of 2 drones at 127.0.0.1:{port}" in out
    assert re.search(r"trained 1,2\d\d of 1,200 env steps", out)
    for simulator in simulators:
        lines = simulator.communicate(timeout=20)[0].splitlines()
        assert lines[-2] == "the agent closed"
    assert load(folder / "checkpoint.safetensors").num_envs == 4
    out = output(capsys, "train", "a2c", "--resume", folder)
    assert "already trained 1,2" in out
    assert "wire" not in out
    again = tmp_path / "again"  # with a simulator of its own: the same numbers
    output(capsys, "train", "a2c", "--out", again, *settings)
    weights = [load(f / "checkpoint.safetensors").actor for f in (folder, again)]
    assert all(weights[0][name].tobytes() == weights[1][name].tobytes() for name in weights[0])
    err = refused(capsys, "train", "a2c", "--num-simulators", 2)
    assert "num-simulators: expected 1 without --listen" in err
    err = refused(capsys, "train", "a2c", *settings[:2], "--num-envs", 0)
    assert "num_envs: expected a whole number of at least 1, or none, got 0" in err


def test_train_evaluate_and_resume(tmp_path: Path, capsys: Capsys) -> None:
    folder = tmp_path / "run"
    settings = ("--env-steps", 1200, "--set", "steps_per_update=100", "--episode-length", 60)
    status, out, _ = run(capsys, "train", "a2c", "--out", folder, *settings)
    assert status == 0
    assert "trained 1,200 of 1,200 env steps" in out
    kept = load(folder / "checkpoint.safetensors")
    assert kept.algorithm == "a2c"
    assert kept.config["steps_per_update"] == 100
    assert kept.spec.options["episode_length"] == 60
    assert len(kept.spec.vehicle_hash) == 32
    assert json.loads((folder / "config.json").read_text())["seed"] == 0
    assert len(pd.read_csv(folder / "episodes.csv")) >= 20
    out = output(capsys, "evaluate", folder / "checkpoint.safetensors", "--episodes", 3)
    assert "episodes   3, " in out
    output(capsys, "evaluate", folder, "--episodes", 1, "--effects", "linear_drag=0.5")
    for changes, sentence in (
        (["vpg"], "resume: expected a training of vpg"),
        (["a2c", "--seed", 0], "got others by --seed"),  # its own: set all the same
        (["a2c", "--seed", 3, "--set", "gamma=0.5"], "got others by --seed, --set"),
    ):
        assert sentence in refused(capsys, "train", *changes, "--resume", folder)
    assert "policy: expected weights of shapes" in refused(
        capsys, "evaluate", folder, "--env.observation", "error"
    )
    reference = fitted(parse(Serve, "serve", ["x"]), kept)
    assert reference.env_id == "rotorgram/Elevation-v0"
    assert reference.options == kept.spec.options
    words = ["x", "--episode-length", "1000", "--effects", "linear_drag=0"]  # the defaults
    assert fitted(parse(Serve, "serve", words), kept).options == {
        **kept.spec.options, "episode_length": 1000, "effects": {"linear_drag": 0}
    }  # fmt: skip
    (folder / "episodes.csv").unlink()  # a result: the checkpoint has the episodes
    output(capsys, "train", "a2c", "--resume", folder)


def test_nothing_that_a_checkpoint_names_is_imported(
    tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fault 28: not in the processes of its simulators either."""
    imported = tmp_path / "imported"
    folder = tmp_path / "run"
    (tmp_path / "evil.py").write_text(f"open({str(imported)!r}, 'w')")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    settings = ("--env-steps", 300, "--set", "steps_per_update=100", "--episode-length", 60)
    output(capsys, "train", "a2c", "--out", folder, *settings)
    kept = load(folder / "checkpoint.safetensors")
    for name, known in (("evil:Evil-v0", False), ("evil:rotorgram/Elevation-v0", True)):
        named = replace(kept, spec=replace(kept.spec, env_id=name), env_steps=600)
        store(named, folder / "checkpoint.safetensors")
        assert run(capsys, "evaluate", folder, "--episodes", 1)[0] == (not known)
        assert run(capsys, "train", "a2c", "--resume", folder)[0] == (not known)
    config = EnvConfig.from_keywords(name, **named.spec.options)
    (trajectory,) = flown_trajectories(named.policy(), config, [0])  # as `render`
    assert trajectory.spec.env_id == "rotorgram/Elevation-v0"
    assert not imported.exists()


def test_of_two_trainings_with_one_folder_one_is_refused(tmp_path: Path) -> None:
    """And of two that resume it."""
    settings = ("--env-steps", 3000, "--set", "steps_per_update=100", "--store-every", 0.1)
    for words in (("--out", tmp_path / "run", *settings), ("--resume", tmp_path / "run")):
        both = [start("train", "a2c", *words) for _ in range(2)]
        ended = []
        for process in both:
            out, err = process.communicate(timeout=60)
            ended.append((process.returncode, out, err))
        (_, out, err), (status, _, refused) = sorted(ended, key=lambda one: one[0])
        assert "3,000 env steps" in out, err
        if words[0] == "--out" or status:  # of a finished one both may say that it is finished
            assert status == 1
            assert refused.count("\n") == 1
            assert "expected a " in refused
        kept = load(tmp_path / "run" / "checkpoint.safetensors")
        assert kept.position.env_steps == 3000
        assert len(kept.position.episodes) == len(pd.read_csv(tmp_path / "run" / "episodes.csv"))


def test_a_resumed_training_names_other_versions(tmp_path: Path, capsys: Capsys) -> None:
    settings = ("--env-steps", 300, "--set", "steps_per_update=100")
    output(capsys, "train", "a2c", "--out", tmp_path / "run", *settings)
    file = tmp_path / "run" / "checkpoint.safetensors"
    kept = load(file)
    versions = {**kept.versions, "mujoco": "3.0.0"}
    store(replace(kept, versions=versions, env_steps=600), file)
    out = output(capsys, "train", "a2c", "--resume", tmp_path / "run")
    now = kept.versions["mujoco"]
    assert f"note: mujoco was 3.0.0 and is {now}: the numbers may differ" in out
    assert out.count("note: ") == 1


def test_a_full_disk_is_named_with_its_file(tmp_path: Path) -> None:
    """A limit of the size of files is as a disk that is full."""
    words = "train a2c --env-steps 300 --set steps_per_update=100 --out"
    done = shell(f"ulimit -f 1; rotorgram {words} {tmp_path}/run")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert re.fullmatch(rf"rotorgram: {tmp_path}/run/\S+: File too large", line)


def test_text_of_others_holds_no_terminal_escapes(
    monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    def fail(self: Sim) -> int:
        logging.getLogger("rotorgram.udp").warning("said \x1b[2J")
        raise InputError("refused: \x1b]0;title\x07")

    monkeypatch.setattr(Sim, "run", fail)
    status, _, err = run(capsys, "sim")
    assert status == 1
    assert err == "rotorgram: said \ufffd[2J\nrotorgram: refused: \ufffd]0;title\ufffd\n"


@pytest.mark.parametrize(
    ("way", "signalled"),
    [("--udp", signal.SIGINT), ("--no-udp", signal.SIGINT), ("--no-udp", signal.SIGTERM)],
)
def test_ctrl_c_stops_a_training_that_resumes_to_the_numbers_of_an_unbroken_one(
    way: str, signalled: int, tmp_path: Path, capsys: Capsys
) -> None:
    settings = (way, "--env-steps", 6_000, "--set", "steps_per_update=100")
    process = start("train", "a2c", "--out", tmp_path / "broken", *settings)
    assert process.stdout is not None
    here, first = "flying in this process", process.stdout.readline()
    assert first.startswith(here) is (way == "--no-udp")
    if first.startswith(here):
        first = process.stdout.readline()
    assert first.startswith("a2c seed 0"), "the first update is reported"
    os.killpg(process.pid, signalled)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 128 + signalled
    assert "stopped after" in out
    line = f"rotorgram train a2c --resume {tmp_path / 'broken'} {way}"
    assert f"go on with: {line}\n" in out
    assert err == ""
    stopped = load(tmp_path / "broken" / "checkpoint.safetensors").position.env_steps
    assert 0 < stopped < 6_000
    output(capsys, *line.split()[1:])
    output(capsys, "train", "a2c", "--out", tmp_path / "whole", *settings)
    broken, whole = (load(tmp_path / f / "checkpoint.safetensors") for f in ("broken", "whole"))
    assert broken.state.keys() == whole.state.keys()
    for name, array in whole.state.items():
        assert array.tobytes() == broken.state[name].tobytes(), name
    columns = ["episode", "first_step", "length", "total_reward"]
    episodes = [pd.read_csv(tmp_path / f / "episodes.csv")[columns] for f in ("broken", "whole")]
    pd.testing.assert_frame_equal(*episodes)


def test_sim_and_serve_meet(tmp_path: Path) -> None:
    agent = start("serve", "pid", "--listen", "127.0.0.1:0", "--episodes", 2)
    assert agent.stdout is not None
    address = agent.stdout.readline().split()[5]
    simulator = start("sim", "--server", address, "--bind", "127.0.0.1:0", "--codec", "text")
    out, err = agent.communicate(timeout=30)
    assert agent.returncode == 0
    assert err == ""
    assert "episode 1: return" in out
    out, err = simulator.communicate(timeout=10)
    assert simulator.returncode == 0
    assert err == ""
    assert "the agent closed" in out


class Terse(gym.Env[Any, Any]):
    """Elevation without position and attitude in its telemetry."""

    def __init__(self) -> None:
        self.env: Any = gym.make("rotorgram/Elevation-v0", episode_length=50).unwrapped
        some = [a for a in self.env.env_spec.telemetry if a.name in ("thrust", "metrics")]
        self.env_spec = replace(self.env.env_spec, telemetry=tuple(some))
        self.observation_space = self.env.observation_space
        self.action_space = self.env.action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.env.reset(seed=seed)

    def step(self, action: Any) -> Any:
        return self.env.step(action)


def test_a_simulator_of_other_telemetry_is_served() -> None:  # fault 12
    port = free_port()
    agent = start("serve", "pid", "--listen", f"127.0.0.1:{port}", "--episodes", 1)
    with Simulator(Terse(), server=("127.0.0.1", port), bind=("127.0.0.1", 0)) as simulator:
        assert simulator.run() == "the agent closed"
    out, err = agent.communicate(timeout=30)
    assert agent.returncode == 0
    assert err == ""
    assert "episode 0: return" in out


def test_serve_flies_as_many_drones_as_the_simulator_has(
    tmp_path: Path, capsys: Capsys
) -> None:  # fault 12
    """A checkpoint of one drone; each episode is bit for bit that of one drone alone."""
    settings = ("--env-steps", 200, "--set", "steps_per_update=100", "--episode-length", 60)
    output(capsys, "train", "a2c", "--out", tmp_path / "run", *settings)
    told = []
    for drones in (1, 3):
        agent = start("serve", tmp_path / "run", "--listen", "127.0.0.1:0", "--episodes", 5)
        assert agent.stdout is not None
        server = agent.stdout.readline().split()[5]
        status, out, _ = run(
            capsys, "sim", "--server", server, "--bind", "127.0.0.1:0", "--num-envs", drones,
            "--episode-length", 60,
        )  # fmt: skip
        assert (status, "the agent closed" in out) == (0, True)
        out, err = agent.communicate(timeout=30)
        assert agent.returncode == 0
        assert err == ""
        told.append(re.findall("episode .*", out))
    assert len(told[0]) == 5
    assert told[0] == told[1]


def test_a_key_loss_and_a_journal(tmp_path: Path, capsys: Capsys) -> None:
    """What a user does who flies over a bad network that others share."""
    key = tmp_path / "key"
    journal = tmp_path / "flight.mcap"
    output(capsys, "key", key)
    assert key.stat().st_mode & 0o777 == 0o600
    assert run(capsys, "key", key)[0] == 1, "a key is never replaced"
    agent_port = free_port()
    agent = start(
        "serve", "pid", "--listen", f"0.0.0.0:{agent_port}", "--episodes", 1, "--key-file", key,
        "--record", journal,
    )  # fmt: skip
    simulator = start(
        "sim", "--server", f"127.0.0.1:{agent_port}", "--bind", "127.0.0.1:0", "--key-file", key,
        "--drop", 0.2,
    )  # fmt: skip
    out, _ = agent.communicate(timeout=60)
    assert agent.returncode == 0
    assert "episode 0: return" in out
    assert re.search(r"wire: .*duplicate.*round trip p50 \d", out)
    out, _ = simulator.communicate(timeout=10)
    assert simulator.returncode == 0
    assert re.search(r"wire: \d+ dropped, .*resent.*round trip p50 \d", out)
    status, out, _ = run(capsys, "replay", journal, "--verify")
    assert status == 0, out
    data = bytearray(journal.read_bytes())
    journal.write_bytes(data[: len(data) // 2])
    output(capsys, "replay", journal)


def test_an_agent_that_listens_knows_a_vehicle_with_drag() -> None:
    address = f"127.0.0.1:{free_port()}"
    flown = ["--env", "rotorgram/Hover-v0", "--action", "position", "--vehicle", "crazyflie2"]
    flown += ["--effects", "linear_drag=0.2"]
    agent = start("serve", "geometric", *flown, "--listen", address, "--episodes", 1)
    start("sim", "--server", address, "--bind", "127.0.0.1:0", *flown)
    out, err = agent.communicate(timeout=60)
    assert agent.returncode == 0, err
    assert "episode 0: return" in out


@pytest.mark.quiet
def test_ctrl_c_while_nobody_answers(tmp_path: Path) -> None:
    """No update comes any more, for the simulator is stopped: it ends all the same."""
    address = f"127.0.0.1:{free_port()}"
    simulator = start("sim", "--server", address, "--bind", "127.0.0.1:0")
    folder = tmp_path / "run"
    agent = start("train", "a2c", "--out", folder, "--listen", address, "--env-steps", 10**7)
    deadline = time.monotonic() + 60
    while not (folder / "checkpoint.safetensors").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    simulator.send_signal(signal.SIGSTOP)
    time.sleep(0.5)
    began = time.monotonic()
    agent.send_signal(signal.SIGINT)
    out, _ = agent.communicate(timeout=20)
    assert time.monotonic() - began < 5, "one second on a machine that has nothing else to do"
    assert agent.returncode == 130
    assert f"go on with: rotorgram train a2c --resume {folder}" in out
    episodes = pd.read_csv(folder / "episodes.csv")
    assert episodes.episode.tolist() == list(range(len(episodes)))
    simulator.kill()
    simulator.communicate()


def test_tensorboard_has_the_training_and_the_wire(tmp_path: Path, capsys: Capsys) -> None:
    settings = ("--env-steps", 1200, "--episode-length", 60)
    output(capsys, "train", "a2c", "--out", tmp_path / "run", *settings)
    board = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    board.Reload()
    names = board.Tags()["scalars"]
    assert {"rollout/ep_rew_mean", "time/fps", "wire/received", "wire/round_trip_p99_ms"} <= {
        *names
    }
    last = board.Scalars("rollout/ep_rew_mean")[-1]
    episodes = pd.read_csv(tmp_path / "run" / "episodes.csv")
    assert last.step == 1200
    assert last.value == pytest.approx(episodes.total_reward[-100:].mean(), rel=1e-5)
    assert board.Scalars("wire/received")[-1].value >= 1200


def test_compare_writes_everything(tmp_path: Path, capsys: Capsys) -> None:
    folder = tmp_path / "out"
    out = output(
        capsys, "compare", "--out", folder, "--seeds", 1, "--env-steps", 1100,
        "--snapshots", 2, "--episodes", 2, "--episode-length", 50,
    )  # fmt: skip
    assert f"report: {folder / 'report.html'}" in out.replace("\n", "")
    results = Results.read(folder)
    assert sorted(set(results.runs.row)) == ["a2c", "pid", "sb3-a2c", "vpg"]
    assert sorted(set(results.evaluations.row)) == ["a2c", "pid", "sb3-a2c", "vpg"]
    steps = results.steps("train")
    assert (steps.row == "a2c").sum() == 1100
    assert steps[steps.row == "vpg"].step.tolist() == list(range(1, 1101))
    names = {p.name for p in (folder / "checkpoints").iterdir()}
    assert names == {f"{a}-seed0.safetensors" for a in ("vpg", "a2c", "sb3-a2c")}
    page = (folder / "report.html").read_text()
    assert page.count("<figure>") == 4
    assert len(list((folder / "figures").glob("*.png"))) == 4
    assert (folder / "video.mp4").exists() == ("data:video/mp4;base64," in page)
    assert (folder / "results.csv").exists()
    assert results.specs["a2c"].options["episode_length"] == 50
    assert len(results.specs["a2c"].vehicle_hash) == 32
    # What is needed for the film alone is not needed for the report.
    shutil.rmtree(folder / "checkpoints")
    for name in ("video.mp4", "report.html", "results.md"):
        (folder / name).unlink(missing_ok=True)
    output(capsys, "report", folder)
    assert "data:video/mp4" not in (folder / "report.html").read_text()
    assert "| A2C (1 seed; 1,100 env steps) |" in (folder / "results.md").read_text()


def test_an_interrupted_comparison_goes_on(tmp_path: Path, capsys: Capsys) -> None:
    folder = tmp_path / "out"
    process = start(
        "compare", "--out", folder, "--agents", "vpg", "--seeds", 3, "--env-steps", 4_000,
        "--snapshots", 1, "--episodes", 1, "--jobs", 2,
    )  # fmt: skip
    deadline = time.monotonic() + 100
    while not list((folder / "runs").glob("vpg-seed*")):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert f"go on with: rotorgram compare --resume {folder}" in out
    assert err == "rotorgram: interrupted\n"
    assert "got others by --seeds" in refused(capsys, "compare", "--resume", folder, "--seeds", 4)
    output(capsys, "compare", "--resume", folder, "--jobs", 1, "--no-film")
    runs = Results.read(folder).runs
    assert runs[runs.row == "vpg"].seed.tolist() == [0, 1, 2]
    assert len(list((folder / "runs").iterdir())) == len(runs)
    again = output(capsys, "compare", "--resume", folder, "--no-film")
    assert "runs done" in again, "nothing is left to fly: the report is drawn again"


def test_a_killed_simulator_ends_a_training_with_a_sentence(tmp_path: Path) -> None:
    process = start("train", "a2c", "--out", tmp_path / "run", "--env-steps", 10_000_000)
    assert process.stdout is not None
    process.stdout.readline()
    children = subprocess.run(
        ["pgrep", "-P", str(process.pid)], capture_output=True, text=True, check=True
    )
    (simulator,) = children.stdout.split()
    os.kill(int(simulator), signal.SIGKILL)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 1
    assert err.splitlines()[-1] == (
        "rotorgram: the simulator ended with status -9: it said nothing"
    )
    assert f"go on with: rotorgram train a2c --resume {tmp_path / 'run'}" in out
