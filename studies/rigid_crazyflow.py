"""Crazyflow's step benchmark on the CPU, for `studies/rigid.py`: JSON on standard output.

    python studies/rigid_crazyflow.py DRONES SECONDS

The task of its `benchmark/main.py`: attitude commands, dynamics from first principles, wait for the
state. `rate`: at 50 Hz with two physics steps, as ours; `own_rate`: one physics step of 500 Hz, its
default. Control steps of all drones, per second and per second of a processor. Runs in an
environment with crazyflow.
"""

import json
import sys
import time
from importlib.metadata import version

import jax
import jax.numpy as jnp
from crazyflow.control import Control
from crazyflow.dynamics import Dynamics
from crazyflow.sim import Sim

DRONES = int(sys.argv[1])
SECONDS = float(sys.argv[2])


def measured(freq: int, steps: int) -> tuple[float, float]:
    sim = Sim(n_worlds=DRONES, n_drones=1, dynamics=Dynamics.first_principles,
              control=Control.attitude, freq=freq, attitude_freq=freq, state_freq=freq,
              body_rate_freq=freq, force_torque_freq=freq, device="cpu")  # fmt: skip
    command = jnp.zeros((DRONES, 1, 4)).at[..., 3].set(0.3)
    sim.reset()

    def fly() -> None:
        sim.attitude_control(command)
        sim.step(steps)
        jax.block_until_ready(sim.data)

    for _ in range(5):  # compiles
        fly()
    times = 0
    start = time.perf_counter()
    used = time.process_time()
    while time.perf_counter() - start < SECONDS:
        fly()
        times += 1
    flown = times * DRONES
    return flown / (time.perf_counter() - start), flown / (time.process_time() - used)


told = {"rate": measured(100, 2), "own_rate": measured(500, 1)}
told["versions"] = {name: version(name) for name in ("crazyflow", "jax")}
print(json.dumps(told))
