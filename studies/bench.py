"""Env steps per second on this machine, from raw physics to a simulator over UDP.

    python studies/bench.py [--out FOLDER]

`rigid` counts seconds of the processor, so that threads bring nothing: steps per second of one
core. All layers are open at the same time and take turns to run for a moment; the median over the
turns counts, so that a machine that slows down for a while slows all alike. Prints the medians;
with `--out`, `bench.json` there has all rates. `studies/beside.py` adds other simulators.

It takes about two minutes on two cores.
"""

import logging
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
from measuring import options, table, write
from mujoco.batch import Batch
from numpy.typing import NDArray
from rotorgram.envs.autoreset import AdvancingVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.vector import LocalVectorEnv
from rotorgram.models.fields import Limits, check
from rotorgram.models.vehicle import Vehicle
from rotorgram.udp.spawn import spawn_simulator
from rotorgram.udp.transport.stepped import GymEnv

ENV_ID = "rotorgram/Elevation-v0"
HOVER = "rotorgram/Hover-v0"
_PERIOD = 0.02  # s, of a control step
_STEPS_AT_ONCE = 64  # of one drone between two looks at the clock
DRONES = 1024

Step = Callable[[], int]
"""Flies a step of all drones; the number of env steps that it made."""


class Measured(NamedTuple):
    """What `bench` found."""

    rates: dict[str, list[float]]
    """Env steps per second in each turn, by the name of the layer."""
    policy_seconds: float | None
    """Processor time of a training, s; None where its packages are missing."""

    @property
    def medians(self) -> dict[str, float]:
        """Median rate of each layer."""
        return {name: statistics.median(values) for name, values in self.rates.items()}


class Layer(NamedTuple):
    """What is measured."""

    name: str
    about: str
    drones: int
    start: Callable[[ExitStack], Step]
    """Opens it for as long as the stack is."""
    clock: Callable[[], float] = perf_counter


def bench(layers: Sequence[Layer], rounds: int, seconds: float) -> Measured:
    """Measure every layer in turns of `seconds`, after one round that warms up.

    Raises `InputError`.
    """
    check("rounds", Limits(1, whole=True), rounds)
    check("seconds", Limits(0, 60, "s", above=True), seconds)
    rates: dict[str, list[float]] = {layer.name: [] for layer in layers}
    with ExitStack() as stack:
        steps = {layer.name: layer.start(stack) for layer in layers}
        for number in range(rounds + 1):
            for layer in layers:
                at_once = _STEPS_AT_ONCE if layer.drones == 1 else 1
                rate = rate_of(steps[layer.name], seconds, at_once, layer.clock)
                if number:
                    rates[layer.name].append(round(rate, 1))
    return Measured(rates, policy_seconds() if find_spec("safetensors") else None)


def keep(measured: Measured, rounds: int, seconds: float, folder: Path) -> None:
    """Write `bench.json` into a folder."""
    result = {"rounds": rounds, "seconds": seconds, "rates": measured.rates}
    result |= {"medians": measured.medians, "policy_seconds": measured.policy_seconds}
    write(folder / "bench.json", result)


def policy_seconds() -> float:
    """Processor time of `rotorgram train ppo` on Hover-v0, from its start to its end, s."""
    with TemporaryDirectory() as folder:
        words = ["train", "ppo", "--preset", "tuned", "--env", HOVER]
        command = [sys.executable, "-m", "rotorgram.cli", *words]
        command += ["--out", f"{folder}/policy"]
        before = os.times()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        after = os.times()
    used = after.children_user - before.children_user
    return used + after.children_system - before.children_system


def rate_of(
    step: Step,
    seconds: float,
    at_once: int = _STEPS_AT_ONCE,
    clock: Callable[[], float] = perf_counter,
) -> float:
    """Env steps per second over `seconds`, with `at_once` steps between looks at the clock."""
    start = clock()
    now = start
    steps = 0
    while now < start + seconds:
        for _ in range(at_once):
            steps += step()
        now = clock()
    return steps / (now - start)


# ---- the layers


def _mj_step(_: ExitStack) -> Step:
    vehicle = Vehicle.load()
    model = vehicle.model
    substeps = vehicle.substeps(_PERIOD)
    data = mujoco.MjData(model)
    data.qpos[2] = 5.0
    data.ctrl[:] = vehicle.hover_thrust

    def step() -> int:
        mujoco.mj_step(model, data, substeps)
        return 1

    return step


