"""Curricula: a training that begins with the networks of another."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drones import cases
from rotorgram.agents import Checkpoint, load, preset
from rotorgram.cli import main
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.models.errors import InputError
from rotorgram.training.settings import Run
from rotorgram.training.training import Training

SHORT = {"episode_length": 30, "start_band": 0.3, "flight_band": 0.4}
HOVER = "rotorgram/Hover-v0"
OURS = "vpg, a2c, ppo, ippo, mappo"
WINDY = {**SHORT, "effects": {"linear_drag": 0.5}}
SMALL: dict[str, dict[str, Any]] = {
    "vpg": {"episodes_per_update": 4},
    "a2c": {"steps_per_update": 40},
    "ppo": {"steps_per_update": 40, "epochs": 2, "minibatches": 2},
}
SMALL["sb3-ppo"] = SMALL["ppo"]


def training_of(
    algorithm: str,
    options: Any = WINDY,
    start: Checkpoint | None = None,
    env_id: str = "rotorgram/Elevation-v0",
    **changes: Any,
) -> Training:
    config = preset(algorithm, "tuned", **{**SMALL[algorithm], **changes})
    env_config = EnvConfig.from_keywords(env_id, **options)
    sizes = {"env_steps": 400, "num_envs": 4}
    run = Run(algorithm=algorithm, config=config, seed=4, env=env_config, **sizes)
    env: Any = LocalVectorEnv(run.env, 4, autoreset_mode="Disabled")
    return Training(run, env, start=start)


def trained(algorithm: str, options: Any = SHORT, **changes: Any) -> Checkpoint:
    training = training_of(algorithm, options, **changes)
    training.train()
    return training.checkpoint()


def layers(actor: Any) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in actor.items() if name != "log_std"}


@pytest.mark.parametrize("algorithm", ["vpg", "a2c", "ppo"])
def test_it_begins_with_the_networks_and_with_nothing_else(algorithm: str) -> None:
    kept = trained(algorithm)
    agent: Any = training_of(algorithm, start=kept).agent
    new = training_of(algorithm).agent
    actor = agent.actor()
    assert layers(actor) == layers(kept.actor)
    assert layers(actor) != layers(new.actor())
    log_std = actor["log_std"]  # the noise is that of the preset
    assert log_std == (0.0 if algorithm == "ppo" else -0.5)
    assert log_std != kept.actor["log_std"]
    if algorithm != "vpg":
        critic = agent.weights.part("critic.").values
        assert critic.tobytes() == kept.state["weights"][-critic.size :].tobytes()
    state = agent.state()
    assert state["optimizer.steps"] == 0
    assert not state["optimizer.first"].any()


def test_the_policy_of_vpg_starts_ppo_whose_critic_is_new() -> None:
    kept = trained("vpg")
    agent: Any = training_of("ppo", start=kept).agent
    new: Any = training_of("ppo").agent
    assert layers(agent.actor()) == layers(kept.actor)
    critics = [one.weights.part("critic.").values for one in (agent, new)]
    assert critics[0].tobytes() == critics[1].tobytes()


def test_the_normalisation_goes_on_where_it_was() -> None:
    kept = trained("ppo", normalize_observations=True)
    training = training_of("ppo", start=kept, normalize_observations=True)
    assert layers(training.agent.actor()) == layers(kept.actor)
    assert np.abs(kept.actor["observation.mean"]).max() > 0
    training.train()
    counts = kept.state["observations.count"], training.agent.state()["observations.count"]
    first = kept.position.env_steps
    second = training.log.env_steps
    assert counts == (first, first + second)


@pytest.fixture(scope="module")
def kept() -> Checkpoint:
    return trained("ppo")


def test_a_second_stage_that_was_stopped_ends_as_if_it_had_not(kept: Checkpoint) -> None:
    unbroken = training_of("ppo", start=kept)
    stopped = training_of("ppo", start=kept)
    assert unbroken.train()
    assert not stopped.train(lambda: False)
    resumed = Training.resume(stopped.checkpoint(), stopped.env)
    assert resumed.train()
    expected = unbroken.agent.state()
    for name, array in resumed.agent.state().items():
        assert array.tobytes() == expected[name].tobytes(), name


@pytest.mark.parametrize("case", cases("wrong_starts"), ids=str)
def test_a_training_that_does_not_fit_is_refused(case: Any, kept: Checkpoint) -> None:
    arguments = {"algorithm": "ppo", "start": kept, **case["changes"]}
    with pytest.raises(InputError) as told:
        training_of(**arguments)
    assert str(told.value).startswith(case["sentence"])


def test_other_actions_are_refused() -> None:
    kept = trained("ppo", {"action": "rates"}, env_id=HOVER)
    sentence = "start-from: expected action 'roll rate' of rotorgram/Hover-v0, got action 'roll'"
    with pytest.raises(InputError, match=sentence):
        training_of("ppo", {"action": "attitude"}, kept, HOVER)


def test_a_checkpoint_that_does_not_fit_is_refused(kept: Checkpoint) -> None:
    sb3 = replace(kept, algorithm="sb3-ppo")
    for start, sentence in (
        (sb3, f"start-from: expected a training of {OURS}, got sb3-ppo"),
        (kept.policy_alone(), "start-from: expected the checkpoint of a training, got a policy"),
        (replace(kept, state={}), "checkpoint: its parts do not fit together"),
    ):
        with pytest.raises(InputError, match=sentence):
            training_of("ppo", start=start)


def test_a_curriculum_is_a_chain_of_trainings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = str(tmp_path / "first")
    second = str(tmp_path / "second")
    words = ["train", "a2c", "--env-steps", "300", "--set", "steps_per_update=100"]
    assert main([*words, "hidden=[8]", "--out", first]) == 0
    harder = ["--effects", "linear_drag=0.5", "--start-from", first, "--out", second]
    assert main([*words, *harder]) == 0
    stages = [load(tmp_path / name / "checkpoint.safetensors") for name in ("first", "second")]
    assert [stage.config["hidden"] for stage in stages] == [[8], [8]]
    assert stages[1].options["effects"] == {"linear_drag": 0.5}
    config = json.loads((tmp_path / "second" / "config.json").read_text())
    assert config["start_from"]["file"] == f"{first}/checkpoint.safetensors"
    assert main(["train", "a2c", "--resume", second, "--start-from", first]) == 1
    assert "got others by --start-from" in capsys.readouterr().err
