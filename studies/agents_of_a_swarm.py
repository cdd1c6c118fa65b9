"""Eight agent processes that fly one world together, killed and stopped.

    python studies/agents_of_a_swarm.py [--kills 20] [--out FILE.json]

Eight drones fly in one world, each by an agent process of its own (`RemoteEnv`), through relays
that lose 30 % of the datagrams, double 10 % and reorder 10 %. At random moments an agent is killed
(SIGKILL) and started again, or stopped (SIGSTOP) for 2 s, which is longer than the world waits.
The drone of an agent that is lost holds.

An action is computed from every bit of the observation before it. A second world, in process, gets
the seeds, the absences and the actions that the simulator took: every bit of every State has to be
the same, and every action the one that follows from it.

It takes about three minutes on two cores.
"""

import json
import random
import signal
import subprocess
import sys
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable

import numpy as np
from measuring import RESULTS, free_ports, launch, options, relay, write
from rotorgram.envs import ArraySpec, Outcome, Task, register
from rotorgram.envs.config import EnvConfig
from rotorgram.envs.loop import Loop
from rotorgram.envs.state import State as TaskState
from rotorgram.sim import Draw, InitialState
from rotorgram.udp import LinkConfig, Simulator
from rotorgram.udp.protocol.messages import Command

ENV_ID = "benchmark/Row-v0"
FAULTS = {"drop": 0.3, "duplicate": 0.1, "reorder": 0.1}
AGENTS, PATIENCE, STOPPED = 8, 1.0, 2.0  # drones and agents; s
ANY = ("127.0.0.1", 0)

AGENT = """
import json, sys, zlib
import numpy as np
from rotorgram.udp import PeerClosed, RemoteEnv
port = json.loads(sys.argv[1])
env = RemoteEnv(("127.0.0.1", port), connect_timeout=600)
try:
    while True:
        observation, _ = env.reset()
        over = False
        while not over:
            number = zlib.crc32(observation.tobytes()) % 2001 - 1000
            observation, _, *ends, _ = env.step(np.array([number / 10_000], np.float32))
            over = any(ends)
except PeerClosed:
    pass
"""


class Row(Task):
    """Drones in a row, 5 m apart and 2 m high. One that rises by 5 cm is out."""

    action = "offset"
    episode_length = 200
    max_drones = 128

    def setup(self) -> None:
        self.observation = (ArraySpec(name="observation", shape=(3,)),)

    def begin(self, draw: Draw) -> InitialState:
        row = 5.0 * np.arange(self.shape[1]) + draw.uniform(-0.1, 0.1)
        return InitialState(position=np.stack((row, 0.0 * row, 2.0 + 0.0 * row), axis=-1))

    def observe(self, state: TaskState) -> dict[str, np.ndarray]:
        return {"observation": state.position}

    def outcome(self, state: TaskState) -> Outcome:
        risen = state.position[..., 2] - 2.0
        return Outcome(reward={"risen": risen}, terminated=risen > 0.05, metrics={})


register(ENV_ID, Row)


def action_of(observation: np.ndarray) -> np.float32:
    """As in an agent above."""
    return np.float32((zlib.crc32(observation.tobytes()) % 2001 - 1000) / 10_000)


