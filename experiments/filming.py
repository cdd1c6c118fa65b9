"""Films of flights: a frame shows the control step of its time; several flights side by side."""

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from ..rendering import Camera, Canvas, Stage, World
from ..rendering.film import QUALITY, check_film, write_film
from ..rendering.overlay import Overlay
from .flights import Track

__all__ = ["Film", "OnFrame", "Shot", "film", "grid"]

OnFrame = Callable[[int, int], None]
"""Called with frames drawn, and frames in all."""

_SPACE: Final = 2  # pixels between panes
_DARK: Final = (13, 18, 26)
_ASPECT: Final = 1.2  # of a pane that shows a craft and its strip well
_BANDS: Final = (0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0)


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One pane: who flies, and what was flown."""

    name: str
    color: str
    """Of name and curve, "#RRGGBB"."""
    tracks: list[Track]
    """One after the other."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """How it is filmed."""

    width: int = 1280
    """Pixels."""
    height: int = 720
    camera: Camera = "chase"
    fps: float = 25.0
    speed: float = 1.0
    """Seconds of flight per second of film."""
    world: World = "airport"
    overlay: bool = True
    """Whether numbers and error curves are drawn. Of several panes the names always are."""
    at: float | None = None
    """Only the picture at this time of the first episode, s."""
    fast: bool = False
    """Without shadows and smooth edges."""
    quality: int = QUALITY
    """As of `write_film`."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.speed) and 0.001 <= self.speed <= 1000):
            raise ValueError(f"speed: expected 0.001 to 1000, got {self.speed:g}")
        if self.at is not None and not (math.isfinite(self.at) and self.at >= 0):
            raise ValueError(f"at: expected a time of 0 s or more, got {self.at:g}")


def film(path: Path, shots: Sequence[Shot], config: Film, on_frame: OnFrame | None = None) -> int:
    """Film flights side by side.

    Args:
        path: As of `write_film`. A `.png` is the picture at `config.at`, or the last.
        shots: One or more, each with as many tracks. An episode lasts until the longest flight of
            it has ended; one that ended before stays on its last picture.
        config: How.
        on_frame: Told how far it is.

    Returns:
        Frames written.

    Raises:
        NoOpenGL: There is nothing to draw with.
        ValueError: The name, the size or the rate is not what it should be.
        OSError: It cannot be written.
    """
    check_film(path, config.width, config.height, config.fps)
    times = _times(shots, config, still=path.suffix.lower() == ".png")

    def told() -> Generator[np.ndarray, None, None]:
        with _Studio(shots, config) as studio:
            for number, (episode, seconds) in enumerate(times, 1):
                yield studio.frame(episode, seconds)
                if on_frame:
                    on_frame(number, len(times))

    frames = told()
    try:
        return write_film(path, frames, config.fps, quality=config.quality)
    finally:
        frames.close()  # whatever went wrong, the context is given back here


def _times(shots: Sequence[Shot], config: Film, *, still: bool) -> list[tuple[int, float]]:
    """Episode and time of flight of every frame, from its start to its end."""
    if not shots or len({len(shot.tracks) for shot in shots}) != 1 or not shots[0].tracks:
        raise ValueError("shots: expected one or more, with as many episodes each")
    lengths = [max(track.seconds for track in tracks)
               for tracks in zip(*(shot.tracks for shot in shots), strict=True)]  # fmt: skip
    if config.at is not None:
        return [(0, config.at)]
    if still:
        return [(len(lengths) - 1, lengths[-1])]
    step = config.speed / config.fps
    return [
        (episode, number * step)
        for episode, length in enumerate(lengths)
        for number in range(int(length / step + 1e-6) + 1)
    ]


def grid(count: int, width: int, height: int) -> tuple[int, int]:
    """Columns and rows of so many panes in a picture of so many pixels.

    Panes come out a little wider than high, with few places empty.
    """

    def badness(columns: int) -> float:
        rows = -(-count // columns)
        aspect = (width / columns) / (height / rows)
        return abs(math.log(aspect / _ASPECT)) + (columns * rows - count) / count

    columns = min(range(1, count + 1), key=badness)
    return columns, -(-count // columns)


class _Studio:
    """Draws frames. One canvas of a pane's size serves every pane."""

    def __init__(self, shots: Sequence[Shot], config: Film) -> None:
        self._config = config
        columns, rows = grid(len(shots), config.width, config.height)
        width = (config.width - _SPACE * (columns - 1)) // columns
        height = (config.height - _SPACE * (rows - 1)) // rows
        self._corners = [
            ((width + _SPACE) * (i % columns), (height + _SPACE) * (i // columns))
            for i in range(len(shots))
        ]
        stage = Stage(config.world)
        self._canvas = Canvas(stage, width, height, fast=config.fast)
        tracks = [track for shot in shots for track in shot.tracks]
        seconds = max(track.seconds for track in tracks)
        band = _band(tracks)
        try:
            self._panes = [
                _Pane(shot, config, self._canvas, stage.twin(), seconds, band, len(shots) > 1)
                for shot in shots
            ]
        except BaseException:
            self._canvas.close()
            raise

    def frame(self, episode: int, seconds: float) -> np.ndarray:
        """The picture at that time of flight: uint8, shape (height, width, 3)."""
        frame = np.full((self._config.height, self._config.width, 3), _DARK, np.uint8)
        for pane, (x, y) in zip(self._panes, self._corners, strict=True):
            picture = pane.picture(episode, seconds)
            frame[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
        return frame

    def __enter__(self) -> "_Studio":
        return self

    def __exit__(self, *_: object) -> None:
        self._canvas.close()


class _Pane:
    """The picture of one flight, drawn again only where it changes."""

    def __init__(
        self,
        shot: Shot,
        config: Film,
        canvas: Canvas,
        stage: Stage,
        seconds: float,
        band: float,
        named: bool,
    ) -> None:
        self._shot, self._config = shot, config
        self._canvas, self._stage = canvas, stage
        self._shown = (-1, -1)  # episode and step
        self._picture = np.empty(0, np.uint8)
        self._bare = not (config.overlay or named)
        self._overlay = Overlay(
            canvas.width,
            canvas.height,
            title=shot.name,
            color=shot.color,
            period=shot.tracks[0].control_period,
            seconds=seconds,
            band=band,
            numbers=config.overlay,
        )

    def picture(self, episode: int, seconds: float) -> np.ndarray:
        track = self._shot.tracks[episode]
        step = track.step_at(seconds)
        if (episode, step) != self._shown:
            begin = self._shown[1] + 1 if episode == self._shown[0] else 0
            for moment in track.moments[begin : step + 1]:  # its path has no gaps
                self._stage.show(moment)
            self._shown = episode, step
            self._picture = self._draw(track, step)
        return self._picture

    def _draw(self, track: Track, step: int) -> np.ndarray:
        picture = self._canvas.draw(self._config.camera, self._stage)
        if self._bare:
            return picture
        ended = (
            self._config.overlay and step == len(track.moments) - 1 and track.ending != "truncated"
        )
        note = track.ending if ended else ""
        return self._overlay.draw(picture, track.moments[step], track.errors[: step + 1], note)


def _band(tracks: Sequence[Track]) -> float:
    """A round number of metres that holds E.

    Of a crash it holds the start only, for the others to be seen, unless all crashed.
    """
    crashed = [track.ending == "terminated" for track in tracks]
    largest = max(
        abs(error)
        for track, ended in zip(tracks, crashed, strict=True)
        for error in (track.errors[:1] if ended and not all(crashed) else track.errors)
    )
    return next((band for band in _BANDS if largest <= band), math.ceil(largest))
