"""Wall time from process start to a policy that holds, by `rotorgram train`, over many seeds.

    python benchmarks/seconds.py [--seeds 20] [--first-seed 100] [--episodes 20]
        [--out FILE.json] [-- ppo --env rotorgram/Hover-v0 …]

After `--` are the words of `rotorgram train`; without any, PPO on the paper's task, with its tuned
preset. The clock runs from before the process starts to after it has ended, with its checkpoint
written; processor seconds are those of all its processes, which count where others use the cores.
Each policy then flies 20 `--episodes` on `mujoco`, of starts that no training has seen. A seed
holds if the mean of the steady headline metric over the episodes is below `--within`, and none of
them crashes.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rotorgram.agents import load
from rotorgram.agents.checkpoints import software_versions
from rotorgram.envs import LocalVectorEnv
from rotorgram.experiments.metrics import steady_state
from rotorgram.experiments.trajectories import fly_episodes


def train(words: list[str], seed: int, folder: Path) -> tuple[float, float]:
    """Seconds of a training: of wall time, and of processors."""
    command = [sys.executable, "-m", "rotorgram.cli", "train", *words]
    began, used = time.perf_counter(), processor_seconds()
    subprocess.run([*command, "--seed", str(seed), "--out", str(folder)],
                   check=True, stdout=subprocess.DEVNULL)  # fmt: skip
    return time.perf_counter() - began, processor_seconds() - used


def processor_seconds() -> float:
    """Of all processes that this one started and that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def evaluate(folder: Path, vehicle: str | None, episodes: int) -> dict[str, Any]:
    """Steady size of the headline metric and return, means over episodes; crashes.

    `worst` is of the episodes without a crash.
    """
    kept = load(folder / "checkpoint.safetensors")
    env: Any = LocalVectorEnv(kept.env_id, episodes, autoreset_mode="Disabled", vehicle=vehicle,
                              **kept.options)  # fmt: skip
    flown = fly_episodes(env, kept.policy(env.env_spec), episodes, "final")
    env.close()
    sizes = [steady_state(np.abs(one.headline[1:])) for one in flown]
    whole = [size for size, one in zip(sizes, flown, strict=True) if not one.terminated]
    return {
        "env_steps": kept.position.env_steps,
        "error": round(float(np.mean(sizes)), 5),
        "median": round(float(np.median(sizes)), 5),
        "worst": round(float(np.max(whole, initial=0.0)), 5),
        "return": round(float(np.mean([one.rewards.sum() for one in flown])), 2),
        "crashes": sum(bool(one.terminated) for one in flown),
    }


def write(
    path: Path, words: list[str], within: float, episodes: int, rows: list[dict[str, Any]]
) -> None:
    """The file of the seeds until now: a run that is stopped keeps them."""
    result = {
        "command": f"rotorgram train {' '.join(words)}",
        "within": within,
        "hold": sum(row["holds"] for row in rows),
        "of": len(rows),
        "episodes": episodes,
        "seconds": {"median": statistics.median(row["seconds"] for row in rows),
                    "most": max(row["seconds"] for row in rows),
                    "processor": statistics.median(row["processor"] for row in rows)},
        "seeds": rows,
        "versions": software_versions(),
        "machine": {"cores": os.cpu_count()},
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n")
    print(f"{result['hold']} of {result['of']} hold {within}; seconds {result['seconds']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--within", type=float, default=0.05)
    parser.add_argument("--vehicle")
    parser.add_argument("--out", type=Path, default=Path("docs/results/seconds.json"))
    parser.add_argument("words", nargs="*", default=["ppo"])
    args = parser.parse_args()
    words = args.words + (["--vehicle", args.vehicle] if args.vehicle else [])
    rows = []
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        with tempfile.TemporaryDirectory() as folder:
            seconds, used = train(words, seed, Path(folder) / "run")
            row = {"seed": seed, "seconds": round(seconds, 2), "processor": round(used, 2)}
            row |= evaluate(Path(folder) / "run", args.vehicle, args.episodes)
        row["holds"] = row["error"] < args.within and not row["crashes"]
        row["load_average"] = round(os.getloadavg()[0], 1)
        rows.append(row)
        print(row, flush=True)
        write(args.out, words, args.within, args.episodes, rows)


if __name__ == "__main__":
    main()
