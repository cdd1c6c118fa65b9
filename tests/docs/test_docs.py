"""What the pages quote is what the files hold that the commands wrote."""

import json
import re
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"


def test_the_table_is_the_one_of_the_comparison() -> None:
    table = (RESULTS / "tuned" / "results.md").read_text().split("\n\n")[0]
    assert table in (ROOT / "docs" / "results.md").read_text()


@pytest.mark.parametrize("preset", ["tuned", "paper", "error"])
def test_the_verdicts_are_those_of_the_comparison(preset: str) -> None:
    page = (ROOT / "docs" / "results.md").read_text()
    for verdict in json.loads((RESULTS / preset / "claims.json").read_text()):
        row = f"| **{verdict['verdict']}** | {verdict['evidence']} |"
        assert row in page


@pytest.mark.parametrize("preset", ["tuned", "paper"])
def test_the_command_is_the_one_that_was_given(preset: str) -> None:
    command = json.loads((RESULTS / preset / "config.json").read_text())["command"]
    settings = re.sub(r" --out \S+", "", command)
    assert settings in (ROOT / "docs" / "results.md").read_text()


@pytest.mark.parametrize("folder", ["paper", "error"])
def test_the_other_tables_are_those_of_their_comparisons(folder: str) -> None:
    page = (ROOT / "docs" / "results.md").read_text()
    assert (RESULTS / folder / "results.md").read_text().split("\n\n")[0] in page
    assert json.loads((RESULTS / folder / "config.json").read_text())["command"] in page


@pytest.mark.parametrize("file", sorted(RESULTS.glob("*/mujoco.csv")), ids=lambda f: f.parent.name)
def test_the_check_on_mujoco_is_the_one_that_was_measured(file: Path) -> None:
    page = (ROOT / "docs" / "results.md").read_text()

    def text(number: float) -> str:
        return f"{number:,.0f}" if abs(number) >= 1000 else f"{number:.3g}"

    for row in pd.read_csv(file).itertuples():
        assert row.low < 0 < row.high  # as the page says
        assert (
            f"| {text(row.rigid)} | {text(row.mujoco)} "
            f"| {text(row.difference)} ({text(row.low)} to {text(row.high)}) |"
        ) in page


@pytest.mark.parametrize("agent", ["vpg", "a2c"])
def test_the_tuning_trials_are_those_of_the_sweeps(agent: str) -> None:
    page = (ROOT / "docs" / "results.md").read_text()
    for point in pd.read_csv(RESULTS / "tuning" / f"{agent}.csv").itertuples():
        assert (
            f"| {point.learning_rate} | {point[3]} | {point.worst:.3f} | {point.median:.3f} "
            f"| {point[7]:.0f} | {point.crashed} of {point.episodes} |"
        ) in page


def test_the_seeds_of_vpg_that_do_not_hold_are_those_that_were_measured() -> None:
    page = (ROOT / "docs" / "algorithms" / "vpg.md").read_text().replace("−", "-")
    seeds = pd.read_csv(RESULTS / "tuned" / "vpg_seeds.csv")
    failing = seeds[seeds["crashes"] > 0]
    assert not failing.empty
    for row in failing.itertuples(index=False):
        slopes = " | ".join(f"{slope:.2f}" for slope in row[3:])
        assert f"| {row.seed} | {row[2]} | {slopes} |" in page


def test_the_seeds_of_sac_are_those_that_were_measured() -> None:
    measured = json.loads((RESULTS / "sac" / "elevation.json").read_text())
    page = " ".join((ROOT / "docs" / "algorithms" / "sac.md").read_text().split())
    seeds = measured["seeds"]
    (steps,) = {row["env_steps"] for row in seeds}
    errors, returns, loads = ([row[name] for row in seeds]
                              for name in ("error", "return", "load_average"))  # fmt: skip
    for told in (
        f"After {steps:,} env steps {measured['hold']} of {measured['of']} seeds hold",
        f"the worst seed's steady |E| is {max(errors):.3f} m",
        f"returns are {min(returns):.0f} to {max(returns):.0f}",
        f"the median was {measured['seconds']['median']:.0f} s",
        f"the load average was {min(loads)} to {max(loads)}",
    ):
        assert told in page


