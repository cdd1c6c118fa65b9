"""Logs and plots of flights: their columns, units and pictures."""

import csv
from contextlib import closing
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from cases import CASES, each
from peers import ANY, Running
from rotorgram.cli import main
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.plots import plot_flights, roll_pitch_yaw, shown_columns
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.flights.signals import columns_of
from rotorgram.flights.trajectories import Trajectory, flown_trajectories
from rotorgram.udp import RemoteVectorEnv, Simulator
from rotorgram.udp.spawn import spawn_simulator

pytest.importorskip("mcap")
HEAD = CASES["hover"]["head"]


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three steps of a first episode, which is given up, and two of a second one."""
    path = tmp_path_factory.mktemp("journals") / "hover.mcap"
    action = np.array([0.1, 0.0, 0.0, 0.0], np.float32)
    with spawn_simulator(EnvConfig(env_id="rotorgram/Hover-v0"), record=path) as env:
        for steps in (3, 2):
            env.reset(seed=steps)
            for _ in range(steps):
                env.step(action)
    return path


def log(journal: Path, out: Path, *words: str) -> None:
    assert main(["log", str(journal), "--out", str(out), *words]) == 0


def table(file: Path) -> tuple[list[str], list[list[str]]]:
    with file.open(newline="", encoding="utf-8") as opened:
        head, *rows = csv.reader(opened)
    return head, rows


def test_a_log_has_the_time_first_and_units(
    journal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["log", str(journal)]) == 0
    head, rows = table(tmp_path / "hover.csv")
    width = len(HEAD)
    actions = head[width:-1]
    assert head[:width] == HEAD
    assert head[-1] == "reward"
    assert all(name.startswith("action_") for name in actions)
    assert [row[:3] for row in rows] == CASES["hover"]["rows"]
    begins = [row[-1] == "" for row in rows]
    assert begins == [True, False, False, False, True, False, False]
    assert rows[3][width] == "", "no action is flown from the last row"
    assert float(rows[0][width]) == pytest.approx(0.1)


def test_positions_of_a_log_have_z_up(journal: Path, tmp_path: Path) -> None:
    """Fault 63: the goal of Hover is 5 m high."""
    out = tmp_path / "log.csv"
    log(journal, out, "--episode", "1")
    head, rows = table(out)
    assert len(rows) == 3
    for axis, expected in zip("xyz", (0.0, 0.0, 5.0), strict=True):
        column = head.index(f"goal_{axis} [m]")
        assert {float(row[column]) for row in rows} == {expected}
    first = head.index("qw")
    quaternion = np.array(rows[2][first : first + 4], float)
    assert np.linalg.norm(quaternion) == pytest.approx(1.0)


@each("words, sentence", "log")
def test_wrong_words_of_log(
    journal: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there.csv").write_text("mine")
    assert main(["log", str(journal), *words]) == 1
    assert sentence in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["there.csv"]


def test_columns_of_a_flight_by_hand() -> None:
    spec = env_spec(EnvConfig(env_id="rotorgram/Elevation-v0"))
    telemetry = {array.name: np.zeros((2, *array.shape)) for array in spec.telemetry}
    telemetry["position"] = np.array([(3.0, -1.0, 2.0), (3.0, -1.0, 2.5)])
    telemetry["attitude"] = np.array([(1.0, 0.0, 0.0, 0.0), (0.6, 0.0, 0.0, -0.8)])
    flight = Trajectory(
        spec=spec,
        telemetry=telemetry,
        rewards=np.array([0.5]),
        actions=np.array([[0.25]]),
        ending="truncated",
        episode=7,
    )
    columns = {column.name: column.values.tolist() for column in columns_of(flight)}
    expected = {
        "time": [0.0, 0.02],
        "episode": [7, 7],
        "x": [3.0, 3.0],
        "y": [-1.0, -1.0],
        "z": [2.0, 2.5],
        "qw": [1.0, 0.6],
        "qz": [0.0, -0.8],
    }
    assert {name: columns[name] for name in expected} == expected
    assert columns["reward"][1] == 0.5


@each("quaternion, degrees", "angles")
def test_roll_pitch_and_yaw(quaternion: list[float], degrees: list[float]) -> None:
    angles = np.degrees(roll_pitch_yaw(np.array([quaternion])))
    np.testing.assert_allclose(angles, [degrees], atol=1e-3)


def test_a_yaw_of_two_turns_has_no_jump() -> None:
    half = np.linspace(0.0, 2 * np.pi, 50)
    zero = np.zeros(50)
    turns = np.stack((np.cos(half), zero, zero, np.sin(half)), axis=-1)
    np.testing.assert_allclose(roll_pitch_yaw(turns)[:, 2], 2 * half, atol=1e-9)


def test_panels_are_in_one_order_and_of_what_any_flight_has(journal: Path, tmp_path: Path) -> None:
    """A second flight with wind and another metric."""
    (plain, _) = recorded_trajectories(journal)
    assert list(shown_columns(plain))[:13] == CASES["panels"]["first"]
    assert {"time", "reward"}.isdisjoint(shown_columns(plain))
    effects = {"body_drag": True, "wind": [1.0, 0.0, 0.0]}
    other = EnvConfig.from_keywords("rotorgram/Waypoints-v0", vehicle="crazyflie2", effects=effects)
    windy = flown_trajectories(None, other, [0])[0]
    out = tmp_path / "both.svg"
    plot_flights({"plain": plain, "windy": windy}, out)
    texts = texts_of(out)
    assert {"x (m)", "wind x (m/s)", "position error (m)", "points left"} <= texts
    assert "goal x (m)" not in texts


def texts_of(file: Path) -> set[str | None]:
    tree = ElementTree.parse(file)
    return {element.text for element in tree.iter("{http://www.w3.org/2000/svg}text")}


def test_a_plot_lays_flights_over_each_other(journal: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "two.svg"
    assert main(["plot", str(journal), str(journal), "--out", str(out)]) == 0
    labels = [
        "x (m)",
        "roll (deg)",
        "yaw (deg)",
        "F1 (N)",
        "F4 (N)",
        "position error (m)",
        "time (s)",
    ]
    assert {"hover", "hover (again)", "goal", *labels} <= texts_of(out)


@pytest.mark.parametrize(
    ("ending", "start"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")]
)
def test_formats_of_a_plot(journal: Path, tmp_path: Path, ending: str, start: bytes) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / f"flight.{ending}"
    assert main(["plot", str(journal), "--episodes", "2", "--out", str(out)]) == 0
    assert out.read_bytes().startswith(start)
    assert main(["plot", str(journal), "--out", str(out)]) == 1, "a file is not overwritten"


@each("words, sentence", "plot")
def test_wrong_words_of_plot(
    journal: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    given = [str(journal) if word == "JOURNAL" else word for word in words]
    assert main(["plot", *given]) == 1
    assert sentence in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_journal_of_several_sessions_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "two.mcap"
    remote = RemoteVectorEnv(
        ANY, record=path, connect=False, timeout=5, num_envs=2, num_simulators=2
    )
    with closing(remote):
        simulators = [Running(Simulator(server=remote.address, bind=ANY)) for _ in range(2)]
        remote.reset(seed=[1, 2])
        remote.step(np.zeros((2, 1), np.float32))
    for simulator in simulators:
        simulator.join()
    log(path, tmp_path / "first.csv")
    expected = "two.mcap: session 1, the first of 2 that flew; --session of log, plot and render"
    assert f"{expected} takes another" in capsys.readouterr().err
    log(path, tmp_path / "second.csv", "--session", "2")
    assert capsys.readouterr().err == ""
