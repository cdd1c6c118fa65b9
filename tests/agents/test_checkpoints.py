"""Trainings that stop and go on to the bit; files that are damaged or crafted are refused."""

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from drones import ENV, OPTIONS, cases, vector
from rotorgram.agents import (
    Checkpoint,
    Config,
    EpisodeRecorder,
    ResumeError,
    checkpoints,
    load,
    make_agent,
    preset,
    resume_agent,
    store,
)
from rotorgram.agents.checkpoints import CheckpointError
from rotorgram.agents.learner import Learner
from rotorgram.models.errors import InputError
from rotorgram.models.files import other_versions, software_versions, write_whole

SMALL: dict[str, dict[str, Any]] = {
    "vpg": {"episodes_per_update": 3},
    "a2c": {"steps_per_update": 64},
    "ppo": {"steps_per_update": 64, "epochs": 2, "minibatches": 3},
}
TOTAL = 768


def config_of(algorithm: str) -> Config:
    return preset(algorithm, "tuned", **SMALL[algorithm])


def log_of(drones: int, seed: int = 5, **options: Any) -> EpisodeRecorder:
    env = vector(drones, **{**OPTIONS, **options})
    return EpisodeRecorder(env, seed)


def checkpoint_of(algorithm: str, log: EpisodeRecorder, agent: Learner) -> Checkpoint:
    return Checkpoint(
        algorithm=algorithm,
        config=vars(config_of(algorithm)),
        spec=log.spec,
        seed=log.run_seed,
        env_steps=TOTAL,
        actor=agent.policy().weights.arrays,
        state=agent.state(),
        position=log.position(),
    )


def trained(algorithm: str, log: EpisodeRecorder, updates: int = 10**9) -> Learner:
    agent = make_agent(algorithm, log, config_of(algorithm), 5)
    assert isinstance(agent, Learner)
    calls = iter(range(updates - 1))
    agent.train(log, TOTAL, lambda: next(calls, None) is not None)
    return agent


def short_training(algorithm: str, drones: int = 2, **options: Any) -> Checkpoint:
    """Stopped after three updates."""
    log = log_of(drones, **options)
    agent = trained(algorithm, log, updates=3)
    return checkpoint_of(algorithm, log, agent)


@pytest.mark.parametrize("drones", [1, 4])
@pytest.mark.parametrize("kind", ["continuous", "discrete"])
@pytest.mark.parametrize("algorithm", SMALL)
def test_a_training_that_was_stopped_ends_as_if_it_had_not(
    algorithm: str, drones: int, kind: str, tmp_path: Path
) -> None:
    whole = log_of(drones, action_type=kind)
    unbroken = trained(algorithm, whole)
    stopped = short_training(algorithm, drones, action_type=kind)
    store(stopped, tmp_path / "c")
    kept = load(tmp_path / "c")
    assert kept.num_envs == drones
    assert kept.env_id == ENV
    assert kept.spec.options["episode_length"] == 30
    assert kept.position.episodes == stopped.position.episodes
    torch.manual_seed(99)  # nothing may depend on what the process did before
    log = log_of(drones, action_type=kind)
    resumed = resume_agent(kept, log)
    assert 0 < log.env_steps < TOTAL
    resumed.train(log, TOTAL, lambda: True)
    assert log.env_steps == whole.env_steps
    state = resumed.state()
    expected = unbroken.state()
    assert state.keys() == expected.keys()
    for name, array in state.items():
        assert array.tobytes() == expected[name].tobytes(), name
    found = [replace(episode, seconds=0.0) for episode in log.episodes]
    wanted = [replace(episode, seconds=0.0) for episode in whole.episodes]
    assert found == wanted


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Checkpoint:
    path = tmp_path_factory.mktemp("kept") / "c"
    store(short_training("a2c"), path)
    return load(path)


