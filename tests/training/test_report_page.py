"""The curves of a comparison and the page that shows them: its text, and in a headless Chromium."""

import base64
import html
import json
import operator
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from comparisons import HEADLINE, synthetic_folder
from rotorgram.flights.palette import agent_color
from rotorgram.rendering.film import poster, write_film
from rotorgram.training.figures import (
    FIGURE_FILES,
    cumulative_returns,
    flown_sizes,
    learning_curves,
    pick_trajectories,
    return_curves,
    value_fan,
)
from rotorgram.training.metrics import Spread
from rotorgram.training.report import (
    MAX_POINTS,
    VIDEO_FILE,
    Chart,
    chart_data,
    write_report,
)

CHARTS = ["learning", "flown", "reward", "training-error", "total-by-step", "total-by-episode"]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
EVIL = "</script><img src=x onerror=alert(1)>"


def training(returns: dict[int, list[float]], length: int = 10) -> pd.DataFrame:
    """Training episodes of A2C: the returns of each seed."""
    rows = [
        {"agent": "a2c", "seed": seed, "last_step": (number + 1) * length, "return": y}
        for seed, values in returns.items()
        for number, y in enumerate(values)
    ]
    return pd.DataFrame(rows)


def test_the_average_return_is_the_mean_of_the_last_share_of_training() -> None:
    # Half of 40 steps: two episodes. Seed 0: 2, 3, 5, 7; seed 1: 0, 0, 0, 0.
    episodes = training({0: [2.0, 4.0, 6.0, 8.0], 1: [0.0] * 4})
    spread = return_curves(episodes, share=0.5)["a2c"]
    assert (spread.x[0], spread.x[-1]) == (10, 40)
    marks = np.interp([10, 20, 30, 40], spread.x, spread.middle)
    assert marks == pytest.approx([1.0, 1.5, 2.5, 3.5], abs=0.02)  # the grid is of 300 points
    assert (spread.low[-1], spread.middle[-1], spread.high[-1]) == (0.0, 3.5, 7.0)


def test_cumulative_returns_end_with_the_shortest_run() -> None:
    episodes = training({0: [1.0, 2.0, 3.0], 1: [3.0, 4.0]})
    by_step, by_episode = (curves["a2c"] for curves in cumulative_returns(episodes))
    assert (by_step.x[0], by_step.x[-1]) == (10, 20)
    assert (by_episode.x[0], by_episode.x[-1]) == (1, 2)
    for spread in (by_step, by_episode):
        assert (spread.low[0], spread.middle[0], spread.high[0]) == (1, 2, 3)
        assert (spread.low[-1], spread.middle[-1], spread.high[-1]) == (3, 5, 7)


def test_learning_curves_are_means_over_episodes_then_over_seeds() -> None:
    rows = [
        ("a2c", 0, 0, 1.0), ("a2c", 0, 0, 3.0), ("a2c", 0, 100, 0.2), ("a2c", 0, 100, np.nan),
        ("a2c", 1, 0, 6.0), ("a2c", 1, 100, 0.4),
        ("pid", 0, 0, 0.01), ("pid", 0, 0, 0.03),
        ("vpg", 0, 0, np.nan),
    ]  # fmt: skip
    evaluations = pd.DataFrame(rows, columns=["agent", "seed", "env_steps", "steady"])
    curves, levels = learning_curves(evaluations)
    assert list(curves) == ["a2c"]
    assert curves["a2c"].x.tolist() == [0, 100]
    assert curves["a2c"].middle == pytest.approx([4.0, 0.3])
    assert curves["a2c"].low == pytest.approx([2.0, 0.2])
    assert curves["a2c"].high == pytest.approx([6.0, 0.4])
    assert levels == pytest.approx({"pid": 0.02})


