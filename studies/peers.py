"""Env steps per second beside other drone simulators that pip can install, on one machine.

    python3 -m venv /tmp/pyflyt && /tmp/pyflyt/bin/pip install PyFlyt
    python3 -m venv /tmp/crazyflow && /tmp/crazyflow/bin/pip install crazyflow
    python studies/peers.py --pyflyt /tmp/pyflyt/bin/python --crazyflow /tmp/crazyflow/bin/python

Each runs in a Python of its own, for their requirements exclude each other. They take turns;
medians count. Hover tasks, a control step of 0.02 s where it can be chosen, PyFlyt's own otherwise.
They do not compute the same: PyFlyt simulates propellers, motors and a body with contacts in
Bullet, Crazyflow an analytic model of a Crazyflie in JAX, without contacts.

It takes about three minutes on two cores.
"""

import subprocess
import sys
from pathlib import Path

from measuring import RESULTS, in_turns, medians, options, write

ONE = """
import gymnasium, numpy as np
def one(env_id, action):
    env = gymnasium.make(env_id).unwrapped
    env.reset(seed=0)
    def step():
        r = env.step(action)
        if r[2] or r[3]:
            env.reset()
    return step
"""
OURS = """
import rotorgram.envs
def make(n):
    env = gymnasium.make_vec("rotorgram/Hover-v0", num_envs=n, backend="{}")
    env.reset(seed=0)
    action = np.zeros((n, 4), np.float32)
    return lambda: env.step(action)
"""
PYFLYT = """
import PyFlyt.gym_envs
def make(n):
    return one("PyFlyt/QuadX-Hover-v4", np.array([0.0, 0.0, 0.0, 0.3]))
"""
CRAZYFLOW = """
import crazyflow.envs, jax
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
    out = RESULTS / "performance" / "peers.json"
    args = options(
        __doc__, pyflyt=Path, crazyflow=Path, seconds=2.0, rounds=5, out=out
    ).parse_args()
    peers = {
        "rotorgram `mujoco`": (sys.executable, OURS.format("mujoco"), (1, 64, 1024, 4096)),
        "rotorgram `rigid`": (sys.executable, OURS.format("rigid"), (1, 64, 1024, 4096)),
        "PyFlyt QuadX-Hover-v4": (args.pyflyt, PYFLYT, (1,)),
        "Crazyflow DroneReachPos-v0": (args.crazyflow, CRAZYFLOW, (1, 64, 1024, 4096)),
    }
    ways = {
        f"{name}, {n}": [str(python), "-c", ONE + script + CLOCK, str(n), str(args.seconds)]
        for name, (python, script, counts) in peers.items()
        for n in counts
        if python
    }

    def rate(words: list[str]) -> float:
        said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
        return round(float(said.split()[-1]), 1)

    rates = in_turns(ways, args.rounds, rate)
    middle = medians(rates)
    write(args.out, {"env_steps_per_second": middle, "rates": rates, "seconds": args.seconds})
    for name, rate in middle.items():
        print(f"{name:36} {rate:12,.0f} env steps/s")


if __name__ == "__main__":
    main()
