"""System identification: known values come back, and what a log does not tell is named."""

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from rotorgram.cli import main
from rotorgram.flights.flight_logs import FlightLog, read_log, with_lag
from rotorgram.flights.identify import identify
from rotorgram.flights.prediction import Windows, differences, numbers_of, predict
from rotorgram.models.errors import InputError
from rotorgram.models.vehicle import Vehicle
from rotorgram.sim.backends import kernel
from rotorgram.sim.effects import EffectOptions
from rotorgram.sim.state import InitialState
from rotorgram.sim.world import make_world

pytest.importorskip("scipy")
pandas = pytest.importorskip("pandas")

LIVELY = Path(__file__).parents[1] / "data" / "lively.toml"
TRUE = {
    "rotors.thrust_coefficient": 3e-6,
    "rotors.time_constant": 0.04,
    "body.inertia.x": 2.0e-3,
    "body.inertia.y": 2.5e-3,
    "body.inertia.z": 4.0e-3,
    "drag.linear.x": 0.15,
    "drag.linear.y": 0.2,
    "drag.linear.z": 0.1,
}
WRONG = {
    "inertia = [2.0e-3, 2.5e-3, 4.0e-3]": "inertia = [2.8e-3, 3.2e-3, 3.0e-3]",
    "thrust_coefficient = 3e-6": "thrust_coefficient = 2.5e-6",
    "time_constant = 0.04": "time_constant = 0.06",
    "linear = [0.15, 0.2, 0.1]": "linear = [0.3, 0.05, 0.3]",
}
"""What the file to be corrected says instead."""


def flown(
    path: Path, seconds: float, lively: float | tuple[float, ...], every: float = 0.005
) -> Path:
    """A log of a flight, which a controller keeps upright; `lively` scales what shakes it.

    One number, or one each for lift, roll, pitch and yaw.
    """
    vehicle = Vehicle.load(LIVELY)
    effects = EffectOptions(motor_lag=True, body_drag=True)
    world = make_world(vehicle, 1, effects=effects)
    world.reset(np.True_, InitialState(position=np.array((0.0, 0.0, 50.0))))
    shake = np.broadcast_to(lively, 4)
    rng = np.random.default_rng(3)
    mix = np.linalg.pinv(vehicle.allocation)
    state = world.state
    rows = []
    wanted = np.zeros(4)
    coefficient = 3e-6
    for step in range(round(seconds / every)):
        if step % round(0.25 / every) == 0:
            wanted = shake * rng.normal(size=4) * (1.0, 0.12, 0.12, 1.0)
        q = state.quaternion
        w = state.body_rates
        v = state.velocity
        tilt = 2 * q[0] * q[1:3]
        torque = np.zeros(3)
        torque[:2] = (
            0.1 * (wanted[1:3] - tilt) - 0.02 * w[:2] + 0.01 * shake[1:3] * rng.normal(size=2)
        )
        torque[2] = 0.01 * (wanted[3] - w[2])
        lift = 0.5 * 9.81 + 1.0 * (wanted[0] - v[2])
        thrust = np.clip(mix @ (lift, *torque), 0.1, 2.9)
        speeds, told = (np.sqrt(x / coefficient) for x in (state.thrust, thrust))
        turned = q + 0.002 * rng.normal(size=4)
        rows.append((
            every * step, *(state.position + 0.003 * rng.normal(size=3)),
            *(turned / np.linalg.norm(turned)), *(v + 0.03 * rng.normal(size=3)),
            *(w + 0.03 * rng.normal(size=3)), *(speeds + 0.5 * rng.normal(size=4)), *told,
        ))  # fmt: skip
        world.step(thrust, round(every / 0.005))
    assert state.position[2] > 10.0
    world.close()
    names = ["t", "x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz"]
    names += [f"m{i}_rads" for i in range(1, 5)] + [f"m{i}_command_rads" for i in range(1, 5)]
    pandas.DataFrame(rows, columns=names).to_csv(path, index=False)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("logs") / "lively.csv", 30.0, 1.0)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("logs") / "short.csv", 6.0, 1.0, every=0.01)


@pytest.fixture
def wrong(tmp_path: Path) -> Path:
    text = LIVELY.read_text()
    for right, other in WRONG.items():
        assert right in text
        text = text.replace(right, other)
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    return file


