"""Films: numbers and graphs on pictures, and MP4, GIF or PNGs of them.

A film is there whole or not at all.
"""

import io
import math
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ..models.errors import InputError, require
from ..models.fleet import members_of
from ..models.vehicle import Vehicle
from .stage import Moment

require("PIL", "render", "what is written on pictures and into films")

from PIL import Image, ImageColor, ImageDraw, ImageFont  # noqa: E402

QUALITY: Final = 20
"""x264's constant rate factor: less is better and larger."""

_GROUND: Final = (13, 18, 26, 150)  # Of panels: dark, and some of the picture shows through
_EDGE: Final = (255, 255, 255, 36)
_NAMES = (164, 176, 190)
_VALUES = (238, 242, 246)
_ZERO = (150, 162, 176)
_LIMIT = (84, 96, 110)
_ALARM: Final = (255, 107, 96)
_BAR = (120, 190, 255)
_BAR_GROUND = (70, 82, 98)
_STEPS: Final = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0)  # Round numbers for the ends of a graph
_LEAST: Final = 0.1  # Smallest end of a graph, in the metric's unit
_STRIP_SIZE: Final = 160, 240  # Width and height of the smallest picture with a graph, pixels
_NUMBERS_HEIGHT: Final = 160  # Of the smallest picture with numbers, pixels
_NUMBERS_SHARE: Final = 0.4  # Of width or height: larger ones would hide the craft in the middle
_TIMES: Final = 2  # Everything is drawn so much larger, and reduced: smooth lines and letters


def check_film(path: Path, width: int, height: int, fps: float) -> None:
    """Check the arguments of `write_film` before anything is drawn. Raises `InputError`."""
    kind = path.suffix.lower()
    hundredths = 100 / max(fps, 0.01)
    expected = "a name that ends in .mp4, .gif or .png, or a folder's name without a dot"
    if kind not in (".mp4", ".gif", ".png", ""):
        raise InputError(f"film: expected {expected}, got {path}")
    if path.exists():
        raise InputError(f"film: {path} is there already; choose another name")
    if not 0.01 <= fps <= 1000:
        raise InputError(f"fps: expected 0.01 to 1000 pictures per second, got {fps:g}")
    if not (kind != ".mp4" or not (width % 2 or height % 2)):
        raise InputError(
            f"film: expected an even width and an even height for MP4, got {width}x{height}"
        )
    whole = kind != ".gif" or abs(hundredths - round(hundredths)) <= 1e-6
    expected = "100 divided by a whole number (50, 25, 20, 10) for GIF, which counts hundredths"
    if not whole:
        raise InputError(f"fps: expected {expected} of a second, got {fps:g}")


def write_film(
    path: Path, frames: Iterable[np.ndarray], fps: float, *, quality: int = QUALITY
) -> int:
    """Write a film, and return how many frames were taken. Ctrl-C leaves nothing behind.

    `.mp4` is H.264 that every browser plays before it is loaded whole; `.gif` repeats for ever;
    `.png` is the last frame alone; a name without a dot becomes a folder of `0001.png` and so on.

    Args:
        path: Must not exist.
        frames: uint8, shape (height, width, 3), all of one size; taken one by one.
        fps: Frames per second.
        quality: Of `.mp4`, x264's constant rate factor: 0 (every bit) to 51.

    Raises:
        InputError: The name, the size or the rate is wrong; there are no frames.
        OSError: It cannot be written, or the encoder failed.
        MissingPackage: Pillow or imageio-ffmpeg is not installed.
    """
    taken = iter(frames)
    if (first := next(taken, None)) is None:
        raise InputError("film: expected at least one frame, got none")
    check_film(path, first.shape[1], first.shape[0], fps)
    shape = (*first.shape[:2], 3)
    count = 0

    def counted() -> Iterator[np.ndarray]:
        nonlocal count
        for frame in chain((first,), taken):
            count += 1
            if frame.dtype != np.uint8 or frame.shape != shape:
                got = f"got {frame.dtype}, shape {frame.shape}"
                raise ValueError(f"film: expected frames of uint8, shape {shape}, {got}")
            yield frame

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            unfinished = Path(folder) / path.name
            match path.suffix.lower():
                case ".mp4":
                    _write_mp4(unfinished, counted(), first.shape, fps, quality)
                case ".gif":
                    _write_gif(unfinished, counted(), fps)
                case ".png":
                    last = deque(counted(), maxlen=1).pop()
                    Image.fromarray(last).save(unfinished)
                case _:
                    unfinished.mkdir()
                    for number, frame in enumerate(counted(), 1):
                        Image.fromarray(frame).save(unfinished / f"{number:04}.png")
            unfinished.rename(path)
    except OSError as error:
        if error.errno is None:  # FFmpeg's words
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
    return count