def test_the_speeds_are_those_of_the_benchmark() -> None:
    speed = json.loads((RESULTS / "training_speed.json").read_text())
    page = (ROOT / "docs" / "results.md").read_text()
    for agent, median in speed["medians"].items():
        assert f"| `{agent}` | {median:,.0f} | {speed['ratio_to_sb3'][agent]:.2f} |" in page


def test_the_steps_of_the_ppo_example_are_those_that_were_measured() -> None:  # fault 19
    page = (ROOT / "docs" / "extending.md").read_text()
    for rows in json.loads((RESULTS / "performance" / "ppo_example.json").read_text()).values():
        steps = [row["return_200"] for row in rows]
        assert f"{min(steps):,} to {max(steps):,}" in page


def test_committed_results_are_small() -> None:
    sizes = {p: p.stat().st_size for p in RESULTS.rglob("*") if p.is_file()}
    assert {str(p): s for p, s in sizes.items() if s > 300_000} == {}


def test_the_reliability_page_tells_what_the_benchmarks_wrote() -> None:
    page = (ROOT / "docs" / "reliability.md").read_text()
    soak, kills, flood, fuzz, journal = (
        json.loads((RESULTS / "reliability" / f"{name}.json").read_text())
        for name in ("soak", "kills", "flood", "fuzz", "journal")
    )
    told = [
        f"{soak['control_steps']:,} control steps, {soak['drone_steps']:,} drone steps: "
        f"{soak['bits_that_differ']} differ",
        f"| finished episodes | {kills['agent_killed']['finished_episodes']:,} "
        f"| {kills['either_killed']['finished_episodes']:,} |",
        f"{flood['flood']['sent']:,} datagrams of garbage in {flood['flooded_seconds']:.0f} s",
        f"| steps per second, calm | {flood['steps_per_second']['calm']:,} |",
        f"{fuzz['executions']:,} executions",
        f"{journal['journal_on']['simulator']['ratio']:.3f} of the rate",
    ]
    for sentence in told:
        assert sentence in page
    assert soak["bits_that_differ"] == fuzz["findings"] == 0
    assert kills["agent_killed"]["identical_to_unbroken"]
    assert flood["identical"]
    assert soak["control_steps"] >= 1_000_000
    swarm = json.loads((RESULTS / "reliability" / "swarm.json").read_text())
    eight = swarm["agent_processes"]
    hundred = swarm["hundred_drones"]
    kinds = ("silent", "coming", "late")
    network = hundred["network"]
    absences = ", ".join(str(eight.get(f"absent_{k}", 0)) for k in kinds)
    for sentence in (
        f"{eight['killed']} kills and {eight['stopped']} stops of {eight['agents']} agent "
        f"processes: {eight['states_that_differ']} of {eight['control_steps']:,} control steps "
        "differ",
        f"| episodes | {eight['episodes']} |",
        f"by Commands of their agents | {eight['drone_steps_by_commands']:,} |",
        f"| absences: silent, started anew, late | {absences} |",
        f"| agents that did not come back | {eight['agents_lost_for_good']} |",
        f"{hundred['drone_steps']:,} drone steps, States of {hundred['bytes_of_a_state']:,} bytes, "
        f"{network['dropped']:,} of {network['received']:,} datagrams lost, and "
        f"{hundred['steps_that_differ']} steps with a bit that differs",
    ):
        assert sentence in page
    assert eight["actions_that_differ"] == 0
    for flight in json.loads((RESULTS / "reliability" / "link.json").read_text())["flights"]:
        start = f"| {flight['drones']:,} | {flight['mtu']:,} |"
        row = next(line for line in page.splitlines() if line.startswith(start))
        assert f" {flight['steps_per_second']:.1f} " in row


