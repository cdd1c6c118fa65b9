"""`rotorgram render`, what it does without OpenGL, and the film of a comparison."""

import ctypes.util
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
import rotorgram.rendering.gl as gl
from pictures import HEIGHT, TABLES, WIDTH, decoded, pixels
from rotorgram.agents import PID
from rotorgram.agents.checkpoints import load
from rotorgram.cli import main
from rotorgram.envs.config import EnvConfig
from rotorgram.flights import filming
from rotorgram.flights.filming import Film, FilmTrack, film
from rotorgram.flights.recorded import recorded_trajectories
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.rendering import NoOpenGL
from rotorgram.training.films import film_study
from rotorgram.training.results import COLUMNS, Results, write_config, write_run
from rotorgram.training.settings import Row, Study


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as end:
        status = int(end.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


SMALL = ("--size", f"{WIDTH}x{HEIGHT}", "--scene", "plain", "--fast")


@pytest.fixture(scope="module")
def training(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of 200 steps in a process of its own, which must not have touched what draws."""
    folder = tmp_path_factory.mktemp("training") / "run"
    code = """
        import sys
        from rotorgram.cli import main
        import rotorgram.cli.compare, rotorgram.cli.sweep
        status = main(["train", "a2c", "--env-steps", "200", "--out", sys.argv[1],
                       "--set", "steps_per_update=50", "--episode-length", "25"])
        drawing = {name for name in sys.modules
                   if name.startswith(("rotorgram.rendering.", "OpenGL", "mujoco.egl"))}
        drawing -= {"rotorgram.rendering.gl"}  # looks at MUJOCO_GL and imports nothing
        assert not drawing, drawing
        sys.exit(status)
        """
    command = [sys.executable, "-c", textwrap.dedent(code), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_a_checkpoint_on_film_flies_as_it_does_over_the_wire(
    training: Path, opengl: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    journal = tmp_path / "flight.mcap"
    assert run(capsys, "evaluate", training, "--episodes", 2, "--record", journal)[0] == 0
    trained = load(training / "checkpoint.safetensors")
    assert trained.spec.options["episode_length"] == 25
    config = EnvConfig.from_keywords(trained.env_id, **trained.spec.options)
    (flown,) = flown_trajectories(trained.policy(), config, [1], "final")
    (recorded,) = recorded_trajectories(journal, [1])
    for name, values in flown.telemetry.items():
        assert values.tobytes() == recorded.telemetry[name].tobytes()
    assert flown.rewards.tobytes() == recorded.rewards.tobytes()
    out = tmp_path / "film.mp4"
    what = (training, journal, "--out", out, "--size", "642x240", *SMALL[2:])
    status, said, err = run(capsys, "render", *what, "--episode", 1, "--camera", "front")
    assert status == 0
    assert err == ""
    assert f"film: {out} (13 pictures of 642x240)" in said  # 0.5 s, both ends
    last = decoded(out, 642, 240)[-1].astype(int)
    tracks = [FilmTrack(name="it", trajectories=[one]) for one in (flown, recorded)]
    config = Film(width=642, height=240, camera="front", scene="plain", fast=True, overlay=False)
    film(tmp_path / "plain.png", tracks, config)
    bare = pixels(tmp_path / "plain.png").astype(int)
    assert abs(bare[:, :320] - bare[:, 322:]).max() <= 3  # the same flight twice
    assert abs(last - bare)[:60].mean() > 10  # what is written above


def test_pictures(opengl: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "film"
    settings = ("--episode-length", 10, *SMALL)
    command = ("render", "pid", "random", "--out", out, *settings)
    assert run(capsys, *command, "--episodes", 2)[0] == 0
    assert len(list(out.iterdir())) == 12  # 0.2 s at 25 a second with both ends, twice
    picture = tmp_path / "picture.png"
    assert run(capsys, "render", "pid", "--out", picture, "--at", 0.1, *settings)[0] == 0
    assert pixels(picture).shape == (HEIGHT, WIDTH, 3)


@pytest.fixture
def any_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is drawn: what is tested works without OpenGL."""
    monkeypatch.setattr(gl, "offscreen_context", lambda *_: SimpleNamespace(free=lambda: None))


def test_panes_show_the_episodes_that_evaluate_flies(
    any_opengl: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(filming, "film", lambda out, tracks, *_: shown.extend(tracks) or 1)
    what = ("pid", "pid", "random", "pid", "random")
    settings = ("--episode-length", 10, "--episode", 1, "--out", tmp_path / "film.mp4")
    assert run(capsys, "render", *what, *settings)[0] == 0
    names = [track.name for track in shown]
    assert names == ["PID", "PID", "random", "PID", "random"]
    policy = PID(shown[0].trajectories[0].spec)
    config = EnvConfig.from_keywords("rotorgram/Elevation-v0", episode_length=10)
    evaluated = flown_trajectories(policy, config, [1], "final")
    flown = (*evaluated, *shown[0].trajectories, *shown[3].trajectories)
    assert len({one.telemetry["position"].tobytes() for one in flown}) == 1


@pytest.mark.parametrize(("words", "sentence"), TABLES["wrong_films"])
def test_wrong_input_is_one_sentence(
    any_opengl: None,
    words: str,
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    status, _, err = run(capsys, "render", *words.split())
    assert status == 1
    assert err.startswith("rotorgram: ")
    assert sentence in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_leaves_no_half_film(opengl: None, tmp_path: Path) -> None:
    out = tmp_path / "film.mp4"
    words = ("render", "pid", "--out", out, "--speed", "0.001", *SMALL)
    process = subprocess.Popen(
        [sys.executable, "-m", "rotorgram.cli", *map(str, words)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    while not list(tmp_path.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err == "rotorgram: interrupted\n"
    assert list(tmp_path.iterdir()) == []


# ---- where there is no OpenGL


SENTENCE = "apt-get install libegl1 libgl1-mesa-dri"


def test_without_opengl_it_is_one_sentence_and_status_2(tmp_path: Path) -> None:
    command = ["render", "pid", "--out", str(tmp_path / "film.mp4"), *SMALL]
    done = subprocess.run(
        [sys.executable, "-m", "rotorgram.cli", *command],
        env={**os.environ, "MUJOCO_GL": "disable"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("rotorgram: OpenGL: expected EGL")
    assert SENTENCE in done.stderr
    assert "MUJOCO_GL" in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("setting", ["nonsense", "osmesa"])
def test_a_wrong_mujoco_gl_is_one_sentence_of_what_draws(setting: str, tmp_path: Path) -> None:
    if ctypes.util.find_library("OSMesa") and setting == "osmesa":
        pytest.skip("OSMesa is installed")

    clean = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}  # MuJoCo sets it

    def done(*words: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "rotorgram.cli", *map(str, words)],
            env=clean | {"MUJOCO_GL": setting}, capture_output=True, text=True, check=False,
        )  # fmt: skip

    draws = done("render", "pid", "--out", tmp_path / "film.mp4", *SMALL)
    assert draws.returncode == 2
    expected = {
        "nonsense": "rotorgram: MUJOCO_GL: expected egl, osmesa, glfw or disable, got 'nonsense'\n",
        "osmesa": "osmesa: its library is not installed",
    }
    assert expected[setting] in draws.stderr
    assert draws.stderr.count("\n") == 1
    flies = done("evaluate", "pid", "--episodes", 1, "--episode-length", 5)
    assert flies.returncode == 0
    assert flies.stderr.count("Traceback") == 0


@pytest.fixture
def no_egl(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without libEGL and without a display."""

    def import_module(name: str) -> Any:
        raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")  # as PyOpenGL

    monkeypatch.setattr(gl, "import_module", import_module)
    for variable in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)


def test_without_libegl_it_says_what_to_install(
    no_egl: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "film.mp4"
    status, _, err = run(capsys, "render", "pid", "--out", out, *SMALL)
    assert (status, SENTENCE in err, err.count("\n")) == (2, True, 1)
    assert "egl: its library is not installed" in err
    assert list(tmp_path.iterdir()) == []
    assert run(capsys, "evaluate", "pid", "--episodes", 1, "--episode-length", 5)[0] == 0


@pytest.mark.parametrize(("variables", "tried"), TABLES["libraries"])
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have their own")
def test_which_opengl_is_tried(
    variables: dict[str, str], tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def import_module(name: str) -> Any:
        asked.append(name)
        raise ImportError

    monkeypatch.setattr(gl, "import_module", import_module)
    for variable in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(NoOpenGL):
        gl.offscreen_context(16, 16)
    assert asked == [f"mujoco.{name}" for name in tried]


# ---- the film of a comparison


@pytest.fixture
def comparison(training: Path, tmp_path: Path) -> Results:
    """A study of which one seed of A2C is done, beside a PID."""
    folder = tmp_path / "comparison"
    (folder / "checkpoints").mkdir(parents=True)
    data = (training / "checkpoint.safetensors").read_bytes()
    (folder / "checkpoints" / "a2c-seed0.safetensors").write_bytes(data)
    trained = load(training / "checkpoint.safetensors")
    env = EnvConfig.from_keywords(trained.env_id, **trained.spec.options)
    rows = tuple(Row(agent=agent, name=agent, env=env) for agent in ("a2c", "pid"))
    specs = dict.fromkeys(("a2c", "pid"), trained.spec)
    write_config(folder, "", Study(rows=rows, seeds=1), specs)
    for row in rows:
        tables = {}
        for name in ("evaluations", "runs"):
            tables[name] = pd.DataFrame(0.0, index=[0], columns=list(COLUMNS[name])[2:])
        tables["evaluations"]["episode"] = 0
        write_run(folder, row, 0, tables)
    return Results.read(folder)


def test_the_film_of_a_comparison_shows_its_agents(comparison: Results, opengl: None) -> None:
    out = comparison.folder / "video.mp4"
    film_study(comparison, out)
    frames = decoded(out, 1280, 400)
    assert len(frames) == 13
    left = frames[0][:, :639].astype(int)
    right = frames[0][:, 641:].astype(int)
    assert abs(left[100:300] - right[100:300]).mean() < 8  # they start alike
    names = sorted(path.name for path in comparison.folder.iterdir())
    assert names == ["checkpoints", "config.json", "evaluations", "runs", "video.mp4"]


def test_a_comparison_without_opengl_has_no_film(comparison: Results, no_egl: None) -> None:
    out = comparison.folder / "video.mp4"
    with pytest.raises(NoOpenGL) as told:
        film_study(comparison, out)
    assert SENTENCE in str(told.value)
    assert not out.exists()


# ---- the page


def test_the_page_tells_what_the_benchmark_wrote() -> None:
    docs = Path(__file__).parents[2] / "docs"
    page = (docs / "rendering.md").read_text()
    told = json.loads((docs / "results" / "performance" / "rendering.json").read_text())
    rates = told["pictures_per_second"]
    for size in ("640x360", "1280x720"):
        assert f"| {size} | {rates[size]} | {rates[f'{size}, fast']} |" in page
    assert (docs / "images" / "cameras.jpg").stat().st_size < 200_000
