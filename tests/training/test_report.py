"""The files, the figures, the table and the report of a comparison, on small made-up folders."""

import json
import re
from io import StringIO

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from comparisons import GATES, HEADLINE, spec_of, synthetic_folder
from rich.console import Console
from rotorgram.flights.palette import agent_color, agent_label, sort_agents
from rotorgram.training.figures import FIGURE_FILES, draw_figures, make_curves
from rotorgram.training.metrics import Headline
from rotorgram.training.report import (
    VIDEO_FILE,
    headings,
    result_rows,
    table_note,
    table_of,
    terminal_table,
    write_report,
)
from rotorgram.training.results import (
    EVALUATION_COLUMNS,
    ResultsError,
    read_config,
    read_results,
    read_steps,
)


@pytest.fixture(scope="module")
def comparison(tmp_path_factory):
    folder = synthetic_folder(tmp_path_factory.mktemp("comparison") / "results")
    write_report(folder)
    return folder


def test_results_are_read_with_their_types(comparison):
    results = read_results(comparison)
    assert list(results.evaluations.columns) == list(EVALUATION_COLUMNS)
    assert results.evaluations["terminated"].dtype == bool
    assert results.runs["env_steps"].tolist() == [2000] * 9
    assert results.spec == spec_of()
    assert results.headline == HEADLINE
    assert sort_agents(["zeta", "pid", "a2c", "vpg", "a2c"]) == ["vpg", "a2c", "pid", "zeta"]


def test_the_column_of_the_metric_has_its_name_in_every_file(comparison):
    for name in ("episodes.csv", "evaluations.csv"):
        assert "elevation_error" in pd.read_csv(comparison / name, nrows=0).columns
    assert "elevation_error" in pq.read_schema(comparison / "steps.parquet").names
    metric = json.loads((comparison / "config.json").read_text())["spec"]["metrics"][0]
    assert (metric["name"], metric["unit"]) == ("elevation_error", "m")


def test_steps_are_read_by_phase_and_column(comparison):
    training = read_steps(comparison, "elevation_error", "train", ("agent", "step"))
    assert list(training.columns) == ["agent", "step"]
    assert len(training) == 9 * 2000
    assert len(read_steps(comparison, "elevation_error", "evaluation")) == 12 * 3 * 100
    assert read_steps(comparison, "elevation_error", "evaluation")["agent"].dtype == "category"
    assert len(read_steps(comparison, "elevation_error", "nothing")) == 0
    thinned = read_steps(comparison, "elevation_error", "train", max_rows=1000)
    # A thousand of all 21,600 rows, hence 833 of the training's, by chance.
    assert 700 < len(thinned) < 970
    pd.testing.assert_frame_equal(
        thinned, read_steps(comparison, "elevation_error", "train", max_rows=1000)
    )


@pytest.mark.parametrize(
    "name", ["config.json", "episodes.csv", "steps.parquet", "evaluations.csv", "runs.csv"]
)
def test_a_missing_file_is_named(tmp_path, name):
    folder = synthetic_folder(tmp_path, agents=("a2c",), seeds=1, env_steps=300)
    (folder / name).unlink()
    with pytest.raises(ResultsError, match=f"got one without {name}"):
        write_report(folder)


def test_what_is_wrong_in_a_file_is_named(tmp_path):
    folder = synthetic_folder(tmp_path, agents=("a2c",), seeds=1, env_steps=300)
    episodes = pd.read_csv(folder / "episodes.csv")
    episodes.drop(columns=["return", "seed"]).to_csv(folder / "episodes.csv", index=False)
    with pytest.raises(ResultsError, match=r"episodes\.csv lacks the columns seed, return"):
        read_results(folder)
    episodes.assign(length="long").to_csv(folder / "episodes.csv", index=False)
    with pytest.raises(ResultsError, match="cannot be read"):
        read_results(folder)
    (folder / "episodes.csv").write_text("")
    with pytest.raises(ResultsError, match="cannot be read"):
        read_results(folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"spec": {"env_id": 1}}))
    with pytest.raises(ResultsError, match=r"config\.json: spec: expected control_period"):
        read_results(folder)
    (folder / "config.json").write_text('{"preset": ')
    with pytest.raises(ResultsError, match="not JSON"):
        read_config(folder)
    (folder / "config.json").write_text('{"preset": "tuned"}')
    with pytest.raises(ResultsError, match="lacks the keys created, command, seeds"):
        read_config(folder)
    (folder / "steps.parquet").write_text("no steps")
    with pytest.raises(ResultsError, match="not a Parquet file"):
        read_steps(folder, "elevation_error", "train")
    pq.write_table(pa.table({"agent": ["a2c"]}), folder / "steps.parquet")
    with pytest.raises(ResultsError, match="lacks the columns seed, phase"):
        read_steps(folder, "elevation_error", "train")


