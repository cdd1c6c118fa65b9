"""Env steps per second beside other drone simulators that pip can install, on one machine.

    python3 -m venv /tmp/pyflyt && /tmp/pyflyt/bin/pip install PyFlyt
    python3 -m venv /tmp/crazyflow && /tmp/crazyflow/bin/pip install crazyflow
    python benchmarks/peers.py --pyflyt /tmp/pyflyt/bin/python --crazyflow /tmp/crazyflow/bin/python

Each runs in a Python of its own, for their requirements exclude each other. They take turns;
medians count. Hover tasks, a control step of 0.02 s where it can be chosen, PyFlyt's own otherwise.
They do not compute the same: PyFlyt simulates propellers, motors and a body with contacts in
Bullet, Crazyflow an analytic model of a Crazyflie in JAX, without contacts.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

OURS = """
import gymnasium, numpy as np, rotorgram.envs
def make(n):
    if n == 1:
        env = gymnasium.make("rotorgram/Elevation-v0").unwrapped
        env.reset(seed=0)
        action = np.zeros(1, np.float32)
        def step():
            r = env.step(action)
            if r[2] or r[3]:
                env.reset()
    else:
        env = gymnasium.make_vec("rotorgram/Elevation-v0", num_envs=n)
        env.reset(seed=0)
        action = np.zeros((n, 1), np.float32)
        def step():
            env.step(action)
    return step
"""
PYFLYT = """
import gymnasium, numpy as np, PyFlyt.gym_envs
def make(n):
    env = gymnasium.make("PyFlyt/QuadX-Hover-v4").unwrapped
    env.reset(seed=0)
    action = np.array([0.0, 0.0, 0.0, 0.3])
    def step():
        r = env.step(action)
        if r[2] or r[3]:
            env.reset()
    return step
"""
CRAZYFLOW = """
import gymnasium, numpy as np, crazyflow.envs, jax
def make(n):
    env = gymnasium.make_vec("DroneReachPos-v0", num_envs=n, device="cpu", freq=50)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    action[:, -1] = 0.3
    def step():
        jax.block_until_ready(env.step(action)[0])
    return step
"""
CLOCK = """
import sys, time
step, count, n = make(int(sys.argv[1])), 0, int(sys.argv[1])
for _ in range(5):
    step()
start = time.perf_counter()
while time.perf_counter() - start < float(sys.argv[2]):
    step()
    count += n
print(count / (time.perf_counter() - start))
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pyflyt", type=Path, help="a Python that has PyFlyt")
    parser.add_argument("--crazyflow", type=Path, help="a Python that has crazyflow")
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--rounds", type=int, default=5)
    default = Path("docs/results/performance/peers.json")
    parser.add_argument("--out", type=Path, default=default)
    args = parser.parse_args()
    peers = {
        "rotorgram": (sys.executable, OURS, (1, 64, 1024, 4096)),
        "PyFlyt QuadX-Hover-v4": (args.pyflyt, PYFLYT, (1,)),
        "Crazyflow DroneReachPos-v0": (args.crazyflow, CRAZYFLOW, (1, 64, 1024, 4096)),
    }
    rates: dict[str, list[float]] = {}
    for _ in range(args.rounds):
        for name, (python, script, counts) in peers.items():
            for n in counts if python else ():
                words = [str(python), "-c", script + CLOCK, str(n), str(args.seconds)]
                said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
                rates.setdefault(f"{name}, {n}", []).append(round(float(said.split()[-1]), 1))
    medians = {name: statistics.median(values) for name, values in rates.items()}
    content = {"env_steps_per_second": medians, "rates": rates, "seconds": args.seconds,
               "machine": {"cores": os.cpu_count()}}  # fmt: skip
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(content, indent=2) + "\n")
    for name, rate in medians.items():
        print(f"{name:36} {rate:12,.0f} env steps/s")


if __name__ == "__main__":
    main()
