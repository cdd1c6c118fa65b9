"""Env steps per second of training through the socket: our A2C and VPG beside SB3's A2C.

    python benchmarks/training_speed.py [--env-steps 20000] [--repeats 5] [--out FILE.json]

Every training has a simulator process and a socket pair of its own, the same networks, the same
hyperparameters (preset `tuned`) and the same number of env steps. The agents take turns, so that a
machine that slows down slows all of them; medians are compared. Imports and the start of the
simulator are not counted.
"""

import argparse
import json
import os
import platform
import statistics
from pathlib import Path

from rotorgram.agents import preset
from rotorgram.agents.checkpoints import software_versions
from rotorgram.experiments.pairs import socket_pair
from rotorgram.experiments.settings import Run
from rotorgram.experiments.training import Training

AGENTS = ("a2c", "vpg", "sb3-a2c")


def steps_per_second(algorithm: str, env_steps: int, seed: int) -> float:
    run = Run(
        algorithm=algorithm,
        config=preset(algorithm, "tuned"),
        seed=seed,
        env_steps=env_steps,
    )
    with socket_pair(**run.env) as env:
        training = Training(run, env)
        training.train()
        return training.log.env_steps / training.log.seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-steps", type=int, default=20_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("docs/results/training_speed.json"))
    args = parser.parse_args()
    rates: dict[str, list[float]] = {agent: [] for agent in AGENTS}
    for repeat in range(args.repeats):
        for agent in AGENTS:
            rate = steps_per_second(agent, args.env_steps, seed=repeat)
            rates[agent].append(round(rate, 1))
            print(f"{agent:8} {rate:8,.0f} env steps/s", flush=True)
    medians = {agent: statistics.median(values) for agent, values in rates.items()}
    reference = medians["sb3-a2c"]
    result = {
        "env_steps": args.env_steps,
        "rates": rates,
        "medians": medians,
        "ratio_to_sb3": {agent: round(m / reference, 2) for agent, m in medians.items()},
        "versions": software_versions(),
        "machine": {"processor": platform.machine(), "cores": os.cpu_count()},
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=2) + "\n")
    for agent, median in medians.items():
        print(f"{agent:8} median {median:8,.0f} env steps/s, {median / reference:.2f} x SB3's A2C")


if __name__ == "__main__":
    main()
