"""Films of trajectories: a frame shows the control step of its time; several side by side."""

import math
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from ..envs.rendering import moment
from ..models.errors import InputError, expect
from ..rendering import Camera, Canvas, MetricValue, Moment, Stage
from ..rendering.film import QUALITY, Overlay, check_film, graph_scale, write_film
from ..scenes import parse_scene
from .distances import least
from .trajectories import Trajectory

OnFrame = Callable[[int, int], object]
"""Called with frames drawn, and frames in all."""

MOST_FRAMES: Final = 1_000_000
"""Of a film: 11 hours of it."""
_SPACE: Final = 2  # pixels between panes
_DARK: Final = (13, 18, 26)
_ASPECT: Final = 1.2  # of a pane that shows a craft and its graph well


def moments(trajectory: Trajectory) -> list[Moment]:
    """The moments of a trajectory: its start, and after each control step.

    Raises `InputError` if its telemetry does not tell where the craft is.
    """
    told, spec = trajectory.telemetry, trajectory.spec
    if missing := ", ".join(sorted({"position", "attitude", "thrust"} - set(told))):
        raise InputError(f"pictures: expected telemetry of {missing}, {spec.env_id} tells none")
    rewards = [0.0, *trajectory.rewards.tolist()]
    return [
        moment(spec, {name: array[step] for name, array in told.items()}, step=step,
               reward=reward, episode=trajectory.episode)
        for step, reward in enumerate(rewards)
    ]  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One pane: a name and its trajectories."""

    name: str
    color: str
    """Of name and curve, "#RRGGBB"."""
    trajectories: list[Trajectory]
    """One after the other; with several drones those of each episode, in the order of the drones.
    """
    drones: int = 1
    """Of the world of each episode."""

    @cached_property
    def episodes(self) -> list[list[Trajectory]]:
        """The trajectories of each episode, one of each drone."""
        flown, drones = self.trajectories, self.drones
        return [flown[first : first + drones] for first in range(0, len(flown), drones)]

    @cached_property
    def moments(self) -> list[list[list[Moment]]]:
        """Of each episode and drone."""
        return [[moments(one) for one in world] for world in self.episodes]

    @cached_property
    def distances(self) -> list[np.ndarray]:
        """Of each episode the least distance between two drones after each control step, m, shape
        (T + 1,). One that has ended stays where it is, as in the pictures.
        """
        found = []
        for world in self.episodes:
            told, long = [one.telemetry["position"] for one in world], max(map(len, world)) + 1
            padded = [np.pad(one, ((0, long - len(one)), (0, 0)), "edge") for one in told]
            found.append(least(np.stack(padded, axis=1)))
        return found

    def panel(self, episode: int, step: int) -> Moment:
        """What the overlay tells: the first drone, and the least distance if there are others."""
        told = self.moments[episode][0]
        own = told[min(step, len(told) - 1)]
        if self.drones == 1:
            return own
        distance = MetricValue("least distance", float(self.distances[episode][step]), "m")
        return replace(own, metrics=(distance, *own.metrics))

    def curve(self, episode: int) -> np.ndarray:
        """The overlay's graph: the headline metric; of several drones the least distance, m."""
        if self.drones == 1:
            return self.episodes[episode][0].headline
        return self.distances[episode]

    def note(self, episode: int, step: int) -> str:
        """Which trajectories have ended at a step otherwise than by the clock."""
        ended = [one.ending for one in self.episodes[episode] if step >= len(one)]
        early = [ending for ending in ended if ending != "truncated"]
        if self.drones == 1:
            return "".join(early)
        return f"{len(early)} of {self.drones} ended" if early else ""


@dataclass(frozen=True, kw_only=True)
class Film:
    """Settings of a film."""

    width: int = 1280
    """Pixels."""
    height: int = 720
    camera: Camera = "chase"
    fps: float = 25.0
    speed: float = 1.0
    """Seconds of flight per second of film."""
    world: str = "airport"
    vehicle: str | None = None
    """File or name of the vehicle; None: the paper's."""
    overlay: bool = True
    """Whether numbers and graphs are drawn. Of several panes the names always are."""
    at: float | None = None
    """Only the picture at this time of the first episode, s."""
    fast: bool = False
    """Without shadows and smooth edges."""
    quality: int = QUALITY
    """As of `write_film`."""

    def __post_init__(self) -> None:
        parse_scene(self.world)
        expect(0.001 <= self.speed <= 1000, "speed", "0.001 to 1000", f"{self.speed:g}")
        right = self.at is None or 0 <= self.at < math.inf
        expect(right, "at", "a time of 0 s or more", f"{self.at or 0:g}")


def film(
    path: Path, shots: Sequence[Shot], config: Film, on_frame: OnFrame = lambda *_: None
) -> int:
    """Film trajectories side by side, into a path as of `write_film`; the number of frames written.

    A `.png` is the picture at `config.at`, or the last. There are one or more shots, each with as
    many trajectories. An episode lasts until its longest trajectory has ended; one that ended
    before stays on its last picture.

    Raises:
        NoOpenGL: No OpenGL works here.
        InputError: A wrong name, size or rate, or a film that is too long.
        OSError: It cannot be written.
    """
    check_film(path, config.width, config.height, config.fps)
    times = _times(shots, config, still=path.suffix.lower() == ".png")
    # Whatever goes wrong, the OpenGL context is given back here.
    with closing(_frames(shots, config, times, on_frame)) as frames:
        return write_film(path, frames, config.fps, quality=config.quality)


