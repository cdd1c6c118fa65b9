"""SB3's SAC: its settings, its actions and what it logs."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from drones import OPTIONS, vector
from rotorgram.agents import EpisodeRecorder, make_agent, preset
from rotorgram.agents.config import SACConfig
from rotorgram.envs.spec import ArraySpec
from rotorgram.models.errors import InputError
from scripted import CALM, Scripted, log_of

PAGE = Path(__file__).parents[2] / "docs" / "algorithms" / "sb3-sac.md"


def test_choices_are_refused() -> None:
    log = log_of(Scripted(CALM, discrete=True))
    with pytest.raises(InputError, match="expected an env of continuous actions, got one of"):
        make_agent("sb3-sac", log, SACConfig(), 0)


@pytest.mark.parametrize(
    "array",
    [
        ArraySpec(name="tof", shape=(1, 5), low=0.0, high=4.0, unit="m"),
        ArraySpec(name="front", shape=(8, 8, 3), dtype="uint8", low=0.0, high=255.0),
    ],
)
def test_what_only_our_own_agents_scale_is_refused(array: ArraySpec) -> None:
    log = log_of(Scripted(CALM))
    log.spec = replace(log.spec, observation=(array,))
    with pytest.raises(InputError, match=r"^sb3: expected observations without distances of rays"):
        make_agent("sb3-sac", log, SACConfig(), 0)


def test_what_is_logged_is_on_the_page() -> None:
    rows = re.findall(r"^\| `(train/\w+)`", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    log = EpisodeRecorder(vector(2, **OPTIONS), 5)
    config = preset("sb3-sac", "tuned", hidden=(8, 7), batch_size=16, learning_starts=40)
    agent = make_agent("sb3-sac", log, config, 0)
    assert agent.scalars() == {}
    agent.train(log, 48, lambda: True)
    scalars = agent.scalars()
    assert scalars.keys() == set(rows)
    assert scalars["train/n_updates"] >= 1
    assert scalars["train/ent_coef"] == pytest.approx(0.1, rel=0.05)
