"""Tables, figures, page and film of a study, on small made-up folders and by hand."""

import base64
import shutil
import tomllib
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from comparisons import ERROR, GATES, spec_of, study_of, synthetic_folder
from rich.console import Console
from rich.markdown import Markdown
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.spec import EnvSpec
from rotorgram.flights.filming import Film, FilmTrack
from rotorgram.flights.palette import agent_label
from rotorgram.models.errors import InputError
from rotorgram.training import films
from rotorgram.training.figures import (
    draw_figures,
    learning_curves,
    row_color,
    trajectories,
    value_fan,
)
from rotorgram.training.report import VIDEO_FILE, judge, write_report
from rotorgram.training.results import COLUMNS, Results, write_config
from rotorgram.training.settings import Row, Study
from rotorgram.training.statistics import share_interval
from rotorgram.training.tables import (
    markdown,
    number_text,
    results_table,
    row_label,
)
from tables import DATA

NAN = np.nan


# ---- tables, by hand


def runs_of(name: str, *steady: float, crashed: int = 0, env_steps: int = 2000) -> pd.DataFrame:
    """The runs of a row: a steady size for each seed, which holds below 0.1."""
    held = [int(one < 0.1) for one in steady]
    env_steps_to_hold = [1000.0 if one else NAN for one in held]
    seconds_to_hold = [2.5 if one else NAN for one in held]
    runs = pd.DataFrame({
        "row": name, "seed": range(len(steady)), "env_steps": env_steps, "seconds": 60.0,
        "steps_per_second": 3000.0, "steady": steady, "settling_time": 1.5, "overshoot": 0.2,
        "return": 200.0, "episodes": 20, "settled": 20, "crashed": crashed, "held": held,
        "env_steps_to_hold": env_steps_to_hold, "seconds_to_hold": seconds_to_hold,
    })  # fmt: skip
    return runs[list(COLUMNS["runs"])]


def made_up(
    folder: Path, study: Study, *runs: pd.DataFrame, spec: EnvSpec | None = None
) -> Results:
    """The folder of a study with these runs."""
    specs = {row.name: spec or spec_of() for row in study.rows}
    write_config(folder, "rotorgram compare", study, specs)
    (folder / "runs").mkdir(exist_ok=True)
    pd.concat(runs).to_parquet(folder / "runs" / "all.parquet")
    return Results.read(folder)


def test_measures_over_seeds(tmp_path: Path) -> None:
    study = study_of(("vpg", "a2c", "pid"), 4)
    of_vpg = runs_of("vpg", 0.025, 0.025, 0.025, 0.9)
    of_a2c = runs_of("a2c", 0.02, 0.03, 0.04, 0.05, crashed=1)
    of_pid = runs_of("pid", 0.01, env_steps=0)
    results = made_up(tmp_path, study, of_vpg, of_a2c, of_pid)
    table = results_table(results)
    assert table.index.tolist() == ["vpg", "a2c", "pid"]
    vpg, a2c, pid = (table.loc[name] for name in table.index)
    # Without the lowest and the highest of four; in 5 % of the resamples three are 0.9, or four.
    assert vpg["steady"] == 0.025
    assert vpg["steady_low"] == 0.025
    assert vpg["steady_high"] == 0.9
    assert vpg["held"] == 3
    assert vpg["worst"] == 0.9
    assert vpg["reached"] == 3
    assert vpg["env_steps_to_hold"] == 1000
    assert vpg["seeds"] == 4
    assert vpg["episodes"] == 80
    assert vpg["settled"] == 80
    assert vpg["crashed"] == 0
    # Crashes per flight: 4 of 80, with Wilson's interval.
    assert a2c["crashed"] == 4
    assert a2c["crash_rate"] == 0.05
    assert (a2c["crash_rate_low"], a2c["crash_rate_high"]) == share_interval(4, 80)
    assert np.isnan(pid["steady_low"])  # one seed has no interval
    assert np.isnan(pid["reached"])  # and no training, nothing to reach
    page = markdown(results, table)
    assert (
        r"| VPG (4 seeds; 2,000 env steps) | 0.025 (0.025 to 0.90; worst 0.90) "
        "| 3 of 4 (30 % to 95 %) | 0 % (0 to 4.58 %; 0 of 80) | 1.50 (1.50 to 1.50; "
        "80 of 80) | 0.20 (0.20 to 0.20) | 200 (200 to 200) | 1,000 (3 of 4; 2.50 s) "
        "| 3,000 |" in page
    )
    assert "| 5.00 % (1.96 to 12.2 %; 4 of 80) |" in page
    assert (
        r"| Agent | Steady \|E\| (m) | Seeds that hold \|E\| < 0.1 m | Crashes per flight |" in page
    )


