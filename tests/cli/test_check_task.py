"""`rotorgram check-task`: what it finds in tasks that are wrong, and that a right one compiles."""

import re
from pathlib import Path

import pytest
from commands import Capsys, output, refused, run

LANDING = Path(__file__).parents[2] / "examples" / "landing.py"
HEAD = """import numpy as np
from rotorgram.envs.tasks import Hover

class Mine(Hover):
    def outcome(self, state):
        outcome = super().outcome(state)
        height = state.position[..., 2]
        outcome.reward["more"] = 0.0 * height
"""
WRONG = {
    "        if height[0, 0] > 1.0: pass": r"not compiled, .*np.where\(\) \(`outcome`, line 9\)",
    '        outcome.reward["more"] = np.sin(height)': (
        r"compiled code and NumPy differ in reward of step \d+, .*: take sin, exp, .*\*\*, "
    ),
    '        outcome.reward["more"] = (height - 5.0) ** 3': (
        r"compiled code and NumPy differ in reward of step \d+, .*: take sin, exp, .*\*\*, "
    ),
    '        outcome.reward["more"] = height + np.random.normal()': (
        r"two flights of one seed differ in reward .*random numbers from `draw` alone"
    ),
    '        outcome.reward["more"] = height + np.inf': "expected finite numbers for reward, got ",
    '        outcome.metrics["more"] = self.nothing': r"AttributeError: .*\(`outcome`, line 9\)",
}


@pytest.mark.parametrize("line", WRONG)
def test_a_fault_is_one_sentence(line: str, tmp_path: Path, capsys: Capsys) -> None:
    file = tmp_path / "mine.py"
    file.write_text(f"{HEAD}{line}\n        return outcome\n")
    status, out, err = run(capsys, "check-task", f"{file}:Mine")
    assert (status, err) == (1, "")
    assert re.fullmatch(f"Mine-v0: .*{WRONG[line]}.*\n", out), out


def test_observations_and_their_bounds(tmp_path: Path, capsys: Capsys) -> None:
    file = tmp_path / "mine.py"
    observe = '        return {"observation": 1e6 + super().observe(state)["observation"]}'
    file.write_text(f"{HEAD}        return outcome\n\n    def observe(self, state):\n{observe}\n")
    status, out, _ = run(capsys, "check-task", f"{file}:Mine")
    assert status == 1
    expected = "Mine-v0: observation: expected numbers within the bounds of its spec, got 1e+06 "
    assert out.startswith(expected)


@pytest.mark.parametrize(
    "task", [f"{LANDING}:Landing", "rotorgram/Elevation-v0", "rotorgram/Crossing-v0"]
)
def test_a_right_task(task: str, capsys: Capsys) -> None:
    assert "-v0: compiled; 8 worlds flew 50 steps" in output(capsys, "check-task", task)


def test_what_is_no_task(tmp_path: Path, capsys: Capsys) -> None:
    assert "expected FILE.py:CLASS, got mine.py" in refused(capsys, "check-task", "mine.py")
    assert "expected a file of Python" in refused(capsys, "check-task", "nowhere.py:Mine")
    (tmp_path / "mine.py").write_text(HEAD)
    told = refused(capsys, "check-task", f"{tmp_path / 'mine.py'}:Other")
    assert "expected a class of" in told
    (tmp_path / "other.py").write_text("class Other:\n    pass\n")
    told = refused(capsys, "check-task", f"{tmp_path / 'other.py'}:Other")
    assert "expected a class derived from Task" in told