def test_a_checkpoint_tells_where_it_comes_from(kept: Checkpoint) -> None:
    assert kept.algorithm == "a2c"
    assert kept.config["gae_lambda"] == 0.98
    assert kept.seed == 5
    assert kept.spec.vehicle_hash != "0" * 32
    assert kept.versions == software_versions()
    assert other_versions(kept.versions) == {}
    other = replace(kept, versions={**kept.versions, "torch": "0.1"})
    assert other_versions(other.versions) == {"torch": ("0.1", kept.versions["torch"])}
    policy = kept.policy()
    action = policy.act(np.zeros(3, np.float32))
    assert action.shape == (1,)
    spec = log_of(1, observation="error").spec
    with pytest.raises(InputError, match="policy: expected weights of shapes"):
        kept.policy(spec)


DRAG = {"effects": {"linear_drag": 0.1}}


@pytest.mark.parametrize("options", [DRAG, {"target": 8.0}, {"action_type": "discrete"}])
def test_another_env_is_refused(options: dict[str, Any], kept: Checkpoint) -> None:
    log = log_of(2, **options)
    with pytest.raises(ResumeError, match="an env with options"):
        resume_agent(kept, log)


def test_an_env_that_does_not_repeat_is_refused(kept: Checkpoint) -> None:
    log = log_of(3)
    with pytest.raises(ResumeError, match="expected a training with 3 drones, got one with 2"):
        resume_agent(kept, log)
    flown = kept.position.flown
    assert flown
    flown = flown._replace(actions=flown.actions * 0.5)
    crafted = replace(kept, position=replace(kept.position, flown=flown))
    log = log_of(2)
    with pytest.raises(ResumeError, match="does not repeat the episodes"):
        resume_agent(crafted, log)


DAMAGED = "expected a rotorgram checkpoint, got another file or a damaged one"