@pytest.mark.parametrize("measured", [True, False])
def test_known_values_come_back(log: Path, wrong: Path, tmp_path: Path, measured: bool) -> None:
    file = log
    if not measured:  # from commands alone
        table = pandas.read_csv(log)
        file = tmp_path / "commands.parquet"
        table.drop(columns=[f"m{i}_rads" for i in range(1, 5)]).to_parquet(file)
    vehicle = Vehicle.load(wrong)
    logs = [read_log(file, vehicle, period=0.005)]
    found = identify(vehicle, logs, names=tuple(TRUE))
    assert {one.name for one in found.estimates} == set(TRUE)
    missed = []
    for one in found.estimates:
        true = TRUE[one.name]
        half = one.high - one.value
        assert not one.kept
        assert half < 0.2 * true
        assert abs(one.value - true) < 1.5 * half
        missed += [one.name] if abs(one.value - true) > half else []
    assert len(missed) <= 1  # of eight intervals of 95 %
    assert found.after[2] < 0.25 * found.before[2]


def test_a_hover_tells_the_thrust_alone(wrong: Path, tmp_path: Path) -> None:
    vehicle = Vehicle.load(wrong)
    log = read_log(flown(tmp_path / "hover.csv", 20.0, 0.0, every=0.01), vehicle)
    found = {one.name: one for one in identify(vehicle, [log], names=tuple(TRUE)).estimates}
    thrust = found.pop("rotors.thrust_coefficient")
    assert not thrust.kept
    assert thrust.value == pytest.approx(3e-6, rel=0.01)
    own = {"body.inertia.x": 2.8e-3, "body.inertia.y": 3.2e-3, "drag.linear.x": 0.3}
    own |= {"body.inertia.z": 3.0e-3, "drag.linear.y": 0.05, "drag.linear.z": 0.3}
    for name, value in own.items():
        assert found[name].kept.startswith(("not excited", "not told apart")), name
        assert found[name].value == pytest.approx(value)


def test_a_yawing_craft_does_not_tell_reaction_and_inertia_apart(tmp_path: Path) -> None:
    """Without rolling and pitching their ratio alone counts, and the file's reaction is kept."""
    vehicle = Vehicle.load(LIVELY)
    log = read_log(flown(tmp_path / "yaw.csv", 20.0, (0.0, 0.0, 0.0, 1.0), every=0.01), vehicle)
    names = ("body.inertia.z", "rotors.reaction")
    inertia, reaction = identify(vehicle, [log], names=names).estimates
    assert not inertia.kept
    assert inertia.value == pytest.approx(4.0e-3, rel=0.03)
    assert "not told apart from body.inertia.z" in reaction.kept
    assert reaction.value == pytest.approx(0.02)


