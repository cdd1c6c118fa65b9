"""What a memory is worth behind racks: PPO on Warehouse-v0 with a GRU and without, over seeds.

    python studies/memory.py [--seeds 3] [--first-seed 7300] [--flights 400] [--jobs 1]
        [--out FILE.json]

Both train as many env steps with the preset of the task; the second has `--set memory=0`. The
clock runs from before the training's process starts to its end. Each policy then flies the same
unseen layouts without exploration. The interval of the difference is a percentile bootstrap, at
95 %, which resamples the seeds of each and the flights of each seed.

With `--jobs 6` it took 15 minutes on two cores that others used too.
"""

import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.agents import load
from rotorgram.agents.policies import Policy
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import fly_episodes

TASK = "rotorgram/Warehouse-v0"
WORDS = ("ppo", "--env", TASK, "--no-udp")
CHANGES: dict[str, tuple[str, ...]] = {"gru": (), "none": ("--set", "memory=0")}
RESAMPLES = 10_000
Row = dict[str, float]


def train(seed: int, folder: Path, *changes: str) -> float:
    """Wall time of a training, s."""
    words = (*WORDS, *changes, "--seed", str(seed), "--out", str(folder))
    began = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "rotorgram.cli", "train", *words],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    return round(time.perf_counter() - began, 1)


def fly(policy: Policy, flights: int, seed: int) -> Row:
    """Of flights in unseen layouts: how many arrive or touch, and the mean time of arrivals, s."""
    config = EnvConfig.from_keywords(TASK, backend="rigid").unseen()
    env = LocalVectorEnv(config, flights, autoreset_mode="Disabled")
    flown = fly_episodes(env, policy, flights, "final", training_seed=seed)
    env.close()
    last = np.array([one.telemetry["metrics"][-1] for one in flown])
    names = [metric.name for metric in env.env_spec.metrics]
    ends = dict(zip(names, last.T, strict=True))
    arrived = ends["success"] > 0.5
    seconds = float(ends["flight_time"][arrived].mean()) if arrived.any() else 0.0
    touched = int((ends["touched"] > 0.5).sum())
    return {"arrived": int(arrived.sum()), "touched": touched, "flight_time": round(seconds, 2)}


def run(seed: int, flights: int, *changes: str) -> Row:
    """A training and its flights."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = train(seed, Path(folder) / "run", *changes)
        kept = load(Path(folder) / "run" / "checkpoint.safetensors")
    row: Row = {"seed": seed, "seconds": seconds, "env_steps": kept.position.env_steps}
    row |= fly(kept.policy(), flights, seed)
    print(*changes, row, flush=True)
    return row


def resampled(rows: list[Row], flights: int, rng: np.random.Generator) -> np.ndarray:
    """Shares of arrivals of resampled seeds and flights, shape (RESAMPLES,)."""
    shares = np.array([row["arrived"] for row in rows]) / flights
    chosen = rng.integers(len(rows), size=(RESAMPLES, len(rows)))
    arrived = rng.binomial(flights, shares[chosen])
    means: np.ndarray = arrived.mean(axis=1) / flights
    return means


def summary(rows: dict[str, list[Row]], flights: int) -> dict[str, float]:
    """Shares of arrivals, their difference, and its interval."""
    rng = np.random.default_rng(0)
    drawn = {name: resampled(own, flights, rng) for name, own in rows.items()}
    low, high = np.quantile(drawn["gru"] - drawn["none"], (0.025, 0.975))
    shares = {
        name: float(np.mean([row["arrived"] for row in own])) / flights
        for name, own in rows.items()
    }
    numbers = {**shares, "difference": shares["gru"] - shares["none"], "low": low, "high": high}
    return {name: round(float(value), 4) for name, value in numbers.items()}


def main() -> None:
    args = options(
        __doc__, seeds=3, first_seed=7300, flights=400, jobs=1, out=RESULTS / "memory.json"
    ).parse_args()
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    with ThreadPoolExecutor(args.jobs) as threads:
        waiting = {
            name: [threads.submit(run, seed, args.flights, *changes) for seed in seeds]
            for name, changes in CHANGES.items()
        }
        rows = {name: [future.result() for future in own] for name, own in waiting.items()}
    content = {"flights": args.flights, **summary(rows, args.flights), "rows": rows}
    write(args.out, {"command": f"rotorgram train {' '.join(WORDS)}", **content})


if __name__ == "__main__":
    main()