def test_the_smallest_damage_is_noticed(kept: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "c"
    store(kept, path)
    data = path.read_bytes()
    places = np.random.default_rng(0).choice(len(data), 300, replace=False)
    files = [b"", b"x", data[:-1], data + b"x", data[:100], b"garbage" * 100]
    for place in [*range(8), *places.tolist()]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << place % 8
        files.append(damaged)
    for content in files:
        path.write_bytes(content)
        with pytest.raises(CheckpointError) as told:
            load(path)
        assert str(told.value) == f"{path}: {DAMAGED}"
    missing = tmp_path / "none"
    with pytest.raises(CheckpointError) as told:
        load(missing)
    assert str(told.value) == f"checkpoint: expected a file, got {missing}, where there is none"


def with_nan(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays, the first number of which is NaN."""
    copies = {name: array.copy() for name, array in arrays.items()}
    numbers = [array for array in copies.values() if array.dtype.kind == "f" and array.size]
    numbers[0].flat[0] = np.nan
    return copies


@pytest.mark.parametrize("part", ["actor", "state"])
def test_what_is_not_finite_is_never_stored(part: str, kept: Checkpoint, tmp_path: Path) -> None:
    path = tmp_path / "c"
    store(kept, path)
    before = path.read_bytes()
    arrays = with_nan(getattr(kept, part))
    wrong = replace(kept, **{part: arrays})
    with pytest.raises(CheckpointError, match=r"training diverged, .* is not finite"):
        store(wrong, path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["c"]


def test_what_is_not_finite_is_never_loaded(
    kept: Checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crafted file with a good checksum."""
    path = tmp_path / "c"
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "_not_finite", lambda _: [])
        crafted = replace(kept, actor=with_nan(kept.actor))
        store(crafted, path)
    with pytest.raises(CheckpointError) as told:
        load(path)
    first = next(iter(kept.actor))
    name = f"policy/{first}"
    assert str(told.value) == f"{path}: expected finite numbers, got NaN or infinity in {name}"


def refusal_of(kept: Checkpoint, path: Path) -> str:
    """The sentence about a crafted file."""
    store(kept, path)
    with pytest.raises(CheckpointError) as told:
        load(path)
    return str(told.value)


@pytest.mark.parametrize("case", cases("crafted_metadata"), ids=str)
def test_crafted_metadata_is_refused(case: Any, kept: Checkpoint, tmp_path: Path) -> None:
    crafted = replace(kept, **case["change"])
    refusal = refusal_of(crafted, tmp_path / "c")
    assert case["sentence"] in refusal


@pytest.mark.parametrize(("text", "sentence"), [(None, "wrong part"), ("{}", "expected env_id in")])
def test_a_crafted_spec_is_refused(
    text: str | None, sentence: str, kept: Checkpoint, tmp_path: Path
) -> None:
    spec: Any = SimpleNamespace(to_json=lambda: text)
    crafted = replace(kept, spec=spec)
    refusal = refusal_of(crafted, tmp_path / "c")
    assert sentence in refusal


def test_another_format_is_refused(
    kept: Checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c"
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "FORMAT", 1)
        store(kept, path)
    with pytest.raises(CheckpointError, match="expected a checkpoint of format 6, got 1"):
        load(path)


@pytest.fixture(scope="module")
def ppo_kept() -> Checkpoint:
    return short_training("ppo")


@pytest.mark.parametrize(("name", "shape"), cases("wrong_states"))
def test_parts_that_do_not_fit_are_refused(
    name: str, shape: tuple[int, ...], ppo_kept: Checkpoint
) -> None:
    array = np.zeros(shape, np.float32)
    state = {**ppo_kept.state, name: array}
    wrong = replace(ppo_kept, state=state)
    log = log_of(2)
    with pytest.raises(CheckpointError, match="its parts do not fit together"):
        resume_agent(wrong, log)


@pytest.mark.parametrize("name", ["optimizer.sums", "weights", "rng"])
def test_a_missing_part_is_refused(name: str, ppo_kept: Checkpoint) -> None:
    state = dict(ppo_kept.state)
    del state[name]
    wrong = replace(ppo_kept, state=state)
    log = log_of(2)
    with pytest.raises(CheckpointError, match="its parts do not fit together"):
        resume_agent(wrong, log)


@pytest.mark.parametrize("config", [{"hidden": [10**9]}, {"gamma": 7}, {"other": 1}])
def test_a_config_that_does_not_fit_is_refused(config: Any, ppo_kept: Checkpoint) -> None:
    given = {**ppo_kept.config, **config}
    wrong = replace(ppo_kept, config=given)
    log = log_of(2)
    with pytest.raises(CheckpointError, match="its parts do not fit together"):
        resume_agent(wrong, log)


@pytest.mark.parametrize(("name", "shape"), cases("wrong_positions"))
def test_a_position_that_does_not_fit_is_refused(
    name: str, shape: tuple[int, ...], kept: Checkpoint
) -> None:
    flown = kept.position.flown
    assert flown
    flown = flown._replace(**{name: np.zeros(shape, np.float32)})
    position = replace(kept.position, flown=flown)
    with pytest.raises(InputError):
        resume_agent(replace(kept, position=position), log_of(2))


def test_a_file_is_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "new" / "file"
    write_whole(path, b"one")
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(OSError, match="full") as error:
        write_whole(path, b"two")
    assert error.value.filename == str(path), "a sentence about a full disk names the file"
    assert path.read_bytes() == b"one"
    assert os.listdir(path.parent) == ["file"]


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_a_policy_alone_is_small_flies_the_same_and_resumes_nothing(
    kind: str, tmp_path: Path
) -> None:
    whole = short_training("a2c", 1, action_type=kind)
    paths = tmp_path / "whole", tmp_path / "alone"
    store(whole, paths[0])
    store(whole.policy_alone(), paths[1])
    size, alone = (path.stat().st_size for path in paths)
    # The actor's weights (82 numbers if continuous) and the spec are all that it needs.
    spec = len(json.dumps(whole.spec.to_json()))
    assert alone < 6000
    assert alone - spec < (size - spec) / 2
    kept = load(paths[1])
    assert kept.num_envs == 0
    assert kept.position.env_steps == whole.position.env_steps
    observation = np.array([0.5, -0.2, 0.1], np.float32)
    assert kept.policy().act(observation) == whole.policy().act(observation)
    words = "resume: expected the checkpoint of a training, got a policy alone"
    with pytest.raises(ResumeError, match=words):
        resume_agent(kept, log_of(1, action_type=kind))