def test_the_command_writes_a_vehicle_that_loads(
    log: Path, wrong: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new.toml"
    words = ["identify", str(log), "--vehicle", str(wrong), "--out", str(out)]
    assert main([*words, "--period", "0.005"]) == 0
    told = capsys.readouterr().out
    assert "95 % interval" in told
    assert "clustered over 15 segments of 2 s" in told
    vehicle = Vehicle.load(out)
    assert vehicle.mass == 0.5
    assert vehicle.coefficients.rotors.thrust_coefficient == pytest.approx(3e-6, rel=0.02)
    assert vehicle.coefficients.rotors.time_constant == pytest.approx(0.04, rel=0.05)
    np.testing.assert_allclose(np.diag(vehicle.inertia)[:2], (2.0e-3, 2.5e-3), rtol=0.1)
    text = out.read_text()
    assert 'source = "identified from lively"' in text
    assert "95 % interval" in text
    # A file is not overwritten.
    assert main(words) == 1


def test_a_prediction_is_the_simulator_s(log: Path) -> None:
    """Constant speeds, drag of every kind, the center of mass beside the origin."""
    text = LIVELY.read_text().replace(
        "inertia =", "center_of_mass = [0.01, -0.005, 0.02]\ninertia ="
    )
    text = text.replace("time_constant = 0.04", "drag = 2e-5\ninflow = 3e-5\nlift = 1e-3")
    text += "angular = [2e-3, 3e-3, 1e-3]\nmoment = [4e-3, 5e-3]\n"
    file = log.parent / "offset.toml"
    file.write_text(text)
    vehicle = Vehicle.load(file)
    speeds = np.array((640.0, 655.0, 650.0, 645.0))
    start = {
        "position": (1.0, 2.0, 50.0), "quaternion": (0.9, 0.3, -0.2, 0.2449489742783178),
        "velocity": (2.0, -1.0, 0.5), "body_rates": (0.5, -1.0, 2.0),
    }  # fmt: skip
    arrays = {name: np.array(value) for name, value in start.items()}
    world = make_world(vehicle, 1, effects=EffectOptions(body_drag=True, rotor_drag=True))
    thrust = 3e-6 * speeds**2
    world.reset(np.True_, InitialState(thrust=thrust, **arrays))
    world.step(thrust, 100)
    count = 101
    held = {name: np.tile(array, (count, 1)) for name, array in arrays.items()}
    flight = FlightLog(name="", period=0.005, speeds=np.tile(speeds, (count, 1)), **held)
    windows = Windows.cut([flight], 100, 200)
    ((_, predicted),) = predict(vehicle, numbers_of(vehicle), windows)
    state = world.state
    truth = (state.position, state.quaternion, state.velocity, state.body_rates)
    p, r, v, w = differences(predicted, [array[:, None] for array in truth])
    assert np.abs(p).max() < 2e-4
    assert np.abs(r).max() < 2e-4
    assert np.abs(v).max() < 1e-3
    assert np.abs(w).max() < 1e-3
    world.close()


@pytest.mark.parametrize("compiler", ["works", "fails", "missing"])
def test_free_fall_with_linear_drag_falls_as_the_closed_form(
    compiler: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if compiler == "fails":
        kernel._library.cache_clear()
        monkeypatch.setenv("CC", str(shutil.which("false")))
    if compiler == "missing":
        monkeypatch.setattr(kernel, "compiler", lambda: None)
    vehicle = Vehicle.load(LIVELY)
    numbers = numbers_of(vehicle) | {"drag.linear.z": 0.5}
    still = np.zeros((501, 3))
    level = np.tile((1.0, 0.0, 0.0, 0.0), (501, 1))
    flight = FlightLog(
        name="", period=0.002, position=still, quaternion=level, velocity=still,
        body_rates=still, speeds=np.zeros((501, 4)),
    )  # fmt: skip
    windows = Windows.cut([flight], 500, 600)
    ((_, (position, _, velocity, _)),) = predict(vehicle, numbers, windows)
    # m dv/dt = -m g - c v with m = 0.5, c = 0.5: v = -g (1 - e^-t), z = -g (t - 1 + e^-t).
    assert velocity[2, 0] == pytest.approx(-9.81 * (1 - np.exp(-1)), abs=1e-5)
    assert position[2, 0] == pytest.approx(-9.81 * np.exp(-1), abs=1e-5)
    warnings = [line.startswith("predictions by NumPy: compiled: ") for line in caplog.messages]
    assert warnings == ([True] if compiler == "fails" else [])


def test_lag_is_the_closed_form(short: Path) -> None:
    vehicle = Vehicle.load(LIVELY)
    table = pandas.read_csv(short).head(60)
    for i in range(1, 5):
        table[f"m{i}_command_rads"] = np.where(np.arange(60) < 10, 500.0, 600.0)
    file = short.parent / "steps.csv"
    table.to_csv(file, index=False)
    speeds = with_lag(read_log(file, vehicle), 0.05).speeds
    assert speeds[10, 0] == pytest.approx(500.0)
    assert speeds[15, 2] == pytest.approx(600 - 100 * np.exp(-0.05 / 0.05))


def test_columns_may_have_other_names_units_and_times(short: Path, tmp_path: Path) -> None:
    vehicle = Vehicle.load(LIVELY)
    table = pandas.read_csv(short).head(200)
    plain = read_log(short, vehicle)
    table["rpm"] = table.pop("m1_rads") * 60 / (2 * np.pi)
    table = table.rename(columns={"x": "pos_x"})
    table[["qw", "qx", "qy", "qz"]] *= np.where(np.arange(200) % 3, 1, -1)[:, None]
    file = tmp_path / "other.csv"
    table.to_csv(file, index=False)
    columns = {"x": "pos_x", "m1_rads": "rpm*0.10471975511965977"}
    read = read_log(file, vehicle, columns, period=0.005)
    assert read.position.shape == (399, 3)
    np.testing.assert_allclose(read.position[::2], plain.position[:200], atol=1e-12)
    np.testing.assert_allclose(read.speeds[::2], plain.speeds[:200])
    middle = 0.5 * (plain.position[0] + plain.position[1])
    np.testing.assert_allclose(read.position[1], middle, atol=1e-12)
    turned = np.abs((read.quaternion[::2] * plain.quaternion[:200]).sum(axis=1))
    np.testing.assert_allclose(turned, 1.0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda t: t.drop(columns="vy"), "expected a column vy"),
        (lambda t: t.drop(columns=[f"m{i}_rads" for i in (1, 2, 3, 4)]
                          + [f"m{i}_command_rads" for i in (1, 2, 3, 4)]), "m1...4_rads"),
        (lambda t: t.drop(index=range(50, 70)), "no gap of more than 0.1 s, got 0.21 s"),
        (lambda t: t.assign(x=np.nan), "finite numbers"),
        (lambda t: t.assign(x="here"), "numbers in x"),
    ],
)  # fmt: skip
def test_a_wrong_log_is_refused(short: Path, tmp_path: Path, change: object, sentence: str) -> None:
    vehicle = Vehicle.load(LIVELY)
    file = tmp_path / "log.csv"
    change(pandas.read_csv(short).head(200)).to_csv(file, index=False)  # type: ignore[operator]
    with pytest.raises(InputError, match=sentence.replace(".", r"\.")):
        read_log(file, vehicle)


