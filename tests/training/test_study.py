"""A study: its runs, what it keeps when it is stopped, resuming, and wrong input."""

import json
import os
import signal
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import WRONG, Capsys, output, refused, run, start, wait_until, words_of
from comparisons import synthetic_folder
from rotorgram.agents import load, preset
from rotorgram.cli._parser import parse
from rotorgram.cli.compare import Compare
from rotorgram.cli.sweep import Sweep, parse_grid
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig, SceneConfig
from rotorgram.flights.executors import RunsFailed, WorkersConfig
from rotorgram.flights.folders import locked
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.models.errors import InputError
from rotorgram.training.metrics import measure_episode
from rotorgram.training.results import Results, checkpoint_file
from rotorgram.training.settings import BOARD, Row, Study
from rotorgram.training.study import open_env, run_study

SWARMS = Path(__file__).parents[2] / "studies" / "swarms.toml"
ENV = EnvConfig(episode_length=40, task={"flight_band": 1.2})
A2C = Row(agent="a2c", name="a2c", env=ENV, env_steps=600, set={"steps_per_update": 64})
STUDY = Study(
    rows=(A2C, Row(agent="pid", name="pid", env=ENV)),
    seeds=2, snapshots=2, curve_episodes=2, episodes=3, keep_steps=True,
)  # fmt: skip
ONE = WorkersConfig(jobs=1)
DATA = Path(__file__).parents[1] / "data"
COMMITTED = Path(__file__).parents[2] / "docs" / "results" / "baselines"
TIMES = ["seconds", "steps_per_second", "seconds_to_hold"]
FLAGS = ("--env-steps", "300", "--episodes", "1", "--episode-length", "40", "--no-film")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study")
    run_study(STUDY, path, ONE, "rotorgram compare")
    return path


# ---- runs


def test_a_run_is_what_its_checkpoint_flies_from_starts_of_its_seed(folder: Path) -> None:
    results = Results.read(folder)
    assert results.study == STUDY
    runs = list(zip(results.runs["row"], results.runs["seed"], strict=True))
    assert runs == [("a2c", 0), ("a2c", 1), ("pid", 0), ("pid", 1)]
    policy = load(checkpoint_file(folder, A2C, 1)).policy()
    headline = results.headline(A2C)
    with closing(LocalVectorEnv(ENV, 3, autoreset_mode="Disabled")) as env:
        flown = fly_episodes(env, policy, 3, "final", training_seed=1)
        others = fly_episodes(env, policy, 3, "final", training_seed=0)
    rows = [measure_episode(one, headline) for one in flown]
    found = results.runs.iloc[1]
    assert found["steady"] == np.mean([row["steady"] for row in rows])
    assert found["return"] == pytest.approx(np.mean([row["return"] for row in rows]), rel=1e-12)
    assert found["env_steps"] == 600
    assert found["episodes"] == 3
    assert found["steps_per_second"] == pytest.approx(600 / found["seconds"])
    # The other seed's starts are others.  # fault 41
    assert all(a.headline[0] != b.headline[0] for a, b in zip(flown, others, strict=True))


def test_tables_flies_two_hundred_times_or_more() -> None:  # fault 41
    for seeds, episodes in ((1, 200), (5, 40), (7, 29), (10, 20), (30, 20)):
        assert Study(rows=(A2C,), seeds=seeds).episodes == episodes


def test_files_hold_settings_software_and_every_step(folder: Path) -> None:
    assert sorted(p.name for p in folder.iterdir()) == [
        ".lock", "checkpoints", "config.json", "episodes", "evaluations", "runs", "steps",
    ]  # fmt: skip
    content = json.loads((folder / "config.json").read_text())
    assert content["command"] == "rotorgram compare"
    assert content["versions"]["mujoco"].startswith("4.")
    assert len(content["specs"]["a2c"]["vehicle_hash"]) == 32
    results = Results.read(folder)
    training = results.steps("train")
    for seed in (0, 1):
        own = training[training["seed"] == seed]
        assert own["step"].tolist() == list(range(1, 601))
    # Two snapshots and the untrained policy on two episodes each, the last on three.
    evaluations = results.evaluations[results.evaluations["row"] == "a2c"]
    assert evaluations.groupby(["seed", "env_steps"]).size().iloc[-1] == 3
    flown = results.evaluations[results.evaluations["row"] == "pid"]
    steps = results.steps("evaluation")
    assert (steps["row"] == "pid").sum() == flown["length"].sum()


