"""Two ways to wait for a datagram, beside other processes that want the same cores.

    python studies/waiting.py [--rounds 9] [--out FILE.json]

A lock-step of one drone over UDP, agent and simulator in a process each. `looks` is the wait of
`rotorgram.udp.transport.sockets`; `sleeps` is the same with no time to look. Both pairs stay open
and take turns; medians count. Neighbours are endless loops in Python.

It takes about a minute on two cores.
"""

import itertools
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
from measuring import RESULTS, in_turns, medians, options, timed, write
from rotorgram.udp import RemoteEnv
from rotorgram.udp.transport import sockets

SIMULATOR = """
import sys
from rotorgram.udp import Simulator
from rotorgram.udp.transport import sockets
sockets._LOOK = float(sys.argv[2])
Simulator(server=("127.0.0.1", int(sys.argv[1])), bind=("127.0.0.1", 0)).run()
"""
WAYS = {"looks": sockets._LOOK, "sleeps": 0.0}
NEIGHBOURS = (0, 1, 2, 4)
SECONDS = 0.5


@contextmanager
def pair(look: float) -> Iterator[RemoteEnv]:
    with RemoteEnv(("127.0.0.1", 0), connect=False) as env:
        words = [sys.executable, "-c", SIMULATOR, str(env.address[1]), str(look)]
        with subprocess.Popen(words) as process:
            env.reset(seed=0)
            yield env
            env.close()
            process.wait()


@contextmanager
def busy(count: int) -> Iterator[None]:
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def microseconds(env: RemoteEnv, look: float) -> float:
    """Of a step, the mean over a moment."""
    sockets._LOOK = look
    drawn = np.random.default_rng(0).uniform(-0.1, 0.1, (64, 1)).astype(np.float32)
    actions = itertools.cycle(drawn)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()

    wall, _ = timed(step, SECONDS)
    return round(1e6 * wall, 1)


def main() -> None:
    out = RESULTS / "performance" / "waiting.json"
    args = options(__doc__, rounds=9, out=out).parse_args()
    rows = []
    for neighbours in NEIGHBOURS:
        with ExitStack() as stack:
            stack.enter_context(busy(neighbours))
            envs = {way: (stack.enter_context(pair(look)), look) for way, look in WAYS.items()}
            times = in_turns(envs, args.rounds, lambda one: microseconds(*one))
        middle = medians(times)
        rows.append({"neighbours": neighbours, "medians": middle, "microseconds": times})
        print(f"{neighbours} neighbours:", ", ".join(f"{w} {t:.0f} µs" for w, t in middle.items()))
    write(args.out, {"rows": rows})


if __name__ == "__main__":
    main()
