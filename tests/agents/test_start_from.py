"""Curricula: a training that begins with the networks of another."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rotorgram.agents import Checkpoint, load, preset, store
from rotorgram.cli import main
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.models.errors import InputError
from rotorgram.training.settings import Run
from rotorgram.training.training import Training

SHORT = {"episode_length": 30, "start_band": 0.3, "flight_band": 0.4}
OURS = "vpg, a2c, ppo, ippo, mappo"
WINDY = {**SHORT, "effects": {"linear_drag": 0.5}}
SMALL: dict[str, dict[str, Any]] = {
    "vpg": {"episodes_per_update": 4},
    "a2c": {"steps_per_update": 40},
    "ppo": {"steps_per_update": 40, "epochs": 2, "minibatches": 2},
    "sb3-ppo": {"steps_per_update": 40, "epochs": 2, "minibatches": 2},
}


def training_of(
    algorithm: str,
    options: Any = WINDY,
    start: Checkpoint | None = None,
    env_id: str = "rotorgram/Elevation-v0",
    **changes: Any,
) -> Training:
    config = preset(algorithm, "tuned", **{**SMALL[algorithm], **changes})
    run = Run(algorithm=algorithm, config=config, seed=4, env_steps=400, num_envs=4,
              env=EnvConfig.from_keywords(env_id, **options))  # fmt: skip
    env: Any = LocalVectorEnv(run.env, 4, autoreset_mode="Disabled")
    return Training(run, env, start=start)


def trained(algorithm: str, options: Any = SHORT, **changes: Any) -> Checkpoint:
    training = training_of(algorithm, options, **changes)
    training.train()
    return training.checkpoint()


def same(one: Any, other: Any) -> bool:
    return {k: v.tobytes() for k, v in one.items()} == {k: v.tobytes() for k, v in other.items()}


def layers(actor: Any) -> dict[str, np.ndarray]:
    return {name: array for name, array in actor.items() if name != "log_std"}


@pytest.mark.parametrize("algorithm", ["vpg", "a2c", "ppo"])
def test_it_begins_with_the_networks_and_with_nothing_else(algorithm: str) -> None:
    kept = trained(algorithm)
    agent, new = (training_of(algorithm, start=start).agent for start in (kept, None))
    assert same(layers(agent.actor()), layers(kept.actor))
    assert not same(layers(agent.actor()), layers(new.actor()))
    state = agent.state()
    log_std = agent.actor()["log_std"]  # the noise is that of the preset
    assert log_std == (0.0 if algorithm == "ppo" else -0.5)
    assert kept.actor["log_std"] != log_std
    if algorithm != "vpg":
        critic = agent.weights.part("critic.").values  # type: ignore[union-attr]
        assert critic.tobytes() == kept.state["weights"][-critic.size :].tobytes()
    assert state["optimizer.steps"] == 0
    assert not state["optimizer.first"].any()


def test_the_policy_of_vpg_starts_ppo_whose_critic_is_new() -> None:
    kept = trained("vpg")
    agent, new = (training_of("ppo", start=start).agent for start in (kept, None))
    assert same(layers(agent.actor()), layers(kept.actor))
    critics = [one.weights.part("critic.").values for one in (agent, new)]  # type: ignore[union-attr]
    assert critics[0].tobytes() == critics[1].tobytes()


def test_the_normalisation_goes_on_where_it_was() -> None:
    kept = trained("ppo", normalize_observations=True)
    training = training_of("ppo", start=kept, normalize_observations=True)
    assert same(layers(training.agent.actor()), layers(kept.actor))
    assert np.abs(kept.actor["observation.mean"]).max() > 0
    training.train()
    counts = kept.state["observations.count"], training.agent.state()["observations.count"]
    first = kept.position.env_steps
    second = training.log.env_steps
    assert counts == (first, first + second)


def test_a_second_stage_that_was_stopped_ends_as_if_it_had_not(tmp_path: Path) -> None:
    kept = trained("ppo")
    unbroken = training_of("ppo", start=kept)
    stopped = training_of("ppo", start=kept)
    unbroken.train()
    assert not stopped.train(lambda: False)
    store(stopped.checkpoint(), tmp_path / "stage")
    resumed = Training.resume(load(tmp_path / "stage"), stopped.env)
    assert resumed.train()
    assert same(resumed.agent.state(), unbroken.agent.state())


def test_what_does_not_fit_is_one_sentence() -> None:
    kept = trained("ppo")
    sb3 = replace(kept, algorithm="sb3-ppo")
    rates, attitude = ({"action": level} for level in ("rates", "attitude"))
    hover = "rotorgram/Hover-v0"
    for changes, sentence in (
        ({"algorithm": "sb3-ppo"}, f"start-from: expected a training of {OURS}, got sb3-ppo"),
        ({"start": kept.policy_alone()}, "start-from: expected the checkpoint of a training, got"),
        ({"start": sb3}, f"start-from: expected a training of {OURS}, got sb3-ppo"),
        ({"hidden": (8,)}, r"hidden: expected \(16,\) of the training to start from, got \(8,\)"),
        (
            {"options": {**SHORT, "observation": "error"}},
            "start-from: expected observation 'rate of the error' of rotorgram/Elevation-v0, got",
        ),
        (
            {"start": trained("ppo", rates, env_id=hover), "options": attitude, "env_id": hover},
            "start-from: expected action 'roll rate' of rotorgram/Hover-v0, got action 'roll'",
        ),
        ({"start": replace(kept, state={})}, "checkpoint: its parts do not fit together"),
    ):
        with pytest.raises(InputError, match=sentence):
            training_of(**{"algorithm": "ppo", "start": kept, **changes})


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
