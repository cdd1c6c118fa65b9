"""Curricula against training from scratch, at equally many env steps.

    OMP_NUM_THREADS=1 python benchmarks/curriculum.py [--seeds 100 101 102 103 104]
        [--rows "hard hover" "hover, hard hover" …] [--out docs/results/transfer/curriculum.csv]

A row is a chain of stages. Its last policy flies 50 episodes of the last stage's task, of starts
that no training has seen; those of seeds below 100, which choose settings, are others than those of
the rest. PPO flies on `mujoco` in this process, in all stages with the preset `tuned` of Hover-v0
but for gamma. A line for each row and seed is added: share of crashes, mean return, and seconds of
processor time.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
from rotorgram.agents import preset
from rotorgram.envs import LocalVectorEnv
from rotorgram.experiments.settings import Run
from rotorgram.experiments.training import Training
from rotorgram.experiments.trajectories import fly_episodes

HOVER: Final = "rotorgram/Hover-v0"
RECOVERY: Final = "rotorgram/Recovery-v0"
TILTED: Final = {"start_tilt": 80.0, "start_heading": 180.0, "flight_band": 10.0}
HARD: Final = {"start_tilt": 80.0, "start_heading": 180.0, "start_band": 1.5}
Stages = list[tuple[str, dict[str, float], int]]
ROWS: Final[dict[str, tuple[float, Stages]]] = {
    "recovery": (0.98, [(RECOVERY, {}, 1_000_000)]),
    "hover, recovery": (0.98, [(HOVER, {}, 300_000), (RECOVERY, {}, 700_000)]),
    "tilted hover, recovery": (0.98, [(HOVER, TILTED, 400_000), (RECOVERY, {}, 600_000)]),
    "recovery, gamma 0.99": (0.99, [(RECOVERY, {}, 1_000_000)]),
    "hover, recovery, gamma 0.99": (0.99, [(HOVER, {}, 300_000), (RECOVERY, {}, 700_000)]),
    "hard hover": (0.98, [(HOVER, HARD, 300_000)]),
    "hover, hard hover": (0.98, [(HOVER, {}, 100_000), (HOVER, HARD, 200_000)]),
}
"""Gamma and stages: task, options, env steps."""
DRONES: Final = 128
EPISODES: Final = 50


def made(count: int, env_id: str, options: dict[str, float]) -> Any:
    """So many drones in this process."""
    return LocalVectorEnv(env_id, count, autoreset_mode="Disabled", num_threads=1, **options)


def measure(row: str, seed: int) -> dict[str, Any]:
    """Train through the stages of a row, and fly the task of the last one."""
    (gamma, stages), began, kept = ROWS[row], time.process_time(), None
    for env_id, options, env_steps in stages:
        run = Run(
            algorithm="ppo", config=preset("ppo", "tuned", HOVER, gamma=gamma), seed=seed,
            env_steps=env_steps, num_envs=DRONES, env_id=env_id, options=options,
        )  # fmt: skip
        env = made(DRONES, env_id, options)
        training = Training(run, env, start=kept)
        training.train()
        kept = training.checkpoint()
        env.close()
    seconds = time.process_time() - began
    env = made(EPISODES, *stages[-1][:2])
    policy = training.agent.policy()
    flown = fly_episodes(env, policy, EPISODES, "tuning" if seed < 100 else "final")
    env.close()
    return {
        "row": row, "seed": seed, "crashes": sum(one.terminated for one in flown) / EPISODES,
        "return": round(float(np.mean([one.rewards.sum() for one in flown])), 1),
        "processor_seconds": round(seconds, 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=range(100, 105))
    parser.add_argument("--rows", nargs="+", default=["hard hover", "hover, hard hover"])
    parser.add_argument("--out", type=Path, default=Path("docs/results/transfer/curriculum.csv"))
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    for seed in args.seeds:
        for row in args.rows:
            line = measure(row, seed)
            print(line, flush=True)
            fresh = not args.out.exists()
            with args.out.open("a", newline="") as file:
                writer = csv.DictWriter(file, line.keys(), lineterminator="\n")
                if fresh:
                    writer.writeheader()
                writer.writerow(line)


if __name__ == "__main__":
    main()
