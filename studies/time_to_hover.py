"""Wall time from nothing to a policy that holds: ours and SB3's A2C, each with its best settings.

    python studies/time_to_hover.py [--seeds 5] [--out FILE.json]

For each setting and seed a process is started that imports everything, starts a simulator, trains
over UDP and evaluates the policy without exploration: the mean of |E| over the last quarter of 20
episodes, m. The clock runs from the start of the process to its end. A setting counts as reached
where every seed holds |E| < 0.05 m; the settings are those that reached it soonest among those that
were tried.
"""

import json
import statistics
import subprocess
import sys
import time
from typing import Any

from measuring import RESULTS, options, write

FLY = """
import json, sys
import numpy as np
import rotorgram.envs
from rotorgram.agents import preset
from rotorgram.training.metrics import Headline, measure_episode
from rotorgram.udp.spawn import spawn_simulator
from rotorgram.training.settings import Run
from rotorgram.training.training import Training
from rotorgram.flights.trajectories import fly_episodes
s = json.loads(sys.argv[1])
run = Run(algorithm=s["agent"], config=preset(s["agent"], "tuned", **s["changes"]),
          seed=s["seed"], env_steps=s["env_steps"], num_envs=s["drones"])
with spawn_simulator(run.flown, num_envs=run.num_envs) as remote:
    training = Training(run, remote)
    training.train()
spec = training.log.spec
with spawn_simulator(run.flown, num_envs=20) as remote:
    flown = fly_episodes(remote, training.agent.policy(), 20, "final")
rows = [measure_episode(one, Headline.of(spec)) for one in flown]
print(json.dumps({"training": training.log.seconds,
                  "error": float(np.mean([r["steady"] for r in rows]))}))
"""

MANY: dict[str, Any] = {"steps_per_update": 2048, "learning_rate": 0.03}
SOME: dict[str, Any] = {"steps_per_update": 1024, "learning_rate": 0.02}
SETTINGS: list[dict[str, Any]] = [
    {"agent": "a2c", "drones": 32, "env_steps": 200_000, "changes": SOME},
    {"agent": "a2c", "drones": 1, "env_steps": 200_000, "changes": {}},
    {"agent": "sb3-a2c", "drones": 64, "env_steps": 200_000, "changes": MANY},
    {"agent": "sb3-a2c", "drones": 32, "env_steps": 200_000, "changes": SOME},
    {"agent": "sb3-a2c", "drones": 1, "env_steps": 200_000, "changes": {}},
]


def measure(setting: dict[str, Any], seed: int) -> dict[str, float]:
    start = time.perf_counter()
    words = [sys.executable, "-c", FLY, json.dumps({**setting, "seed": seed})]
    said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    wall = time.perf_counter() - start
    return {"wall": round(wall, 2), **{k: round(v, 4) for k, v in json.loads(said).items()}}


def main() -> None:
    out = RESULTS / "performance" / "time_to_hover.json"
    args = options(__doc__, seeds=5, out=out).parse_args()
    runs: list[list[dict[str, float]]] = [[] for _ in SETTINGS]
    for seed in range(args.seeds):
        for setting, flown in zip(SETTINGS, runs, strict=True):
            flown.append(measure(setting, seed))
            print(f"{setting['agent']:8} {setting['drones']:3} drones, seed {seed}: {flown[-1]}",
                  flush=True)  # fmt: skip
    results = [
        {
            **setting,
            "wall_seconds": statistics.median(run["wall"] for run in flown),
            "training_seconds": statistics.median(run["training"] for run in flown),
            "worst_error": max(run["error"] for run in flown),
            "reached": all(run["error"] < 0.05 for run in flown),
            "runs": flown,
        }
        for setting, flown in zip(SETTINGS, runs, strict=True)
    ]
    write(args.out, {"settings": results})
    print("| agent | drones | env steps | wall time, s | worst |E|, m |\n|---|---|---|---|---|")
    for r in results:
        print(f"| {r['agent']} | {r['drones']} | {r['env_steps']:,} | {r['wall_seconds']:.1f} | "
              f"{r['worst_error']:.3f} |")  # fmt: skip


if __name__ == "__main__":
    main()
