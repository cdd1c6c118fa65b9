"""Effects, drawn parameters and delays as options of every task: in process, in a batch, by UDP."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
import rotorgram.envs  # noqa: F401
from contracts import TABLES, rows_of, spec_with
from rotorgram.cli import main
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.memory import Memory
from rotorgram.envs.stages.actions import ActionDelay
from rotorgram.envs.stages.record import Record
from rotorgram.models.errors import InputError
from rotorgram.udp.spawn import spawn_simulator

RACER = Path(__file__).parents[1] / "data" / "racer.xml"
ELEVATION = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
WORLD: dict[str, Any] = TABLES["world options: WORLD"]


def actions(steps: int, rotors: int = 4) -> np.ndarray:
    return np.random.default_rng(5).uniform(-0.1, 0.1, (steps, rotors)).astype(np.float32)


def flight(env: Any, seed: int, steps: int = 30) -> list[np.ndarray]:
    """Observations of a reset and some steps."""
    seen = [env.reset(seed=seed)[0]]
    seen += [env.step(action)[0] for action in actions(steps)]
    env.close()
    return seen


def test_a_delay_gives_what_was_sent_so_many_steps_ago() -> None:
    neutral = np.full((3, 1, 1), -1.0)
    age = np.array([[0], [1], [2]])
    world: Any = SimpleNamespace(parameters={"action_delay": age})
    delay = ActionDelay(world, 2, neutral)
    record = Record((3, 1), Memory())
    record.kept = delay.arrays
    delay.begin(record)

    def arrived(action: float, mask: np.ndarray | None) -> list[float]:
        record.received = np.full((3, 1, 1), action)
        record.run(mask, [delay.step])
        received: list[float] = record.received[:, 0, 0].tolist()
        return received

    given = [arrived(float(step), None) for step in range(4)]
    assert given == TABLES["world options: actions that arrive"]
    arrived(9.0, np.array([[True], [False], [False]]))
    # the past of a frozen drone does not move
    sent = record.actions_sent[:, 0, :, 0]
    assert sent.tolist() == TABLES["world options: actions sent"]


@pytest.mark.parametrize("late", [1, 3])
def test_a_late_action_acts_as_one_that_was_given_later(late: int) -> None:
    given = actions(10)
    plain = gym.make(HOVER, vehicle=str(RACER))
    delayed = gym.make(HOVER, vehicle=str(RACER), randomize={"action_delay": late})
    plain.reset(seed=2)
    delayed.reset(seed=2)
    waited = [np.zeros(4, np.float32)] * late + list(given)
    for now, then in zip(given, waited, strict=False):
        ours = delayed.step(now)
        theirs = plain.step(then)
        assert (ours[0] == theirs[0]).all()
        assert ours[1] == theirs[1]


def test_a_late_action_is_held_where_it_is_one_of_choices() -> None:
    options = {"action_type": "discrete", "randomize": {"action_delay": 2}}
    env = gym.make(ELEVATION, **options)
    env.reset(seed=0)
    infos = [env.step(2)[4] for _ in range(4)]
    thrusts = [info["F1"] for info in infos]
    assert thrusts == [49.0, 49.0, 54.0, 59.0]


def test_a_late_observation_is_that_of_an_earlier_step() -> None:
    plain = gym.make(HOVER, vehicle=str(RACER))
    late = gym.make(HOVER, vehicle=str(RACER), randomize={"observation_delay": 2})
    expected = flight(plain, 2)
    for step, observation in enumerate(flight(late, 2)):
        earlier = expected[max(0, step - 2)]
        assert (observation == earlier).all()


def test_reward_and_end_are_never_late() -> None:
    plain = gym.make(ELEVATION, episode_length=3)
    late = gym.make(ELEVATION, episode_length=3, randomize={"observation_delay": 5})
    plain.reset(seed=1)
    late.reset(seed=1)
    action = np.ones(1, np.float32)
    for _ in range(3):
        ours = late.step(action)
        theirs = plain.step(action)
        assert ours[1:4] == theirs[1:4]


def test_over_udp_the_same_bits_and_what_was_drawn() -> None:
    here = gym.make(HOVER, vehicle=str(RACER), **WORLD)
    with spawn_simulator(EnvConfig.from_keywords(HOVER, vehicle=RACER, **WORLD)) as remote:
        ours = here.reset(seed=4)
        theirs = remote.reset(seed=4)
        assert (ours[0] == theirs[0]).all()
        for name in ("drawn_mass", "drawn_wind_y", "drawn_action_delay"):
            assert ours[1][name] == theirs[1][name]
        for action in actions(20):
            ours = here.step(action)
            theirs = remote.step(action)
            assert (ours[0] == theirs[0]).all()


def test_options_that_are_on_move_no_other_draw() -> None:
    plain = gym.make(HOVER, vehicle=str(RACER))
    changed = gym.make(HOVER, vehicle=str(RACER), **WORLD)
    _, before = plain.reset(seed=3)
    _, after = changed.reset(seed=3)
    for axis in "xyz":
        assert before[axis] == after[axis]


def test_without_them_nothing_is_told_of_them() -> None:
    spec = spec_with(HOVER)
    assert "effects" not in spec.options
    assert "randomize" not in spec.options
    assert "drawn" not in [array.name for array in spec.telemetry]
    told = spec_with(HOVER, **WORLD, vehicle=str(RACER))
    assert told.options["effects"]["wind"] == [0.5, 0.0, 0.0]
    assert told.options["randomize"]["observation_delay"] == 1
    drawn = next(array for array in told.telemetry if array.name == "drawn")
    assert drawn.components == (
        "drawn_mass", "drawn_wind_y", "drawn_action_delay", "drawn_observation_delay"
    )  # fmt: skip
    assert drawn.unit == ("", "m/s", "steps", "steps")


def test_observations_of_a_stronger_craft_stay_within_their_bounds() -> None:
    env = gym.make(ELEVATION, randomize={"thrust": 3.0}, flight_band=50.0, start_band=0.0)
    env.reset(seed=0)
    space = env.observation_space
    action = np.ones(1, np.float32)
    for _ in range(200):
        observation, _, ended, _, info = env.step(action)
        assert space.contains(observation)
        if ended:
            break
    assert info["elevation_error"] < -40  # it was fast: three times the thrust


def test_flags(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", "pid", "--episodes", "1", "--vehicle", str(RACER)]
    words += ["--episode-length", "20"]
    flags = ["--effects", "motor-lag", "wind=0.5,0,0", "body_drag"]
    assert main([*words, *flags, "--randomize", "mass=uniform(0.9,1.1)"]) == 0
    assert "episodes   1, 0 terminated" in capsys.readouterr().out
    for flag, sentence in TABLES["world options: wrong flags"]:
        assert main([*words, *flag]) != 0
        assert sentence in capsys.readouterr().err


def test_a_policy_flies_with_the_vehicle_that_has_its_effects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = ["--vehicle", str(RACER), "--effects", "motor_lag", "--out", str(tmp_path / "run")]
    assert main(["train", "a2c", "--env-steps", "256", *run]) == 0
    capsys.readouterr()
    outputs = []
    for more in ([], ["--vehicle", str(RACER)]):
        assert main(["evaluate", str(tmp_path / "run"), "--episodes", "1", *more]) == 0
        outputs.append(capsys.readouterr().out)
    returns = [re.findall("return .*", output) for output in outputs]
    assert returns[0] == returns[1] != []


def test_evaluations_of_a_comparison_tell_what_was_drawn(tmp_path: Path) -> None:
    words = ["--agents", "vpg", "--seeds", "1", "--env-steps", "1500", "--episodes", "2"]
    words += ["--jobs", "1", "--episode-length", "50", "--no-film"]
    words += ["--randomize", "mass=uniform(0.9,1.1)", "--out", str(tmp_path / "c")]
    assert main(["compare", *words]) == 0
    drawn = pd.read_parquet(tmp_path / "c" / "evaluations")["drawn_mass"]
    assert len(drawn) > 3
    assert drawn.between(0.9, 1.1).all()
    assert drawn.nunique() > 1


@rows_of("a wrong one gives one sentence", "options, sentence")
def test_a_wrong_one_gives_one_sentence(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as raised:
        gym.make(HOVER, **{"vehicle": str(RACER), **options})
    assert "\n" not in str(raised.value)
