"""Samples per second of updates: our PPO and A2C beside SB3's, on data of the same env.

    OMP_NUM_THREADS=1 python studies/updates.py [--seconds 3] [--cases ppo] [--out FILE.json]

`--cases` takes only those whose names begin so. Networks, batch, epochs and minibatches are the
same. A sample is a transition in one step of Adam, so an epoch counts each of a rollout once. Ours
and SB3's take turns, update by update, in one process: set OMP_NUM_THREADS=1; medians are compared.
Computing the advantages is part of an update of ours, and of SB3's `train` it is not: SB3 does it
while it flies.

It takes about two minutes on two cores.
"""

import os
import time
from typing import Any

import numpy as np
from measuring import RESULTS, options, write
from rotorgram.agents import EpisodeRecorder, make_agent, preset
from rotorgram.agents.rollouts import Rollout
from rotorgram.envs import LocalVectorEnv

CASES: dict[str, tuple[str, str, int, dict[str, int]]] = {
    "ppo, Elevation-v0": ("ppo", "rotorgram/Elevation-v0", 32, {}),
    "ppo, Hover-v0": ("ppo", "rotorgram/Hover-v0", 64, {}),
    "a2c, 256 steps of 1 drone": ("a2c", "rotorgram/Elevation-v0", 1, {}),
    "a2c, 1,024 steps of 64 drones": ("a2c", "rotorgram/Elevation-v0", 64,
                                      {"steps_per_update": 1024}),
}  # fmt: skip
"""Algorithm, env, drones and changes to the preset `tuned`."""


class Updates:
    """An agent that has flown a rollout, to update from it again and again."""

    def __init__(self, algorithm: str, env_id: str, drones: int, config: Any) -> None:
        env = LocalVectorEnv(env_id, drones, autoreset_mode="Disabled", num_threads=1)
        log = EpisodeRecorder(env, 0)
        self.agent: Any = make_agent(algorithm, log, config, 0)
        self.rollouts: list[Rollout] = []
        total = 2 * config.rollout_size(drones)
        if algorithm.startswith("sb3-"):
            self.agent.train(log, total, lambda: True)
            self.agent.model.on_update = lambda: True
            self.update = self.agent.model.train
        else:
            update = self.agent.update
            self.agent.update = lambda rollout: (self.rollouts.append(rollout), update(rollout))
            self.agent.train(log, total, lambda: True)
            self.update = lambda: update(self.rollouts[-1])

    def seconds(self) -> tuple[float, float]:
        """Wall time and processor time of an update, s: on a busy machine compare the second."""
        wall = time.perf_counter()
        processor = time.process_time()
        self.update()
        return time.perf_counter() - wall, time.process_time() - processor


def measure(case: tuple[str, str, int, dict[str, int]], seconds: float) -> dict[str, object]:
    algorithm, env_id, drones, changes = case
    config = preset(algorithm, "tuned", env_id, **changes)
    updates = {name: Updates(name, env_id, drones, config)
               for name in (algorithm, f"sb3-{algorithm}")}  # fmt: skip
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in updates}
    until = time.perf_counter() + seconds
    while time.perf_counter() < until or len(times[algorithm]) < 5:
        for name, update in updates.items():
            times[name].append(update.seconds())
    batch = config.rollout_size(drones)
    samples = batch * getattr(config, "epochs", 1)
    medians = {name: np.median(one, axis=0) for name, one in times.items()}
    wall, processor = medians[f"sb3-{algorithm}"] / medians[algorithm]
    return {
        "hidden": config.hidden, "batch": batch,
        "minibatches": getattr(config, "minibatches", 1), "epochs": getattr(config, "epochs", 1),
        "samples_per_second": {name: round(samples / t[0]) for name, t in medians.items()},
        "ratio": round(wall, 2), "ratio_of_processor_time": round(processor, 2),
    }  # fmt: skip


def main() -> None:
    args = options(__doc__, seconds=3.0, cases="", out=RESULTS / "updates.json").parse_args()
    cases = {}
    for name, case in CASES.items():
        if not name.startswith(args.cases):
            continue
        cases[name] = result = measure(case, args.seconds)
        print(
            f"{name:30} {result['samples_per_second']}, ratio {result['ratio']} "
            f"({result['ratio_of_processor_time']} of processor time)",
            flush=True,
        )
    write(args.out, {"cases": cases, "load_average": round(os.getloadavg()[0], 1)})


if __name__ == "__main__":
    main()
