"""The policy that we ship: it flies craft that no training saw."""

from pathlib import Path

import numpy as np
import pytest
from rotorgram.agents import load
from rotorgram.cli import main
from rotorgram.cli._env import UNIVERSAL, checkpoint_file
from rotorgram.envs import LocalVectorEnv
from rotorgram.flights.crowd import Columns, fly_crowd
from rotorgram.models import InputError
from rotorgram.models.library import vehicle_names

HOVER = "rotorgram/Hover-v0"
RECOVERY = "rotorgram/Recovery-v0"
OPTIONS = {"action": "wrench", "frame": "body", "backend": "rigid"}


def flights(env_id: str, vehicle: str, count: int, **options: object) -> Columns:
    """Of the policy, in a batch of episodes."""
    env = LocalVectorEnv(
        env_id, count, autoreset_mode="Disabled", vehicle=vehicle, **OPTIONS, **options
    )
    policy = load(UNIVERSAL).policy(env.env_spec)
    return fly_crowd(env, policy, range(count))


@pytest.mark.parametrize("effects", [{}, {"motor_lag": True}], ids=["ideal", "lag"])
def test_it_hovers_with_craft_that_it_never_saw(effects: dict[str, bool]) -> None:
    flown = flights(HOVER, "drawn:300000-300999", 500, effects=effects)
    assert flown["terminated"].mean() <= 0.01
    assert np.median(flown["steady"]) < 0.03


def test_it_recovers_from_throws() -> None:
    flown = flights(RECOVERY, "drawn:300000-300999", 500, effects={"motor_lag": True}, heading=0.0)
    assert flown["terminated"].mean() <= 0.02
    assert flown["last"].mean() >= 0.97  # recovered at the end


@pytest.mark.parametrize("vehicle", vehicle_names())
def test_it_flies_the_library(vehicle: str) -> None:
    flown = flights(HOVER, vehicle, 100)
    assert not flown["terminated"].any()
    assert np.median(flown["steady"]) < 0.03


def test_it_flies_a_file_of_one_s_own_by_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "my.toml"
    assert main(["vehicle", "new", str(file)]) == 0
    assert main(["evaluate", "universal", "--vehicle", str(file), "--episodes", "2"]) == 0
    assert "2, 0 terminated" in capsys.readouterr().out


def test_it_refuses_numbers_that_mean_something_else() -> None:
    for options, sentence in (
        ({"frame": "world"}, "expected observation with the frame 'body', on which it was trained"),
        ({"frame": "body", "action": "rates"}, "expected action with the components ..lift.*, got"),
    ):
        given = {"action": "wrench", **options}
        env = LocalVectorEnv(HOVER, 1, autoreset_mode="Disabled", vehicle="hummingbird", **given)
        with pytest.raises(InputError, match=sentence):
            load(UNIVERSAL).policy(env.env_spec)


def test_a_folder_of_that_name_is_the_user_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert checkpoint_file("universal") == UNIVERSAL
    Path("universal").mkdir()
    assert checkpoint_file("universal") == Path("universal", "checkpoint.safetensors")