def test_two_rows_with_the_same_files_are_refused() -> None:
    rows = Row(agent="pid", name="x 1/2"), Row(agent="pid", name="X 1:2")
    with pytest.raises(InputError, match=r"^row: expected each row once, got x-1-2 twice as a"):
        Study(rows=rows)


def test_over_the_wire_the_numbers_are_those_in_process(folder: Path, tmp_path: Path) -> None:
    study = replace(STUDY, wire=True, seeds=1)
    run_study(study, tmp_path, workers=ONE)
    own = Results.read(tmp_path)
    other = Results.read(folder)
    for name in ("runs", "evaluations", "episodes"):
        table = getattr(other, name)
        expected = table[table["seed"] == 0].reset_index(drop=True)
        clocks = [name for name in table if "seconds" in name or name in TIMES]
        pd.testing.assert_frame_equal(
            getattr(own, name).drop(columns=clocks),
            expected.drop(columns=clocks),
            check_exact=True,
        )


def test_all_rows_fly_with_a_seed_before_the_next() -> None:
    names = ["a2c seed 0", "pid seed 0", "a2c seed 1", "pid seed 1"]
    assert list(STUDY.runs()) == names


@pytest.mark.parametrize("work", ["fresh", "resumed"])
def test_a_folder_is_written_by_one_process(work: str, tmp_path: Path) -> None:
    if work == "resumed":
        synthetic_folder(tmp_path, ("a2c",), 1, 300)
    before = {path.name for path in tmp_path.iterdir()}
    busy = pytest.raises(InputError, match="expected a folder that no other process writes to")
    with locked(tmp_path), busy:
        run_study(STUDY, tmp_path, workers=ONE)
    assert {path.name for path in tmp_path.iterdir()} == before | {".lock"}


def test_a_run_that_fails_is_named_and_the_others_are_kept(tmp_path: Path, capsys: Capsys) -> None:
    # Adam's step is as large as the learning rate: the second update overflows.
    folder = tmp_path / "out"
    flags = ("--grid", "learning_rate=0.01,1e29", "--seeds", 1, *FLAGS, "--jobs", 1)
    status, out, err = run(capsys, "sweep", "a2c", *flags, "--out", folder)
    assert status == 1
    assert err.startswith("rotorgram: 1 of 2 runs failed: learning_rate=1e+29 seed 1000: ")
    assert err.count("\n") == 1
    assert f"go on with: rotorgram sweep a2c --resume {folder}" in out
    assert "1 of 2 runs done" in out
    assert pd.read_csv(folder / "results.csv")["row"].tolist() == ["learning_rate=0.01"]
    study = Results.read(folder).study
    with pytest.raises(RunsFailed, match=r"1 of 1 runs failed: learning_rate=1e\+29 seed 1000"):
        run_study(study, folder, workers=ONE)
    assert len(Results.read(folder).runs) == 1


def test_ctrl_c_keeps_what_is_done(tmp_path: Path, capsys: Capsys) -> None:
    folder = tmp_path / "out"
    flags = ["--grid", "gamma=0.9,0.99", "--seeds", "2", "--jobs", "1", *FLAGS]
    flags[flags.index("--env-steps") + 1] = "4000"
    process = start("sweep", "vpg", *flags, "--out", folder)
    try:
        wait_until(lambda: list(folder.glob("runs/gamma*")), process)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 130
    assert err == "rotorgram: interrupted\n"
    assert f"go on with: rotorgram sweep vpg --resume {folder}\n" in out
    kept = Results.read(folder).runs
    assert 1 <= len(kept) < 4
    output(capsys, "report", folder)
    output(capsys, "sweep", "vpg", "--resume", folder, "--jobs", 1)
    whole = Results.read(folder).runs
    assert len(whole) == 4
    merged = whole.merge(kept)  # the same bits, times too
    assert len(merged) == len(kept)
    resume = ("--resume", folder)
    for words, sentence in (
        (("sweep", "vpg", *resume, "--seeds", 3), "got others by --seeds"),
        (("compare", *resume), "expected a folder of rotorgram compare"),
    ):
        assert sentence in refused(capsys, *words)


