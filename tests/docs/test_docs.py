"""What the pages quote is what the files hold that the commands wrote."""

import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import collisions
import pandas as pd
import pytest
import robust
import shipped
import universal
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.training.report import judge
from rotorgram.training.results import Results
from rotorgram.training.tables import markdown, results_table

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"


def page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def result(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text())


def check(name: str, *sentences: str) -> None:
    """That the page has the sentences, whatever its line breaks."""
    text = " ".join(page(name).split())
    for sentence in sentences:
        assert sentence in text


@pytest.mark.parametrize("name", ["tuned", "paper", "error"])
def test_the_page_of_results_has_what_committed_flights_say(name: str) -> None:  # fault 66
    results = Results.read(RESULTS / name)
    table = markdown(results, results_table(results)).split("\n\n")[0]
    assert table in page("results")
    rows = [f"| **{one.verdict}** | {one.evidence} |" for one in judge(results)]
    check("results", results.config["command"], *rows)


@pytest.mark.parametrize("name", ["baselines", "swarms"])
def test_the_pages_of_boards_have_what_committed_flights_say(name: str) -> None:  # fault 67
    results = Results.read(RESULTS / name)
    lines = markdown(results, results_table(results)).splitlines()
    rows = [x for x in lines if x.startswith("|")]
    check("swarm_baselines" if name == "swarms" else name, results.config["command"], *rows)
    named = list((RESULTS / name / "checkpoints").iterdir())
    assert len(named) == sum(not row.controller for row in results.study.rows)


@pytest.mark.parametrize("file", sorted(RESULTS.glob("*/mujoco.csv")), ids=lambda f: f.parent.name)
def test_the_check_on_mujoco_is_the_one_that_was_measured(file: Path) -> None:
    def text(number: float) -> str:
        return f"{number:,.0f}" if abs(number) >= 1000 else f"{number:.3g}"

    for row in pd.read_csv(file).itertuples():
        assert row.low < 0 < row.high  # as the page says
        interval = f"{text(row.difference)} ({text(row.low)} to {text(row.high)})"
        check("results", f"| {text(row.rigid)} | {text(row.mujoco)} | {interval} |")


@pytest.mark.parametrize("agent", ["vpg", "a2c"])
def test_the_tuning_trials_are_those_of_the_sweeps(agent: str) -> None:
    for point in pd.read_csv(RESULTS / "tuning" / f"{agent}.csv").itertuples():
        errors = f"{point.worst:.3f} | {point.median:.3f}"
        crashes = f"{point.crashed} of {point.episodes}"
        setting = f"{point.learning_rate} | {point[3]}"
        check("results", f"| {setting} | {errors} | {point[7]:.0f} | {crashes} |")


@pytest.mark.parametrize(
    "name",
    ["training_speed", "performance/training_speed_64", "performance/training_speed_64_in_process"],
)
def test_the_speeds_are_those_of_the_benchmark(name: str) -> None:
    speed = result(name)
    for agent, median in speed["medians"].items():
        ratio = f"{median:,.0f} | {speed['ratio_to_sb3'][agent]:.2f}"
        start = rf"\| `{agent}` \| .*\(results/{name}\.json\)\)"
        assert re.search(rf"{start} \| {re.escape(ratio)} \|", page("results"))


def test_the_protocol_says_where_the_numbers_of_a_state_are() -> None:
    places = []
    at = 72  # behind the flags of one drone
    for array in env_spec(EnvConfig()).telemetry:
        places.append(f"{array.name} at {at}")
        at += 8 * array.size
    check("protocol", f"{', '.join(places)}; {at} bytes in all")


def test_committed_results_are_small() -> None:
    most = {".parquet": 2_000_000}  # each flight and training episode of a comparison
    files = [path for path in RESULTS.rglob("*") if path.is_file()]
    assert [path for path in files if path.stat().st_size > most.get(path.suffix, 300_000)] == []


