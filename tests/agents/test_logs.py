"""What a training logs: names and values of its curves, one curve over a resume, lines that fit."""

import io
import math
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from drones import log_of, rollout, vector
from rich.console import Console
from rotorgram.agents import VPGConfig, preset
from rotorgram.agents.checkpoints import Checkpoint, load, store
from rotorgram.agents.vpg import VPG
from rotorgram.cli import main
from rotorgram.cli._progress import Bars, Lines
from rotorgram.cli._scalars import ScalarWriter
from rotorgram.envs.config import EnvConfig
from rotorgram.training.settings import Run
from rotorgram.training.training import Training
from tensorboard.backend.event_processing import plugin_event_accumulator
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

DOCS = Path(__file__).parents[2] / "docs" / "algorithms"
AGENTS = ["vpg", "a2c", "sb3-a2c"]
ENTROPY_OF_ONE = 0.5 * math.log(2 * math.pi * math.e)  # nats, of a Gaussian with deviation 1

Curves = dict[str, list[tuple[int, float]]]


def curves(folder: Path) -> Curves:
    """Points by name, without those of the wire."""
    board = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0})
    board.Reload()
    return {
        name: [(point.step, point.value) for point in board.Scalars(name)]
        for name in board.Tags()["scalars"]
        if not name.startswith("wire/")
    }


def documented(page: str) -> set[str]:
    return set(re.findall(r"^\| `((?:rollout|time|train)/\w+)`", (DOCS / page).read_text(), re.M))


def train(algorithm: str, folder: Path, *settings: object) -> Curves:
    arguments = ["train", algorithm, "--out", folder, *settings]
    assert main([str(a) for a in arguments]) == 0
    return curves(folder)


def sized(algorithm: str, steps: int = 100) -> tuple[str, str]:
    change = "episodes_per_update=4" if algorithm == "vpg" else f"steps_per_update={steps}"
    return "--set", change


# ---- names


@pytest.mark.parametrize("drones", [1, 2])
@pytest.mark.parametrize("algorithm", [*AGENTS, "ppo"])
def test_the_names_are_those_of_the_pages(algorithm: str, drones: int, tmp_path: Path) -> None:
    logged = train(
        algorithm, tmp_path / "run", "--env-steps", 600, "--num-envs", drones, *sized(algorithm)
    )
    assert set(logged) == documented("README.md") | documented(f"{algorithm}.md")
    critic = {"train/value_loss", "train/explained_variance"}
    assert documented("a2c.md") == documented("sb3-a2c.md") == documented("vpg.md") | critic
    steps = max([step for step, _ in points] for points in logged.values())
    assert steps[-1] >= 400
    assert steps == sorted(set(steps))


@pytest.mark.parametrize("algorithm", AGENTS)
def test_discrete_actions_have_no_deviation(algorithm: str) -> None:
    env = vector(action_type="discrete", episode_length=10)
    size = {"episodes_per_update": 2} if algorithm == "vpg" else {"steps_per_update": 20}
    config = preset(algorithm, "tuned", **size)
    choices = EnvConfig.from_keywords(action_type="discrete")
    run = Run(algorithm=algorithm, config=config, env=choices, seed=0, env_steps=40)
    training = Training(run, env)
    assert not any(name.startswith("train/") for name in training.scalars()), "before an update"
    training.train()
    logged = training.scalars()
    train_names = {name for name in logged if name.startswith("train/")}
    assert train_names == documented(f"{algorithm}.md") - {"train/std"}
    # The first policies are near to uniform over decrease, hold and increase.
    assert logged["train/entropy_loss"] == pytest.approx(-math.log(3), abs=0.01)


def test_what_is_not_defined_is_not_written() -> None:
    """One step has no variance to explain."""
    run = Run(algorithm="a2c", config=preset("a2c", "paper"), seed=0, env_steps=1)
    training = Training(run, vector())
    training.train()
    logged = training.scalars()
    assert "train/explained_variance" not in logged
    assert not any(name.startswith("rollout/") for name in logged), "no episode has ended"
    assert logged["train/n_updates"] == 1
    assert logged["time/total_timesteps"] == 1


# ---- values


