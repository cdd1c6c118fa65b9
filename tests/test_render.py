"""Pictures and films: coarse facts of what is in them, and that flights are those that were flown.

No pixel is compared with a stored one: drivers differ.
"""

import json
import logging
import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import rotorgram.rendering.gl as gl
from imageio_ffmpeg import (  # type: ignore[import-untyped]
    count_frames_and_secs,
    get_ffmpeg_exe,
)
from peers import ANY, Running
from PIL import Image
from rotorgram.agents.checkpoints import load
from rotorgram.agents.pid import PID
from rotorgram.cli import main
from rotorgram.cli.inputs import load_policy
from rotorgram.envs import ElevationConfig, ElevationEnv
from rotorgram.experiments.comparison_film import film_comparison
from rotorgram.experiments.evaluate import evaluation_seed, fly
from rotorgram.experiments.filming import Film, Shot, film, grid
from rotorgram.experiments.flights import Track, flown_tracks, recorded_tracks
from rotorgram.experiments.pairs import socket_pair
from rotorgram.experiments.records import EVALUATION_COLUMNS
from rotorgram.experiments.runs import write_config
from rotorgram.rendering import CAMERAS, Camera, Canvas, Moment, NoOpenGL, Stage
from rotorgram.rendering.film import check_film, write_film
from rotorgram.rendering.overlay import Overlay
from rotorgram.udp import RemoteVectorEnv, Simulator

WIDTH, HEIGHT = 160, 120
SHORT = ElevationConfig(episode_length=25)  # half a second
FAST = Film(width=WIDTH, height=HEIGHT, world="plain", fast=True, overlay=False)


@pytest.fixture(scope="module")
def opengl() -> None:
    """What draws."""
    try:
        gl.offscreen_context(16, 16).free()
    except NoOpenGL as error:
        pytest.skip(str(error))


def at(elevation: float, error: float = 0.0, **rest: Any) -> Moment:
    """A level craft over the origin."""
    return Moment(
        position=(0.0, elevation, 0.0),
        attitude=(0.0, 0.0, 0.0),
        thrusts=(49.0, 49.0, 49.0, 49.0),
        error=error,
        **rest,
    )


def track(*elevations: float, target: float = 5.0, ending: Any = "truncated") -> Track:
    moments = [at(y, target - y, step=step) for step, y in enumerate(elevations)]
    return Track(moments=moments, control_period=0.02, ending=ending)


