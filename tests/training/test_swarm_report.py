"""Distances between the drones of a world, and the report of a comparison of several drones."""

import base64
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from comparisons import HEADLINE, PERIOD, spec_of, synthetic_folder
from rotorgram.cli import main
from rotorgram.flights.distances import least, nearest
from rotorgram.flights.filming import Film, Shot
from rotorgram.flights.trajectories import Trajectory
from rotorgram.training import films
from rotorgram.training.compare import read_compare_config
from rotorgram.training.figures import SWARM_FIGURE, pick_trajectories
from rotorgram.training.metrics import shown_runs
from rotorgram.training.report import headings, result_rows, table_of, write_report
from rotorgram.training.results import POSITION_SCHEMA, ResultsError, read_results
from rotorgram.training.swarms import (
    GOAL,
    POSITION,
    distance_curves,
    least_distances,
    rows_of,
    worlds,
)

NAN = np.nan


def line(*xs: float) -> np.ndarray:
    """Positions of drones on a line along X, shape (1, A, 3)."""
    return np.array([[(x, 10.0, 0.0) for x in xs]])


def test_the_nearest_other_of_each_drone_that_flies() -> None:
    assert nearest(line(0.0, 3.0, 4.0)).tolist() == [[3.0, 1.0, 1.0]]
    assert least(line(0.0, 3.0, 4.0)).tolist() == [1.0]
    assert nearest(np.array([[(0.0, 0.0, 0.0), (2.0, 3.0, 6.0)]])).tolist() == [[7.0, 7.0]]
    np.testing.assert_array_equal(nearest(line(0.0, 3.0, NAN)), [[3.0, 3.0, NAN]])
    np.testing.assert_array_equal(nearest(line(0.0, NAN, NAN)), [[NAN, NAN, NAN]])
    np.testing.assert_array_equal(least(line(0.0, NAN)), [NAN])


def positions(*episodes: list[list[float]], agent: str = "ippo", seed: int = 0) -> pd.DataFrame:
    """Rows of episodes, of each drone its X after each step; the goals are at X = 5 m."""
    rows = [
        {"agent": agent, "seed": seed, "episode": episode, "drone": drone, "step": step}
        | dict(zip((*POSITION, *GOAL), (x, 10.0, 0.0, 5.0, 10.0, 0.0), strict=True))
        for episode, world in enumerate(episodes)
        for drone, xs in enumerate(world)
        for step, x in enumerate(xs)
    ]
    return pd.DataFrame(rows)


def test_distances_over_time_are_of_the_drones_that_still_fly() -> None:
    rows = positions([[0.0, 0.0, 0.0], [4.0, 3.0]], [[0.0, 0.0], [2.0, 5.0]])
    curve = distance_curves(rows, 0.5)["ippo"]
    assert curve.x.tolist() == [0.0, 0.5]  # at 1 s one drone is left
    assert curve.middle.tolist() == [3.0, 4.0]
    assert (curve.low.tolist(), curve.high.tolist()) == ([2.0, 3.0], [4.0, 5.0])
    assert distance_curves(positions([[0.0]]), 0.5) == {}


def test_the_least_distance_is_that_of_all_episodes_of_a_seed() -> None:
    rows = [positions([[0.0, 0.0], [4.0, 3.0]], [[0.0, 0.0], [2.0, 5.0]])]  # at the least 2 m
    rows += [positions([[0.0], [4.0]], seed=1), positions([[0.0], [7.0]], agent="orca")]
    table = least_distances(pd.concat(rows))
    assert table["least_distance"].to_dict() == {"ippo": 3.0, "orca": 7.0}
    assert table.loc["ippo", "least_distance_low"] == 2.0
    assert np.isnan(table.loc["orca", "least_distance_low"])  # one seed has no interval