@pytest.mark.parametrize("algorithm", AGENTS)
def test_the_values_by_hand(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path / "sb3"))
    folder = tmp_path / "run"
    settings = ("--env-steps", 800, "--episode-length", 5, *sized(algorithm))
    logged = train(algorithm, folder, *settings)
    assert not (tmp_path / "sb3").exists(), "SB3 is to write nothing"
    table = pd.read_csv(folder / "episodes.csv")
    assert len(table) > 150, "more than a window"
    columns = {"rew": "total_reward", "len": "length", "error": "mean_size"}
    for short, column in columns.items():
        for step, value in logged[f"rollout/ep_{short}_mean"]:
            ended = table[table.first_step + table.length <= step]
            assert value == pytest.approx(ended[column][-100:].mean(), rel=1e-5)
    assert logged["time/total_timesteps"] == [(s, s) for s, _ in logged["time/fps"]]
    kept = load(folder / "checkpoint.safetensors")
    deviation = float(np.exp(kept.actor["log_std"]).mean())
    assert logged["train/std"][-1] == (800, pytest.approx(deviation, rel=1e-6))
    # The rate falls from 0.01 to 0, and is that of the steps before the update.
    size = 4 * 5 if algorithm == "vpg" else 100
    for step, value in logged["train/learning_rate"]:
        assert value == pytest.approx(0.01 * (1 - (step - size) / 800), rel=1e-5)
    assert logged["train/n_updates"] == [(s, s / size) for s, _ in logged["train/n_updates"]]


TWO_STEPS = rollout("two episodes")
LOG_P = [-0.045 - 0.9189385, -2.0 - 0.9189385]  # of the actions, of mean 0 and deviation 1


def test_the_terms_of_vpg_by_hand() -> None:
    agent = VPG(log_of(), VPGConfig(hidden=(1,), log_std=0.0), 0)
    agent.weights.values[:] = 0.0
    agent.gradient(TWO_STEPS)
    logged = agent.scalars()
    assert logged["train/policy_loss"] == pytest.approx(-(1 * LOG_P[0] + 2 * LOG_P[1]) / 2)
    assert logged["train/entropy_loss"] == pytest.approx(-ENTROPY_OF_ONE)


# ---- resuming


# TensorBoard reads event files in the order of their names, and these tell whole seconds: a test
# that is faster than a user waits one between two files of a folder.


def exact(logged: Curves) -> Curves:
    """Those that no clock is part of."""
    return {name: points for name, points in logged.items() if name != "time/fps"}