def test_the_fan_has_the_quantiles_of_each_window() -> None:
    # Two windows of 50 steps: E from 0 to 4.9 m in the first, and -1 m in the second.
    errors = np.concatenate([np.arange(50) / 10, np.full(50, -1.0)])
    fan = value_fan(pd.DataFrame({"step": np.arange(100), "value": errors}))
    assert fan.x.tolist() == [25, 75]
    # Of n = 50 even values the quantile q is q (n - 1) / 10.
    first = [values[0] for values in fan[1:]]
    assert first == pytest.approx([0.245, 1.225, 2.45, 3.675, 4.655])
    assert [values[1] for values in fan[1:]] == [-1] * 5


def flying(errors: list[list[float]]) -> pd.DataFrame:
    """Evaluation steps of one seed: E of each episode."""
    parts = [
        pd.DataFrame({"seed": 0, "episode": n, "step": np.arange(len(values)), "value": values})
        for n, values in enumerate(errors)
    ]
    return pd.concat(parts)


def test_the_flown_sizes_are_of_those_that_still_fly() -> None:
    spread = flown_sizes(
        flying([[-1.0, 1.0], [2.0, 2.0], [-3.0, 3.0], [4.0], [5.0]]), 0.5, HEADLINE
    )
    assert spread.x.tolist() == [0.0, 0.5]
    # Of five, the quartiles and the mean of what is between; of three, the extremes and the mean.
    assert (spread.low[0], spread.middle[0], spread.high[0]) == (2, 3, 4)
    assert (spread.low[1], spread.middle[1], spread.high[1]) == (1, 2, 3)
    long = flown_sizes(flying([list(range(5000))]), 0.01, HEADLINE)
    assert len(long.x) == 500
    assert (long.x[-1], long.middle[-1]) == (49.99, 4999)


def test_trajectories_are_picked_once_and_for_all() -> None:
    steps = flying([[float(n), 0.0] for n in range(60)])
    shown, total = pick_trajectories(steps, 0.5)
    assert (len(shown), total) == (40, 60)
    assert all(time.tolist() == [0.0, 0.5] for time, _ in shown)
    starts = [error[0] for _, error in shown]
    assert len(set(starts)) == 40
    assert starts == [error[0] for _, error in pick_trajectories(steps, 0.5).shown]


def chart(spread: Spread, **changes: Any) -> dict[str, Any]:
    texts = dict.fromkeys(("key", "x_label", "y_label"), "")
    charts = [Chart(**texts, spreads={"a2c": spread}, **changes)]
    (data,) = chart_data(charts, ["vpg", "a2c", "pid"])
    return data


def test_series_are_rounded_and_missing_values_are_null() -> None:
    x = np.array([0.0, 1234.56789, 200000.0])
    spread = Spread(x, np.array([1.23456, -0.000123456, np.nan]), np.zeros(3), np.ones(3))
    (series,) = chart(spread)["series"]
    assert series == {
        "agent": 1,
        "x": [0, 1234.568, 200000],
        "y": [1.235, -0.0001235, None],
        "low": [0, 0, 0],
        "high": [1, 1, 1],
    }
    series, level = chart(spread, log=True, levels={"pid": 0.0004567891})["series"]
    assert (series["y"], series["low"]) == ([1.235, None, None], [None] * 3)
    assert level == {"agent": 2, "level": 0.0004568}


