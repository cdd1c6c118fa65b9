"""Logs and plots of flights: their columns, units and pictures."""

import csv
import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from rotorgram.cli import main
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.plots import panels_of, roll_pitch_yaw
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.flights.signals import Signal, columns_of
from rotorgram.flights.trajectories import Trajectory
from rotorgram.udp.spawn import spawn_simulator

pytest.importorskip("mcap")
HEAD = [
    "time [s]", "episode", "drone", "x [m]", "y [m]", "z [m]", "qw", "qx", "qy", "qz",
    "vx [m/s]", "vy [m/s]", "vz [m/s]", "rate_x [rad/s]", "rate_y [rad/s]", "rate_z [rad/s]",
    "F1 [N]", "F2 [N]", "F3 [N]", "F4 [N]", "goal_x [m]", "goal_y [m]", "goal_z [m]",
    "position_error [m]", "heading_error [deg]",
]  # fmt: skip


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three steps of a first episode, which is given up, and two of a second one."""
    path = tmp_path_factory.mktemp("journals") / "hover.mcap"
    with spawn_simulator(EnvConfig(env_id="rotorgram/Hover-v0"), record=path) as env:
        for steps in (3, 2):
            env.reset(seed=steps)
            for _ in range(steps):
                env.step(np.array([0.1, 0.0, 0.0, 0.0], np.float32))
    return path


def table(file: Path) -> tuple[list[str], list[list[str]]]:
    with file.open(newline="", encoding="utf-8") as opened:
        head, *rows = csv.reader(opened)
    return head, rows


def test_a_log_has_the_time_first_and_units(
    journal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["log", str(journal), "--csv"]) == 0
    head, rows = table(tmp_path / "hover.csv")
    assert head[: len(HEAD)] == HEAD
    assert head[-1] == "reward"
    assert all(name.startswith("action_") for name in head[len(HEAD) : -1])
    assert [row[:3] for row in rows] == [
        ["0.0", "0", "0"], ["0.02", "0", "0"], ["0.04", "0", "0"], ["0.06", "0", "0"],
        ["0.0", "1", "0"], ["0.02", "1", "0"], ["0.04", "1", "0"],
    ]  # fmt: skip
    rewards = [row[-1] for row in rows]
    assert [reward == "" for reward in rewards] == [True, False, False, False, True, False, False]
    assert rows[3][len(HEAD)] == "", "no action is flown from the last row"
    assert float(rows[0][len(HEAD)]) == pytest.approx(0.1)


def test_positions_of_a_log_have_z_up(journal: Path, tmp_path: Path) -> None:
    """Fault 63: the goal of Hover is 5 m high."""
    out = tmp_path / "log.csv"
    assert main(["log", str(journal), "--csv", "--episode", "1", "--out", str(out)]) == 0
    head, rows = table(out)
    assert len(rows) == 3
    for name, expected in (("goal_x [m]", 0.0), ("goal_y [m]", 0.0), ("goal_z [m]", 5.0)):
        assert {float(row[head.index(name)]) for row in rows} == {expected}
    norm = sum(float(rows[2][head.index(q)]) ** 2 for q in ("qw", "qx", "qy", "qz"))
    assert norm == pytest.approx(1.0)


def test_parquet_has_the_same_numbers_and_units_in_metadata(journal: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "log.parquet"
    text = tmp_path / "log.csv"
    assert main(["log", str(journal), "--parquet", "--out", str(out)]) == 0
    assert main(["log", str(journal), "--csv", "--out", str(text)]) == 0
    read = parquet.read_table(out)
    assert read.column_names[:4] == ["time", "episode", "drone", "x"]
    assert read.schema.field("x").metadata == {b"unit": b"m"}
    assert read["reward"].null_count == 2
    _, rows = table(text)
    for i, name in enumerate(read.column_names):
        column = ["" if value is None else str(value) for value in read[name].to_pylist()]
        assert column == [row[i] for row in rows], name


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "log: expected either --csv or --parquet"),
        (["--csv", "--parquet"], "log: expected either --csv or --parquet"),
        (["--csv", "--out", "log.parquet"], "out: expected a file that ends in .csv"),
        (["--csv", "--out", "there.csv"], "out: expected the name of a new file, got there.csv"),
        (["--csv", "--out", "no/log.csv"], "out: expected a folder that exists for it"),
        (["--csv", "--episode", "2"], "episode: expected 0 to 1"),
        (["--csv", "--drone", "1"], "drone: expected 0 to 0"),
    ],
)
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
    assert columns["time"] == [0.0, 0.02]
    assert columns["episode"] == [7, 7]
    assert columns["x"] == [3.0, 3.0]
    assert columns["y"] == [-1.0, -1.0]
    assert columns["z"] == [2.0, 2.5]
    assert columns["qw"] == [1.0, 0.6]
    assert columns["qz"] == [0.0, -0.8]
    assert columns["reward"][1] == 0.5


@pytest.mark.parametrize(
    ("quaternion", "degrees"),
    [
        ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((math.cos(0.1), math.sin(0.1), 0.0, 0.0), (11.459, 0.0, 0.0)),
        ((math.cos(0.2), 0.0, math.sin(0.2), 0.0), (0.0, 22.918, 0.0)),
        ((math.cos(0.3), 0.0, 0.0, math.sin(0.3)), (0.0, 0.0, 34.377)),
    ],
)
def test_roll_pitch_and_yaw(quaternion: tuple[float, ...], degrees: tuple[float, ...]) -> None:
    angles = np.degrees(roll_pitch_yaw(np.array([quaternion])))
    np.testing.assert_allclose(angles, [degrees], atol=1e-3)


def test_a_yaw_of_two_turns_has_no_jump() -> None:
    half = np.linspace(0.0, 2 * np.pi, 50)
    zero = np.zeros(50)
    turns = np.stack((np.cos(half), zero, zero, np.sin(half)), axis=-1)
    np.testing.assert_allclose(roll_pitch_yaw(turns)[:, 2], 2 * half, atol=1e-9)


def test_panels_are_of_what_any_flight_has() -> None:
    rows = np.zeros((2, 8))

    def signal(name: str, unit: str, *components: str) -> Signal:
        return Signal(name, components, (unit,) * len(components), rows[:, : len(components)])

    first = [
        signal("thrust", "N", "F1", "F2"),
        signal("position", "m", "x", "y", "z"),
        signal("reward", "", "reward"),
    ]
    second = [signal("voltage", "V", "voltage"), signal("wind", "m/s", "wx", "wy", "wz")]
    flights = [{one.name: one for one in flight} for flight in (first, second)]
    panels = [(panel.label, panel.wide) for panel in panels_of(flights)]
    assert panels == [
        ("x (m)", False), ("y (m)", False), ("z (m)", False),
        ("wx (m/s)", False), ("wy (m/s)", False), ("wz (m/s)", False),
        ("thrust (N)", True), ("voltage (V)", False),
    ]  # fmt: skip


def texts(svg: Path) -> list[str]:
    tree = ElementTree.parse(svg)
    return [element.text or "" for element in tree.iter("{http://www.w3.org/2000/svg}text")]


def test_a_plot_lays_flights_over_each_other(journal: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "two.svg"
    assert main(["plot", str(journal), str(journal), "--names", "A", "B", "--out", str(out)]) == 0
    shown = texts(out)
    labels = ["x (m)", "roll (deg)", "yaw (deg)", "thrust (N)", "position error (m)", "time (s)"]
    assert {"A", "B", "goal", "F1", "F4", *labels} <= {*shown}


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_formats_of_a_plot(journal: Path, tmp_path: Path, ending: str) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / f"flight.{ending}"
    assert main(["plot", str(journal), "--episodes", "2", "--out", str(out)]) == 0
    start = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}[ending]
    assert out.read_bytes().startswith(start)
    assert main(["plot", str(journal), "--out", str(out)]) == 1, "a file is not overwritten"


def test_wrong_words_of_plot(
    journal: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "flight.png"
    for words, sentence in (
        ((str(journal), "--out", str(tmp_path / "a.gif")), "ends in .png or .pdf or .svg"),
        ((str(journal), "--out", str(out), "--names", "A", "B"), "names: expected one for each of"),
        ((str(tmp_path / "no.mcap"), "--out", str(out)), "expected a journal (.mcap)"),
        (("--out", str(out)), "flights: expected at least one journal, got none"),
    ):
        assert main(["plot", *words]) == 1
        assert sentence in capsys.readouterr().err
    assert not out.exists()


def test_all_drones_of_a_journal(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with spawn_simulator(
        EnvConfig(env_id="rotorgram/Elevation-v0"), num_envs=2, record=path
    ) as env:
        env.reset(seed=[1, 2])
        for _ in range(2):
            env.step(np.zeros((2, 1), np.float32))
    flights = recorded_trajectories(path, drone=None)
    assert [(one.drone, one.episode, one.seed, len(one)) for one in flights] == [
        (0, 0, 1, 2),
        (1, 0, 2, 2),
    ]