def test_figures_are_pictures_of_modest_size(comparison):
    paths = [comparison / "figures" / name for name in FIGURE_FILES]
    written = [path.read_bytes() for path in paths]
    results = read_results(comparison)
    draw_figures(comparison, results, make_curves(comparison, results))
    assert [path.read_bytes() for path in paths] == written
    for path in paths:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert 5_000 < path.stat().st_size < 200_000


@pytest.mark.parametrize("dark", [False, True])
def test_every_agent_keeps_its_colour(dark):
    colors = {agent_color(agent, dark) for agent in ("vpg", "a2c", "sb3-a2c", "pid")}
    assert len(colors) == 4
    assert not colors & {agent_color(agent, not dark) for agent in ("vpg", "a2c", "sb3-a2c", "pid")}
    assert agent_color("mine") == agent_color("mine")
    assert agent_label("sb3-a2c") == "SB3 A2C"
    assert agent_label("mine") == "mine"


def test_the_table_and_the_verdicts_are_written_too(comparison):
    table = table_of(read_results(comparison))
    assert table.index.tolist() == ["vpg", "a2c", "sb3-a2c", "pid", "time-optimal"]
    written = pd.read_csv(comparison / "results.csv", index_col="agent")
    pd.testing.assert_frame_equal(written, table, check_dtype=False, check_index_type=False)
    lines = (comparison / "results.md").read_text(encoding="utf-8").splitlines()
    # Bars inside cells are escaped: every line of the table has the same number of columns.
    assert [len(re.findall(r"(?<!\\)\|", line)) for line in lines[:7]] == [9] * 7
    assert lines[6].startswith("| time-optimal (bound) | – |")
    claims = json.loads((comparison / "claims.json").read_text(encoding="utf-8"))
    assert len(claims) == 5
    assert set(claims[0]) == {"claim", "source", "preset", "verdict", "definition", "evidence"}
    assert [claim["preset"] for claim in claims] == ["tuned"] * 5


def test_a_report_from_results_at_hand_is_the_same(comparison):
    page = comparison / "report.html"
    before = page.read_bytes()
    assert write_report(comparison, read_results(comparison)) == page
    assert page.read_bytes() == before


def test_the_page_shows_the_film_where_there_is_one(tmp_path):
    folder = synthetic_folder(tmp_path, agents=("a2c",), seeds=1, env_steps=300)
    assert "<video" not in write_report(folder).read_text(encoding="utf-8")
    (folder / VIDEO_FILE).write_bytes(b"film")
    page = write_report(folder).read_text(encoding="utf-8")
    assert 'src="data:video/mp4;base64,ZmlsbQ=="' in page


def test_a_task_of_another_kind_is_not_judged_by_the_papers_claims(tmp_path):
    folder = synthetic_folder(tmp_path, agents=("vpg", "a2c"), seeds=2, env_steps=300)
    config = json.loads((folder / "config.json").read_text())
    spec = json.loads(spec_of(GATES).to_json()) | {"env_id": "mine/Race-v0"}
    (folder / "config.json").write_text(json.dumps(config | {"spec": spec}))
    for name in ("episodes.csv", "evaluations.csv"):
        frame = pd.read_csv(folder / name).rename(columns={"elevation_error": "gates_passed"})
        frame.to_csv(folder / name, index=False)
    steps = pq.read_table(folder / "steps.parquet")
    names = [n.replace("elevation_error", "gates_passed") for n in steps.column_names]
    pq.write_table(steps.rename_columns(names), folder / "steps.parquet")
    page = write_report(folder).read_text(encoding="utf-8")
    claims = json.loads((folder / "claims.json").read_text(encoding="utf-8"))
    assert [claim["source"] for claim in claims] == ["A claim of this software, not of the paper"]
    assert "Agents on mine/Race-v0" in page
    assert "Seeds that hold gates_passed ≥ 3" in page
    assert "|E|" not in page


@pytest.mark.parametrize(
    ("annealed", "sentence"),
    [
        (("vpg", "a2c"), "the learning rate of VPG and A2C falls to 0 over the run"),
        (("a2c",), "the learning rate of A2C falls to 0 over the run"),
        ((), None),
    ],
)
def test_the_report_names_the_preset_and_an_annealed_learning_rate(tmp_path, annealed, sentence):
    folder = synthetic_folder(tmp_path, agents=("vpg", "a2c"), seeds=1, env_steps=300)
    config = read_config(folder)
    for name, settings in config["agents"].items():
        settings["anneal"] = name in annealed
    (folder / "config.json").write_text(json.dumps(config | {"preset": "mine"}))
    text = write_report(folder).read_text(encoding="utf-8")
    assert text.count("Judged with the preset “mine”.") == 5
    if sentence is None:
        assert "falls to 0" not in text
    else:
        assert sentence in text