def test_the_reliability_page_tells_what_was_measured() -> None:
    soak, kills, flood, fuzz, journal = (
        result(f"reliability/{name}") for name in ("soak", "kills", "flood", "fuzz", "journal")
    )
    finished = [kills[name]["finished_episodes"] for name in ("agent_killed", "either_killed")]
    sent = flood["flood"]["sent"]
    check(
        "reliability",
        f"{soak['control_steps']:,} control steps, {soak['drone_steps']:,} drone steps: 0 differ",
        f"| finished episodes | {finished[0]:,} | {finished[1]:,} |",
        f"{sent:,} datagrams of garbage in {flood['flooded_seconds']:.0f} s",
        f"| steps per second, calm | {flood['steps_per_second']['calm']:,} |",
        f"{fuzz['executions']:,} executions",
        f"{journal['journal_on']['simulator']['ratio']:.3f} of the rate",
    )
    assert soak["bits_that_differ"] == fuzz["findings"] == 0
    assert soak["control_steps"] >= 1_000_000
    assert kills["agent_killed"]["identical_to_unbroken"]
    assert flood["identical"]


def test_the_reliability_page_tells_what_agents_of_a_swarm_did() -> None:
    swarm = result("reliability/swarm")
    eight = swarm["agent_processes"]
    absences = ", ".join(str(eight.get(f"absent_{k}", 0)) for k in ("silent", "coming", "late"))
    check(
        "reliability",
        f"{eight['killed']} kills and {eight['stopped']} stops of {eight['agents']} agent "
        f"processes: 0 of {eight['control_steps']:,} control steps differ",
        f"| episodes | {eight['episodes']} |",
        f"by Commands of their agents | {eight['drone_steps_by_commands']:,} |",
        f"| absences: silent, started anew, late | {absences} |",
        f"| agents that did not come back | {eight['agents_lost_for_good']} |",
    )
    assert eight["states_that_differ"] == eight["actions_that_differ"] == 0


def test_the_reliability_page_tells_what_links_carried() -> None:
    rows = page("reliability").splitlines()
    for flight in result("reliability/link")["flights"]:
        start = f"| {flight['drones']:,} | {flight['mtu']:,} |"
        row = next(line for line in rows if line.startswith(start))
        assert f" {flight['steps_per_second']:.1f} " in row


def test_the_performance_page_tells_what_was_measured() -> None:
    bench, peers, waiting = (
        result(f"performance/{name}") for name in ("bench", "peers", "waiting")
    )
    rates = bench["medians"]
    rows = [f"{rate:,.0f} | {1e6 / rate:.2f}" for rate in rates.values()]
    for first, second in (
        ("env", "mj_step"),
        ("UDP, 1", "env"),
        ("UDP, 1024", "vector env, 1024"),
    ):
        rows.append(f"{first} ÷ {second} | {rates[first] / rates[second]:.2f}")
    for row in waiting["rows"]:
        looks = row["medians"]["looks"]
        rows.append(f"{row['neighbours']} | {looks:.0f} | {row['medians']['sleeps']:.0f}")
    for name in ("seconds_elevation", "performance/seconds_a2c", "performance/seconds_sb3_a2c"):
        found = result(name)
        worst = max(seed["steady"] for seed in found["seeds"])
        held = f"{found['hold']} of {found['of']}"
        rows.append(f"{found['seconds']['median']:.3g} | {worst:.2g} | {held}")
    rows += [f"{rate:,.0f}" for rate in peers["env_steps_per_second"].values()]
    words = "rotorgram train ppo --preset tuned --env rotorgram/Hover-v0"
    trained = f"`{words}` | {bench['policy_seconds']:.2f} s"
    check("performance", trained, *(f"| {row} |" for row in rows))


