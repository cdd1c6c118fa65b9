"""A million control steps through a bad network, compared bit for bit with flights in process.

    python studies/soak.py [--steps 1000000] [--jobs 12] [--out FILE.json]

Every job is an agent, a relay that loses 30 % of the datagrams, doubles 10 %, reorders 20 %, spoils
7 %, and a simulator, each a process of its own. The agent flies the same seeds and random actions
on a local env beside it and compares every bit of every answer. The last job flies 64 drones, the
one before it with a key. One bit that differs ends the soak with the step's number.

It takes about an hour and a half on two cores.
"""

import json
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import rotorgram.envs  # noqa: F401
from measuring import RESULTS, launch, options, relay, write
from rotorgram.udp import RemoteVectorEnv
from rotorgram.udp.protocol.auth import write_key

FAULTS = {"drop": 0.3, "duplicate": 0.1, "reorder": 0.2, "corrupt": 0.05, "truncate": 0.02}
PERIOD = 0.01  # s: one physics step for each control step, so that the wire is what is soaked

SIMULATE = """
import json, sys
from rotorgram.udp import Simulator
settings = json.loads(sys.argv[1])
with Simulator(server=("127.0.0.1", settings["port"]), bind=("127.0.0.1", 0),
               num_envs=settings["drones"], key_file=settings["key"],
               control_period=settings["period"]) as simulator:
    simulator.run()
    print(json.dumps(simulator.link.statistics.numbers()), flush=True)
"""


def numbers(answer: tuple[Any, ...]) -> dict[str, bytes]:
    """Every bit of an answer of a vector env, by name."""
    *arrays, info = answer
    names = ["observations", "rewards", "terminated", "truncated"][: len(arrays)]
    told = {name: array for name, array in info.items() if not name.startswith(("_", "reward"))}
    return {
        name: np.ascontiguousarray(array).tobytes()
        for name, array in [*zip(names, arrays, strict=True), *told.items()]
    }


def soak(job: int, steps: int, drones: int, keyed: bool) -> dict[str, Any]:
    folder = Path(tempfile.mkdtemp())
    key = str(folder / "key") if keyed else None
    if key:
        write_key(Path(key))
    options = {"control_period": PERIOD}
    remote = RemoteVectorEnv(
        ("127.0.0.1", 0), num_envs=drones, options=options, key_file=key, connect=False
    )
    with relay([remote.address], {**FAULTS, "seed": job}) as (((_, port),), network):
        settings = {"port": port, "drones": drones, "key": key, "period": PERIOD}
        simulator = launch(SIMULATE, settings)
        local = gym.make_vec("rotorgram/Elevation-v0", num_envs=drones, **options)
        dice = np.random.default_rng(job)
        assert numbers(remote.reset(seed=job)) == numbers(local.reset(seed=job))
        began = time.perf_counter()
        different = None
        ended = 0
        for step in range(1, steps + 1):
            actions = dice.uniform(-1.2, 1.2, (drones, 1)).astype(np.float32)
            answer = remote.step(actions)
            if numbers(answer) != numbers(local.step(actions)):
                different = step
                break
            ended += int((answer[2] | answer[3]).sum())
        seconds = time.perf_counter() - began
        agent = remote.statistics.numbers()
        remote.close()
        there = json.loads(simulator.communicate()[0])
    return {
        "drones": drones, "key": keyed, "steps": step, "seconds": round(seconds, 1),
        "episodes": ended, "first_step_that_differs": different,
        "network": network[0], "agent": agent, "simulator": there,
    }  # fmt: skip


def main() -> None:
    out = RESULTS / "reliability" / "soak.json"
    args = options(__doc__, steps=1_000_000, jobs=12, out=out).parse_args()
    # 64 drones: a twentieth of the exchanges, more than half of the drones' steps.
    many = args.steps // 20
    each = -(-(args.steps - many) // (args.jobs - 1))
    kinds = [(each, 1, job == args.jobs - 2) for job in range(args.jobs - 1)] + [(many, 64, False)]
    with ProcessPoolExecutor(args.jobs) as executor:
        jobs = list(executor.map(soak, range(len(kinds)), *zip(*kinds, strict=True)))
    network: Counter[str] = Counter()
    for job in jobs:
        network.update(job["network"])
    result = {
        "faults": FAULTS,
        "control_steps": sum(job["steps"] for job in jobs),
        "drone_steps": sum(job["steps"] * job["drones"] for job in jobs),
        "episodes": sum(job["episodes"] for job in jobs),
        "bits_that_differ": sum(job["first_step_that_differs"] is not None for job in jobs),
        "network": dict(network),
        "jobs": jobs,
    }
    write(args.out, result)
    for job in jobs:
        rate = job["steps"] / job["seconds"]
        print(f"{job['drones']:3} drones {job['steps']:9,} steps, {rate:6.0f} steps/s, "
              f"first that differs: {job['first_step_that_differs']}")  # fmt: skip
    print(f"{result['control_steps']:,} control steps, {result['drone_steps']:,} drone steps")
    if result["bits_that_differ"]:
        sys.exit(1)


if __name__ == "__main__":
    main()
