"""examples/landing.py, a task of one's own: everything that ours can, from outside the package.

The agent's side runs in a folder that lacks the file: it knows of the task what Hello tells.
"""

import ast
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium.utils.env_checker import check_env
from rotorgram.envs import registry

ROOT = Path(__file__).parents[2]
LANDING = ROOT / "examples" / "landing.py"
ID = "landing:Landing-v0"
SHORT = ("--env-steps", "4096", "--num-envs", "8", "--seed", "0")


def rotorgram(folder: Path, *words: Any, status: int = 0) -> str:
    command = [sys.executable, "-m", "rotorgram.cli", *map(str, words)]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=110, check=False
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


@contextmanager
def simulator(folder: Path, port: int, *words: Any) -> Iterator[None]:
    """`rotorgram sim`, which ends when the agent closes."""
    flags = ["--server", f"127.0.0.1:{port}", "--bind", "127.0.0.1:0", *map(str, words)]
    command = [sys.executable, "-m", "rotorgram.cli", "sim", "--env", ID, *flags]
    with subprocess.Popen(command, cwd=folder) as process:
        try:
            yield
            assert process.wait(30) == 0
        finally:
            process.kill()


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the task's file."""
    folder = tmp_path_factory.mktemp("here")
    shutil.copy(LANDING, folder)
    return folder


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder without it."""
    return tmp_path_factory.mktemp("elsewhere")


@pytest.fixture(scope="module")
def trained(here: Path, elsewhere: Path) -> Path:
    """A policy that was trained over the wire by an agent that lacks the file."""
    port = free_port()
    with simulator(here, port, "--num-envs", 8):
        words = ["train", "a2c", "--listen", f"127.0.0.1:{port}", *SHORT, "--out", "run"]
        rotorgram(elsewhere, *words)
    return elsewhere / "run"


@pytest.fixture(scope="module")
def recorded(here: Path, elsewhere: Path, trained: Path) -> Path:
    """A journal of an evaluation by an agent that lacks the file."""
    port = free_port()
    journal = elsewhere / "flight.mcap"
    with simulator(here, port):
        words = ["--listen", f"127.0.0.1:{port}", "--episodes", "1", "--record", journal]
        told = rotorgram(elsewhere, "evaluate", trained, *words)
    assert re.search(r"on Landing-v0\n", told)
    assert re.search(r"steady +\|?h\|? -?\d+\.\d+ m", told)
    return journal


def test_it_is_one_short_file() -> None:
    lines = [line for line in LANDING.read_text().splitlines() if line.strip()]
    assert len(lines) <= 60


def test_the_page_shows_the_file() -> None:
    """But for the file's docstring."""
    text = LANDING.read_text()
    code = text.split("\n", ast.parse(text).body[0].end_lineno or 0)[-1].strip()
    assert code in (ROOT / "docs" / "extending.md").read_text()


def test_it_is_a_gymnasium_env(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(LANDING.parent)
    env_id = registry.load(ID)
    check_env(gym.make(env_id, disable_env_checker=True).unwrapped, skip_render_check=True)
    with pytest.raises(ValueError, match=r"^start: expected a number from 2 to 50 m, got 1"):
        gym.make(env_id, start=1)
    many = gym.make_vec(env_id, num_envs=16, autoreset_mode="Disabled", start=3.0)
    observations, info = many.reset(seed=0)
    assert abs(info["height"] - 3.0).max() <= 1.0
    done = np.zeros(16, bool)
    while not done.all():  # down at a speed that falls with the height
        height, climb = observations.T
        wanted = -np.minimum(1.0, 0.3 + 0.5 * height)
        observations, _, terminated, done, info = many.step(2.0 * (wanted - climb)[:, None])
        assert not terminated.any()
    assert abs(info["height"]).max() < 0.01
    assert (info["reward_nearness"] > 0.9).all()
    many.reset(seed=0)
    for _ in range(100):  # a stone
        *_, terminated, _, info = many.step(np.full((16, 1), -1.0, np.float32))
        if terminated.any():
            break
    assert terminated.any()
    assert (info["reward_end"][terminated] == -100.0).all()


def test_an_agent_without_the_file_trains(trained: Path) -> None:
    assert (trained / "checkpoint.safetensors").is_file()
    assert b"Landing-v0" in (trained / "checkpoint.safetensors").read_bytes()


def test_one_with_the_file_trains_and_evaluates(here: Path) -> None:
    words = ["--env", ID, "--env.start", "3", *SHORT, "--out", "own"]
    rotorgram(here, "train", "a2c", *words)
    told = rotorgram(here, "evaluate", "own", "--env", ID, "--episodes", "2")
    assert "on Landing-v0\n" in told
    assert "episodes   2" in told


def test_a_journal_is_replayed_to_the_bit(here: Path, elsewhere: Path, recorded: Path) -> None:
    assert "Landing-v0" in rotorgram(elsewhere, "replay", recorded)
    told = rotorgram(here, "replay", recorded, "--verify", "--env", ID)
    assert "identical" in told
    # What a journal names is looked up, never imported.
    assert "Landing-v0" in rotorgram(here, "replay", recorded, "--verify", status=1)


def test_it_is_filmed(here: Path, recorded: Path, trained: Path, opengl: None) -> None:
    size = ["--size", "160x120", "--fast"]
    rotorgram(here, "render", recorded, "--out", "recorded.png", *size)
    rotorgram(here, "render", trained, "--env", ID, "--out", "flown.png", *size)
    assert (here / "recorded.png").stat().st_size > 500
    assert (here / "flown.png").stat().st_size > 500


def test_agents_are_compared_on_it(here: Path) -> None:
    words = ["--env", ID, "--agents", "a2c", "--seeds", "1", "--env-steps", "2048"]
    words += ["--episodes", "1", "--snapshots", "1", "--no-film", "--out", "comparison"]
    rotorgram(here, "compare", *words)
    assert (here / "comparison" / "report.html").is_file()
    evaluations = pd.read_parquet(here / "comparison" / "evaluations")
    assert set(evaluations["env_steps"]) == {0, 2048}
    assert evaluations["steady"].notna().all()
    assert "| Steady h (m) |" in (here / "comparison" / "results.md").read_text()


def test_a_task_that_nobody_knows_is_one_sentence(elsewhere: Path) -> None:
    told = rotorgram(elsewhere, "sim", "--env", ID, status=1)
    assert "expected a module landing here, got none" in told
    assert "Traceback" not in told


def test_files_of_the_working_folder_are_not_executed(tmp_path: Path) -> None:
    """But the module that `--env` names, in this process and in the simulator's."""
    for name in ("queue", "json", "random", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('executed')\n")
    source = Path(__file__).parents[2] / "examples" / "landing.py"
    (tmp_path / "landing.py").write_text(source.read_text())
    words = ["train", "ppo", "--env", "landing:Landing-v0", "--env-steps", "2000", "--out", "run"]
    for program in ("rotorgram", "rotorgram.cli"):
        done = subprocess.run(
            [sys.executable, "-m", program, *words], cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        shutil.rmtree(tmp_path / "run")
