"""What is written on pictures of a flight: its name, numbers, and a graph of the first metric."""

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError, require
from ..models.fleet import members_of
from ..models.vehicle import Vehicle
from .stage import Moment

require("PIL", "render", "what is written on pictures and into films")

from PIL import Image, ImageColor, ImageDraw, ImageFont  # noqa: E402

Picture = NDArray[np.uint8]

_GROUND: Final = (13, 18, 26, 150)  # of panels: some of the picture shows through
_NAMES: Final = (164, 176, 190)
_VALUES: Final = (238, 242, 246)
_LEVEL: Final = (84, 96, 110)
_ALARM: Final = (255, 107, 96)
_STEPS: Final = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0)  # round numbers for the ends of a graph
_LEAST: Final = 0.1  # smallest end of a graph, in the metric's unit
_STRIP_SIZE: Final = (160, 240)  # width and height of the smallest picture with a graph, pixels
_NUMBERS_SHARE: Final = 0.4  # of width or height: larger ones would hide the craft in the middle
_WIDE: Final = 15.0  # width of the panel of numbers, in heights of a letter
_LINE: Final = 1.28  # height of a line, in heights of a letter
_MARGIN: Final = 2  # pixels about the plot, into which half of the curve's width reaches
_FINER: Final = 2  # the curve is drawn so much larger, and reduced: a smooth line


class Box(NamedTuple):
    """Edges, pixels."""

    left: int
    upper: int
    right: int
    lower: int


def graph_scale(values: Iterable[float]) -> tuple[float, float]:
    """Round ends of a graph that holds the values: from 0, or symmetrical if one is negative."""
    finite = [value for value in values if math.isfinite(value)]
    largest = max(map(abs, finite), default=0.0)
    decade = 10.0 ** math.floor(math.log10(max(largest, _LEAST)))
    high = next(step * decade for step in _STEPS if largest <= step * decade * (1 + 1e-9))
    low = -high if min(finite, default=0.0) < 0 else 0.0
    return low, high


