"""Trainings: wrong ones are refused, progress and resuming."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drones import OPTIONS, cases, vector
from rotorgram.agents import ResumeError, load, preset, store
from rotorgram.agents.checkpoints import CheckpointError
from rotorgram.cli import main
from rotorgram.envs.config import BackendConfig, EnvConfig
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.models.errors import InputError
from rotorgram.training.settings import Run
from rotorgram.training.training import Training

SMALL: dict[str, dict[str, int]] = {
    "vpg": {"episodes_per_update": 4},
    "a2c": {"steps_per_update": 70},
    "ppo": {"steps_per_update": 72, "epochs": 2, "minibatches": 2},
    "sb3-a2c": {"steps_per_update": 70},
}


def run_of(algorithm: str, drones: int = 4, **changes: Any) -> Run:
    return Run(
        algorithm=algorithm,
        config=preset(algorithm, "tuned", **SMALL[algorithm]),
        seed=4,
        env_steps=1400,
        num_envs=drones,
        **{"env": EnvConfig.from_keywords(**OPTIONS), **changes},
    )


def env_of(run: Run, **changes: Any) -> Any:
    return vector(run.num_envs, **{**run.env.flat_options(), **changes})


@pytest.mark.parametrize("case", cases("wrong_runs"), ids=str)
def test_wrong_runs_are_one_sentence(case: Any) -> None:
    """An update takes whole steps of 4 drones, or an episode of each."""
    run = run_of(case["algorithm"])
    with pytest.raises(InputError, match=case["sentence"]):
        replace(run, **case["changes"])


def test_an_env_of_other_drones_is_refused() -> None:
    run = run_of("a2c")
    env = env_of(replace(run, num_envs=3))
    with pytest.raises(InputError, match="env: expected one of 4 drones, got 3"):
        Training(run, env)


@pytest.mark.parametrize("backend", ["mujoco", "rigid"])
def test_a_training_knows_the_config_that_is_flown(backend: str) -> None:
    run = run_of("a2c")
    flown = replace(run.env, backend=BackendConfig(name=backend))  # type: ignore[arg-type]
    env = LocalVectorEnv(flown, 4, autoreset_mode="Disabled")
    assert Training(run, env).env_config == flown.resolve()
    other = LocalVectorEnv(replace(flown, history=2), 4, autoreset_mode="Disabled")
    assert Training(run, other).env_config is None


def test_progress_tells_of_every_drone() -> None:
    """Of 120 drones that begin together the last 20 to end are those that flew longest."""
    run = replace(run_of("vpg"), num_envs=120, env_steps=7200)
    training = Training(run, env_of(run))
    training.train()
    assert len(training.log.episodes) >= 240
    last = training.log.episodes[-120:]
    lengths = [episode.length for episode in last]
    assert np.mean(lengths[-20:]) > np.mean(lengths)
    mean = np.mean([episode.total_reward for episode in last])
    assert training.words().startswith(f"return {mean:.0f}, |E| 0.")
    assert training.scalars()["rollout/ep_rew_mean"] == pytest.approx(mean)
    assert training.scalars()["rollout/ep_len_mean"] == pytest.approx(np.mean(lengths))


def test_what_cannot_be_resumed_is_refused() -> None:
    run = run_of("a2c")
    training = Training(run, env_of(run))
    training.train(lambda: False)
    kept = training.checkpoint()
    with pytest.raises(ResumeError, match="resume: expected an env with options"):
        Training.resume(kept, env_of(run, effects={"linear_drag": 0.5}))
    vehicles = r"resume: expected rotorgram quadcopter .*, got Crazyflie 2.* with --vehicle$"
    with pytest.raises(ResumeError, match=vehicles):
        Training.resume(kept, env_of(run, vehicle="crazyflie2"))
    unfit = "its parts do not fit together"
    hidden = {**kept.config, "hidden": [8]}
    with pytest.raises(CheckpointError, match=unfit):
        Training.resume(replace(kept, config=hidden), env_of(run))
    with pytest.raises(InputError, match=r"^seed: expected"):
        Training.resume(replace(kept, seed=-1), env_of(run))


def test_a_stopped_run_of_sb3_starts_anew_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    words = ["train", "sb3-a2c"]
    assert main([*words, "--env-steps", "300", "--num-envs", "4", "--out", str(folder)]) == 0
    path = folder / "checkpoint.safetensors"
    store(replace(load(path), env_steps=600), path)
    capsys.readouterr()
    assert main([*words, "--resume", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "note: sb3-a2c keeps no state of a training: it starts anew\n" in out
    assert "trained 512 of 600 env steps\n" in out  # whole rollouts of 256
    assert load(path).position.episodes[0].first_step == 0
