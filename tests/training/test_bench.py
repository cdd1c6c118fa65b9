"""`rotorgram bench`: every layer is measured, and ratios are those of the same round."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rotorgram.cli import main
from rotorgram.training.bench import (
    RATIOS,
    Layer,
    Ratio,
    bench,
    one_core,
)


def layer(name: str, *rates: float) -> Layer:
    return Layer(name=name, about="", drones=1, rates=rates)


def test_ratios_are_medians_over_rounds() -> None:
    # The machine was half as fast in the second round: both layers were.
    layers = [layer("a", 30.0, 10.0, 50.0), layer("b", 10.0, 5.0, 10.0)]
    ratio = Ratio(name="a ÷ b", of=lambda rates: rates["a"] / rates["b"], target="≥ 2.5")
    assert ratio.value(layers) == 3.0
    assert layers[0].rate == 30.0


def test_a_step_is_compared_with_its_env_and_an_echo() -> None:  # fault 68
    # 100 µs of a step, 20 µs of the env and 30 µs of echo.
    rates = {"UDP, 1": 10_000.0, "env": 50_000.0, "UDP echo": 1e6 / 30}
    assert RATIOS[0].of(rates) == pytest.approx(2.0)
    assert RATIOS[0].target == "≤ 1.6"


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity of processes here")
def test_the_echo_shares_the_core_of_its_client() -> None:  # fault 68
    before = os.sched_getaffinity(0)
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        with one_core(process.pid):
            assert os.sched_getaffinity(0) == os.sched_getaffinity(process.pid)
            assert len(os.sched_getaffinity(0)) == 1
        assert os.sched_getaffinity(0) == before
        process.communicate(b"\n")


def test_every_layer_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "bench"
    assert main(["bench", "--rounds", "1", "--seconds", "0.01", "--out", str(folder)]) == 0
    written = json.loads((folder / "bench.json").read_text())
    layers = [Layer(**{**one, "rates": tuple(one["rates"])}) for one in written["layers"]]
    assert written["medians"] == {one.name: one.rate for one in layers}
    for ratio in RATIOS:
        told = written["ratios"][ratio.name]
        assert told["target"] == ratio.target
        assert told["value"] == pytest.approx(ratio.value(layers), abs=0.001)
    assert all(one.rate > 0 and len(one.rates) == 1 for one in layers)
    said = capsys.readouterr().out
    assert all(one.name in said for one in layers)


def test_wrong_times(tmp_path: Path) -> None:
    for rounds, seconds, sentence in (
        (0, 1.0, "rounds: expected a whole number of at least 1, got 0"),
        (1, 0.0, "seconds: expected a number above 0, at most 60 s, got 0"),
    ):
        with pytest.raises(ValueError, match=sentence):
            bench(rounds, seconds, tmp_path, lambda *_: None)