class Overlay:
    """Draws on the pictures of one flight: a panel of numbers, and a graph of the first metric.

    Everything scales with the picture. A small one has no graph, a smaller one only the title.

    Args:
        width: Of the pictures, pixels.
        height: Of the pictures, pixels.
        title: Name of the flight.
        color: Of title and curve, "#RRGGBB"; light, the ground is dark.
        like: A moment of the flight: it says which metrics, goal and rotors there are.
        vehicle: Its largest thrust sets the digits.
        period: Time between two values of the graph, s.
        seconds: Length of the graph's time axis, s.
        scale: Lower and upper end of the graph, in the metric's unit. Beyond it nothing is drawn.
        numbers: Whether there is more than the title.
        of: Name of the craft of which the numbers are, where there are several.

    Attributes:
        has_numbers: Whether the panel has numbers.
        has_strip: Whether there is a graph.
        panel, strip, plot: Where title and numbers are, where the graph, and where in it its curve.
    """

    def __init__(
        self,
        width: int,
        height: int,
        *,
        title: str,
        color: str = "#7CC8F2",
        like: Moment,
        vehicle: Vehicle,
        period: float,
        seconds: float,
        scale: tuple[float, float],
        numbers: bool = True,
        of: str = "",
    ) -> None:
        self._size = (width, height)
        self._title = title
        self._color = ImageColor.getrgb(color)[:3]
        self._period = period
        self._seconds = max(seconds, period)
        self._scale = scale
        self._high = float(members_of(vehicle, 1)[0].thrust_high.max())
        self._of = of
        self._metric = like.metrics[0] if like.metrics else None
        self._unit = max(7.0, min(height / 30, width / 34))
        self._gap = max(2, round(0.55 * self._unit))
        panel = self._panel_box(len(self._lines(like)))
        fits = panel.right + self._gap <= width and panel.lower + self._gap <= height
        small = panel.right <= _NUMBERS_SHARE * width or panel.lower <= _NUMBERS_SHARE * height
        self.has_numbers = numbers and fits and small
        self.panel = panel if self.has_numbers else self._panel_box(0)
        large = width >= _STRIP_SIZE[0] and height >= _STRIP_SIZE[1]
        self.has_strip = numbers and large and self._metric is not None
        gap = self._gap
        upper = max(height - gap - round(6.6 * self._unit), 0)
        self.strip = Box(gap, upper, width - gap, height - gap)
        left = self.strip.left + round(4 * self._unit)
        upper += gap + round(1.75 * self._unit)
        lower = self.strip.lower - round(1.5 * gap)
        self.plot = Box(left, upper, max(left, self.strip.right - 2 * gap), max(upper, lower))

    def draw(
        self, picture: Picture, moment: Moment, values: Sequence[float], note: str = ""
    ) -> Picture:
        """A copy of a picture, uint8, shape (height, width, 3), with everything on it.

        `values` are those of the first metric from the episode's start to this moment, one per
        period; `note` is an event, such as "terminated".
        """
        image = Image.fromarray(picture)
        if image.size != self._size:
            raise InputError(f"picture: expected {self._size} pixels, got {image.size}")
        layer = Image.new("RGBA", image.size)
        pen = ImageDraw.Draw(layer)
        self._write_panel(pen, moment)
        if self.has_strip:
            self._write_strip(pen, len(values))
        if note:  # below the panel, away from the craft
            left = self.panel.left
            upper = self.panel.lower + self._gap
            wide = self._font(1.25).getlength(note) + 2 * self._gap
            box = Box(left, upper, round(left + wide), round(upper + 1.9 * self._unit))
            self._write_title(pen, box, note, _ALARM)
        image.paste(layer, (0, 0), layer)
        if self.has_strip:
            self._draw_curve(image, values)
        return np.asarray(image)

    def _font(self, share: float = 1.0) -> ImageFont.FreeTypeFont:
        return _font(self._unit * share)

    def _lines(self, moment: Moment) -> list[tuple[str, str]]:
        first, *rest = moment.lines(self._high)
        named = [("numbers of", self._of)] if self._of else []
        return [first, *named, *rest]

    def _panel_box(self, lines: int) -> Box:
        width, height = self._size
        wide = self._font(1.25).getlength(self._title) + 2 * self._gap
        wide = max(wide, _WIDE * self._unit) if lines else wide
        high = (2.0 + _LINE * lines) * self._unit + self._gap
        box = Box(self._gap, self._gap, round(self._gap + wide), round(self._gap + high))
        if lines:
            return box
        right = min(box.right, width - self._gap)
        lower = min(box.lower, height - self._gap)
        return box._replace(right=right, lower=lower)

    def _write_title(
        self, pen: ImageDraw.ImageDraw, box: Box, title: str, color: tuple[int, ...]
    ) -> None:
        """A title on the ground of a box."""
        pen.rectangle((*box[:2], box.right - 1, box.lower - 1), _GROUND)
        place = (box.left + self._gap, box.upper + 0.95 * self._unit)
        pen.text(place, title, color, self._font(1.25), anchor="lm")

    def _write_panel(self, pen: ImageDraw.ImageDraw, moment: Moment) -> None:
        panel = self.panel
        self._write_title(pen, panel, self._title, self._color)
        if not self.has_numbers:
            return
        for number, (name, value) in enumerate(self._lines(moment)):
            y = panel.upper + (2.0 + _LINE * number) * self._unit
            pen.text((panel.left + self._gap, y), name, _NAMES, self._font())
            pen.text((panel.right - self._gap, y), value, _VALUES, self._font(), anchor="ra")

    def _write_strip(self, pen: ImageDraw.ImageDraw, count: int) -> None:
        assert self._metric is not None
        gap = self._gap
        left, upper, right, lower = self.plot
        unit = f", {self._metric.unit}" if self._metric.unit else ""
        heading = f"{self._metric.label} over time{unit}"
        seconds = f"{max(count - 1, 0) * self._period:.2f} s"
        strip = self.strip
        pen.rectangle((*strip[:2], strip.right - 1, strip.lower - 1), _GROUND)
        top = strip.upper + gap
        pen.text((strip.left + 2 * gap, top), heading, _NAMES, self._font())
        pen.text((right, top), seconds, _VALUES, self._font(), anchor="ra")
        low, high = self._scale
        for y, level in ((lower, low), ((lower + upper) / 2, (low + high) / 2), (upper, high)):
            pen.line((left, y, right, y), _LEVEL)
            pen.text((left - gap, y), f"{level:g}", _NAMES, self._font(0.85), anchor="rm")

    def _draw_curve(self, image: Image.Image, values: Sequence[float]) -> None:
        """What is beyond the plot and its margin is cut off."""
        left, upper, right, lower = self.plot
        low, high = self._scale
        wide = (right - left) * _FINER
        tall = (lower - upper) * _FINER
        times = np.arange(len(values)) * (wide * self._period / self._seconds)
        heights = tall * (high - np.asarray(values, np.float64)) / (high - low)
        points = np.stack((np.minimum(times, wide), heights), axis=1) + _MARGIN * _FINER
        curve = [(x, y) for x, y in points.tolist() if math.isfinite(y)]
        thick = max(_FINER, round(self._unit * _FINER / 6))
        layer = Image.new("RGBA", (wide + 2 * _MARGIN * _FINER, tall + 2 * _MARGIN * _FINER))
        ImageDraw.Draw(layer).line(curve, self._color, thick, joint="curve")
        layer = layer.reduce(_FINER)
        image.paste(layer, (left - _MARGIN, upper - _MARGIN), layer)


@lru_cache
def _font(size: float) -> ImageFont.FreeTypeFont:
    """Pillow's font, for a height in pixels."""
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)  # Pillow's wheels bring FreeType
    return font