def test_a_csv_without_rows_is_one_sentence(tmp_path: Path) -> None:
    """Fault 54."""
    names = [
        *["t", "x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz"],
        *(f"m{i}_rads" for i in range(1, 5)),
    ]
    file = tmp_path / "head.csv"
    file.write_text(",".join(names) + "\n")
    with pytest.raises(InputError, match=r"^head\.csv: expected two or more samples, got 0$"):
        read_log(file, Vehicle.load(LIVELY))


@pytest.mark.parametrize("impossible", [1e6, 1e308, -50.0])
@pytest.mark.parametrize("row", [0, 60, 199])
@pytest.mark.parametrize("column", ["x", "vz"])
def test_an_impossible_sample_is_left_out(
    short: Path, tmp_path: Path, impossible: float, row: int, column: str
) -> None:
    """Fault 45: the velocity contradicts a position, or both positions contradict a velocity."""
    if column == "vz" and impossible < 1e308:
        impossible *= 10  # -500 m/s moves by 5 m in a sample
    vehicle = Vehicle.load(LIVELY)
    file = tmp_path / "log.csv"
    table = pandas.read_csv(short).head(200)
    table.to_csv(file, index=False)
    whole = read_log(file, vehicle)
    table.loc[row, column] = impossible
    table.to_csv(file, index=False)
    read = read_log(file, vehicle)
    assert whole.left_out == 0
    assert read.left_out == 1
    lost = {0: 1, 199: 1}.get(row, 0)
    assert len(read.position) == len(whole.position) - lost
    shift = 1 if row == 0 else 0
    same = whole.position[shift : shift + len(read.position)]
    np.testing.assert_allclose(read.position, same, atol=0.05)


def test_a_jump_of_the_attitude_is_left_out(short: Path, tmp_path: Path) -> None:
    vehicle = Vehicle.load(LIVELY)
    file = tmp_path / "log.csv"
    table = pandas.read_csv(short).head(200)
    table.loc[60, ["qw", "qx", "qy", "qz"]] = (0.0, 1.0, 0.0, 0.0)  # on its head
    table.to_csv(file, index=False)
    assert read_log(file, vehicle).left_out == 1


def test_a_log_that_jumps_for_good_is_refused(short: Path, tmp_path: Path) -> None:
    vehicle = Vehicle.load(LIVELY)
    file = tmp_path / "log.csv"
    table = pandas.read_csv(short).head(200)
    table.loc[100:, "x"] += 5.0
    table.to_csv(file, index=False)
    with pytest.raises(InputError, match=r"agree with velocities and rates, got a jump at 1 s"):
        read_log(file, vehicle)


