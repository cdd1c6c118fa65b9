"""Pictures: coarse facts of what is in them.

No pixel is compared with a stored one: drivers differ.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pictures import HEIGHT, HEXA, TINY, WIDTH, at
from rotorgram.envs import Metric
from rotorgram.envs.rendering import metric_line
from rotorgram.models import InputError
from rotorgram.rendering import CAMERAS, Camera, Canvas, Stage


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
    geoms = model.geom_bodyid > 0  # all that is not of the world
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
    assert rows.mean() == pytest.approx(HEIGHT / 2 - lower, abs=8)  # they look below the goal
    wide = 2.8 * pixels_per_metre(stage, camera)  # rotors of 0.8 m on a square of 2 m
    assert np.ptp(columns) == pytest.approx(wide, rel=0.25)  # what is nearer is larger
    if camera == "top":
        assert np.ptp(rows) == pytest.approx(wide, rel=0.25)
    else:
        assert np.ptp(rows) < wide / 2


def test_onboard_sees_the_front_rotors_to_both_sides(stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0))
    seen = craft_in(canvas, "onboard")
    orange = seen & orange_in(canvas.draw("onboard"))  # the front rotors' colour
    left = orange[:, : WIDTH // 2].sum()
    right = orange[:, WIDTH // 2 :].sum()
    assert min(left, right) > 0.01 * WIDTH * HEIGHT
    assert left == pytest.approx(right, rel=0.4)  # the blades are turned differently
    assert not orange[: HEIGHT // 4].any()


def test_the_horizon_is_where_the_pitch_of_the_camera_puts_it(stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0))
    for camera in ("chase", "side"):
        view = stage.camera(camera)
        down = math.radians(-view.elevation)
        focal = pixels_per_metre(stage, camera) * view.distance
        row = HEIGHT / 2 - focal * math.tan(down)
        picture = canvas.draw(camera).astype(int)
        # The floor's checks begin there: above it a row has one colour.
        spread = np.ptp(picture[:, :40], axis=1).max(axis=1)
        lively = np.flatnonzero(spread > 12)
        assert lively.min() == pytest.approx(row, abs=9), camera


def mean_row(mask: np.ndarray) -> float:
    rows, _ = np.nonzero(mask)
    return float(rows.mean())


def orange_in(picture: np.ndarray) -> np.ndarray:
    red, _, blue = np.moveaxis(picture.astype(int), 2, 0)
    orange: np.ndarray = red > blue + 40
    return orange


def green_in(picture: np.ndarray) -> np.ndarray:
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    disc: np.ndarray = (green > red + 25) & (green > blue + 10)
    return disc


@pytest.mark.parametrize("camera", ["front", "side"])
@pytest.mark.parametrize("error", [-3.0, 3.0])
def test_a_craft_3_m_from_its_goal_is_in_the_picture(
    error: float, camera: Camera, stage: Stage, canvas: Canvas
) -> None:
    stage.show(at(5.0 - error, error))
    rows = np.nonzero(craft_in(canvas, camera))[0]
    assert rows.min() > 0.05 * HEIGHT
    assert rows.max() < 0.8 * HEIGHT


@pytest.mark.parametrize("camera", ["front", "side"])
def test_cameras_that_stand_still_stay_above_the_ground(camera: Camera, stage: Stage) -> None:
    stage.show(at(0.2))
    view = stage.camera(camera)
    above = -view.distance * math.sin(math.radians(view.elevation))
    assert view.lookat[2] + above > 1.0


def test_onboard_has_no_disc_in_its_way(stage: Stage, canvas: Canvas) -> None:
    for error in (-0.2, 0.0, 0.2):
        stage.show(at(5.0, error=error))
        assert green_in(canvas.draw("onboard")).sum() == 0


@pytest.mark.parametrize("camera", ["chase", "front", "side", "top"])
def test_the_disc_marks_the_goal(camera: Camera, stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0, error=-0.2))
    picture = canvas.draw(camera)
    assert green_in(picture).sum() > 20
    with Canvas(Stage("plain"), canvas.width, canvas.height, fast=True) as empty:
        assert green_in(empty.draw(camera)).sum() == 0  # nothing shown yet


def test_a_craft_below_its_goal_is_so_far_below_the_disc(stage: Stage, canvas: Canvas) -> None:
    stage.show(at(4.0, error=1.0))
    disc = mean_row(green_in(canvas.draw("side")))
    craft = mean_row(craft_in(canvas, "side"))
    metre = pixels_per_metre(stage, "side")
    assert craft - disc == pytest.approx(metre, abs=4)


@pytest.mark.parametrize("camera", CAMERAS)
def test_without_a_goal_there_is_no_disc_and_the_craft_is_in_the_middle(
    camera: Camera, stage: Stage, canvas: Canvas
) -> None:
    stage.show(at(7.0, goal=None, position=(-2.0, -3.0, 7.0)))
    assert green_in(canvas.draw(camera)).sum() == 0
    if camera != "onboard":
        _, columns = np.nonzero(craft_in(canvas, camera))
        assert columns.mean() == pytest.approx(WIDTH / 2, abs=3)


@pytest.mark.parametrize("world", ["plain", "airport"])
@pytest.mark.parametrize(("file", "span"), [(HEXA, 1.24), (TINY, 0.13)])
@pytest.mark.parametrize("camera", CAMERAS)
def test_a_craft_of_any_size_fills_the_picture_as_ours_does(
    camera: Camera, file: Path, span: float, world: Any, opengl: None
) -> None:
    shares = []
    for vehicle in (None, file):
        stage = Stage(world, vehicle=vehicle)
        thrusts = tuple(stage.vehicle.hover_thrust)
        stage.show(at(3 * stage.radius, thrusts=thrusts))
        with Canvas(stage, WIDTH, HEIGHT, fast=True) as canvas:
            seen = craft_in(canvas, camera)
            rows, columns = np.nonzero(seen)
            assert seen.sum() > 30
            assert columns.mean() == pytest.approx(WIDTH / 2, abs=3)
            shares.append((np.ptp(columns), rows.mean()))
    (width, row), (other_width, other_row) = shares
    assert 0.8 * width < other_width < 1.7 * width  # of 1.5, 1.9 and 1.6 radii
    assert other_row == pytest.approx(row, abs=0.12 * HEIGHT)
    if camera == "top":
        assert other_width == pytest.approx(span * pixels_per_metre(stage, "top"), rel=0.2)


def test_front_backs_off_from_a_small_craft_that_is_far_from_its_goal(opengl: None) -> None:
    stage = Stage("plain", vehicle=TINY)  # 0.069 m
    stage.show(at(1.5, thrusts=(0.066,) * 4, error=-0.5))
    with Canvas(stage, WIDTH, HEIGHT, fast=True) as canvas:
        rows, _ = np.nonzero(craft_in(canvas, "front"))
        disc, _ = np.nonzero(green_in(canvas.draw("front")))
    assert rows.size > 3
    assert disc.size > 3
    assert rows.mean() < disc.mean() - HEIGHT / 8


def test_a_crash_does_not_move_the_camera_out_of_sight(stage: Stage) -> None:
    stage.show(at(5.0))
    near = stage.camera("front").distance
    for step in range(1, 60):  # falls for ever
        stage.show(at(5.0 - 2.0 * step, error=2.0 * step, step=step))
    far = stage.camera("front").distance
    assert near < far < near + 3 * 10 * stage.radius
    stage.show(at(5.0, episode=1))
    assert stage.camera("front").distance == near


def test_a_vehicle_without_its_texture_is_one_sentence(tmp_path: Path) -> None:
    file = tmp_path / "hexa.xml"
    texture = '<asset><texture name="t" type="2d" file="no.png"/><material name="m" texture="t"/>'
    text = HEXA.read_text()
    file.write_text(text.replace("<worldbody>", f"{texture}</asset><worldbody>", 1))
    for world in ("plain", "airport"):
        with pytest.raises(InputError, match=r"vehicle: expected a file that can be drawn, got: "):
            Stage(world, vehicle=file)  # type: ignore[arg-type]


def test_a_moment_of_another_vehicle_is_one_sentence() -> None:
    with pytest.raises(InputError, match=r"vehicle: expected a file with 4 rotors.*hexa\.xml"):
        Stage("plain", vehicle=HEXA).show(at(5.0))


def test_the_path_leads_to_where_it_was(stage: Stage, canvas: Canvas) -> None:
    for step in range(61):
        stage.show(at(3.0 + step / 40, goal=None, step=step))  # 1.5 m upwards
    hidden = craft_in(canvas, "chase")
    path = orange_in(canvas.draw("chase")) & ~hidden
    assert path.sum() > 10
    assert mean_row(path) > mean_row(hidden)  # below the craft
    stage.show(at(4.5, goal=None, step=0))  # another episode
    path = orange_in(canvas.draw("chase")) & ~hidden
    assert path.sum() < 5


def test_shadows_and_smooth_edges_are_there_unless_it_is_to_be_fast(opengl: None) -> None:
    stage = Stage("plain")
    stage.show(at(1.0, goal=None))
    with Canvas(stage, WIDTH, HEIGHT) as canvas:
        smooth = canvas.draw("chase").astype(int)
    with Canvas(stage, WIDTH, HEIGHT, fast=True) as canvas:
        rough = canvas.draw("chase").astype(int)
    darker = (rough - smooth).min(axis=2) > 30
    assert darker.sum() > 50  # the shadow, below the craft
    assert mean_row(darker) > HEIGHT / 2


def test_lines_are_written_in_the_upper_left_corner(stage: Stage, canvas: Canvas) -> None:
    stage.show(at(5.0))
    canvas.draw("side")  # MuJoCo centres the floor on the camera of the picture before
    plain = canvas.draw("side")
    written = canvas.draw("side", lines=[("PID", "0.50 s"), ("E", "-0.079 m")])
    changed = (plain != written).any(axis=2)
    rows, columns = np.nonzero(changed)
    assert rows.size > 500
    assert rows.max() < HEIGHT / 2
    assert columns.max() < 0.75 * WIDTH
    upper = written[: HEIGHT // 2]
    assert upper.max() > 240  # white letters


def test_lines_follow_the_task_and_the_vehicle() -> None:
    position = metric_line(Metric(name="position_error", unit="m", symbol="e"), 0.25)
    heading = metric_line(Metric(name="heading_error", unit="deg"), -12.345)
    gates = metric_line(Metric(name="gates_passed", unit=""), 3.0)
    hover = at(1.0, 0.25, metrics=(position, heading, gates))
    assert hover.lines == [
        ("e", "0.250 m"),
        ("heading error", "-12.35 deg"),
        ("gates passed", "3"),
        ("elevation", "1.00 m"),
        ("F1 to F4", "49 49 49 49 N"),
        ("reward", "+0.000"),
        ("step", "0"),
        ("episode", "0"),
    ]
    free = at(1.0, goal=None, metrics=(), thrusts=(0.066,) * 4).lines
    assert free[:2] == [("elevation", "1.00 m"), ("F1 to F4", "0.066 0.066 0.066 0.066 N")]
    six = at(1.0, thrusts=(5.0, 7.25, 5.0, 7.0, 5.0, 7.0)).lines
    assert at(1.0, metrics=(), thrusts=(3.25,)).lines[1] == ("F1", "3.25 N")
    assert six[2] == ("F1 to F6", "5 7.25 5 7 5 7 N")