def test_the_performance_page_tells_what_the_benchmarks_wrote() -> None:
    page = (ROOT / "docs" / "performance.md").read_text()
    bench, hover, peers, waiting = (
        json.loads((RESULTS / "performance" / f"{name}.json").read_text())
        for name in ("bench", "time_to_hover", "peers", "waiting")
    )
    told = [f"| {rate:,.0f} | {1e6 / rate:.2f} |" for rate in bench["medians"].values()]
    for name, ratio in bench["ratios"].items():
        sign, _, limit = ratio["target"].partition(" ")
        value = ratio["value"]
        word = "–"
        if limit:
            reached = value <= float(limit) if sign == "≤" else value >= float(limit)
            word = "reached" if reached else "missed"
        told.append(f"| {name} | {ratio['target'] or '–'} | {value:.2f} | {word} |")
    told += [f"| {name} | {time:.1f} |" for name, time in bench["microseconds"].items()]
    told += [
        f"| {row['neighbours']} | {row['medians']['looks']:.0f} | {row['medians']['sleeps']:.0f} |"
        for row in waiting["rows"]
    ]
    codec = sum(time for name, time in bench["microseconds"].items() if name[2:5] == "cod")
    told.append(f"takes {codec:.1f} of the {bench['microseconds']['step']:.1f} µs")
    told += [f"| {one['wall_seconds']:.1f} | {one['worst_error']:.3f} |"
             for one in hover["settings"]]  # fmt: skip
    told += [f"| {rate:,.0f} |" for rate in peers["env_steps_per_second"].values()]
    for sentence in told:
        assert sentence in page
    assert hover["settings"][0]["wall_seconds"] <= 20
    assert hover["settings"][0]["reached"]


def test_the_scaling_page_tells_what_the_benchmark_wrote() -> None:
    page = (ROOT / "docs" / "scaling.md").read_text()
    scaling = json.loads((RESULTS / "performance" / "scaling.json").read_text())
    extrapolated = scaling["extrapolated"]
    drones = scaling["drones"]
    told = [f"| {threads} | {rate:,} |" for threads, rate in scaling["threads"].items()]
    told += [
        f"| {count} | {int(count) * drones:,} | {one['rate']:,} "
        f"| {one['agent_seconds'] * 1e3:.2f} |"
        for count, one in scaling["simulators"].items()
    ]
    told += [
        f"| {count} | {int(count) * drones:,} | {rate:,} |"
        for count, rate in extrapolated["rates"].items()
    ]
    told += [f"| {seconds:.1f} |" for seconds in scaling["runs"]["seconds"].values()]
    told += [f"{extrapolated['t_agent'] * 1e3:.2f} ms at the median"]
    for sentence in told:
        assert sentence in page
    for count, rate in extrapolated["rates"].items():  # the formula on the page
        t_agent = int(count) * extrapolated["t_agent"]
        period = extrapolated["t_physics"] + t_agent + extrapolated["t_network"]
        assert int(count) * drones / period == pytest.approx(rate, rel=1e-3)
    runs = pd.read_csv(RESULTS / "tuned" / "runs.csv")["seconds"]
    assert (
        f"{len(runs)} runs of {runs.sum():,.0f} s in all, the longest of {runs.max():.0f} s" in page
    )


def test_the_page_of_swarms_tells_what_the_benchmark_wrote() -> None:
    page = (ROOT / "docs" / "swarms.md").read_text()
    told = json.loads((RESULTS / "performance" / "swarm.json").read_text())["microseconds"]
    for case, row in told.items():
        assert f"| {case} | " + " | ".join(f"{x:,.1f}" for x in row.values()) + " |" in page


def test_the_limits_are_those_that_were_measured() -> None:
    page = (ROOT / "docs" / "limits.md").read_text()
    bench, peers = (
        json.loads((RESULTS / "performance" / f"{name}.json").read_text())
        for name in ("bench", "peers")
    )
    step = bench["ratios"]["time of a step, UDP, 1 ÷ (mj_step + UDP echo)"]["value"]
    assert f"a step takes {step:.2f} times as long as its bare physics and an echo" in page
    rates = peers["env_steps_per_second"]
    factor = rates["Crazyflow DroneReachPos-v0, 4096"] / rates["rotorgram, 4096"]
    assert round(factor) == 5
    assert "Crazyflow is five times as fast" in page


