"""How fast pictures are drawn without a window.

    python studies/rendering.py [--rounds 5] [--frames 20] [--out FILE.json]

Every size and quality is drawn in turns; the fastest round of each counts, since other work on the
machine only slows it down. The craft flies: every picture differs from the one before.

It takes about two minutes on two cores.
"""

import json
import os
import time
from collections.abc import Callable

from measuring import RESULTS, options, write
from rotorgram.agents import PID
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.filming import moments
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.rendering import Canvas, Moment, Stage

SIZES = ((640, 360), (1280, 720))
ENV = "rotorgram/Elevation-v0"
EPISODE = 1


def rate(draw: Callable[[int], object], frames: int) -> float:
    """Pictures per second."""
    start = time.perf_counter()
    for number in range(frames):
        draw(number)
    return frames / (time.perf_counter() - start)


def pictures(flight: list[Moment], rounds: int, frames: int) -> dict[str, float]:
    """Pictures per second by size and quality."""
    rates: dict[str, float] = {}
    for _ in range(rounds):
        for width, height in SIZES:
            for fast in (False, True):
                stage = Stage("airport")
                with Canvas(stage, width, height, fast=fast) as canvas:

                    def draw(number: int, stage: Stage = stage, canvas: Canvas = canvas) -> None:
                        stage.show(flight[number])
                        canvas.draw("chase")

                    draw(0)
                    name = f"{width}x{height}{', fast' if fast else ''}"
                    rates[name] = max(rates.get(name, 0.0), round(rate(draw, frames), 1))
    return rates


def main() -> None:
    out = RESULTS / "performance" / "rendering.json"
    args = options(__doc__, rounds=5, frames=20, out=out).parse_args()
    config = EnvConfig(env_id=ENV)
    (flown,) = flown_trajectories(PID(env_spec(config)), config, [EPISODE])
    flight = moments(flown)
    result = {
        "rounds": args.rounds,
        "frames": args.frames,
        "pictures_per_second": pictures(flight, args.rounds, args.frames),
        "load": [round(load, 1) for load in os.getloadavg()],
    }
    write(args.out, result)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
