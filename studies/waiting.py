"""Two ways to wait for a datagram, beside other processes that want the same cores.

    python studies/waiting.py

A lock-step of one drone over UDP, agent and simulator in a process each. `looks` is the wait of
`rotorgram.udp.transport.sockets`; `sleeps` is the same with no time to look. Both pairs stay open
and take turns; medians count. Neighbours are endless loops in Python.
"""

import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import numpy as np
from measuring import RESULTS, medians, write
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
ROUNDS = 9
SECONDS = 0.5


@contextmanager
def pair(look):
    with RemoteEnv(("127.0.0.1", 0), connect=False) as env:
        words = [sys.executable, "-c", SIMULATOR, str(env.address[1]), str(look)]
        with subprocess.Popen(words) as process:
            env.reset(seed=0)
            yield env
            env.close()
            process.wait()


@contextmanager
def busy(count):
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def microseconds(env, actions):
    steps = 0
    begin = time.perf_counter()
    while time.perf_counter() < begin + SECONDS:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        steps += len(actions)
    return 1e6 * (time.perf_counter() - begin) / steps


def main():
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (64, 1)).astype(np.float32)
    rows = []
    for neighbours in NEIGHBOURS:
        with ExitStack() as stack:
            stack.enter_context(busy(neighbours))
            envs = {way: stack.enter_context(pair(look)) for way, look in WAYS.items()}
            times = {way: [] for way in WAYS}
            for _ in range(ROUNDS):
                for way, look in WAYS.items():
                    sockets._LOOK = look
                    times[way].append(round(microseconds(envs[way], actions), 1))
        middle = medians(times)
        rows.append({"neighbours": neighbours, "medians": middle, "microseconds": times})
        print(f"{neighbours} neighbours:", ", ".join(f"{w} {t:.0f} µs" for w, t in middle.items()))
    write(RESULTS / "performance" / "waiting.json", {"rows": rows})


if __name__ == "__main__":
    main()