class Twin:
    """A world in process that repeats what the simulator does, and compares every bit."""

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        self.loop = Loop(EnvConfig(env_id=ENV_ID, drones=AGENTS))
        self.absent = np.zeros(AGENTS, bool)
        kinds = ("coming", "waiting", "left")
        self.counts = Counter({f"absent_{kind}": 0 for kind in kinds})
        self.shown = np.zeros((AGENTS, 3), np.float32)

    def __call__(self, cause: Command) -> None:
        loop = self.loop
        rules = self.simulator.rules
        begins = bool(cause.resets.all())
        if begins:
            loop.advance(cause.actions, cause.resets, cause.seeds)
            self.absent = np.zeros(AGENTS, bool)
        for number, link in enumerate(rules.links):
            is_new = link.participation != "flying" and not self.absent[number]
            if is_new and not loop.out[number]:
                self.absent[number] = True
                came_back = link.participation == "ready"
                self.counts[f"absent_{'coming' if came_back else link.participation}"] += 1
        if not begins:
            flying = ~(self.absent | loop.out)
            for drone in range(AGENTS):
                right = action_of(self.shown[drone]) if flying[drone] else np.float32(0.0)
                here = cause.actions[drone, 0]
                self.counts["actions_that_differ"] += int(flying[drone] and here != right)
                self.counts["drone_steps_by_commands"] += int(flying[drone])
            loop.advance(cause.actions)
            self.counts["control_steps"] += 1
        here, there = (
            (world.observations["observation"], world.rewards, world.terminated, world.truncated,
             *world.telemetry.values())
            for world in (loop, self.simulator.stepped)
        )  # fmt: skip
        same = all(a.tobytes() == b.tobytes() for a, b in zip(here, there, strict=True))
        self.counts["states_that_differ"] += not same
        self.shown = loop.observations["observation"].copy()


def fly_eight(kills: int, dice: random.Random) -> dict[str, object]:
    ports = free_ports(AGENTS)
    agents = [launch(AGENT, port) for port in ports]
    done: Counter[str] = Counter()
    try:
        with relay([("127.0.0.1", port) for port in ports], FAULTS) as (addresses, counts):
            simulator = Simulator(
                ENV_ID, agents=addresses, drones=AGENTS, bind=ANY, patience=PATIENCE,
                config=LinkConfig(timeout=600),
            )  # fmt: skip
            rules = simulator.rules
            twin = Twin(simulator)
            simulator.observers.append(twin)
            thread = threading.Thread(target=simulator.run)
            thread.start()
            try:
                for number in range(kills):
                    wait_for(lambda: rules.steps >= 5 and rules.episodes, thread)
                    time.sleep(dice.uniform(0.0, 1.5))
                    victim = dice.randrange(AGENTS)
                    done[disturb(agents, victim, ports[victim], dice)] += 1
                    print(f"{number + 1} of {kills}: {dict(done)}, {dict(twin.counts)}", flush=True)
                wanted = rules.episodes + 3  # all take part again
                wait_for(lambda: rules.episodes >= wanted, thread)
                present = [link.participation for link in rules.links]
            finally:
                simulator.stop()
                thread.join(60)
                simulator.close()
    finally:
        time.sleep(1.0)
        for agent in agents:
            agent.kill()
            agent.wait()
    network: Counter[str] = Counter()
    for counters in counts:
        network.update(counters)
    return {
        "agents": AGENTS, "faults": FAULTS, "patience": PATIENCE, **done,
        "episodes": rules.episodes, **twin.counts,
        "agents_lost_for_good": present.count("left"), "network": dict(network),
    }  # fmt: skip


def wait_for(condition: Callable[[], object], thread: threading.Thread) -> None:
    """Wait until a condition holds, while the simulator's thread runs."""
    while not condition():
        assert thread.is_alive(), "the simulator failed"
        time.sleep(0.01)


def disturb(
    agents: list[subprocess.Popen[str]], victim: int, port: int, dice: random.Random
) -> str:
    """Kill an agent and start it again, or stop it for a while: what was done."""
    if dice.random() < 0.6:
        agents[victim].kill()
        agents[victim].wait()
        time.sleep(dice.choice((0.0, 2 * PATIENCE)))
        agents[victim] = launch(AGENT, port)
        return "killed"
    agents[victim].send_signal(signal.SIGSTOP)
    time.sleep(STOPPED)
    agents[victim].send_signal(signal.SIGCONT)
    return "stopped"


def main() -> None:
    out = RESULTS / "reliability" / "swarm.json"
    args = options(__doc__, kills=20, seed=0, out=out).parse_args()
    result = fly_eight(args.kills, random.Random(args.seed))
    write(args.out, {"agent_processes": result})
    print(json.dumps(result, indent=2))
    if result["states_that_differ"] or result["actions_that_differ"]:
        sys.exit(1)


if __name__ == "__main__":
    main()
