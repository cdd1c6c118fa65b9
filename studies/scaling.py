"""What more cores, more simulators and more workers bring: the figures of docs/scaling.md.

    python studies/scaling.py [--out FILE.json]

* **threads**: the vector env of 1,024 drones on one thread and on two, in turns.
* **simulators**: 1, 2 and 4 of 1,024 drones each at one agent, in turns, on this machine. Besides
  the rate: the processor time that the agent takes for a control step, which is what a learner pays
  for simulators that have machines of their own. From it, and from the time that one simulator
  takes by itself, the rate with M machines like this one is extrapolated:

      M * 1024 / (t_physics + M * t_agent + round trip of the network)

* **runs**: one comparison of four trainings, by one worker, by two processes and by two
  workers of a Ray cluster (two nodes on this machine, started before the clock). Left out where
  there is no Ray.

It takes about eight minutes on two cores.
"""

import itertools
import statistics
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium as gym
import numpy as np
import rotorgram.envs  # noqa: F401  # makes the envs known
from measuring import RESULTS, in_turns, launch, medians, options, timed, write
from rotorgram.envs import LocalVectorEnv
from rotorgram.envs.config import EnvConfig
from rotorgram.flights.executors import WorkersConfig
from rotorgram.flights.folders import new_folder
from rotorgram.training.settings import Row, Study
from rotorgram.training.study import run_study
from rotorgram.udp import RemoteVectorEnv
from rotorgram.udp.spawn import start_simulator

ENV_ID = "rotorgram/Elevation-v0"
DRONES = 1024
MACHINES = 1, 2, 4, 8, 16
NETWORK = 0.0005
"""Round trip of a local network that the extrapolation assumes, s."""
CLUSTER = """
import sys
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
cluster.add_node(num_cpus=1)
print("at", cluster.address, flush=True)
sys.stdin.read()
cluster.shutdown()
"""


def fly(env: LocalVectorEnv | RemoteVectorEnv, seconds: float) -> tuple[float, float]:
    """Wall time of a control step, and processor time of this process for it, s."""
    actions = np.zeros((env.num_envs, 1), np.float32)
    return timed(lambda: env.advance(actions, env.done if env.done.any() else None), seconds)


@contextmanager
def simulators(count: int) -> Iterator[RemoteVectorEnv]:
    """An agent's env and its simulators, each a process."""
    here = "127.0.0.1", 0
    with closing(
        RemoteVectorEnv(
            here, num_envs=count * DRONES, num_simulators=count, connect=False,
            autoreset_mode="Disabled", connect_timeout=60.0,
        )
    ) as env, ExitStack() as stack:  # fmt: skip
        for _ in range(count):
            process = start_simulator(EnvConfig(env_id=ENV_ID), env.address, num_envs=DRONES)
            stack.callback(process.wait)
            stack.callback(process.stdin.close)
        env.connect()
        env.reset(seed=0)
        yield env


def measure(
    envs: Mapping[int, LocalVectorEnv | RemoteVectorEnv], rounds: int, seconds: float
) -> dict[int, dict[str, float]]:
    """Median rate in env steps/s and processor time per control step, s, of each."""
    found = {}
    for name, pairs in in_turns(envs, rounds, lambda env: fly(env, seconds)).items():
        wall, processor = np.median(pairs, axis=0)
        rate = round(envs[name].num_envs / wall)
        found[name] = {"rate": rate, "agent_seconds": round(processor, 6)}
    return found


def measure_threads(rounds: int, seconds: float) -> dict[int, float]:
    with ExitStack() as stack:
        envs = {}
        for threads in (1, 2):
            made = gym.make_vec(ENV_ID, num_envs=DRONES, num_threads=threads).unwrapped
            env = stack.enter_context(closing(made))
            env.reset(seed=0)
            envs[threads] = env
        return {name: value["rate"] for name, value in measure(envs, rounds, seconds).items()}


def measure_simulators(rounds: int, seconds: float) -> dict[int, dict[str, float]]:
    with ExitStack() as stack:
        envs = {count: stack.enter_context(simulators(count)) for count in (1, 2, 4)}
        return measure(envs, rounds, seconds)


def extrapolate(alone: float, measured: dict[int, dict[str, float]]) -> dict[str, object]:
    """Env steps/s with M machines like this one: one simulator on each, the agent apart."""
    physics = DRONES / alone
    agent = statistics.median(value["agent_seconds"] / n for n, value in measured.items())
    return {
        "t_physics": round(physics, 6),
        "t_agent": round(agent, 6),
        "t_network": NETWORK,
        "rates": {n: round(n * DRONES / (physics + n * agent + NETWORK)) for n in MACHINES},
    }


def measure_runs(env_steps: int, rounds: int) -> dict[str, object]:
    row = Row(agent="a2c", env_steps=env_steps)
    study = Study(rows=(row,), seeds=4, snapshots=1, curve_episodes=1, episodes=1, wire=True)
    ways = {"one worker": WorkersConfig(jobs=1), "two processes": WorkersConfig(jobs=2)}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        if find_spec("ray"):
            cluster = launch(CLUSTER, None)
            stack.callback(cluster.wait)
            stack.callback(cluster.stdin.close)
            address = next(x for x in cluster.stdout if x.startswith("at ")).split()[1]
            ways["two, Ray"] = WorkersConfig(jobs=2, runner="ray", address=address)
        numbers = itertools.count()

        def compared(workers: WorkersConfig) -> float:
            start = time.perf_counter()
            run_study(study, new_folder(folder / str(next(numbers)), ""), workers=workers)
            return round(time.perf_counter() - start, 2)

        seconds = in_turns(ways, rounds, compared)
    return {
        "env_steps": env_steps,
        "trainings": study.seeds,
        "seconds": medians(seconds),
        "rounds": seconds,
    }


def main() -> None:
    out = RESULTS / "performance" / "scaling.json"
    args = options(__doc__, rounds=5, seconds=2.0, env_steps=40_000, out=out).parse_args()
    threads = measure_threads(args.rounds, args.seconds)
    print("threads:", threads, flush=True)
    measured = measure_simulators(args.rounds, args.seconds)
    print("simulators:", measured, flush=True)
    extrapolated = extrapolate(threads[2], measured)
    print("extrapolated:", extrapolated, flush=True)
    runs = measure_runs(args.env_steps, rounds=3)
    print("runs:", runs["seconds"], flush=True)
    content = {
        "drones": DRONES,
        "threads": threads,
        "simulators": measured,
        "extrapolated": extrapolated,
        "runs": runs,
    }
    write(args.out, content)


if __name__ == "__main__":
    main()