# ---- rows and files


def test_two_files_are_rows_of_their_names(tmp_path: Path, capsys: Capsys) -> None:
    text = 'agent = "a2c"\nenv_steps = 300\nset = {{ hidden = {} }}\n[env]\nepisode_length = 40\n'
    for name, hidden in (("a", "[8]"), ("b", "[8, 8]")):
        (tmp_path / f"{name}.toml").write_text(text.format(hidden))
    files = [tmp_path / "a.toml", tmp_path / "b.toml"]
    flags = ("--seeds", 2, "--episodes", 2, "--snapshots", 1, "--jobs", 1, "--no-film")
    more = ("--set", "gamma=0.9", "--env.flight-band", "1.5", "--out", tmp_path / "out")
    output(capsys, "compare", *files, *flags, *more)
    results = Results.read(tmp_path / "out")
    assert [row.name for row in results.study.rows] == ["a", "b"]
    assert [row.config.hidden for row in results.study.rows] == [(8,), (8, 8)]
    for row in results.study.rows:
        assert row.config.gamma == 0.9
        assert row.env.task["flight_band"] == 1.5
        assert row.env.episode_length == 40
    assert not results.study.wire
    words = ["--udp", *map(str, files)]
    assert parse(Compare, "rotorgram compare", words).study().wire
    figures = {path.name for path in (tmp_path / "out" / "figures").iterdir()}
    assert figures == {"comparison.png", "comparison.pdf", "comparison.svg"}


def test_a_study_is_read_back_from_its_json() -> None:
    for study in (STUDY, Study.from_toml(BOARD), Study.from_toml(SWARMS)):
        content = json.loads(json.dumps(study.to_dict()))
        assert Study.from_dict("here", content) == study


OWN_TASK = """
import rotorgram.envs
from rotorgram.envs.tasks.hover import Hover

class Near(Hover):
    pass

rotorgram.envs.register("Near-v0", Near)
"""


def test_a_board_takes_own_tasks_and_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:  # fault 60
    monkeypatch.chdir(tmp_path)
    (tmp_path / "near_task.py").write_text(OWN_TASK)
    (tmp_path / "rows.toml").write_text(
        '[[row]]\nagent = "ppo"\nenv_steps = 4096\nnum_envs = 4\n'
        'env = { env_id = "near_task:Near-v0", episode_length = 20 }\n'
        '[[row]]\nagent = "geometric"\n'
        'env = { env_id = "near_task:Near-v0", episode_length = 20 }\n'
    )
    flags = ("--set", "steps_per_update=256", "--seeds", 2, "--episodes", 2, "--snapshots", 1)
    status, out, err = run(capsys, "benchmark", "rows.toml", *flags, "--jobs", 2, "--out", "o")
    assert status == 0, err
    assert "4 of 4 runs done" in out
    page = (tmp_path / "o" / "results.md").read_text()
    assert "| PPO tuned steps_per_update=256 (2 seeds; 4,096 env steps) |" in page
    assert "| Geometric (2 seeds) |" in page


CONTROLLER = """
import numpy as np

class Falls:
    options = {}

    def __init__(self, spec):
        self.action = np.full(spec.action.shape, spec.action.low)

    def reset(self):
        pass

    def act(self, observation):
        return self.action
"""


def test_a_study_goes_on_with_the_code_that_it_began_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    texts = {"falls.py": CONTROLLER, "heavy_task.py": OWN_TASK.replace("Near", "Heavy")}
    for file, text in texts.items():
        (tmp_path / file).write_text(text)
    settings = ("--env", "heavy_task:Heavy-v0", "--no-udp", "--seeds", 2, "--episodes", 1)
    more = ("--episode-length", 5, "--jobs", 1, "--no-film")
    output(capsys, "compare", "--agents", "falls.py:Falls", *settings, *more, "--out", "out")
    content = json.loads((tmp_path / "out" / "config.json").read_text())
    assert len(content["sources"]["falls"]) == 32
    (tmp_path / "out" / "runs" / "falls-seed1.parquet").unlink()
    words = {"falls.py": "falls.py:Falls", "heavy_task.py": "task, vehicle or scene"}
    for file, changed in words.items():
        (tmp_path / file).write_text(texts[file] + "# another\n")
        status, out, err = run(capsys, "compare", "--resume", "out")
        assert (status, out) == (1, "")
        sentence = f"resume: falls: expected the {changed} with which out began, got another"
        assert err == f"rotorgram: {sentence}\n"
        (tmp_path / file).write_text(texts[file])
    assert "2 of 2 runs done" in output(capsys, "compare", "--resume", "out", "--no-film")


