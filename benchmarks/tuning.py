"""What was tried for an algorithm on a task: points, each some changes to one base, on a few seeds.

    OMP_NUM_THREADS=1 python benchmarks/tuning.py Hover-v0 [--points 0 3] [--seeds 0 1]

Training flies in this process on `mujoco`. Each policy then flies 50 episodes, of starts that no
training has seen. The headline metric of an episode is its mean over the last 50 steps, or its last
value where that is what counts, and infinite after a crash. A row a seed is added to
docs/results/tuning/ALGORITHM_TASK.csv, or to `--out`. Seconds are of processor time, for the
machine was busy; early rows have none.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from rotorgram.agents import EpisodeLog, make_agent
from rotorgram.agents.presets import config_type
from rotorgram.envs import LocalVectorEnv
from rotorgram.experiments.trajectories import Trajectory, fly_episodes

EPISODES: Final = 50
PPO: Final[dict[str, Any]] = {
    "action": "rotors", "drones": 64, "env_steps": 250_000, "steps_per_update": 2048,
    "hidden": (64, 64), "activation": "tanh", "learning_rate": 0.003, "anneal": True, "epochs": 4,
    "minibatches": 8, "gamma": 0.98, "gae_lambda": 0.95, "log_std": -1.0,
    "normalize_observations": False,
}  # fmt: skip
_MORE: Final = {"env_steps": 300_000, "steps_per_update": 1024}
_FAST: Final = {**_MORE, "learning_rate": 0.005}
_WIDE: Final = {"drones": 128, "steps_per_update": 4096, "minibatches": 16}
_SHORT: Final = {"env_steps": 300_000}
_LEVELS: Final = [
    {**_SHORT, "action": "rates", "log_std": -2.0},
    {**_SHORT, "action": "attitude"},
    {**_SHORT, "action": "velocity"},
    {**_SHORT, "action": "position"},
]
POINTS: Final[dict[tuple[str, str], list[dict[str, Any]]]] = {
    ("ppo", "Hover-v0"): [
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
        {**_WIDE, "env_steps": 600_000},
        {**_WIDE, "env_steps": 1_000_000},
    ],
    ("ppo", "Waypoints-v0"): [
        _SHORT,
        *_LEVELS,
        {**_SHORT, "gamma": 0.99},
        {**_SHORT, "normalize_observations": True},
    ],
    ("ppo", "Tracking-v0"): [
        _SHORT,
        *_LEVELS,
        {**_SHORT, "gamma": 0.96},
        {**_SHORT, "normalize_observations": True},
    ],
    ("ppo", "Racing-v0"): [
        _SHORT,
        *_LEVELS,
        {**_SHORT, "gamma": 0.99},
        {**_SHORT, "normalize_observations": True},
    ],
}
"""Changes to `PPO`, by algorithm and task."""
WITHIN: Final = {"Hover-v0": 0.05, "Tracking-v0": 0.05}
"""Headline metric below which an episode is good; that of the others is a count, below 0.5."""


def decide(flown: Trajectory) -> float:
    """Headline metric of an episode; infinite after a crash."""
    metric, sizes = flown.spec.headline, np.abs(flown.headline)
    if metric is not None and metric.final:
        last = float(sizes[-1])
        return np.inf if flown.terminated and not last < 0.5 else last
    return np.inf if flown.terminated else float(sizes[-50:].mean())


def measure(algorithm: str, task: str, settings: dict[str, Any], seed: int) -> dict[str, Any]:
    """Train with the settings on a seed; the columns of the result."""
    config = dict(settings)
    drones, env_steps = config.pop("drones"), config.pop("env_steps")
    options = {"action": config.pop("action")}

    def make(count: int) -> Any:
        return LocalVectorEnv(
            f"rotorgram/{task}", count, autoreset_mode="Disabled", num_threads=1, **options
        )

    log = EpisodeLog(make(drones), seed)
    agent = make_agent(algorithm, log, config_type(algorithm)(**config), seed)
    began = time.process_time()
    agent.train(log, env_steps, lambda: True)
    seconds = time.process_time() - began
    flown = fly_episodes(make(EPISODES), agent.policy(), EPISODES, "tuning")
    errors = np.array([decide(one) for one in flown])
    good = errors < WITHIN.get(task, 0.5)
    row: dict[str, Any] = {
        "seed": seed, "median": round(float(np.median(errors)), 4),
        "worst": round(float(errors.max()), 4), "good": int(good.sum()), "episodes": EPISODES,
        "return": round(float(np.mean([one.rewards.sum() for one in flown])), 1),
    }  # fmt: skip
    if flown[0].spec.headline.final:
        times = [one.seconds for one, is_good in zip(flown, good, strict=True) if is_good]
        row["seconds_of_good"] = round(float(np.median(times)), 2) if times else None
    return row | {"processor_seconds": round(seconds, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", choices=sorted({task for _, task in POINTS}))
    parser.add_argument("--algorithm", default="ppo")
    parser.add_argument("--points", type=int, nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    points = POINTS[args.algorithm, args.task]
    name = f"{args.algorithm}_{args.task.split('-')[0].lower()}.csv"
    out = args.out or Path("docs/results/tuning") / name
    for point in range(len(points)) if args.points is None else args.points:
        for seed in args.seeds:
            settings = {**PPO, **points[point]}
            layers = " ".join(map(str, settings["hidden"]))
            result = measure(args.algorithm, args.task, settings, seed)
            row = {"point": point, **settings, "hidden": layers, **result}
            print(row, flush=True)
            fresh = not out.exists()
            with out.open("a", newline="") as file:
                writer = csv.DictWriter(file, row.keys(), lineterminator="\n")
                if fresh:
                    writer.writeheader()
                writer.writerow(row)


if __name__ == "__main__":
    main()
