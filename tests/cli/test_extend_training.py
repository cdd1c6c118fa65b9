"""A training that is finished goes on to more env steps."""  # fault 60

import json
from pathlib import Path

import pytest
from rotorgram.agents import load
from rotorgram.cli import main

SETTINGS = ["--preset", "paper", "--set", "steps_per_update=64", "--episode-length", "50"]


def test_an_extended_training_is_one_of_as_many_env_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = tmp_path / "first"
    whole = tmp_path / "whole"
    assert main(["train", "a2c", *SETTINGS, "--env-steps", "640", "--out", str(first)]) == 0
    assert main(["train", "a2c", *SETTINGS, "--env-steps", "1280", "--out", str(whole)]) == 0
    assert main(["train", "a2c", "--resume", str(first), "--env-steps", "500"]) == 1
    assert "env_steps: expected 640 or more" in capsys.readouterr().err
    assert main(["train", "a2c", "--resume", str(first), "--env-steps", "1280"]) == 0
    assert "trained 1,280 of 1,280 env steps" in capsys.readouterr().out
    actor, other = (load(path / "checkpoint.safetensors").actor for path in (first, whole))
    assert {k: v.tobytes() for k, v in actor.items()} == {k: v.tobytes() for k, v in other.items()}
    assert json.loads((first / "config.json").read_text())["env_steps"] == 1280
