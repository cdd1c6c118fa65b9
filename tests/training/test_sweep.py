"""The sweep: its rows, its ranking, what it keeps when it is stopped, and wrong input."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from comparisons import GATES, HEADLINE, spec_of
from rotorgram.agents import preset
from rotorgram.cli import main
from rotorgram.cli.sweep import parse_grid
from rotorgram.flights.executors import RunsFailed
from rotorgram.flights.folders import locked
from rotorgram.flights.trajectories import evaluation_seed
from rotorgram.training import films
from rotorgram.training.compare import compare, read_compare_config
from rotorgram.training.metrics import Headline
from rotorgram.training.results import CONFIG_KEYS, ResultsError
from rotorgram.training.settings import CompareConfig, Run, SweepConfig
from rotorgram.training.sweep import (
    RUN_COLUMNS,
    missing_runs,
    read_sweep_config,
    read_sweep_runs,
    sweep,
    sweep_table,
    write_sweep_table,
)
from rotorgram.training.training import Training

OPTIONS: dict[str, Any] = {"episode_length": 40, "flight_band": 1.2}
CONFIG = SweepConfig(
    algorithm="a2c",
    grid={"learning_rate": (0.003, 0.05), "steps_per_update": (64,)},
    seeds=2, env_steps=400, episodes=3, options=OPTIONS,
)  # fmt: skip
TIMES = ["seconds", "steps_per_second"]
FLAGS = ("--env-steps", "300", "--episodes", "1", "--episode-length", "40")


def nothing(*_: object) -> None:
    """No progress is shown."""


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of a command."""
    status = main([str(a) for a in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def sorted_rows(folder: Path, config: SweepConfig = CONFIG) -> pd.DataFrame:
    """The runs in one order, without what the clock says."""
    rows = read_sweep_runs(folder, config).drop(columns=TIMES)
    return rows.sort_values(["seed", "point"]).reset_index(drop=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sweep")
    sweep(CONFIG, path, "rotorgram sweep a2c", nothing)
    return path


def test_a_row_is_what_the_run_gives_in_process(folder: Path) -> None:
    rows = sorted_rows(folder)
    runs = list(zip(rows["seed"], rows["point"], strict=True))
    assert runs == [(1000, 0), (1000, 1), (1001, 0), (1001, 1)]
    env = gym.make(CONFIG.env_id, **OPTIONS).unwrapped
    run = Run(
        algorithm="a2c",
        config=preset("a2c", "tuned", learning_rate=0.05, steps_per_update=64),
        options=OPTIONS, seed=1001, env_steps=400,
    )  # fmt: skip
    training = Training(run, env)
    training.train()
    policy = training.agent.policy()
    errors, returns, crashed = [], [], 0
    for episode in range(3):
        observation, _ = env.reset(seed=evaluation_seed(episode, "tuning"))
        flown, rewards, done = [], [], False
        while not done:
            observation, reward, terminated, truncated, info = env.step(policy.act(observation))
            flown.append(abs(info["elevation_error"]))
            rewards.append(float(reward))
            done = terminated or truncated
        errors.append(np.mean(flown[-max(1, len(flown) // 4) :]))
        returns.append(sum(rewards))
        crashed += terminated
    row = rows.iloc[-1]  # the second point, with the second seed
    assert row["steady"] == pytest.approx(np.mean(errors), rel=1e-12)
    assert row["return"] == pytest.approx(np.mean(returns), rel=1e-12)
    assert (row["env_steps"], row["episodes"], row["crashed"]) == (400, 3, crashed)


def test_files_tell_settings_and_software(folder: Path) -> None:
    assert sorted(p.name for p in folder.iterdir()) == [".lock", "config.json", "runs.csv"]
    table = pd.read_csv(folder / "runs.csv")
    assert list(table.columns[:4]) == ["point", "learning_rate", "steps_per_update", "seed"]
    settings = table[["point", "learning_rate", "steps_per_update"]].drop_duplicates()
    assert settings.sort_values("point").to_numpy().tolist() == [[0, 0.003, 64], [1, 0.05, 64]]
    speed = table["env_steps"] / table["seconds"]
    assert table["steps_per_second"].tolist() == pytest.approx(speed.tolist())
    content = json.loads((folder / "config.json").read_text())
    assert content["command"] == "rotorgram sweep a2c"
    assert content["agents"]["a2c"]["gamma"] == 0.98
    assert content["seeds"] == [1000, 1001]
    assert len(content["spec"]["vehicle_hash"]) == 32
    assert content["versions"]["mujoco"].startswith("4.")
    assert read_sweep_config(folder) == CONFIG
    with pytest.raises(ResultsError, match="expected a comparison's"):
        read_compare_config(folder)


def test_a_comparison_of_swarms_goes_on_and_is_filmed_with_all_drones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = CompareConfig(
        agents=("ippo",), env_id="rotorgram/Formation-v0", options={"episode_length": 4},
        drones=2, num_envs=128, env_steps=16_384, seeds=1, snapshots=1, curve_episodes=1,
        episodes=1,
    )  # fmt: skip
    compare(config, tmp_path, "rotorgram compare", nothing)
    assert read_compare_config(tmp_path) == config
    filmed: list[Any] = []

    def film(fresh: Path, shots: list[Any], *_: object) -> None:
        filmed.extend(shots)
        fresh.touch()

    monkeypatch.setattr(films, "film", film)
    assert films.film_comparison(tmp_path, tmp_path / "film.mp4")
    assert len(filmed) == 2  # ORCA flies beside
    for shot in filmed:
        assert [len(drones) for drones in shot.episodes] == [2]
        assert shot.trajectories[0].spec.agents == ("drone_0", "drone_1")


def test_what_is_missing_is_flown_to_the_same_numbers(folder: Path, tmp_path: Path) -> None:
    whole = sorted_rows(folder)
    lines = (folder / "runs.csv").read_text().splitlines(keepends=True)
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "config.json").write_bytes((folder / "config.json").read_bytes())
    (broken / "runs.csv").write_text("".join(lines[:-2]))
    config = replace(read_sweep_config(broken), jobs=1)
    lost = set(missing_runs(config, read_sweep_runs(broken, config)))
    assert len(lost) == 2
    told = set()
    sweep(config, broken, "", lambda name, *_: told.add(name))
    assert told == {"all runs", *lost}
    assert (broken / "runs.csv").read_text().startswith("".join(lines[:-2]))
    pd.testing.assert_frame_equal(sorted_rows(broken), whole, check_exact=True)
    assert not missing_runs(CONFIG, read_sweep_runs(broken, CONFIG))


def test_a_run_that_fails_is_named_and_the_others_are_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Adam's step is as large as the learning rate: the second update overflows.
    folder = tmp_path / "out"
    flags = ("--grid", "learning_rate=0.01,1e29", "--seeds", 1, *FLAGS, "--out", folder)
    status, out, err = run(capsys, "sweep", "a2c", *flags)
    assert status == 1
    assert err.startswith("rotorgram: 1 of 2 runs failed: learning_rate=1e+29 seed 1000: ")
    assert err.count("\n") == 1
    assert f"go on with: rotorgram sweep a2c --resume {folder}" in out
    assert "1 of 2 runs done" in out
    assert pd.read_csv(folder / "sweep.csv")["learning_rate"].tolist() == [0.01]
    config = read_sweep_config(folder)
    with pytest.raises(RunsFailed, match=r"1 of 1 runs failed: learning_rate=1e\+29 seed 1000"):
        sweep(config, folder, "", nothing)
    assert read_sweep_runs(folder, config)["point"].tolist() == [0]
    with locked(folder):  # as by another process
        status, out, err = run(capsys, "sweep", "a2c", "--resume", folder)
    assert (status, out) == (1, "")
    assert err.endswith(f"{folder}: expected a folder that no other process writes to\n")


SWEEP = """
import sys
from pathlib import Path
from rotorgram.training.settings import SweepConfig
from rotorgram.training.sweep import sweep
config = SweepConfig(algorithm="a2c", grid={"gamma": (0.9, 0.99)}, env_steps=10_000_000, jobs=2)
sweep(config, Path(sys.argv[1]), "", lambda *_: None)
"""


@pytest.mark.quiet
def test_workers_and_simulators_end_with_a_process_that_is_killed(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", SWEEP, str(tmp_path)]) as process:
        deadline = time.monotonic() + 60
        while sum("until-stdin" in words for words in _descendants(process.pid).values()) < 2:
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.2)
        family = _descendants(process.pid)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    deadline = time.monotonic() + 15
    while alive := [pid for pid in family if Path(f"/proc/{pid}/exe").exists()]:
        assert time.monotonic() < deadline, alive
        time.sleep(0.2)


def _descendants(root: int) -> dict[int, str]:
    """Processes that descend from one, with their command lines."""
    words = ["ps", "-ewwo", "pid,ppid,args"]
    listing = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 2) for line in listing.splitlines()[1:]]
    found: dict[int, str] = {}
    for _ in range(4):  # generations
        found |= {int(p): args for p, parent, args in rows if int(parent) in {root, *found}}
    return found


def test_seeds_of_a_sweep_are_not_those_of_a_comparison() -> None:
    assert list(CompareConfig(seeds=3).all_seeds) == [0, 1, 2]
    assert list(CompareConfig(seeds=2, first_seed=40).all_seeds) == [40, 41]
    sweep_seeds = SweepConfig(algorithm="a2c", grid={"gamma": (0.9,)}).all_seeds
    assert list(sweep_seeds) == [1000, 1001, 1002]
    with pytest.raises(ValueError, match="first_seed: expected 0 or more, got -1"):
        CompareConfig(first_seed=-1)


@pytest.mark.parametrize("work", [sweep, compare])
def test_a_folder_is_swept_by_one_process(work: Any, tmp_path: Path) -> None:
    """And compared by one."""  # fault 23
    config = CONFIG if work is sweep else CompareConfig(agents=("a2c",), seeds=1, env_steps=300)
    busy = pytest.raises(ValueError, match="expected a folder that no other process writes to")
    with locked(tmp_path), busy:
        work(config, tmp_path, "", nothing)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


def test_points_are_all_combinations_and_every_one_flies_before_the_next_seed() -> None:
    config = replace(CONFIG, grid={"learning_rate": (0.003, 0.05), "steps_per_update": (64, 100)})
    names = ("learning_rate", "steps_per_update")
    points = [(0.003, 64), (0.003, 100), (0.05, 64), (0.05, 100)]
    assert config.points() == [dict(zip(names, point, strict=True)) for point in points]
    runs = config.runs()
    assert [(run.seed, point) for point, run in runs.values()] == [
        (seed, point) for seed in (1000, 1001) for point in range(4)
    ]
    point, run = runs["learning_rate=0.003 steps_per_update=100 seed 1001"]
    assert (point, run.seed) == (1, 1001)
    assert run.config == preset("a2c", "tuned", learning_rate=0.003, steps_per_update=100)


def rows_of(*runs: tuple[int, int, float, float, int]) -> pd.DataFrame:
    """Runs of ten episodes: point, seed, steady state, return, crashed."""
    names = ("point", "seed", "steady", "return", "crashed")
    rest = {"env_steps": 400, "episodes": 10, "settled": 9, "seconds": 2.0}
    rows = [{**rest, **dict(zip(names, run, strict=True))} for run in runs]
    return pd.DataFrame(rows).assign(steps_per_second=200.0)[list(RUN_COLUMNS)]


def test_points_are_ranked_by_their_worst_seed_and_its_crashes() -> None:
    config = replace(CONFIG, seeds=3, grid={"learning_rate": (0.1, 0.2, 0.3, 0.4)})
    rows = rows_of(
        (0, 0, 0.01, 20.0, 0), (0, 1, 0.01, 22.0, 0), (0, 2, 0.5, 3.0, 0),  # one seed fails
        (1, 0, 0.1, 10.0, 0), (1, 1, 0.2, 11.0, 0), (1, 2, 0.3, 12.0, 0),
        (2, 0, 0.02, 21.0, 2), (2, 1, 0.01, 22.0, 0), (2, 2, 0.04, 19.0, 0),  # crashes twice
        (3, 0, 0.01, 22.0, 0),  # and two seeds to come
    )  # fmt: skip
    table = sweep_table(config, rows, HEADLINE)
    # Whole points first; of these the fewest crashes of a seed, then the worst seed's error.
    assert table["point"].tolist() == [1, 0, 2, 3]
    assert table["most_crashed"].tolist() == [0, 0, 2, 0]
    assert table["worst"].tolist() == [0.3, 0.5, 0.04, 0.01]
    assert table["median"].tolist() == [0.2, 0.01, 0.02, 0.01]
    assert table["return"].tolist() == [11.0, 20.0, 21.0, 22.0]
    assert table["learning_rate"].tolist() == [0.2, 0.1, 0.3, 0.4]
    assert table["seeds"].tolist() == [3, 3, 3, 1]
    assert table["crashed"].tolist() == [0, 0, 2, 0]
    assert table["settled"].tolist() == [27, 27, 27, 9]
    # Of a metric that is to be high, the lowest seed is the worst.
    high = sweep_table(config, rows, Headline.of(spec_of(GATES)))
    assert high["point"].tolist() == [1, 0, 2, 3]
    assert high["worst"].tolist() == [0.1, 0.01, 0.01, 0.01]


def test_a_sweep_of_which_nothing_is_done_has_an_empty_table(tmp_path: Path) -> None:
    content = {"spec": json.loads(spec_of().to_json())} | dict.fromkeys(CONFIG_KEYS[:5], 1)
    content |= {key: {} for key in CONFIG_KEYS[6:]}
    (tmp_path / "config.json").write_text(json.dumps(content))
    table = write_sweep_table(CONFIG, tmp_path)
    assert table.empty
    assert (tmp_path / "sweep.csv").read_text().startswith("point,learning_rate,steps_per_update")


@pytest.mark.parametrize("change", ["twice", "foreign", "text", "empty", "column"])
def test_runs_of_another_sweep_are_refused(folder: Path, tmp_path: Path, change: str) -> None:
    lines = (folder / "runs.csv").read_text().splitlines(keepends=True)
    content = {
        "twice": [*lines, lines[1]],
        "foreign": [*lines[:-1], "4" + lines[-1][1:]],
        "text": [*lines[:-1], "x" + lines[-1][1:]],
        "empty": [],
        "column": [line.replace("steady", "error") for line in lines],
    }[change]
    (tmp_path / "runs.csv").write_text("".join(content))
    with pytest.raises(ResultsError, match=r"runs\.csv: expected"):
        read_sweep_runs(tmp_path, CONFIG)


def test_the_grid_is_read_by_name() -> None:
    assert parse_grid(["learning_rate=0.01,1e-3", "anneal=true,False", "baseline=none,time"]) == {
        "learning_rate": (0.01, 0.001),
        "anneal": (True, False),
        "baseline": ("none", "time"),
    }


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        ([], "grid: expected at least one hyperparameter, got none"),
        (["--grid", "gamma"], "grid: expected NAME=VALUE,VALUE,…, got 'gamma'"),
        (["--grid", "gamma="], "gamma: expected a number from 0 to 1, got ''"),
        (["--grid", "speed=1,2"], "hyperparameters: expected some of"),
        (["--grid", "gamma=0.9,1.1"], "gamma: expected a number from 0 to 1, got 1.1"),
        (["--grid", "gamma=0.9,0.90"], "grid: expected each gamma once, got 0.9 twice"),
        (["--grid", "gamma=0.9", "gamma=0.8"], "grid: expected each name once, got gamma twice"),
        (
            ["--grid", "gamma=0.9", "--grid", "gae_lambda=2"],
            "gae_lambda: expected a number",
        ),
        (["--grid", "gamma=0.9", "--seeds", "0"], "seeds: expected at least 1, got 0"),
        (["--grid", "gamma=0.9", "--first-seed", "-1"], "first_seed: expected 0 or more, got -1"),
        (["--grid", "gamma=0.9", "--env-steps", "9"], "env_steps: expected at least 256, got 9"),
        (["--grid", "gamma=0.9", "--num-envs", "0"], "num_envs: expected 1 or more, got 0"),
        (["--grid", "gamma=0.9", "--jobs", "0"], "jobs: expected at least 1, got 0"),
        (["--grid", "gamma=0.9", "--address", "a:1"], "address: expected it with runner ray"),
        (["--grid", "gamma=0.9", "--env.target", "1"], "target: expected"),
        (["--grid", "gamma=0.9", "--out", "."], "exists already"),
        (["--resume", "nowhere"], "got one without config.json"),
    ],
)
def test_wrong_input_is_one_sentence(
    flags: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, err = run(capsys, "sweep", "a2c", *flags)
    assert (status, out) == (1, "")
    assert err.startswith("rotorgram: ")
    assert sentence in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir()), "nothing has flown"


def test_the_command_with_many_drones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    flags = ("--grid", "steps_per_update=50,100", "--seeds", 1, "--num-envs", 2, "--jobs", 1)
    status, out, _ = run(capsys, "sweep", "a2c", *flags, *FLAGS, "--out", folder)
    assert status == 0
    assert "2 of 2 runs done" in out
    assert f"table: {folder / 'sweep.csv'}" in out.replace("\n", "")
    # Whose episode has ended begins the next in place of a step: rollouts end beyond the count.
    assert pd.read_csv(folder / "runs.csv")["env_steps"].between(300, 302).all()
    table = (folder / "sweep.csv").read_bytes()
    (folder / "sweep.csv").unlink()
    assert run(capsys, "report", folder)[0] == 0
    assert (folder / "sweep.csv").read_bytes() == table
    for flags, sentence in (
        (["a2c"], f"is finished; show it with: rotorgram report {folder}"),
        (["vpg"], f"resume: expected a sweep of vpg, {folder} holds one of a2c"),
        (["a2c", "--seeds", "2"], f"resume: expected the settings of {folder}, got others by --s"),
        (["a2c", "--grid", "gamma=1"], f"the settings of {folder}, got others by --grid"),
    ):
        status, _, err = run(capsys, "sweep", *flags, "--resume", folder)
        assert (status, sentence in err) == (1, True)


def test_ctrl_c_keeps_what_is_done(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    flags = ["--grid", "gamma=0.9,0.99", "--seeds", "2", "--jobs", "1", *FLAGS]
    flags[flags.index("--env-steps") + 1] = "2000"
    process = subprocess.Popen(
        [sys.executable, "-m", "rotorgram.cli", "sweep", "vpg", *flags, "--out", str(folder)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 60
        while not (folder / "runs.csv").exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=20)
    finally:
        process.kill()
    assert (process.returncode, err) == (130, "rotorgram: interrupted\n")
    assert f"go on with: rotorgram sweep vpg --resume {folder}\n" in out
    kept = (folder / "runs.csv").read_text()
    assert 2 <= len(kept.splitlines()) < 5
    assert run(capsys, "report", folder)[0] == 0
    assert run(capsys, "sweep", "vpg", "--resume", folder)[0] == 0
    whole = (folder / "runs.csv").read_text()
    assert whole.startswith(kept)
    assert len(whole.splitlines()) == 5
