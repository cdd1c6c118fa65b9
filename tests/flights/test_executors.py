"""Executors: results, failures, and workers that end with the main process."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
from rotorgram.flights.executors import (
    RunsFailed,
    Tell,
    WorkersConfig,
    open_executor,
    run_jobs,
)


def half(job: int, tell: Tell) -> float:
    if job % 2:
        raise ValueError(f"{job} is odd")
    tell(job, 10, "halved")
    return job / 2


def name_of_queue(job: int, tell: Tell) -> str:
    import queue

    return str(queue.__file__)


def is_killed(job: int, tell: Tell) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def reports(seconds: float, tell: Tell) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        tell(0, 1, "busy")


def silent(*_: object) -> None:
    """Progress that nobody shows, results that nobody keeps."""


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_with_their_jobs_and_progress_is_reported(jobs: int) -> None:
    shown: list[Any] = []
    kept: dict[int, float] = {}
    given = {"two": 2, "four": 4, "eight": 8}

    def on_progress(*item: Any) -> None:
        shown.append(item)

    with open_executor(WorkersConfig(jobs=jobs), len(given), on_progress) as executor:
        run_jobs(executor, half, given, kept.__setitem__, on_progress)
        deadline = time.monotonic() + 5
        while ("four", 4, 10, "halved") not in shown and time.monotonic() < deadline:
            time.sleep(0.01)
    assert kept == {2: 1.0, 4: 2.0, 8: 4.0}
    assert ("four", 4, 10, "halved") in shown
    assert {("two", 1, 1, "done"), ("all runs", 0, 3, ""), ("all runs", 3, 3, "")} <= set(shown)


def test_a_job_that_fails_is_a_sentence_and_the_others_are_kept() -> None:
    kept: dict[int, float] = {}
    sentence = pytest.raises(RunsFailed, match=r"^1 of 3 runs failed: c: ValueError: 3 is odd$")
    with open_executor(WorkersConfig(jobs=1), 3) as executor, sentence:
        run_jobs(executor, half, {"a": 2, "c": 3, "b": 4}, kept.__setitem__, silent)
    assert kept == {2: 1.0, 4: 2.0}


def test_a_worker_that_is_killed_is_one_sentence() -> None:
    sentence = pytest.raises(RunsFailed, match=r"^a worker was killed, .* before is kept$")
    with open_executor(WorkersConfig(jobs=2), 2) as executor, sentence:
        run_jobs(executor, is_killed, {"one": 1, "two": 2}, silent, silent)


def test_a_worker_that_is_killed_costs_no_result_of_others() -> None:
    class Over:
        """Each job has ended before anyone waits for it."""

        workers = 9

        def submit(self, function: Any, of: Any, name: str, job: int) -> Future[Any]:
            future: Future[Any] = Future()
            if job:
                future.set_result((name, "", job))
            else:
                future.set_exception(BrokenProcessPool("killed"))
            return future

    kept: dict[int, int] = {}
    jobs = {str(job): job for job in range(9)}
    with pytest.raises(RunsFailed, match=r"^a worker was killed"):
        run_jobs(Over(), half, jobs, kept.__setitem__, silent)  # type: ignore[arg-type]
    assert kept == {job: job for job in range(1, 9)}


def no_memory(job: int, tell: Tell) -> None:
    raise MemoryError


def test_an_error_without_words_is_named() -> None:
    sentence = pytest.raises(RunsFailed, match=r"^1 of 1 runs failed: one: MemoryError")
    with open_executor(WorkersConfig(jobs=1), 1) as executor, sentence:
        run_jobs(executor, no_memory, {"one": 1}, silent, silent)


@pytest.mark.timeout(60)
def test_a_worker_that_ends_while_it_reports_stops_nobody() -> None:
    """It ends with the lock of what it writes to."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    jobs = {"one": 2.0, "two": 600.0, "three": 600.0, "four": 600.0}
    with pytest.raises(KeyboardInterrupt), open_executor(WorkersConfig(jobs=4), 4) as executor:
        run_jobs(executor, reports, jobs, interrupt, silent)


def test_progress_that_fails_costs_no_result(caplog: pytest.LogCaptureFixture) -> None:
    kept: dict[int, float] = {}

    def fail(*_: object) -> None:
        raise ValueError("no room for a bar")

    with open_executor(WorkersConfig(jobs=2), 2, fail) as executor:
        run_jobs(executor, half, {"two": 2, "four": 4}, kept.__setitem__, silent)
        deadline = time.monotonic() + 5
        while not caplog.messages and time.monotonic() < deadline:
            time.sleep(0.01)
    assert kept == {2: 1.0, 4: 2.0}
    assert caplog.messages[:1] == ["progress is not shown: no room for a bar"]


def test_no_file_of_the_working_directory_is_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fault 51
    (tmp_path / "queue.py").write_text("raise SystemExit('foreign code')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    found: dict[int, str] = {}
    with open_executor(WorkersConfig(jobs=2), 2) as executor:
        run_jobs(executor, name_of_queue, {"one": 1, "two": 2}, found.__setitem__, silent)
    assert len(found) == 2
    assert not any(str(tmp_path) in file for file in found.values())
    assert "PYTHONSAFEPATH" not in os.environ


PARENT = """
import os, signal, sys, threading, time
sys.path.insert(0, sys.argv[1])
from test_executors import sleeps
from rotorgram.flights.executors import WorkersConfig, open_executor, run_jobs
print("ready", flush=True)
with open_executor(WorkersConfig(jobs=2), 2) as executor:
    threading.Timer(float(sys.argv[2]), os.kill, (os.getpid(), signal.SIGKILL)).start()
    run_jobs(executor, sleeps, {"one": 1, "two": 2}, print, lambda *_: None)
"""


def sleeps(job: int, tell: Tell) -> None:
    time.sleep(600)


@pytest.mark.parametrize("after", [0.05, 0.4, 6.0])
def test_no_worker_outlives_a_main_process_that_is_killed(after: float) -> None:
    """Before, while and after the workers start."""  # fault 52
    words = [sys.executable, "-c", PARENT, str(Path(__file__).parent), str(after)]
    mark = {"ROTORGRAM_TEST_MARK": f"{os.getpid()}-{after}"}
    with subprocess.Popen(words, env={**os.environ, **mark}) as process:
        process.wait(60)
    deadline = time.monotonic() + 30
    while left := _with_environment("=".join(*mark.items())):
        assert time.monotonic() < deadline, left
        time.sleep(0.1)


def _with_environment(word: str) -> list[str]:
    """Processes with a word in their environment."""
    found = []
    for file in Path("/proc").glob("[0-9]*/environ"):
        try:
            if word.encode() in file.read_bytes():
                found.append(file.parent.name)
        except OSError:
            continue
    return found
