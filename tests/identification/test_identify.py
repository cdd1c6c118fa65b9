"""System identification: known values come back, and what a log does not tell is named."""

import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from estimates import identify
from flight_logs import MOTION, FlightLog, read_log
from prediction import Windows, differences, numbers_of, predict
from programs import EXAMPLES
from rotorgram.models.errors import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim.effects import EffectOptions
from rotorgram.sim.world import make_world
from worlds import alone, begin

DATA = Path(__file__).parents[1] / "data"
CASES = tomllib.loads((DATA / "identification.toml").read_text("utf-8"))
LIVELY = DATA / "lively.toml"
SCRIPT = EXAMPLES / "identification" / "identify.py"
PROGRAM = [sys.executable, SCRIPT]
SPEEDS = [f"m{i}_rads" for i in range(1, 5)]
TRUE = CASES["lively"]
WRONG = CASES["wrong"].values()
"""What the file to be corrected says instead."""


def flown(
    path: Path, seconds: float, shake: tuple[float, ...] = (1.0,) * 4, every: float = 0.01
) -> Path:
    """A log of a flight that a controller keeps upright; `shake` scales lift, roll, pitch, yaw."""
    vehicle = Vehicle.load(LIVELY)
    effects = EffectOptions(motor_lag=True, body_drag=True)
    world = make_world(vehicle, 1, effects=effects)
    begin(world, position=(0.0, 0.0, 50.0))
    rng = np.random.default_rng(3)
    mix = np.linalg.pinv(vehicle.allocation)
    wanted = np.zeros(4)
    rows = []
    for step in range(round(seconds / every)):
        if step % round(0.25 / every) == 0:
            wanted = shake * rng.normal(size=4) * (1.0, 0.12, 0.12, 1.0)
        state = alone(world)
        q = state.quaternion
        w = state.body_rates
        tilt = 2 * q[0] * q[1:3]
        torque = 0.1 * (wanted[1:3] - tilt) - 0.02 * w[:2]
        torque += 0.01 * np.array(shake[1:3]) * rng.normal(size=2)
        lift = 0.5 * 9.81 + 1.0 * (wanted[0] - state.velocity[2])
        thrust = mix @ (lift, *torque, 0.01 * (wanted[3] - w[2]))
        thrust = np.clip(thrust, 0.1, 2.9)
        turned = q + 0.002 * rng.normal(size=4)
        turned /= np.linalg.norm(turned)
        position = state.position + 0.003 * rng.normal(size=3)
        velocity = state.velocity + 0.03 * rng.normal(size=3)
        rates = w + 0.03 * rng.normal(size=3)
        speeds = np.sqrt(state.thrust / 3e-6) + 0.5 * rng.normal(size=4)
        commands = np.sqrt(thrust / 3e-6)
        row = ([every * step], position, turned, velocity, rates, speeds, commands)
        rows.append(np.concatenate(row))
        world.step(thrust, round(every / 0.005))
    assert alone(world).position[2] > 10.0
    world.close()
    commanded = [f"m{i}_command_rads" for i in range(1, 5)]
    table = pandas.DataFrame(rows, columns=["t", *MOTION, *SPEEDS, *commanded])
    table.to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("logs") / "lively.csv", 30.0, every=0.005)


@pytest.fixture
def wrong(tmp_path: Path) -> Path:
    text = LIVELY.read_text()
    for right, other in WRONG:
        assert right in text
        text = text.replace(right, other)
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    return file


