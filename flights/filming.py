"""Films of trajectories: a frame shows the control step of its time; several side by side."""

import math
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np

from ..envs.rendering import moment
from ..models import InputError
from ..models.fields import Limits, check_fields, immutable
from ..rendering import Camera, Canvas, Moment, Stage
from ..rendering.film import QUALITY, Picture, write_film
from ..rendering.insets import add_insets
from ..scenes import SceneConfig, parse_scene
from .executors import Tell
from .trajectories import Flights, Trajectory, common_scene

MAX_FRAMES = 1_000_000
"""Largest number of frames of a film: 11 hours of it."""
Times = Mapping[int, Sequence[float]]
"""Times of the frames of each episode that a film shows, s."""
_SPACE = 2  # pixels between panes
_DARK = (13, 18, 26)
_ASPECT = 1.2  # of a pane that shows a craft well


def moments(trajectory: Trajectory) -> list[Moment]:
    """The moments of a trajectory: its start, and after each control step.

    They have readings of sensors with rays if those are among the observations. Raises `InputError`
    if its telemetry lacks position, attitude or thrust.
    """
    spec = trajectory.spec
    spec.check_telemetry(("position", "attitude", "thrust"), "pictures")
    return [
        moment(
            spec,
            trajectory.row(step),
            step=step,
            reward=reward,
            episode=trajectory.episode,
            readings=trajectory.readings(step),
        )
        for step, reward in enumerate([0.0, *trajectory.rewards.tolist()])
    ]


@immutable
class FilmTrack:
    """One pane of a film: a name and its trajectories."""

    name: str
    trajectories: Flights
    """Episode after episode; with several drones those of each episode in the order of the drones.
    """
    drones: int = 1
    """Drones of the world of each episode."""

    @cached_property
    def episodes(self) -> list[Flights]:
        """The trajectories of each episode, one of each drone."""
        firsts = range(0, len(self.trajectories), self.drones)
        return [self.trajectories[first : first + self.drones] for first in firsts]

    def note(self, episode: int, step: int) -> str:
        """Which trajectories have ended at a step otherwise than by the clock."""
        flown = self.episodes[episode]
        early = [one.ending for one in flown if step >= len(one) and one.ending != "truncated"]
        if self.drones == 1:
            return "".join(early)
        return f"{len(early)} of {self.drones} ended" if early else ""


