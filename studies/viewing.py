"""What it costs a simulator to be watched: lock-step rates with a window, a page and neither.

    xvfb-run -a -s "-screen 0 1280x800x24" python studies/viewing.py [--rounds 5] [--seconds 3]

Every turn starts a simulator of its own (`rotorgram sim`) for an agent here, waits until both fly,
and counts control steps, and pictures that are handed to the window or the page. The turns
alternate; medians count, of rates and of their ratios within a round. Where chromium is installed a
page is also watched by one, without a screen: it draws on the same processors, as no remote browser
would.

It takes about six minutes on two cores.
"""

import itertools
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
from measuring import RESULTS, in_turns, medians, options, timed, write
from rotorgram.udp import RemoteEnv, RemoteVectorEnv

PORT = 8181
KINDS = ("none", "window", "page", "page and browser")
SETTLE = 3.0  # s: until a window is open, until a browser has loaded the page and the model

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
from rotorgram.rendering.web import WebPage
from rotorgram.rendering.window import Window

shown = []

def counted(show):
    def note(*arguments):
        shown.append(time.monotonic())
        show(*arguments)
    return note

for surface in (WebPage, Window):
    surface.show = counted(surface.show)
sys.argv[0] = "rotorgram"
status = main()
print(json.dumps(shown))
sys.exit(status)
"""
"""`rotorgram sim`, which writes when it handed pictures on."""


@contextmanager
def simulator(drones: int, kind: str, address: tuple[str, int]) -> Iterator[list[float]]:
    """A simulator in a process of its own, watched in one way: afterwards when it was drawn."""
    view = {"none": [], "window": ["--view", "window"]}.get(
        kind, ["--view", "web", "--view-port", str(PORT)]
    )
    server = "{}:{}".format(*address)
    words = ["--server", server, "--bind", "127.0.0.1:0", "--num-envs", str(drones), *view]
    command = [sys.executable, "-c", SIM, "sim", *words]
    shown = list[float]()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        yield shown
        told, _ = process.communicate()
        shown += json.loads(told.splitlines()[-1])


@contextmanager
def browser() -> Iterator[None]:
    """A browser that looks at the page, without a screen."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        gl = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        rest = ["--no-sandbox", "--remote-debugging-port=0", f"--user-data-dir={profile}"]
        words = ["chromium", "--headless=new", *gl, *rest, f"http://127.0.0.1:{PORT}/"]
        quiet = subprocess.DEVNULL
        with subprocess.Popen(words, stdout=quiet, stderr=quiet) as process:
            try:
                yield
            finally:
                process.terminate()


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
    env: Any = (
        RemoteEnv(here, connect=False)
        if drones == 1
        else RemoteVectorEnv(here, num_envs=drones, connect=False)
    )
    with simulator(drones, kind, env.address) as shown:
        try:
            env.reset(seed=0)
            with browser() if kind == "page and browser" else nullcontext():
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
    kinds = KINDS if shutil.which("chromium") else KINDS[:-1]
    renderer = subprocess.run(
        [sys.executable, "-c", RENDERER], capture_output=True, text=True, check=True
    ).stdout.strip()
    ways = {(drones, kind): (drones, kind) for drones in (1, 64) for kind in kinds}
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