def test_rows_of_trajectories_give_the_worlds_back() -> None:
    spec = spec_of()
    spec = type(spec)(**(vars(spec) | {"agents": ("drone_0", "drone_1")}))

    def flown(*xs: float) -> Trajectory:
        where = np.array([(x, 10.0, 1.0) for x in xs])
        told = {"position": where, "goal": where + 1.0}
        steps = len(xs) - 1
        return Trajectory(spec=spec, telemetry=told, rewards=np.zeros(steps),
                          actions=np.zeros((steps, 1)), ending="terminated", episode=7)  # fmt: skip

    rows = rows_of([flown(0.0, 1.0, 2.0), flown(4.0, 5.0)]).assign(agent="ippo", seed=3)
    ((key, world),) = worlds(rows)
    assert key == ("ippo", 3, 7)
    np.testing.assert_array_equal(world.position[:, 0, 0], [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(world.position[:, 1, 0], [4.0, 5.0, NAN])
    assert world.goal[1, 1].tolist() == [6.0, 11.0, 2.0]


def test_drones_of_an_episode_are_trajectories_of_their_own() -> None:
    flights = [(0, 0, 3), (0, 0, 2), (0, 1, 2), (0, 1, 2)]  # seed, episode, steps
    parts = [
        pd.DataFrame({"seed": seed, "episode": episode, "step": range(1, steps + 1), "value": 1.0})
        for seed, episode, steps in flights
    ]
    shown, total = pick_trajectories(pd.concat(parts), 0.5)
    assert total == 4
    assert sorted(time.tolist() for time, _ in shown) == [
        [0.5, 1.0], [0.5, 1.0], [0.5, 1.0], [0.5, 1.0, 1.5],
    ]  # fmt: skip


def test_the_middle_seed_and_the_furthest_start_are_shown() -> None:
    rows = [
        ("ippo", seed, episode, start, steady)
        for seed, steady in enumerate((0.3, 0.1, 0.2))
        for episode, start in enumerate((1.0, -4.0, 2.0))
    ]
    columns = ["agent", "seed", "episode", "start", "steady"]
    table = pd.DataFrame([*rows, ("orca", 0, 0, 1.0, 0.0)], columns=columns)
    table = table.assign(env_steps=0, settling_time=NAN, overshoot=NAN, terminated=False)
    assert shown_runs(table.assign(**{"return": 0.0}), HEADLINE) == ({"ippo": 2, "orca": 0}, 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of two drones that fly past each other, with agents that were compared."""
    made = synthetic_folder(tmp_path_factory.mktemp("swarm") / "results", ("ippo", "mappo"), 2)
    config = json.loads((made / "config.json").read_text())
    config["spec"] |= {"env_id": "mine/Pass-v0", "agents": ["left", "right"]}
    (made / "config.json").write_text(json.dumps(config | {"diameter": 0.7, "bounds": {}}))
    there = np.linspace(0.0, 4.0, 21).tolist()
    episode = [there, [5.0 - x for x in there]]  # at X = 2.4 and 2.6 m they are nearest
    rows = [
        positions(episode, episode, episode, agent=agent, seed=seed)
        for agent in ("ippo", "mappo")
        for seed in (0, 1)
    ]
    table = pd.concat(rows)[POSITION_SCHEMA.names]
    table.to_parquet(made / "positions.parquet", index=False)
    write_report(made)
    return made


def test_the_table_has_the_least_distance_and_no_overshoot(folder: Path) -> None:
    table = table_of(read_results(folder))
    assert table["least_distance"].to_dict() == pytest.approx({"ippo": 0.2, "mappo": 0.2})
    assert headings(HEADLINE, swarm=True)[4] == "Least distance (m)"
    assert [row[4].value for row in result_rows(table)] == ["0.20", "0.20"]
    text = (folder / "results.md").read_text(encoding="utf-8")
    assert "| Least distance (m) |" in text
    assert "An episode of each drone counts for itself." in text
    for word in ("Overshoot", "Bounds:"):
        assert word not in text


def test_the_page_shows_the_drones_and_claims_nothing_of_the_paper(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    picture = (folder / "figures" / SWARM_FIGURE).read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert f"data:image/png;base64,{base64.b64encode(picture).decode()}" in page
    assert "their spheres touch, at 0.7 m" in page
    assert "2 drones in each world" in page
    for words in ("the paper's", "as in the paper", "Drones 2023", 'id="claims"', "Overshoot"):
        assert words not in page, words
    assert json.loads((folder / "claims.json").read_text()) == []


def test_the_page_has_the_least_distance_over_time(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    data = page.partition('<script type="application/json" id="data">')[2].partition("</script>")[0]
    charts = {chart["key"]: chart for chart in json.loads(data)["charts"]}
    assert page.count('<figure class="card chart"') == len(charts) == 7
    chart = charts["distance"]
    assert (chart["mark"], chart["log"], chart["y"]) == (0.7, False, "least distance (m)")
    (first, second) = chart["series"]
    assert first["y"] == second["y"]
    assert (first["y"][0], min(first["y"]), first["y"][-1]) == (5.0, 0.2, 3.0)
    assert first["x"][-1] == pytest.approx(20 * PERIOD)


def test_one_drone_has_none_of_it(tmp_path: Path) -> None:
    page = write_report(synthetic_folder(tmp_path, ("a2c",), 1, 300)).read_text(encoding="utf-8")
    assert not (tmp_path / "figures" / SWARM_FIGURE).exists()
    assert 'id="drones"' not in page
    assert "east distance" not in page


def test_wrong_positions_are_one_sentence(tmp_path: Path) -> None:
    made = synthetic_folder(tmp_path, ("a2c",), 1, 300)
    (made / "positions.parquet").write_text("nothing")
    with pytest.raises(ResultsError, match="not a Parquet file"):
        read_results(made)
    pd.DataFrame({"agent": ["a2c"]}).to_parquet(made / "positions.parquet")
    with pytest.raises(ResultsError, match=r"positions\.parquet lacks the columns seed, episode"):
        read_results(made)


def test_a_comparison_of_several_drones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "out"
    arguments = ["compare", "--env", "rotorgram/Formation-v0", "--vehicle", "crazyflie2"]
    arguments += ["--drones", "2", "--num-envs", "64", "--agents", "ippo", "--seeds", "1"]
    arguments += ["--env-steps", "16384", "--snapshots", "1", "--episodes", "2", "--no-film"]
    arguments += ["--episode-length", "20", "--jobs", "1", "--out", str(folder)]
    assert main(arguments) == 0
    results = read_results(folder)
    assert sorted(set(results.evaluations["agent"])) == ["ippo", "orca"]
    table = pq.read_table(folder / "positions.parquet")
    assert table.schema.remove_metadata() == POSITION_SCHEMA
    rows = table.to_pandas()
    orca = rows[rows["agent"] == "orca"]
    assert len(orca) == 2 * 2 * 21  # episodes, drones, steps and the start
    both = orca[(orca["episode"] == 0) & (orca["step"] == 0)][list(POSITION)].to_numpy()
    apart = float(np.linalg.norm(both[0] - both[1]))
    steps = distance_curves(orca[orca["episode"] == 0], 0.02)["orca"]
    assert steps.middle[0] == pytest.approx(apart)
    assert results.config["diameter"] < apart  # no two start in touch
    assert read_compare_config(folder).drones == 2
    filmed = []

    def film(path: Path, shots: list[Shot], config: Film, _: object) -> int:
        path.touch()
        filmed.extend((shot.name, shot.drones, len(shot.episodes[0])) for shot in shots)
        filmed.append(config.camera)
        return 1

    monkeypatch.setattr(films, "film", film)
    assert films.film_comparison(folder, tmp_path / "film.mp4")
    assert filmed == [("IPPO", 2, 2), ("ORCA", 2, 2), "top"]
