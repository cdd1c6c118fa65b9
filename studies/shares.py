"""What each part of a training of many drones over the wire costs: PPO on Hover.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python studies/shares.py [--drones 128]

Processor microseconds of a step of all drones, medians of rounds in which the parts take turns:
`simulate` is the loop with its physics, task and telemetry; `wire` both sides of an exchange, in
one process whose waits sleep at once, less its simulation; `fly` the policy's draw and the log of
episodes; `learn` an update, spread over the steps of its rollout. Agent and simulator alternate, so
the sum is the time of a step where each has a core. Writes docs/results/rigid/shares.json.
"""

import time
from collections.abc import Callable
from threading import Thread
from typing import Any

import numpy as np
from measuring import RESULTS, medians, options, write
from rotorgram.agents import EpisodeRecorder, make_agent, preset
from rotorgram.envs import EnvConfig, LocalVectorEnv, Loop
from rotorgram.udp import RemoteVectorEnv, Simulator
from rotorgram.udp.transport import sockets

HOVER = "rotorgram/Hover-v0"
OUT = RESULTS / "rigid" / "shares.json"


def microseconds(fly: Callable[[], None], times: int) -> float:
    began = time.process_time()
    for _ in range(times):
        fly()
    return (time.process_time() - began) / times * 1e6


def simulate(backend: Any, drones: int) -> Callable[[], None]:
    loop = Loop(EnvConfig.from_keywords(HOVER, backend=backend), drones)
    actions = np.zeros((drones, 4), np.float32)
    loop.advance(actions, np.ones(drones, bool), range(drones))

    def fly() -> None:
        loop.advance(actions, loop.done if loop.done.any() else None)
        assert loop.telemetry

    return fly


def exchange(drones: int) -> Callable[[], None]:
    sockets._LOOK = 0.0  # type: ignore[misc]
    env = RemoteVectorEnv(("127.0.0.1", 0), num_envs=drones, autoreset_mode="Disabled",
                          connect=False)  # fmt: skip
    simulator = Simulator(HOVER, server=env.address, bind=("127.0.0.1", 0), num_envs=drones,
                          backend="rigid")  # fmt: skip
    Thread(target=simulator.run, daemon=True).start()
    env.connect()
    env.reset(seed=0)
    actions = np.zeros((drones, 4), np.float32)
    return lambda: env.advance(actions, env.done if env.done.any() else None)


class Agent:
    """PPO on an env whose steps cost nothing that is counted."""

    def __init__(self, drones: int) -> None:
        config: Any = preset("ppo", "tuned", HOVER)
        self.steps = config.rollout_size(drones) // drones
        env: Any = LocalVectorEnv(HOVER, drones, autoreset_mode="Disabled", backend="rigid")
        log = EpisodeRecorder(env, 0)
        self.spent = {"env": 0.0, "learn": 0.0}
        self.agent: Any = make_agent("ppo", log, config, 0)
        env.advance = self.timed("env", env.advance)
        self.agent.update = self.timed("learn", self.agent.update)
        self.log = log

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> None:
            began = time.process_time()
            function(*arguments)
            self.spent[name] += time.process_time() - began

        return call

    def rollout(self) -> dict[str, float]:
        """Microseconds of a step: `fly` and `learn`."""
        self.spent = dict.fromkeys(self.spent, 0.0)
        began = time.process_time()
        self.agent.train(self.log, self.log.env_steps + self.steps * self.log.num_envs, bool)
        whole = time.process_time() - began
        parts = {"fly": whole - sum(self.spent.values()), "learn": self.spent["learn"]}
        return {name: seconds / self.steps * 1e6 for name, seconds in parts.items()}


def main() -> None:
    args = options(__doc__, drones=128, rounds=15).parse_args()
    ways = {f"simulate {name}": simulate(name, args.drones) for name in ("mujoco", "rigid")}
    agent = Agent(args.drones)
    both = exchange(args.drones)
    rows: dict[str, list[float]] = {}
    for _ in range(args.rounds):
        times = {name: microseconds(fly, 20) for name, fly in ways.items()}
        times["wire"] = microseconds(both, 50) - times["simulate rigid"]
        for name, value in (times | agent.rollout()).items():
            rows.setdefault(name, []).append(value)
    middle = {name: round(value) for name, value in medians(rows).items()}
    write(OUT, {"drones": args.drones, "rounds": args.rounds, "microseconds_per_step": middle})
    for name, value in middle.items():
        print(f"{name:16} {value:6,} µs")


if __name__ == "__main__":
    main()
