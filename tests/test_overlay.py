"""What is written on a picture, and where."""

import numpy as np
import pytest
from pictures import at
from rotorgram.rendering import Moment
from rotorgram.rendering.overlay import Overlay


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
