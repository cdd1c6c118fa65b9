"""Env steps per second on a GPU (rigid, MuJoCo Warp), beside mujoco.batch on the CPU beside it.

    python studies/gpu.py [--worlds 1024 4096 16384 65536] [--repeats 5] [--out FILE.json]

All fly Hover with random actions, each made where it is used: on the GPU, or by NumPy. `rigid` is
compiled; `rigid world` is its world alone: no controller, observation, reward or reset. They take
turns, and medians are compared. Making an env and compilation are not counted; nor is a first,
short flight. Without a CUDA device it says so and
exits with status 2. `--device cpu` tries the script on Warp's CPU device, and writes nothing
unless told where.
"""

import sys
import time
from argparse import Namespace
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from measuring import RESULTS, in_turns, medians, options, write
from rotorgram.envs import LocalVectorEnv
from rotorgram.models import Vehicle
from rotorgram.sim import InitialState, make_world

OUT = RESULTS / "performance" / "gpu.json"
TASK = "rotorgram/Hover-v0"


def of_rigid_world(worlds: int, device: str) -> Callable[[], None]:
    vehicle = Vehicle.load()
    world = make_world(vehicle, worlds, "rigid", device=device, compiled=True)
    place = torch.zeros((worlds, 1, 3), device=device) + 5.0
    world.reset(
        torch.ones((worlds, 1), dtype=torch.bool, device=device), InitialState(position=place)
    )
    thrust = torch.full((worlds, 1, vehicle.num_rotors), 49.0, device=device)

    def fly() -> None:
        for _ in range(10):
            world.step(thrust, vehicle.substeps(0.02))
        if thrust.is_cuda:
            torch.cuda.synchronize(thrust.device)

    return fly


def on_device(backend: Any, worlds: int, device: str) -> Callable[[], None]:
    given = {"compiled": True} if backend == "rigid" else {}
    env = LocalVectorEnv(TASK, worlds, backend=backend, device=device, tensors=True, **given)
    env.reset(seed=0)
    actions = torch.empty(env.action_space.shape, device=device)

    def fly() -> None:
        for _ in range(10):
            env.step(actions.uniform_(-1.0, 1.0))
        if actions.is_cuda:
            torch.cuda.synchronize(actions.device)

    return fly


def on_cpu(worlds: int) -> Callable[[], None]:
    env = LocalVectorEnv(TASK, worlds)
    env.reset(seed=0)
    dice = np.random.default_rng(0)

    def fly() -> None:
        for _ in range(10):
            env.step(2.0 * dice.random((worlds, 4), np.float32) - 1.0)

    return fly


def rate(fly: Callable[[], None], worlds: int, seconds: float) -> float:
    """Env steps per second, of all worlds together; `fly` is ten steps of each."""
    times, start = 0, time.perf_counter()
    while times == 0 or time.perf_counter() - start < seconds:
        fly()
        times += 1
    return 10 * times * worlds / (time.perf_counter() - start)


def measure(worlds: int, args: Namespace) -> dict[str, Any]:
    flown = {
        "rigid world": of_rigid_world(worlds, args.device),
        "rigid": on_device("rigid", worlds, args.device),
        "warp": on_device("warp", worlds, args.device),
        "mujoco": on_cpu(worlds),
    }
    for fly in flown.values():
        rate(fly, worlds, args.seconds / 10)
    rates = in_turns(flown, args.repeats, lambda fly: round(rate(fly, worlds, args.seconds)))
    middle = medians(rates)
    for backend, median in middle.items():
        print(f"{worlds:7,} worlds  {backend:12} {median:14,.0f} env steps/s", flush=True)
    return {"worlds": worlds, "rates": rates, "medians": middle}


def main() -> None:
    worlds = (1024, 4096, 16384, 65536)
    args = options(
        __doc__, worlds=worlds, repeats=5, seconds=2.0, device="cuda", out=Path
    ).parse_args()
    cuda = args.device.startswith("cuda")
    if cuda and not torch.cuda.is_available():
        print("no CUDA device here", file=sys.stderr)
        sys.exit(2)
    rows = [measure(worlds, args) for worlds in args.worlds]
    result = {
        "device": torch.cuda.get_device_name(args.device) if cuda else args.device,
        "rows": rows,
        "warp": {name: version(name) for name in ("mujoco-warp", "warp-lang")},
    }
    out = args.out or (OUT if cuda else None)
    if out:
        write(out, result)


if __name__ == "__main__":
    main()
