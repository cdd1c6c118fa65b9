"""Films: every frame at its time, whole or not at all, panes side by side."""

import gc
import math
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imageio_ffmpeg import (  # type: ignore[import-untyped]
    count_frames_and_secs,
)
from pictures import HEIGHT, TABLES, WIDTH, decoded, ffmpeg_facts, nearest, pixels, same
from PIL import Image
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.filming import Film, FilmTrack, film, grid
from rotorgram.flights.trajectories import Trajectory
from rotorgram.models import InputError
from rotorgram.rendering import Camera, Canvas
from rotorgram.rendering.film import check_film, write_film

FAST = Film(width=WIDTH, height=HEIGHT, scene="plain", fast=True, overlay=False)


def trajectory(*elevations: float, ending: Any = "truncated") -> Trajectory:
    """A level craft at these elevations, one each 0.02 s, with its goal at 5 m."""
    heights = np.array(elevations)
    zeros = np.zeros_like(heights)
    steps = len(heights)
    errors = 5.0 - heights
    telemetry = {
        "position": np.stack((zeros, zeros, heights), axis=1),
        "attitude": np.tile((1.0, 0.0, 0.0, 0.0), (steps, 1)),
        "thrust": np.full((steps, 4), 49.0),
        "goal": np.tile((0.0, 0.0, 5.0), (steps, 1)),
        "metrics": errors[:, np.newaxis],
    }
    config = EnvConfig(env_id="rotorgram/Elevation-v0")
    return Trajectory(
        spec=env_spec(config),
        telemetry=telemetry,
        rewards=np.zeros(steps - 1),
        actions=np.zeros((steps - 1, 1)),
        ending=ending,
    )


def track(*trajectories: Trajectory, name: str = "PID") -> FilmTrack:
    return FilmTrack(name=name, trajectories=list(trajectories))


def swarm(*trajectories: Trajectory) -> FilmTrack:
    """The two drones of one world."""
    spec = replace(trajectories[0].spec, agents=("a", "b"))
    world = [replace(one, spec=spec) for one in trajectories]
    return FilmTrack(name="ORCA", trajectories=world, drones=2)


def greys(count: int, width: int = 64, height: int = 48) -> Iterator[np.ndarray]:
    """Frames that grow brighter by 4 each."""
    for number in range(count):
        brightness = 20 + 4 * number
        yield np.full((height, width, 3), brightness, np.uint8)


def test_mp4_has_every_frame_at_its_time(tmp_path: Path) -> None:
    path = tmp_path / "new" / "grey.mp4"
    write_film(path, greys(30), 25.0)
    told = ffmpeg_facts(path)
    for fact in ("Video: h264", "yuv420p", "64x48", "25 fps"):
        assert fact in told
    frames = decoded(path, 64, 48)
    found = frames.mean(axis=(1, 2, 3))
    expected = 20 + 4 * np.arange(30)
    np.testing.assert_allclose(found, expected, atol=3)
    count, seconds = count_frames_and_secs(str(path))
    assert count == 30
    assert seconds == pytest.approx(1.2, abs=0.01)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays before it is loaded whole


@pytest.mark.parametrize("package", ["PIL", "imageio_ffmpeg"])
def test_a_missing_package_is_one_sentence(package: str, tmp_path: Path) -> None:
    code = f"""
        import sys
        import numpy as np
        sys.modules[{package!r}] = None
        from pathlib import Path
        from rotorgram.models import MissingPackage
        try:
            from rotorgram.rendering.film import write_film
            write_film(Path("film.mp4"), [np.zeros((16, 16, 3), np.uint8)], 25.0)
        except MissingPackage as error:
            print(error)
        """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert f"needs the package {package}: pip install 'rotorgram[render]'" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_folder_and_picture_are_exact(tmp_path: Path) -> None:
    frames = list(greys(3))
    folder = tmp_path / "frames"
    write_film(folder, frames, 25.0)
    files = sorted(folder.iterdir())
    names = [file.name for file in files]
    assert names == ["0001.png", "0002.png", "0003.png"]
    for file, frame in zip(files, frames, strict=True):
        np.testing.assert_array_equal(pixels(file), frame)
    last = tmp_path / "last.png"
    write_film(last, frames, 25.0)
    np.testing.assert_array_equal(pixels(last), frames[-1])


@pytest.mark.parametrize("name", ["film.mp4", "film.png", "film"])
def test_what_is_broken_off_leaves_nothing(name: str, tmp_path: Path) -> None:
    def interrupted() -> Iterator[np.ndarray]:
        yield from greys(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / name, interrupted(), 25.0)
    assert list(tmp_path.iterdir()) == []


