"""Films of pictures: MP4 or PNGs. A film is there whole or not at all."""

import tempfile
from collections import deque
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..models.errors import InputError, require

Picture = NDArray[np.uint8]

require("PIL", "render", "writing pictures and films")

from PIL import Image  # noqa: E402

QUALITY = 20
"""x264's constant rate factor: less is better and larger."""


def check_film(path: Path, width: int, height: int, fps: float) -> None:
    """Check the arguments of `write_film` before anything is drawn. Raises `InputError`."""
    kind = path.suffix.lower()
    if kind not in (".mp4", ".png", ""):
        raise InputError(
            "film: expected a name that ends in .mp4 or .png, or a folder's name without a dot, "
            f"got {path}"
        )
    if path.exists():
        raise InputError(f"film: {path} is there already; choose another name")
    if not 0.01 <= fps <= 1000:
        raise InputError(f"fps: expected 0.01 to 1000 pictures per second, got {fps:g}")
    if kind == ".mp4" and (width % 2 or height % 2):
        raise InputError(
            f"film: expected an even width and an even height for MP4, got {width}x{height}"
        )


def write_film(
    path: Path, frames: Iterable[Picture], fps: float, *, quality: int = QUALITY
) -> None:
    """Write a film. Ctrl-C leaves nothing behind.

    `.mp4` is H.264 that every browser plays before it is loaded whole; `.png` is the last frame
    alone; a name without a dot becomes a folder of `0001.png` and so on.

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
    first = next(taken, None)
    if first is None:
        raise InputError("film: expected at least one frame, got none")
    height, width = first.shape[:2]
    check_film(path, width, height, fps)

    def checked() -> Iterator[Picture]:
        for frame in chain((first,), taken):
            if frame.dtype != np.uint8 or frame.shape != (height, width, 3):
                raise ValueError(
                    f"film: expected frames of uint8, shape ({height}, {width}, 3), "
                    f"got {frame.dtype}, shape {frame.shape}"
                )
            yield frame

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            unfinished = Path(folder) / path.name
            match path.suffix.lower():
                case ".mp4":
                    _write_mp4(unfinished, checked(), (width, height), fps, quality)
                case ".png":
                    last = deque(checked(), maxlen=1).pop()
                    Image.fromarray(last).save(unfinished)
                case _:
                    unfinished.mkdir()
                    for number, frame in enumerate(checked(), 1):
                        Image.fromarray(frame).save(unfinished / f"{number:04}.png")
            unfinished.rename(path)
    except OSError as error:
        if error.errno is None:  # the encoder's words
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None


def _write_mp4(
    path: Path, frames: Iterator[Picture], size: tuple[int, int], fps: float, quality: int
) -> None:
    ffmpeg = require("imageio_ffmpeg", "render", "an MP4 film")
    try:
        ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        raise OSError(
            "ffmpeg: expected one that imageio-ffmpeg brings or finds, got none; "
            "write a folder of PNGs"
        ) from None
    options = ["-preset", "slow", "-crf", str(quality), "-movflags", "+faststart"]
    rate = Fraction(fps).limit_denominator(1001)
    writer = ffmpeg.write_frames(
        str(path), size, fps=rate, codec="libx264", quality=None, macro_block_size=1,
        ffmpeg_log_level="fatal", output_params=options,
    )  # fmt: skip
    sent = 0
    try:
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))
            sent += 1
        writer.close()
        written, _ = ffmpeg.count_frames_and_secs(str(path))
    except (OSError, RuntimeError):
        written = -1
    finally:
        writer.close()
    if written != sent:
        raise OSError("ffmpeg: the film could not be written: is the disk full?")
