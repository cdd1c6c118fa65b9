"""Wall time from process start to a policy that holds, by `rotorgram train`, over many seeds.

    python studies/seconds.py [--seeds 20] [--first-seed 100] [--episodes 20]
        [--backend mujoco] [--scene gates:unseen] [--out FILE.json] [--beside geometric]
        [-- ppo --env rotorgram/Hover-v0 …]

After `--` are the words of `rotorgram train`; without any, PPO on the paper's task, with its tuned
preset. The clock runs from before the process starts to after it has ended, with its checkpoint
written. Processor seconds are of all its processes: on a busy machine compare these. Each policy
then flies 20 `--episodes` on `--backend`, from starts of its own that no training has seen, and in
unseen layouts or those of `--scene`. A seed holds if the mean of the steady headline metric over
the episodes is on the good side of `--within`, and at most 0.5 % of them crash; for a metric whose
last value counts, as `landed`, the mean alone decides. Such a task has also `good`, the flights
whose last value is on the good side; their mean `speed`, m/s; and the `means` of all metrics at the
ends of flights.

It takes about two minutes on two cores.
"""

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.agents import find_controller, load
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.training.metrics import Headline, steady_state
from rotorgram.training.statistics import share_interval


def train(words: list[str], seed: int, folder: Path) -> dict[str, float]:
    """Wall time and processor time of a training, s."""
    command = [sys.executable, "-m", "rotorgram.cli", "train", *words]
    began = time.perf_counter()
    used = processor_seconds()
    subprocess.run([*command, "--seed", str(seed), "--out", str(folder)],
                   check=True, stdout=subprocess.DEVNULL)  # fmt: skip
    return {"seconds": round(time.perf_counter() - began, 2),
            "processor_seconds": round(processor_seconds() - used, 2)}  # fmt: skip


def processor_seconds() -> float:
    """Of all processes that this one started and that have ended, and of theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def evaluate(agent: Any, env_id: str, args: Any, seed: int) -> dict[str, object]:
    """Of a `Checkpoint`, or of a controller by its name: steady size of the headline metric and
    return, means over episodes; crashes; the verdict. The starts are those of the training's seed.
    """
    episodes = args.episodes
    options = find_controller(agent).options if isinstance(agent, str) else agent.spec.options
    keywords = {**options, "vehicle": args.vehicle, "backend": args.backend}
    if args.scene:
        keywords["scene"] = args.scene
    config = EnvConfig.from_keywords(env_id, **keywords).unseen()
    env = LocalVectorEnv(config, episodes, autoreset_mode="Disabled")
    spec = env.env_spec
    policy = find_controller(agent)(spec) if isinstance(agent, str) else agent.policy(spec)
    flown = fly_episodes(env, policy, episodes, "final", training_seed=seed)
    env.close()
    headline = replace(Headline.of(spec), held=args.within)
    sizes = [steady_state(headline.size(one.headline[1:]), final=headline.final) for one in flown]
    crashes = 0 if headline.final else sum(bool(one.terminated) for one in flown)
    speeds = [np.linalg.norm(one.telemetry["velocity"], axis=1).mean() for one in flown]
    last = np.mean([one.telemetry["metrics"][-1] for one in flown], axis=0)
    names = [metric.name for metric in spec.metrics]
    ends = {
        "good": int(headline.holds(sizes).sum()),
        "speed": round(float(np.mean(speeds)), 3),
        "means": dict(zip(names, last.round(4).tolist(), strict=True)),
    }
    return {
        "steady": round(float(np.mean(sizes)), 5),
        "worst": round(float(min(sizes) if headline.high else max(sizes)), 5),
        "return": round(float(np.mean([one.rewards.sum() for one in flown])), 2),
        "flight_seconds": round(float(np.mean([one.seconds for one in flown])), 2),
        "crashes": crashes,
        "holds": bool(headline.holds(np.mean(sizes))) and crashes <= 0.005 * episodes,
        **(ends if headline.final else {}),
    }


def main() -> None:
    parser = options(__doc__, seeds=20, first_seed=100, episodes=20, within=0.05, vehicle=str,
                     backend="mujoco", scene=str, out=RESULTS / "seconds.json")  # fmt: skip
    parser.add_argument("--beside", nargs="+", default=[],
                        help="controllers that fly the same starts")  # fmt: skip
    parser.add_argument("words", nargs="*", default=["ppo"])
    args = parser.parse_args()
    words = args.words + (["--vehicle", args.vehicle] if args.vehicle else [])
    rows = []
    beside = {}
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        with tempfile.TemporaryDirectory() as folder:
            row = {"seed": seed, **train(words, seed, Path(folder) / "run")}
            kept = load(Path(folder) / "run" / "checkpoint.safetensors")
        row["env_steps"] = kept.position.env_steps
        row |= evaluate(kept, kept.env_id, args, seed)
        row["load_average"] = round(os.getloadavg()[0], 1)
        rows.append(row)
        print(row, flush=True)
        beside = beside or {name: evaluate(name, kept.env_id, args, seed) for name in args.beside}
        note(args.out, words, args.within, args.episodes, rows, beside)
    print(f"{sum(row['holds'] for row in rows)} of {len(rows)} hold {args.within}")


def note(
    path: Path,
    words: list[str],
    within: float,
    episodes: int,
    rows: list[dict[str, object]],
    beside: dict[str, object],
) -> None:
    """After every seed, so that an interrupted measurement has those that were flown.

    `low` and `high` are the ends of Wilson's 95 % interval of the share of flights that crash.
    """
    flights = episodes * len(rows)
    crashes = sum(row["crashes"] for row in rows)
    low, high = share_interval(crashes, flights)
    result = {
        "command": f"rotorgram train {' '.join(words)}",
        "within": within,
        "hold": sum(row["holds"] for row in rows),
        "of": len(rows),
        "crashes": {"flights": flights, "crashes": crashes,
                    "low": round(low, 5), "high": round(high, 5)},
        **{name: {"median": round(statistics.median(row[name] for row in rows), 2),
                  "most": max(row[name] for row in rows)}
           for name in ("seconds", "processor_seconds")},
        "seeds": rows,
        **({"beside": beside} if beside else {}),
    }  # fmt: skip
    write(path, result)


if __name__ == "__main__":
    main()
