"""A curriculum against training from scratch, at equally many env steps.

    OMP_NUM_THREADS=1 python benchmarks/curriculum.py [--seeds 100 101 102 103 104]
        [--out docs/results/transfer/curriculum.csv]

Both rows end with Hover-v0 from hard starts, and then fly 50 episodes of it, of starts that no
training has seen. PPO flies on `mujoco` in this process, with the preset `tuned` in all stages. A
line a seed: share of crashes, mean return, and mean position error over the last quarter of the
episodes that did not crash.
"""

import argparse
import math
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from rotorgram.agents import preset
from rotorgram.envs import LocalVectorEnv
from rotorgram.experiments.metrics import steady_state
from rotorgram.experiments.settings import Run
from rotorgram.experiments.statistics import bootstrap_interval, iqm
from rotorgram.experiments.training import Training
from rotorgram.experiments.trajectories import fly_episodes

ENV: Final = "rotorgram/Hover-v0"
HARD: Final = {"start_tilt": 80.0, "start_heading": 180.0, "start_band": 1.5}
ROWS: Final[dict[str, list[tuple[dict[str, float], int]]]] = {
    "from scratch": [(HARD, 300_000)],
    "curriculum": [({}, 100_000), (HARD, 200_000)],
}
"""Stages: options of the task, env steps."""
DRONES: Final = 128
EPISODES: Final = 50


def made(count: int, options: dict[str, float]) -> Any:
    """So many drones in this process."""
    return LocalVectorEnv(ENV, count, autoreset_mode="Disabled", num_threads=1, **options)


def trained(stages: list[tuple[dict[str, float], int]], seed: int) -> Any:
    """The checkpoint after the stages."""
    kept = None
    for options, env_steps in stages:
        run = Run(
            algorithm="ppo", config=preset("ppo", "tuned", ENV), seed=seed, env_steps=env_steps,
            num_envs=DRONES, env_id=ENV, options=options,
        )  # fmt: skip
        env = made(DRONES, options)
        training = Training(run, env, start=kept)
        training.train()
        kept = training.checkpoint()
        env.close()
    return kept


def measure(row: str, seed: int) -> dict[str, Any]:
    """Train through the stages of a row, and fly the last one's task."""
    began = time.process_time()
    kept = trained(ROWS[row], seed)
    seconds = time.process_time() - began
    env = made(EPISODES, HARD)
    flown = fly_episodes(env, kept.policy(env.env_spec), EPISODES, "final")
    env.close()
    errors = [steady_state(one.headline[1:]) for one in flown if not one.terminated]
    return {
        "row": row, "seed": seed, "crashes": 1 - len(errors) / EPISODES,
        "return": round(float(np.mean([one.rewards.sum() for one in flown])), 1),
        "error_m": round(float(np.mean(errors)) if errors else math.nan, 4),
        "processor_seconds": round(seconds, 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=range(100, 105))
    parser.add_argument("--out", type=Path, default=Path("docs/results/transfer/curriculum.csv"))
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    lines = []
    for seed in args.seeds:
        for row in ROWS:
            lines.append(measure(row, seed))
            print(lines[-1], flush=True)
            pd.DataFrame(lines).to_csv(args.out, index=False, lineterminator="\n")
    for row, seeds in pd.DataFrame(lines).groupby("row", sort=False):
        for name in ("crashes", "return", "error_m"):
            low, high = bootstrap_interval(seeds[name])
            print(f"{row}: {name} {iqm(seeds[name]):.3f} ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