def test_a_share_of_all_flights_has_wilsons_interval(tmp_path: Path) -> None:  # fault 66
    landed = replace(GATES, name="landed", held=0.75, final=True)
    study = study_of(("a2c",), 3, kind="compare")
    whole = runs_of("a2c", 1.0, 1.0, 1.0)
    table = results_table(made_up(tmp_path, study, whole, spec=spec_of(landed)))
    found = table.loc["a2c", "steady_low"], table.loc["a2c", "steady_high"]
    assert found == share_interval(60, 60)
    # A share of the time, which counts no crash, where all seeds have all of it.
    other = spec_of(replace(landed, final=False))
    table = results_table(made_up(tmp_path, study, whole, spec=other))
    assert table.loc["a2c", "steady_low"] == share_interval(60, 60)[0]
    some = runs_of("a2c", 1.0, 0.9, 0.8)
    table = results_table(made_up(tmp_path, study, some, spec=other))
    assert table.loc["a2c", "steady_low"] == pytest.approx(0.8)


def test_points_of_a_sweep_are_ranked_by_their_worst_seed_and_its_crashes(tmp_path: Path) -> None:
    rows = [Row(agent="a2c", name=f"p{i}", env_steps=400, set={"gamma": 0.9}) for i in range(4)]
    study = Study(rows=tuple(rows), kind="sweep", seeds=3)
    crashes = runs_of("p2", 0.02, 0.01, 0.04).assign(crashed=[2, 0, 0])
    runs = (
        runs_of("p0", 0.01, 0.01, 0.5), runs_of("p1", 0.1, 0.2, 0.3), crashes, runs_of("p3", 0.01)
    )  # fmt: skip
    table = results_table(made_up(tmp_path, study, *runs))
    # Whole points first; of these the fewest crashes of a seed, then the worst seed's error.
    assert table.index.tolist() == ["p1", "p0", "p2", "p3"]
    assert table["most_crashed"].tolist() == [0, 0, 2, 0]
    assert table["worst"].tolist() == [0.3, 0.5, 0.04, 0.01]
    # Of a metric that is to be high, the lowest seed is the worst.
    high = results_table(made_up(tmp_path, study, *runs, spec=spec_of(GATES)))
    assert high["worst"].tolist() == [0.1, 0.01, 0.01, 0.01]


def test_rows_of_several_tasks_have_a_table_each(tmp_path: Path) -> None:
    other = EnvConfig(action="offset", task={"observation": "error"})
    rows = tuple(
        Row(agent=agent, env=env, env_steps=2000)
        for env in (EnvConfig(), other) for agent in ("vpg", "a2c")
    )  # fmt: skip
    study = Study(rows=rows, kind="benchmark", seeds=4)
    runs = [runs_of(row.name, *[0.025] * 4) for row in rows]
    results = made_up(tmp_path, study, *runs)
    page = markdown(results, results_table(results))
    assert "## Elevation-v0\n" in page
    assert "## Elevation-v0 action=offset observation=error\n" in page
    assert page.count("| A2C tuned (4 seeds; 2,000 env steps) |") == 2