@pytest.mark.parametrize("algorithm", AGENTS)
def test_the_curves_of_a_killed_training_go_on_as_if_it_had_not_been(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed where it hurts most: the curves are written, the checkpoint is the one before."""
    folder = tmp_path / "whole"
    broken = tmp_path / "broken"

    def copy_before(checkpoint: Checkpoint, path: Path) -> None:
        if path.exists() and checkpoint.position.env_steps >= 800 and not broken.exists():
            shutil.copytree(folder, broken)
        store(checkpoint, path)

    monkeypatch.setattr("rotorgram.cli._trainer.store", copy_before)
    settings = ("--env-steps", 2400, *sized(algorithm), "--store-every", 0.05)
    whole = train(algorithm, folder, *settings)
    behind = load(broken / "checkpoint.safetensors").position.env_steps
    left = curves(broken)["train/std"]
    assert 0 < behind < left[-1][0] < 2400, "the copy has points beyond its checkpoint"
    time.sleep(1.0)
    assert main(["train", algorithm, "--resume", str(broken)]) == 0
    assert exact(curves(broken)) == exact(whole)
    assert len(list((broken / "tensorboard").iterdir())) == 2
    assert len(whole["train/std"]) >= 4


def test_lost_points_are_forgotten_and_none_is_double(tmp_path: Path) -> None:
    for behind, value, end in ((0, 1.0, 800), (300, 2.0, 600)):
        writer = ScalarWriter(tmp_path / "tensorboard", 800, behind=behind)
        for step in range(behind + 100, end + 1, 100):
            assert writer.due(step)
            writer.write(step, {"a": value})
        writer.close()
        time.sleep(1.0)
    expected = [(100, 1.0), (200, 1.0), (300, 1.0), (400, 2.0), (500, 2.0), (600, 2.0)]
    assert curves(tmp_path)["a"] == expected
    # The server reads in one of two ways; `--load_fast=false` is this.
    slow = plugin_event_accumulator.EventAccumulator(str(tmp_path / "tensorboard"))
    slow.Reload()
    assert [point.step for point in slow.Tensors("a")] == [step for step, _ in expected]


@pytest.mark.parametrize("size", [1, 128, 700])
def test_points_are_few_and_near_the_same_steps_for_all(size: int, tmp_path: Path) -> None:
    writer = ScalarWriter(tmp_path, 200_000)
    steps = range(size, 200_001, size)
    written = [step for step in steps if writer.due(step)]
    assert written[0] == size, "the first update"
    # Each thousand is written, as soon as an update is beyond it.
    thousands = range(1000, steps[-1] + 1, 1000)
    assert written[1:] == [math.ceil(t / size) * size for t in thousands]
    writer.write(steps[-2], {})
    assert writer.due(steps[-1], last=True)
    writer.write(steps[-1], {})
    assert not writer.due(steps[-1], last=True)
    writer.close()


def test_short_runs_have_a_point_each_hundred_steps(tmp_path: Path) -> None:
    writer = ScalarWriter(tmp_path, 500)
    written = [step for step in range(1, 501) if writer.due(step)]
    writer.close()
    assert written == [1, 100, 200, 300, 400, 500]


# ---- lines


class Clock:
    """A clock that stands still unless it is moved."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def fly(show: Callable[[str, int, int, str], None], clock: Clock, name: str, seconds: int) -> None:
    """5,120 env steps per second, told five times each."""
    for tick in range(5 * seconds + 1):
        show(name, 1024 * tick, 200_000, "return 224, |E| 0.02 m")
        clock.now += 0.2
    clock.now -= 0.2


def drawn(bars: Bars, width: int) -> list[str]:
    console = Console(width=width, file=io.StringIO(), force_terminal=True, color_system=None)
    console.print(bars.progress.get_renderable())
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined,no-any-return]


def test_a_bar_tells_everything_on_80_columns() -> None:
    clock = Clock()
    bars = Bars(Console(width=80, file=io.StringIO(), force_terminal=True), clock)
    fly(bars, clock, "sb3-a2c seed 0", 20)
    (line,) = drawn(bars, 80)
    assert len(line) <= 80
    assert re.fullmatch(
        r"sb3-a2c seed 0 ━[━╸╺ ]{4,} 102,400/200,000 0:00:20 0:00:20 "
        r"return 224, \|E\| 0\.02 m",
        line.rstrip(),
    )


@pytest.mark.parametrize("width", [30, 60, 79, 80, 100, 200])
def test_no_bar_is_wider_than_its_terminal(width: int) -> None:
    clock = Clock()
    bars = Bars(Console(width=width, file=io.StringIO(), force_terminal=True), clock)
    for step in range(3):
        bars("sb3-a2c seed 12", 9_123_456 + step, 12_345_678, "return -1234, |E| 10.12 m")
        bars("vpg seed 3", 40_000 * step, 200_000, "evaluating")
        bars("a2c seed 4", 0, 200_000, "")
        clock.now += 5000.0
    lines = drawn(bars, width)
    assert len(lines) == 3, "none is wrapped"
    assert max(map(len, lines)) <= width
    assert [line.split()[0][:2] for line in lines] == ["sb", "vp", "a2"]


def test_lines_come_every_ten_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    fly(Lines(clock), clock, "a2c seed 0", 25)
    assert capsys.readouterr().out.splitlines() == [
        "a2c seed 0     0/200,000 return 224, |E| 0.02 m",
        "a2c seed 0     51,200/200,000 return 224, |E| 0.02 m",
        "a2c seed 0     102,400/200,000 return 224, |E| 0.02 m",
    ]


def test_a_run_that_is_done_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    lines = Lines(clock)
    lines("vpg seed 1", 0, 60, "simulate")
    clock.now += 2.0
    lines("vpg seed 1", 60, 60, "done")
    assert capsys.readouterr().out.splitlines()[-1] == "vpg seed 1     60/60 done"
    bars = Bars(Console(width=80, file=io.StringIO(), force_terminal=True), clock)
    bars("vpg seed 1", 60, 60, "done")
    assert drawn(bars, 80) == [], "it makes room"
