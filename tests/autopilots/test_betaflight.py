"""Betaflight's SITL in the seat: paths of programs, with ':' between them, in ROTORGRAM_BETAFLIGHT.

Each may be of another release.
"""

import math
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from commands import Capsys, output, refused, write_program
from numpy.typing import NDArray
from rotorgram.agents.policies import Observation
from rotorgram.autopilots import find_stack
from rotorgram.autopilots.betaflight import configured
from rotorgram.autopilots.seat import Seat, Start, seated
from rotorgram.autopilots.sticks import Pilot
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.models import InputError
from rotorgram.udp.protocol.errors import PeerClosed, PeerSilent

PROGRAMS = [Path(path) for path in os.environ.get("ROTORGRAM_BETAFLIGHT", "").split(":") if path]
STACK = find_stack("betaflight")
needs_program = pytest.mark.skipif(
    not PROGRAMS, reason="ROTORGRAM_BETAFLIGHT: expected the path of Betaflight's SITL, got none"
)
every_program = pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.name)

TALKS = """
import os, socket, time
port = 5761 + int(os.environ.get("BETAFLIGHT_APART", 0))
link = socket.create_server(("127.0.0.1", port)).accept()[0]
while True:
    link.sendall(b"no end ")
    time.sleep(0.01)
"""
LISTENS_LATER = f"""
import os, signal, socket, sys
from pathlib import Path
sys.path.append({str(Path(__file__).parents[1])!r})
from player import answer_cli
started = Path(__file__).with_name("started")
port = 5761 + int(os.environ.get("BETAFLIGHT_APART", 0))
with socket.create_server(("127.0.0.1", port)) as listening:
    with started.open("a") as file:
        file.write("once ")
    if len(started.read_text().split()) < 3:
        signal.pause()
    answer_cli(listening)
"""


class Asks:
    """A policy that asks for the same action all the time."""

    def __init__(self, *action: float) -> None:
        self._action = np.array(action, np.float32)

    def reset(self) -> None:
        pass

    def act(self, observation: Observation) -> NDArray[np.float32]:
        return self._action


def config_of(**settings: object) -> EnvConfig:
    options = {"vehicle": "hummingbird", "start_tilt": 0.0, **settings}
    return EnvConfig.from_keywords("rotorgram/Hover-v0", **options)


def flown(
    program: Path, config: EnvConfig, mode: str, pilot: Pilot | None = None
) -> Iterator[tuple[Seat, dict[str, NDArray[np.float64]]]]:
    """The seat and the telemetry after each step of a flight."""
    inner = seated(config, STACK.rate)
    start = Start(inner, inner.load_vehicle(), mode, program, policy=pilot)
    with closing(LocalVectorEnv(inner, 1, autoreset_mode="Disabled")) as env:
        observations, _ = env.reset(seed=5)
        with closing(Seat(env.env_spec, start, STACK.make)) as seat:
            while True:
                action = seat.act({name: array[0] for name, array in observations.items()})
                observations, _, terminated, truncated, _ = env.step(action[np.newaxis])
                yield seat, {name: array[0] for name, array in env.telemetry.items()}
                if terminated.any() or truncated.any():
                    return


def children() -> set[int]:
    """Processes that this one has started."""
    own = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children")
    return {int(pid) for pid in own.read_text().split()}