@pytest.fixture(scope="module")
def commands(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same flight without measured speeds."""
    file = tmp_path_factory.mktemp("logs") / "lively.parquet"
    pandas.read_csv(log).drop(columns=SPEEDS).to_parquet(file)
    return file


@pytest.mark.parametrize("measured", [True, False])
def test_known_values_come_back(log: Path, commands: Path, wrong: Path, measured: bool) -> None:
    expected = dict(TRUE)
    if measured:
        del expected["rotors.time_constant"]
    vehicle = Vehicle.load(wrong)
    logs = [read_log(log if measured else commands, vehicle, period=0.005)]
    found = identify(vehicle, logs, tuple(TRUE))
    assert {one.name for one in found.estimates} == set(expected)
    missed = []
    for one in found.estimates:
        true = TRUE[one.name]
        half = one.high - one.value
        error = abs(one.value - true)
        assert not one.kept
        assert half < 0.2 * true
        assert error < 1.5 * half
        if error > half:
            missed.append(one.name)
    assert len(missed) <= 1  # of eight intervals of 95 %
    assert found.after[2] < 0.25 * found.before[2]


def test_a_hover_tells_the_thrust_alone(wrong: Path, tmp_path: Path) -> None:
    vehicle = Vehicle.load(wrong)
    log = read_log(flown(tmp_path / "hover.csv", 20.0, (0.0,) * 4), vehicle)
    found = {one.name: one for one in identify(vehicle, [log], tuple(TRUE)).estimates}
    thrust = found.pop("rotors.thrust_coefficient")
    assert not thrust.kept
    assert thrust.value == pytest.approx(3e-6, rel=0.01)
    for name, value in CASES["wrong_numbers"].items():
        assert found[name].kept.startswith(("not excited", "not told apart")), name
        assert found[name].value == pytest.approx(value)


def test_a_yawing_craft_does_not_tell_reaction_and_inertia_apart(tmp_path: Path) -> None:
    """Without rolling and pitching their ratio alone counts, and the file's reaction is kept."""
    vehicle = Vehicle.load(LIVELY)
    log = read_log(flown(tmp_path / "yaw.csv", 20.0, (0.0, 0.0, 0.0, 1.0)), vehicle)
    names = ("body.inertia.z", "rotors.reaction")
    inertia, reaction = identify(vehicle, [log], names).estimates
    assert not inertia.kept
    assert inertia.value == pytest.approx(4.0e-3, rel=0.03)
    assert "not told apart from body.inertia.z" in reaction.kept
    assert reaction.value == pytest.approx(0.02)


def run(*words: object, program: Sequence[Any] = PROGRAM) -> subprocess.CompletedProcess[str]:
    """A program, the example's by default."""
    command = [*program, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=110)


def test_the_program_writes_a_vehicle_that_loads(
    commands: Path, wrong: Path, tmp_path: Path
) -> None:
    out = tmp_path / "new.toml"
    words = (commands, "--vehicle", wrong, "--out", out)
    done = run(*words, "--period", "0.005")
    assert done.returncode == 0, done.stderr
    assert "95 % interval" in done.stdout
    assert "clustered over 15 segments of 2 s" in done.stdout
    vehicle = Vehicle.load(out)
    own = vehicle.coefficients
    assert vehicle.mass == 0.5
    assert own["rotors.thrust_coefficient"] == pytest.approx(3e-6, rel=0.02)
    assert own["rotors.time_constant"] == pytest.approx(0.04, rel=0.05)
    np.testing.assert_allclose(np.diag(vehicle.inertia)[:2], (2.0e-3, 2.5e-3), rtol=0.1)
    text = out.read_text()
    assert 'source = "identified from lively"' in text
    assert "95 % interval" in text
    again = run(*words)
    assert again.returncode == 1
    assert again.stderr.startswith("out: expected the name of a new file, got ")


def test_a_prediction_is_the_simulator_s(tmp_path: Path) -> None:
    """Constant speeds, drag of every kind, the center of mass beside the origin."""
    text = LIVELY.read_text().replace(
        "inertia =", "center_of_mass = [0.01, -0.005, 0.02]\ninertia ="
    )
    text = text.replace("time_constant = 0.04", "drag = 2e-5\ninflow = 3e-5\nlift = 1e-3")
    text += "angular = [2e-3, 3e-3, 1e-3]\nmoment = [4e-3, 5e-3]\n"
    file = tmp_path / "offset.toml"
    file.write_text(text)
    vehicle = Vehicle.load(file)
    speeds = np.array((640.0, 655.0, 650.0, 645.0))
    start = {
        "position": np.array((1.0, 2.0, 50.0)),
        "quaternion": np.array((0.9, 0.3, -0.2, 0.2449489742783178)),
        "velocity": np.array((2.0, -1.0, 0.5)),
        "body_rates": np.array((0.5, -1.0, 2.0)),
    }
    thrust = 3e-6 * speeds**2
    effects = EffectOptions(body_drag=True, rotor_drag=True)
    world = make_world(vehicle, 1, effects=effects)
    begin(world, thrust=thrust, **start)
    world.step(thrust, 100)
    row = np.concatenate(list(start.values()))
    states = np.tile(row, (101, 1))
    constant = np.tile(speeds, (101, 1))
    flight = FlightLog(name="", period=0.005, speeds=constant, states=states)
    windows = Windows.cut([flight], 100, 200)
    predicted = predict(vehicle, [numbers_of(vehicle)], windows)[0, 0, 0]
    truth = np.concatenate([getattr(alone(world), name) for name in start])
    errors = np.abs(differences(predicted, truth))
    assert errors[:2].max() < 2e-4  # position and attitude
    assert errors[2:].max() < 1e-3
    world.close()


def test_free_fall_with_linear_drag_falls_as_the_closed_form() -> None:
    vehicle = Vehicle.load(LIVELY)
    states = np.zeros((501, 13))
    states[:, 3] = 1.0
    flight = FlightLog(name="", period=0.002, states=states, speeds=np.zeros((501, 4)))
    candidates = [numbers_of(vehicle) | {"drag.linear.z": drag} for drag in (0.5, 0.0)]
    windows = Windows.cut([flight], 500, 600)
    draggy, free = predict(vehicle, candidates, windows)[:, 0, 0]
    # m dv/dt = -m g - c v with m = 0.5, c = 0.5: v = -g (1 - e^-t), z = -g (t - 1 + e^-t).
    assert draggy[9] == pytest.approx(-9.81 * (1 - np.exp(-1)), abs=1e-5)
    assert draggy[2] == pytest.approx(-9.81 * np.exp(-1), abs=1e-5)
    assert free[9] == pytest.approx(-9.81)


def test_a_short_log_and_an_unknown_number_are_refused(tmp_path: Path) -> None:
    vehicle = Vehicle.load(LIVELY)
    log = read_log(flown(tmp_path / "short.csv", 6.0), vehicle)
    with pytest.raises(InputError, match=r"at least 5 segments of 2 s in the logs, got 3"):
        identify(vehicle, [log])
    with pytest.raises(InputError, match=r"^fit: expected some of rotors\.thrust_coefficient"):
        identify(vehicle, [log], ["mass"])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["log.csv", "--out", "none/new.toml"], "out: expected a folder that exists for it, got "),
        (["--out", "new.toml"], "logs: expected one or more, got none"),
        (["no.csv", "--out", "new.toml"], "[Errno 2] No such file or directory: 'no.csv'"),
        (["log.csv", "--out", "new.toml"], "log.csv: expected columns m1...4_rads or "),
    ],
)
def test_wrong_words_are_one_sentence(
    words: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("t,x\n0,0\n")
    done = run(*words, "--vehicle", "paper")
    assert done.returncode == 1
    assert done.stderr.startswith(sentence)
    assert done.stderr.count("\n") == 1
    assert not Path("new.toml").exists()


INTERRUPTED = """
import runpy, signal, sys
sys.path.insert(0, sys.argv[1])
import estimates
estimates.identify = lambda *_: signal.raise_signal(signal.SIGINT)
sys.argv = sys.argv[2:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_ctrl_c_leaves_no_file(commands: Path, wrong: Path, tmp_path: Path) -> None:
    out = tmp_path / "new.toml"
    words = (SCRIPT.parent, SCRIPT, commands, "--vehicle", wrong, "--out", out)
    done = run(*words, program=[sys.executable, "-c", INTERRUPTED])
    assert done.returncode == 130
    assert done.stderr == ""
    assert not out.exists()


def test_a_wrong_period_is_a_wrong_flag(tmp_path: Path) -> None:
    done = run("log.csv", "--vehicle", "paper", "--out", tmp_path / "new.toml", "--period", "1")
    assert done.returncode == 2
    assert "period: expected a number from 0.0001 to 0.1 s" in done.stderr