@immutable
class Film:
    """Settings of a film."""

    width: int = 1280
    """Pixels."""
    height: int = 720
    camera: Camera = "chase"
    fps: float = 25.0
    speed: Annotated[float, Limits(0.001, 1000)] = 1.0
    """Seconds of flight per second of film."""
    scene: str | None = None
    """None: the one that was flown in, and the airport in place of bare ground."""
    vehicle: str | None = None
    """File or name of the vehicle; None: the paper's."""
    overlay: bool = True
    """Whether time and numbers are written. Of several panes the names always are."""
    at: Annotated[float | None, Limits(0, unit="s")] = None
    """Only the picture at this time of the first episode, s."""
    fast: bool = False
    """Without shadows and smooth edges."""
    quality: int = QUALITY
    """As of `write_film`."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.scene is not None:
            parse_scene(self.scene)


def film(
    path: Path, tracks: Sequence[FilmTrack], config: Film, tell: Tell = lambda *_: None
) -> int:
    """Film trajectories side by side, into a path as of `write_film`; the number of frames written.

    A `.png` is the picture at `config.at`, or the last. There are one or more tracks, each with as
    many trajectories. An episode lasts until its longest trajectory has ended; one that ended
    before stays on its last picture.

    Raises:
        NoOpenGL: No OpenGL works here.
        InputError: A wrong name, size or rate, or a film that is too long.
        OSError: It cannot be written.
    """
    times = _times(tracks, config, still=path.suffix.lower() == ".png")
    # Whatever goes wrong, the OpenGL context is given back here.
    with closing(_frames(tracks, config, times, tell)) as frames:
        write_film(path, frames, config.fps, quality=config.quality)
    return sum(map(len, times.values()))


def _times(tracks: Sequence[FilmTrack], config: Film, *, still: bool) -> Times:
    """Times of the frames of each episode, from its start to its end."""
    counts = {(len(track.episodes), track.drones) for track in tracks}
    if len(counts) != 1 or not tracks[0].episodes:
        raise InputError("tracks: expected one or more, with as many episodes and drones each")
    lengths = []
    for worlds in zip(*(track.episodes for track in tracks), strict=True):
        lengths.append(max(one.seconds for world in worlds for one in world))
    if config.at is not None:
        return {0: [config.at]}
    if still:
        return {len(lengths) - 1: lengths[-1:]}
    step = config.speed / config.fps
    seconds = sum(lengths)
    if seconds / step > MAX_FRAMES:
        raise InputError(
            f"film: expected at most {MAX_FRAMES:,} frames, got {seconds / step:,.0f} "
            f"for {seconds:,.0f} s of flight; choose a higher speed"
        )
    times = {}
    for episode, length in enumerate(lengths):
        frames = int(length / step + 1e-6) + 1
        times[episode] = [number * step for number in range(frames)]
    return times


def grid(count: int, width: int, height: int) -> tuple[int, int]:
    """Columns and rows of so many panes in a picture of so many pixels."""
    rows = round(math.sqrt(count * height * _ASPECT / width))
    rows = min(max(rows, 1), count)
    return math.ceil(count / rows), rows


def _frames(
    tracks: Sequence[FilmTrack], config: Film, times: Times, tell: Tell
) -> Generator[Picture, None, None]:
    """Frames, shape (height, width, 3)."""
    columns, rows = grid(len(tracks), config.width, config.height)
    width = (config.width - _SPACE * (columns - 1)) // columns
    height = (config.height - _SPACE * (rows - 1)) // rows
    total = sum(map(len, times.values()))
    number = 0
    shown: SceneConfig | None = None
    with ExitStack() as opened:
        for episode, seconds in times.items():
            scene = _scene_of(tracks, config, episode)
            if scene != shown:
                opened.close()
                shown = scene
                canvases = []
                for track in tracks:
                    stage = Stage(scene, track.drones, vehicle=config.vehicle)
                    canvas = Canvas(stage, width, height, fast=config.fast)
                    canvases.append(opened.enter_context(canvas))
            panes = [
                _pane(track, canvas, config, episode, seconds, named=len(tracks) > 1)
                for track, canvas in zip(tracks, canvases, strict=True)
            ]
            for pictures in zip(*panes, strict=True):
                frame = np.full((config.height, config.width, 3), _DARK, np.uint8)
                for place, picture in enumerate(pictures):
                    row, column = divmod(place, columns)
                    x = (width + _SPACE) * column
                    y = (height + _SPACE) * row
                    frame[y : y + height, x : x + width] = picture
                yield frame
                number += 1
                tell(number, total, "done" if number == total else "frames")


def _scene_of(tracks: Sequence[FilmTrack], config: Film, episode: int) -> SceneConfig:
    """What surrounds the drones of an episode. Raises `InputError` where tracks differ."""
    if config.scene is not None:
        return parse_scene(config.scene)
    return common_scene(one.scene.shown for track in tracks for one in track.episodes[episode])


def _pane(
    track: FilmTrack,
    canvas: Canvas,
    config: Film,
    episode: int,
    times: Sequence[float],
    *,
    named: bool,
) -> Iterator[Picture]:
    """The picture at each time of an episode of one track, drawn where it changes.

    Its name is on it in any case if it is `named`, otherwise beside the time.
    """
    flown = [moments(one) for one in track.episodes[episode]]
    longest = max(track.episodes[episode], key=len)
    stage = canvas.stage
    shown = -1
    for seconds in times:
        step = longest.step_at(seconds)
        for now in range(shown + 1, step + 1):  # paths have no gaps
            stage.show(*(own[min(now, len(own) - 1)] for own in flown))
        if step > shown:
            shown = step
            lines = [(track.name, "")] if named else []
            if config.overlay:
                lines = _lines(track, stage, episode, step)
            picture = canvas.draw(config.camera, lines)
            add_insets(picture, stage.moments[0])
        yield picture


def _lines(track: FilmTrack, stage: Stage, episode: int, step: int) -> list[tuple[str, str]]:
    """Name and time; the first metric, of several drones the least distance; early ends."""
    seconds = step * track.trajectories[0].spec.control_period
    lines = [(track.name, f"{seconds:.2f} s")]
    distance = stage.least_distance
    if distance is not None:
        lines.append(("least distance", f"{distance:.2f} m"))
    else:
        lines += stage.moments[0].metrics[:1]
    for reading in stage.moments[0].readings:
        lines.append((reading.name, f"0 to {reading.reach:g} m"))
    note = track.note(episode, step)
    return [*lines, (note, "")] if note else lines
