"""Env steps per second on a GPU (MuJoCo Warp), beside mujoco.batch on the CPU of the same machine.

    python benchmarks/gpu.py [--worlds 1024 4096 16384 65536] [--repeats 5] [--out FILE.json]

Both fly the default task with random actions, each made where it is used: on the GPU, or by NumPy.
They take turns, and medians are compared. Making an env, Warp's compilation among it, is not
counted; nor is a first, short flight. Without a CUDA device it says so and
exits with status 2. `--device cpu` tries the script on Warp's CPU device, and writes nothing
unless told where.
"""

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rotorgram.agents.checkpoints import software_versions
from rotorgram.envs import LocalVectorEnv

OUT = Path("docs/results/performance/gpu.json")
TASK = "rotorgram/Elevation-v0"
BACKENDS = ("warp", "mujoco")


def on_device(worlds: int, device: str) -> Callable[[], None]:
    env = LocalVectorEnv(TASK, worlds, backend="warp", device=device, tensors=True)
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
            env.step(2.0 * dice.random((worlds, 1), np.float32) - 1.0)

    return fly


def rate(fly: Callable[[], None], worlds: int, seconds: float) -> float:
    """Env steps per second, of all worlds together; `fly` is ten steps of each."""
    times, start = 0, time.perf_counter()
    while times == 0 or time.perf_counter() - start < seconds:
        fly()
        times += 1
    return 10 * times * worlds / (time.perf_counter() - start)


def measure(worlds: int, args: argparse.Namespace) -> dict[str, Any]:
    flown = {"warp": on_device(worlds, args.device), "mujoco": on_cpu(worlds)}
    for fly in flown.values():
        rate(fly, worlds, args.seconds / 10)
    rates: dict[str, list[float]] = {backend: [] for backend in BACKENDS}
    for _ in range(args.repeats):
        for backend in BACKENDS:
            rates[backend].append(round(rate(flown[backend], worlds, args.seconds)))
    medians = {backend: statistics.median(values) for backend, values in rates.items()}
    for backend, median in medians.items():
        print(f"{worlds:7,} worlds  {backend:8} {median:14,.0f} env steps/s", flush=True)
    return {"worlds": worlds, "rates": rates, "medians": medians}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 4096, 16384, 65536])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each repeat")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    cuda = args.device.startswith("cuda")
    if cuda and not torch.cuda.is_available():
        print("no CUDA device here", file=sys.stderr)
        sys.exit(2)
    rows = [measure(worlds, args) for worlds in args.worlds]
    packages = ("mujoco-warp", "warp-lang")
    result = {
        "device": torch.cuda.get_device_name(args.device) if cuda else args.device,
        "rows": rows,
        "versions": software_versions() | {name: version(name) for name in packages},
        "machine": {"processor": platform.machine(), "cores": os.cpu_count()},
    }
    out = args.out or (OUT if cuda else None)
    if out:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
