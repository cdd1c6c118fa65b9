"""Flights, films and pixels for the tests of what is drawn."""

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from imageio_ffmpeg import (  # type: ignore[import-untyped]
    get_ffmpeg_exe,
)
from PIL import Image
from rotorgram.envs import ElevationConfig
from rotorgram.experiments.filming import Film, Shot
from rotorgram.experiments.flights import Track
from rotorgram.rendering import Moment

WIDTH, HEIGHT = 160, 120
SHORT = ElevationConfig(episode_length=25)  # half a second
FAST = Film(width=WIDTH, height=HEIGHT, world="plain", fast=True, overlay=False)


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