def shot(*tracks: Track, name: str = "PID") -> Shot:
    return Shot(name=name, color="#7CC8F2", tracks=list(tracks))


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def decoded(path: Path, width: int, height: int) -> np.ndarray:
    """Every frame of a film: uint8, shape (frames, height, width, 3)."""
    words = ["-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    data = subprocess.run([get_ffmpeg_exe(), *words], capture_output=True, check=True).stdout
    return np.frombuffer(data, np.uint8).reshape(-1, height, width, 3)


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two pictures are one, drawn twice: drivers round now so, now so."""
    return one.shape == other.shape and int(abs(one.astype(int) - other).max()) <= 3


def told_of(path: Path) -> str:
    """What ffmpeg tells of a film."""
    words = [get_ffmpeg_exe(), "-i", str(path)]
    return subprocess.run(words, capture_output=True, text=True, check=False).stderr


# ---- what is in a picture


@pytest.fixture(scope="module")
def stage(opengl: None) -> Stage:
    return Stage("plain")


@pytest.fixture(scope="module")
def canvas(stage: Stage) -> Iterator[Canvas]:
    with Canvas(stage, WIDTH, HEIGHT, fast=True) as canvas:
        yield canvas


def craft_in(canvas: Canvas, camera: Camera) -> np.ndarray:
    """Where the picture changes when the craft is hidden: bool, shape (HEIGHT, WIDTH)."""
    model = canvas.stage.model
    geoms = model.geom_bodyid == model.body("quad").id
    groups = model.geom_group.copy()
    there = canvas.draw(camera).astype(int)
    model.geom_group[geoms] = 5  # is not drawn
    gone = canvas.draw(camera).astype(int)
    model.geom_group[:] = groups
    different: np.ndarray = abs(there - gone).max(axis=2) > 12
    return different


def pixels_per_metre(stage: Stage, camera: Camera) -> float:
    """At the distance of what the camera looks at."""
    view = math.radians(stage.model.vis.global_.fovy)
    return float(HEIGHT / 2 / math.tan(view / 2) / stage.camera(camera).distance)


@pytest.mark.parametrize("camera", ["chase", "front", "side", "top"])
def test_the_craft_is_in_the_midst_of_the_picture_and_as_large_as_it_should_be(
    camera: Camera, stage: Stage, canvas: Canvas
) -> None:
    stage.show(at(5.0))
    rows, columns = np.nonzero(craft_in(canvas, camera))
    assert columns.mean() == pytest.approx(WIDTH / 2, abs=3)
    lower = 0.75 * pixels_per_metre(stage, camera) if camera in ("front", "side") else 0.0
    assert rows.mean() == pytest.approx(HEIGHT / 2 - lower, abs=8)  # they look below the target
    wide = 2.8 * pixels_per_metre(stage, camera)  # rotors of 0.8 m on a square of 2 m
    assert np.ptp(columns) == pytest.approx(wide, rel=0.25)  # what is nearer is larger
    if camera == "top":
        assert np.ptp(rows) == pytest.approx(wide, rel=0.25)
    else:
        assert np.ptp(rows) < wide / 2


@pytest.mark.parametrize("camera", CAMERAS)
def test_the_craft_is_at_the_airport_too(camera: Camera, opengl: None) -> None:
    with Canvas(Stage("airport"), WIDTH, HEIGHT, fast=True) as canvas:
        canvas.stage.show(at(5.0, error=0.5))
        craft, picture = craft_in(canvas, camera), canvas.draw(camera).astype(int)
    assert 0.002 < craft.mean() < 0.5
    assert craft[:, : WIDTH // 2].sum() == pytest.approx(craft[:, WIDTH // 2 :].sum(), rel=0.4)
    if camera != "top":
        sky = picture[: HEIGHT // 12, -WIDTH // 8 :]
        assert (sky[..., 2] - sky[..., 0]).mean() > 20


def test_onboard_sees_the_front_rotors_to_both_sides(stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0))
    seen = craft_in(canvas, "onboard")
    red, _, blue = np.moveaxis(canvas.draw("onboard").astype(int), 2, 0)
    orange = seen & (red > blue + 40)  # the front rotors' colour
    halves = orange[:, : WIDTH // 2].sum(), orange[:, WIDTH // 2 :].sum()
    assert min(halves) > 0.01 * WIDTH * HEIGHT
    assert halves[0] == pytest.approx(halves[1], rel=0.4)  # the blades are turned differently
    assert not orange[: HEIGHT // 4].any()


@pytest.mark.parametrize("camera", ["chase", "front", "side", "onboard"])
def test_the_sky_is_above_the_ground(camera: Camera, stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0, error=50.0 if camera in ("chase", "onboard") else 0.0))
    picture = canvas.draw(camera).astype(int)
    edges = picture[:, [0, WIDTH // 2, -1] if camera != "onboard" else [WIDTH // 2]]
    blue = edges[..., 2] - edges[..., 0]
    assert blue[: HEIGHT // 20].min() > 40
    assert blue[-HEIGHT // 20 :].max() < 40


def test_the_horizon_is_where_the_pitch_of_the_camera_puts_it(stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0))
    for camera in ("chase", "side"):
        down = math.radians(-stage.camera(camera).elevation)
        focal = HEIGHT / 2 / math.tan(math.radians(stage.model.vis.global_.fovy) / 2)
        row = HEIGHT / 2 - focal * math.tan(down)
        picture = canvas.draw(camera).astype(int)
        # The floor's checks begin there: above it a row has one colour.
        lively = np.nonzero(np.ptp(picture[:, :40], axis=1).max(axis=1) > 12)[0]
        assert lively.min() == pytest.approx(row, abs=9), camera


def green_in(picture: np.ndarray) -> np.ndarray:
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    disc: np.ndarray = (green > red + 25) & (green > blue + 10)
    return disc


@pytest.mark.parametrize(
    ("camera", "size"), [("front", (320, 400)), ("side", (640, 360)), ("side", (1280, 720))]
)
@pytest.mark.parametrize("error", [-3.0, 3.0])
def test_a_craft_3_m_from_its_target_is_above_the_strip(
    error: float, camera: Camera, size: tuple[int, int], stage: Stage, canvas: Canvas
) -> None:
    overlay = Overlay(*size, title="PID", period=0.02, seconds=5.0, band=1.0)
    stage.show(at(5.0 - error, error))
    rows, columns = np.nonzero(craft_in(canvas, camera))
    scale = size[1] / HEIGHT  # the height says how large things are
    assert rows.min() * scale > 0.05 * size[1]
    assert rows.max() * scale < overlay.strip.upper
    across = (columns - WIDTH / 2) * scale + size[0] / 2
    free = (across > overlay.panel.right) | (rows * scale > overlay.panel.lower)
    assert free.mean() > 0.45  # about half of it or more is beside the panel, or below


@pytest.mark.parametrize("camera", ["front", "side"])
def test_cameras_that_stand_still_stay_above_the_ground(camera: Camera, stage: Stage) -> None:
    stage.show(at(0.2))
    view = stage.camera(camera)
    assert view.lookat[2] - view.distance * math.sin(math.radians(view.elevation)) > 1.0


def test_onboard_has_no_disc_in_its_way(stage: Stage, canvas: Canvas) -> None:
    for error in (-0.2, 0.0, 0.2):
        stage.show(at(5.0, error=error))
        assert green_in(canvas.draw("onboard")).sum() == 0


@pytest.mark.parametrize("camera", ["chase", "front", "side", "top"])
def test_the_disc_marks_the_target(camera: Camera, stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0, error=-0.2))
    assert green_in(canvas.draw(camera)).sum() > 20
    assert green_in(canvas.draw(camera, stage.twin())).sum() == 0  # nothing shown yet


def test_a_craft_below_its_target_is_so_far_below_the_disc(stage: Stage, canvas: Canvas) -> None:
    stage.show(at(4.0, error=1.0))
    disc = np.nonzero(green_in(canvas.draw("side")))[0].mean()
    craft = np.nonzero(craft_in(canvas, "side"))[0].mean()
    assert craft - disc == pytest.approx(pixels_per_metre(stage, "side"), abs=4)


def test_the_path_leads_to_where_it_was(stage: Stage, canvas: Canvas) -> None:
    for step in range(61):
        stage.show(at(3.0 + step / 40, error=50.0, step=step))  # 1.5 m upwards, no disc in sight
    red, _, blue = np.moveaxis(canvas.draw("chase").astype(int), 2, 0)
    hidden = craft_in(canvas, "chase")
    path = (red > blue + 40) & ~hidden
    rows = np.nonzero(path)[0]
    assert rows.size > 10
    assert rows.mean() > np.nonzero(hidden)[0].mean()  # below the craft
    stage.show(at(4.5, error=50.0, step=0))  # another episode
    red, _, blue = np.moveaxis(canvas.draw("chase").astype(int), 2, 0)
    assert ((red > blue + 40) & ~hidden).sum() < 5


def test_twins_share_a_canvas_and_nothing_else(stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0))
    before = canvas.draw("side")
    twin = stage.twin()
    twin.show(at(3.0, error=2.0))
    other = canvas.draw("side", twin)
    assert not same(before, other)
    assert same(canvas.draw("side"), before)
    with pytest.raises(ValueError, match="stage: expected the canvas's own or a twin"):
        canvas.draw("side", Stage("plain"))


def test_shadows_and_smooth_edges_are_there_unless_it_is_to_be_fast(opengl: None) -> None:
    stage = Stage("plain")
    stage.show(at(1.0, error=50.0))
    with Canvas(stage, WIDTH, HEIGHT) as canvas:
        smooth = canvas.draw("chase").astype(int)
    with Canvas(stage, WIDTH, HEIGHT, fast=True) as canvas:
        rough = canvas.draw("chase").astype(int)
    darker = (rough - smooth).min(axis=2) > 30
    assert darker.sum() > 50  # the shadow, below the craft
    assert np.nonzero(darker)[0].mean() > HEIGHT / 2


# ---- what is written on it


def test_the_curve_has_the_colour_of_the_flight_and_the_place_of_its_errors() -> None:
    overlay = Overlay(640, 360, title="A2C", color="#00FF00", period=0.02, seconds=5.0, band=1.0)
    picture = np.zeros((360, 640, 3), np.uint8)
    drawn = overlay.draw(picture, at(5.0, step=125), [0.5] * 126)  # 2.5 s of 5 s
    strip = np.zeros((360, 640), bool)
    strip[int(360 * 0.75) :] = True
    curve = (drawn[..., 1] > 200) & (drawn[..., 0] < 60) & strip
    rows, columns = np.nonzero(curve)
    left, right = overlay.plot[0], overlay.plot[2]
    assert columns.min() == pytest.approx(left, abs=3)
    assert columns.max() == pytest.approx((left + right) / 2, abs=5)
    upper, lower = overlay.plot[1], overlay.plot[3]
    assert rows.mean() == pytest.approx(upper + (lower - upper) / 4, abs=2)  # halfway to +1 m
    assert not picture.any()


def lit(overlay: Overlay, errors: list[float], height: int, width: int) -> np.ndarray:
    """Where the green of a curve is in its plot: bool, shape of the plot."""
    drawn = overlay.draw(np.zeros((height, width, 3), np.uint8), at(1.0), errors).astype(int)
    left, upper, right, lower = overlay.plot
    part = drawn[upper : lower + 1, left : right + 1]
    green: np.ndarray = (part[..., 1] > 150) & (part[..., 0] < 80)
    return green


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_curve_that_leaves_its_scale_has_no_plateau(side: float) -> None:
    overlay = Overlay(640, 360, title="x", color="#00FF00", period=0.02, seconds=2.0, band=0.5)
    rising = [side * step / 50 for step in range(101)]  # reaches the edge after 0.5 s of 2 s
    green = lit(overlay, rising, 360, 640)
    columns, middle = np.nonzero(green)[1], green.shape[0] // 2
    edge = green.shape[1] / 4
    assert columns.max() == pytest.approx(edge, abs=6)  # half a triangle
    triangle = green[:, round(edge) - 6 : round(edge) + 7]
    wide = triangle.sum(axis=1)
    outer, inner = (wide[:middle], wide[middle:]) if side > 0 else (wide[middle:], wide[:middle])
    assert outer.max() >= 6
    assert not inner.any()
    back = lit(overlay, [*rising[:51], *rising[50::-1]], 360, 640)  # beyond from 0.5 to 1.5 s
    width = back.shape[1]
    assert not back[:, round(0.28 * width) : round(0.74 * width)].any()
    assert back[:, round(0.8 * width) : round(0.98 * width)].any(axis=0).all()


def test_a_step_across_the_scale_is_drawn_and_marked_where_it_leaves() -> None:
    overlay = Overlay(640, 360, title="x", color="#00FF00", period=0.02, seconds=0.04, band=1.0)
    green = lit(overlay, [0.0, 2.0, -2.0], 360, 640)
    high, wide = green.shape
    assert green[high // 2, round(0.7 * wide) : round(0.8 * wide)].any()  # through 0 after 0.03 s
    assert not green[:, round(0.3 * wide) : round(0.6 * wide)].any()  # above from 0.01 to 0.025 s
    assert not green[:, round(0.92 * wide) :].any()  # below from 0.035 s on


def test_errors_beyond_the_band_stay_inside_the_strip() -> None:
    overlay = Overlay(320, 240, title="x", color="#00FF00", period=0.02, seconds=1.0, band=0.5)
    drawn = overlay.draw(np.zeros((240, 320, 3), np.uint8), at(1.0), [0.0, 90.0, -90.0])
    rows = np.nonzero((drawn[120:, :, 1] > 200) & (drawn[120:, :, 0] < 60))[0] + 120
    assert rows.min() >= overlay.plot[1] - 1
    assert rows.max() <= overlay.plot[3] + 1


@pytest.mark.parametrize("size", [(640, 360), (320, 400), (320, 240), (1280, 720)])
def test_full_thrusts_do_not_lie_on_their_name(size: tuple[int, int]) -> None:
    overlay = Overlay(*size, title="x", period=0.02, seconds=1.0, band=1.0)

    def drawn(thrust: float) -> np.ndarray:
        moment = Moment(position=(0, 5, 0), attitude=(0, 0, 0), thrusts=(thrust,) * 4, error=0.0)
        return overlay.draw(np.zeros((*size[::-1], 3), np.uint8), moment, [0.0]).astype(int)

    nothing, full = drawn(0.0), drawn(100.0)
    bars = np.nonzero((np.abs(full - (120, 190, 255)).max(axis=2) < 4).any(axis=1))[0].min()
    values = (nothing != full).any(axis=2)[: bars - 3]
    rows, columns = np.nonzero(values)
    written = (nothing[rows.min() : rows.max() + 1] > 90).all(axis=2).any(axis=0)
    name = np.nonzero(written[: overlay.panel.right // 2])[0]
    gaps = np.nonzero(np.diff(name) > size[1] / 40)[0]  # between words it is less
    end = name[gaps[0]] if gaps.size else name[-1]
    assert end > overlay.panel.left + 3 * size[1] / 100
    assert columns.min() > end + 2


def test_bars_grow_with_the_thrust() -> None:
    def bar_pixels(thrust: float) -> int:
        overlay = Overlay(640, 360, title="x", period=0.02, seconds=1.0, band=1.0)
        moment = Moment(position=(0, 5, 0), attitude=(0, 0, 0), thrusts=(thrust,) * 4, error=0.0)
        drawn = overlay.draw(np.zeros((360, 640, 3), np.uint8), moment, [0.0])
        return int((np.abs(drawn.astype(int) - (120, 190, 255)).max(axis=2) < 4).sum())

    nothing, half, full = (bar_pixels(thrust) for thrust in (0.0, 50.0, 100.0))
    assert nothing < 0.1 * half
    assert half == pytest.approx(full / 2, rel=0.15)


@pytest.mark.parametrize(
    ("size", "numbers", "strip"),
    [
        ((640, 360), True, True),
        ((320, 400), True, True),
        ((320, 240), True, True),
        ((480, 200), True, False),
        ((240, 160), False, False),  # numbers would cover the craft
        ((160, 120), False, False),
        ((100, 900), False, False),
    ],
)
def test_what_is_too_small_to_be_read_is_left_out(
    size: tuple[int, int], numbers: bool, strip: bool
) -> None:
    overlay = Overlay(*size, title="PID", color="#00FF00", period=0.02, seconds=1.0, band=1.0)
    assert (overlay.has_numbers, overlay.has_strip) == (numbers, strip)
    drawn = overlay.draw(np.zeros((*size[::-1], 3), np.uint8), at(5.0), [0.0, 0.5, 0.0])
    green = (drawn[..., 1] > 150) & (drawn[..., 0] < 80)
    assert green[: overlay.panel.lower].any()  # the title
    assert green[overlay.panel.lower :].any() == strip
    assert (drawn[..., 0] > 220).any() == (numbers or strip)
    alone = Overlay(*size, title="PID", period=0.02, seconds=1.0, band=1.0, numbers=False)
    assert (alone.has_numbers, alone.has_strip) == (False, False)


def test_an_overlay_covers_little_and_fits_any_size() -> None:
    grey = np.full((360, 640, 3), 128, np.uint8)
    overlay = Overlay(640, 360, title="x" * 200, period=0.02, seconds=1.0, band=1.0)
    drawn = overlay.draw(grey, at(5.0), [0.0], note="terminated")
    assert (drawn[200:260] == grey[200:260]).all()  # where the craft is
    for width, height in ((16, 16), (160, 120), (100, 900), (900, 100)):
        small = Overlay(width, height, title="name", period=0.02, seconds=1.0, band=1.0)
        picture = np.zeros((height, width, 3), np.uint8)
        assert small.draw(picture, at(5.0), [0.1, 0.2], "terminated").shape == picture.shape
    with pytest.raises(ValueError, match="picture: expected"):
        overlay.draw(np.zeros((10, 10, 3), np.uint8), at(5.0), [0.0])


# ---- films


def greys(count: int, width: int = 64, height: int = 48) -> Iterator[np.ndarray]:
    """Frames that grow brighter by 4 each."""
    for number in range(count):
        yield np.full((height, width, 3), 20 + 4 * number, np.uint8)


def test_mp4_has_every_frame_at_its_time(tmp_path: Path) -> None:
    path = tmp_path / "new" / "grey.mp4"
    assert write_film(path, greys(30), 25.0) == 30
    told = told_of(path)
    for fact in ("Video: h264", "yuv420p", "64x48", "25 fps"):
        assert fact in told
    frames = decoded(path, 64, 48).mean(axis=(1, 2, 3))
    np.testing.assert_allclose(frames, [20 + 4 * number for number in range(30)], atol=3)
    count, seconds = count_frames_and_secs(str(path))
    assert (count, seconds) == (30, pytest.approx(1.2, abs=0.01))
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays before it is loaded whole


def test_gif_repeats_with_every_frame(tmp_path: Path) -> None:
    path = tmp_path / "grey.gif"
    write_film(path, greys(7), 20.0)
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0
        assert (gif.size, gif.n_frames) == ((64, 48), 7)  # type: ignore[attr-defined]
        for number in range(7):
            gif.seek(number)
            assert gif.info["duration"] == 50
            assert np.asarray(gif.convert("RGB")).mean() == pytest.approx(20 + 4 * number, abs=1)


def test_folder_and_picture_are_exact(tmp_path: Path) -> None:
    write_film(tmp_path / "frames", greys(3), 25.0)
    files = sorted((tmp_path / "frames").iterdir())
    assert [file.name for file in files] == ["0001.png", "0002.png", "0003.png"]
    for file, frame in zip(files, greys(3), strict=True):
        np.testing.assert_array_equal(pixels(file), frame)
    write_film(tmp_path / "last.png", greys(3), 25.0)
    np.testing.assert_array_equal(pixels(tmp_path / "last.png"), list(greys(3))[-1])


@pytest.mark.parametrize("name", ["film.mp4", "film.gif", "film.png", "film"])
def test_what_is_broken_off_leaves_nothing(name: str, tmp_path: Path) -> None:
    def interrupted() -> Iterator[np.ndarray]:
        yield from greys(3)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_film(tmp_path / name, interrupted(), 25.0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "frames", "fps", "sentence"),
    [
        ("film.avi", greys(1), 25.0, "film: expected a name that ends in .mp4, .gif or .png"),
        ("there", greys(1), 25.0, "there is there already"),
        ("film.mp4", greys(1, 63), 25.0, "film: expected an even width and an even height"),
        ("film.gif", greys(1), 30.0, "fps: expected 100 divided by a whole number"),
        ("film.mp4", greys(1), 0.0, "fps: expected 0.01 to 1000"),
        ("film.mp4", greys(1), math.nan, "fps: expected 0.01 to 1000"),
        ("film.mp4", greys(0), 25.0, "film: expected at least one frame"),
        ("film", iter([*greys(1), *greys(1, 32)]), 25.0, "film: expected frames of uint8"),
        ("film", iter([np.zeros((48, 64))]), 25.0, "film: expected frames of uint8"),
    ],
)
def test_what_is_no_film_is_one_sentence(
    name: str, frames: Iterator[np.ndarray], fps: float, sentence: str, tmp_path: Path
) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(ValueError, match=sentence):
        write_film(tmp_path / name, frames, fps)
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_an_encoder_that_fails_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    with pytest.raises(OSError, match="ffmpeg: the film could not be written"):
        write_film(tmp_path / "film.mp4", greys(3), 25.0)
    assert list(tmp_path.iterdir()) == []


def test_a_picture_of_odd_size_may_be_anything_but_mp4(tmp_path: Path) -> None:
    check_film(tmp_path / "film.gif", 63, 47, 25.0)
    check_film(tmp_path / "film", 63, 47, 30.0)


# ---- flights on film


@pytest.mark.parametrize(
    ("count", "size", "expected"),
    [
        (1, (1280, 720), (1, 1)),
        (2, (1280, 720), (2, 1)),
        (3, (1280, 720), (3, 1)),
        (4, (1280, 720), (2, 2)),
        (4, (1280, 400), (4, 1)),
        (4, (400, 1600), (1, 4)),
        (6, (1280, 720), (3, 2)),
    ],
)
def test_panes_are_about_as_high_as_wide(
    count: int, size: tuple[int, int], expected: tuple[int, int]
) -> None:
    assert grid(count, *size) == expected


def frames_of(folder: Path) -> list[np.ndarray]:
    return [pixels(file) for file in sorted(folder.iterdir())]


def filmed(folder: Path, *shots: Shot, **settings: Any) -> list[np.ndarray]:
    """The frames of a film."""
    out = folder / f"film{len(list(folder.iterdir()))}"
    config = Film(**{**asdict(FAST), **settings})
    assert film(out, shots, config) == len(list(out.iterdir()))
    return frames_of(out)


def test_a_frame_shows_the_step_of_its_time(opengl: None, tmp_path: Path) -> None:
    flight = shot(track(*(4.0 + step / 10 for step in range(11))))  # 0.2 s
    assert [flight.tracks[0].step_at(t) for t in (0, 0.019, 0.02, 0.06, 0.2, 9)] == [
        0, 0, 1, 3, 10, 10,
    ]  # fmt: skip
    every = filmed(tmp_path, flight, fps=50.0)
    assert len(every) == 11
    for settings, steps in (
        ({"fps": 25.0}, [0, 2, 4, 6, 8, 10]),
        ({"fps": 25.0, "speed": 2.0}, [0, 4, 8]),
        ({"fps": 50.0, "speed": 0.5}, [step // 2 for step in range(21)]),
    ):
        frames = filmed(tmp_path, flight, **settings)
        assert len(frames) == len(steps)
        for frame, step in zip(frames, steps, strict=True):
            assert [same(frame, one) for one in every].index(True) == step


def test_panes_are_the_single_pictures_side_by_side(opengl: None, tmp_path: Path) -> None:
    one, other = track(5.0, 5.1, 5.2), track(4.0, 3.9, 3.8)
    both = filmed(tmp_path, shot(one), shot(other), width=2 * WIDTH + 2)
    for number, frame in enumerate(both):
        assert frame.shape == (HEIGHT, 2 * WIDTH + 2, 3)
        for flight, columns in ((one, slice(0, WIDTH)), (other, slice(WIDTH + 2, None))):
            single, title = filmed(tmp_path, shot(flight))[number], slice(0, HEIGHT // 5)
            assert same(frame[HEIGHT // 5 :, columns], single[HEIGHT // 5 :])
            assert not same(frame[title, columns], single[title])  # of several the names are told
        assert (frame[:, WIDTH : WIDTH + 2] == (13, 18, 26)).all()


def alarms_in(picture: np.ndarray) -> int:
    """Pixels of the colour in which is written how a flight ended."""
    return int((np.abs(picture.astype(int) - (255, 107, 96)).max(axis=2) < 40).sum())


def test_a_flight_that_ended_stays_on_its_last_picture(opengl: None, tmp_path: Path) -> None:
    crash = track(5.0, 4.0, 3.0, ending="terminated")  # 0.04 s
    long = track(*[5.0] * 11)  # 0.2 s
    frames = filmed(tmp_path, shot(crash), shot(long), width=642, height=240, overlay=True)
    panes = [frame[:, :320] for frame in frames]
    assert len(frames) == 6
    assert alarms_in(panes[0]) == 0
    assert alarms_in(panes[1]) > 20
    for pane in panes[2:]:
        np.testing.assert_array_equal(pane, panes[1])
    assert not np.array_equal(frames[4][:, 322:], frames[5][:, 322:])  # the other's time goes on
    assert all(alarms_in(frame[:, 322:]) == 0 for frame in frames)


def test_the_scale_holds_crashes_if_there_is_nothing_else(opengl: None, tmp_path: Path) -> None:
    crash = track(*(5.0 - 0.03 * step for step in range(101)), ending="terminated")  # E to 3 m
    hovers = track(*[5.0] * 101)
    size = {"height": 240, "overlay": True, "fps": 0.5}
    alone = filmed(tmp_path, shot(crash), width=320, **size)[-1]
    beside = filmed(tmp_path, shot(crash), shot(hovers), width=642, **size)[-1][:, :320]
    strip = Overlay(320, 240, title="PID", period=0.02, seconds=2.0, band=3.0).plot
    columns = [
        np.nonzero(np.abs(part[190:].astype(int) - (124, 200, 242)).max(axis=2) < 40)[1]
        for part in (alone, beside)
    ]
    assert columns[0].max() == pytest.approx(strip.right, abs=4)  # to its end
    assert columns[1].max() < strip.left + 20  # of 0.1 m it is out after 0.08 s


def test_episodes_follow_one_another_and_pictures_are_of_a_time(
    opengl: None, tmp_path: Path
) -> None:
    flight = shot(track(5.0, 5.1, 5.2), track(4.0, 3.9, 3.8, 3.7, 3.6))
    frames = filmed(tmp_path, flight)
    assert len(frames) == 2 + 3
    for settings, expected in (({}, frames[-1]), ({"at": 0.04}, frames[1])):
        out = tmp_path / f"picture{len(settings)}.png"
        assert film(out, [flight], Film(**{**asdict(FAST), **settings})) == 1
        assert same(pixels(out), expected)


def test_wrong_films_are_one_sentence(tmp_path: Path) -> None:
    for settings, sentence in (
        ({"speed": 0.0}, "speed: expected"),
        ({"speed": math.inf}, "speed: expected"),
        ({"at": -1.0}, "at: expected"),
    ):
        with pytest.raises(ValueError, match=sentence):
            Film(**settings)  # type: ignore[arg-type]
    for shots in ([], [shot()], [shot(track(5.0)), shot(track(5.0), track(5.0))]):
        with pytest.raises(ValueError, match="shots: expected one or more"):
            film(tmp_path / "film.gif", shots, FAST)


# ---- where flights come from


def test_a_recorded_flight_is_the_one_that_was_flown(tmp_path: Path) -> None:
    journal = tmp_path / "pid.mcap"
    with socket_pair(SHORT, record=journal) as env:
        for episode in range(2):
            fly(env, PID(SHORT), evaluation_seed(episode))
        env.reset(seed=3)  # given up at once: no episode
        env.reset(seed=4)
        env.step(np.zeros(1, np.float32))  # cut off
    flown = flown_tracks(PID(SHORT), SHORT, [0, 1])
    recorded = recorded_tracks(journal, [0, 1, 2])
    for one, other in zip(flown, recorded, strict=False):
        assert repr(one) == repr(other)  # every bit of every number
        assert (len(one.moments), one.ending, one.seconds) == (26, "truncated", 0.5)
    last = recorded[2]
    assert (len(last.moments), last.ending, last.moments[1].episode) == (2, "cut off", 2)
    start = last.moments[0]
    assert start.target == pytest.approx(5.0, abs=1e-6)
    assert (start.step, start.reward) == (0, 0.0)
    with pytest.raises(ValueError, match=r"episode: expected 0 to 2 in .*, got 3"):
        recorded_tracks(journal, [3])


def test_any_drone_of_any_session(tmp_path: Path) -> None:
    journal = tmp_path / "two.mcap"
    options: dict[str, Any] = {"timeout": 5, "connect_timeout": 5, "connect": False}
    options |= {"num_envs": 2, "autoreset_mode": "Disabled"}
    actions = np.full((2, 1), 0.25, np.float32)
    with closing(RemoteVectorEnv(ANY, record=journal, **options)) as remote:
        running = Running(Simulator(server=remote.address, bind=ANY, num_envs=2))
        remote.reset(seed=[7, 8])
        for _ in range(5):
            remote.step(actions)
        remote.reset(options={"reset_mask": np.array([False, True])})  # the first one waits
        for _ in range(3):
            remote.step(actions)
    running.join()
    env = ElevationEnv()
    for seed, drone, steps in ((7, 0, 8), (8, 1, 5)):
        _, info = env.reset(seed=seed)
        heights = [info["Y"]]
        for _ in range(steps):
            heights.append(env.step(actions[0])[4]["Y"])
        (found,) = recorded_tracks(journal, [0], drone=drone)
        assert [moment.position[1] for moment in found.moments] == heights
        assert found.ending == "cut off"
    (second,) = recorded_tracks(journal, [1], drone=1, session=1)
    assert [(moment.step, moment.episode) for moment in second.moments] == [
        (step, 1) for step in range(4)
    ]
    for choice, sentence in (
        ({"drone": 2}, "drone: expected 0 to 1 in .*, got 2"),
        ({"drone": -1}, "drone: expected 0 to 1"),
        ({"session": 2}, "session: expected 1 to 1, got 2"),
        ({"session": 0}, "session: expected 1 to 1, got 0"),
    ):
        with pytest.raises(ValueError, match=sentence):
            recorded_tracks(journal, [0], **choice)


def test_what_holds_no_flight_is_one_sentence(tmp_path: Path) -> None:
    journal = tmp_path / "nothing.mcap"
    with socket_pair(SHORT, record=journal) as env:
        env.reset(seed=0)
    with pytest.raises(ValueError, match="expected an episode in which something was flown"):
        recorded_tracks(journal, [0])
    (tmp_path / "text.mcap").write_text("no journal")
    with pytest.raises(ValueError, match="expected an MCAP file"):
        recorded_tracks(tmp_path / "text.mcap", [0])
    with pytest.raises(ValueError, match=r"nowhere\.mcap: expected a journal"):
        recorded_tracks(tmp_path / "nowhere.mcap", [0])


def test_random_flights_are_the_same_for_the_same_episode() -> None:
    first, second = flown_tracks(None, SHORT, [0, 1])
    (again,) = flown_tracks(None, SHORT, [1])
    assert repr(again) == repr(second)
    assert repr(first) != repr(second)


# ---- the command


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as end:
        status = int(end.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


SMALL = ("--size", f"{WIDTH}x{HEIGHT}", "--world", "plain", "--fast")


@pytest.fixture(scope="module")
def training(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of 200 steps in a process of its own, which must not have touched what draws."""
    folder = tmp_path_factory.mktemp("training") / "run"
    code = """
        import sys
        from rotorgram.cli import main
        import rotorgram.cli.compare, rotorgram.cli.sweep
        status = main(["train", "a2c", "--env-steps", "200", "--out", sys.argv[1],
                       "--set", "steps_per_update=50", "--env.episode-length", "25"])
        drawing = {name for name in sys.modules
                   if name.startswith(("rotorgram.rendering", "OpenGL", "mujoco.egl"))}
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
    policy, config = load_policy(str(training), ElevationConfig())
    assert config.episode_length == 25
    assert repr(flown_tracks(policy, config, [1])) == repr(recorded_tracks(journal, [1]))
    out = tmp_path / "film.mp4"
    what = (training, journal, "--out", out, "--size", "642x240", *SMALL[2:])
    status, said, err = run(capsys, "render", *what, "--episode", 1, "--camera", "front")
    assert (status, err) == (0, "")
    assert f"film: {out} (13 pictures of 642x240)" in said  # 0.5 s, both ends
    last = decoded(out, 642, 240)[-1].astype(int)
    plain = tmp_path / "plain.mp4"
    status, _, _ = run(
        capsys, "render", *what[:3], plain, *what[4:], "--episode", 1, "--no-overlay"
    )
    assert status == 0
    bare = decoded(plain, 642, 240)[-1].astype(int)
    # The same flight twice: below its name a pane is the other's picture, but for the compression.
    assert abs(bare[40:, :320] - bare[40:, 322:]).mean() < 3
    assert abs(last - bare).mean() > 10


def test_gif_pictures_and_names(
    opengl: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "film.gif"
    settings = ("--env.episode-length", 10, *SMALL)
    command = ("render", "pid", "random", "--out", out, "--names", "ours", "theirs", *settings)
    assert run(capsys, *command, "--episodes", 2)[0] == 0
    with Image.open(out) as gif:
        assert gif.n_frames <= 12  # type: ignore[attr-defined]
        total = 0
        for number in range(gif.n_frames):  # type: ignore[attr-defined]
            gif.seek(number)
            total += gif.info["duration"]
    assert total == 12 * 40  # 0.2 s with both ends, twice
    picture = tmp_path / "picture.png"
    assert run(capsys, "render", "pid", "--out", picture, "--at", 0.1, *settings)[0] == 0
    assert pixels(picture).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["pid", "--out", "film.avi"], "film: expected a name that ends in"),
        (["pid", "--out", "."], "is there already"),
        (["pid", "--out", "film.mp4", "--size", "641x360"], "film: expected an even width"),
        (["pid", "--out", "film.mp4", "--size", "large"], "size: expected WIDTHxHEIGHT"),
        (["pid", "--out", "film.mp4", "--size", "9x9"], "size: expected WIDTHxHEIGHT"),
        (["pid", "--out", "film.mp4", "--speed", "0"], "speed: expected"),
        (["pid", "--out", "film.mp4", "--episode", "-1"], "episode: expected 0 or more"),
        (["pid", "--out", "film.mp4", "--episodes", "0"], "episodes: expected at least 1"),
        (["pid", "--out", "film.mp4", "--names", "a", "b"], "names: expected one for each of 1"),
        (["pid", "--out", "film.mp4", "--at", "-1"], "at: expected"),
        (["--out", "film.mp4"], "what: expected a checkpoint, pid, random or a journal"),
        (["nowhere", "--out", "film.mp4"], "policy: expected pid, a checkpoint"),
        (["nowhere.mcap", "--out", "film.mp4"], "nowhere.mcap"),
        (["pid", "--out", "film.mp4", "--env.observation", "error"], "pid: expected"),
    ],
)
def test_wrong_input_is_one_sentence(
    arguments: list[str],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    status, _, err = run(capsys, "render", *arguments)
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
    assert (process.returncode, err) == (130, "rotorgram: interrupted\n")
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
    out = tmp_path / "film.gif"
    status, _, err = run(capsys, "render", "pid", "--out", out, *SMALL)
    assert (status, SENTENCE in err, err.count("\n")) == (2, True, 1)
    assert "egl: its library is not installed" in err
    assert list(tmp_path.iterdir()) == []
    assert run(capsys, "evaluate", "pid", "--episodes", 1, "--env.episode-length", 5)[0] == 0


@pytest.mark.parametrize(
    ("variables", "tried"),
    [
        ({}, ["egl"]),
        ({"DISPLAY": ":0"}, ["egl", "glfw"]),
        ({"DISPLAY": ":0", "MUJOCO_GL": "egl"}, ["egl"]),
        ({"MUJOCO_GL": "osmesa"}, ["osmesa"]),
        ({"MUJOCO_GL": "on"}, ["glfw"]),
        ({"MUJOCO_GL": "off"}, []),
    ],
)
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
def comparison(training: Path, tmp_path: Path) -> Path:
    """A comparison's folder: the checkpoint of the middle seed alone."""
    folder = tmp_path / "comparison"
    env = load(training / "checkpoint.safetensors").env
    config = ElevationConfig.from_options(env)
    content = {"preset": "tuned", "seeds": [0, 1, 2], "env_steps": 200, "agents": {"a2c": {}}}
    write_config(folder, "rotorgram compare", config, content)
    rows = [
        {"agent": agent, "seed": seed, "env_steps": 200, "seconds": 1.0, "episode": 0,
         "length": 25, "return": 0.0, "steady_error": error, "settling_time": math.nan,
         "overshoot": 0.0, "terminated": False}
        for agent, seed, error in (("a2c", 0, 0.3), ("a2c", 1, 0.1), ("a2c", 2, 0.2),
                                   ("pid", 0, 0.0))
    ]  # fmt: skip
    pd.DataFrame(rows, columns=list(EVALUATION_COLUMNS)).to_csv(
        folder / "evaluations.csv", index=False
    )
    (folder / "checkpoints").mkdir()
    data = (training / "checkpoint.safetensors").read_bytes()
    (folder / "checkpoints" / "a2c-seed2.safetensors").write_bytes(data)
    return folder


def test_the_film_of_a_comparison_shows_its_agents(comparison: Path, opengl: None) -> None:
    out = comparison / "video.mp4"
    out.write_text("an old one")
    assert film_comparison(comparison, out, world="plain")
    frames = decoded(out, 1280, 400)
    assert len(frames) == 13
    left, right = frames[0][:, :639].astype(int), frames[0][:, 641:].astype(int)
    assert abs(left[100:300] - right[100:300]).mean() < 8  # they start alike
    assert sorted(path.name for path in comparison.iterdir()) == [
        "checkpoints", "config.json", "evaluations.csv", "video.mp4",
    ]  # fmt: skip


def test_a_comparison_without_opengl_has_no_film(
    comparison: Path, no_egl: None, caplog: pytest.LogCaptureFixture
) -> None:
    out = comparison / "video.mp4"
    with caplog.at_level(logging.INFO, logger="rotorgram"):
        assert not film_comparison(comparison, out)
    assert len(caplog.messages) == 1
    assert SENTENCE in caplog.messages[0]
    assert not out.exists()


def test_what_is_no_comparison_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"config\.json is missing"):
        film_comparison(tmp_path, tmp_path / "video.mp4")
    (tmp_path / "config.json").write_text(json.dumps({}))
    with pytest.raises(ValueError, match=r"config\.json"):
        film_comparison(tmp_path, tmp_path / "video.mp4")


# ---- the page


def test_the_page_tells_what_the_benchmark_wrote() -> None:
    docs = Path(__file__).parent.parent / "docs"
    page = (docs / "rendering.md").read_text()
    told = json.loads((docs / "results" / "performance" / "rendering.json").read_text())
    rates, overlay, filmed = (
        told[name] for name in ("pictures_per_second", "overlay_milliseconds", "film")
    )
    for size in ("640x360", "1280x720"):
        assert f"| {size} | {rates[size]} | {rates[f'{size}, fast']} | {overlay[size]} |" in page
    assert f"took {filmed['seconds']} s, and are {filmed['kilobytes']} kB as MP4" in page
    assert f"load {told['load'][0]:.0f}" in page
    assert (docs / "images" / "cameras.jpg").stat().st_size < 200_000
