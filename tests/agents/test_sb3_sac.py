"""SB3's SAC: its settings, its actions and what it logs."""

import re
from pathlib import Path
from typing import Any

import pytest
from drones import OPTIONS, vector
from rotorgram.agents import EpisodeRecorder, SACConfig, make_agent, preset
from rotorgram.models.errors import InputError
from scripted import CALM, Scripted, log_of

PAGE = Path(__file__).parents[2] / "docs" / "algorithms" / "sb3-sac.md"


def test_choices_are_refused() -> None:
    log = log_of(Scripted(CALM, discrete=True))
    with pytest.raises(InputError, match="expected an env of continuous actions, got one of"):
        make_agent("sb3-sac", log, SACConfig(), 0)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"tau": 0.0}, "tau: expected a number above 0, at most 1, got 0.0"),
        ({"gradient_steps": 0}, "gradient_steps: expected a whole number of at least 1, got 0"),
        ({"target_entropy": "auto"}, "target_entropy: expected a number, or none"),
        ({"buffer_size": 50}, "buffer_size: expected learning_starts (1000) or more, got 50"),
    ],
)
def test_wrong_settings_are_one_sentence(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        SACConfig(**changes)
    assert str(caught.value).startswith(sentence)


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