@every_program
def test_flies_to_the_goal_and_repeats_its_hash(program: Path) -> None:
    words = ("fly", "betaflight", "--program", program, "--vehicle", "hummingbird",
             "--env", "rotorgram/Hover-v0", "--effects", "motor_lag")  # fmt: skip
    printed = []
    for _ in range(2):
        command = [sys.executable, "-m", "rotorgram", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        printed.append(done.stdout)
        assert "lock-step  all " in done.stdout
        error = re.search(r"^steady\s+e (\S+) m", done.stdout, re.MULTILINE)
        assert error is not None
        assert float(error[1]) < 0.04
    hashes = [re.findall(r"^hash\s+(\w{16})$", text, re.MULTILINE) for text in printed]
    assert len(hashes[0]) == 1
    assert hashes[0] == hashes[1]


@every_program
def test_rates_in_acro(program: Path) -> None:
    """A quarter of a turn per second about each axis; that of yaw is reached slowly."""
    rates = config_of(action="rates", control_period=0.01, episode_length=25)
    spec = env_spec(rates)
    for axis, sign in ((0, 1.0), (1, -1.0), (2, 1.0)):
        action = np.zeros(4)
        action[1 + axis] = sign * 0.5 * math.pi / spec.action_scale[1 + axis]
        pilot = Pilot(Asks(*action), spec)
        *_, (_, last) = flown(program, rates, "acro", pilot)
        expected = np.zeros(3)
        expected[axis] = sign * 0.5 * math.pi
        assert last["body_rates"] == pytest.approx(expected, abs=0.4)


def test_a_policy_between_two_steps_is_refused() -> None:
    for period in (0.0004, 0.0025):
        config = config_of(action="position", control_period=period)
        pilot = Pilot(Asks(0.0, 0.0, 0.0, 0.0), env_spec(config))
        flight = seated(config, STACK.rate)
        start = Start(flight, config.load_vehicle(), "angle", Path("none"), policy=pilot)
        sentence = (
            f"policy: expected a control period of whole ms with betaflight, got {period * 1e3}"
        )
        with pytest.raises(InputError, match=sentence):
            STACK.make(start)


def test_one_that_ends_before_its_cli_says_what_it_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rotorgram.autopilots.betaflight.ANSWER", 0.5)
    program = tmp_path / "none"
    program.write_text("#!/bin/sh\necho no memory\nexit 3\n")
    program.chmod(0o755)
    config = config_of()
    start = Start(seated(config, STACK.rate), config.load_vehicle(), "angle", program)
    with pytest.raises(PeerClosed, match=r"^betaflight: ended with status 3: no memory$"):
        STACK.make(start)


def test_a_cli_that_never_ends_its_answer_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rotorgram.autopilots.betaflight.CLI_ANSWER", 0.3)
    program = tmp_path / "talks"
    write_program(program, TALKS)
    config = config_of()
    start = Start(seated(config, STACK.rate), config.load_vehicle(), "angle", program)
    sentence = r"^betaflight: expected its CLI, got none: no end of its answer to '#'$"
    with pytest.raises(PeerSilent, match=sentence):
        STACK.make(start)


@pytest.mark.skipif(shutil.which("cc") is None, reason="expected a C compiler, got none")
def test_one_whose_cli_hears_nobody_is_started_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rotorgram.autopilots.betaflight.CLI_ANSWER", 0.3)
    program = tmp_path / "later"
    write_program(program, LISTENS_LATER)
    before = children()
    assert configured(program, ("set small_angle = 180",), True) == ((2026, 12), b"configured")
    assert len((tmp_path / "started").read_text().split()) >= 3
    assert children() == before


@needs_program
def test_a_killed_program_gives_no_thrust() -> None:
    """Its rotors stop, the craft falls, and a sentence tells why."""
    before = children()
    flight = flown(PROGRAMS[0], config_of(), "angle")
    for _ in range(200):
        seat, telemetry = next(flight)
    assert telemetry["thrust"].min() > 0.1
    (pid,) = children() - before
    os.kill(pid, signal.SIGKILL)
    for _ in range(300):
        seat, telemetry = next(flight)
    assert telemetry["thrust"] == pytest.approx(np.zeros(4))
    assert telemetry["velocity"][2] < -2.0
    (fault,) = seat.tally.faults
    assert fault.startswith("betaflight: ended with status -9")
    flight.close()
    assert children() == before


@needs_program
def test_two_programs_fly_side_by_side() -> None:
    config = config_of(episode_length=5)
    pairs = list(zip(*(flown(PROGRAMS[0], config, "angle") for _ in range(2)), strict=True))
    (_, first), (_, second) = pairs[-1]
    assert len(pairs) == 100
    assert (first["position"] == second["position"]).all()


@needs_program
def test_a_command_that_its_cli_refuses() -> None:
    with pytest.raises(InputError, match="expected that it takes 'set nonsense = 1', got"):
        configured(PROGRAMS[0], ("set nonsense = 1",), lockstep=True)


@needs_program
def test_a_policy_of_another_task_is_refused() -> None:
    config = config_of()
    spec = env_spec(config.changed(action="rates", history=2))
    with pytest.raises(
        InputError,
        match="policy: expected one that observes what rotorgram/Hover-v0 shows here, got",
    ):
        next(flown(PROGRAMS[0], config, "acro", Pilot(Asks(0.0), spec)))


def test_only_betaflight_has_sticks(capsys: Capsys, tmp_path: Path) -> None:
    program = tmp_path / "program"
    program.touch()
    words = ("fly", "crazyflie", "--program", program, "--policy", "geometric")
    assert "policy: expected betaflight, got crazyflie" in refused(capsys, *words)


@pytest.mark.parametrize("flag", ["--action=rates", "--control-period=0.02"])
def test_the_level_of_the_motors_is_not_chosen(capsys: Capsys, tmp_path: Path, flag: str) -> None:
    program = tmp_path / "program"
    program.touch()
    told = refused(capsys, "fly", "betaflight", "--program", program, flag)
    assert "--action, --control-period: expected them with --policy alone" in told


@needs_program
def test_a_controller_moves_the_sticks(capsys: Capsys) -> None:
    words = ("fly", "betaflight", "--program", PROGRAMS[0], "--vehicle", "hummingbird", "--env",
             "rotorgram/Hover-v0", "--episode-length", "5", "--policy", "geometric")  # fmt: skip
    assert "lock-step  all " in output(capsys, *words)
