"""What is written on a picture, and where."""

from typing import Any

import numpy as np
import pytest
from pictures import at
from rotorgram.models.vehicle import Vehicle
from rotorgram.rendering import MetricValue
from rotorgram.rendering.overlay import Overlay, graph_scale

QUAD = Vehicle.load()


def overlay_of(width: int, height: int, **settings: Any) -> Overlay:
    """An overlay for the paper's craft, 1 s long, from -1 to 1 m."""
    defaults: dict[str, Any] = {
        "title": "x", "color": "#00FF00", "like": at(5.0), "vehicle": QUAD, "period": 0.02,
        "seconds": 1.0, "scale": (-1.0, 1.0),
    }  # fmt: skip
    return Overlay(width, height, **{**defaults, **settings})


def test_the_curve_has_the_colour_of_the_flight_and_the_place_of_its_errors() -> None:
    overlay = overlay_of(640, 360, title="A2C", seconds=5.0)
    picture = np.zeros((360, 640, 3), np.uint8)
    drawn = overlay.draw(picture, at(5.0, step=125), [0.5] * 126)  # 2.5 s of 5 s
    strip = np.zeros((360, 640), bool)
    strip[int(360 * 0.75) :] = True
    curve = (drawn[..., 1] > 200) & (drawn[..., 0] < 60) & strip
    rows, columns = np.nonzero(curve)
    left = overlay.plot[0]
    right = overlay.plot[2]
    assert columns.min() == pytest.approx(left, abs=3)
    assert columns.max() == pytest.approx((left + right) / 2, abs=5)
    upper = overlay.plot[1]
    lower = overlay.plot[3]
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
    overlay = overlay_of(640, 360, seconds=2.0, scale=(-0.5, 0.5))
    rising = [side * step / 50 for step in range(101)]  # reaches the edge after 0.5 s of 2 s
    green = lit(overlay, rising, 360, 640)
    columns = np.nonzero(green)[1]
    edge = green.shape[1] / 4
    assert columns.max() == pytest.approx(edge, abs=16)  # a thick line
    back = lit(overlay, [*rising[:51], *rising[50::-1]], 360, 640)  # beyond from 0.5 to 1.5 s
    width = back.shape[1]
    assert not back[:, round(0.28 * width) : round(0.74 * width)].any()
    assert back[:, round(0.8 * width) : round(0.98 * width)].any(axis=0).all()


@pytest.mark.parametrize("size", [(640, 360), (320, 400), (320, 240), (1280, 720)])
def test_full_thrusts_do_not_lie_on_their_name(size: tuple[int, int]) -> None:
    overlay = overlay_of(*size)
    assert overlay.has_numbers
    font = overlay._font()
    for name, value in at(5.0, thrusts=(100.0,) * 4).lines(100.0):
        wide = font.getlength(name) + font.getlength(value)
        assert wide + 3 * overlay._gap < overlay.panel.right - overlay.panel.left


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
    overlay = overlay_of(*size, title="PID")
    assert overlay.has_numbers == numbers
    assert overlay.has_strip == strip
    drawn = overlay.draw(np.zeros((*size[::-1], 3), np.uint8), at(5.0), [0.0, 0.5, 0.0])
    green = (drawn[..., 1] > 150) & (drawn[..., 0] < 80)
    assert green[: overlay.panel.lower].any()  # the title
    assert green[overlay.panel.lower :].any() == strip
    assert (drawn[..., 0] > 170).any() == (numbers or strip)
    alone = overlay_of(*size, title="PID", numbers=False)
    assert (alone.has_numbers, alone.has_strip) == (False, False)


def test_an_overlay_covers_little_and_fits_any_size() -> None:
    grey = np.full((360, 640, 3), 128, np.uint8)
    overlay = overlay_of(640, 360, title="x" * 200)
    drawn = overlay.draw(grey, at(5.0), [0.0], note="terminated")
    assert (drawn[200:260] == grey[200:260]).all()  # where the craft is
    for width, height in ((16, 16), (160, 120), (100, 900), (900, 100)):
        small = overlay_of(width, height, title="name")
        picture = np.zeros((height, width, 3), np.uint8)
        assert small.draw(picture, at(5.0), [0.1, 0.2], "terminated").shape == picture.shape
    with pytest.raises(ValueError, match="picture: expected"):
        overlay.draw(np.zeros((10, 10, 3), np.uint8), at(5.0), [0.0])


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([], (0.0, 0.1)),
        ([0.0, 0.05], (0.0, 0.1)),
        ([0.0, 0.11], (0.0, 0.15)),
        ([-0.7, 0.2], (-1.0, 1.0)),
        ([1.6], (0.0, 2.0)),
        ([-3.0], (-3.0, 3.0)),
        ([179.0], (0.0, 200.0)),
        ([float("nan"), 4.0], (0.0, 5.0)),
    ],
)
def test_a_graph_ends_at_round_numbers(values: list[float], expected: tuple[float, float]) -> None:
    assert graph_scale(values) == pytest.approx(expected)


def test_lines_follow_the_task_and_the_vehicle() -> None:
    hover = at(1.0, 0.25, metrics=(MetricValue("position_error", 0.25, "m", "e"),
                                   MetricValue("heading_error", -12.345, "deg"),
                                   MetricValue("gates_passed", 3.0)))  # fmt: skip
    assert hover.lines(100.0) == [
        ("e", "0.250 m"),
        ("heading error", "-12.35 deg"),
        ("gates passed", "3"),
        ("elevation", "1.00 m"),
        ("goal", "1.25 m"),
        ("F1 to F4", "49 49 49 49 N"),
        ("reward", "+0.000"),
        ("step", "0"),
        ("episode", "0"),
    ]
    free = at(1.0, goal=None, metrics=(), thrusts=(0.066,) * 4).lines(0.15)
    assert free[:2] == [("elevation", "1.00 m"), ("F1 to F4", "66 66 66 66 mN")]
    assert at(1.0, thrusts=(3.25,)).lines(13.0)[3] == ("F1", "3.2 N")
    six = at(1.0, thrusts=(5.0, 7.0, 5.0, 7.0, 5.0, 7.0)).lines(30.0)
    assert six[3] == ("F1 to F6, mean", "6.0 N")


def test_it_names_the_craft_of_which_the_numbers_are() -> None:
    without = overlay_of(640, 360)
    named = overlay_of(640, 360, of="drone_3")
    assert named.has_numbers
    assert named.panel.lower - without.panel.lower == 15  # a line: 1.28 of a thirtieth of 360
    black = np.zeros((360, 640, 3), np.uint8)
    first, second = (overlay.draw(black, at(5.0), [0.0]) for overlay in (without, named))
    panel = without.panel
    assert not np.array_equal(first[: panel.lower, :100], second[: panel.lower, :100])


def test_without_metrics_there_is_no_graph() -> None:
    overlay = overlay_of(640, 360, like=at(5.0, metrics=()))
    assert (overlay.has_numbers, overlay.has_strip) == (True, False)
    picture = np.zeros((360, 640, 3), np.uint8)
    drawn = overlay.draw(picture, at(5.0, metrics=()), [])
    assert drawn[: overlay.panel.lower].any()
    assert not drawn[overlay.panel.lower :].any()
