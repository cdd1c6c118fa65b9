"""What it costs a simulator to be watched: lock-step rates with a window and without.

    xvfb-run -a -s "-screen 0 1280x800x24" python studies/viewing.py [--rounds 5] [--seconds 3]

Every turn starts a simulator of its own (`rotorgram sim`) for an agent here, waits until both fly,
and counts control steps, and pictures that are handed to the window. The turns
alternate; medians count, of rates and of their ratios within a round.

It takes about three minutes on two cores.
"""

import itertools
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from measuring import RESULTS, in_turns, medians, options, timed, write
from rotorgram.udp import RemoteEnv, RemoteVectorEnv

KINDS = ("none", "window")
SETTLE = 3.0  # s: until a window is open

RENDERER = """
import glfw
from OpenGL.GL import GL_RENDERER, glGetString
glfw.init()
glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
glfw.make_context_current(glfw.create_window(16, 16, "", None, None))
print(glGetString(GL_RENDERER).decode())
"""

SIM = """
import json, sys, time
from rotorgram.cli import main
from rotorgram.rendering.window import Window

shown = []

def counted(show):
    def note(*arguments):
        shown.append(time.monotonic())
        show(*arguments)
    return note

Window.show = counted(Window.show)
sys.argv[0] = "rotorgram"
status = main()
print(json.dumps(shown))
sys.exit(status)
"""
"""`rotorgram sim`, which writes when it handed pictures on."""


@contextmanager
def simulator(drones: int, kind: str, address: tuple[str, int]) -> Iterator[list[float]]:
    """A simulator in a process of its own, watched in one way: afterwards when it was drawn."""
    view = ["--view"] if kind == "window" else []
    server = "{}:{}".format(*address)
    words = ["--server", server, "--bind", "127.0.0.1:0", "--num-envs", str(drones), *view]
    command = [sys.executable, "-c", SIM, "sim", *words]
    shown = list[float]()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        yield shown
        told, _ = process.communicate()
        shown += json.loads(told.splitlines()[-1])


def fly(env: Any, drones: int, seconds: float) -> float:
    """Control steps per second."""
    drawn = np.random.default_rng(0).uniform(-0.1, 0.1, (256, drones, 1)).astype(np.float32)
    actions = itertools.cycle(drawn if drones > 1 else drawn[:, 0])

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if drones == 1 and (terminated or truncated):
            env.reset()

    wall, _ = timed(step, seconds)
    return 1 / wall


def turn(drones: int, kind: str, seconds: float) -> tuple[float, float]:
    """Control steps and pictures per second."""
    here = ("127.0.0.1", 0)
    env = (
        RemoteEnv(here, connect=False)
        if drones == 1
        else RemoteVectorEnv(here, num_envs=drones, connect=False)
    )
    with simulator(drones, kind, env.address) as shown:
        try:
            env.reset(seed=0)
            if kind != "none":
                fly(env, drones, SETTLE)
            fly(env, drones, 0.5)
            start = time.monotonic()
            rate = fly(env, drones, seconds)
            end = time.monotonic()
        finally:
            env.close()
    return rate, sum(start < moment <= end for moment in shown) / (end - start)


def ratio(watched: list[float], alone: list[float]) -> float:
    """Median of what one is of the other in the same round: a slow while slows both."""
    return round(statistics.median(a / b for a, b in zip(watched, alone, strict=True)), 3)


def main() -> None:
    out = RESULTS / "performance" / "viewing.json"
    args = options(__doc__, rounds=5, seconds=3.0, out=out).parse_args()
    renderer = subprocess.run(
        [sys.executable, "-c", RENDERER], capture_output=True, text=True, check=True
    ).stdout.strip()
    ways = {(drones, kind): (drones, kind) for drones in (1, 64) for kind in KINDS}
    turns = in_turns(ways, args.rounds, lambda way: turn(*way, args.seconds))
    rates: dict[str, dict[str, list[float]]] = {"1": {}, "64": {}}
    pictures: dict[str, dict[str, list[float]]] = {"1": {}, "64": {}}
    for (drones, kind), pairs in turns.items():
        rates[str(drones)][kind] = [round(rate, 1) for rate, _ in pairs]
        pictures[str(drones)][kind] = [round(drawn, 1) for _, drawn in pairs]
    result = {
        "rounds": args.rounds,
        "seconds": args.seconds,
        "control_steps_per_second": {drones: medians(of) for drones, of in rates.items()},
        "pictures_per_second": {drones: medians(of) for drones, of in pictures.items()},
        "of_that_without": {
            drones: {kind: ratio(many, of["none"]) for kind, many in of.items()}
            for drones, of in rates.items()
        },
        "rates": rates,
        "opengl": renderer,
        "scene": "airport",
    }
    write(args.out, result)
    print(json.dumps(result["control_steps_per_second"], indent=2))


if __name__ == "__main__":
    main()
