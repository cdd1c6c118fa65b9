"""What was tried for PPO and APG on Hover-v0: each point, changes to one base, on a few seeds.

    OMP_NUM_THREADS=1 python benchmarks/hover_tuning.py [ppo|apg] [--points 0 3] [--seeds 0 1]

Training flies in this process on `mujoco`, that of APG on `rigid`. Each policy then flies 50
episodes: an error is the mean distance over the last 50 of 250 steps, and infinite if the episode
crashes. A row a seed is added to docs/results/tuning/ALGORITHM_hover.csv, or to `--out`. Seconds
are of processor time, for the machine was busy; early rows have none.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from rotorgram.agents import EpisodeLog, make_agent, preset
from rotorgram.envs import LocalVectorEnv
from rotorgram.experiments.trajectories import fly_episodes

ENV: Final = "rotorgram/Hover-v0"
BASE: Final[dict[str, Any]] = {
    "drones": 64, "env_steps": 250_000, "steps_per_update": 2048, "hidden": (64, 64),
    "activation": "tanh", "learning_rate": 0.003, "epochs": 4, "minibatches": 8, "gamma": 0.98,
    "gae_lambda": 0.95, "log_std": -1.0,
}  # fmt: skip
_MORE: Final = {"env_steps": 300_000, "steps_per_update": 1024}
_FAST: Final = {**_MORE, "learning_rate": 0.005}
POINTS: Final[list[dict[str, Any]]] = [
    {},
    {"learning_rate": 0.005},
    {"epochs": 8},
    {"hidden": (32, 32)},
    {"activation": "relu"},
    {"gae_lambda": 0.9},
    {"steps_per_update": 1024},
    {"log_std": -0.5},
    {"log_std": -1.5},
    {"gamma": 0.97},
    {"hidden": (64,)},
    _FAST,
    _MORE,
    {**_FAST, "epochs": 8},
    {"drones": 128, "env_steps": 600_000, "steps_per_update": 4096, "minibatches": 16},
    {"drones": 128, "env_steps": 1_000_000, "steps_per_update": 4096, "minibatches": 16},
]
APG_BASE: Final[dict[str, Any]] = {
    "drones": 256, "env_steps": 400_000, "hidden": (64, 64), "horizon": 64, "tail": 20,
    "minibatches": 4, "crash_cost": 5.0, "learning_rate": 0.005, "gamma": 0.99,
}  # fmt: skip
APG_POINTS: Final[list[dict[str, Any]]] = [
    {"tail": 0, "crash_cost": 0.0},
    {"crash_cost": 0.0},
    {},
]


def measure(algorithm: str, settings: dict[str, Any], seed: int) -> dict[str, Any]:
    config = dict(settings)
    drones, env_steps = config.pop("drones"), config.pop("env_steps")
    flown_on: Any = {"backend": "rigid"} if algorithm == "apg" else {"num_threads": 1}
    env: Any = LocalVectorEnv(ENV, drones, autoreset_mode="Disabled", **flown_on)
    log = EpisodeLog(env, seed)
    agent = make_agent(algorithm, log, preset(algorithm, "tuned", ENV, **config), seed)
    began = time.process_time()
    agent.train(log, env_steps, lambda: True)
    seconds = time.process_time() - began
    other: Any = LocalVectorEnv(ENV, 50, autoreset_mode="Disabled", num_threads=1)
    flown = fly_episodes(other, agent.policy(), 50, "tuning")
    errors = np.array([np.inf if f.terminated else f.headline[-50:].mean() for f in flown])
    return {
        "seed": seed, "median_m": round(float(np.median(errors)), 4),
        "worst_m": round(float(errors.max()), 4), "below_5_cm": int((errors < 0.05).sum()),
        "episodes": 50, "return": round(float(np.mean([f.rewards.sum() for f in flown])), 1),
        "processor_seconds": round(seconds, 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("algorithm", nargs="?", choices=("ppo", "apg"), default="ppo")
    parser.add_argument("--points", type=int, nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    base, points = (BASE, POINTS) if args.algorithm == "ppo" else (APG_BASE, APG_POINTS)
    out = args.out or Path(f"docs/results/tuning/{args.algorithm}_hover.csv")
    for seed in args.seeds:
        for point in args.points or range(len(points)):
            settings = {**base, **points[point]}
            layers = " ".join(map(str, settings["hidden"]))
            found = measure(args.algorithm, settings, seed)
            row = {"point": point, **settings, "hidden": layers, **found}
            print(row, flush=True)
            fresh = not out.exists()
            with out.open("a", newline="") as file:
                writer = csv.DictWriter(file, row.keys(), lineterminator="\n")
                if fresh:
                    writer.writeheader()
                writer.writerow(row)


if __name__ == "__main__":
    main()
