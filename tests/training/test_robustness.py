"""The table of robustness: its cells, its flights, its numbers, and the command that writes it."""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rotorgram.cli import main
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.perturbations import PERTURBATIONS
from rotorgram.flights.executors import WorkersConfig
from rotorgram.training import robustness
from rotorgram.training.robustness import NOMINAL, TOGETHER, Cell, cells_of, fly, jobs_of, table_of

CONFIG = EnvConfig.from_keywords(
    "rotorgram/Hover-v0", vehicle="hummingbird", backend="rigid", action="position",
    episode_length=60,
)  # fmt: skip


def test_cells_of_a_craft_and_what_it_cannot_fly() -> None:
    cells, refused = cells_of(CONFIG)
    rows = list(dict.fromkeys(cell.row for cell in cells))
    assert rows == [NOMINAL, *(name for name in PERTURBATIONS if name not in refused), TOGETHER]
    assert refused["obstacles"] == "rotorgram/Hover-v0: expected a task with density, it has none"
    assert "rotors.curve" in refused["curve"]
    sizes = [cell.size for cell in cells if cell.row == "wind"]
    assert sizes == [2, 5, 8]
    last = cells[-1]
    assert last.drawn["mass"] == "uniform(0.5, 1.5)"
    assert last.drawn["start_tilt"] == "uniform(0, 180.0)"
    assert last.config.effects.motor_lag
    labels = [cell.label for cell in cells]
    assert len(set(labels)) == len(labels)
    assert {"nominal", "wind 5 m/s", "all together, 3 of 3"} <= {*labels}


def test_cells_of_one_env_fly_together_and_keep_their_own_numbers() -> None:
    cells = [cell for cell in cells_of(CONFIG)[0] if cell.row in (NOMINAL, "rotor", "wind")]
    jobs = jobs_of("geometric", cells, 30)
    assert [len(job.cells) for job in jobs] == [4, 3]
    flown = fly(jobs, WorkersConfig(jobs=1), lambda *_: None)
    assert len(flown) == 30 * len(cells)
    assert flown.groupby(["row", "size"])["seed"].nunique().eq(30).all()
    table = table_of(flown, cells).set_index(["row", "size"])
    assert list(table["flights"]) == [30] * len(cells)
    errors = table.loc["rotor", "median"]
    assert errors[10] < errors[20] < errors[30]
    again = fly(jobs[:1], WorkersConfig(jobs=1), lambda *_: None)
    pd.testing.assert_frame_equal(again, flown.head(len(again)))


def test_cells_that_draw_nothing_fly_apart_from_their_like() -> None:
    plain = [Cell(row=row, size=1.0, config=CONFIG, drawn={}) for row in (NOMINAL, "wind")]
    drawn = Cell(row="rotor", size=10, config=CONFIG, drawn={"thrust_1": 0.9})
    jobs = jobs_of("geometric", [*plain, drawn], 3)
    assert [[cell.row for cell in job.cells] for job in jobs] == [[NOMINAL, "rotor"], ["wind"]]
    flown = fly(jobs, WorkersConfig(jobs=1), lambda *_: None)
    assert flown["row"].value_counts().to_dict() == {NOMINAL: 3, "rotor": 3, "wind": 3}
    paper, refused = cells_of(CONFIG.changed(vehicle=None))
    assert "expected sensors.gyro_noise in the vehicle's file, which imu needs" in refused["imu"]
    assert len(jobs_of("geometric", paper, 3)) < len(paper)


def test_a_cell_has_wilson_s_interval_and_the_errors_of_whole_flights() -> None:
    cell = Cell(row=NOMINAL, size=0.0, config=CONFIG, drawn={})
    flown = pd.DataFrame({"crashed": [True] + [False] * 9, "steady": [9.0, *range(1, 10)]})
    flown = flown.assign(pilot="p", row=NOMINAL, size=0.0)
    line = table_of(flown, [cell]).iloc[0]
    assert (line["flights"], line["crashes"], line["median"]) == (10, 1, 5.0)
    # Wilson's interval of 1 of 10: (0.0179, 0.4042).
    assert line["low"] == pytest.approx(0.0179, abs=1e-4)
    assert line["high"] == pytest.approx(0.4042, abs=1e-4)


def test_the_command_writes_table_figure_and_flights(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = {name: PERTURBATIONS[name] for name in ("rotor", "curve")}
    monkeypatch.setattr(robustness, "PERTURBATIONS", few)
    out = tmp_path / "a folder"
    words = ["evaluate", "geometric", "--env", "rotorgram/Hover-v0", "--vehicle", "hummingbird"]
    words += ["--episode-length", "50", "--robustness", "--episodes", "8", "--jobs", "1"]
    assert main([*words, "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "one rotor weaker 30 %" in text
    assert "not beside: pid: pid: expected the env rotorgram/Elevation-v0" in text
    assert "not flown: thrust by the curve: vehicle: expected rotors.curve" in text
    content = json.loads((out / "robustness.json").read_text())
    flights = pd.read_csv(out / "flights.csv.gz")
    for cell in content["cells"]:
        same = [flights[name] == cell[name] for name in ("pilot", "row", "size")]
        own = flights[np.logical_and.reduce(same)]
        assert (len(own), own["crashed"].sum()) == (cell["flights"], cell["crashes"])
    assert (out / "robustness.png").stat().st_size > 10_000
    assert main([*words, "--out", str(out)]) == 1
    assert "out: expected a new folder" in capsys.readouterr().err
    assert main([*words, "--record", "a.mcap"]) == 1
    assert "robustness: expected flights in this process, got --record" in capsys.readouterr().err
    assert main(["evaluate", "pid", "--out", str(out)]) == 1
    assert "out, jobs: expected them with --robustness" in capsys.readouterr().err


def test_a_task_of_one_s_own_flies_in_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where a package of a controller is missing, the others fly."""
    (tmp_path / "mine.py").write_text(
        "from rotorgram.envs import register\n"
        "from rotorgram.envs.tasks.hover import Hover\n\n\n"
        "class Mine(Hover):\n"
        "    episode_length = 40\n\n\n"
        'register("my/Mine-v0", Mine)\n'
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(sys.modules, "foundation_policy", None)
    few = {name: PERTURBATIONS[name] for name in ("rotor", "lag")}
    monkeypatch.setattr(robustness, "PERTURBATIONS", few)
    words = ["evaluate", "geometric", "--env", "mine:my/Mine-v0", "--vehicle", "hummingbird"]
    words += ["--robustness", "--episodes", "4", "--jobs", "2", "--out", "table"]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "pip install 'rotorgram[raptor]'" in text
    flights = pd.read_csv(tmp_path / "table" / "flights.csv.gz")
    assert len(flights) == 4 * (1 + 3 + 3 + 3)
    assert set(flights["pilot"]) == {"geometric"}