WRONG = TABLES["wrong_files"]


@pytest.mark.parametrize(("count", "width", "height", "name", "fps", "sentence"), WRONG)
def test_what_is_no_film_is_one_sentence(
    count: int, width: int, height: int, name: str, fps: float, sentence: str, tmp_path: Path
) -> None:
    there = tmp_path / "there"
    there.mkdir()
    frames = greys(count, width, height)
    with pytest.raises(InputError, match=sentence):
        write_film(tmp_path / name, frames, fps)
    left = list(tmp_path.iterdir())
    assert left == [there]


def test_a_frame_of_another_size_or_kind_is_our_fault(tmp_path: Path) -> None:
    sizes = [*greys(1), *greys(1, 32)]
    kind = [np.zeros((48, 64))]
    for frames in (sizes, kind):
        with pytest.raises(ValueError, match="film: expected frames of uint8") as raised:
            write_film(tmp_path / "film", iter(frames), 25.0)
        assert not isinstance(raised.value, InputError)
        assert list(tmp_path.iterdir()) == []


def test_a_picture_on_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    picture = tmp_path / "a.png"
    with pytest.raises(OSError, match="No space left on device") as told:
        write_film(picture, greys(1), 25.0)
    assert told.value.filename == str(picture)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_encoder_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    with pytest.raises(OSError, match="ffmpeg: the film could not be written"):
        write_film(tmp_path / "film.mp4", greys(3), 25.0)
    assert list(tmp_path.iterdir()) == []
    gc.collect()  # imageio-ffmpeg leaves the pipe of an encoder that ended open


def test_a_picture_of_odd_size_may_be_anything_but_mp4(tmp_path: Path) -> None:
    path = tmp_path / "film"
    check_film(path, 63, 47, 30.0)
    write_film(path, greys(2, 63, 47), 30.0)
    assert pixels(path / "0001.png").shape == (47, 63, 3)


@pytest.mark.parametrize(("count", "size", "expected"), TABLES["panes"])
def test_panes_are_about_as_high_as_wide(count: int, size: list[int], expected: list[int]) -> None:
    found = grid(count, *size)
    assert list(found) == expected


def frames_of(folder: Path) -> list[np.ndarray]:
    return [pixels(file) for file in sorted(folder.iterdir())]


def filmed(folder: Path, *tracks: FilmTrack, **settings: Any) -> list[np.ndarray]:
    """The frames of a film."""
    number = len(list(folder.iterdir()))
    out = folder / f"film{number}"
    config = replace(FAST, **settings)
    written = film(out, tracks, config)
    frames = frames_of(out)
    assert written == len(frames)
    return frames


