"""The layers of `studies/bench.py`, beside other simulators of drones that are installed here.

    pip install l2f hyperdrone crazyflow
    python studies/beside.py

As `rigid`, they count seconds of the processor: steps per second of one core. Writes
`docs/results/performance/bench.json` and prints the medians.

It takes about two minutes on two cores.
"""

import os
from contextlib import ExitStack, closing
from importlib.util import find_spec
from time import process_time

import gymnasium as gym
import numpy as np
from bench import DRONES, LAYERS, Layer, Step, actions, bench, keep
from measuring import RESULTS, options


def l2f(_: ExitStack) -> Step:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # it counts seconds of all threads
    import l2f

    vector = l2f.vector_selector[DRONES]
    device = l2f.Device()
    env = vector.VectorEnvironment()
    rng = vector.VectorRng()
    parameters = vector.VectorParameters()
    state, later = vector.VectorState(), vector.VectorState()
    vector.initialize_rng(device, rng, 0)
    vector.initialize_environment(device, env)
    vector.initial_parameters(device, env, parameters)
    vector.sample_initial_state(device, env, parameters, state, rng)
    seen = np.zeros((DRONES, env.OBSERVATION_DIM), np.float32)
    flown = actions(16, DRONES, env.ACTION_DIM)

    def step() -> int:
        vector.step(device, env, parameters, state, next(flown), later, rng)
        state.assign(later)
        vector.observe(device, env, parameters, state, seen, rng)
        return DRONES

    return step


def hyperdrone(_: ExitStack) -> Step:
    from hyperdrone.dynamics import Sim

    sim = Sim(DRONES)
    sim.reset(sample_states=True)
    flown = actions(16, DRONES, sim.action_dim)

    def step() -> int:
        sim.step(next(flown))
        sim.observe()
        return DRONES

    return step


def crazyflow(stack: ExitStack) -> Step:
    import crazyflow.envs  # noqa: F401  # it registers them
    import jax

    made = gym.make_vec("DroneReachPos-v0", num_envs=DRONES, device="cpu", freq=50)
    env = stack.enter_context(closing(made))
    env.reset(seed=0)
    flown = actions(16, *(env.action_space.shape or ()))

    def step() -> int:
        jax.block_until_ready(env.step(next(flown))[0])
        return DRONES

    return step


OTHERS = {
    "l2f": Layer("L2F, 1024", "one step of RK4", DRONES, l2f, process_time),
    "hyperdrone": Layer("HyperDrone, 1024", "the same", DRONES, hyperdrone, process_time),
    "crazyflow": Layer("Crazyflow, 1024", "ten steps", DRONES, crazyflow, process_time),
}
"""By the package that must be installed."""


def main() -> None:
    args = options(__doc__, rounds=7, seconds=0.5, out=RESULTS / "performance").parse_args()
    found = [layer for package, layer in OTHERS.items() if find_spec(package)]
    measured = bench([*LAYERS, *found], args.rounds, args.seconds)
    keep(measured, args.rounds, args.seconds, args.out)
    for name, rate in measured.medians.items():
        print(f"{name:20} {rate:14,.0f}")


if __name__ == "__main__":
    main()
