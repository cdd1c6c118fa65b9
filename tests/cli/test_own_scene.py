"""A scene of the user's own: commands know it where `--env` names its module."""

import sys
from pathlib import Path

import pytest
from commands import Capsys, output, refused
from rotorgram.scenes.registry import SCENES

MODULE = """
from rotorgram.scenes import Draft, SceneType, register

LOOKS = {"grass": {"colours": [[0.3, 0.5, 0.2]]}}


def lone(draft: Draft) -> None:
    draft.add("ground/floor", "plane", (60, 60, 1), (0, 0, 0), "grass")
    x, y = draft.around(0.2, 20.0)
    draft.add("post_0/pole", "cylinder", (0.2, 3, 0), (x, y, 3), "grass")


register("lone", SceneType(draw=lone, materials=LOOKS))
"""
OWN = ("--env", "lone_scene:rotorgram/Hover-v0")


def forget() -> None:
    SCENES.pop("lone", None)
    sys.modules.pop("lone_scene", None)


def test_policies_and_journals_in_a_scene_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    (tmp_path / "lone_scene.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    settings = ("--scene", "lone:new", "--episode-length", 10, "--backend", "rigid")
    steps = ("--env-steps", 64, "--num-envs", 2, "--set", "steps_per_update=32")
    try:
        output(capsys, "train", "a2c", *OWN, *settings, *steps, "--out", "run")
        output(capsys, "evaluate", "run", *OWN, "--episodes", 1, "--record", "flown.mcap")
        for words, written in (
            (("export", "run", "--to", "c"), "rotorgram_policy.h"),
            (("plot", "flown.mcap", "--plan"), "flown.png"),
        ):
            forget()
            assert "got 'lone'" in refused(capsys, *words)
            assert not Path(written).exists()
            output(capsys, *words, *OWN)
            assert Path(written).stat().st_size > 1000
        forget()
        told = output(capsys, "replay", "flown.mcap", "--verify", *OWN)
        assert "States in 1 session" in told.rpartition("identical: ")[2]
    finally:
        forget()