def test_a_frame_shows_the_step_of_its_time(opengl: None, tmp_path: Path) -> None:
    climb = trajectory(*(4.0 + step / 10 for step in range(11)))  # 0.2 s
    for time, step in ((0, 0), (0.019, 0), (0.02, 1), (0.06, 3), (0.2, 10), (9, 10)):
        assert climb.step_at(time) == step
    flight = track(climb)
    every = filmed(tmp_path, flight, fps=50.0)
    assert len(every) == 11
    slow = [step // 2 for step in range(21)]
    for fps, speed, expected in (
        (25.0, 1.0, [0, 2, 4, 6, 8, 10]),
        (25.0, 2.0, [0, 4, 8]),
        (50.0, 0.5, slow),
    ):
        frames = filmed(tmp_path, flight, fps=fps, speed=speed)
        shown = [nearest(frame, every) for frame in frames]
        assert shown == expected


def test_panes_are_the_single_pictures_side_by_side(opengl: None, tmp_path: Path) -> None:
    one = trajectory(5.0, 5.1, 5.2)
    other = trajectory(4.0, 3.9, 3.8)
    width = 2 * WIDTH + 2
    both = filmed(tmp_path, track(one), track(other), width=width)
    high = HEIGHT // 4
    for number, frame in enumerate(both):
        assert frame.shape == (HEIGHT, width, 3)
        left = frame[:, :WIDTH]
        right = frame[:, WIDTH + 2 :]
        for flight, pane in ((one, left), (other, right)):
            single = filmed(tmp_path, track(flight))[number]
            assert same(pane[high:], single[high:])
            assert not same(pane[:high], single[:high])  # of several the names are told
        between = frame[:, WIDTH : WIDTH + 2]
        assert (between == (13, 18, 26)).all()


def test_a_flight_that_ended_stays_on_its_last_picture(opengl: None, tmp_path: Path) -> None:
    crash = trajectory(5.0, 4.0, 3.0, ending="terminated")  # 0.04 s
    long = trajectory(*[5.0] * 11)  # 0.2 s
    frames = filmed(tmp_path, track(crash), track(long), width=642, height=240, overlay=True)
    panes = [frame[:, :320] for frame in frames]
    assert len(frames) == 6
    assert not np.array_equal(panes[0], panes[1])
    for pane in panes[2:]:
        np.testing.assert_array_equal(pane, panes[1])
    other = [frame[:, 322:] for frame in frames]
    assert not np.array_equal(other[4], other[5])  # its time goes on


def test_a_note_tells_which_flights_ended_early() -> None:
    first = trajectory(5.0, 5.0, 5.0, ending="terminated")
    second = trajectory(8.0, 7.0, 6.0, 6.5)
    both = FilmTrack(name="ORCA", trajectories=[first, second], drones=2)
    notes = [both.note(0, step) for step in range(4)]
    assert notes == ["", "", "1 of 2 ended", "1 of 2 ended"]
    alone = track(first)
    assert alone.note(0, 1) == ""
    assert alone.note(0, 2) == "terminated"


def test_lines_have_name_time_metric_and_end(
    opengl: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of several drones the least distance; one that has ended stays where it is."""
    written: list[list[tuple[str, str]]] = []
    draw = Canvas.draw

    def noted(canvas: Canvas, camera: Camera, lines: Any) -> np.ndarray:
        written.append(list(lines))
        return draw(canvas, camera, lines)

    monkeypatch.setattr(Canvas, "draw", noted)
    first = trajectory(5.0, 4.0, 3.0, ending="terminated")
    second = trajectory(8.0, 8.0, 8.0, 5.0)
    filmed(tmp_path, track(first), overlay=True, fps=50.0)
    assert written[1] == [("PID", "0.02 s"), ("E", "1.000 m")]
    assert written[2] == [("PID", "0.04 s"), ("E", "2.000 m"), ("terminated", "")]
    written.clear()
    both = swarm(first, second)
    filmed(tmp_path, both, overlay=True, fps=50.0)
    second_lines = [lines[1] for lines in written]
    names, values = zip(*second_lines, strict=True)
    assert set(names) == {"least distance"}
    assert values == ("3.00 m", "4.00 m", "5.00 m", "2.00 m")
    assert written[2][2] == ("1 of 2 ended", "")


def test_a_film_of_several_drones(opengl: None, tmp_path: Path) -> None:
    still = trajectory(5.0, 5.0, 5.0)
    lower = swarm(still, trajectory(8.0, 7.5, 7.0))
    higher = swarm(still, trajectory(8.0, 7.5, 8.0))
    near = filmed(tmp_path, lower, overlay=True)
    far = filmed(tmp_path, higher, overlay=True)
    assert len(near) == len(far) == 2
    assert same(near[0], far[0])
    assert not same(near[1], far[1])  # the second is where it is


def test_episodes_follow_one_another_and_pictures_are_of_a_time(
    opengl: None, tmp_path: Path
) -> None:
    flight = track(trajectory(5.0, 5.1, 5.2), trajectory(4.0, 3.9, 3.8, 3.7, 3.6))
    frames = filmed(tmp_path, flight)
    assert len(frames) == 2 + 3
    out = tmp_path / "picture.png"
    for config, expected in ((FAST, 4), (replace(FAST, at=0.04), 1)):
        written = film(out, [flight], config)
        assert written == 1
        assert nearest(pixels(out), frames) == expected
        out.unlink()


def test_wrong_films_are_one_sentence(tmp_path: Path) -> None:
    for settings, sentence in (
        ({"speed": 0.0}, "speed: expected"),
        ({"speed": math.inf}, "speed: expected"),
        ({"at": -1.0}, "at: expected"),
    ):
        with pytest.raises(InputError, match=sentence):
            Film(**settings)  # type: ignore[arg-type]
    flight = trajectory(5.0)
    uneven = [track(flight), track(flight, flight)]
    for tracks in ([], [track()], uneven):
        with pytest.raises(InputError, match="tracks: expected one or more"):
            film(tmp_path / "film.mp4", tracks, FAST)


def test_a_film_without_end_is_refused(tmp_path: Path) -> None:
    """A peer may name a control period of a quarter of an hour; the film would hold hours."""
    flown = trajectory(*[5.0] * 50)
    spec = replace(flown.spec, control_period=1e3)
    slow = replace(flown, spec=spec)
    sentence = r"film: expected at most 1,000,000 frames, got 1,22\d,\d+"
    with pytest.raises(InputError, match=sentence):
        film(tmp_path / "film.mp4", [track(slow)], FAST)
    assert not list(tmp_path.iterdir())