def _batch_step(_: ExitStack) -> Step:
    vehicle = Vehicle.load()
    batch = Batch(vehicle.model, DRONES)
    substeps = vehicle.substeps(_PERIOD)
    batch.qpos[:, 2] = 5.0
    batch.ctrl[:] = vehicle.hover_thrust

    def step() -> int:
        batch.step(nstep=substeps)
        return DRONES

    return step


def actions(*shape: int) -> Iterator[NDArray[np.float32]]:
    """Random actions near hover, the same ones again and again."""
    return cycle(np.random.default_rng(0).uniform(-0.1, 0.1, shape).astype(np.float32))


def local_env(stack: ExitStack) -> Step:
    """The single env in process."""
    env = stack.enter_context(closing(gym.make(ENV_ID, disable_env_checker=True).unwrapped))
    return single_step(env)


def single_step(env: GymEnv, width: int = 1) -> Step:
    """Steps of a single env with random actions; after an episode it is reset."""
    flown = actions(4096, width)
    env.reset(seed=0)

    def step() -> int:
        _, _, terminated, truncated, _ = env.step(next(flown))
        if terminated or truncated:
            env.reset()
        return 1

    return step


def _vector_step(env: AdvancingVectorEnv) -> Step:
    """Drones whose episode ended are reset by the next step, as in NEXT_STEP."""
    flown = actions(16, env.num_envs, 1)
    env.reset(seed=0)

    def step() -> int:
        resets = env.done
        env.advance(next(flown), resets if resets.any() else None)
        return int((~resets).sum())

    return step


def _remote(stack: ExitStack) -> Step:
    return single_step(stack.enter_context(spawn_simulator(EnvConfig(env_id=ENV_ID))))


def _vector(stack: ExitStack) -> Step:
    return _vector_step(stack.enter_context(closing(LocalVectorEnv(ENV_ID, DRONES))))


def _remote_vector(stack: ExitStack) -> Step:
    opened = spawn_simulator(EnvConfig(env_id=ENV_ID), num_envs=DRONES)
    return _vector_step(stack.enter_context(opened))


# ---- `rigid` on one core


def _rigid_env(stack: ExitStack) -> Step:
    env = gym.make(HOVER, backend="rigid", disable_env_checker=True)
    return single_step(stack.enter_context(closing(env)), 4)


def _rigid(drones: int) -> Callable[[ExitStack], Step]:
    def start(stack: ExitStack) -> Step:
        env = gym.make_vec(HOVER, num_envs=drones, backend="rigid")
        env = stack.enter_context(closing(env))
        flown = actions(16, drones, 4)
        env.reset(seed=0)

        def step() -> int:
            env.step(next(flown))
            return drones

        return step

    return start


LAYERS = (
    Layer("mj_step", "substeps of one control step", 1, _mj_step),
    Layer("env", "the single env's step", 1, local_env),
    Layer("UDP, 1", "RemoteEnv and a simulator", 1, _remote),
    Layer("Batch.step, 1024", "mujoco.batch, the same substeps", DRONES, _batch_step),
    Layer("vector env, 1024", "the vector env", DRONES, _vector),
    Layer("UDP, 1024", "RemoteVectorEnv", DRONES, _remote_vector),
    Layer("rigid, 1", "Hover-v0, two steps of RK4", 1, _rigid_env, process_time),
    Layer("rigid, 64", "the same", 64, _rigid(64), process_time),
    Layer("rigid, 1024", "the same", DRONES, _rigid(DRONES), process_time),
    Layer("rigid, 4096", "the same", 4096, _rigid(4096), process_time),
)


def main() -> None:
    args = options(__doc__, rounds=7, seconds=0.5, out=Path).parse_args()
    logging.getLogger("rotorgram").setLevel(logging.WARNING)  # no counters of every wire
    measured = bench(LAYERS, args.rounds, args.seconds)
    rows = []
    for layer in LAYERS:
        rate = measured.medians[layer.name]
        rows.append([layer.name, layer.about, f"{rate:,.0f}", f"{1e6 / rate:.2f}"])
    print(table(["layer", "what", "env steps/s", "µs per env step"], rows))
    if measured.policy_seconds:
        words = f"rotorgram train ppo --preset tuned --env {HOVER}"
        print(f"{words}: {measured.policy_seconds:.2f} s of one core")
    if args.out:
        keep(measured, args.rounds, args.seconds, args.out)


if __name__ == "__main__":
    main()
