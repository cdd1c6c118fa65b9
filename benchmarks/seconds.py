"""Wall time from process start to a policy that holds, by `rotorgram train`, over many seeds.

    python benchmarks/seconds.py [--seeds 20] [--first-seed 100] [--out FILE.json]
        [-- ppo --env rotorgram/Hover-v0 …]

After `--` are the words of `rotorgram train`; without any, PPO on the paper's task, with its tuned
preset. The clock runs from before the process starts to after it has ended, with its checkpoint
written; `processor` are the seconds of all its processes, which a busy machine disturbs less. Each
policy then flies 20 episodes on `mujoco`, of starts that no training has seen. A seed holds if the
mean of the steady headline metric over the episodes is below `--within`, and none of them crashes.
"""

import argparse
import json
import os
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

EPISODES = 20


def train(words: list[str], seed: int, folder: Path) -> dict[str, float]:
    """Seconds of a training: of a clock, and of processors."""
    command = [sys.executable, "-m", "rotorgram.cli", "train", *words]
    began, before = time.perf_counter(), os.times()
    subprocess.run([*command, "--seed", str(seed), "--out", str(folder)],
                   check=True, stdout=subprocess.DEVNULL)  # fmt: skip
    seconds, after = time.perf_counter() - began, os.times()
    used = after.children_user + after.children_system
    used -= before.children_user + before.children_system
    return {"seconds": round(seconds, 2), "processor": round(used, 2)}


def evaluate(folder: Path, vehicle: str | None) -> dict[str, Any]:
    """Steady size of the headline metric and return, means over episodes; crashes."""
    kept = load(folder / "checkpoint.safetensors")
    env: Any = LocalVectorEnv(kept.env_id, EPISODES, autoreset_mode="Disabled", vehicle=vehicle,
                              **kept.options)  # fmt: skip
    flown = fly_episodes(env, kept.policy(env.env_spec), EPISODES, "final")
    env.close()
    sizes = [steady_state(np.abs(one.headline[1:])) for one in flown]
    return {
        "env_steps": kept.position.env_steps,
        "error": round(float(np.mean(sizes)), 5),
        "worst": round(float(np.max(sizes)), 5),
        "return": round(float(np.mean([one.rewards.sum() for one in flown])), 2),
        "crashes": sum(bool(one.terminated) for one in flown),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--within", type=float, default=0.05)
    parser.add_argument("--vehicle")
    parser.add_argument("--out", type=Path, default=Path("docs/results/seconds.json"))
    parser.add_argument("words", nargs="*", default=["ppo"])
    args = parser.parse_args()
    words = args.words + (["--vehicle", args.vehicle] if args.vehicle else [])
    rows = []
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        with tempfile.TemporaryDirectory() as folder:
            row: dict[str, Any] = {"seed": seed, **train(words, seed, Path(folder) / "run")}
            row |= evaluate(Path(folder) / "run", args.vehicle)
        row["holds"] = row["error"] < args.within and not row["crashes"]
        row["load_average"] = round(os.getloadavg()[0], 1)
        rows.append(row)
        print(row, flush=True)
    result = {
        "command": f"rotorgram train {' '.join(words)}",
        "within": args.within,
        "hold": sum(row["holds"] for row in rows),
        "of": len(rows),
        "seconds": {"median": statistics.median(row["seconds"] for row in rows),
                    "most": max(row["seconds"] for row in rows)},
        "processor": {"median": statistics.median(row["processor"] for row in rows)},
        "seeds": rows,
        "versions": software_versions(),
        "machine": {"cores": os.cpu_count()},
    }  # fmt: skip
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=2) + "\n")
    print(f"{result['hold']} of {result['of']} hold {args.within}; seconds {result['seconds']}")


if __name__ == "__main__":
    main()