@pytest.mark.parametrize("task", ["PayloadHover", "Landing", "Recovery"])
def test_the_seeds_of_ppo_are_those_that_were_flown(task: str) -> None:
    name = {"PayloadHover": "payload"}.get(task, task.lower())
    found = json.loads((RESULTS / f"seconds_{name}.json").read_text())
    sizes = [row["steady"] for row in found["seeds"]]
    count = len(found["seeds"])
    crashes = sum(row["crashes"] for row in found["seeds"])
    beside = found["beside"]["geometric"]
    row = (
        f"| {found['hold']} of {count} | {min(sizes):.3g} to {max(sizes):.3g} "
        f"| {crashes} of {20 * count} | {beside['steady']:.3g}, {beside['crashes']} of 20 "
        f"| {found['processor_seconds']['median']:.0f} |"
    )
    rows = (ROOT / "docs" / "algorithms" / "ppo.md").read_text().splitlines()
    assert any(line.startswith(f"| `{task}-v0` |") and row in line for line in rows)


def test_the_shifts_are_those_that_were_measured() -> None:
    """Position error in cm and crashes in per cent, of each row of the page's table."""
    page = (ROOT / "docs" / "transfer.md").read_text()
    summary = pd.read_csv(RESULTS / "transfer" / "summary.csv", dtype={"at": str})
    found = re.findall(r"^\| (\w+) \| (\S+) \| (.* %) \|$", page, re.MULTILINE)
    assert len(found) >= 10
    for by, at, cells in found:
        some = summary[(summary["by"] == by) & (summary["at"] == at)].set_index("row")
        rows = some.loc[["plain", "randomised", "randomised, history", "geometric"]]
        expected = [
            f"{100 * row.error_m:.1f}, {100 * row.crashes:.0f} %"
            for row in rows.itertuples(index=False)
        ]
        assert cells.replace("–", "nan") == " | ".join(expected)


def test_the_curriculum_is_the_one_that_was_measured() -> None:
    page = (ROOT / "docs" / "transfer.md").read_text()
    lines = pd.read_csv(RESULTS / "transfer" / "curriculum.csv", dtype=str, keep_default_na=False)
    assert len(lines) >= 10
    for row in lines.itertuples(index=False):
        share = f"{100 * float(row.left_out):.0f} %"
        assert f"| {row.row} | {row.seed} | {share} | {row.seconds or '–'} |" in page


def test_the_page_of_rigid_tells_what_the_benchmarks_wrote() -> None:
    page = (ROOT / "docs" / "rigid.md").read_text()
    sizes, a2c = (
        json.loads((RESULTS / "rigid" / f"{name}.json").read_text()) for name in ("sizes", "a2c")
    )
    for drones, row in sizes["processor_microseconds"].items():
        numbers = [f"{number:,}" for name, number in row.items() if "tensors" not in name]
        assert f"| {int(drones):,} | {' | '.join(numbers)} |" in page
    assert f"{a2c['ratio_to_sb3']['a2c']:.2f} times as many env steps per second" in page


@pytest.mark.parametrize(
    "task", ["Elevation", "Hover", "Tracking", "Waypoints", "Racing", "Recovery"]
)
def test_the_page_of_ppo_says_how_long_a_training_took(task: str) -> None:
    found = json.loads((RESULTS / f"seconds_{task.lower()}.json").read_text())
    cells = f" | {found['hold']} of {found['of']} | {found['seconds']['median']:.3g} s |"
    text = (ROOT / "docs" / "algorithms" / "ppo.md").read_text()
    rows = text.split("## Results")[1].splitlines()
    assert any(row.startswith(f"| `{task}-v0`") and row.endswith(cells) for row in rows)