def _write_gif(path: Path, frames: Iterator[np.ndarray], fps: float) -> None:
    # Without dithering: parts that stand still do not change, and cost nothing.
    pictures = (Image.fromarray(f).quantize(256, dither=Image.Dither.NONE) for f in frames)
    first = next(pictures)
    settings = {"duration": round(100 / fps) * 10, "loop": 0}
    with path.open("wb") as file:  # Pillow's own stays open when it is interrupted
        first.save(file, "GIF", save_all=True, append_images=pictures, **settings)


def _write_mp4(
    path: Path, frames: Iterator[np.ndarray], shape: tuple[int, ...], fps: float, quality: int
) -> None:
    """Through FFmpeg. Raises `OSError` with its words if it fails."""
    size = f"{shape[1]}x{shape[0]}"
    rate = str(Fraction(fps).limit_denominator(1001))
    words = [
        *(_ffmpeg(), "-y", "-v", "error"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", rate, "-i", "-"),
        *("-an", "-c:v", "libx264", "-preset", "slow", "-crf", str(quality)),
        *("-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", str(path)),
    ]
    with tempfile.TemporaryFile() as said:
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL}
        # In a session of its own: Ctrl-C is for us, who then end it. A broken pipe: it has failed.
        pipes |= {"stderr": said, "start_new_session": True}
        with suppress(BrokenPipeError), subprocess.Popen(words, **pipes) as process:
            assert process.stdin is not None
            try:
                for frame in frames:
                    process.stdin.write(np.ascontiguousarray(frame).data)
            except BaseException:
                process.kill()
                raise
        if process.returncode:
            said.seek(0)
            why = " ".join(said.read().decode(errors="replace").split())
            raise OSError(f"ffmpeg: the film could not be written: {why:.300}")