def results_of(**changes: float) -> pd.DataFrame:
    row = dict.fromkeys(("seeds", "episodes", "settled", "reached"), 10) | {"crashed": 0}
    row |= {"held": 9, "worst": 0.43}
    for name in ("steady", "settling_time", "overshoot", "return"):
        row |= {name: 1.0, f"{name}_low": 0.5, f"{name}_high": 12.345}
    row |= {"env_steps_to_reach": 1234567.0, "seconds_to_reach": 99.6, "steps_per_second": 2500.4}
    table = pd.DataFrame([row | changes], index=["sb3-a2c"])
    table.index.name = "agent"
    return table


def test_cells_are_honest_about_what_is_missing():
    (row,) = result_rows(results_of(reached=3, settled=7, crashed=2))
    assert row[0] == ("SB3 A2C", ("10 seeds",))
    assert row[1] == ("1.00", ("0.50 to 12.3", "2 of 10 crashed"))
    assert row[2] == ("90 %", ("9 of 10 seeds", "worst 0.43"))
    assert row[3].details == ("0.50 to 12.3", "7 of 10 settled")
    assert row[6] == ("1,234,567", ("3 of 10 seeds", "99.6 s"))
    assert row[7].value == "2,500"
    nothing = dict.fromkeys(("settling_time", "settling_time_low", "settling_time_high"), np.nan)
    (row,) = result_rows(results_of(seeds=1, reached=np.nan, settled=0, held=np.nan, **nothing))
    assert row[2] == ("–", ("worst 0.43",))
    assert row[3] == ("–", ("0 of 10 settled",))
    assert row[6].details == ()
    (bound,) = result_rows(results_of(seeds=0, **{"return": 234.4}))
    assert [cell.value for cell in bound] == ["sb3-a2c", *"––––", "234", *"––"]


def test_headings_and_note_name_the_metric_and_its_unit():
    names = headings(HEADLINE)
    assert names[1:4] == ("Steady |E| (m)", "Seeds that hold |E| < 0.1 m", "Settling to 0.05 m (s)")
    assert "until |E| stays below 0.05 m" in table_note(HEADLINE)
    gates = Headline.of(spec_of(GATES))
    assert headings(gates)[1:3] == ("Steady gates_passed", "Seeds that hold gates_passed ≥ 3")
    assert "Settling:" not in table_note(gates)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0.0, "0"),
        (0.00001234, "1e-05"),
        (0.01234, "0.012"),
        (0.5, "0.50"),
        (3.14159, "3.14"),
        (-27.18, "-27.2"),
        (12345.6, "12,346"),
    ],
)
def test_numbers_are_written_with_the_digits_that_count(value, expected):
    (row,) = result_rows(results_of(overshoot=value))
    assert row[4].value == expected


def test_the_terminal_table_fits_a_hundred_columns():
    wide = {"return": -12345.0, "return_low": -12345.0, "return_high": -11234.0, "crashed": 10}
    wide |= {"steady_low": 0.0123, "steady_high": 0.0456, "overshoot_low": 0.0123}
    buffer = StringIO()
    Console(file=buffer, width=100).print(terminal_table(results_of(**wide), HEADLINE))
    lines = buffer.getvalue().splitlines()
    assert max(len(line) for line in lines) <= 100
    assert "…" not in buffer.getvalue()
    assert any("1,234,567" in line for line in lines)


@pytest.mark.parametrize(
    "options",
    [
        {"agents": ("pid",), "seeds": 2},
        {"agents": ("a2c",), "seeds": 1, "snapshots": 1},
        {"agents": ("vpg", "a2c"), "seeds": 1, "env_steps": 60},
        {"agents": ("vpg", "my [agent]", "pid"), "seeds": 2, "snapshots": 2},
        {"agents": ("vpg", "a2c"), "seeds": 10, "env_steps": 1000},
    ],
    ids=lambda options: f"{len(options['agents'])}x{options['seeds']}",
)
def test_any_selection_gives_a_report(tmp_path, options):
    folder = synthetic_folder(tmp_path, **options)
    text = write_report(folder).read_text(encoding="utf-8")
    assert text.count('<figure class="card chart"') == 6
    # SB3's A2C, with which ours is compared, is in none of them.
    both = {"vpg", "a2c"} <= set(options["agents"])
    assert text.count('<span class="badge not-tested">') == (1 if both else 5)


def test_missing_values_and_crashes_give_a_report(tmp_path):
    folder = synthetic_folder(tmp_path, agents=("vpg", "a2c"), seeds=3)
    evaluations = pd.read_csv(folder / "evaluations.csv")
    evaluations.loc[evaluations["seed"] == 1, ["elevation_error", "overshoot"]] = np.nan
    evaluations.loc[evaluations["agent"] == "a2c", "elevation_error"] = np.nan
    evaluations.assign(settling_time=np.nan, terminated=True).to_csv(
        folder / "evaluations.csv", index=False
    )
    text = write_report(folder).read_text(encoding="utf-8")
    assert "0 of 9 settled" in text
    assert "9 of 9 crashed" in text
    assert "no value" in text
