"""How fast pictures are drawn without a window, and how long a film takes.

    python benchmarks/rendering.py [--rounds 5] [--frames 20] [--out FILE.json]

Every size and quality is drawn in turns; the fastest round of each counts, since whatever else the
machine does only slows it down. The craft flies: every picture is another one.
"""

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
from rotorgram.agents.pid import PID
from rotorgram.envs import ElevationConfig
from rotorgram.experiments.filming import Film, Shot, film
from rotorgram.experiments.flights import Track, flown_tracks
from rotorgram.rendering import Canvas, Stage
from rotorgram.rendering.gl import offscreen_context
from rotorgram.rendering.overlay import Overlay

SIZES = ((640, 360), (1280, 720))
EPISODE = 1  # starts 0.75 m below its target


def rate(draw: Callable[[int], object], frames: int) -> float:
    """Pictures per second."""
    start = time.perf_counter()
    for number in range(frames):
        draw(number)
    return frames / (time.perf_counter() - start)


def pictures(track: Track, rounds: int, frames: int) -> tuple[dict[str, float], str]:
    """Pictures per second by size and quality, and who draws."""
    rates: dict[str, float] = {}
    for _ in range(rounds):
        for width, height in SIZES:
            for fast in (False, True):
                stage = Stage("airport")
                with Canvas(stage, width, height, fast=fast) as canvas:
                    renderer = driver()

                    def draw(number: int, stage: Stage = stage, canvas: Canvas = canvas) -> None:
                        stage.show(track.moments[number])
                        canvas.draw("chase")

                    draw(0)
                    name = f"{width}x{height}{', fast' if fast else ''}"
                    rates[name] = max(rates.get(name, 0.0), round(rate(draw, frames), 1))
    return rates, renderer


def driver() -> str:
    """What OpenGL calls itself."""
    context = offscreen_context(16, 16)
    from OpenGL.GL import GL_RENDERER, glGetString  # after the context has chosen its platform

    with context.as_current():
        name = str(glGetString(GL_RENDERER).decode())
    context.free()
    return name


def overlays(track: Track, rounds: int, frames: int) -> dict[str, float]:
    """Milliseconds for what is written on a picture."""
    import numpy as np

    times = {}
    for width, height in SIZES:
        overlay = Overlay(width, height, title="PID", period=0.02, seconds=5.0, band=1.0)
        picture = np.zeros((height, width, 3), np.uint8)

        def draw(number: int, overlay: Overlay = overlay, picture: Any = picture) -> None:
            overlay.draw(picture, track.moments[number], track.errors[: number + 1])

        best = max(rate(draw, frames) for _ in range(rounds))
        times[f"{width}x{height}"] = round(1000 / best, 2)
    return times


def whole_film(track: Track) -> dict[str, float]:
    """Five seconds at 1280x720 as MP4, once."""
    shot = Shot(name="PID", color="#B4BCC4", tracks=[track])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        start, spent = time.perf_counter(), time.process_time()
        frames = film(path, [shot], Film())
        return {
            "frames": frames,
            "seconds": round(time.perf_counter() - start, 1),
            "processor_seconds": round(time.process_time() - spent, 1),
            "kilobytes": round(path.stat().st_size / 1000),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=20)
    default = Path("docs/results/performance/rendering.json")
    parser.add_argument("--out", type=Path, default=default)
    args = parser.parse_args()
    config = ElevationConfig()
    (track,) = flown_tracks(PID(config), config, [EPISODE])
    rates, renderer = pictures(track, args.rounds, args.frames)
    result = {
        "rounds": args.rounds,
        "frames": args.frames,
        "pictures_per_second": rates,
        "overlay_milliseconds": overlays(track, args.rounds, args.frames),
        "film": whole_film(track),
        "renderer": renderer,
        "versions": {"mujoco": mujoco.__version__},
        "machine": {"processor": platform.machine(), "cores": os.cpu_count()},
        "load": [round(load, 1) for load in os.getloadavg()],
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