def test_the_page_of_solids_tells_what_was_measured() -> None:
    found = result("performance/sight")
    errors = found["errors"]
    assert errors["off"] == errors["grazing"]
    rays = f"Of {errors['rays']:,} rays in random scenes (`python studies/sight.py`) all but"
    rows = [
        f"| {row['solids']} | {row['sensor']} | {row['scans']:,.0f} | {row['mj_multiRay']:,.0f} | "
        f"{row['ratio']:.0f} |"
        for row in found["speeds"]
    ]
    check("solids", rays, f"all but {errors['off']} are within 0.2 mm", *rows)


def test_the_page_of_tasks_tells_how_policies_failed() -> None:
    policies = result("failures")["policies"]
    assert [one["policy"] for one in policies] == ["mlp", "gru", "cnn"]
    rows = []
    for cause, row in (
        ("evaded another trunk", 2),
        ("turned back", 3),
        ("slow among trunks", 4),
        ("kept its course", 1),
    ):
        counts = [sum(f["cause"] == cause for f in one["failures"]) for one in policies]
        rows.append((*counts, row))
    rows.append((*(one["flights"] for one in policies), "–"))
    for held in ("touched", "pixels_before"):
        rows.append((*(sum(f[held] > 0 for f in one["failures"]) for one in policies), "–"))
    slow = (f"{one['passes_slow']} of {one['passes']}" for one in policies)
    rows.append((*slow, "–"))
    check("tasks", *(f"| {' | '.join(map(str, row))} |" for row in rows))
    assert all("/trunk" in f["solid"] for one in policies for f in one["failures"])


def test_the_scaling_page_tells_what_was_measured() -> None:
    scaling = result("performance/scaling")
    extrapolated = scaling["extrapolated"]
    drones = scaling["drones"]
    rows = [f"{threads} | {rate:,}" for threads, rate in scaling["threads"].items()]
    for count, one in scaling["simulators"].items():
        agent = f"{one['agent_seconds'] * 1e3:.2f}"
        rows.append(f"{count} | {int(count) * drones:,} | {one['rate']:,} | {agent}")
    for count, rate in extrapolated["rates"].items():
        rows.append(f"{count} | {int(count) * drones:,} | {rate:,}")
        t_agent = int(count) * extrapolated["t_agent"]  # the formula on the page
        period = extrapolated["t_physics"] + t_agent + extrapolated["t_network"]
        assert int(count) * drones / period == pytest.approx(rate, rel=1e-3)
    rows += [f"{seconds:.1f}" for seconds in scaling["runs"]["seconds"].values()]
    check(
        "scaling",
        *(f"| {row} |" for row in rows),
        f"{extrapolated['t_agent'] * 1e3:.2f} ms at the median",
    )


def test_the_page_of_swarms_tells_what_was_measured() -> None:
    for case, row in result("performance/swarm")["microseconds"].items():
        cells = " | ".join(f"{x:,.1f}" for x in row.values())
        check("swarms", f"| {case} | {cells} |")


def test_the_limits_are_those_that_were_measured() -> None:
    bench = result("performance/bench")["medians"]
    rates = result("performance/peers")["env_steps_per_second"]
    crazyflow = rates["Crazyflow DroneReachPos-v0, 4096"]
    assert round(crazyflow / rates["rotorgram `mujoco`, 4096"]) == 4
    assert round(rates["rotorgram `rigid`, 4096"] / crazyflow, -1) == 40
    check(
        "limits",
        f"a step takes {bench['env'] / bench['UDP, 1']:.1f} times as long as in process",
        "Crazyflow is four times as fast",
    )


@pytest.mark.parametrize(
    "task",
    [
        "Elevation",
        "Hover",
        "PayloadHover",
        "Landing",
        "Recovery",
        "Tracking",
    ],
)
def test_the_page_of_ppo_tells_what_was_flown(task: str) -> None:
    found = result(f"seconds_{task.lower()}")
    sizes = [seed["steady"] for seed in found["seeds"]]
    controller = "–"
    if "beside" in found:
        beside = found["beside"]["geometric"]
        flights = found["crashes"]["flights"] // found["of"]
        controller = f"{beside['steady']:.3g}, {beside['crashes']} of {flights}"
    cells = (
        f"{found['hold']} of {found['of']}", f"{min(sizes):.2g} to {max(sizes):.2g}",
        crashes_of(found), controller, f"{found['processor_seconds']['median']:.3g} s",
    )  # fmt: skip
    rows = page("algorithms/ppo").split("## Results")[1].splitlines()
    own = [row for row in rows if row.startswith(f"| `{task}-v0`")]
    assert own[0].endswith(f" | {' | '.join(cells)} |")


