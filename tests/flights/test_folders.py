"""Folders of runs: two processes never share one, and a crash releases its lock."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rotorgram.flights import folders
from rotorgram.flights.folders import locked, new_folder

HOLD = """
import sys, time
from pathlib import Path
from rotorgram.flights.folders import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_of_two_that_want_one_folder_one_gets_it(tmp_path: Path) -> None:
    assert new_folder(tmp_path / "a" / "out", "compare").is_dir()
    with pytest.raises(ValueError, match=r"out: expected a new folder, .*out exists already"):
        new_folder(tmp_path / "a" / "out", "compare")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"out: cannot make .*file: File exists"):
        new_folder(tmp_path / "file" / "out", "compare")


def test_two_of_the_same_second_get_two_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Still(folders.datetime):
        @classmethod
        def now(cls, tz: object = None) -> "Still":
            return cls(2026, 1, 2, 3, 4, 5)

    monkeypatch.setattr(folders, "datetime", Still)
    monkeypatch.chdir(tmp_path)
    made = [new_folder(None, "train-a2c") for _ in range(3)]
    names = ["train-a2c-20260102-030405", "train-a2c-20260102-030405-2"]
    assert [folder.name for folder in made[:2]] == names
    assert len(set(made)) == 3


def test_a_folder_is_written_by_one_process_and_a_crash_releases_it(tmp_path: Path) -> None:
    words = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        busy = pytest.raises(ValueError, match="expected a folder that no other process writes to")
        with busy, locked(tmp_path):
            pass
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    with locked(tmp_path):
        pass
    with locked(tmp_path):  # and again, after an orderly end
        pass
