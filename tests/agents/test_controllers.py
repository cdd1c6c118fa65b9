"""Controllers of a user's own, in files: named on the command line and in the rows of a study."""

from pathlib import Path

import pytest
from commands import Capsys, output, refused
from rotorgram.agents import CONTROLLERS, PID, find_controller, is_controller
from rotorgram.flights.palette import agent_color, agent_label
from rotorgram.models import InputError
from rotorgram.training.settings import Row
from rotorgram.training.tables import row_label

STILL = """
import numpy as np

class Still:
    options = {"action": "offset"}

    def __init__(self, spec):
        self.size = spec.action.size

    def reset(self):
        pass

    def act(self, observation):
        return np.zeros(self.size, np.float32)

class Half:
    options = {}

    def reset(self):
        pass

Number = 3
"""


@pytest.fixture
def still(tmp_path: Path) -> str:
    path = tmp_path / "still.py"
    path.write_text(STILL)
    return f"{path}:Still"


def test_names_and_files() -> None:
    assert find_controller("pid") is PID
    assert is_controller("pid")
    assert is_controller("my/still.py:Still")
    assert not is_controller("ppo")
    assert not is_controller("runs/still")


def test_a_file_is_run_once(still: str) -> None:
    assert find_controller(still) is find_controller(still)
    assert still not in CONTROLLERS
    assert agent_label(still) == "Still"
    assert agent_color(still) == agent_color("pid")


def test_it_flies_with_its_options(still: str, capsys: Capsys) -> None:
    shown = output(capsys, "evaluate", still, "--episodes", 2)
    assert f"policy     {still} on rotorgram/Elevation-v0\nepisodes   2, 0 terminated" in shown
    words = ("--action", "increment", "--episode-length", 5, "--episodes", 1)
    assert "episodes   1, 0 terminated" in output(capsys, "evaluate", still, *words)


def test_a_row_of_a_study(still: str) -> None:
    row = Row(agent=still)
    assert row.name == "still Elevation-v0"
    assert row.env.flat_options()["action"] == "offset"
    assert row.controller
    assert row_label(row) == "Still"
    table = row.to_dict()
    Path(still.rpartition(":")[0]).write_text("raise RuntimeError")
    stored = Row.from_dict("row", {**table, "agent": "elsewhere.py:Still"})  # nothing is run
    assert stored.env == row.env


@pytest.mark.parametrize(
    ("text", "name", "sentence"),
    [
        (STILL, "Moves", "expected a class of {file}, got 'Moves'"),
        (STILL, "Number", "expected a class of {file}, got 'Number'"),
        (STILL, "Half", "expected a class with options, reset, act, got {file}:Half "
                        "without act"),
        ("a = 1\nb = a / 0\n", "Still", "wrong.py fails: ZeroDivisionError: division by zero, "
                                        "line 2"),
        ("class Still\n", "Still", "wrong.py fails: SyntaxError: expected ':' (wrong.py, line 1)"),
        ("import nowhere_at_all\n", "Still", "wrong.py fails: ModuleNotFoundError: No module named "
                                             "'nowhere_at_all', line 1"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file(text: str, name: str, sentence: str, tmp_path: Path) -> None:
    file = tmp_path / "wrong.py"
    file.write_text(text)
    with pytest.raises(InputError) as error:
        find_controller(f"{file}:{name}")
    assert str(error.value) == "controller: " + sentence.format(file=file)


def test_wrong_names(tmp_path: Path, capsys: Capsys) -> None:
    told = refused(capsys, "evaluate", "nowhere.py:Still")
    nowhere = Path("nowhere.py").absolute()
    assert told == f"rotorgram: controller: expected a file of Python, got none: {nowhere}\n"
    assert "controller: expected FILE.py:CLASS, got still.py" in refused(
        capsys, "evaluate", "still.py"
    )
    told = refused(capsys, "evaluate", "nobody")
    assert "expected universal, pid, geometric, raptor, FILE.py:CLASS of a controller" in told
    with pytest.raises(InputError, match="agent: expected one of pid, geometric, raptor, vpg, a2c"):
        Row(agent="nobody")
