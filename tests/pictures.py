"""Moments, films and pixels for the tests of what is drawn."""

import subprocess
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from imageio_ffmpeg import (  # type: ignore[import-untyped]
    get_ffmpeg_exe,
)
from PIL import Image
from rotorgram.rendering import Moment

WIDTH = 160
HEIGHT = 120
DATA: Final = Path(__file__).parent / "data"
TABLES: Final[dict[str, Any]] = tomllib.loads((DATA / "pictures.toml").read_text("utf-8"))
HEXA: Final = DATA / "meadow_hexa.xml"
"""Six rotors of up to 30 N, 0.62 m from centre to tip, with a ground of its own."""
TINY: Final = DATA / "tiny.xml"
"""27 g, four rotors of up to 0.15 N, 0.069 m from centre to tip."""


def at(elevation: float, error: float = 0.0, *, goal: Any = True, **rest: Any) -> Moment:
    """A level craft over the origin, whose goal is `error` metres higher; goal=None: no goal."""
    fields: dict[str, Any] = {
        "position": (0.0, 0.0, elevation),
        "attitude": (1.0, 0.0, 0.0, 0.0),
        "thrusts": (49.0, 49.0, 49.0, 49.0),
        "goal": (0.0, 0.0, elevation + error) if goal is True else goal,
        "metrics": (("E", f"{error:.3f} m"),),
    }
    return Moment(**{**fields, **rest})


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def decoded(path: Path, width: int, height: int) -> np.ndarray:
    """Every frame of a film: uint8, shape (frames, height, width, 3)."""
    words = ["-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    data = subprocess.run([get_ffmpeg_exe(), *words], capture_output=True, check=True).stdout
    return np.frombuffer(data, np.uint8).reshape(-1, height, width, 3)


def nearest(picture: np.ndarray, others: Sequence[np.ndarray]) -> int:
    """The number of the picture that differs least; it differs by less than 1 of 255 in the mean.

    On a busy machine two of some 150 films had discs in another shade, by up to 34 of 255, in up to
    0.7 % of the pixels; more than a thousand later films had none. We do not know the cause.
    """
    apart = [abs(picture.astype(int) - other).mean() for other in others]
    number = int(np.argmin(apart))
    assert apart[number] < 1.0
    return number


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two pictures show the same: drivers round differently from time to time, and now and
    then a pixel at an edge falls to the other side.
    """
    if one.shape != other.shape:
        return False
    off = abs(one.astype(int) - other).max(axis=-1) > 3
    return bool(off.mean() <= 0.002)


def ffmpeg_facts(path: Path) -> str:
    """What ffmpeg prints about a film."""
    words = [get_ffmpeg_exe(), "-i", str(path)]
    return subprocess.run(words, capture_output=True, text=True, check=False).stderr
