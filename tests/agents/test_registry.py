"""An algorithm is a module and a row; a network is a class and a row; a preset is inherited."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
from rotorgram.agents import (
    A2CConfig,
    Config,
    EpisodeRecorder,
    PPOConfig,
    find_preset,
    load,
    make_agent,
    store,
)
from rotorgram.agents.a2c import A2C
from rotorgram.agents.config import SACConfig
from rotorgram.agents.layers import Affine, Layer, Tanh
from rotorgram.agents.networks import NETWORKS, Network
from rotorgram.agents.registry import ALGORITHMS, Algorithm
from rotorgram.cli import main
from rotorgram.envs import LocalVectorEnv, register
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.tasks.hover import Hover
from rotorgram.flights.palette import agent_label
from rotorgram.models.errors import InputError
from rotorgram.models.fields import Limits
from rotorgram.training.settings import Run
from rotorgram.training.training import Training

ENV = "rotorgram/Elevation-v0"
OPTIONS: dict[str, Any] = {"episode_length": 12, "start_band": 0.3, "flight_band": 0.4}


def vector(drones: int = 4) -> LocalVectorEnv:
    return LocalVectorEnv(ENV, drones, autoreset_mode="Disabled", **OPTIONS)


# ---- a row for an algorithm


@dataclass(frozen=True, kw_only=True)
class SlowConfig(A2CConfig):
    slower: Annotated[float, Limits(0.0, 1.0)] = 0.5


class Slow(A2C):
    """A2C with smaller steps."""

    config: SlowConfig

    def update(self, rollout: Any) -> None:
        self.rate = self.config.learning_rate * self.config.slower
        super().update(rollout)


def run_of(algorithm: str, config: Config) -> Run:
    return Run(
        algorithm=algorithm,
        config=config,
        seed=3,
        env_steps=240,
        num_envs=4,
        env=EnvConfig.from_keywords(**OPTIONS),
    )


def stopped_and_resumed(run: Run, path: Path) -> tuple[Training, Training]:
    """A training without a break, and one that was stored after two updates and went on."""
    whole = Training(run, vector())
    part = Training(run, vector())
    assert whole.train()
    updates = iter([True])
    assert not part.train(lambda: next(updates, False))
    store(part.checkpoint(), path)
    resumed = Training.resume(load(path), vector())
    assert 0 < resumed.log.env_steps < 240
    assert resumed.train()
    return whole, resumed


def test_a_new_algorithm_is_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = Algorithm("Slow A2C", f"{__name__}:SlowConfig", f"{__name__}:Slow")
    monkeypatch.setitem(ALGORITHMS, "slow", row)
    assert agent_label("slow") == "Slow A2C"
    preset = find_preset("slow", "tuned")
    assert (preset.config, preset.fits) == (SlowConfig(), False)
    run = run_of("slow", SlowConfig(steps_per_update=48))
    whole, resumed = stopped_and_resumed(run, tmp_path / "c")
    for name, array in whole.agent.state().items():
        assert resumed.agent.state()[name].tobytes() == array.tobytes(), name


# ---- a row for a network


class Wide(Network):
    """Two layers of tanh units."""

    def build(self, inputs: int, outputs: int, config: Config) -> Sequence[Layer]:
        return [Affine(inputs, 5), Tanh(), Affine(5, 5), Tanh(), Affine(5, outputs)]


def test_a_network_of_one_s_own_trains_resumes_and_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(NETWORKS, "wide", Wide)
    sizes = {"steps_per_update": 48, "learning_rate": 0.01}
    config = PPOConfig(network="wide", **sizes)  # type: ignore[arg-type]
    whole, resumed = stopped_and_resumed(run_of("ppo", config), tmp_path / "c")
    for name, array in whole.agent.state().items():
        assert resumed.agent.state()[name].tobytes() == array.tobytes(), name
    begun = Training(whole.run, vector()).agent.policy().weights.arrays["layers.0.weight"]
    assert (resumed.agent.policy().weights.arrays["layers.0.weight"] != begun).any()

    monkeypatch.delitem(NETWORKS, "wide")
    with pytest.raises(InputError, match=r"network: expected one of mlp.*, got 'wide'; import"):
        load(tmp_path / "c")


def test_sb3_takes_its_own_networks_alone() -> None:
    with pytest.raises(
        InputError, match="network: expected mlp without memory and reach with SB3, got"
    ):
        make_agent("sb3-ppo", EpisodeRecorder(vector(), 0), PPOConfig(network="wide"), 0)
    growing = PPOConfig(reward_clip=2.0, anneal_clip=True)
    with pytest.raises(InputError, match="anneal_clip: expected false with SB3, got true"):
        make_agent("sb3-ppo", EpisodeRecorder(vector(), 0), growing, 0)
    with pytest.raises(InputError, match="squashed: expected false with SB3, got true"):
        make_agent("sb3-ppo", EpisodeRecorder(vector(), 0), PPOConfig(squashed=True), 0)
    with pytest.raises(InputError, match="squashed: expected true with SB3, got false"):
        make_agent("sb3-sac", EpisodeRecorder(vector(), 0), SACConfig(squashed=False), 0)


def test_a_clip_of_rewards_grows_over_the_run() -> None:
    growing = PPOConfig(reward_scale=0.5, reward_clip=2.0, anneal_clip=True)
    rewards = np.array([-240.0, -8.0, 1.0])
    for left, expected in ((1.0, [-2.0, -2.0, 0.5]), (0.5, [-4.0, -4.0, 0.5])):
        assert growing.scaled(rewards, left) == pytest.approx(expected)
    assert growing.scaled(rewards, 0.01) == pytest.approx([-120.0, -4.0, 0.5])
    fixed = PPOConfig(reward_clip=2.0)
    assert fixed.scaled(rewards, 0.5) == pytest.approx([-2.0, -2.0, 1.0])
    with pytest.raises(InputError, match="anneal_clip: expected a reward_clip with it, got null"):
        PPOConfig(anneal_clip=True)


# ---- presets


class Higher(Hover):
    """Hover, by another name."""


def test_a_task_has_the_preset_of_the_task_that_it_derives_from() -> None:
    register("test/Higher-v0", Higher)
    own, hover = (
        find_preset("ppo", "tuned", f"{task}-v0") for task in ("test/Higher", "rotorgram/Hover")
    )
    assert own == hover
    assert (own.env_id, own.fits, own.config.hidden) == ("rotorgram/Hover-v0", True, (32, 32))
    other = find_preset("ippo", "tuned", "test/Higher-v0")
    assert (other.env_id, other.fits) == (ENV, False)


def test_train_says_where_no_preset_fits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["train", "ippo", "--env", "rotorgram/Hover-v0", "--env-steps", "1280"]
    assert main([*words, "--out", str(tmp_path / "a")]) == 0
    out = capsys.readouterr().out
    assert "there is no preset of ippo for rotorgram/Hover-v0" in out
    assert f"it gets that of {ENV}; --preset-of ID names another\n" in out
    words += ["--preset-of", "rotorgram/Crossing-v0", "--set", "steps_per_update=1024"]
    assert main([*words, "--out", str(tmp_path / "b")]) == 0
    assert "note: there is no preset" not in capsys.readouterr().out
    kept = load(tmp_path / "b" / "checkpoint.safetensors")
    assert kept.config["hidden"] == [32, 32]
    assert kept.num_envs == 1024