def test_long_series_are_thinned_with_both_ends_kept() -> None:
    x = np.arange(12_345.0)
    (series,) = chart(Spread(x, x, x, x))["series"]
    assert len(series["x"]) == len(series["y"]) == MAX_POINTS
    assert (series["x"][0], series["x"][-1]) == (0, 12_344)
    assert series["x"] == sorted(set(series["x"]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A comparison whose evaluations are made by hand."""
    path = synthetic_folder(tmp_path_factory.mktemp("page"), ("vpg", EVIL, "pid"), env_steps=800)
    rows = []
    for agent, seed, env_steps, error in [
        ("vpg", 0, 0, 1.0), ("vpg", 0, 400, 0.5), ("vpg", 0, 800, 0.02),
        ("vpg", 1, 0, 3.0), ("vpg", 1, 400, 0.7), ("vpg", 1, 800, 0.04),
        (EVIL, 0, 0, 2.0), (EVIL, 0, 800, 0.25),
        ("pid", 0, 0, 0.003),
    ]:  # fmt: skip
        row = {"agent": agent, "seed": seed, "env_steps": env_steps, "elevation_error": error}
        rows.append(row | {"seconds": env_steps / 100, "episode": 0, "length": 100, "return": 50.0})
    frame = pd.DataFrame(rows).assign(settling_time=1.0, overshoot=0.1, start=1.0, terminated=False)
    frame.to_csv(path / "evaluations.csv", index=False)
    write_report(path)
    return path


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return (folder / "report.html").read_text(encoding="utf-8")


def data_of(page: str) -> dict[str, Any]:
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    data = json.loads(text)
    assert isinstance(data, dict)
    return data


def test_the_page_holds_the_numbers_of_the_files(page: str) -> None:
    data = data_of(page)
    assert data["agents"] == ["VPG", "PID", EVIL]
    assert [one["key"] for one in data["charts"]] == CHARTS
    vpg, pid, other = data["charts"][0]["series"]
    assert vpg == {
        "agent": 0,
        "x": [0, 400, 800],
        "y": [2, 0.6, 0.03],
        "low": [1, 0.5, 0.02],
        "high": [3, 0.7, 0.04],
    }
    assert pid == {"agent": 1, "level": 0.003}
    assert (other["agent"], other["x"], other["y"]) == (2, [0, 800], [2, 0.25])


class Elements(HTMLParser):
    """What a page refers to, and its headings in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.references: list[tuple[str, str]] = []
        self.headings: list[int] = []
        self.tags: list[str] = []
        self.identifiers: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        named = dict(attrs)
        self.references += [(tag, named[name] or "") for name in ("src", "href") if name in named]
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if named.get("id"):
            self.identifiers.append(str(named["id"]))


def test_the_page_needs_nothing_but_itself(page: str) -> None:
    elements = Elements(page)
    outside = [(tag, to) for tag, to in elements.references if not to.startswith(("data:", "#"))]
    assert outside == [("a", "https://doi.org/10.3390/drones7040225")]
    styles = "".join(re.findall(r"<style>(.*?)</style>", page, re.S))
    assert not re.search(r"url\(|@import", styles)
    assert "default-src 'none'" in page  # nor would the browser let it
    assert "uPlot (v1.6.32)" in page
    assert "Permission is hereby granted, free of charge" in page


def test_the_page_is_well_built(page: str) -> None:
    elements = Elements(page)
    steps = np.diff(elements.headings)
    assert elements.headings[0] == 1
    assert elements.headings.count(1) == 1
    assert steps.max() == 1
    assert len(elements.identifiers) == len(set(elements.identifiers))
    targets = {to[1:] for _, to in elements.references if to.startswith("#")}
    assert targets == {"results", "claims", "curves", "configuration", "environment", "reproduce",
                       "files"}  # fmt: skip
    assert targets <= set(elements.identifiers)
    for theme in (agent_color("vpg"), agent_color("vpg", dark=True)):
        assert f"--agent-0: {theme};" in page


def test_the_page_escapes_what_it_is_given(page: str) -> None:
    assert "img" not in Elements(page).tags
    assert html.escape(EVIL) in page
    assert "rotorgram compare --seeds 3 &lt;folder&gt;" in page
    assert "some &lt;processor&gt;" in page
    assert "<folder>" not in page


def test_the_page_tells_what_was_asked_for_and_where_it_ran(page: str, folder: Path) -> None:
    text = html.unescape(page)
    for words in ("0" * 32, "rotorgram report FOLDER", "rotorgram compare --resume FOLDER"):
        assert words in text
    assert text.count('<span class="badge') == 5
    for name in ("config.json", "results.csv", *(f"figures/{name}" for name in FIGURE_FILES)):
        assert (folder / name).is_file()
        assert f"<code>{name}</code>" in text
    assert "<code>checkpoints</code>" not in text  # there is none in this folder
    assert '<th scope="row"><code>learning_rate</code></th><td><code>0.001</code></td>' in text


def test_the_outcome_is_one_sentence_of_the_tables_numbers(page: str) -> None:
    (lead,) = re.findall(r'<p class="lead">(.*?)</p>', page)
    text = html.unescape(lead)
    assert text.startswith(
        "After 800 env steps of training, episodes end with a mean |E| of 0.030 m (VPG) and "
        f"0.25 m ({EVIL}); without training, with 0.0030 m (PID); "
        "of the paper's 4 claims, "
    )
    assert text.endswith("not tested; 2 seeds decide no claim, that takes 30.")
    assert text.count(". ") == 0


def test_a_video_in_the_folder_is_in_the_page(tmp_path: Path, page: str) -> None:
    assert "<video" not in page
    assert 'href="#video"' not in page
    folder = synthetic_folder(tmp_path, ("vpg", "a2c"), seeds=1, env_steps=300)
    video = folder / VIDEO_FILE
    write_film(video, np.full((5, 32, 48, 3), 90, np.uint8), 25.0)
    film = write_report(folder).read_text(encoding="utf-8")
    (tag,) = re.findall(r"<video[^>]*>", film)
    for data, content in (
        ('src="data:video/mp4', video.read_bytes()),
        ('poster="data:image/jpeg', poster(video)),  # fault 20
    ):
        encoded = re.findall(f' {data};base64,([^"]*)"', tag)
        assert [base64.b64decode(text) for text in encoded] == [content]
    assert all(f" {name}" in tag for name in ("controls", "muted", "loop", "playsinline"))
    assert f"<code>{VIDEO_FILE}</code>" in film


def test_a_long_comparison_makes_a_small_page(tmp_path: Path) -> None:
    agents = ("vpg", "a2c", "sb3-a2c", "pid")
    folder = synthetic_folder(tmp_path, agents, seeds=2, env_steps=3000, length=700, snapshots=20)
    assert write_report(folder).stat().st_size < 400_000


PROBE = """
<script>
addEventListener("load", () => setTimeout(async () => {
  const root = document.documentElement;
  const one = (query) => document.querySelector(query);
  const all = (query) => [...document.querySelectorAll(query)];
  const later = (act) => new Promise((done) => { act(); setTimeout(done, 50); });
  const texts = () => all("#chart-learning .readout button").map((button) => button.innerText);
  const colours = ({ width, height }, ctx) =>
    new Set(new Uint32Array(ctx.getImageData(0, 0, width, height).data.buffer)).size;
  const drawn = () => all("canvas").map((canvas) => colours(canvas, canvas.getContext("2d")));
  const paper = () => getComputedStyle(document.body).backgroundColor;
  const seen = {
    width: innerWidth,
    scroll: root.scrollWidth,
    error: root.dataset.error ?? null,
    notice: one("#failure").hidden ? null : one("#failure").innerText,
    charts: root.dataset.charts ?? null,
  };
  if (seen.charts) {
    const plot = one("#chart-learning .plot");
    const over = plot.querySelector(".u-over");
    const box = over.getBoundingClientRect();
    const middle = { clientX: box.left + box.width / 2, clientY: box.top + 20, bubbles: true };
    const at = () => [one("#chart-learning .at").innerText, ...texts()];
    seen.drawn = drawn();
    seen.atRest = texts();
    await later(() => plot.dispatchEvent(new KeyboardEvent("keydown", { key: "Home" })));
    seen.atHome = at();
    seen.spoken = plot.getAttribute("aria-valuetext");
    await later(() => over.dispatchEvent(new MouseEvent("mousemove", middle)));
    seen.inTheMiddle = at();
    await later(() => one("#chart-learning [data-agent='0']").click());
    seen.pressed = all(".readout button").map(
      (button) => [button.dataset.agent, button.getAttribute("aria-pressed")]);
    seen.drawnWithout = drawn();
    seen.papers = [paper()];
    await later(() => one("#theme").click());
    seen.papers.push(paper());
  }
  parent.postMessage(JSON.stringify(seen), "*");
}, 200));
</script>
</body>"""

# No window of Chromium is narrower than 500 px, but a frame may be.
FRAME = """<!doctype html>
<script>
addEventListener("message", (event) => { document.body.dataset.probe = event.data; });
</script>
<body><iframe src="probed.html" style="width: WIDTHpx; height: 844px; border: 0"></iframe></body>
"""


def probed(page: str, folder: Path, width: int) -> dict[str, Any]:
    """Open a page at some width (px), try it, and tell what was seen."""
    assert page.count("</body>") == 1
    (folder / "probed.html").write_text(page.replace("</body>", PROBE), encoding="utf-8")
    (folder / "frame.html").write_text(FRAME.replace("WIDTH", str(width)), encoding="utf-8")
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--dump-dom"]
    flags += [f"--user-data-dir={folder / 'profile'}", "--virtual-time-budget=5000"]
    flags += ["--disable-dev-shm-usage"]
    result = subprocess.run(
        [str(CHROMIUM), *flags, "--window-size=1400,900", f"file://{folder}/frame.html"],
        capture_output=True,
        check=True,
        timeout=60,
    )
    (found,) = re.findall(r'data-probe="([^"]*)"', result.stdout.decode("utf-8"))
    seen = json.loads(html.unescape(found))
    assert isinstance(seen, dict)
    return seen


needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH")


@needs_chromium
@pytest.mark.parametrize("width", [360, 390, 1280])
def test_the_page_in_a_browser(tmp_path: Path, page: str, width: int) -> None:
    seen = probed(page, tmp_path, width)
    assert (seen["error"], seen["notice"]) == (None, None)
    assert seen["width"] == width
    assert seen["scroll"] <= width
    assert seen["charts"] == str(len(CHARTS))
    assert len(seen["drawn"]) == len(CHARTS)
    assert min(seen["drawn"]) > 20  # lines, bands and their edges; an empty canvas has one
    names = ["VPG", "PID", EVIL]
    assert seen["atRest"] == [
        f"{name}\n{values}"
        for name, values in zip(
            names, ("0.030\n0.020 to 0.040", "0.0030", "0.25\n0.25 to 0.25"), strict=True
        )
    ]
    assert seen["atHome"] == [
        "at 0 env steps", "VPG\n2.00\n1.00 to 3.00", "PID\n0.0030", f"{EVIL}\n2.00\n2.00 to 2.00"
    ]  # fmt: skip
    assert seen["spoken"] == f"at 0 env steps: VPG 2.00, PID 0.0030, {EVIL} 2.00"
    # Halfway on a logarithmic scale: the square root of 2.0 * 0.25.
    assert seen["inTheMiddle"] == [
        "at 400 env steps", "VPG\n0.60\n0.50 to 0.70", "PID\n0.0030", f"{EVIL}\n0.71\n0.71 to 0.71"
    ]  # fmt: skip
    assert dict(seen["pressed"]) == {
        "0": "false", "1": "true", "2": "true"
    }  # fmt: skip
    assert sum(pressed == "false" for _, pressed in seen["pressed"]) == len(CHARTS)
    assert all(map(operator.ne, seen["drawn"], seen["drawnWithout"]))
    assert len(set(seen["papers"])) == 2


@needs_chromium
def test_a_page_that_cannot_draw_says_so(tmp_path: Path, page: str) -> None:
    broken = page.replace('id="data">{', 'id="data">{,')
    seen = probed(broken, tmp_path, 390)
    assert seen["charts"] is None
    assert "JSON" in seen["error"]
    assert seen["notice"] == f"The curves could not be drawn: {seen['error']}"