def _times(shots: Sequence[Shot], config: Film, *, still: bool) -> list[tuple[int, float]]:
    """Episode and time of flight of every frame, from its start to its end."""
    counts = {(len(shot.episodes), shot.drones) for shot in shots}
    right = len(counts) == 1 and min(counts)[0]
    expect(right, "shots", "one or more, with as many episodes and drones each")
    episodes = zip(*(shot.episodes for shot in shots), strict=True)
    lengths = [max(one.seconds for world in flown for one in world) for flown in episodes]
    if config.at is not None:
        return [(0, config.at)]
    if still:
        return [(len(lengths) - 1, lengths[-1])]
    step, seconds = config.speed / config.fps, sum(lengths)
    got = f"{seconds / step:,.0f} for {seconds:,.0f} s of flight; choose a higher speed"
    expect(seconds / step <= MOST_FRAMES, "film", f"at most {MOST_FRAMES:,} frames", got)
    return [
        (episode, number * step)
        for episode, length in enumerate(lengths)
        for number in range(int(length / step + 1e-6) + 1)
    ]


def grid(count: int, width: int, height: int) -> tuple[int, int]:
    """Columns and rows of so many panes in a picture of so many pixels, with few empty places."""

    def badness(shape: tuple[int, int]) -> float:
        columns, rows = shape
        aspect = (width * rows) / (height * columns)
        return abs(math.log(aspect / _ASPECT)) + (columns * rows - count) / count

    return min(((columns, -(-count // columns)) for columns in range(1, count + 1)), key=badness)


def _frames(
    shots: Sequence[Shot], config: Film, times: Sequence[tuple[int, float]], on_frame: OnFrame
) -> Generator[np.ndarray, None, None]:
    """Frames of uint8, shape (height, width, 3). One canvas of a pane's size serves every pane."""
    columns, rows = grid(len(shots), config.width, config.height)
    width = (config.width - _SPACE * (columns - 1)) // columns
    height = (config.height - _SPACE * (rows - 1)) // rows
    drones = shots[0].drones
    names = shots[0].trajectories[0].spec.agents if drones > 1 else ()
    stage = Stage(config.world, drones, vehicle=config.vehicle, names=names)
    with Canvas(stage, width, height, fast=config.fast) as canvas:
        panes = [_pane(shot, config, canvas, stage.twin(), shots) for shot in shots]
        for pane in panes:
            next(pane)
        for number, now in enumerate(times, 1):
            frame = np.full((config.height, config.width, 3), _DARK, np.uint8)
            for place, pane in enumerate(panes):
                x, y = (width + _SPACE) * (place % columns), (height + _SPACE) * (place // columns)
                frame[y : y + height, x : x + width] = pane.send(now)
            yield frame
            on_frame(number, len(times))


def _pane(
    shot: Shot, config: Film, canvas: Canvas, stage: Stage, shots: Sequence[Shot]
) -> Generator[np.ndarray, tuple[int, float], None]:
    """Pictures of one flight, for each episode and time that are sent; drawn where they change."""
    seconds = max(one.seconds for other in shots for one in other.trajectories)
    of = stage.names[0] if stage.names else ""
    scale, named = _scale(shots), len(shots) > 1
    overlay = Overlay(
        canvas.width, canvas.height, title=shot.name, color=shot.color, like=shot.panel(0, 0),
        vehicle=stage.vehicle, period=shot.trajectories[0].spec.control_period, of=of,
        seconds=seconds, scale=scale, numbers=config.overlay,
    )  # fmt: skip
    picture, shown = np.empty(0, np.uint8), (-1, -1)  # episode and step
    while True:
        episode, seconds = yield picture
        world, told = shot.episodes[episode], shot.moments[episode]
        trajectory = max(world, key=len)  # that of one that flew to the end
        step = trajectory.step_at(seconds)
        if (episode, step) == shown:
            continue
        begin = shown[1] + 1 if episode == shown[0] else 0
        for now in range(begin, step + 1):  # paths have no gaps
            stage.show(*(own[min(now, len(own) - 1)] for own in told))
        shown = episode, step
        picture = canvas.draw(config.camera, stage)
        if config.overlay or named:
            note = shot.note(episode, step) if config.overlay else ""
            values = shot.curve(episode)[: step + 1].tolist()
            picture = overlay.draw(picture, shot.panel(episode, step), values, note)


def _scale(shots: Sequence[Shot]) -> tuple[float, float]:
    """Ends of the graph. Of the headline metric a crash has its start, unless all crashed."""
    if shots[0].drones > 1:
        return graph_scale(np.concatenate([x for shot in shots for x in shot.distances]).tolist())
    flown = [one for shot in shots for one in shot.trajectories]
    crashed = [one.terminated for one in flown]
    ends = [1 if crash and not all(crashed) else None for crash in crashed]
    shown = [one.headline[:end] for one, end in zip(flown, ends, strict=True)]
    return graph_scale(np.concatenate(shown).tolist())