MEASURES = tomllib.loads((DATA / "measures.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("value", "text"), MEASURES["texts"])
def test_numbers_in_words(value: float, text: str) -> None:
    assert number_text(value) == text


def test_names_and_colours_of_rows() -> None:
    a2c = Row(agent="a2c", name="a2c")
    assert (row_label(a2c), row_color(a2c)) == ("A2C", "#0072B2")
    assert row_label(Row(agent="sb3-ppo", preset="tuned")) == "SB3 PPO tuned"
    assert row_label(Row(agent="a2c", name="wide")) == "wide"
    assert agent_label("zeta") == "zeta"


# ---- curves, by hand


def test_a_fan_is_of_the_quantiles_of_windows() -> None:
    steps = pd.DataFrame({"step": range(1, 101), "value": [0.0] * 50 + [1.0] * 50})
    fan = value_fan(steps)
    assert fan.index.tolist() == [25.25, 75.75]
    assert fan[0.5].tolist() == [0.0, 1.0]
    assert fan[0.05].iloc[0] == 0.0
    assert fan[0.95].iloc[1] == 1.0


def test_a_trajectory_is_an_episode_of_a_seed() -> None:
    parts = []
    for seed, episode, steps in ((0, 0, 3), (0, 1, 2), (1, 0, 2)):
        one = {"seed": seed, "episode": episode, "step": range(1, steps + 1), "value": 1.0}
        parts.append(pd.DataFrame(one))
    shown = trajectories(pd.concat(parts), 0.5)
    times = sorted(time.tolist() for time, _ in shown)
    assert times == [[0.5, 1.0], [0.5, 1.0], [0.5, 1.0, 1.5]]


def test_learning_curves_are_interquartile_means_of_seeds() -> None:
    rows = [("a2c", seed, steps, float(seed)) for seed in range(3) for steps in (0, 100)]
    rows += [("pid", 0, 0, 0.1)]
    table = pd.DataFrame(rows, columns=["row", "seed", "env_steps", "steady"])
    curves = learning_curves(table, ["a2c", "pid"])
    assert list(curves) == ["a2c"]
    assert curves["a2c"].x.tolist() == [0, 100]
    assert curves["a2c"].middle.tolist() == [1.0, 1.0]
    assert curves["a2c"].low[0] == 0.0
    assert curves["a2c"].high[0] == 2.0


# ---- the page


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = synthetic_folder(tmp_path_factory.mktemp("comparison") / "results")
    (folder / VIDEO_FILE).write_bytes(b"a film")
    write_report(Results.read(folder))
    return folder


def test_the_page_has_figures_tables_and_film_and_no_script(comparison: Path) -> None:
    text = (comparison / "report.html").read_text(encoding="utf-8")
    for name in ("comparison", "fig6_reward", "fig7_cumulative_reward", "fig8_error"):
        picture = (comparison / "figures" / f"{name}.svg").read_bytes()
        assert f"data:image/svg+xml;base64,{base64.b64encode(picture).decode()}" in text
    assert f"data:video/mp4;base64,{base64.b64encode(b'a film').decode()}" in text
    assert "<script" not in text
    # The command has signs of HTML in it.
    assert "rotorgram compare --seeds 3 &lt;folder&gt;" in text
    assert text.count("<tr") == 5  # a head and four agents
    assert "It gives no numbers." in text
    assert "<td>PID (3 seeds)</td>" in text


def test_figures_are_written_in_three_formats_and_always_the_same(comparison: Path) -> None:
    results = Results.read(comparison)
    names = draw_figures(results, results_table(results))
    for name in names:
        for kind, magic in (("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")):
            content = (comparison / "figures" / f"{name}.{kind}").read_bytes()
            assert content.startswith(magic)
            assert len(content) < 1_000_000


def test_a_study_without_its_steps_has_no_figure_of_them(comparison: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(comparison, tmp_path / "small")  # as docs/results has them
    shutil.rmtree(folder / "steps")
    results = Results.read(folder)
    drawn = draw_figures(results, results_table(results))
    assert drawn == ["comparison", "fig6_reward", "fig7_cumulative_reward"]


def test_verdicts_and_tables_are_files(comparison: Path) -> None:
    verdicts = judge(Results.read(comparison))
    assert len(verdicts) == 5
    assert {one.verdict for one in verdicts} == {"undecided"}  # three seeds decide nothing
    rows = pd.read_csv(comparison / "results.csv")["row"].tolist()
    assert rows == ["vpg", "a2c", "sb3-a2c", "pid"]
    runs = pd.read_csv(comparison / "runs.csv")
    assert runs["row"].unique().tolist() == rows
    assert len(runs) == 12
    text = (comparison / "results.md").read_text(encoding="utf-8")
    assert text.startswith("# Results\n\n```sh\nrotorgram compare --seeds 3 <folder>\n```\n")
    assert "Seeds 0 to 2; 67 evaluation episodes each;" in text
    assert "Fewer than five seeds decide nothing." in text
    assert text.count("**undecided**: ") == 5
    assert text.count("; preset tuned.)") == 5


def test_the_terminal_shows_the_table_in_a_hundred_columns(comparison: Path) -> None:
    results = Results.read(comparison)
    stream = StringIO()
    text = markdown(results, results_table(results))
    Console(file=stream, width=100).print(Markdown(text))
    lines = stream.getvalue().splitlines()
    assert max(map(len, lines)) <= 100
    assert any(line.startswith(" SB3 A2C ") for line in lines)


def test_a_study_of_which_nothing_is_done_has_an_empty_report(tmp_path: Path) -> None:
    study = study_of(("a2c",), 3)
    write_config(tmp_path, "rotorgram compare", study, {"a2c": spec_of()})
    assert write_report(Results.read(tmp_path)).empty
    assert "3 of 3 runs are missing." in (tmp_path / "results.md").read_text()


# ---- several drones in a world


@pytest.fixture(scope="module")
def swarm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of worlds of two drones, with agents that were compared."""
    env = EnvConfig(env_id="rotorgram/Formation-v0", drones=2, vehicle="crazyflie2")
    rows = tuple(Row(agent=agent, name=agent, env=env) for agent in ("ippo", "mappo"))
    study = Study(rows=rows, seeds=2)
    folder = synthetic_folder(tmp_path_factory.mktemp("swarm") / "results", study=study)
    write_report(Results.read(folder))
    return folder


def test_only_the_papers_comparison_has_claims_and_its_figures(swarm: Path) -> None:
    text = (swarm / "results.md").read_text(encoding="utf-8")
    assert "Claims" not in text
    assert [path.name for path in (swarm / "figures").glob("*.svg")] == ["comparison.svg"]


def test_the_film_shows_the_first_seed_of_each_row(
    swarm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filmed: list[object] = []

    def film(path: Path, tracks: list[FilmTrack], config: Film, _: object) -> None:
        path.touch()
        filmed.extend((shot.name, shot.drones) for shot in tracks)
        filmed.append(config.camera)

    monkeypatch.setattr(films, "film", film)
    monkeypatch.setattr(films, "load", lambda path: filmed.append(path.name) or FakePolicy)
    monkeypatch.setattr(films, "flown_trajectories", lambda *_, **__: [])
    results = Results.read(swarm)
    films.film_study(results, tmp_path / "film.mp4")
    files = ["ippo-seed0.safetensors", "mappo-seed0.safetensors"]
    assert filmed == [*files, ("IPPO, seed 0", 2), ("MAPPO, seed 0", 2), "top"]


class FakePolicy:
    """A checkpoint."""

    @staticmethod
    def policy() -> None:
        return None


def test_a_film_is_of_one_task(tmp_path: Path) -> None:
    other = EnvConfig(action="offset")
    rows = (Row(agent="pid", name="a"), Row(agent="pid", name="b", env=other))
    results = made_up(tmp_path, Study(rows=rows, seeds=1), runs_of("a", 0.1))
    with pytest.raises(InputError, match="film: expected rows of one task"):
        films.film_study(results, tmp_path / "film.mp4")


def test_a_headline_without_a_bound_holds_nothing(tmp_path: Path) -> None:
    spec = spec_of(replace(ERROR, held=None, settled=None))
    results = made_up(tmp_path, study_of(("a2c",), 2), runs_of("a2c", 0.1, 0.2), spec=spec)
    page = markdown(results, results_table(results))
    assert "| Seeds that hold | " in page
    assert "| – |" in page
