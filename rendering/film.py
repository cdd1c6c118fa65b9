"""Films of pictures: MP4, GIF, PNGs. A film is there whole or not at all."""

import io
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from ..models.errors import InputError, expect, require
from ._pillow import Image

SUFFIXES: Final = (".mp4", ".gif", ".png", "")
"""Kinds of film, by suffix; no suffix is a folder of PNGs."""
QUALITY: Final = 20
"""x264's constant rate factor: less is better and larger."""


def check_film(path: Path, width: int, height: int, fps: float) -> None:
    """Check the arguments of `write_film` before anything is drawn. Raises `InputError`."""
    kind, hundredths = path.suffix.lower(), 100 / max(fps, 0.01)
    expected = "a name that ends in .mp4, .gif or .png, or a folder's name without a dot"
    expect(kind in SUFFIXES, "film", expected, str(path))
    if path.exists():
        raise InputError(f"film: {path} is there already; choose another name")
    expect(0.01 <= fps <= 1000, "fps", "0.01 to 1000 pictures per second", f"{fps:g}")
    even = kind != ".mp4" or not (width % 2 or height % 2)
    expect(even, "film", "an even width and an even height for MP4", f"{width}x{height}")
    whole = kind != ".gif" or abs(hundredths - round(hundredths)) <= 1e-6
    expected = "100 divided by a whole number (50, 25, 20, 10) for GIF, which counts hundredths"
    expect(whole, "fps", f"{expected} of a second", f"{fps:g}")


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
    shape, count = (*first.shape[:2], 3), 0

    def counted() -> Iterator[np.ndarray]:
        nonlocal count
        for frame in chain((first,), taken):
            count += 1
            if frame.dtype != np.uint8 or frame.shape != shape:
                got = f"got {frame.dtype}, shape {frame.shape}"
                raise ValueError(f"film: expected frames of uint8, shape {shape}, {got}")
            yield frame

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        unfinished = Path(folder) / path.name
        match path.suffix.lower():
            case ".mp4":
                _write_mp4(unfinished, counted(), first.shape, fps, quality)
            case ".gif":
                _write_gif(unfinished, counted(), fps)
            case ".png":
                *_, last = counted()
                Image.fromarray(last).save(unfinished)
            case _:
                unfinished.mkdir()
                for number, frame in enumerate(counted(), 1):
                    Image.fromarray(frame).save(unfinished / f"{number:04}.png")
        unfinished.rename(path)
    return count


def _write_gif(path: Path, frames: Iterator[np.ndarray], fps: float) -> None:
    # Without dithering: parts that stand still do not change, and cost nothing.
    pictures = (Image.fromarray(f).quantize(256, dither=Image.Dither.NONE) for f in frames)
    first, settings = next(pictures), {"duration": round(100 / fps) * 10, "loop": 0}
    with path.open("wb") as file:  # Pillow's own stays open when it is interrupted
        first.save(file, "GIF", save_all=True, append_images=pictures, **settings)


def _write_mp4(
    path: Path, frames: Iterator[np.ndarray], shape: tuple[int, ...], fps: float, quality: int
) -> None:
    """Through FFmpeg. Raises `OSError` with its words if it fails."""
    size, rate = f"{shape[1]}x{shape[0]}", str(Fraction(fps).limit_denominator(1001))
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
