"""`rotorgram bench`: every layer is measured, and ratios are those of the same round."""

import json
from pathlib import Path

import pytest
from rotorgram.cli import main
from rotorgram.experiments.bench import RATIOS, BenchConfig, Layer, layers_of, ratio_of


def layer(name: str, *rates: float) -> Layer:
    return Layer(name=name, about="", drones=1, rates=rates)


def test_ratios_are_medians_over_rounds() -> None:
    # The machine was half as fast in the second round: both layers were.
    layers = [layer("a", 30.0, 10.0, 50.0), layer("b", 10.0, 5.0, 10.0)]
    assert ratio_of(layers, "a", "b") == 3.0
    assert layers[0].rate == 30.0


def test_every_layer_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "bench"
    assert main(["bench", "--rounds", "1", "--seconds", "0.01", "--out", str(folder)]) == 0
    written = json.loads((folder / "bench.json").read_text())
    layers = layers_of(folder)
    assert {name for pair in RATIOS for name in pair} <= {one.name for one in layers}
    assert written["medians"] == {one.name: one.rate for one in layers}
    assert set(written["ratios"]) == {f"{a} / {b}" for a, b in RATIOS}
    assert all(one.rate > 0 and len(one.rates) == 1 for one in layers)
    assert (folder / "bench.png").read_bytes()[:4] == b"\x89PNG"
    said = capsys.readouterr().out
    assert all(one.name in said for one in layers)


def test_wrong_times() -> None:
    with pytest.raises(ValueError, match="rounds: expected at least 1, got 0"):
        BenchConfig(rounds=0)
    with pytest.raises(ValueError, match="seconds: expected more than 0 and at most 60, got 0"):
        BenchConfig(seconds=0)


def test_a_folder_without_a_bench(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"bench.json: expected what rotorgram bench writes"):
        layers_of(tmp_path)