def poster(path: Path, share: float = 0.3) -> bytes:
    """A JPEG of an MP4, from this share of its length. Raises `OSError` or `MissingPackage`."""
    ffmpeg = require("imageio_ffmpeg", "render", "a film's poster")
    try:
        frames, seconds = ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError as error:
        raise OSError(f"{path}: expected a film, got none that ffmpeg reads") from error
    start = share * seconds * (frames - 1) / max(frames, 1)
    words = ("-v", "error", "-ss", f"{start:.6f}", "-i", str(path), "-frames:v", "1")
    command = [_ffmpeg(), *words, "-f", "image2pipe", "-c:v", "png", "-"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
    if done.returncode or not done.stdout:
        raise OSError(f"{path}: expected a picture of the film, got none from ffmpeg")
    jpeg = io.BytesIO()
    Image.open(io.BytesIO(done.stdout)).convert("RGB").save(jpeg, "JPEG", quality=80)
    return jpeg.getvalue()


def _ffmpeg() -> str:
    try:
        return str(require("imageio_ffmpeg", "render", "an MP4 film").get_ffmpeg_exe())
    except RuntimeError:
        raise OSError(
            "ffmpeg: expected one that imageio-ffmpeg brings or finds, got none; "
            "write a .gif or a folder of PNGs"
        ) from None


class Box(NamedTuple):
    """Edges, pixels."""

    left: int
    upper: int
    right: int
    lower: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of what is drawn into it, enlarged."""
        return (self.right - self.left) * _TIMES, (self.lower - self.upper) * _TIMES


def graph_scale(values: Iterable[float]) -> tuple[float, float]:
    """Round ends of a graph that holds the values: from 0, or symmetrical if one is negative."""
    finite = [value for value in values if math.isfinite(value)]
    largest = max(map(abs, finite), default=0.0)
    decade = 10.0 ** math.floor(math.log10(max(largest, _LEAST)))
    high = next(step * decade for step in _STEPS if largest <= step * decade * (1 + 1e-9))
    return (-high if min(finite, default=0.0) < 0 else 0.0), high


class Overlay:
    """Draws on the pictures of one flight: a panel of numbers, and a graph of the headline metric.

    Everything scales with the picture. A small one has no graph, a smaller one only the title.

    Args:
        width: Of the pictures, pixels.
        height: Of the pictures, pixels.
        title: Name of the flight.
        color: Of title and curve, "#RRGGBB"; light, the ground is dark.
        like: A moment of the flight: it says which metrics, goal and rotors there are.
        vehicle: It gives the limits of the thrusts.
        period: Time between two values of the graph, s.
        seconds: Length of the graph's time axis, s.
        scale: Lower and upper end of the graph, in the metric's unit. Values beyond are not drawn:
            a triangle marks where the curve leaves.
        numbers: Whether there is more than the title.
        of: Name of the craft of which the numbers are, all but the first metric, where there are
            several.

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
        self._size = width, height
        self._title = title
        self._color = ImageColor.getrgb(color)[:3]
        self._period = period
        self._seconds = max(seconds, period)
        self._scale = scale
        self._vehicle = members_of(vehicle, 1)[0]  # the overlay is of the first drone
        self._high = float(self._vehicle.thrust_high.max())
        self._of = [("numbers of", of)] if of else []
        widest = replace(  # its lines are as wide as any of the flight
            like,
            position=(0.0, -100.0, 0.0),
            thrusts=(self._high,) * len(like.thrusts),
            goal=like.goal and (0.0, -100.0, 0.0),
            metrics=tuple(metric._replace(value=-1.001) for metric in like.metrics),
            reward=-10.0,
            step=100_000,
            episode=100_000,
        )
        self._widest = self._lines(widest)
        self._metric = like.metrics[0] if like.metrics else None
        unit = max(7.0, min(height / 30, width / 34))
        self._unit = unit
        self._gap = max(2, round(0.55 * unit))
        self._line = round(1.28 * unit)
        self._small, self._font, self._large = (_font(unit * share) for share in (0.85, 1, 1.25))
        self.has_numbers = numbers and self._have_room()
        large = width >= _STRIP_SIZE[0] and height >= _STRIP_SIZE[1]
        self.has_strip = numbers and large and self._metric is not None
        self.panel = self._panel_box(self.has_numbers)
        self.strip, self.plot = self._strip_boxes()
        left, upper, right, lower = self.plot
        self._curve = Box(left - self._gap, upper, right + self._gap, lower + 1)
        boxes = (self.panel, self.strip) if self.has_strip else (self.panel,)
        self._grounds = [(box, _ground(box, self._gap)) for box in boxes]

    def draw(
        self, picture: np.ndarray, moment: Moment, values: Sequence[float], note: str = ""
    ) -> np.ndarray:
        """A copy of a picture, uint8, shape (height, width, 3), with everything on it.

        `values` are those of the headline metric from the episode's start to this moment, one each
        period; `note` is an event, such as "terminated".
        """
        image = Image.fromarray(picture)
        if image.size != self._size:
            raise InputError(f"picture: expected {self._size} pixels, got {image.size}")
        for box, ground in self._grounds:
            image.paste(ground, box[:2], ground)
        _enlarged(image, self.panel, lambda draw: self._write_panel(draw, moment))
        if self.has_strip:
            _enlarged(image, self.strip, lambda draw: self._write_strip(draw, values))
            _enlarged(image, self._curve, lambda draw: self._draw_curve(draw, values))
        if note:  # below the panel, away from the craft
            wide = self._large.getlength(note) / _TIMES + 3 * self._gap
            left = self.panel.left
            upper = self.panel.lower + self._gap
            box = Box(left, upper, round(left + wide), round(upper + 1.9 * self._unit))
            _enlarged(image, box, lambda draw: self._write_note(draw, box, note))
        return np.asarray(image)

    def _lines(self, moment: Moment) -> list[tuple[str, str]]:
        first, *rest = moment.lines(self._high)
        return [first, *self._of, *rest]

    def _numbers_width(self) -> int:
        """Of a panel in which every name and its value fit beside each other."""
        lines = ((name, _spaced(value)) for name, value in self._widest)
        texts = max(sum(map(self._font.getlength, line)) for line in lines) / _TIMES
        return round(texts + self._unit + 4 * self._gap)

    def _have_room(self) -> bool:
        """Whether numbers fit, and leave the middle free."""
        wide = self._gap + self._numbers_width()
        high = self._panel_box(True).lower
        width, height = self._size
        fits = height >= _NUMBERS_HEIGHT and width >= wide + self._gap
        return fits and (wide <= _NUMBERS_SHARE * width or high <= _NUMBERS_SHARE * height)

    def _panel_box(self, numbers: bool) -> Box:
        gap = self._gap
        (width, height) = self._size
        title = math.ceil(self._large.getlength(self._title) / _TIMES + 1.2 * self._unit) + 1
        lower = 3 * gap + round(1.6 * self._unit)
        right = 5 * gap + title
        if numbers:
            lower += len(self._widest) * self._line + 3 * gap
            right = max(right, gap + self._numbers_width())
        return Box(gap, gap, min(right, width - gap), min(lower, height - gap))

    def _write_panel(self, draw: ImageDraw.ImageDraw, moment: Moment) -> None:
        unit = self._unit * _TIMES
        gap = self._gap * _TIMES
        line = self._line * _TIMES
        left = 2 * gap
        y = gap
        right = self.panel.size[0] - 2 * gap
        middle = y + 0.8 * unit
        radius = 0.36 * unit
        draw.ellipse((left, middle - radius, left + 2 * radius, middle + radius), self._color)
        title = _fitted(self._title, self._large, right - left - 1.2 * unit)
        draw.text((left + 1.2 * unit, middle), title, self._color, self._large, anchor="lm")
        y += round(1.6 * unit) + gap // 2
        for name, value in self._lines(moment) if self.has_numbers else ():
            draw.text((left, y), name, _NAMES, self._font)
            draw.text((right, y), _spaced(value), _VALUES, self._font, anchor="ra")
            y += line
            if "F1" in name:
                y += gap // 2
                self._draw_bars(draw, Box(left, y, right, y + gap), moment.thrusts)
                y += round(1.5 * gap)

    def _draw_bars(self, draw: ImageDraw.ImageDraw, box: Box, thrusts: Sequence[float]) -> None:
        """The thrusts side by side, from the least to the largest, with a mark at hover."""
        gap = min(self._gap * _TIMES, (box.right - box.left) // (3 * len(thrusts)))
        long = (box.right - box.left - gap * (len(thrusts) - 1)) / len(thrusts)
        thick = max(1, round(self._unit / 7))
        craft = self._vehicle
        columns = (thrusts, craft.thrust_low, craft.thrust_high, craft.hover_thrust)
        for number, (thrust, low, high, hover) in enumerate(zip(*columns, strict=True)):
            start = box.left + number * (long + gap)
            full, mark = (
                start + long * min(max((value - low) / (high - low), 0.0), 1.0)
                for value in (thrust, hover)
            )
            draw.rectangle((start, box.upper, start + long, box.lower), _BAR_GROUND)
            if full > start:
                draw.rectangle((start, box.upper, full, box.lower), _BAR)
            draw.line((mark, box.upper - _TIMES, mark, box.lower + _TIMES), _VALUES, thick)

    def _strip_boxes(self) -> tuple[Box, Box]:
        gap = self._gap
        (width, height) = self._size
        upper = max(height - gap - round(6.6 * self._unit), 0)
        strip = Box(gap, upper, width - gap, height - gap)
        label = max(self._small.getlength(name) for name, _ in self._levels()) / _TIMES
        left = strip.left + round(label) + 3 * gap
        upper = upper + gap + round(1.75 * self._unit)
        right = strip.right - 2 * gap
        lower = strip.lower - round(1.5 * gap)
        return strip, Box(left, upper, max(left, right), max(upper, lower))

    def _levels(self) -> tuple[tuple[str, float], ...]:
        """Labels of the graph's lines, and their heights, -1 to 1."""
        low, high = self._scale
        return (f"{high:g}", 1.0), (f"{(low + high) / 2:g}", 0.0), (f"{low:g}", -1.0)

    def _write_strip(self, draw: ImageDraw.ImageDraw, values: Sequence[float]) -> None:
        unit = self._unit * _TIMES
        gap = self._gap * _TIMES
        assert self._metric is not None
        words = [f"{self._metric.label} over time", *filter(None, [self._metric.unit])]
        draw.text((2 * gap, gap), ", ".join(words), _NAMES, self._font)
        time = f"{max(len(values) - 1, 0) * self._period:.2f} s"
        draw.text((self.strip.size[0] - 2 * gap, gap), time, _VALUES, self._font, anchor="ra")
        corner = self.strip[:2] * 2
        left, upper, right, lower = (np.subtract(self.plot, corner) * _TIMES).tolist()
        for label, share in self._levels():
            y = lower - (lower - upper) * (1 + share) / 2
            color = _ZERO if label == "0" else _LIMIT
            draw.line((left, y, right, y), color, max(1, round(unit / 14)))
            if share or lower - upper > 2.4 * unit:  # there is room for the zero too
                draw.text((left - gap, y), label, _NAMES, self._small, anchor="rm")

    def _draw_curve(self, draw: ImageDraw.ImageDraw, values: Sequence[float]) -> None:
        low, high = self._scale
        shares = (np.asarray(values, float) - (low + high) / 2) / ((high - low) / 2)
        left, _, right, _ = ((edge - self._curve.left) * _TIMES for edge in self.plot)
        tall = (self.plot.lower - self.plot.upper) * _TIMES
        across = (right - left) * self._period / self._seconds
        xs = np.minimum(left + across * np.arange(len(shares)), right)
        points = np.stack((xs, shares), axis=1)[np.isfinite(shares)].tolist()
        thick = max(_TIMES, round(self._unit * _TIMES / 6))
        path: list[tuple[float, float]] = []  # what is beyond the box is cut off
        for (x, y), (next_x, next_y) in pairwise([(left, 0.0), *points]):
            crossed = [edge for edge in (-1.0, 1.0) if (y * edge <= 1) != (next_y * edge <= 1)]
            for edge in sorted(crossed, reverse=next_y < y):
                across = x + (edge - y) / (next_y - y) * (next_x - x)
                ends = [(across, edge), (across, 2 * edge)]
                path += ends if next_y * edge > 1 else ends[::-1]
                if next_y * edge > 1:  # it leaves
                    corner = min(max(across, left + 2 * thick), right - 2 * thick)
                    start = tall * (1 - edge) / 2
                    inside = start + 2.5 * thick * edge  # rows count downwards
                    sides = (corner - 2 * thick, inside), (corner + 2 * thick, inside)
                    draw.polygon(((corner, start), *sides), self._color)
            path.append((next_x, next_y if abs(next_y) <= 1 else math.copysign(2, next_y)))
        curve = [(x, tall * (1 - y) / 2) for x, y in path]
        draw.line(curve, self._color, thick, joint="curve")
        for x, y in ((x, tall * (1 - y) / 2) for x, y in points[-1:] if abs(y) <= 1):
            draw.ellipse((x - thick, y - thick, x + thick, y + thick), self._color)

    def _write_note(self, draw: ImageDraw.ImageDraw, box: Box, note: str) -> None:
        size = box.size[0] - 1, box.size[1] - 1
        thick = max(1, round(self._unit * _TIMES / 12))
        draw.rounded_rectangle((0, 0, *size), self._gap * _TIMES, _GROUND[:3], _ALARM, thick)
        draw.text((size[0] / 2, size[1] / 2), note, _ALARM, self._large, anchor="mm")


def _enlarged(image: Image.Image, box: Box, write: Callable[[ImageDraw.ImageDraw], None]) -> None:
    """Write on a part of the picture, in enlarged pixels from its own corner on."""
    part = image.crop(box).resize(box.size, Image.Resampling.NEAREST)
    write(ImageDraw.Draw(part))
    image.paste(part.reduce(_TIMES), box[:2])


def _ground(box: Box, radius: int) -> Image.Image:
    """An empty panel, RGBA."""
    image = Image.new("RGBA", box.size)
    edges = (0, 0, image.width - 1, image.height - 1)
    ImageDraw.Draw(image).rounded_rectangle(edges, radius * _TIMES, _GROUND, _EDGE, _TIMES)
    return image.reduce(_TIMES)


def _spaced(value: str) -> str:
    """The same with more space between numbers than between number and unit."""
    numbers, _, unit = value.rpartition(" ")
    return f"{numbers.replace(' ', '  ')} {unit}".strip()


def _fitted(text: str, font: ImageFont.FreeTypeFont, room: float) -> str:
    """The text, or its beginning where it is too long."""
    shorter = (f"{text[:length]}..." for length in range(len(text) - 1, 0, -1))
    return next((t for t in (text, *shorter) if font.getlength(t) <= room), "...")


@lru_cache
def _font(size: float) -> ImageFont.FreeTypeFont:
    """For so many pixels of the picture."""
    font = ImageFont.load_default(size * _TIMES)
    assert isinstance(font, ImageFont.FreeTypeFont)  # Pillow's wheels bring FreeType
    return font