def test_rotor_speeds_that_no_rotor_reaches_are_refused(short: Path, tmp_path: Path) -> None:
    vehicle = Vehicle.load(LIVELY)
    file = tmp_path / "log.csv"
    table = pandas.read_csv(short).head(200)
    table.loc[60, "m1_rads"] = 1e6
    table.to_csv(file, index=False)
    with pytest.raises(InputError, match=r"rotor speeds of at most 5000 rad/s, got 1e\+06"):
        read_log(file, vehicle)


def test_a_short_log_and_an_unknown_number_are_refused(short: Path) -> None:
    vehicle = Vehicle.load(LIVELY)
    log = read_log(short, vehicle)
    with pytest.raises(InputError, match=r"at least 5 segments of 2 s in the logs, got 3"):
        identify(vehicle, [log])
    with pytest.raises(InputError, match=r"^fit: expected some of rotors\.thrust_coefficient"):
        identify(vehicle, [log], names=["mass"])


def ulog(path: Path) -> Path:
    """A PX4 log of 2 s: a climb at 1 m/s past 3 m north and 2 m east, rolled by 0.2 rad."""
    topics = {
        "vehicle_local_position": (["x", "y", "z", "vx", "vy", "vz"], "float"),
        "vehicle_attitude": (["q[4]"], "float"),
        "vehicle_angular_velocity": (["xyz[3]"], "float"),
        "actuator_motors": (["control[12]"], "float"),
    }

    def message(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    parts = [b"\x55\x4c\x6f\x67\x01\x12\x35\x01" + struct.pack("<Q", 0)]
    parts.append(message("B", bytes(40)))
    for topic, (names, kind) in topics.items():
        fields = ["uint64_t timestamp"]
        for name in names:
            word, bracket, size = name.partition("[")
            fields.append(f"{kind}{bracket}{size} {word}")
        parts.append(message("F", f"{topic}:{';'.join(fields)};".encode()))
    for index, topic in enumerate(topics):
        parts.append(message("A", struct.pack("<BH", 0, index) + topic.encode()))
    for step in range(201):
        time = step * 0.01
        rows = (
            (3.0, 2.0, -5.0 - time, 0.0, 0.0, -1.0),
            (np.cos(0.1), np.sin(0.1), 0.0, 0.0),
            (0.1, 0.2, 0.3),
            (0.25, 0.5, 0.75, 1.0, *[np.nan] * 8),
        )
        for index, row in enumerate(rows):
            head = struct.pack("<HQ", index, 1_000_000 + step * 10_000)
            parts.append(message("D", head + struct.pack(f"<{len(row)}f", *row)))
    path.write_bytes(b"".join(parts))
    return path


def test_a_ulog_file_comes_in_our_frames(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    log = read_log(ulog(tmp_path / "flight.ulg"), Vehicle.load(LIVELY))
    flight = log
    assert not log.measured
    # North east down becomes north, west, up; forward right down becomes forward, left, up.
    np.testing.assert_allclose(flight.position[100], (3.0, -2.0, 6.0), atol=1e-6)
    np.testing.assert_allclose(flight.velocity[50], (0.0, 0.0, 1.0), atol=1e-6)
    expected = (np.cos(0.1), np.sin(0.1), 0.0, 0.0)
    np.testing.assert_allclose(flight.quaternion[7], expected, atol=1e-6)
    np.testing.assert_allclose(flight.body_rates[7], (0.1, -0.2, -0.3), atol=1e-6)
    # A quarter of the largest thrust, 3 N, at 3e-6 N s²/rad², is 500 rad/s.
    assert flight.speeds[7, 0] == pytest.approx(500.0)
    assert flight.speeds[7, 3] == pytest.approx(1000.0)


def test_a_folder_that_is_not_there_is_told_before_anything_is_flown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "none" / "new.toml"
    assert main(["identify", "log.csv", "--vehicle", "paper", "--out", str(out)]) == 1
    assert "out: expected a folder that exists for it, got " in capsys.readouterr().err