def test_a_controller_brings_its_options_and_stands_in_the_table_of_its_task() -> None:
    hover = EnvConfig(env_id="rotorgram/Hover-v0", episode_length=9)
    row = Row(agent="geometric", env=hover)
    assert row.env.action == "position"
    assert row.env.episode_length == 9
    assert row.name == "geometric Hover-v0 episode_length=9"
    assert row.task == Row(agent="ppo", env=hover, env_steps=41_000).task
    velocity = EnvConfig(env_id="rotorgram/Hover-v0", action="velocity")
    assert Row(agent="geometric", env=velocity).task == "Hover-v0 action=velocity"


def test_a_row_trains_on_the_backend_of_its_preset_or_its_own() -> None:
    hover = EnvConfig(env_id="rotorgram/Hover-v0")
    row = Row(agent="ppo", env=hover)
    assert row.run(0).env.backend.name == "rigid"
    assert row.env.backend.name == "mujoco"
    assert Row(agent="ppo", env=hover, backend="mujoco").run(0).env.backend.name == "mujoco"
    forest = EnvConfig(env_id="rotorgram/Forest-v0")
    assert Row(agent="geometric", env=forest).env.backend.name == "rigid"
    assert Row(agent="a2c", env=forest).run(0).env.backend.name == "rigid"  # without a preset
    on_mujoco = Row(agent="ppo", env=forest.changed(backend="mujoco"))
    assert on_mujoco.env.backend.name == "mujoco"
    assert on_mujoco.run(0).env.backend.name == "rigid"
    assert Row.from_dict("here", json.loads(json.dumps(on_mujoco.to_dict()))) == on_mujoco
    with pytest.raises(InputError, match=r"ppo tuned Hover-v0: env_steps: expected at least"):
        Row(agent="ppo", env=hover, env_steps=100)


def test_a_row_keeps_all_of_its_env_or_refuses_it() -> None:
    with pytest.raises(InputError, match=r"^env: expected the backend mujoco, .*, got rigid$"):
        Row(agent="ppo", env=EnvConfig.from_keywords(backend="rigid"))
    env = EnvConfig.from_keywords(scene="forest:3", num_threads=2, vehicle="crazyflie2")
    row = Row(agent="pid", env=env)
    assert row.env.scene == SceneConfig(name="forest", seeds=(3,))
    assert row.env.backend.num_threads == 2
    content = json.loads(json.dumps(row.to_dict()))
    assert Row.from_dict("here", content) == row


def test_whole_worlds_train_a_swarm() -> None:
    words = ["--env", "rotorgram/Crossing-v0", "--drones", "4", "--agents", "ippo"]
    for more, count in (([], 4), (["--num-envs", "8"], 8)):
        study = parse(Compare, "rotorgram compare", [*words, *more]).study()
        assert study.rows[0].num_envs == count


def test_without_files_it_is_the_papers_comparison_over_udp() -> None:
    study = parse(Compare, "rotorgram compare", ["--set", "hidden=[32,32]"]).study()
    assert [row.name for row in study.rows] == ["vpg", "a2c", "sb3-a2c", "pid"]
    assert (study.kind, study.wire, study.keep_steps, study.seeds) == ("paper", True, True, 5)
    assert {row.env_steps for row in study.rows[:3]} == {200_000}
    assert study.rows[0].config == preset("vpg", "tuned", hidden=(32, 32))
    here = parse(Compare, "rotorgram compare", ["--no-udp"]).study()
    assert (here.kind, here.wire) == ("paper", False)


# ---- the grid


