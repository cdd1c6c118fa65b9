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
"""

import statistics
import subprocess
import sys
import time
from contextlib import ExitStack, closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium as gym
import numpy as np
import rotorgram.envs  # noqa: F401  # makes the envs known
from measuring import RESULTS, medians, options, write
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


def fly(env, seconds):
    """Control steps per second, and the processor time of this process for each, s."""
    count = 0
    actions = np.zeros((env.num_envs, 1), np.float32)
    wall = time.perf_counter()
    cpu = time.process_time()
    while time.perf_counter() - wall < seconds:
        env.advance(actions, env.done if env.done.any() else None)
        count += 1
    return count / (time.perf_counter() - wall), (time.process_time() - cpu) / count


@contextmanager
def simulators(count):
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


def in_turns(envs, rounds, seconds):
    """Median rate in env steps/s and processor time per control step, s, of each."""
    measured = {name: [] for name in envs}
    for number in range(rounds + 1):
        for name, env in envs.items():
            rate, cpu = fly(env, seconds)
            if number:  # the first round warms up
                measured[name].append((rate * env.num_envs, cpu))
    return {
        name: {
            "rate": round(statistics.median(rate for rate, _ in pairs)),
            "agent_seconds": round(statistics.median(cpu for _, cpu in pairs), 6),
        }
        for name, pairs in measured.items()
    }


def measure_threads(rounds, seconds):
    with ExitStack() as stack:
        envs = {}
        for threads in (1, 2):
            made = gym.make_vec(ENV_ID, num_envs=DRONES, num_threads=threads).unwrapped
            env = stack.enter_context(closing(made))
            env.reset(seed=0)
            envs[threads] = env
        return {name: value["rate"] for name, value in in_turns(envs, rounds, seconds).items()}


def measure_simulators(rounds, seconds):
    with ExitStack() as stack:
        envs = {count: stack.enter_context(simulators(count)) for count in (1, 2, 4)}
        return in_turns(envs, rounds, seconds)


def extrapolate(alone, measured):
    """Env steps/s with M machines like this one: one simulator on each, the agent apart."""
    physics = DRONES / alone
    agent = statistics.median(value["agent_seconds"] / n for n, value in measured.items())
    return {
        "t_physics": round(physics, 6),
        "t_agent": round(agent, 6),
        "t_network": NETWORK,
        "rates": {n: round(n * DRONES / (physics + n * agent + NETWORK)) for n in MACHINES},
    }


def measure_runs(env_steps, rounds):
    row = Row(agent="a2c", env_steps=env_steps)
    study = Study(rows=(row,), seeds=4, snapshots=1, curve_episodes=1, episodes=1, wire=True)
    ways = {"one worker": WorkersConfig(jobs=1), "two processes": WorkersConfig(jobs=2)}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        if find_spec("ray"):
            pipe = subprocess.PIPE
            cluster = subprocess.Popen(
                [sys.executable, "-c", CLUSTER], stdin=pipe, stdout=pipe, text=True
            )
            stack.callback(cluster.wait)
            stack.callback(cluster.stdin.close)
            address = next(x for x in cluster.stdout if x.startswith("at ")).split()[1]
            ways["two, Ray"] = WorkersConfig(jobs=2, runner="ray", address=address)
        seconds = {name: [] for name in ways}
        for number in range(rounds):
            for name, way in ways.items():
                start = time.perf_counter()
                run_study(study, new_folder(folder / f"{number} {name}", ""), workers=way)
                seconds[name].append(round(time.perf_counter() - start, 2))
                print(f"{name}: {seconds[name][-1]} s", flush=True)
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
