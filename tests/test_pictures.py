"""Pictures: coarse facts of what is in them.

No pixel is compared with a stored one: drivers differ.
"""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from pictures import HEIGHT, WIDTH, at, same
from rotorgram.rendering import CAMERAS, Camera, Canvas, Stage
from rotorgram.rendering.overlay import Overlay


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