def test_the_grid_is_read_by_name_in_json() -> None:  # fault 60
    assert parse_grid(
        ["learning_rate=0.01,1e-3", "anneal=true,False", "baseline=none,time",
         "hidden=[64,64],[32]", "env.start_band=0.5,2"]
    ) == {
        "learning_rate": (0.01, 0.001),
        "anneal": (True, False),
        "baseline": ("none", "time"),
        "hidden": ([64, 64], [32]),
        "env.start_band": (0.5, 2),
    }  # fmt: skip


def test_points_are_all_combinations_of_settings_and_task_options() -> None:
    words = ["ppo", "--env", "rotorgram/Hover-v0", "--set", "gamma=0.9"]
    grid = ["--grid", "hidden=[64,64],[32]", "--grid", "env.start-band=0.5,1"]
    study = parse(Sweep, "rotorgram sweep", [*words, *grid]).study()
    found = [(row.config.hidden, row.env.task["start_band"]) for row in study.rows]
    assert found == [((64, 64), 0.5), ((64, 64), 1), ((32,), 0.5), ((32,), 1)]
    assert study.rows[0].name == "hidden=[64,64] env.start-band=0.5"
    assert study.first_seed == 1000
    assert study.seeds == 3
    assert study.evaluation == "tuning"
    assert study.rows[3].config.gamma == 0.9


@pytest.mark.parametrize(("line", "sentence"), WRONG["sweep"])
def test_wrong_input_is_one_sentence(
    line: str, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    assert sentence in refused(capsys, "sweep", "a2c", *words_of(line), silent=True)
    assert not list(tmp_path.iterdir()), "nothing has flown"


@pytest.mark.parametrize(("text", "sentence"), WRONG["rows"])
def test_wrong_files_are_one_sentence(text: str, sentence: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.toml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        Study.from_toml(path)
    assert sentence in str(error.value)
    assert "\n" not in str(error.value)


# ---- files of results


def test_results_that_are_wrong_are_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected the folder of a study, .*config\.json$"):
        Results.read(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(InputError, match="expected the settings of a study"):
        Results.read(tmp_path)


def test_a_table_that_is_no_table_is_one_sentence(tmp_path: Path) -> None:
    folder = synthetic_folder(tmp_path, ("a2c",), 1, 300)
    for name in ("runs", "evaluations"):
        (file,) = (folder / name).iterdir()
        file.write_text("nothing")
        with pytest.raises(InputError, match=f"{name}: expected Parquet files"):
            getattr(Results.read(folder), name)
        pd.DataFrame({"row": ["a2c"]}).to_parquet(file)
        with pytest.raises(InputError, match=rf"{name}: expected the columns .*, got no seed, "):
            getattr(Results.read(folder), name)


# ---- what is committed


def test_our_own_rows_are_right() -> None:
    study = Study.from_toml(BOARD)
    assert {"vpg", "a2c", "sb3-a2c", "pid"} <= {row.agent for row in study.rows}
    swarms = Study.from_toml(SWARMS)
    assert swarms.seeds == 5
    assert {row.env.drones for row in swarms.rows} == {2, 4, 8}
    assert {"ippo", "mappo", "sb3-ppo", "examples/orca.py:Orca"} == {
        row.agent for row in swarms.rows
    }


def test_the_committed_policies_fly_the_committed_numbers() -> None:
    results = Results.read(COMMITTED)
    seed = results.study.first_seed
    trained = [row for row in results.study.rows if not row.controller]
    files = {row.name: checkpoint_file(COMMITTED, row, seed) for row in trained}
    assert {*files.values()} == set((COMMITTED / "checkpoints").iterdir())
    runs = results.runs[results.runs["seed"] == seed].set_index("row")
    for row in trained:
        policy = load(files[row.name]).policy()
        count = results.study.episodes
        with open_env(False, row.env, count) as env:
            flown = fly_episodes(env, policy, count, "final", training_seed=seed)
        measured = [measure_episode(one, results.headline(row)) for one in flown]
        found = {
            name: float(np.mean([one[name] for one in measured])) for name in ("steady", "return")
        }
        flown_before = runs.loc[row.name, ["steady", "return"]].to_dict()
        # Another processor may round otherwise: a policy that fails from one start of twenty, or
        # ends elsewhere, may then differ by a twentieth.
        assert found == pytest.approx(flown_before, rel=0.05, abs=2e-3), row.name