def test_the_table_of_laps_has_what_was_flown() -> None:
    laps = {name: found for name, found in result("racing").items() if "bound" in found}
    assert {"Racing", "Waypoints"} <= laps.keys()
    rows = []
    for task, found in laps.items():
        flown = found["all"]
        crashes = flown["crashes"]
        low, high = 100 * crashes["low"], 100 * crashes["high"]
        ratios = found["lap_over_bound"]
        beside = found["geometric"]
        craft = found["craft"]
        cells = (
            f"{found['seeds_without_a_miss']} of {found['of']}",
            f"{flown['not_whole']} of {flown['flights']:,}",
            f"{crashes['crashes']} ({low:.2g} to {high:.2g} %)",
            f"{found['bound']:.2f} s",
            f"{ratios['median']:.2f} ({ratios['best']:.2f} to {ratios['worst']:.2f})",
            f"{craft['lap_over_least']:.2f}",
            f"{beside['not_whole']}, {beside['lap_over_bound']:.2f}",
            f"{found['processor_seconds']:.0f} s",
        )
        rows.append(f"| `{task}-v0` | {' | '.join(cells)} |")
    check("tasks", *rows)


@pytest.mark.parametrize(
    ("where", "study"),
    [
        ("robustness", robust),
        ("robustness", universal),
        ("robustness", shipped),
        ("swarms", collisions),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_page_has_what_every_flight_says(
    where: str, study: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(RESULTS.parent.parent)
    found = study.sums()
    committed = result(study.__name__)
    assert {key: committed[key] for key in found} == found
    check(where, *(" ".join(row.split()) for row in study.page(found).splitlines()))


def crashes_of(found: dict[str, Any]) -> str:
    """Crashes of all flights, and Wilson's interval of their share, in a cell; none where the
    metric counts them.
    """
    counted = found["crashes"]
    if found["command"].endswith("Landing-v0"):
        return "–"
    low, high = 100 * counted["low"], 100 * counted["high"]
    return f"{counted['crashes']:,} of {counted['flights']:,} ({low:.2g} to {high:.2g} %)"


def test_the_shifts_are_those_that_were_measured() -> None:
    """Position error in cm and crashes in per cent, of each row of the page's table."""
    summary = pd.read_csv(RESULTS / "transfer" / "summary.csv", dtype={"at": str})
    summary = summary.set_index(["by", "at", "row"])
    found = re.findall(r"^\| (\w+) \| (\S+) \| (.* %) \|$", page("transfer"), re.MULTILINE)
    assert len(found) >= 10
    names = ["plain", "randomised", "randomised, history", "geometric"]
    for by, at, cells in found:
        rows = [summary.loc[by, at, name] for name in names]
        expected = [f"{100 * row.error_m:.1f}, {100 * row.crashes:.0f} %" for row in rows]
        assert cells.replace("–", "nan") == " | ".join(expected)


def test_the_page_of_rigid_tells_what_was_measured() -> None:
    for drones, row in result("rigid/sizes")["processor_microseconds"].items():
        numbers = [f"{number:,}" for name, number in row.items() if "tensors" not in name]
        check("rigid", f"| {int(drones):,} | {' | '.join(numbers)} |")
    ratio = result("rigid/a2c")["ratio_to_sb3"]["a2c"]
    check("rigid", f"{ratio:.2f} times as many env steps per second")


def percent(share: float) -> str:
    return f"{100 * share:.1f}"


def test_the_table_of_forests_has_what_was_flown() -> None:
    found = result("forest")
    assert len(found["cases"]) == 4
    assert len(found["seeds"]) == 5
    rows = []
    for case in found["cases"]:
        others = [case[name] for name in ("vfh", "straight")]
        low, high = percent(case["low"]), percent(case["high"])
        cells = [
            f"{1 / case['density']:.0f} m²",
            f"{case['speed']:.0f} m/s",
            f"{percent(case['share'])} % ({low} to {high})",
            f"{case['mean_speed']:.2f} m/s",
            f"{case['top_speed']:.2f} m/s",
            *(f"{percent(one['arrived'] / one['flights'])} %" for one in others),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    minutes = [one["seconds"] / 60 for one in found["seeds"]]
    check("tasks", *rows, f"in {min(minutes):.1f} to {max(minutes):.1f} minutes from process start")


def test_the_page_of_tasks_tells_what_else_was_measured_in_forests() -> None:
    cases = result("forest")["cases"]
    easy, dense = cases[:2], cases[2:]
    for case in (easy[1], dense[1]):
        beside = case["vfh"]
        assert beside["arrived"] / beside["flights"] < case["low"]  # as the page says
    straight = easy[0]["straight"]
    touched = 100 * straight["touched"] / straight["flights"]
    slow, fast = (f"{case['vfh']['mean_speed']:.1f} m/s" for case in easy)
    speed = result("performance/forest")
    rate = round(speed["steps_per_second"]["depth"], -3)
    check(
        "tasks",
        f"of 100 flights straight at the goal {touched:.0f} touch a trunk",
        f"with {slow} and {fast} in the mean",
        f"the env makes {rate:,} steps/s with {speed['drones']:,} drones",
        f"a wood adds to a physics step is {speed['contact_over_physics']:.1f} times that step",
    )


def test_the_page_of_tasks_tells_what_a_memory_is_good_for() -> None:
    found = result("memory")
    shares = {}
    for name, seeds in found["rows"].items():
        assert len(seeds) == 3
        arrived = sum(seed["arrived"] for seed in seeds)
        shares[name] = arrived / (len(seeds) * found["flights"])
    assert [found[name] for name in shares] == pytest.approx([*shares.values()], abs=5e-5)
    with_memory, without, apart, low, high = (
        f"{100 * found[name]:.0f}" for name in ("gru", "none", "difference", "low", "high")
    )
    check(
        "tasks",
        f"flies {found['flights']} unseen layouts",
        f"{with_memory} % arrive with a memory, {without} % without",
        f"a difference of {apart} points (95 % interval {low} to {high})",
    )


def test_the_table_of_gates_has_what_was_flown() -> None:
    found = result("seconds_gates")
    seeds = found["seeds"]
    assert len(seeds) == 3
    flights = found["crashes"]["flights"] // found["of"]
    passed = ", ".join(percent(seed["good"] / flights) for seed in seeds)
    times = ", ".join(f"{seed['flight_seconds']:.1f}" for seed in seeds)
    speeds = ", ".join(f"{seed['speed']:.1f}" for seed in seeds)
    geometric = found["beside"]["geometric"]
    beside = f"{percent(geometric['good'] / flights)} % | {geometric['flight_seconds']:.1f} s"
    check(
        "tasks",
        f"for {found['processor_seconds']['most']:.0f} s of one processor | {passed} % | "
        f"{times} s | {speeds} m/s |",
        f"| {flights:,} unseen tracks for each",
        f"| `geometric` | {beside} | {geometric['speed']:.1f} m/s |",
    )


def test_the_table_of_dodge_has_what_was_flown() -> None:
    found = result("seconds_dodge")
    (seed,) = found["seeds"]
    means = seed["means"]
    check(
        "tasks",
        f"{seed['processor_seconds']:.0f} s of one processor: not solved | "
        f"{percent(means['success'])} % | {percent(means['touched'])} % | "
        f"{seed['flight_seconds']:.1f} s |",
        f"| {found['crashes']['flights']:,} unseen layouts",
    )
