"""`studies/bench.py`: every layer is measured; and what a step over UDP is compared with."""

import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

import pytest
from bench import LAYERS, bench
from step_over_udp import multiple, one_core


def test_a_step_is_compared_with_its_env_and_an_echo() -> None:  # fault 68
    # 100 µs of a step, 20 µs of the env and 30 µs of echo.
    assert multiple(step=100.0, env=20.0, echo=30.0) == pytest.approx(2.0)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity of processes here")
def test_the_echo_shares_the_core_of_its_client() -> None:  # fault 68
    before = os.sched_getaffinity(0)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        with one_core(process.pid):
            assert os.sched_getaffinity(0) == os.sched_getaffinity(process.pid)
            assert len(os.sched_getaffinity(0)) == 1
        assert os.sched_getaffinity(0) == before
        process.communicate(b"\n")


def test_every_layer_is_measured(tmp_path: Path) -> None:
    script = Path(__file__).parents[2] / "studies" / "bench.py"
    words = [sys.executable, script, "--rounds", "3", "--seconds", "0.01", "--out", tmp_path]
    ran = subprocess.run(words, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    shown = ran.stdout
    written = json.loads((tmp_path / "bench.json").read_text())
    names = [layer.name for layer in LAYERS]
    assert list(written["rates"]) == names
    for name, rates in written["rates"].items():
        assert len(rates) == 3
        assert min(rates) > 0
        assert written["medians"][name] == statistics.median(rates)
    assert all(name in shown for name in names)
    assert f"{written['policy_seconds']:.2f} s of one core" in shown


def test_wrong_times() -> None:
    for rounds, seconds, sentence in (
        (0, 1.0, "rounds: expected a whole number of at least 1, got 0"),
        (1, 0.0, "seconds: expected a number above 0, at most 60 s, got 0"),
    ):
        with pytest.raises(ValueError, match=sentence):
            bench(LAYERS, rounds, seconds)
