"""How fast pictures are drawn without a window.

    python studies/rendering.py [--rounds 5] [--frames 20] [--out FILE.json]

Every size and quality is drawn in turns; the fastest round of each counts, since other work on the
machine only slows it down. The craft flies: every picture differs from the one before.

It takes about two minutes on two cores.
"""

import json
import os
import time

from measuring import RESULTS, in_turns, options, write
from rotorgram.agents import PID
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.registry import env_spec
from rotorgram.flights.filming import moments
from rotorgram.flights.trajectories import flown_trajectories
from rotorgram.rendering import Canvas, Moment, Stage

SIZES = ((640, 360), (1280, 720))
ENV = "rotorgram/Elevation-v0"
EPISODE = 1


def rate(flight: list[Moment], width: int, height: int, fast: bool) -> float:
    """Pictures per second of a flight."""
    stage = Stage("airport")
    with Canvas(stage, width, height, fast=fast) as canvas:
        stage.show(flight[0])
        canvas.draw("chase")
        start = time.perf_counter()
        for moment in flight:
            stage.show(moment)
            canvas.draw("chase")
        return round(len(flight) / (time.perf_counter() - start), 1)


def main() -> None:
    out = RESULTS / "performance" / "rendering.json"
    args = options(__doc__, rounds=5, frames=20, out=out).parse_args()
    config = EnvConfig(env_id=ENV)
    (flown,) = flown_trajectories(PID(env_spec(config)), config, [EPISODE])
    flight = moments(flown)[: args.frames]
    ways = {
        f"{width}x{height}{words}": (width, height, fast)
        for width, height in SIZES
        for words, fast in (("", False), (", fast", True))
    }
    rates = in_turns(ways, args.rounds, lambda way: rate(flight, *way))
    result = {
        "rounds": args.rounds,
        "frames": args.frames,
        "pictures_per_second": {name: max(found) for name, found in rates.items()},
        "load": [round(load, 1) for load in os.getloadavg()],
    }
    write(args.out, result)
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
